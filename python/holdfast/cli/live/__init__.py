"""The live views of `holdfast watch`: their screen, their sources, and what has changed."""

"""The messages of the scanner. Does no I/O."""

"""The messages of the scanner, and what programs of each dialect send and expect. Does no I/O."""

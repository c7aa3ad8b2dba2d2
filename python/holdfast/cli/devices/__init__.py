"""Commands that read, write, find, describe and simulate devices."""

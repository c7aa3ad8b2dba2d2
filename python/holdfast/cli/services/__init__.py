"""Commands that run a service until a signal."""

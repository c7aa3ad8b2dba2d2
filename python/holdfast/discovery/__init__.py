"""Finds devices and their addresses, and describes what registers mean. Uses no terminal."""

"""Tools for the command line and for other callers: discovery, inference, plans, load tests.

This package never uses a terminal.
"""

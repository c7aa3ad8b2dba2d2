"""What the command line offers to other callers too: discovery, inference, plans, load.

Nothing here knows a terminal.
"""

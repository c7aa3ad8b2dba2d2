"""Why the scanner does not do what it is asked."""

from __future__ import annotations


class Refused(Exception):
    """A request that is not carried out; nothing has changed. The text is for whoever asked."""

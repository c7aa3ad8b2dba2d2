"""The error of requests that the scanner refuses."""

from __future__ import annotations

STOPPING = "the scanner is stopping"


class Refused(Exception):
    """A request was refused; nothing has changed. The message is sent to the caller."""


class Moved(Refused):
    """Another node uses the device. Nothing was written."""

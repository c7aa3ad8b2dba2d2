"""The error of requests that the scanner refuses."""

from __future__ import annotations

STOPPING = "the scanner is stopping"


class Refused(Exception):
    """A request was refused; nothing has changed, but for `NotConfirmed`.

    The message is sent to the caller.
    """


class NotConfirmed(Refused):
    """Nobody knows whether the request was carried out, or still will be."""


class Moved(Refused):
    """Another node uses the device. Nothing was written."""

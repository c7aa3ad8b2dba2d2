"""What says that the buffer file of an output is not used any more."""

from __future__ import annotations


class FileGone(OSError):
    """The file could not be used any more, and is closed: another can be opened in its place, but
    if it `stays` there.

    `lost` readings waited in it.
    """

    def __init__(self, message: str, lost: int, stays: bool = False) -> None:
        super().__init__(message)
        self.lost, self.stays = lost, stays

"""Puts full files aside: FILE becomes FILE.1, FILE.1 becomes FILE.2 and so on.

Who writes a file decides when it is full: `audit/file.py`, `outputs/text_file.py`, and the log of
the Windows service.
"""

from __future__ import annotations

import contextlib
import math
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

RETRY_S = 10.0
"""Seconds after a failure in which a full file grows before the next attempt."""


class Rotation:
    """A file, and up to `keep` older ones. If renaming fails, no file is lost.

    A file is renamed to FILE.0 first, then to FILE.1. `take_up` finishes what a crash interrupted.
    """

    def __init__(self, file: Path, keep: int, failed: Callable[[], object]) -> None:
        """`failed` is called inside the `except` block, for the first of consecutive failures."""
        self._file, self._keep, self._failed = file, keep, failed
        self._spare = self.numbered(0)
        self._is_failing = False
        self._again_at = -math.inf

    @property
    def may_rotate(self) -> bool:
        """Whether a rotation may be tried: false for `RETRY_S` after a failure."""
        return time.monotonic() >= self._again_at

    def numbered(self, number: int) -> Path:
        """The name of a file that was put aside; the oldest has the highest number."""
        return self._file.with_name(f"{self._file.name}.{number}")

    def rotate(self) -> None:
        """Puts the file aside, which nobody here may have open: Windows renames no open file.

        If that fails, the file keeps its name.
        """
        try:
            self._rotate()
        except OSError:
            self._again_at = time.monotonic() + RETRY_S
            if not self._is_failing:
                self._is_failing = True
                self._failed()
        else:
            self._is_failing, self._again_at = False, -math.inf

    def take_up(self) -> None:
        """Puts aside what a crash has left, if that is possible now."""
        with contextlib.suppress(OSError):
            self._make_room()

    def _rotate(self) -> None:
        if self._keep == 0:
            self._file.unlink(missing_ok=True)
            return
        self._make_room()
        with contextlib.suppress(FileNotFoundError):
            self._file.replace(self._spare)
        try:
            self._make_room()
        except OSError:
            if not self._file.exists():
                self._spare.replace(self._file)
            raise

    def _make_room(self) -> None:
        """Renames FILE.0 to FILE.1, after those before it. Uses a gap that a failure has left."""
        if not self._spare.exists():
            return
        numbers = range(1, self._keep + 1)
        free = (number for number in numbers if not self.numbered(number).exists())
        for number in range(next(free, self._keep), 0, -1):
            self.numbered(number - 1).replace(self.numbered(number))

"""The files of a configuration at one moment, to notice which ones were renamed into place.

A file that is written in place can be half of itself and valid at any moment. A file that is
renamed into place, itself or by a symbolic link on the way to it, was complete before.
"""

from __future__ import annotations

import contextlib
import os
import sys
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from holdfast.runtime.bounded_files import call

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

Change: TypeAlias = Literal["replaced", "written", "removed"]


class State(NamedTuple):
    """The file that a path leads to."""

    identity: tuple[int, int]
    """Its device and number."""
    written: tuple[int, int]
    """When it was written, and its size."""


class _Held:
    """An open file. As long as it is open, no other file gets its number."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor

    def __del__(self) -> None:
        os.close(self.descriptor)


class FileSnapshot:
    """The state of files at one moment: `None` for a path without a file."""

    def __init__(self, files: Iterable[Path], *, hold: bool) -> None:
        """With `hold`, other files do not get the numbers of these while this object exists."""
        self._held: dict[Path, _Held] = {}
        self.states: dict[Path, State | None] = {file: self._state(file, hold) for file in files}

    def read_after(self, before: FileSnapshot) -> FileSnapshot:
        """These files as they were before they were read, so that no change in between is lost."""
        for file in self.states.keys() & before.states.keys():
            self.states[file] = before.states[file]
            self._held.pop(file, None)
            if file in before._held:
                self._held[file] = before._held[file]
        return self

    def changed(self, now: FileSnapshot) -> dict[Path, Change]:
        """The changes of these files from this snapshot to `now`."""
        found = {
            file: _change(state, now.states[file])
            for file, state in self.states.items()
            if file in now.states
        }
        return {file: change for file, change in found.items() if change is not None}

    def not_taken_over(
        self, before: FileSnapshot | None, now: FileSnapshot
    ) -> dict[Path, str] | None:
        """Why the changes since this snapshot are not taken over, by file; `None` if they are.

        `before` is the look before `now`. Files that were renamed into place are taken over if
        nothing has changed since that look, and no file was written in place.
        """
        changed = self.changed(now)
        is_steady = before is not None and before.states == now.states
        is_written = "written" in changed.values()
        if is_steady and "replaced" in changed.values() and not is_written:
            return None
        reasons: dict[Path, str] = {}
        for file, change in changed.items():
            if change == "written":
                reasons[file] = "written in place, not renamed"
            elif change == "replaced" and is_written:
                reasons[file] = "replaced, but another file was written in place"
            elif change == "removed" and is_steady:
                reasons[file] = "removed"
        return reasons

    def _state(self, file: Path, hold: bool) -> State | None:
        held: _Held | None = None
        # Other systems don't use a number again soon.
        if hold and sys.platform == "linux":
            with contextlib.suppress(OSError):
                held = _Held(call(file, os.open, file, os.O_PATH | os.O_CLOEXEC))
        try:
            status = call(file, os.stat, file if held is None else held.descriptor)
        except OSError:
            return None
        if held is not None:
            self._held[file] = held
        return State((status.st_dev, status.st_ino), (status.st_mtime_ns, status.st_size))


def _change(before: State | None, now: State | None) -> Change | None:
    if now is None:
        return None if before is None else "removed"
    if before is None or before.identity != now.identity:
        return "replaced"
    return None if before == now else "written"

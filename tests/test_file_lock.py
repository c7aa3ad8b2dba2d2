"""The lock of a file on Windows, with a module in the place of `msvcrt`."""

from __future__ import annotations

import errno
import importlib.util
import os
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.events import file_lock as own

if TYPE_CHECKING:
    from pathlib import Path


class Msvcrt(ModuleType):
    """Locks one byte of a file for each descriptor, as Windows does."""

    LK_NBLCK = 2

    def __init__(self) -> None:
        super().__init__("msvcrt")
        self.locked: dict[tuple[int, int], int] = {}
        self.failure: OSError | None = None

    def locking(self, descriptor: int, mode: int, count: int) -> None:
        assert (mode, count) == (self.LK_NBLCK, 1)
        if self.failure is not None:
            raise self.failure
        place = os.fstat(descriptor).st_ino, os.lseek(descriptor, 0, os.SEEK_CUR)
        if self.locked.setdefault(place, descriptor) != descriptor:
            raise PermissionError(errno.EACCES, "Permission denied")


@pytest.fixture
def msvcrt(monkeypatch: pytest.MonkeyPatch) -> Msvcrt:
    made = Msvcrt()
    monkeypatch.setitem(sys.modules, "msvcrt", made)
    return made


@pytest.fixture
def windows(msvcrt: Msvcrt, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module as Windows imports it."""
    assert sys.modules["msvcrt"] is msvcrt
    monkeypatch.setattr(sys, "platform", "win32")
    assert own.__file__ is not None
    spec = importlib.util.spec_from_file_location("lock_of_windows", own.__file__)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.undo()
    return module


@pytest.fixture
def file(tmp_path: Path) -> Path:
    made = tmp_path / "audit.log"
    made.write_bytes(b"a line\n")
    return made


def opened(file: Path) -> int:
    return os.open(file, os.O_RDWR | os.O_APPEND)


def test_on_windows_a_second_process_can_not_lock_the_file(windows: Any, file: Path) -> None:
    first, second = opened(file), opened(file)
    assert windows.lock(first)
    assert not windows.lock(second)
    os.close(first)
    os.close(second)


def test_lines_stay_readable_and_are_appended_at_the_end(
    windows: Any, msvcrt: Msvcrt, file: Path
) -> None:
    descriptor = opened(file)
    assert windows.lock(descriptor)
    # Windows refuses to read a locked byte. `msvcrt` can lock none behind a position of 31 bits.
    assert [place for _, place in msvcrt.locked] == [2**31 - 2]
    os.write(descriptor, b"another\n")
    os.close(descriptor)
    assert file.read_bytes() == b"a line\nanother\n"


def test_a_file_system_without_locks_can_still_be_written(
    windows: Any, msvcrt: Msvcrt, file: Path
) -> None:
    descriptor = opened(file)
    msvcrt.failure = OSError(errno.EINVAL, "Invalid argument")
    assert windows.lock(descriptor)
    os.close(descriptor)

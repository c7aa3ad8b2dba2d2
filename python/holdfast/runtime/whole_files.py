"""Files that are written whole or not at all."""

from __future__ import annotations

import errno
import os
import stat
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
"""Flags for a new file; Windows would convert line ends without `O_BINARY`."""

USUAL = 0o666
SECRET = 0o600
PUBLIC = 0o644
"""Modes of new files, of which the mask of the process takes some away: those of all programs, of
files with keys, and of files that others must be able to read."""


def write_new(contents: Mapping[Path, tuple[bytes, int]]) -> None:
    """Writes new files, each with its content and mode: all of them, or none.

    Raises `FileExistsError` if there is one of them, and `OSError` with the name of the file.
    """
    for file in contents:
        if file.exists():
            raise FileExistsError(f"{file} exists, and is not overwritten")
    written: list[Path] = []
    try:
        for file, (content, mode) in contents.items():
            descriptor = os.open(file, NEW, mode)
            written.append(file)
            with os.fdopen(descriptor, "wb") as opened:
                opened.write(content)
                opened.flush()
                # After a power cut, an empty file could take the place of a secret for good.
                os.fsync(opened.fileno())
    except BaseException as error:
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(file)
        for file in written:
            file.unlink(missing_ok=True)
        raise


def replace(file: Path, content: bytes, mode: int | None = None) -> None:
    """Writes a file that programs may read at the same time, and that a full disk leaves as it was.

    With `mode`, it is always a new file, of this process. Without, a file keeps its owner, group
    and mode, and what can't be replaced is written in place: a pipe, a device, a file of another
    owner, or one whose folder allows no others. Raises `OSError`.
    """
    before = _before(file) if mode is None else None
    if before is None or stat.S_ISREG(before.st_mode):
        real = Path(os.path.realpath(file))
        try:
            with _beside(real, content, USUAL if mode is None else mode, before) as new:
                new.replace(real)
            return
        except OSError as error:
            if before is None or error.errno not in _IRREPLACEABLE:
                raise
    file.write_bytes(content)


_IRREPLACEABLE = (errno.EACCES, errno.EPERM, errno.EBUSY, errno.EROFS)
"""Errors of a folder or an owner, or of a file that is mounted alone; the file may be writable."""


def try_replace(file: Path) -> None:
    """Raises `OSError` if a file can't be written by `replace`. Changes nothing."""
    if not os.access(file, os.W_OK):
        with _beside(Path(os.path.realpath(file)), b"", USUAL, _before(file)):
            pass


def _before(file: Path) -> os.stat_result | None:
    try:
        return file.stat()
    except FileNotFoundError:
        return None


@contextmanager
def _beside(file: Path, content: bytes, mode: int, before: os.stat_result | None) -> Iterator[Path]:
    """A new file next to `file`, with the owner and mode of the one before. It is removed if it is
    not renamed."""
    # A name has 255 bytes at most, and a character up to 4.
    new = file.with_name(f".{file.name[:50]}.{os.getpid()}")
    # One that a power cut has left: in a container, the next process has the same number.
    new.unlink(missing_ok=True)
    try:
        write_new({new: (content, mode if before is None else SECRET)})
        # On Windows, a mode can only make a file read-only, and then it can't be removed.
        if before is not None and sys.platform != "win32":
            made = new.stat()
            # Some file systems refuse every `chown`.
            if (made.st_uid, made.st_gid) != (before.st_uid, before.st_gid):
                os.chown(new, before.st_uid, before.st_gid)
            new.chmod(stat.S_IMODE(before.st_mode))
        yield new
    finally:
        new.unlink(missing_ok=True)

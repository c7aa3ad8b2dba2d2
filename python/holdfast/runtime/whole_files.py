"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
"""Flags for a new file; Windows would convert line ends without `O_BINARY`."""

SECRET = 0o600
PUBLIC = 0o644
"""The modes of files with keys, and of other files."""


def write_new(contents: Mapping[Path, tuple[bytes, int]]) -> None:
    """Writes new files, each with its content and mode: all of them, or none.

    Raises `FileExistsError` if there is one of them, and `OSError`.
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
    except BaseException:
        for file in written:
            file.unlink(missing_ok=True)
        raise


def replace(file: Path, content: bytes, mode: int | None = None) -> None:
    """Writes a file that programs may read at the same time, and that a full disk leaves as it was.

    Without `mode`, it keeps that of the file before. A pipe or a device is not replaced. Raises
    `OSError`.
    """
    file = file.resolve()
    try:
        before = file.stat().st_mode
    except FileNotFoundError:
        before = stat.S_IFREG | PUBLIC
    if not stat.S_ISREG(before):
        file.write_bytes(content)
        return
    new = _written_beside(file, content, PUBLIC if mode is None else mode)
    try:
        if mode is None:
            new.chmod(stat.S_IMODE(before))
        new.replace(file)
    except BaseException:
        new.unlink(missing_ok=True)
        raise


def try_replace(file: Path) -> None:
    """Raises `OSError` if the folder of a file does not allow `replace`. Changes nothing."""
    _written_beside(file.resolve(), b"", PUBLIC).unlink()


def _written_beside(file: Path, content: bytes, mode: int) -> Path:
    new = file.with_name(f".{file.name}.{os.getpid()}")
    # One that a power cut has left: in a container, the next process has the same number.
    new.unlink(missing_ok=True)
    write_new({new: (content, mode)})
    return new

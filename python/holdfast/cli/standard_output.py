"""Standard output that can't take what a command prints: another encoding, a full disk, a reader
that is gone or does not read, a stream that is closed. Standard error drops what it can't take.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
from pathlib import Path
from typing import Any, cast

_UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EPIPE)


def prepare() -> None:
    """Lets text from outside pass that the encoding of standard output does not have.

    Files and pipes on Windows get UTF-8, which Holdfast requires of all that it reads, unless the
    user demands another encoding. Standard streams that are closed, as by `2>&-`, are replaced.
    Standard error that can't be written changes no exit code.
    """
    # In the order of their descriptors: each is the lowest that is free. A socket that took the
    # place of one would get what native code prints.
    nowhere = Path(os.devnull)
    sys.stdin = sys.stdin or nowhere.open(encoding="utf-8")
    sys.stdout = sys.stdout or nowhere.open("w", encoding="utf-8")
    sys.stderr = sys.stderr or nowhere.open("w", encoding="utf-8")
    is_local = sys.platform == "win32" and not os.environ.get("PYTHONIOENCODING")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            encoding = "utf-8" if is_local and not stream.isatty() else None
            stream.reconfigure(encoding=encoding, errors="backslashreplace")
    if not isinstance(sys.stderr, _Dropping):
        sys.stderr = cast("Any", _Dropping(sys.stderr))


class _Dropping:
    """A stream that drops what can't be written. The log, which counts that, has its file."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @property
    def buffer(self) -> Any:
        """The same for bytes, which click writes where the encoding is ASCII."""
        return _Dropping(self._stream.buffer)

    def write(self, text: str | bytes) -> int:
        """Writes a text if that is possible."""
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Writes what is buffered if that is possible."""
        with contextlib.suppress(OSError):
            self._stream.flush()


def is_screen() -> bool:
    """Whether text can be redrawn: not on a dumb terminal, as in an editor, nor without one."""
    return sys.stdout.isatty() and os.environ.get("TERM", "").lower() not in ("dumb", "unknown")


def is_unwritable(error: OSError) -> bool:
    """Whether this error is that of standard output, not of a file."""
    if error.filename is not None:
        return False
    return _number(error) in _UNWRITABLE


def reason(error: OSError) -> str:
    """Why standard output can't be written."""
    return os.strerror(_number(error))


def _number(error: OSError) -> int:
    """The number of an error; of a pipe whose reader is gone on Windows, too."""
    # The C library has no other number for that. Errors of the system have one of their own, too.
    if sys.platform == "win32" and error.errno == errno.EINVAL and error.winerror is None:
        return errno.EPIPE
    return error.errno or 0


def leave() -> None:
    """Drops what is not printed: Python would fail again at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)

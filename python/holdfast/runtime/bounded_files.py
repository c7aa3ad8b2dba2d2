"""Reads the files that settings name: up to a size, and within a time.

A file can block whoever opens or reads it: a named pipe without a writer, a mount whose server is
gone. Pipes are opened so that they don't block. A call that blocks all the same is left behind in
its thread, and a file has at most one such thread: until that call returns, the file is unusable.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import stat
import sys
import threading
import time
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, TypeAlias, TypeVar, cast

if TYPE_CHECKING:
    from collections.abc import Callable

File: TypeAlias = str | os.PathLike[str]

P = ParamSpec("P")
T = TypeVar("T")

TIMEOUT_MS = 5000
"""Milliseconds in which a file must be read. An event loop that waits for one is not stalled."""

MAX_CERTIFICATES_BYTES = 4 << 20
"""The size limit of a file with certificates, keys or revocation lists, in bytes."""

MAX_SECRETS_BYTES = 1 << 20
"""The size limit of a file with passwords or tokens, in bytes."""

CHUNK_BYTES = 1 << 20

_PASSING = (
    errno.EIO,
    errno.ENFILE,
    errno.ENOMEM,
    errno.ENOTCONN,
    errno.ESTALE,
    errno.ETIMEDOUT,
    getattr(errno, "EHOSTDOWN", errno.ETIMEDOUT),
)
"""Errors of a system without memory or file descriptors, and of mounts whose server is away."""

_FLAGS = os.O_RDONLY | sum(
    getattr(os, flag, 0) for flag in ("O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC", "O_BINARY")
)
_KINDS = (
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)


class Unreadable(OSError):
    """A file is none that can be read here. `strerror` has the reason, `filename` the file."""

    def __str__(self) -> str:
        return f"{self.filename}: {self.strerror}"


class NotAnswered(Unreadable):
    """A file was not read in time, or an error that may pass prevented it."""


class TooLarge(Unreadable):
    """A file is larger than allowed."""


class _Blocked(BaseException):
    """An earlier thread still waits for the file, or its error may pass. Ends all of the work, not
    the file's part only: with the next file, one more thread could be left behind. Has the error.
    """


class FileWork(Generic[T]):
    """Work with files in a thread of its own, so that whoever starts it never waits for a file.

    Inside, `read` and `call` tell which file the thread waits for.
    """

    _abandoned: tuple[FileWork[Any], ...] = ()
    _lock = threading.Lock()
    _current = threading.local()

    def __init__(self, work: Callable[[], T], timeout_ms: int = TIMEOUT_MS) -> None:
        self.timeout_ms = timeout_ms
        self._work = work
        self._ended = threading.Event()
        self._waits: tuple[str, float] | None = None
        """The file that the thread waits for, and since when."""
        self._given_up: NotAnswered | None = None
        self._value: T | None = None
        self._error: BaseException | None = None
        try:
            threading.Thread(target=self._run, name="holdfast-files", daemon=True).start()
        except RuntimeError as error:
            self._error = OSError(errno.EAGAIN, f"no thread to read files with: {error}")
            self._ended.set()

    @staticmethod
    def current() -> FileWork[Any] | None:
        """Returns the work whose thread this is."""
        return getattr(FileWork._current, "work", None)

    def is_over(self, wait_ms: float = 0) -> bool:
        """Returns whether `result` does not wait. Waits for that at most `wait_ms`.

        The work is abandoned here once a file has taken too long, whatever happens to it later.
        """
        if self._given_up is None and not self._ended.wait(wait_ms / 1000):
            waits = self._waits
            if waits is None or time.monotonic() - waits[1] < self.timeout_ms / 1000:
                return False
            self._given_up = not_answered(waits[0], self.timeout_ms)
            with FileWork._lock:
                left = [each for each in FileWork._abandoned if not each._ended.is_set()]
                FileWork._abandoned = (*left, self)
        return True

    def result(self) -> T:
        """Waits for the end. Raises what the work has raised, and `NotAnswered`."""
        while not self.is_over(self._left_ms()):
            pass
        if self._given_up is not None:
            raise self._given_up
        if isinstance(self._error, _Blocked):
            raise self._error.args[0]
        if self._error is not None:
            raise self._error
        return cast("T", self._value)

    def call(self, file: str, function: Callable[[], T]) -> T:
        """Calls what may wait for a file, in the thread of this work."""
        blocked = {waits[0] for each in self._abandoned if (waits := each._waits) is not None}
        if self._given_up is not None or file in blocked:
            raise _Blocked(not_answered(file, self.timeout_ms))
        self._waits = (file, time.monotonic())
        try:
            return function()
        except OSError as error:
            if error.errno not in _PASSING:
                raise
            raise _Blocked(NotAnswered(error.errno, error.strerror, file)) from error
        finally:
            self._waits = None

    def _run(self) -> None:
        FileWork._current.work = self
        try:
            self._value = self._work()
        except BaseException as error:
            self._error = error
        self._ended.set()

    def _left_ms(self) -> float:
        """Milliseconds after which the file of this moment has taken too long."""
        waits = self._waits
        waited_ms = 0.0 if waits is None else (time.monotonic() - waits[1]) * 1000
        return max(self.timeout_ms - waited_ms, 1)


def answered(work: Callable[[], T], timeout_ms: int = TIMEOUT_MS) -> T:
    """Returns the result of work with files. Raises `NotAnswered` if it waits for one too long."""
    if FileWork.current() is not None:
        return work()
    return FileWork(work, timeout_ms).result()


def call(file: File, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Calls a function that may wait for a file. Raises `NotAnswered` if it does not return."""
    work: FileWork[Any] | None = FileWork.current()
    if work is None:
        return FileWork(lambda: call(file, function, *args, **kwargs)).result()
    found: T = work.call(os.fspath(file), lambda: function(*args, **kwargs))
    return found


def read(
    file: File, max_bytes: int, *, named_pipe: bool = False, timeout_ms: int = TIMEOUT_MS
) -> bytes:
    """Returns the content of a file. Raises `OSError`, also `NotAnswered` and `TooLarge`.

    A named pipe is read only if that is allowed: it has its content once, for one reader.
    """
    return answered(lambda: _content(file, max_bytes, named_pipe, timeout_ms), timeout_ms)


def require_stored(*files: File | None) -> None:
    """Checks files that other code is about to read by their names, where it can't be interrupted.

    Raises `Unreadable` for one that could block that code. All other errors are left to it.
    """

    def check() -> None:
        for file in files:
            if file is not None:
                with contextlib.suppress(FileNotFoundError, PermissionError, IsADirectoryError):
                    _check_stored(file)

    answered(check)


def _check_stored(file: File) -> None:
    mode = call(file, os.stat, file).st_mode
    if is_shell_pipe(file, mode):
        return
    if reason := unstored(file, mode):
        raise Unreadable(errno.EINVAL, reason, os.fspath(file))
    read(file, MAX_CERTIFICATES_BYTES)


def unstored(file: File, mode: int) -> str:
    """Returns why a file can't be read again and again, or "" if it can."""
    kind = special(file, mode)
    return kind and f"it is {kind}, allowed: a regular file"


def special(file: File, mode: int) -> str:
    """Returns what a file is that is neither a regular one nor a folder, "" for these."""
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode) or is_shell_pipe(file, mode):
        return ""
    return next((kind for is_kind, kind in _KINDS if is_kind(mode)), "no file")


def is_shell_pipe(file: File, mode: int) -> bool:
    """Returns whether a file is a pipe of the process itself: `<(command)`, or standard input."""
    # Where a link leads to: in containers, files of logs lead to /dev/stdout.
    return stat.S_ISFIFO(mode) and os.path.realpath(file).startswith(("/dev/", "/proc/"))


def not_answered(file: str, timeout_ms: int) -> NotAnswered:
    """The error for a file that was not read in time."""
    seconds = timeout_ms / 1000
    return NotAnswered(errno.ETIMEDOUT, f"no answer within {seconds:g} s, the limit", file)


def _content(file: File, max_bytes: int, named_pipe: bool, timeout_ms: int) -> bytes:
    name, deadline = os.fspath(file), time.monotonic() + timeout_ms / 1000
    descriptor = call(file, os.open, file, _FLAGS)
    try:
        mode = call(file, os.fstat, descriptor).st_mode
        is_pipe = stat.S_ISFIFO(mode) and hasattr(select, "poll")
        if is_pipe and not named_pipe and (reason := unstored(file, mode)):
            raise Unreadable(errno.EINVAL, reason, name)
        content, has_writer_left = bytearray(), False
        while len(content) <= max_bytes:
            try:
                found = call(
                    file, os.read, descriptor, min(CHUNK_BYTES, max_bytes + 1 - len(content))
                )
            except BlockingIOError:
                found = None
            if found:
                content += found
            elif found is not None and (content or not is_pipe or has_writer_left):
                return bytes(content)
            left_ms = (deadline - time.monotonic()) * 1000
            if left_ms <= 0:
                raise not_answered(name, timeout_ms)
            if not found:
                # A pipe without a writer also looks empty: only the end of a writer is its end.
                has_writer_left = _wait(descriptor, left_ms)
        raise TooLarge(errno.EFBIG, f"more than {max_bytes} bytes, the limit", name)
    except OSError as error:
        error.filename = name
        raise
    finally:
        os.close(descriptor)


def _wait(descriptor: int, wait_ms: float) -> bool:
    """Waits until there is something to read. Returns whether the last writer has left."""
    if sys.platform == "win32":
        raise AssertionError("only called on other systems")
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return any(events & select.POLLHUP for _, events in poll.poll(wait_ms))

"""Files that settings name are read up to a size and within a time, whatever they are."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import threading
from functools import partial
from typing import TYPE_CHECKING

import pytest

from holdfast.client.endpoint import endpoint
from holdfast.client.url import parse
from holdfast.runtime import bounded_files
from holdfast.runtime.bounded_files import (
    FileWork,
    NotAnswered,
    TooLarge,
    Unreadable,
    read,
    require_stored,
)
from support import wire
from support.silent_files import Silent, threads

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="pipes of other systems differ")

SHORT = partial(read, max_bytes=100, named_pipe=True, timeout_ms=50)


@contextlib.contextmanager
def written(*parts: bytes, to: int) -> Iterator[None]:
    """Writes parts to a pipe one by one, each when the one before was read, then closes it."""

    def write() -> None:
        for part in parts:
            os.write(to, part)
        os.close(to)

    thread = threading.Thread(target=write)
    thread.start()
    yield
    thread.join(wire.DEADLINE)


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    os.mkfifo(tmp_path / "pipe")
    return tmp_path / "pipe"


def test_a_named_pipe_without_a_writer_is_an_error_that_names_file_and_limit(pipe: Path) -> None:
    with pytest.raises(NotAnswered) as caught:
        SHORT(pipe)
    assert str(caught.value) == f"{pipe}: no answer within 0.05 s, the limit"


def test_a_named_pipe_whose_writer_writes_nothing_is_an_error(pipe: Path) -> None:
    opened = os.open(pipe, os.O_RDWR)
    with pytest.raises(NotAnswered):
        SHORT(pipe)
    os.close(opened)


def test_a_writer_may_take_its_time(pipe: Path) -> None:
    reading = FileWork(lambda: read(pipe, 100, named_pipe=True, timeout_ms=60_000), 60_000)
    with pipe.open("wb", buffering=0) as writer:
        writer.write(b"half, ")
        assert not reading.is_over()
        writer.write(b"and the rest")
    assert reading.result() == b"half, and the rest"


def test_a_writer_that_leaves_without_a_word_is_the_end(pipe: Path) -> None:
    reading = FileWork(lambda: read(pipe, 100, named_pipe=True, timeout_ms=60_000), 60_000)
    pipe.open("wb").close()
    assert reading.result() == b""


def test_keys_and_passwords_are_not_read_from_a_named_pipe(pipe: Path) -> None:
    with pytest.raises(Unreadable) as caught:
        read(pipe, 100)
    assert str(caught.value) == f"{pipe}: it is a named pipe, allowed: a regular file"


def test_a_pipe_of_the_shell_is_read() -> None:
    reader, writer = os.pipe()
    with written(b"from ", b"a command", to=writer):
        assert read(f"/dev/fd/{reader}", 100) == b"from a command"
    os.close(reader)


def test_no_more_is_read_than_allowed(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"x" * 100)
    assert read(file, 100) == b"x" * 100
    for endless in (file, "/dev/zero"):
        with pytest.raises(TooLarge) as caught:
            read(endless, 99)
        assert str(caught.value) == f"{endless}: more than 99 bytes, the limit"


def test_other_errors_are_those_of_the_system_and_name_the_file(tmp_path: Path) -> None:
    for file, number in ((tmp_path / "none", errno.ENOENT), (tmp_path, errno.EISDIR)):
        with pytest.raises(OSError, match=os.strerror(number)) as caught:
            read(file, 100)
        assert str(caught.value.filename) == str(file)


def test_an_error_that_may_pass_ends_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "file"

    def stale(*_: object) -> int:
        raise OSError(errno.ESTALE, "Stale file handle")

    def work() -> None:
        with contextlib.suppress(OSError):
            bounded_files.call(file, os.open, file, os.O_RDONLY)

    monkeypatch.setattr(os, "open", stale)
    for reading in (FileWork(work), FileWork(lambda: read(file, 100))):
        with pytest.raises(NotAnswered) as caught:
            reading.result()
        assert str(caught.value) == f"{file}: Stale file handle"


@pytest.mark.parametrize("function", ["open", "read", "fstat"])
def test_a_file_that_never_answers_leaves_one_thread_behind(
    function: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, other = tmp_path / "file", tmp_path / "other"
    file.write_bytes(b"content")
    other.write_bytes(b"other")
    with Silent(monkeypatch, function, file) as silent:
        for _ in range(5):
            with pytest.raises(NotAnswered):
                SHORT(file)
            assert read(other, 100) == b"other"
        assert len(threads()) == 1
        silent.answer()
        wire.until(lambda: not threads(), "the thread has ended")
        assert read(file, 100) == b"content"


def test_work_with_many_silent_files_ends_at_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise each would take its time, and leave a thread behind."""
    files = [tmp_path / str(number) for number in range(5)]

    def work() -> None:
        for file in files:
            with contextlib.suppress(OSError):
                bounded_files.call(file, os.stat, file)

    with Silent(monkeypatch, "stat", *files) as silent:
        for _ in range(3):
            with pytest.raises(NotAnswered, match="0: no answer"):
                FileWork(work, 50).result()
        assert silent.calls == 1
    wire.until(lambda: not threads(), "abandoned work does not go on with the next file")


def test_what_other_code_reads_by_its_name_must_answer_and_end(
    pipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The native core, and OpenSSL, can't be interrupted."""
    good, large = tmp_path / "good", tmp_path / "large"
    good.write_bytes(b"content")
    with large.open("wb") as file:
        file.truncate(bounded_files.MAX_CERTIFICATES_BYTES + 1)
    require_stored(good, None, tmp_path / "missing", tmp_path)
    for unusable, reason in (
        (pipe, "it is a named pipe, allowed: a regular file"),
        ("/dev/zero", "it is a device, allowed: a regular file"),
        (large, "more than 4194304 bytes, the limit"),
    ):
        with pytest.raises(Unreadable) as caught:
            require_stored(good, unusable)
        assert str(caught.value) == f"{unusable}: {reason}"
    with pytest.raises(Unreadable):
        endpoint(parse(f"tls://127.0.0.1?ca={pipe}"))
    with Silent(monkeypatch, "open", good), pytest.raises(NotAnswered):
        FileWork(lambda: require_stored(good), 50).result()


def test_without_a_thread_there_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", fail)
    with pytest.raises(OSError, match="no thread to read files with: can't start new thread"):
        read(tmp_path, 100)


def test_work_that_is_over_has_its_result_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loop of an appliance asks for both, one after the other."""
    file = tmp_path / "file"
    file.write_bytes(b"content")
    with Silent(monkeypatch, "open", file) as silent:
        work = FileWork(lambda: read(file, 100), 50)
        wire.until(work.is_over, "it was abandoned")
        silent.answer()
        wire.until(lambda: not threads(), "the thread has ended")
        work.timeout_ms = 60_000
        assert work.is_over()
        with pytest.raises(NotAnswered):
            work.result()

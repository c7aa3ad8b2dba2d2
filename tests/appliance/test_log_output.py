"""The thread that writes log lines."""

from __future__ import annotations

import errno
import json
import logging
import os
import sys
import threading
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.events import writer as log_output
from holdfast.events.log_lines import LineFormatter
from holdfast.events.writer import QueuedHandler
from support import wire

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.events import Format


@pytest.fixture
def pipe() -> Iterator[tuple[int, Any]]:
    reader, writer = os.pipe()
    with os.fdopen(writer, "w", encoding="utf-8") as stream:
        yield reader, stream
        os.close(reader)


def logged(handler: QueuedHandler, text: str) -> None:
    handler.emit(logging.makeLogRecord({"msg": text}))


def test_lines_arrive_in_order(pipe: tuple[int, Any]) -> None:
    reader, stream = pipe
    handler = QueuedHandler(stream)
    for number in range(100):
        logged(handler, f"{number} °C")
    handler.flush()
    expected = "".join(f"{number} °C\n" for number in range(100))
    assert os.read(reader, 65536).decode() == expected


@pytest.mark.parametrize("form", ["text", "json"])
def test_lines_for_the_journal_begin_with_their_priority(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: Format
) -> None:
    levels = {"DEBUG": 7, "INFO": 6, "WARNING": 4, "ERROR": 3}
    records = [{"msg": "listening", "levelname": level} for level in levels]
    records.append({"msg": "is served"})  # Text without a level, as at the start.
    with (tmp_path / "journal").open("w+") as journal, (tmp_path / "other").open("w+") as other:
        found = os.fstat(journal.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{found.st_dev}:{found.st_ino}")
        for stream in (journal, other):
            handler = QueuedHandler(stream)
            handler.setFormatter(LineFormatter(form))
            for record in records:
                handler.emit(logging.makeLogRecord({"created": 0.0, **record}))
            handler.flush()
            stream.seek(0)
        lines = journal.readlines()
        assert [line[:3] for line in lines[:-1]] == [f"<{level}>" for level in levels.values()]
        assert [line[3:] for line in lines[:-1]] + lines[-1:] == other.readlines()


def test_a_console_of_windows_gets_its_own_encoding(
    pipe: tuple[int, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, stream = pipe
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(os, "device_encoding", lambda _: "cp850")
    handler = QueuedHandler(stream)
    logged(handler, "20 °C Ω")
    assert os.read(reader, 65536) == b"20 \xf8C \\u03a9\n"


def test_a_reader_that_stops_loses_the_newest_lines_which_are_counted(
    pipe: tuple[int, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_output, "MAX_WAITING_LINES", 100)
    reader, stream = pipe
    handler, text = QueuedHandler(stream, timeout=0.05), "x" * 999
    while handler.dropped < 5:
        logged(handler, text)
    handler.flush()  # It does not wait for ever.

    received: list[bytes] = []

    def read() -> None:
        while b"".join(received).count(b"\n") < 101 or b"log_dropped" not in received[-1]:
            received.append(os.read(reader, 65536))

    thread = threading.Thread(target=read)
    thread.start()
    thread.join(wire.DEADLINE)
    assert not thread.is_alive()
    assert b"".join(received).count(b"log_dropped") == 1
    logged(handler, "it goes on")
    wire.until(lambda: b"it goes on" in os.read(reader, 65536), "it goes on")


def test_a_reader_that_is_gone_holds_up_nobody(pipe: tuple[int, Any]) -> None:
    reader, stream = pipe
    handler = QueuedHandler(stream)
    os.dup2(os.open(os.devnull, os.O_RDONLY), reader)
    for _ in range(100):
        logged(handler, "x")
    handler.flush()
    assert handler.dropped == 100


class Disk:
    """The file behind a stream, with `room` for this many more bytes."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.path, self.stream, self.room = path, path.open("w", encoding="utf-8"), 0
        write = os.write

        def written(descriptor: int, data: bytes) -> int:
            if descriptor != self.stream.fileno():
                return write(descriptor, data)
            if not self.room:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            count = write(descriptor, data[: self.room])
            self.room -= count
            return count

        monkeypatch.setattr(os, "write", written)


@pytest.fixture
def disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    made = Disk(tmp_path / "log", monkeypatch)
    with made.stream:
        yield made


@pytest.mark.parametrize(
    ("room", "written", "lost"),
    [
        (0, [], 3),
        (2, ["fi"], 3),
        (5, ["first"], 2),
        (6, ["first"], 2),
        (9, ["first", "sec"], 2),
        (18, ["first", "second", "third"], 0),
    ],
)
def test_lines_that_a_full_disk_does_not_take_are_counted(
    disk: Disk, room: int, written: list[str], lost: int
) -> None:
    handler = QueuedHandler(disk.stream)
    disk.room = room
    for text in ("first", "second", "third"):
        logged(handler, text)
        handler.flush()
    assert (disk.path.read_text().splitlines(), handler.dropped) == (written, lost)
    disk.room = 1000
    logged(handler, "next")
    handler.flush()
    after = ["next", "log_dropped"] if lost else ["next"]
    assert disk.path.read_text().splitlines() == written + after
    assert handler.dropped == lost
    logged(handler, "last")
    handler.flush()
    assert disk.path.read_text().splitlines()[-1] == "last"


def test_a_note_that_is_lost_is_written_again_and_is_no_lost_line(disk: Disk) -> None:
    handler = QueuedHandler(disk.stream)
    handler.setFormatter(LineFormatter("json"))
    for _ in range(3):
        logged(handler, "x")
        handler.flush()
    disk.room = 1000
    logged(handler, "next")
    handler.flush()
    events = [json.loads(line) for line in disk.path.read_text().splitlines()]
    assert [(each["event"], each.get("count")) for each in events] == [
        ("next", None),
        ("log_dropped", 3),
    ]

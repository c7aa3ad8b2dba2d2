"""The thread that writes log lines."""

from __future__ import annotations

import logging
import os
import threading
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.events import writer as log_output
from holdfast.events.writer import QueuedHandler
from support import wire

if TYPE_CHECKING:
    from collections.abc import Iterator


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
    assert handler.dropped == 0

"""The socket for requests from the appliance's own machine, while connections can't be accepted."""

from __future__ import annotations

import errno
import os
import tempfile
import threading
from multiprocessing.connection import Listener
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from holdfast.appliance import control
from holdfast.appliance.control import Control
from support import wire

if TYPE_CHECKING:
    from collections.abc import Iterator
    from multiprocessing.connection import Connection

FILE = Path("plant.yaml")


class Accepting:
    """Replaces `accept`: for `failures` calls, there are no free file descriptors."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls = 0
        self.failures = 0
        accept = Listener.accept

        def accepted(listener: Listener) -> Connection:
            self.calls += 1
            if self.calls <= self.failures:
                raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
            return accept(listener)

        monkeypatch.setattr(Listener, "accept", accepted)


@pytest.fixture
def accepting(monkeypatch: pytest.MonkeyPatch) -> Iterator[Accepting]:
    # The path of a socket is short, and those of tests can be long.
    with tempfile.TemporaryDirectory(prefix="hf") as runtime:
        monkeypatch.setenv("RUNTIME_DIRECTORY", runtime)
        yield Accepting(monkeypatch)


def test_it_pauses_after_an_error_and_a_stop_ends_the_pause(
    accepting: Accepting, monkeypatch: pytest.MonkeyPatch
) -> None:
    accepting.failures = 1_000_000
    for pause in ("FIRST_PAUSE_S", "MAX_PAUSE_S"):
        monkeypatch.setattr(control, pause, 3600.0)
    before = set(threading.enumerate())
    socket = Control(FILE, {})
    [thread] = set(threading.enumerate()) - before
    wire.until(lambda: accepting.calls, "the first attempt")
    socket.close()
    assert not thread.is_alive()
    assert accepting.calls == 1


def test_it_answers_again_after_errors(accepting: Accepting) -> None:
    accepting.failures = 2
    socket = Control(FILE, {})
    try:
        assert control.ask(FILE, "ping", within_s=wire.DEADLINE, ping_s=wire.DEADLINE) == {}
        assert accepting.calls > accepting.failures
    finally:
        socket.close()

"""A thread for work that takes long, beside an event loop."""

from __future__ import annotations

import asyncio
import threading

import pytest

from holdfast.runtime.own_thread import OwnThread
from support import wire


def test_a_thread_ends_with_its_object() -> None:
    thread = OwnThread("own")
    own = asyncio.run(thread.call(threading.current_thread))
    assert own.daemon
    ended = thread.ended
    del thread
    ended.result(wire.DEADLINE)
    own.join(wire.DEADLINE)
    assert not own.is_alive()


def test_the_work_that_waits_is_done_before_the_end() -> None:
    thread, go_on = OwnThread("own"), threading.Event()
    first, second = thread.submit(go_on.wait), thread.submit(lambda: 2)
    thread.end()
    go_on.set()
    thread.ended.result(wire.DEADLINE)
    assert (first.result(0), second.result(0)) == (True, 2)


def test_a_thread_that_the_interpreter_does_not_start_is_started_the_next_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't create new thread at interpreter shutdown")

    thread = OwnThread("own")
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", refuse)
        with pytest.raises(RuntimeError, match="at interpreter shutdown"):
            asyncio.run(thread.call(lambda: 1))
    assert asyncio.run(asyncio.wait_for(thread.call(lambda: 1), wire.DEADLINE)) == 1

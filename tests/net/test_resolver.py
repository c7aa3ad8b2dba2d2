"""The resolver: the system's, in threads that nobody has to wait for."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
import threading
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.net.resolver import NoSuchName, Resolver
from support import wire

if TYPE_CHECKING:
    from collections.abc import Iterator


class Slow:
    """The system's resolver, which answers when it is let."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.answers = threading.Event()
        self._lock = threading.Lock()

    def __call__(self, host: str, port: int | None, **_: Any) -> list[tuple[Any, ...]]:
        if host != "127.0.0.1":  # A thread of another test may still connect.
            with self._lock:
                self.asked.append(host)
        self.answers.wait(wire.DEADLINE)
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("10.0.0.1", port or 0))]


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> Iterator[Slow]:
    made = Slow()
    monkeypatch.setattr(socket, "getaddrinfo", made)
    yield made
    made.answers.set()


def found(monkeypatch: pytest.MonkeyPatch, *hosts: str) -> None:
    """Lets every name have these addresses."""
    addresses = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (host, 0)) for host in hosts]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: addresses)


def test_a_name_has_each_of_its_addresses_once(monkeypatch: pytest.MonkeyPatch) -> None:
    found(monkeypatch, "10.0.0.1", "fd00::1", "10.0.0.1")
    assert asyncio.run(Resolver()("plc")) == ["10.0.0.1", "fd00::1"]


def test_an_address_of_one_link_is_none_that_a_name_has(monkeypatch: pytest.MonkeyPatch) -> None:
    found(monkeypatch, "fe80::1%eth0", "10.0.0.1")
    assert asyncio.run(Resolver()("plc")) == ["10.0.0.1"]


def test_a_name_that_means_nothing_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(NoSuchName, match=r"^can't resolve plc: Name or service not known$") as told:
        asyncio.run(Resolver()("plc"))
    assert (told.value.host, told.value.why) == ("plc", "Name or service not known")


@pytest.mark.parametrize("host", ["x" * 64, "plc..local", "a\0b"])
def test_what_can_not_be_a_name_is_told(host: str) -> None:
    with pytest.raises(NoSuchName, match="is not a valid host name"):
        asyncio.run(Resolver()(host))


def test_a_name_has_only_so_much_time(slow: Slow) -> None:
    with pytest.raises(NoSuchName, match=r"can't resolve plc: no answer within 0\.05 s"):
        asyncio.run(Resolver(0.05)("plc"))
    assert slow.asked == ["plc"]


def test_names_beyond_the_threads_wait_for_their_turn(slow: Slow) -> None:
    resolve = Resolver(most=2)
    futures = [resolve.look_up(f"plc{number}", 502) for number in range(5)]
    wire.until(lambda: len(slow.asked) == 2, "two names are looked up")
    assert not any(future.done() for future in futures)
    slow.answers.set()
    address = (socket.AF_INET, ("10.0.0.1", 502))
    assert [future.result(wire.DEADLINE) for future in futures] == [[address]] * 5
    assert sorted(slow.asked) == [f"plc{number}" for number in range(5)]


def test_a_name_that_nobody_waits_for_any_more_is_not_looked_up(slow: Slow) -> None:
    resolve = Resolver(most=1)
    first = resolve.look_up("first")
    wire.until(lambda: slow.asked == ["first"], "the first name is looked up")
    for _ in range(3):
        with pytest.raises(TimeoutError):
            resolve.wait_for("given-up", 502, 0.01)
    last = resolve.look_up("last")
    assert [host for host, _ in resolve._queue] == ["last"]
    slow.answers.set()
    first.result(wire.DEADLINE)
    last.result(wire.DEADLINE)
    assert slow.asked == ["first", "last"]


def test_a_name_is_looked_up_once_for_all_who_ask_meanwhile(slow: Slow) -> None:
    """A client that tries a dead name again and again does not take the threads of others."""
    resolve = Resolver(most=2)
    for _ in range(5):
        with pytest.raises(TimeoutError):
            resolve.wait_for("dead", 502, 0.01)
    waiting = [resolve.look_up("dead", 502), resolve.look_up("dead", 502)]
    other = resolve.look_up("other", 502)
    wire.until(lambda: slow.asked == ["dead", "other"], "both names are looked up")
    slow.answers.set()
    address = (socket.AF_INET, ("10.0.0.1", 502))
    assert [each.result(wire.DEADLINE) for each in (*waiting, other)] == [[address]] * 3
    assert resolve.look_up("dead", 502).result(wire.DEADLINE) == [address]
    assert slow.asked == ["dead", "other", "dead"]


def test_addresses_that_came_too_late_are_for_the_next_attempt(
    slow: Slow, monkeypatch: pytest.MonkeyPatch
) -> None:
    resolve = Resolver()

    def come_too_late() -> None:
        slow.answers.clear()
        before = len(slow.asked)
        lookup = resolve.look_up("plc", 502)
        wire.until(lambda: len(slow.asked) > before, "it is looked up")
        lookup.cancel()
        slow.answers.set()
        wire.until(lambda: not resolve._threads, "the lookup has ended")

    come_too_late()
    address = (socket.AF_INET, ("10.0.0.1", 502))
    assert resolve.wait_for("plc", 502, 0) == [address]
    assert slow.asked == ["plc"]
    assert resolve.wait_for("plc", 502, wire.DEADLINE) == [address]
    assert slow.asked == ["plc"] * 2
    come_too_late()
    monkeypatch.setattr("holdfast.net.resolver.KEPT_S", 0.0)
    assert resolve.wait_for("plc", 502, wire.DEADLINE) == [address]
    assert slow.asked == ["plc"] * 4


def test_a_failure_is_an_exception_of_its_own_for_each(monkeypatch: pytest.MonkeyPatch) -> None:
    held = threading.Event()

    def unknown(*_: object, **__: object) -> None:
        held.wait(wire.DEADLINE)
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    resolve = Resolver()
    waiting = [resolve.look_up("plc", 502) for _ in range(2)]
    held.set()
    first, second = (each.exception(wire.DEADLINE) for each in waiting)
    assert isinstance(first, socket.gaierror)
    assert str(first) == str(second) == f"[Errno {socket.EAI_NONAME}] Name or service not known"
    assert first is not second


def test_a_process_that_is_forked_looks_up_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """The child has the state of a lookup, but not its thread."""
    found(monkeypatch, "10.0.0.1")
    resolve = Resolver(most=1)
    resolve._process += 1
    resolve._threads = 1
    resolve._waiting["plc", 502] = [Future()]
    address = (socket.AF_INET, ("10.0.0.1", 0))
    assert resolve.look_up("plc", 502).result(wire.DEADLINE) == [address]


def test_an_address_needs_no_thread(slow: Slow) -> None:
    slow.answers.set()
    resolve = Resolver(most=0)
    assert resolve.look_up("10.0.0.7", 502).done()
    assert asyncio.run(resolve("[::1]")) == ["10.0.0.1"]
    assert slow.asked == ["10.0.0.7", "::1"]


def test_without_a_thread_a_look_up_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_thread(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", no_thread)
    resolve = Resolver()
    with pytest.raises(OSError, match="can't start a thread to look up the name"):
        resolve.wait_for("plc", 502, wire.DEADLINE)
    monkeypatch.undo()
    found(monkeypatch, "10.0.0.1")
    assert resolve.wait_for("plc", 502, wire.DEADLINE) == [(socket.AF_INET, ("10.0.0.1", 0))]


SCRIPT = """
import asyncio, socket, threading
from holdfast.net.resolver import NoSuchName, Resolver

socket.getaddrinfo = lambda *_, **__: threading.Event().wait()

async def ask():
    try:
        await Resolver(0.01)("plc")
    except NoSuchName as error:
        print(error)

asyncio.run(ask())
"""


def test_neither_the_loop_nor_the_process_waits_for_a_look_up() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=wire.DEADLINE
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "can't resolve plc: no answer within 0.01 s\n"

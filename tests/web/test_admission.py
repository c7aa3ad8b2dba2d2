"""Who has to leave an HTTP host that is full."""

from __future__ import annotations

import asyncio
import socket
from contextlib import ExitStack, closing
from dataclasses import dataclass
from ipaddress import ip_address, ip_network
from typing import TYPE_CHECKING, Any

import pytest
from holdfast.web.admission import TIMEOUT, Admission, ConnectionLimits, Full, Waiting

from holdfast.web.host import Host
from holdfast.web.port import listen
from holdfast.web.requests import Request, Response
from support import web, wire

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from holdfast.types import WhenFull


ONE, TWO = ip_address("10.0.0.1"), ip_address("10.0.0.2")
NOW = 100.0
LONG_AGO = NOW - TIMEOUT


@dataclass(eq=False)
class Peer:
    state: Waiting | None

    def waiting(self) -> Waiting | None:
        return self.state


def idle(since: float) -> Peer:
    return Peer(Waiting(in_request=False, since=since))


def in_request(since: float) -> Peer:
    return Peer(Waiting(in_request=True, since=since))


def answered() -> Peer:
    return Peer(None)


def full(*peers: Peer, when_full: WhenFull = "evict") -> Admission[Peer]:
    admission = Admission[Peer](ConnectionLimits(len(peers), when_full=when_full))
    for peer in peers:
        assert admission.admit(peer, ONE, NOW) is None
    return admission


@pytest.mark.parametrize(
    ("peers", "evicted"),
    [
        ([idle(98), idle(97), idle(99)], 1),
        ([idle(99.9), in_request(1)], 0),
        ([in_request(1), idle(99.9)], 1),
        ([in_request(9), in_request(8), in_request(99.9)], 1),
        ([answered(), in_request(LONG_AGO)], 1),
    ],
)
def test_who_is_evicted(peers: list[Peer], evicted: int) -> None:
    admission = full(*peers)
    assert admission.admit(answered(), TWO, NOW) is peers[evicted]


@pytest.mark.parametrize(
    "peers",
    [
        [answered(), answered()],
        [in_request(LONG_AGO + 0.1)],
        [answered(), in_request(NOW)],
    ],
)
def test_who_is_not_evicted(peers: list[Peer]) -> None:
    with pytest.raises(Full):
        full(*peers).admit(answered(), TWO, NOW)


def test_refuse_evicts_nobody() -> None:
    admission = full(idle(0), when_full="refuse")
    with pytest.raises(Full):
        admission.admit(answered(), TWO, NOW)


def test_a_place_is_free_after_a_release_and_after_an_eviction() -> None:
    first, second, third = idle(1), idle(2), idle(3)
    admission = full(first)
    assert admission.admit(second, ONE, NOW) is first
    admission.release(first)
    assert admission.admit(third, ONE, NOW) is second, "a second release frees nothing"
    admission.release(third)
    assert admission.admit(first, ONE, NOW) is None


def test_a_source_at_its_limit_evicts_only_its_own() -> None:
    limits = ConnectionLimits(9, max_connections_per_source=1, when_full="evict")
    admission = Admission[Peer](limits)
    older, own = idle(1), idle(2)
    assert admission.admit(older, ONE, NOW) is None
    assert admission.admit(own, TWO, NOW) is None
    assert admission.admit(answered(), TWO, NOW) is own
    with pytest.raises(Full):
        admission.admit(answered(), TWO, NOW)


def test_event_streams_are_never_evicted() -> None:
    async def streamed(request: Request) -> None:
        await request.begin(200, [])
        while True:
            await request.send(b"x")
            await asyncio.sleep(0.01)

    def answer(request: Request) -> Response | Coroutine[Any, Any, None]:
        return streamed(request) if request.path == "/stream" else Response(200)

    listener = listen("127.0.0.1", 0)
    limits = ConnectionLimits(2, when_full="evict")
    sources = [ip_network("127.0.0.0/8")]
    host = Host("x", answer, listener, sources=sources, limits=limits, request_timeout=9)
    address: tuple[str, int] = listener.getsockname()
    with closing(listener), web.in_a_thread(host), ExitStack() as opened:
        streams = [opened.enter_context(wire.Connection(address)) for _ in range(2)]
        for stream in streams:
            stream.send(web.head("GET", "/stream"))
            assert stream.socket.recv(1)
        with socket.create_connection(address, timeout=wire.DEADLINE) as another:
            assert another.recv(1) == b""
        assert (host.counts()["refused_full"], host.counts()["evicted"]) == (1, 0)
        for stream in streams:
            assert stream.socket.recv(1)

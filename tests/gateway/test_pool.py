"""The pool of connections, with connections that fail."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Literal

import pytest

from holdfast._core import Request
from holdfast.client.url import NetworkTarget
from holdfast.errors import ConnectFailed, ConnectionLost, RequestTimeout
from holdfast.gateway import pool
from holdfast.gateway.device_routes import Route
from holdfast.gateway.pool import Pool
from holdfast.gateway.shared_devices import Turns
from holdfast.net.http.requests import BadRequest
from support import wire

if TYPE_CHECKING:
    from collections.abc import Callable

READ = Request.read("coils", 0, 1)


class Failing:
    """Raises the errors one after the other, then answers. Its first close waits, then fails."""

    late, longest_late = 0, 0.0

    def __init__(self, *outcomes: Any) -> None:
        self.outcomes = list(outcomes)
        self.is_closing, self.may_fail = asyncio.Event(), asyncio.Event()

    async def call(
        self,
        request: Request,  # noqa: ARG002
        unit: int,  # noqa: ARG002
        timeout: float,  # noqa: ARG002
        note_sent: Callable[[], None] | None = None,
    ) -> Any:
        assert note_sent is not None
        note_sent()
        outcome = self.outcomes.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    async def close(self) -> None:
        if not self.is_closing.is_set():
            self.is_closing.set()
            await self.may_fail.wait()
            raise OSError("it can't be closed")


def failing_pool(transport: Failing, dialed: list[NetworkTarget]) -> Pool:
    def dial(target: NetworkTarget, _in_flight: int) -> Failing:
        dialed.append(target)
        return transport

    return Pool(most=1, in_flight=1, idle=60, dial=dial)


def test_requests_behind_a_connection_that_can_not_be_closed_are_sent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pool, "CHECK_INTERVAL_S", 0)
    target = NetworkTarget("udp", "127.0.0.1", 502)
    route = Route(target, (target,))

    async def run() -> Any:
        transport = Failing(RequestTimeout("no reply"), [7])
        pool = failing_pool(transport, [])
        with pytest.raises(RequestTimeout):
            await pool.run(route, 60, lambda turns: turns.call(READ, 1, 60))
        await transport.is_closing.wait()
        waiting = asyncio.create_task(pool.run(route, 60, lambda turns: turns.call(READ, 1, 60)))
        await asyncio.sleep(0)
        transport.may_fail.set()
        return await waiting

    assert asyncio.run(asyncio.wait_for(run(), wire.DEADLINE)) == [7]


def test_a_call_of_which_a_part_was_sent_is_not_repeated_elsewhere() -> None:
    """Its later part found no connection."""
    first, second = (NetworkTarget("tcp", f"127.0.0.{number}", 502) for number in (1, 2))
    dialed: list[NetworkTarget] = []

    async def call(turns: Turns) -> None:
        await turns.call(READ, 1, 60)
        try:
            await turns.call(READ, 1, 60)
        finally:
            assert turns.is_sent

    async def run(*outcomes: Any) -> bool:
        transport = Failing(*outcomes)
        transport.may_fail.set()
        pool = failing_pool(transport, dialed)
        with pytest.raises(ConnectionLost) as error:
            await pool.run(Route(first, (first, second)), 60, call)
        return error.value.maybe_sent

    refused = ConnectFailed("tcp://127.0.0.1:502", "refused")
    assert asyncio.run(asyncio.wait_for(run([7], refused), wire.DEADLINE))
    assert dialed == [first]


async def ask(pool: Pool, target: NetworkTarget) -> Any:
    return await pool.run(Route(target, (target,)), 60, lambda turns: turns.call(READ, 1, 60))


@pytest.mark.parametrize(("transport", "may_come"), [("udp", True), ("tcp", False)])
def test_a_connection_that_may_have_late_replies_is_not_pushed_out(
    transport: Literal["udp", "tcp"], *, may_come: bool
) -> None:
    """Another connection to the same device could take a late reply for its own."""

    async def run() -> Any:
        failing = Failing(RequestTimeout("no reply"), [7])
        failing.may_fail.set()
        failing.is_closing.set()
        pool = failing_pool(failing, [])
        first, second = (NetworkTarget(transport, f"127.0.0.{number}", 502) for number in (1, 2))
        with pytest.raises(RequestTimeout):
            await ask(pool, first)
        try:
            return await ask(pool, second)
        except BadRequest as error:
            return error.reason

    assert asyncio.run(asyncio.wait_for(run(), wire.DEADLINE)) == ("busy" if may_come else [7])


def test_connections_may_be_pushed_out_while_an_idle_one_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And idle ones are closed later too, although that one could not be closed."""
    monkeypatch.setattr(pool, "CHECK_INTERVAL_S", 0)
    slow, *others = (NetworkTarget("tcp", f"127.0.0.{number}", 502) for number in range(1, 5))

    async def run() -> None:
        transports = {target: Failing([7]) for target in (slow, *others)}
        for target in others:
            transports[target].is_closing.set()
        pool = Pool(most=2, in_flight=1, idle=0, dial=lambda target, _: transports[target])
        idle, *new = others
        await ask(pool, slow)
        await ask(pool, idle)
        await transports[slow].is_closing.wait()
        for target in new:
            await ask(pool, target)
        transports[slow].may_fail.set()
        while len(pool):
            await asyncio.sleep(0)

    asyncio.run(asyncio.wait_for(run(), wire.DEADLINE))


class Unstoppable(Failing):
    """Answers when it may, also after it was cancelled."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0
        self.may_answer = [asyncio.Event(), asyncio.Event()]

    async def call(
        self,
        request: Request,  # noqa: ARG002
        unit: int,  # noqa: ARG002
        timeout: float,  # noqa: ARG002
        note_sent: Callable[[], None] | None = None,  # noqa: ARG002
    ) -> Any:
        event = self.may_answer[self.calls]
        self.calls += 1
        try:
            await event.wait()
        except asyncio.CancelledError:
            await event.wait()
        return [7]


def test_a_connection_with_a_call_that_still_runs_is_not_pushed_out() -> None:
    async def run() -> None:
        transport = Unstoppable()
        pool = failing_pool(transport, [])
        used, other = (NetworkTarget("tcp", f"127.0.0.{number}", 502) for number in (1, 2))
        first = asyncio.create_task(ask(pool, used))
        while not transport.calls:
            await asyncio.sleep(0)
        second = asyncio.create_task(ask(pool, used))
        await asyncio.sleep(0)
        transport.may_answer[0].set()
        assert await first == [7]
        while transport.calls < 2:
            await asyncio.sleep(0)
        second.cancel()
        with pytest.raises(asyncio.CancelledError):
            await second
        with pytest.raises(BadRequest):
            await ask(pool, other)
        transport.may_answer[1].set()
        transport.may_fail.set()

    asyncio.run(asyncio.wait_for(run(), wire.DEADLINE))

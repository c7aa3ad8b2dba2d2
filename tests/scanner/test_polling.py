"""The results of polls, on their way from the native poller into the event loop."""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast
from unittest.mock import Mock

import pytest

from holdfast.scanner.polling import poller as module
from holdfast.scanner.polling.poller import Polling

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast import _core
    from holdfast.scanner.polling.poller import Poll
    from holdfast.scanner.subscriptions.device import ScannedDevice

LONG_AGO = 100.0
"""Seconds."""


class Results:
    """Batches as the native poller has them for a receiver."""

    def __init__(self, polls: Iterable[Poll]) -> None:
        self._batches: queue.SimpleQueue[tuple[list[Poll], list[Any]]] = queue.SimpleQueue()
        self._batches.put((list(polls), []))
        self.dropped = 3

    def take(self, _timeout: float) -> tuple[list[Poll], list[Any]]:
        return self._batches.get()

    def wake(self) -> None:
        self._batches.put(([], []))


def handled(polls: list[Poll], wanted: int) -> tuple[list[tuple[str, float]], int, list[str]]:
    """Hands polls to an event loop. Returns what came, what was lost, and in which turn it came."""

    async def run() -> tuple[list[tuple[str, float]], int, list[str]]:
        results, came, order = Results(polls), [], []
        core = SimpleNamespace(new_receiver=lambda: results, remove=lambda _: None)
        polling = Polling(cast("_core.Poller", core))
        # On some Pythons, a clock that is set back lengthens such a wait.
        cast("Any", polling._stopping).wait = None
        done = asyncio.Event()

        def on_poll(device: Any, due: float, _blocks: Any) -> None:
            came.append((device, due))
            order.append("poll")
            asyncio.get_running_loop().call_soon(order.append, "other")
            if len(came) == wanted:
                done.set()

        names = {name: cast("Any", name) for name, _, _ in polls}
        polling._devices.update(names)
        polling.start(on_poll)
        await asyncio.wait_for(done.wait(), 30)
        lost = polling.dropped - results.dropped
        await polling.stop()
        return came, lost, order

    return asyncio.run(run())


def poll(name: str, due: float, age: float) -> Poll:
    at = time.time() - age
    return name, due, [("holding_registers", 0, 1, b"\0\1", 0, at)]


def test_other_work_is_done_between_polls(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "TURN_S", 0.0)
    came, lost, order = handled([poll(f"device{at}", at, 0.0) for at in range(5)], 5)
    assert [name for name, _ in came] == [f"device{at}" for at in range(5)]
    assert lost == 0
    assert order[:8] == ["poll", "other"] * 4


def test_late_polls_give_way_to_a_newer_one_of_their_device() -> None:
    polls = [poll("a", 1, LONG_AGO), poll("b", 1, LONG_AGO), poll("a", 2, LONG_AGO)]
    came, lost, _ = handled([*polls, poll("a", 3, 0.0)], 2)
    assert came == [("b", 1), ("a", 3)]
    assert lost == 2


def test_polls_that_are_in_time_are_all_handled() -> None:
    came, lost, _ = handled([poll("a", at, 0.0) for at in range(4)], 4)
    assert [due for _, due in came] == [0, 1, 2, 3]
    assert lost == 0


def test_a_poll_that_can_t_be_handled_costs_no_other() -> None:
    async def run() -> tuple[list[Any], list[dict[str, Any]]]:
        problems: list[dict[str, Any]] = []
        came: list[Any] = []
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: problems.append(context))
        results = Results([poll("a", 1, 0.0), poll("b", 1, 0.0)])
        core = SimpleNamespace(new_receiver=lambda: results, remove=lambda _: None)
        polling, done = Polling(cast("_core.Poller", core)), asyncio.Event()

        def on_poll(device: Any, _due: float, _blocks: Any) -> None:
            if device == "a":
                raise LookupError(device)
            came.append(device)
            done.set()

        polling._devices.update({name: cast("Any", name) for name in "ab"})
        polling.start(on_poll)
        await asyncio.wait_for(done.wait(), 30)
        await polling.stop()
        return came, problems

    came, problems = asyncio.run(run())
    assert came == ["b"]
    assert [type(problem["exception"]) for problem in problems] == [LookupError]
    assert not [thread for thread in threading.enumerate() if thread.name == "holdfast-scan"]


def test_polls_that_wait_are_not_handled_after_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "TURN_S", 0.0)

    async def run() -> list[float]:
        results = Results([poll("a", at, 0.0) for at in range(100)])
        core = SimpleNamespace(new_receiver=lambda: results, remove=lambda _: None)
        polling, began = Polling(cast("_core.Poller", core)), asyncio.Event()
        came: list[float] = []

        def on_poll(_device: Any, due: float, _blocks: Any) -> None:
            came.append(due)
            began.set()

        polling._devices.update({"a": cast("Any", "a")})
        polling.start(on_poll)
        await asyncio.wait_for(began.wait(), 30)
        await polling.stop()
        handled = list(came)
        for _ in range(10):
            await asyncio.sleep(0)
        assert came == handled
        return came

    assert len(asyncio.run(run())) < 100


def test_only_the_polls_of_a_former_address_are_discarded() -> None:
    class Noting(Polling):
        def _native(self, _device: ScannedDevice, name: str) -> Any:
            return name

    async def run() -> list[tuple[str, bool]]:
        changes: list[tuple[str, bool]] = []
        core = SimpleNamespace(
            new_receiver=lambda: Results([]),
            remove=lambda _: None,
            add=lambda name: changes.append((name, False)),
            replace=lambda old, name, **_: changes.append((name, old == name)),
        )
        polling = Noting(cast("_core.Poller", core))
        polling.start(lambda *_: None)
        device = cast("ScannedDevice", Mock(polled_as="", endpoint=object()))
        polling._renew(device)
        polling._renew(device)
        device.endpoint = cast("Any", object())
        polling._renew(device)
        assert polling._devices == {device.polled_as: device}
        await polling.stop()
        return changes

    changes = asyncio.run(run())
    assert [keeps_name for _, keeps_name in changes] == [False, True, False]
    assert len({name for name, _ in changes}) == 2

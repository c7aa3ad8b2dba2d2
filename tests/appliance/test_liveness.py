"""Heartbeats: a thread that is stalled is noticed, logged once, and shown."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import pytest

from holdfast import _core
from holdfast.appliance import liveness
from holdfast.appliance.liveness import STALLED_S, Liveness
from holdfast.appliance.services.supervision import Supervisor
from holdfast.runtime.heartbeat import Heartbeat
from holdfast.runtime.processor_time import cpu_time
from support import wire

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.runtime.stop import Stop
    from holdfast.types import ThreadHeartbeat
    from support import web
    from support.running import Run

IDENTITY = [(0, "a"), (1, "b"), (2, "c")]

EVERYTHING = """
memories:
  plant: {holding_registers: 10}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: read-only}]
devices:
  meter:
    url: tcp://127.0.0.1:1
    unit: 1
    interval: 60
    reads: [{area: holding_registers, address: 0, count: 2}]
workers: 2
audit: {file: audit.log}
rest: {bind: 127.0.0.1:0, sources: [127.0.0.0/8], tokens: none}
gateway:
  {bind: 127.0.0.1:0, sources: [127.0.0.0/8], tokens: none, access: read-only, allow: [127.0.0.1]}
metrics: {bind: 127.0.0.1:0}
"""

THREADS = {
    "holdfast-io-0",
    "holdfast-io-1",
    "holdfast-poller",
    "holdfast-audit",
    "holdfast-rest",
    "holdfast-gateway",
    "holdfast-metrics",
}


class Clock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(liveness, "time", made)
    return made


def test_a_stalled_thread_is_logged_once_and_when_it_is_back(
    clock: Clock, log: web.Records
) -> None:
    ages = {"io": 0.5, "poller": 0.5}
    watched = Liveness(lambda: [(name, age, None) for name, age in ages.items()])

    def check() -> bool:
        clock.now += 1
        watched.check()
        return not watched.stalled()

    ages["io"] = STALLED_S
    assert check()
    for age in (STALLED_S + 2, STALLED_S + 3, STALLED_S + 0.1):
        ages["io"] = age
        assert not check()
    assert [each["thread"] for each in log.of("thread_stalled")] == ["io"]
    assert log.of("thread_back") == []
    ages["io"] = 0.1
    assert check()
    assert check()
    assert [each["thread"] for each in log.of("thread_back")] == ["io"]


def test_a_process_that_was_suspended_has_no_stalled_threads(
    clock: Clock, log: web.Records
) -> None:
    ages = [0.5]
    watched = Liveness(lambda: [("io", ages[0], None)])
    clock.now += 300
    ages[0] = 300.5
    watched.check()
    assert not watched.stalled()
    clock.now += 1
    watched.check()
    assert watched.stalled()
    assert len(log.of("thread_stalled")) == 1


def test_a_thread_that_has_ended_as_it_should_is_not_stalled(clock: Clock) -> None:
    beats: list[ThreadHeartbeat] = [("nats", STALLED_S + 2, None)]
    watched = Liveness(lambda: beats)
    clock.now += 1
    watched.check()
    assert watched.stalled()
    beats.clear()
    watched.check()
    assert not watched.stalled()


def test_every_thread_of_an_appliance_has_a_heartbeat(run: Run) -> None:
    appliance = run(EVERYTHING)

    def threads() -> dict[str, Any]:
        found: dict[str, Any] = appliance.diagnostics.stats()["threads"]
        return found

    def states() -> set[object]:
        adapters = appliance.diagnostics.stats()["adapters"]
        return {adapter["state"] for adapter in adapters.values()}

    wire.until(lambda: states() == {"running"}, "all run")
    before = threads()
    assert set(before) == THREADS
    assert appliance.is_live
    # Each beats again: its age falls.
    waiting = set(THREADS)

    def all_have_beaten() -> bool:
        for name, told in threads().items():
            if told["heartbeat_age"] < before[name]["heartbeat_age"]:
                waiting.discard(name)
            before[name] = told
        return not waiting

    wire.until(all_have_beaten, "each has beaten")
    has_linux = cpu_time(threading.get_native_id()) is not None
    assert all((told["cpu"] is not None) == has_linux for told in threads().values())


def test_native_threads_know_their_number() -> None:
    engine = _core.Engine([], identity=IDENTITY, workers=2)
    poller = _core.Poller([])

    def numbers() -> list[int | None]:
        return [number for _, _, number in [*engine.heartbeats(), poller.heartbeat]]

    if cpu_time(threading.get_native_id()) is None:
        assert numbers() == [None, None, None]
    else:
        wire.until(lambda: None not in numbers(), "they have begun")
        assert len(set(numbers())) == 3
        assert None not in [cpu_time(number) for number in numbers()]
    poller.stop()
    engine.stop()


class Adapter:
    """An adapter that does what a test says."""

    def __init__(self, *, heartbeat: Heartbeat | None = None, ends: bool = False) -> None:
        self.heartbeat = heartbeat
        self.ends = ends

    def run(self, stop: Stop) -> None:
        if not self.ends:
            stop.wait()

    def status(self) -> dict[str, object]:
        return {}


class Stopped(Heartbeat):
    """A heartbeat that has stopped long ago."""

    @property
    def age(self) -> float:
        return 99.0


@pytest.fixture
def supervise() -> Iterator[Any]:
    made: list[Supervisor] = []

    def start(adapter: Adapter, *, may_end: bool = False) -> Supervisor:
        made.append(Supervisor("own", lambda: adapter, may_end=may_end))
        assert made[-1].heartbeat() is None
        made[-1].start()
        return made[-1]

    yield start
    for supervisor in made:
        supervisor.stop()
        supervisor.join()
        assert supervisor.heartbeat() is None


def age_of(supervisor: Supervisor) -> float | None:
    found = supervisor.heartbeat()
    return None if found is None else found[1]


def test_the_heartbeat_of_an_adapter_is_that_of_its_loop(supervise: Any) -> None:
    supervisor = supervise(Adapter(heartbeat=Stopped()))
    wire.until(lambda: age_of(supervisor) == 99.0, "the loop of the adapter has stopped")


def test_an_adapter_without_a_loop_lives_as_long_as_its_thread(supervise: Any) -> None:
    supervisor = supervise(Adapter())
    wire.until(lambda: supervisor.status()["state"] == "running", "it runs")
    assert age_of(supervisor) == 0.0


def test_a_failed_adapter_is_not_stalled(supervise: Any) -> None:
    supervisor = supervise(Adapter(heartbeat=Stopped(), ends=True))
    wire.until(lambda: supervisor.status()["state"] == "failed", "it waits for its restart")
    assert age_of(supervisor) == 0.0


def test_an_adapter_that_may_end_is_not_watched_after_its_end(supervise: Any) -> None:
    supervisor = supervise(Adapter(ends=True), may_end=True)
    wire.until(lambda: age_of(supervisor) is None, "it has ended")


def test_a_thread_that_has_died_is_stalled(supervise: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def die() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    monkeypatch.setattr("holdfast.appliance.services.supervision._lower_priority", die)
    supervisor = supervise(Adapter())
    wire.until(lambda: (age_of(supervisor) or 0.0) > 0.0, "the age of the thread grows")
    supervisor._has_ended = True

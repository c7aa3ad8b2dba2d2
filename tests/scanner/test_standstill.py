"""Commands that waited while a scanner did not run, which must not be written late."""

from __future__ import annotations

import asyncio
import json
import signal
import sys
import threading
import time
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from holdfast.net.nats.connection import Servers
from holdfast.polling.write_ttl import WRITE_TTL_S
from holdfast.scanner import late_commands as module
from holdfast.scanner.fleet.nodes import Command
from holdfast.scanner.fleet.questions import subject
from holdfast.scanner.settings import FleetSettings, Settings
from support import wire
from support.fake_device import FakeDevice, registers
from support.fleet_nodes import FLEET, prepare, subscribed, wanted
from support.judges import Judges
from support.leases import BRIEF
from support.nats_bus import Caller, logged, subscription, tag
from support.scanner_parts import member_of, polling_of
from support.scanner_process import begin_scanner, freeze

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from concurrent.futures import Future
    from pathlib import Path
    from subprocess import Popen

    import holdfast
    from support.brokers import NatsServer
    from support.nats_bus import Run, Running

LATE = "not written: this scanner stood still for"

STANDSTILL_S = 0.5
"""A loaded machine can cause one, too: what is sent after it has to be repeated."""

PARTITIONS = 4
LOG = "scanner.log"

needs_stopping = pytest.mark.skipif(sys.platform == "win32", reason="can't stop a process")


@pytest.fixture
def judges() -> Iterator[Judges]:
    with Judges(1) as judges:
        yield judges


@pytest.fixture
def process(own_nats: NatsServer, tmp_path: Path) -> Iterator[Callable[..., Popen[bytes]]]:
    """Starts a scanner as a process."""
    with ExitStack() as running:

        def start(**more: Any) -> Popen[bytes]:
            settings = Settings(Servers((own_nats.url,)), standstill_s=STANDSTILL_S, **more)
            started = running.enter_context(begin_scanner(settings, tmp_path / LOG))
            running.callback(started.kill)
            return started

        yield start


@pytest.fixture
def node(own_nats: NatsServer, run_scanner: Run) -> Callable[..., Running]:
    """Starts a scanner that is the only node of a fleet."""
    prepare(own_nats.url, PARTITIONS)
    return lambda **more: run_scanner(own_nats, fleet=FleetSettings(FLEET, "a", PARTITIONS), **more)


def send(caller: Caller, where: str, payload: bytes) -> Future[Any]:
    """Sends a request. When it returns, the server has it."""

    async def request() -> Any:
        answer = await caller.client.request(where, payload, timeout=3 * wire.DEADLINE)
        return json.loads(answer.data)

    sent = asyncio.run_coroutine_threadsafe(request(), caller.loop)
    caller.publish("nobody")
    return sent


def stand(
    process: Popen[bytes], during: Callable[[], Sequence[Future[Any]]], seconds: float
) -> list[Any]:
    """Stops a process, and returns the answers to what was sent to it meanwhile."""
    freeze(process)
    try:
        sent = during()
        until_late(seconds)
    finally:
        process.send_signal(signal.SIGCONT)
    return [each.result(3 * wire.DEADLINE) for each in sent]


def until_late(seconds: float = STANDSTILL_S) -> None:
    end = time.monotonic() + seconds + 0.1
    wire.until(lambda: time.monotonic() > end, "it stood still for long enough")


def is_done(caller: Caller, where: str, text: str) -> bool:
    return bool(caller.request(where, text)["success"])


@needs_stopping
def test_commands_that_waited_for_a_stopped_scanner_are_refused(
    process: Callable[..., Popen[bytes]], own_caller: Caller, judges: Judges
) -> None:
    [judge] = judges.devices
    running = process()
    subscribed(own_caller, 0, judge)
    wire.until(partial(is_done, own_caller, "modbus.command.t0", "1"), "it is written")

    def during() -> list[Future[Any]]:
        for _ in range(100):  # More than the loop handles at once, and nobody waits for an answer.
            own_caller.publish("modbus.command.t0", "2")
        return [send(own_caller, "modbus.command.d0.t0", b"3") for _ in range(3)]

    for answer in stand(running, during, STANDSTILL_S):
        assert answer["success"] is False
        assert answer["error"].startswith(LATE)
        assert answer["error"].endswith("send it again if it is still wanted")
    wire.until(partial(is_done, own_caller, "modbus.command.t0", "4"), "new ones are written")
    assert {value for _, value in judge.writes} == {1, 4}


@needs_stopping
def test_commands_that_waited_for_a_stopped_node_are_refused(
    process: Callable[..., Popen[bytes]],
    own_nats: NatsServer,
    own_caller: Caller,
    judges: Judges,
    tmp_path: Path,
) -> None:
    [judge] = judges.devices
    prepare(own_nats.url, PARTITIONS)
    running = process(fleet=FleetSettings(FLEET, "a", PARTITIONS, BRIEF))
    subscribed(own_caller, 0, judge)
    wire.until(partial(is_done, own_caller, "modbus.command.d0.t0", "1"), "it is written")

    def during() -> list[Future[Any]]:
        return [send(own_caller, "modbus.command.d0.t0", b"3") for _ in range(3)]

    # Its leases lapse, and it renews them.
    for answer in stand(running, during, BRIEF.hold_s):
        assert answer["success"] is False
        assert answer["error"].startswith(LATE)
    wire.until(partial(is_done, own_caller, "modbus.command.d0.t0", "4"), "it is written")
    assert {value for _, value in judge.writes} == {1, 4}
    assert "stood_still" in (tmp_path / LOG).read_text()


class Blocked:
    """The event loop of a scanner, which does not run until it is released."""

    def __init__(self, scanner: Running) -> None:
        self._gate, is_blocked = threading.Event(), threading.Event()

        async def block() -> None:
            is_blocked.set()
            self._gate.wait(3 * wire.DEADLINE)

        assert scanner._loop is not None
        asyncio.run_coroutine_threadsafe(block(), scanner._loop.loop)
        assert is_blocked.wait(wire.DEADLINE)

    def release(self) -> None:
        self._gate.set()


def test_a_command_of_another_node_is_refused_by_a_node_whose_loop_did_not_run(
    node: Callable[..., Running], own_caller: Caller, judges: Judges
) -> None:
    [judge] = judges.devices
    running = node(standstill_s=STANDSTILL_S)
    subscribed(own_caller, 0, judge)
    wire.until(partial(is_done, own_caller, "modbus.command.d0.t0", "1"), "it is written")
    member = member_of(running.scanner)
    where = subject("modbus", "a", "command", member.partition_leases.leases.process)
    command = msgspec.json.encode(Command(device="d0", tag="t0", text="3", epoch=0))
    # The thread of its leases goes on: the node has the device all the time.
    blocked = Blocked(running)
    try:
        sent = [send(own_caller, where, command) for _ in range(3)]
        until_late()
    finally:
        blocked.release()
    for each in sent:
        answer = each.result(wire.DEADLINE)
        assert answer.get("moved") or answer["error"].startswith(LATE)
    wire.until(partial(is_done, own_caller, "modbus.command.d0.t0", "4"), "it is written")
    assert {value for _, value in judge.writes} == {1, 4}


def test_a_command_of_another_node_waits_as_long_as_that_node_allows(
    node: Callable[..., Running],
    own_caller: Caller,
    judges: Judges,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    running = node()
    subscribed(own_caller, 0, judges.devices[0])
    wire.until(partial(is_done, own_caller, "modbus.command.d0.t0", "1"), "it is written")
    member, allowed = member_of(running.scanner), list[float]()

    async def write(_device: object, _request: object, *, within: float) -> int:
        allowed.append(within)
        return 0

    monkeypatch.setattr(polling_of(running.scanner), "write", write)
    where = subject("modbus", "a", "command", member.partition_leases.leases.process)
    for within in (4.0, 60.0):
        command = Command(device="d0", tag="t0", text="3", epoch=0, within=within)
        answer = send(own_caller, where, msgspec.json.encode(command)).result(wire.DEADLINE)
        assert answer == {"success": True}
    assert allowed[0] == 4.0
    assert 4.0 < allowed[1] <= WRITE_TTL_S


def test_a_standstill_is_logged_once(
    run_scanner: Run, caller: Caller, caplog: pytest.LogCaptureFixture
) -> None:
    blocked = Blocked(run_scanner(standstill_s=STANDSTILL_S))
    try:
        until_late()
    finally:
        blocked.release()
    assert caller.request("modbus.browse", b"")["devices"] == []
    wire.until(lambda: logged(caplog, "stood_still"), "it is logged")
    [first, *_] = logged(caplog, "stood_still")
    assert first["part"] == "scanner"
    assert first["seconds"] >= STANDSTILL_S


def test_a_command_that_waited_for_long_in_the_scanner_is_refused(
    run_scanner: Run,
    caller: Caller,
    server: holdfast.Server,
    memory: holdfast.Memory,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run_scanner()
    caller.request("modbus.subscribe", subscription(server, tag("a", 10)))
    with monkeypatch.context() as patched:
        patched.setattr(module, "WRITE_TTL_S", -1.0)
        answer = caller.request("modbus.command.a", "3")
    assert answer["success"] is False
    assert answer["error"].startswith("not written: the command waited for 0 s; send it again")
    assert memory.read("holding_registers", 10, 1) == [0]
    assert caller.request("modbus.command.a", "4") == {"success": True}


def test_a_command_that_waited_for_long_for_its_device_is_refused(
    run_scanner: Run, caller: Caller, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_scanner()
    is_reading, go_on = threading.Event(), threading.Event()

    def answer(pdu: bytes) -> bytes:
        if pdu[0] == 3 and not is_reading.is_set():
            is_reading.set()
            assert go_on.wait(wire.DEADLINE)
        return registers(pdu) if pdu[0] == 3 else pdu

    with FakeDevice(answer) as line:
        of = {"subscriberId": "x", "url": line.url, "scanRate": 60_000}
        slow = {**of, "deviceId": "slow", "timeout": 30_000, "tags": [tag("b", 0)]}
        other = {**of, "deviceId": "a", "unitId": 2, "timeout": 1000, "tags": [tag("a", 0)]}
        try:
            assert caller.request("modbus.subscribe", slow)["success"]
            assert is_reading.wait(wire.DEADLINE)
            assert caller.request("modbus.subscribe", other)["success"]
            with monkeypatch.context() as patched:
                patched.setattr(module, "WRITE_TTL_S", 1.0)
                refused = caller.request("modbus.command.a", "3")
        finally:
            go_on.set()
        assert refused == {
            "success": False,
            "error": "not written: it has waited too long; send it again if it is still wanted",
        }
        assert caller.request("modbus.command.a", "4") == {"success": True}
        assert [pdu for pdu in line.asked if pdu[0] == 6] == [bytes.fromhex("0600000004")]


def test_a_node_passes_no_command_on_that_waited_for_long(
    node: Callable[..., Running], own_caller: Caller, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = node()
    member = member_of(running.scanner)
    with Judges(1) as judges:
        subscribed(own_caller, 0, judges.devices[0])
        monkeypatch.setattr(member, "is_own", lambda _: False)  # It waits for a node that has it.
        monkeypatch.setattr(module, "WRITE_TTL_S", 0.5)
        answer = own_caller.request("modbus.command.d0.t0", "3")
        assert answer["error"].startswith("not written: the command waited for")
        assert not judges.devices[0].writes


def test_requests_that_change_nothing_of_a_device_are_answered_after_a_standstill(
    run_scanner: Run, own_nats: NatsServer, own_caller: Caller, judges: Judges
) -> None:
    running = run_scanner(own_nats, standstill_s=STANDSTILL_S)
    blocked = Blocked(running)
    try:
        request = json.dumps(wanted(judges.devices[0], 0)).encode()
        sent = send(own_caller, "modbus.subscribe", request)
        until_late()
    finally:
        blocked.release()
    assert sent.result(wire.DEADLINE) == {"success": True, "count": 1}

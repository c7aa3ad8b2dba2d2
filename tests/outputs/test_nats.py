"""An output to NATS, with a real server: messages, states, and outages."""

from __future__ import annotations

import asyncio
import socket
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.net.nats.connection import Servers
from holdfast.outputs import Buffer, OutputSender
from holdfast.outputs import sender as module
from holdfast.outputs.sender import Refused
from holdfast.polling.faults import NO_CONNECTION
from holdfast.runtime.stop import Stop
from holdfast.scanner.publish import nats_output as output_module
from holdfast.scanner.publish.nats_output import NatsOutput
from support import wire
from support.brokers import NatsServer
from support.nats_bus import Caller
from support.readings import TIME, numbered, polls, reading, tag

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

STAMP = int(TIME * 1000)


@pytest.fixture
def output(own_nats: NatsServer) -> Iterator[NatsOutput]:
    made = NatsOutput(Servers((own_nats.url,)), "modbus", "tentacle")
    yield made
    made.close()


@contextmanager
def denying(folder: Path, subjects: str) -> Iterator[NatsOutput]:
    """An output that may not publish to some subjects."""
    (folder / "nats.conf").write_text(
        'authorization: {users: [{user: u, password: "", permissions: {publish: '
        f"{{deny: {subjects}}}}}}}]}}"
    )
    server = NatsServer(folder, "-c", str(folder / "nats.conf"), jetstream=False)
    output = NatsOutput(Servers((server.url,), user="u"), "modbus", "tentacle-next")
    try:
        yield output
    finally:
        output.close()
        server.kill()


def test_values_come_as_messages_of_the_scanner(output: NatsOutput, own_caller: Caller) -> None:
    inbox = own_caller.listen("modbus.>")
    output.send(
        [
            reading(230.10000610351562, tag=tag("v", type="float32")),
            reading(True, tag=tag("on", area="coils", type="bool")),
            reading(None, tag=tag("marked")),
            reading([1, 2], tag=tag("both", type="uint16[2]")),
            reading(None, tag=tag("bad"), fault=2),
        ]
    )
    state = inbox.next()
    assert state == {"deviceId": "pump", "state": "online", "failures": 0, "timestamp": STAMP}
    common = {"moduleId": "modbus", "deviceId": "pump", "timestamp": STAMP}
    assert [inbox.next() for _ in range(4)] == [
        {**common, "variableId": "v", "value": 230.1, "datatype": "number"},
        {**common, "variableId": "on", "value": True, "datatype": "boolean"},
        {**common, "variableId": "marked", "value": None, "datatype": "number"},
        {**common, "variableId": "both", "value": [1, 2], "datatype": "array"},
    ]


def test_states_are_published_when_they_change(output: NatsOutput, own_caller: Caller) -> None:
    inbox = own_caller.listen("modbus.status.pump")
    down = reading(None, fault=NO_CONNECTION)
    output.send([reading(1), reading(2), down, down])
    output.send([down, reading(None, fault=2), reading(3)])
    states = [inbox.next() for _ in range(3)]
    assert [(each["state"], each.get("error")) for each in states] == [
        ("online", None),
        ("offline", "no connection"),
        ("online", None),
    ]


def test_tentacle_next_has_a_subject_for_each_tag(own_nats: NatsServer, own_caller: Caller) -> None:
    inbox = own_caller.listen("line1.data.pump.t")
    output = NatsOutput(Servers((own_nats.url,)), "line1", "tentacle-next")
    output.send([reading(7)])
    output.close()
    assert inbox.next()["value"] == 7


def test_nothing_is_lost_when_the_server_is_away(
    own_nats: NatsServer, output: NatsOutput, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("FIRST_PAUSE_S", "MAX_PAUSE_S", "CHECK_INTERVAL_S"):
        monkeypatch.setattr(module, name, 0.05)
    buffer, stop = Buffer(), Stop()
    sender = OutputSender("nats", output, buffer)
    thread = threading.Thread(target=sender.run, args=[stop])
    thread.start()
    try:
        with Caller(own_nats.url) as caller:
            inbox = caller.listen("modbus.data.pump")
            buffer.offer(polls(3))
            assert [inbox.next()["value"] for _ in range(3)] == [0, 1, 2]
        own_nats.kill()
        buffer.offer(polls(2000, 3))
        wire.until(lambda: sender.status()["connected"] is False, "the server is missed")
        own_nats.start()
        with Caller(own_nats.url) as caller:
            inbox = caller.listen("modbus.data.pump")
            buffer.offer(polls(1, 2003))
            wire.until(lambda: not len(buffer), "all is sent")
            found = [inbox.next()["value"]]
            while found[-1] != 2003:
                found.append(inbox.next()["value"])
    finally:
        stop.set()
        thread.join(wire.DEADLINE)
    # What came before the listener is not seen: NATS keeps nothing without a stream.
    assert found == list(range(found[0], 2004))
    assert sender.status()["readings"] == {"sent": 2004, "refused": 0, "dropped": 0}


@pytest.mark.parametrize(
    ("rule", "reason"),
    [
        (
            'authorization: {users: [{user: u, password: "", permissions: {publish: '
            '{deny: "modbus.data.big"}}}]}',
            'Permissions Violation for Publish to "modbus.data.big"',
        ),
        ("max_payload: 512", r"modbus.data.big: found \d+ bytes, the server takes 512"),
        (
            'accounts: {A: {users: [{user: u, password: ""}], limits: {max_payload: 512}}}',
            r"modbus.data.big: found \d+ bytes, the server takes 512",
        ),
    ],
)
def test_a_value_that_the_server_does_not_take_is_refused_alone(
    tmp_path: Path, rule: str, reason: str
) -> None:
    (tmp_path / "nats.conf").write_text(rule)
    server = NatsServer(tmp_path, "-c", str(tmp_path / "nats.conf"), jetstream=False)
    output = NatsOutput(Servers((server.url,), user="u"), "modbus", "tentacle")
    try:
        big = reading([60000] * 120, tag=tag("t", type="uint16[120]"), device="big")
        for _ in range(3):  # The first one also connects.
            with pytest.raises(Refused, match=reason) as caught:
                output.send([big, reading(1), reading(2)])
            assert len(caught.value.readings) == 1
        output.send([reading(3)])
    finally:
        output.close()
        server.kill()


def test_a_value_counts_once_and_its_state_is_published_again(tmp_path: Path) -> None:
    with denying(tmp_path, '["modbus.data.BIG.>", "modbus.status.BIG"]') as output:
        for _ in range(2):
            with pytest.raises(Refused, match=r"Publish to \"modbus\.status\.BIG\"") as caught:
                output.send([reading(1, device="BIG"), reading(2), reading(3)])
            assert len(caught.value.readings) == 1


def test_a_refused_value_whose_tag_has_a_quote_counts(tmp_path: Path) -> None:
    with denying(tmp_path, '"modbus.data.pump.>"') as output:
        with pytest.raises(Refused, match="Publish to") as caught:
            output.send([reading(1, tag=tag('5"')), reading(2), reading(3, device="other")])
        assert len(caught.value.readings) == 2


def test_a_lost_connection_is_an_error_at_once(own_nats: NatsServer, output: NatsOutput) -> None:
    """Also if nothing was read from the connection since it ended."""
    output.send(numbered(1))
    own_nats.kill()
    with pytest.raises(OSError, match=r"the connection was lost|connection closed"):
        output.send(numbered(2000))


def test_a_server_that_can_not_be_reached_is_an_error(own_nats: NatsServer) -> None:
    own_nats.kill()
    output = NatsOutput(Servers((own_nats.url,)), "modbus", "tentacle")
    with pytest.raises(OSError, match=r"refused|no servers"):
        output.send(numbered(1))
    output.idle()
    output.close()


def test_a_frozen_server_does_not_hold_up_a_stop(
    own_nats: NatsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "STOP_TIMEOUT_S", 0.05)
    monkeypatch.setattr(output_module, "CONFIRM_TIMEOUT_S", 3600.0)
    output = NatsOutput(Servers((own_nats.url,)), "modbus", "tentacle")
    buffer, stop = Buffer(), Stop()
    sender = OutputSender("nats", output, buffer, is_followed=lambda: True)
    thread = threading.Thread(target=sender.run, args=[stop])
    thread.start()
    buffer.offer(polls(1))
    counted = sender.status
    wire.until(lambda: "'sent': 1" in str(counted()["readings"]), "it is connected")
    own_nats.freeze()
    buffer.offer(polls(1))
    stop.set()
    thread.join(wire.DEADLINE)
    own_nats.thaw()
    assert not thread.is_alive()
    assert len(buffer) == 1


def test_connecting_does_not_hold_up_a_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "STOP_TIMEOUT_S", 0.05)
    waits: list[float] = []
    wait_for = asyncio.wait_for

    async def noted(task: Any, timeout: float) -> Any:
        waits.append(timeout)
        return await wait_for(task, timeout)

    monkeypatch.setattr(asyncio, "wait_for", noted)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"nats://127.0.0.1:{silent.getsockname()[1]}"
        output, stop = NatsOutput(Servers((url,)), "modbus", "tentacle"), Stop()
        output.use_stop(stop)
        stop.set()
        with pytest.raises(OSError):  # noqa: PT011
            output.send(numbered(1))
        output.close()
    assert waits[0] <= 0.05

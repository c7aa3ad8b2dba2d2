"""Devices that are read into replicated memories: one of the appliances polls each of them.

The device is the judge: it knows which connection every request came over.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.appliance import Appliance
from holdfast.appliance.client_credentials import nats_servers
from holdfast.appliance.parts import device_leases
from holdfast.client.url import connection_of, parse
from holdfast.config import ConfigError, load
from holdfast.replication.leases.leases import Leases
from holdfast.replication.leases.times import LEASE_TIMES, LeaseTimes
from support import wire
from support.brokers import NatsServer
from support.cli import RunCommand, invoke
from support.config_folder import written
from support.fake_device import Stream, silent
from support.leases import BRIEF, ENDLESS, make_settled
from support.nats_bus import logged
from support.running import endpoint
from support.tcp_proxy import Proxy

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from support.fake_device import Asked, Peer


RUN = f"""
import sys
from holdfast.appliance import Appliance
from holdfast.config import load
from holdfast.replication.leases.times import LeaseTimes
with Appliance(load(sys.argv[1]), lease_times={BRIEF}) as appliance:
    while True:
        appliance.log_events(1.0)
"""


class Device(Stream):
    """A device that notes over which connection each request came."""

    def __init__(self) -> None:
        super().__init__("tcp", then=self._note)
        self.peers: list[Peer] = []
        self.writes: list[tuple[float, bytes]] = []

    def _note(self, asked: Asked) -> None:
        self.peers.append(asked.peer)
        if asked.pdu[0] > 4:
            self.writes.append((time.monotonic(), asked.pdu))
        asked.answer()

    def count(self, asked: Asked) -> None:
        """Answers with the number of the poll in the second register."""
        self.peers.append(asked.peer)
        asked.answer(bytes((3, 4, 0, 0)) + len(self.peers).to_bytes(2))


@pytest.fixture
def server(tmp_path: Path) -> Iterator[NatsServer]:
    (tmp_path / "server").mkdir()
    server = NatsServer(tmp_path / "server")
    make_settled(server.url, "holdfast-log-site-devices")
    yield server
    server.kill()


@pytest.fixture
def device() -> Iterator[Device]:
    with Device() as made:
        yield made


@pytest.fixture
def settings(tmp_path: Path, server: NatsServer, device: Device) -> Callable[..., Path]:
    """Writes the configuration of a node."""

    def write(name: str, **more: Any) -> Path:
        meter = {
            "url": device.url,
            "interval": 0.02,
            "timeout": 3,
            "writes": "pass",
            "reads": [
                {
                    "area": "holding_registers",
                    "address": 7,
                    "count": 2,
                    "into": {"memory": "plant", "area": "holding_registers", "address": 10},
                }
            ],
        }
        rules = [{"sources": ["127.0.0.0/8"], "units": {1: "plant"}, "access": "read-write"}]
        parts = {
            "memories": {"plant": {"holding_registers": 100, "replicate": {"log": "site"}}},
            "logs": {"site": {"servers": [server.url], "node": name, "write_timeout": 10}},
            "devices": {"meter": meter | more},
            "listeners": {"scada": {"type": "modbus-tcp", "bind": "127.0.0.1:0", "rules": rules}},
        }
        file = tmp_path / f"{name}.yaml"
        file.write_text(written(parts))
        return file

    return write


@pytest.fixture
def node(settings: Callable[..., Path]) -> Iterator[Callable[..., Appliance]]:
    with ExitStack() as running:

        def start(name: str, lease_times: LeaseTimes = LEASE_TIMES, **more: Any) -> Appliance:
            config = load(settings(name, **more))
            return running.enter_context(Appliance(config, lease_times=lease_times))

        yield start


@pytest.fixture
def process(settings: Callable[..., Path]) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Starts appliances as processes, which can be stopped and killed; their leases are `BRIEF`."""
    with ExitStack() as running:

        def start(name: str, **more: Any) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-c", RUN, str(settings(name, **more))]
            started = running.enter_context(subprocess.Popen(command))
            running.callback(started.kill)
            return started

        yield start


def ask(appliance: Appliance, pdu: str) -> str:
    with wire.Connection(endpoint(appliance, "scada")) as connection:
        return connection.ask(bytes.fromhex(pdu)).hex()


def health(appliance: Appliance) -> str:
    found: str = appliance.diagnostics.stats()["devices"]["meter"]["health"]
    return found


def polled_by(appliance: Appliance) -> str | None:
    found: str | None = appliance.replicas()["site"]["devices"]["meter"]["node"]
    return found


def test_one_node_polls_a_device_and_all_have_its_values(
    node: Callable[..., Appliance], device: Device
) -> None:
    one = node("a")
    wire.until(lambda: health(one) == "ok", "the first node polls it")
    two = node("b")
    wire.until(lambda: ask(two, "03000a0002") == "030400070008", "the other node has its values")
    wire.until(lambda: polled_by(two) == "a", "the other node knows who polls it")
    assert health(two) == "standby"
    polls = len(device.peers)
    wire.until(lambda: len(device.peers) > polls + 20, "it is polled")
    assert device.connections == 1
    one.stop()
    wire.until(lambda: health(two) == "ok", "the other node has taken over")
    assert device.connections == 2
    assert polled_by(two) == "b"


def test_a_node_that_was_stopped_sends_not_one_poll_when_it_goes_on(
    process: Callable[..., subprocess.Popen[bytes]],
    node: Callable[..., Appliance],
    device: Device,
) -> None:
    one = process("a")
    wire.until(lambda: device.connections == 1, "the first node polls it")
    two = node("b", BRIEF)
    wire.until(lambda: polled_by(two) == "a", "the other node knows who polls it")
    wire.until(lambda: len(device.peers) > 20, "it is polled")
    one.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, one.pid, os.WSTOPPED | os.WNOWAIT)
    wire.until(lambda: polled_by(two) == "b", "the other node has taken over")
    wire.until(lambda: health(two) == "ok", "it polls")
    polls = len(device.peers)
    wire.until(lambda: len(device.peers) > polls + 5, "it goes on")
    stopped_at = len(device.peers)
    [first, second] = dict.fromkeys(device.peers)
    # The device has seen all that the first node sent before it was stopped.
    one.send_signal(signal.SIGCONT)
    # It closes its connection, and asks nothing more.
    wire.until(lambda: device.sources() and first not in device._peers, "it closes its connection")
    wire.until(lambda: len(device.peers) > stopped_at + 20, "the other node goes on")
    assert set(device.peers[stopped_at:]) == {second}
    assert device.connections == 2


def test_values_of_a_node_that_was_cut_off_are_refused_when_they_arrive_late(
    node: Callable[..., Appliance],
    settings: Callable[..., Path],
    server: NatsServer,
    device: Device,
) -> None:
    device.then = device.count
    with closing(Proxy(server.port, "nats")) as proxy:
        file = settings("a", interval=0.01)
        file.write_text(file.read_text().replace(server.url, proxy.url))
        with Appliance(load(file), lease_times=BRIEF) as one:
            wire.until(lambda: health(one) == "ok", "the first node polls it")
            # It polls once, when it takes over.
            two = node("b", BRIEF, interval=3600)
            wire.until(lambda: polled_by(two) == "a", "the other node knows who polls it")
            proxy.hold()
            wire.until(lambda: health(two) == "ok", "the other node has taken over")
            newest = ask(two, "03000b0001")
            proxy.go_on()
            # What the first node has sent before comes before this.
            wire.until(lambda: ask(one, "0600000001") == "0600000001", "it is connected again")
            wire.until(lambda: ask(two, "0300000001") == "03020001", "the other node has followed")
            # The device counts its polls. The first node may poll it again: its term is brief.
            assert min(ask(each, "03000b0001") for each in (one, two)) >= newest


def test_a_device_of_a_kept_memory_too_is_written_into_the_log_by_the_next_holder(
    node: Callable[..., Appliance],
    settings: Callable[..., Path],
    tmp_path: Path,
    device: Device,
) -> None:
    device.then = device.count
    one = node("a")
    wire.until(lambda: health(one) == "ok", "the first node polls it")
    one.stop()
    file = settings("b")
    keep = {"file": str(tmp_path / "b.redb"), "sync": 0}
    own = {"own": {"holding_registers": 100, "keep": keep}}
    read = {"area": "holding_registers", "address": 7, "count": 2}
    into = {"memory": "own", "area": "holding_registers", "address": 10}
    text = file.read_text().replace('"memories": {', f'"memories": {written(own)[:-1]}, ')
    file.write_text(text.replace('"reads": [', f'"reads": [{written({**read, "into": into})}, '))
    with Appliance(load(file), lease_times=LEASE_TIMES) as two:
        wire.until(lambda: health(two) == "ok", "the other node has taken over")
        before = ask(two, "03000b0001")
        wire.until(lambda: ask(two, "03000b0001") > before, "the replicated memory moves on")
        assert two.diagnostics.stats()["devices"]["meter"]["unstored"] == 0


def test_a_log_with_later_terms_than_the_bucket_of_leases_takes_the_values_of_the_holder(
    node: Callable[..., Appliance], device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    device.then = device.count
    one = node("a")
    wire.until(lambda: health(one) == "ok", "the first node polls it")
    one.stop()
    before = len(device.peers)
    # As if the bucket were one of long ago.
    monkeypatch.setattr(
        Leases, "_made_at", property(lambda _: None, lambda *_: None), raising=False
    )
    two = node("b")
    wire.until(lambda: int(ask(two, "03000b0001")[-4:], 16) > before, "its values are there")
    wire.until(lambda: health(two) == "ok", "it has recovered")


def test_a_node_that_stands_by_writes_no_status_of_the_device(
    settings: Callable[..., Path],
) -> None:
    status = {"memory": "plant", "area": "holding_registers", "slot": 2}

    def started(name: str) -> Appliance:
        config = load(settings(name, interval=3600, status=status))
        return Appliance(config, lease_times=LEASE_TIMES)

    with started("a") as one:
        wire.until(lambda: health(one) == "ok", "the first node polls it")
        wire.until(lambda: ask(one, "03003c0001") == "03020001", "its status is ok")
        with started("b") as two:
            wire.until(lambda: polled_by(two) == "a", "the other node knows who polls it")
            wire.until(lambda: health(two) == "standby", "it stands by")
            assert ask(two, "0600000001") == "0600000001"
            wire.until(lambda: ask(one, "0300000001") == "03020001", "the first has followed")
            assert [ask(each, "03003c0001") for each in (one, two)] == ["03020001"] * 2


def test_a_node_that_dies_is_replaced_and_the_first_write_waits(
    process: Callable[..., subprocess.Popen[bytes]],
    node: Callable[..., Appliance],
    device: Device,
) -> None:
    timeout_s = 2
    one = process("a", timeout=timeout_s)
    wire.until(lambda: device.connections == 1, "the first node polls it")
    two = node("b", BRIEF, timeout=timeout_s)
    wire.until(lambda: polled_by(two) == "a", "the other node knows who polls it")
    # A node that stands by does not write to the device.
    assert ask(two, "06000a0063") == "860a"
    assert not device.writes
    one.kill()
    wire.until(lambda: device.connections == 2, "the other node has taken over")
    taken_over = time.monotonic()
    assert ask(two, "06000a0063") == "06000a0063"
    [(at, pdu)] = device.writes
    assert pdu.hex() == "0600070063"
    # The timeout of the device, and the TTL, of which a part has passed when it is first polled.
    assert at - taken_over > BRIEF.ttl_s + timeout_s - 1.0
    assert ask(two, "03000a0001") == "03020063"
    # Polls went on meanwhile, and later writes do not wait.
    assert ask(two, "06000a0064") == "06000a0064"


def test_after_a_lease_that_was_given_back_the_first_write_does_not_wait(
    node: Callable[..., Appliance],
) -> None:
    one = node("a", ENDLESS)
    wire.until(lambda: health(one) == "ok", "the first node polls it")
    two = node("b", ENDLESS)  # Otherwise, the first write waits for as long.
    wire.until(lambda: polled_by(two) == "a", "the other node knows who polls it")
    one.stop()
    wire.until(lambda: health(two) == "ok", "the other node has taken over")
    assert ask(two, "06000a0063") == "06000a0063"


def test_a_device_that_is_removed_gives_its_lease_back(
    node: Callable[..., Appliance], settings: Callable[..., Path]
) -> None:
    one = node("a")
    wire.until(lambda: health(one) == "ok", "the first node polls it")
    two = node("b")
    wire.until(lambda: health(two) == "standby", "the other node stands by")
    one.reload(load(settings("a", enabled=False)))
    wire.until(lambda: health(two) == "ok", "the other node has taken over")
    one.reload(load(settings("a")))
    wire.until(lambda: health(one) == "standby", "the first node stands by")


def test_a_device_whose_address_another_node_polls_without_it_is_named(
    node: Callable[..., Appliance],
    settings: Callable[..., Path],
    caplog: pytest.LogCaptureFixture,
) -> None:
    one = node("a")
    wire.until(lambda: health(one) == "ok", "the first node polls it")
    file = settings("b")
    file.write_text(file.read_text().replace("meter", "pump"))
    with Appliance(load(file)) as two:
        wire.until(
            lambda: two.replicas()["site"]["devices"].get("pump", {}).get("node", "") is None,
            "nobody polls it",
        )
        wire.until(lambda: "device_not_polled" in caplog.messages, "it is logged")


def test_a_node_whose_log_has_failed_lets_others_poll(
    node: Callable[..., Appliance], caplog: pytest.LogCaptureFixture
) -> None:
    one = node("a", BRIEF)
    wire.until(lambda: health(one) == "ok", "it polls")
    two = node("a", BRIEF)  # Two processes with one name: the first one fails.
    wire.until(lambda: health(two) == "ok", "the other node has taken over")
    assert health(one) == "standby"
    [fields] = logged(caplog, "device_given_up")
    assert fields["reason"] == "the log is not usable here: failed (name_taken)"


def test_a_node_whose_log_hangs_lets_others_poll_and_takes_part_again(
    node: Callable[..., Appliance],
    settings: Callable[..., Path],
    server: NatsServer,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its leases have a connection of their own, which goes on."""
    direct = nats_servers(load(settings("a")).logs["site"])
    monkeypatch.setattr(device_leases, "nats_servers", lambda _: direct)
    with closing(Proxy(server.port, "nats")) as proxy:
        file = settings("a")
        text = file.read_text().replace(server.url, proxy.url)
        file.write_text(text.replace("write_timeout: 10", "write_timeout: 10, max_lag: 1"))
        with Appliance(load(file), lease_times=BRIEF) as one:
            wire.until(lambda: health(one) == "ok", "it polls")
            two = node("b", BRIEF)
            wire.until(lambda: polled_by(two) == "a", "the other node knows who polls it")
            proxy.hold()
            wire.until(lambda: health(two) == "ok", "the other node has taken over")
            assert health(one) == "standby"
            proxy.go_on()
            wire.until(lambda: one.replicas()["site"]["obstacle"] is None, "its log works again")
            two.stop()
            wire.until(lambda: health(one) == "ok", "it polls again")


def test_without_its_log_a_node_stops_polling_and_comes_back(
    node: Callable[..., Appliance], server: NatsServer, device: Device
) -> None:
    one = node("a", BRIEF, tags={"level": {"area": "holding_registers", "address": 7}})
    wire.until(one.diagnostics.tag_values, "it polls")
    server.kill()
    wire.until(lambda: health(one) == "standby", "it stands by")
    wire.until(lambda: not one.diagnostics.tag_values(), "another node would have the values")
    wire.until(lambda: device.sources() and not device._peers, "the device has no connection")
    polls = len(device.peers)
    wire.until(lambda: not one.replicas()["site"]["connected"], "the log is gone")
    assert len(device.peers) == polls
    server.start()
    wire.until(lambda: health(one) == "ok", "it polls again")
    wire.until(one.diagnostics.tag_values, "it has values again")


def test_a_log_whose_servers_have_lost_it_is_said_to_have_failed(
    node: Callable[..., Appliance], server: NatsServer, caplog: pytest.LogCaptureFixture
) -> None:
    one = node("a")
    wire.until(lambda: health(one) == "ok", "it polls")
    server.kill()
    server.lose_store()
    server.start()

    def failed() -> bool:
        one.log_events(0)
        return bool(logged(caplog, "log_failed"))

    wire.until(failed, "it is logged")
    [fields] = logged(caplog, "log_failed")
    assert (fields["log"], fields["kind"]) == ("site", "replaced")


def test_values_that_a_node_replays_are_stale_until_the_device_is_read(
    settings: Callable[..., Path], device: Device
) -> None:
    never = {"after": 3600, "answer": "exception"}
    both, stale, beside = "03000a0002", "830b", "0300000001"

    def started() -> Appliance:
        return Appliance(load(settings("a", stale=never, timeout=0.1)), lease_times=LEASE_TIMES)

    with started() as appliance:
        wire.until(lambda: ask(appliance, both) == "030400070008", "the device was read")
    device.then = silent
    with started() as appliance:
        polls = len(device.peers)
        wire.until(lambda: len(device.requests) > polls + 3, "it is polled in vain")
        assert (ask(appliance, both), ask(appliance, beside)) == (stale, "03020000")
        device.then = device._note
        wire.until(lambda: ask(appliance, both) == "030400070008", "the device was read again")


def test_values_of_another_device_that_another_node_reads_into_a_range_are_stale(
    node: Callable[..., Appliance], settings: Callable[..., Path], device: Device
) -> None:
    one = node("a")
    wire.until(lambda: health(one) == "ok", "the first node polls its device")
    with Device() as other:
        other.then = silent
        never = {"after": 3600, "answer": "exception"}
        file = settings("b", url=other.url, stale=never)
        with Appliance(load(file), lease_times=LEASE_TIMES) as two:
            # From now on, the second node knows how old at most the values of the first one are.
            assert ask(two, "0600010001") == "0600010001"
            polls = len(device.peers)
            wire.until(lambda: len(device.peers) > polls + 5, "the first node goes on")
            assert ask(one, "0600000001") == "0600000001"
            wire.until(lambda: ask(two, "0300000001") == "03020001", "the second node has followed")
            assert [ask(each, "03000a0002") for each in (one, two)] == ["030400070008", "830b"]
            other.then = other._note
            wire.until(lambda: ask(two, "03000a0002") == "030400070008", "its device was read")


def test_replicas_shows_who_polls_what(settings: Callable[..., Path], device: Device) -> None:
    file = settings("a")
    command = RunCommand(file)
    try:
        command.wait_for_greeting()
        wire.until(lambda: device.connections == 1, "it polls")
        check_replicas(file)
    finally:
        command.end(signal.SIGTERM)


def check_replicas(file: Path) -> None:
    result = invoke("log", "status", str(file))
    assert result.exit_code == 0, result.output
    assert "polled by" in result.stdout
    [line] = [line for line in result.stdout.splitlines() if line.strip().startswith("meter")]
    assert line.split() == ["meter", "a"]
    result = invoke("log", "status", str(file), "--json")
    [status] = json.loads(result.stdout)["logs"].values()
    assert status["devices"] == {"meter": {"node": "a", "polled_here": True, "reason": None}}


def test_a_device_of_two_logs_is_refused(settings: Callable[..., Path]) -> None:
    reads = [read_into("plant"), read_into("other")]
    file = with_second_log(settings("a", reads=reads))
    with pytest.raises(ConfigError, match=r"devices\.meter: found memories of the logs "):
        load(file)


def test_devices_of_two_logs_at_one_address_are_refused(
    settings: Callable[..., Path], device: Device
) -> None:
    other = {"url": device.url, "unit": 2, "interval": 1, "timeout": 3}
    file = with_second_log(settings("a"))
    text = file.read_text()

    def add(**more: Any) -> None:
        added = json.dumps({**other, **more})
        file.write_text(text.replace('"devices": {', f'"devices": {{"other": {added}, '))

    add(reads=[read_into("plant", 30)])
    load(file)
    add(reads=[read_into("other")], enabled=False)
    load(file)
    add(reads=[read_into("other")])
    refused = r"devices\.meter: found a memory of the log 'site', allowed: one of 'second', as "
    with pytest.raises(ConfigError, match=refused):
        load(file)


def read_into(memory: str, address: int = 10) -> dict[str, Any]:
    into = {"memory": memory, "area": "holding_registers", "address": address}
    return {"area": "holding_registers", "address": 7, "count": 2, "into": into}


def with_second_log(file: Path) -> Path:
    """The file, with a memory `other` of a second log."""
    text = file.read_text()
    memory = '"other": {"holding_registers": 20, "replicate": {"log": "second"}}, '
    log = '"second": {"servers": ["nats://127.0.0.1:1"], "node": "a"}, '
    text = text.replace('"memories": {', f'"memories": {{{memory}')
    file.write_text(text.replace('"logs": {', f'"logs": {{{log}'))
    return file


def test_one_connection_has_one_name_however_it_is_written() -> None:
    def of(url: str) -> str:
        return connection_of(parse(url))

    assert of("tcp://PLC.local") == of("tcp://plc.local:502")
    assert of("tcp://[::ffff:10.0.0.5]") == of("tcp://10.0.0.5:502")
    assert of("rtu:///dev/ttyS0?baud=9600") == of("rtu:///dev/ttyS0")
    assert of("rtu+tcp://10.0.0.5") != of("tcp://10.0.0.5")

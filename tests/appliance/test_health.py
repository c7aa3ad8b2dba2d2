"""Probes: whether an appliance is live and ready, as its parts are."""

from __future__ import annotations

import json
import socket
import threading
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.adapters import Stop
from holdfast.appliance import Appliance, liveness
from holdfast.appliance.health import Health
from holdfast.appliance.liveness import MAIN_STALLED_S, STALLED_S, Liveness
from holdfast.appliance.parts.shared_logs import _obstacle
from holdfast.appliance.services.supervision import Supervisor
from holdfast.config import load
from holdfast.net.http import port
from holdfast.net.http.health import Check
from holdfast.net.http.port import Port
from support import web, wire
from support.brokers import NatsServer
from support.running import endpoint, log_events

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    import holdfast
    from holdfast.appliance.parts.part import Part
    from support.running import Run

LISTENER = """
memories: {plant: {holding_registers: 10%s}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: read-write}]
metrics: {bind: 127.0.0.1:0}
"""
PLANT = LISTENER % ""
DEVICES = """
devices:
  good: {url: "tcp://%s:%d", interval: 0.05, reads: [{area: holding_registers, address: 0, count: 1,
    into: {memory: plant, area: holding_registers, address: 0}}]}
  down: {url: "tcp://127.0.0.1:1", interval: 0.05, reads: [{area: holding_registers, address: 0,
    count: 1, into: {memory: plant, area: holding_registers, address: 1}}]}
"""


@pytest.fixture(autouse=True)
def short_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holdfast.appliance.appliance.CHECK_INTERVAL_S", 0.0)
    monkeypatch.setattr(port, "FIRST_PAUSE_S", 0.05)


def probe(appliance: Appliance, path: str = "ready") -> tuple[int, dict[str, Any]]:
    """The status of a probe, and its checks."""
    with closing(web.Client(endpoint(appliance, "metrics"))) as client:
        answer = client.get(f"/health/{path}")
    assert answer.json["ok"] == (answer.status == 200)
    checks: dict[str, Any] = answer.json["checks"]
    return answer.status, checks


def failed(appliance: Appliance) -> dict[str, str]:
    """The checks of readiness that fail, with their details."""
    _, checks = probe(appliance)
    return {name: check["detail"] for name, check in checks.items() if not check["ok"]}


def until_ready(appliance: Appliance) -> dict[str, Any]:
    found: dict[str, Any] = {}

    def is_ready() -> bool:
        log_events(appliance)
        status, checks = probe(appliance)
        found.update(checks)
        return status == 200

    wire.until(is_ready, "it is ready")
    return found


def test_it_is_ready_when_each_device_was_tried(run: Run, server: holdfast.Server) -> None:
    appliance = run(PLANT + DEVICES % server.address)
    assert failed(appliance) == {"devices": "not polled yet: down, good"}
    checks = until_ready(appliance)
    assert {name: check["detail"] for name, check in checks.items()} == {
        "running": "running",
        "threads": "all run",
        "listeners": "1 bound",
        "services": "1 serving",
        "devices": "2 polled, 1 without valid replies",
        "logs": "none",
    }
    assert probe(appliance, "live") == (200, {"threads": {"ok": True, "detail": "all run"}})


def test_new_settings_of_a_device_that_was_polled_do_not_make_it_unready(
    run: Run, server: holdfast.Server, tmp_path: Path
) -> None:
    appliance = run(PLANT + DEVICES % server.address)
    until_ready(appliance)
    file = tmp_path / "changed.yaml"
    file.write_text((PLANT + DEVICES % server.address).replace("0.05", "60"))
    assert set(appliance.reload(load(file))) == {"devices.good", "devices.down"}
    assert probe(appliance)[0] == 200
    file.write_text((PLANT + DEVICES % server.address).replace("good:", "other:"))
    appliance.reload(load(file))
    assert failed(appliance) == {"devices": "not polled yet: other"}
    until_ready(appliance)


def test_a_port_of_http_that_is_taken_makes_it_unready(run: Run) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        rest = "rest: {bind: 127.0.0.1:%d, sources: [127.0.0.0/8], tokens: none}\n"
        appliance = run(PLANT + rest % taken.getsockname()[1])
        assert failed(appliance) == {"services": "not serving: rest"}
        assert probe(appliance, "live")[0] == 200
    until_ready(appliance)


def test_the_gateway_answers_probes_without_a_token_and_without_names(run: Run) -> None:
    gateway = """
gateway:
  bind: 127.0.0.1:0
  sources: [127.0.0.0/8]
  allow: ["127.0.0.0/8:*"]
  access: read-only
  tokens: [{name: a, sha256: 2bb80d537b1da3e38bd30361aa855686bde0eacd7162fef6a25fe97bf527a25b}]
devices:
  secret-meter: {url: "tcp://127.0.0.1:1", interval: 60, tags: {on: {area: coils, address: 0}}}
"""
    appliance = run(gateway)
    with closing(web.Client(endpoint(appliance, "gateway"))) as client:
        assert client.get("/api/gateway").status == 401
        answer = client.get("/health/ready")
        assert (answer.status, answer.json["checks"]["devices"]) == (503, {"ok": False})
        assert b"secret-meter" not in answer.body
        assert client.ask("HEAD", "/health/live").status == 200
        assert client.ask("POST", "/health/live", b"").status == 405


@pytest.fixture
def nats(tmp_path: Path) -> Iterator[NatsServer]:
    (tmp_path / "nats").mkdir()
    server = NatsServer(tmp_path / "nats")
    yield server
    server.kill()


def test_a_node_that_is_behind_its_log_is_live_and_not_ready(run: Run, nats: NatsServer) -> None:
    log = json.dumps({"site": {"servers": [nats.url], "node": "a", "max_lag": 0.5}})
    appliance = run(LISTENER % ", replicate: {log: site}" + f"logs: {log}\n")
    until_ready(appliance)
    nats.freeze()
    try:
        wire.until(lambda: "logs" in failed(appliance), "it is behind")
        assert set(failed(appliance)) == {"logs"}
        assert failed(appliance)["logs"].startswith("site: ")
        assert appliance.replicas()["site"]["obstacle"] is not None
        assert probe(appliance, "live")[0] == 200
    finally:
        nats.thaw()
    until_ready(appliance)
    nats.kill()
    wire.until(lambda: failed(appliance).get("logs") == "site: not connected", "it has noticed")
    nats.start()
    until_ready(appliance)


FOLLOWS: dict[str, Any] = {
    "phase": "running",
    "failure": None,
    "connected": True,
    "contact_age": 1.0,
    "lag": 9,
}


@pytest.mark.parametrize(
    ("status", "why"),
    [
        ({}, None),
        ({"contact_age": 5.1}, "last contact 5.1 s ago, allowed 5 s"),
        ({"contact_age": None}, "no contact yet, allowed 5 s"),
        ({"connected": False}, "not connected"),
        ({"phase": "starting"}, "starting"),
        ({"phase": "failed", "failure": ("differs", "nats://u:p@h")}, "failed (differs)"),
    ],
)
def test_why_a_node_is_not_caught_up(status: Any, why: str | None) -> None:
    assert _obstacle(FOLLOWS | status, 5.0) == why


def test_probes_are_told_of_a_stop_that_waits(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    appliance = run(PLANT)
    until_ready(appliance)
    address = endpoint(appliance, "metrics")
    waits = threading.Event()
    monkeypatch.setattr(appliance._require_running().leases, "close", waits.wait)
    stopping = threading.Thread(target=appliance.stop)
    with closing(web.Client(address)) as client:
        stopping.start()
        try:
            wire.until(lambda: client.get("/health/ready").status == 503, "it is not ready")
            checks = client.get("/health/ready").json["checks"]
            assert checks["running"] == {"ok": False, "detail": "stopping"}
            assert client.get("/health/live").status == 200
            assert client.get("/metrics").status == 200
        finally:
            waits.set()
            stopping.join(wire.DEADLINE)
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(address, wire.DEADLINE)


class Clock:
    """A clock that a test sets."""

    now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(liveness, "time", made)
    return made


def test_a_main_thread_that_hangs_is_stalled_and_a_suspended_process_is_not(clock: Clock) -> None:
    ages = {"io": 0.5, "without a loop": 0.0}
    watched = Liveness(lambda: [(name, age, None) for name, age in ages.items()])
    clock.now += MAIN_STALLED_S
    assert watched.stalled() == []
    clock.now += 1
    assert watched.stalled() == ["main"]
    ages["io"] = MAIN_STALLED_S + 1.5
    assert watched.stalled() == []
    ages["io"] = 0.5
    watched.check()
    assert watched.stalled() == []


def test_the_watchdog_has_the_judgement_of_the_probe(
    run: Run, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    appliance = run(PLANT)
    running = appliance._require_running()
    wire.until(lambda: probe(appliance, "live")[0] == 200, "it is served")
    assert appliance.is_live
    monkeypatch.setattr(
        running.liveness, "_heartbeats", lambda: [("holdfast-poller", STALLED_S + 2, None)]
    )
    clock.now += 1
    running.liveness.check()
    stalled = {"ok": False, "detail": "stalled: holdfast-poller"}
    assert probe(appliance, "live") == (503, {"threads": stalled})
    assert failed(appliance) == {"threads": "stalled: holdfast-poller"}
    assert not appliance.is_live


def test_an_adapter_that_does_not_tell_its_status_holds_up_no_probe() -> None:
    told = threading.Event()

    class Stuck:
        def run(self, stop: Stop) -> None:
            stop.wait()

        def status(self) -> dict[str, object]:
            told.wait()
            return {}

    port = Port("rest", "127.0.0.1", 0)
    supervisor = Supervisor("rest", Stuck, port=port)
    assert not supervisor.serves()
    supervisor.start()
    wire.until(lambda: bool(supervisor.serves()), "it serves")
    supervisor.stop()
    supervisor.join()
    assert not supervisor.serves()
    port.close()
    assert Supervisor("mqtt", Stuck).serves() is None


def test_devices_that_another_node_polls_are_no_reason_to_wait() -> None:
    devices = {"a": "ok", "b": "error", "c": "standby", "d": "unknown"}
    nothing: Any = None
    unpolled: dict[str, str] = {}
    health = Health(nothing, nothing, {}, lambda: devices, lambda: unpolled, int)
    assert health._started() == Check(False, "not polled yet: d")
    devices["d"] = "standby"
    assert health._started() == Check(True, "2 polled, 1 without valid replies, 2 on standby")
    unpolled |= {"d": "no lease", "c": "no lease"}
    assert health._started() == Check(False, "polled by no node: c, d: no lease")


def test_a_part_that_fails_to_close_does_not_keep_the_others_open(run: Run) -> None:
    appliance = run(PLANT)
    running = appliance._running
    assert running is not None
    closed: list[Part] = []

    def close(part: Part, original: Callable[[], None]) -> None:
        original()
        closed.append(part)
        if len(closed) == 1:
            raise OSError("the first one")

    for part in running._parts:
        part.close = partial(close, part, part.close)  # type: ignore[method-assign]
    with pytest.raises(OSError, match="the first one"):
        appliance.stop()
    assert sorted(map(id, closed)) == sorted(map(id, running._parts))

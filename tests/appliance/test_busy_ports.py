"""Ports of HTTP services that can't be bound: Modbus is served, and the services follow later."""

from __future__ import annotations

import errno
import os
import signal
import socket
import threading
from contextlib import ExitStack, closing
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

from holdfast import _core
from holdfast.adapters import Stop
from holdfast.appliance.parts.listeners import GROUP
from holdfast.net.addresses import joined
from holdfast.net.http import port as ports
from holdfast.net.http.port import Port
from holdfast.runtime.text import file_error_text
from support import web, wire
from support.cli import RunCommand
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.running import Connect, Run

READ = bytes.fromhex("0300000001")
READ_REPLY = bytes.fromhex("03020000")
PATHS = {"rest": "/api/v1/health", "gateway": "/api/gateway", "metrics": "/metrics"}
BUSY = "Address already in use"
CONFIGURATION = """
memories: {{plant: {{holding_registers: 8}}}}
listeners:
  scada:
    type: modbus-tcp
    bind: {scada}
    rules: [{{sources: [127.0.0.0/8], units: {{1: plant}}, access: read-only}}]
rest: {{bind: "{rest}", sources: [127.0.0.0/8], tokens: none}}
gateway:
  bind: "{gateway}"
  sources: [127.0.0.0/8]
  allow: ["127.0.0.0/8:*"]
  access: read-only
  tokens: none
metrics: {{bind: "{metrics}"}}
"""


class Taken:
    """A port for each service, which another program uses until it is freed."""

    def __init__(self, stack: ExitStack) -> None:
        self.sockets = {
            name: stack.enter_context(socket.create_server(("127.0.0.1", 0))) for name in PATHS
        }
        self.addresses: dict[str, tuple[str, int]] = {
            name: each.getsockname() for name, each in self.sockets.items()
        }
        self.binds = {name: f"{host}:{port}" for name, (host, port) in self.addresses.items()}

    def configuration(self, scada: str = "127.0.0.1:0") -> str:
        return CONFIGURATION.format(scada=scada, **self.binds)


@pytest.fixture
def taken() -> Iterator[Taken]:
    with ExitStack() as stack:
        yield Taken(stack)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pauses that tests can wait for."""
    monkeypatch.setattr(ports, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(ports, "MAX_PAUSE_S", 0.02)


def status(appliance: Appliance, name: str) -> dict[str, Any]:
    found = appliance.diagnostics.adapter(name)
    assert found is not None
    return found


def get(address: tuple[str, int], path: str) -> web.Answer:
    with closing(web.Client(address)) as client:
        return client.get(path)


@pytest.mark.usefixtures("quick")
def test_modbus_is_served_and_each_service_follows_when_its_port_is_free(
    run: Run, connect: Connect, taken: Taken, log: web.Records
) -> None:
    appliance = run(taken.configuration())
    assert connect(endpoint(appliance, "scada")).ask(READ) == READ_REPLY
    for name, bind in taken.binds.items():
        of = partial(status, appliance, name)
        wire.until(lambda of=of: of()["failed_binds"] > 2, "it is retried")  # type: ignore[misc]
        assert {key: of()[key] for key in ("state", "listening", "restarts", "address")} == {
            "state": "failed",
            "listening": False,
            "restarts": 0,
            "address": bind,
        }
        assert of()["last_error"] == f"can't listen on {bind}: {BUSY}"
    assert [each.error for each in appliance.endpoints()] == [None, BUSY, BUSY, BUSY]

    for name, path in PATHS.items():
        of = partial(status, appliance, name)
        taken.sockets[name].close()
        wire.until(lambda of=of: of()["state"] == "running", "it runs")  # type: ignore[misc]
        assert get(taken.addresses[name], path).status == 200
        assert (of()["listening"], of()["last_error"], of()["restarts"]) == (True, None, 0)
    assert [each.error for each in appliance.endpoints()] == [None] * 4
    assert log.of("adapter_not_listening") == [
        {
            "event": "adapter_not_listening",
            "adapter": name,
            "bind": bind,
            "reason": BUSY,
            "attempts": 1,
            "retry_in": 0.01,
        }
        for name, bind in taken.binds.items()
    ]
    assert [each["listener"] for each in log.of("listening")] == ["scada", *PATHS]


@pytest.mark.usefixtures("quick")
def test_metrics_show_that_a_service_has_no_port(run: Run, taken: Taken) -> None:
    taken.sockets["metrics"].close()
    run(taken.configuration())
    text = get(taken.addresses["metrics"], "/metrics").body.decode()
    assert 'holdfast_adapter_state{adapter="rest",state="failed"} 1.0' in text
    assert 'holdfast_adapter_status{adapter="rest",field="listening"} 0.0' in text
    assert 'holdfast_adapter_status{adapter="metrics",field="listening"} 1.0' in text
    failed = 'holdfast_adapter_status{adapter="gateway",field="failed_binds"}'
    [count] = [float(line.split()[-1]) for line in text.splitlines() if line.startswith(failed)]
    assert count >= 1


def test_a_stop_ends_the_wait_for_a_port_at_once(
    run: Run, taken: Taken, log: web.Records, monkeypatch: pytest.MonkeyPatch
) -> None:
    for pause in ("FIRST_PAUSE_S", "MAX_PAUSE_S"):
        monkeypatch.setattr(ports, pause, 10 * wire.DEADLINE)
    appliance = run(taken.configuration())
    appliance.stop()
    assert log.of("adapter_does_not_stop") == []


def test_the_port_of_a_listener_still_fails_the_start_and_frees_the_others(
    run: Run, taken: Taken
) -> None:
    taken.sockets["rest"].close()
    bind = taken.binds["gateway"]
    with pytest.raises(OSError, match=f"listener scada.*{bind}"):
        run(taken.configuration(scada=bind).replace(f'"{bind}"', "127.0.0.1:0"))
    with socket.create_server(taken.addresses["rest"]):
        pass


@pytest.mark.parametrize(
    ("listener", "refused", "hint"),
    [
        ("bind: '127.0.0.1:502'", "can't listen on 127.0.0.1:502", f" ({ports.PRIVILEGE})"),
        ("bind: '127.0.0.1:1024'", "can't listen on 127.0.0.1:1024", ""),
        ("serial: {device: /dev/ttyS9}", "can't open /dev/ttyS9", f" ({GROUP})"),
    ],
)
def test_a_hint_says_what_a_listener_needs_that_may_not_be_opened(
    listener: str, refused: str, hint: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_: object) -> None:
        raise PermissionError(errno.EACCES, f"listener a: {refused}: Permission denied")

    monkeypatch.setattr(_core, "Engine", refuse)
    sources = "" if "serial" in listener else "sources: [127.0.0.1], "
    rules = f"[{{{sources}units: {{1: plant}}, access: read-only}}]"
    kind = "modbus-tcp" if sources else "modbus-rtu"
    with pytest.raises(PermissionError) as caught:
        run(
            "memories: {plant: {coils: 8}}\n"
            f"listeners: {{a: {{type: {kind}, {listener}, rules: {rules}}}}}"
        )
    assert file_error_text(caught.value) == f"listener a: {refused}: Permission denied{hint}"


def test_the_greeting_names_the_port_and_the_log_the_reason(taken: Taken, tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text(taken.configuration())
    command = RunCommand(file)
    address = command.wait_until_it_serves()
    with wire.Connection(address) as client:
        assert client.ask(READ) == READ_REPLY
    shown = (
        f"  rest     http://{taken.binds['rest']}\n             not served yet, retried: {BUSY}\n"
    )
    assert shown in command.greeting
    code, text = command.end(signal.SIGTERM)
    assert code == 0
    assert (
        f'error adapter_not_listening adapter=rest bind={taken.binds["rest"]} reason="{BUSY}"'
        in text
    )
    assert "Traceback" not in text


# Port


@pytest.fixture
def reasons(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The errors of the next attempts; the last one is repeated."""
    numbers: list[int] = []

    def listen(_host: str, _port: int) -> socket.socket:
        number = numbers.pop(0) if len(numbers) > 1 else numbers[0]
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(ports, "listen", listen)
    return numbers


class Clocked(Stop):
    """Does not wait, and is set after a number of pauses."""

    def __init__(self, most: int) -> None:
        super().__init__()
        self.most = most
        self.pauses: list[float] = []

    def wait(self, seconds: float | None = None) -> bool:
        assert seconds is not None
        self.pauses.append(seconds)
        if len(self.pauses) == self.most:
            self.set()
        return self.is_set()


def test_pauses_grow_up_to_ten_seconds(reasons: list[int]) -> None:
    reasons.append(errno.EADDRINUSE)
    port, stop = Port("rest", "127.0.0.1", 1), Clocked(7)
    assert not port.try_bind()
    assert not port.bind_when_free(stop)
    assert stop.pauses == [1, 2, 4, 8, 10, 10, 10]
    assert port.failures == 7


@pytest.mark.parametrize(
    ("number", "reason"),
    [
        (errno.EACCES, "Permission denied (ports below 1024 require a privilege"),
        (errno.EADDRNOTAVAIL, "Cannot assign requested address"),
        (errno.EAFNOSUPPORT, "Address family not supported by protocol"),
    ],
)
def test_any_error_is_logged_once_and_retried(
    number: int, reason: str, reasons: list[int], log: web.Records
) -> None:
    reasons.append(number)
    port = Port("rest", "::", 80)
    assert not port.try_bind()
    assert not port.bind_when_free(Clocked(5))
    [entry] = log.of("adapter_not_listening")
    assert entry["bind"] == "[::]:80"
    assert entry["reason"].startswith(reason)
    assert all(line.startswith("ERROR ") for line in log.lines)


def test_another_reason_and_a_long_time_are_logged_again(
    reasons: list[int], log: web.Records, monkeypatch: pytest.MonkeyPatch
) -> None:
    reasons += [errno.EADDRNOTAVAIL, *[errno.EADDRINUSE] * 3]
    port = Port("rest", "127.0.0.1", 80)
    assert not port.bind_when_free(Clocked(3))
    monkeypatch.setattr(ports, "LOG_INTERVAL_S", 0)
    assert not port.try_bind()
    assert [(each["reason"], each["attempts"]) for each in log.of("adapter_not_listening")] == [
        ("Cannot assign requested address", 1),
        (BUSY, 2),
        (BUSY, 4),
    ]


def test_an_address_that_this_machine_does_not_have_is_retried() -> None:
    port = Port("rest", "192.0.2.1", 0)  # An address for documentation.
    assert not port.try_bind()
    assert port.error == "Cannot assign requested address"


def test_a_port_that_was_never_bound_has_no_socket() -> None:
    port = Port("rest", "127.0.0.1", 0)
    with pytest.raises(RuntimeError, match=r"rest: 127\.0\.0\.1:0 is not bound"):
        _ = port.listener
    assert port.try_bind()
    stop = Stop()
    stop.set()
    assert not port.bind_when_free(stop)
    port.close()


def test_a_closed_port_still_has_a_status() -> None:
    """Programs may ask the diagnostics while the appliance stops, and after that."""
    port = Port("rest", "127.0.0.1", 0)
    assert port.try_bind()
    bound = port.status()
    assert (bound["listening"], bound["address"]) == (True, f"127.0.0.1:{port.address[1]}")
    port.close()
    assert port.status() == {"address": "127.0.0.1:0", "listening": False, "failed_binds": 0}


@pytest.mark.usefixtures("quick")
def test_a_wait_in_another_thread_ends_when_the_port_is_free(taken: Taken) -> None:
    port = Port("rest", *taken.addresses["rest"])
    assert not port.try_bind()
    stop, bound = Stop(), threading.Event()

    def wait() -> None:
        if port.bind_when_free(stop):
            bound.set()

    thread = threading.Thread(target=wait)
    thread.start()
    try:
        taken.sockets["rest"].close()
        assert bound.wait(wire.DEADLINE)
        assert port.listener.getsockname() == taken.addresses["rest"]
    finally:
        stop.set()
        thread.join()
        port.close()


def test_a_port_is_logged_once_whoever_finds_it_bound(log: web.Records) -> None:
    port = Port("rest", "127.0.0.1", 0)
    port.log_listening()
    assert log.of("listening") == []
    assert port.try_bind()
    for _ in range(2):
        port.log_listening()
    assert [each["address"] for each in log.of("listening")] == [joined(*port.address)]
    port.close()

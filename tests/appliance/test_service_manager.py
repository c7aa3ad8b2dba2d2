"""Notifications to systemd, as its protocol has them."""

from __future__ import annotations

import os
import signal
import socket
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.appliance import service_manager
from holdfast.appliance.service_manager import ServiceManager
from support import wire
from support.cli import RunCommand

if TYPE_CHECKING:
    from collections.abc import Iterator

    from support import web


pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no service manager")

CONFIGURATION = """
memories:
  plant: {holding_registers: 10}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: read-only}]
"""

READ = bytes.fromhex("0300000001")
READ_0 = bytes.fromhex("03020000")


class Manager:
    """The socket of a service manager."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.settimeout(wire.DEADLINE)
        self._socket.bind(f"\0{address[1:]}" if address[0] == "@" else address)

    def next(self) -> str:
        return self._socket.recv(4096).decode()

    def waiting(self) -> list[str]:
        """Returns what has arrived."""
        self._socket.setblocking(False)
        found = []
        try:
            while True:
                found.append(self.next())
        except BlockingIOError:
            return found
        finally:
            self._socket.settimeout(wire.DEADLINE)

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest) -> Iterator[Manager]:
    if request.param == "abstract" and sys.platform != "linux":
        pytest.skip("abstract names are those of Linux")
    with tempfile.TemporaryDirectory(prefix="hf") as folder:
        path = f"{folder}/notify"
        made = Manager(f"@{path}" if request.param == "abstract" else path)
        yield made
        made.close()


def test_systemd_is_notified_of_each_step(
    manager: Manager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(Path(manager.address.removeprefix("@")).parent))
    Path(manager.address.removeprefix("@")).parent.mkdir(exist_ok=True)
    monkeypatch.setenv("NOTIFY_SOCKET", manager.address)
    monkeypatch.setenv("WATCHDOG_USEC", "200000")
    file = tmp_path / "plant.yaml"
    file.write_text(CONFIGURATION)
    before = time.monotonic_ns() // 1000
    command = RunCommand(file)
    try:
        assert manager.next() == "READY=1"
        assert [manager.next(), manager.next()] == ["WATCHDOG=1", "WATCHDOG=1"]
        for text in (CONFIGURATION + "log: {level: debug}\n", "wrong"):
            file.write_text(text)
            command.process.send_signal(signal.SIGHUP)
            assert _next_but_watchdog(manager, before).startswith("RELOADING=1\nMONOTONIC_USEC=")
            assert _next_but_watchdog(manager, before) == "READY=1"
        code, log = command.end(signal.SIGTERM)
    finally:
        command.process.kill()
        command.process.communicate()
    assert (code, _next_but_watchdog(manager, before)) == (0, "STOPPING=1")
    assert manager.waiting() == []
    assert ("notify_failed" in log, "reload_refused" in log, " reloaded " in log) == (
        False,
        True,
        True,
    )


def test_the_watchdog_is_fed_while_a_file_does_not_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with tempfile.TemporaryDirectory(prefix="hf") as folder:
        manager = Manager(f"{folder}/notify")
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        monkeypatch.setenv("NOTIFY_SOCKET", manager.address)
        monkeypatch.setenv("WATCHDOG_USEC", "20000")
        file = tmp_path / "plant.yaml"
        file.write_text(CONFIGURATION)
        command = RunCommand(file)
        try:
            address = command.wait_until_it_serves()
            file.unlink()
            os.mkfifo(file)
            began = time.monotonic_ns() // 1000
            command.process.send_signal(signal.SIGHUP)
            while not manager.next().startswith("RELOADING=1"):
                pass
            assert [manager.next() for _ in range(5)] == ["WATCHDOG=1"] * 5
            with wire.Connection(address) as client:
                assert client.ask(READ) == READ_0
            with file.open("w") as writer:
                writer.write(CONFIGURATION)
            assert _next_but_watchdog(manager, began) == "READY=1"
            command.process.send_signal(signal.SIGHUP)
            while not manager.next().startswith("RELOADING=1"):
                pass
            code, log = command.end(signal.SIGTERM)
        finally:
            command.process.kill()
            command.process.communicate()
            manager.close()
    assert (code, log.count(" reloaded "), "Traceback" in log) == (0, 1, False)


def _next_but_watchdog(manager: Manager, began: int) -> str:
    while (message := manager.next()) == "WATCHDOG=1":
        pass
    if "MONOTONIC_USEC=" in message:
        told = int(message.partition("MONOTONIC_USEC=")[2])
        assert began <= told <= time.monotonic_ns() // 1000
    return message


def test_the_watchdog_is_fed_at_half_of_its_time(
    manager: Manager, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0

    class Clock:
        @staticmethod
        def monotonic() -> float:
            return now

    monkeypatch.setattr(service_manager, "time", Clock)
    own = ServiceManager(
        {
            "NOTIFY_SOCKET": manager.address,
            "WATCHDOG_USEC": "30000000",
            "WATCHDOG_PID": str(os.getpid()),
        }
    )
    fed = []
    for now in (1000.0, 1014.9, 1015.0, 1029.9, 1030.1):  # noqa: B007
        own.feed_watchdog()
        fed.append(manager.waiting())
    own.close()
    assert fed == [["WATCHDOG=1"], [], ["WATCHDOG=1"], [], ["WATCHDOG=1"]]


def test_a_stalled_thread_starves_the_watchdog(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop of `run` feeds it only while the appliance is live."""
    from holdfast.cli.services import run as command

    steps: list[str] = []

    class Appliance:
        def __init__(self, _: object, **_more: object) -> None:
            self.live = iter([True, False, True])
            self.is_live = False
            self.lost_writes = 0

        def start(self) -> None:
            steps.append("start")

        def stop(self) -> None:
            steps.append("stop")

        def log_events(self, timeout: float) -> None:
            assert timeout
            self.is_live = next(self.live)
            steps.append(f"live {self.is_live}")

    class Signals:
        def __init__(self, **_: object) -> None:
            pass

        @staticmethod
        def interrupting() -> nullcontext[None]:
            return nullcontext()

        @property
        def received(self) -> bool:
            return len([step for step in steps if step.startswith("live")]) == 3

    class Recorder:
        def __getattr__(self, name: str) -> Any:
            return lambda: steps.append(name)

    monkeypatch.setattr(command, "Appliance", Appliance)
    monkeypatch.setattr(command, "Signals", Signals)
    monkeypatch.setattr(command, "ServiceManager", Recorder)
    for skipped in ("allow_open_files", "lengthen_switch_interval"):
        monkeypatch.setattr(command, skipped, lambda *_: 0)
    monkeypatch.setattr(command, "freeze_garbage_collector", lambda: steps.append("freeze"))
    monkeypatch.setattr("holdfast.events.log_lines.configure", lambda *_: None)
    log = SimpleNamespace(level="info", format="text")
    settings: Any = SimpleNamespace(log=log, warnings=())
    command.serve(settings, lambda _: "served")
    assert steps == [
        "start",
        "freeze",
        "ready",
        "live True",
        "feed_watchdog",
        "live False",
        "live True",
        "feed_watchdog",
        "stopping",
        "stop",
        "close",
    ]


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"WATCHDOG_USEC": "1"},
        {"NOTIFY_SOCKET": ""},
    ],
)
def test_without_a_service_manager_nothing_happens(
    environment: dict[str, str], log: web.Records
) -> None:
    own = ServiceManager(environment)
    own.ready()
    own.feed_watchdog()
    with own.reloading():
        pass
    own.stopping()
    own.close()
    assert log.of("notify_failed") == []


@pytest.mark.parametrize(
    "watchdog",
    [{}, {"WATCHDOG_USEC": "many"}, {"WATCHDOG_USEC": "1", "WATCHDOG_PID": "1"}],
    ids=["none", "not a number", "of another process"],
)
def test_a_watchdog_that_is_not_ours_is_not_fed(manager: Manager, watchdog: dict[str, str]) -> None:
    own = ServiceManager({"NOTIFY_SOCKET": manager.address, **watchdog})
    own.feed_watchdog()
    own.ready()
    own.close()
    assert manager.waiting() == ["READY=1"]


@pytest.mark.parametrize("address", ["vsock:2:1", "relative/path", "/nowhere/notify"])
def test_an_address_that_can_t_be_used_is_logged(address: str, log: web.Records) -> None:
    own = ServiceManager({"NOTIFY_SOCKET": address})
    own.ready()
    own.close()
    [logged] = log.of("notify_failed")
    assert address in str(logged["reason"])


def test_a_service_manager_that_has_gone_is_logged_once(manager: Manager, log: web.Records) -> None:
    own = ServiceManager({"NOTIFY_SOCKET": manager.address})
    manager.close()
    own.ready()
    own.stopping()
    own.close()
    assert len(log.of("notify_failed")) == 1

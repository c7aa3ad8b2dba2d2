"""Adapters: supervised each for itself, and those of others by entry point."""

from __future__ import annotations

import re
import socket
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from holdfast import Memory
from holdfast.adapters import Grant, MemoryAccess, Refused, Stop
from holdfast.adapters.plugins import UnknownAdapter
from holdfast.appliance.services import supervision as supervisor
from holdfast.appliance.services.supervision import Supervisor
from support import wire
from support.cli import invoke
from support.paths import EXAMPLES
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator

    from support.running import Connect, Run

EXAMPLE = EXAMPLES / "adapter"

CONFIGURATION = """
memories:
  plant: {{input_registers: 10, coils: 8}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{{sources: [127.0.0.0/8], units: {{1: plant}}, access: read-only}}]
adapters:
  text:
    type: {type}
    memories: [plant]
    areas: [input_registers]
    access: {access}
    options: {{port: {port}}}
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example adapter, as an installer would leave it."""
    folder = tmp_path / "site"
    metadata = folder / "holdfast_datagrams-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: holdfast-datagrams\n")
    project = (EXAMPLE / "pyproject.toml").read_text()
    entry = re.search(r'holdfast\.adapters"\]\ndatagrams = "(.*)"', project)
    assert entry
    (metadata / "entry_points.txt").write_text(f"[holdfast.adapters]\ndatagrams = {entry[1]}\n")
    monkeypatch.syspath_prepend(str(EXAMPLE))
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "holdfast_datagrams", raising=False)


@pytest.fixture
def port() -> int:
    with socket.socket(type=socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port: int = free.getsockname()[1]
        return port


def counted(appliance: object) -> dict[str, object]:
    status = appliance.diagnostics.adapter("text")  # type: ignore[attr-defined]
    assert isinstance(status, dict)
    return status


@pytest.mark.usefixtures("installed")
def test_the_example_adapter_writes_what_it_is_sent(run: Run, connect: Connect, port: int) -> None:
    appliance = run(CONFIGURATION.format(type="datagrams", access="read-write", port=port))
    wire.until(lambda: counted(appliance)["state"] == "running", "the adapter runs")
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        wire.until(
            lambda: (
                sender.sendto(b"2 231 17", ("127.0.0.1", port))
                and counted(appliance)["accepted"] != 0
            ),
            "a datagram is accepted",
        )
        client = connect(endpoint(appliance, "scada"))
        assert client.ask(bytes.fromhex("0400020002")) == bytes.fromhex("040400e70011")
        before = appliance.memories["plant"].read("input_registers", 0, 10)
        for bad in (b"2 70000", b"9 1 2", b"2", b"garbage"):
            sender.sendto(bad, ("127.0.0.1", port))
        wire.until(lambda: len(counted(appliance)["refused"]) == 3, "all are refused")  # type: ignore[arg-type]
        assert counted(appliance)["refused"] == {
            "invalid_value": 1,
            "out_of_range": 1,
            "malformed": 1,
        }
    assert appliance.memories["plant"].read("input_registers", 0, 10) == before


@pytest.mark.usefixtures("installed")
def test_the_documented_adapter_is_the_example() -> None:
    page = (EXAMPLE.parent.parent / "docs" / "adapters.md").read_text()
    assert (EXAMPLE / "holdfast_datagrams.py").read_text() in page


@pytest.mark.usefixtures("installed")
def test_an_adapter_without_the_right_writes_nothing(run: Run, port: int) -> None:
    appliance = run(CONFIGURATION.format(type="datagrams", access="read-only", port=port))
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        wire.until(
            lambda: sender.sendto(b"2 231", ("127.0.0.1", port)) and counted(appliance)["refused"],
            "it is refused",
        )
    assert appliance.memories["plant"].read("input_registers", 2, 1) == [0]


def test_an_adapter_that_is_not_installed_is_told(run: Run, port: int, tmp_path: Path) -> None:
    text = CONFIGURATION.format(type="nonesuch", access="read-only", port=port)
    with pytest.raises(UnknownAdapter, match=r"adapters\.text\.type: found 'nonesuch', installed"):
        run(text)
    file = tmp_path / "plant.yaml"
    file.write_text(text)
    result = invoke("run", str(file))
    assert result.exit_code == 2
    assert f"holdfast: {file}: adapters.text.type: found 'nonesuch', inst" in result.stderr


class Scripted:
    """An adapter that does what it is told, and says when it runs."""

    def __init__(self, failures: int) -> None:
        self.failures = failures
        self.made = 0
        self.running = threading.Event()

    def __call__(self) -> Scripted:
        self.made += 1
        if self.made == 2:
            raise OSError("no way to make it")
        return self

    def run(self, stop: Stop) -> None:
        if self.made <= self.failures:
            raise ValueError(f"failure {self.made}")
        self.running.set()
        stop.wait()

    def status(self) -> dict[str, object]:
        if self.made == 1:
            raise RuntimeError("no status")
        return {"made": self.made}


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pauses that tests can wait for."""
    monkeypatch.setattr(supervisor, "FIRST_PAUSE_S", 0.001)


@pytest.fixture
def supervised() -> Iterator[list[Supervisor]]:
    running: list[Supervisor] = []
    yield running
    for each in running:
        each.stop()
    for each in running:
        each.join()
        assert each.status()["state"] == "stopped"


@pytest.mark.usefixtures("quick")
def test_an_adapter_that_fails_is_made_anew_and_others_do_not_notice(
    supervised: list[Supervisor], caplog: pytest.LogCaptureFixture
) -> None:
    failing, steady = Scripted(failures=4), Scripted(failures=0)
    supervised += [Supervisor("failing", failing), Supervisor("steady", steady)]
    for each in supervised:
        each.start()
    assert failing.running.wait(wire.DEADLINE)
    assert steady.running.wait(wire.DEADLINE)
    status = supervised[0].status()
    assert (status["state"], status["restarts"], status["made"]) == ("running", 4, 5)
    assert status["last_error"] == "ValueError: failure 4"
    assert supervised[1].status()["restarts"] == 0
    failures = [each for each in caplog.records if each.message == "adapter_failed"]
    errors = [record.exc_info[1] for record in failures if record.exc_info]
    assert [str(error) for error in errors if error] == [
        "failure 1",
        "no way to make it",
        "failure 3",
        "failure 4",
    ]


def test_pauses_grow_up_to_a_minute(
    supervised: list[Supervisor], monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses: list[float] = []
    enough = threading.Event()

    class Clocked(Stop):
        def wait(self, seconds: float | None = None) -> bool:
            if seconds is None:
                return super().wait()
            pauses.append(seconds)
            if len(pauses) == 9:
                enough.set()
                return super().wait()
            return False

    monkeypatch.setattr(supervisor, "Stop", Clocked)
    supervised.append(Supervisor("failing", Scripted(failures=99)))
    supervised[0].start()
    assert enough.wait(wire.DEADLINE)
    assert pauses == [1, 2, 4, 8, 16, 32, 60, 60, 60]


@pytest.mark.usefixtures("quick")
def test_an_adapter_that_ends_by_itself_has_failed(supervised: list[Supervisor]) -> None:
    class Ending(Scripted):
        def run(self, stop: Stop) -> None:
            if self.made > 2:
                super().run(stop)

    ending = Ending(failures=0)
    supervised.append(Supervisor("ending", ending))
    supervised[0].start()
    assert ending.running.wait(wire.DEADLINE)
    assert supervised[0].status()["restarts"] == 2


@pytest.mark.usefixtures("quick")
def test_an_adapter_that_may_end_is_made_anew_after_failures_only(
    supervised: list[Supervisor], caplog: pytest.LogCaptureFixture
) -> None:
    class Ending(Scripted):
        def run(self, stop: Stop) -> None:
            if self.made <= self.failures:
                super().run(stop)

    ending = Ending(failures=3)
    caplog.set_level("INFO")
    supervised.append(Supervisor("ending", ending, may_end=True))
    supervised[0].start()
    wire.until(lambda: ending.made == 4, "it is made anew")
    wire.until(lambda: supervised[0].status()["state"] == "stopped", "it has ended")
    assert (ending.made, supervised[0].status()["restarts"]) == (4, 3)
    assert [each.message for each in caplog.records].count("adapter_stopped") == 1


def test_a_status_that_raises_is_left_out(supervised: list[Supervisor]) -> None:
    steady = Scripted(failures=0)
    supervised.append(Supervisor("steady", steady))
    supervised[0].start()
    assert steady.running.wait(wire.DEADLINE)
    assert supervised[0].status() == {"state": "running", "restarts": 0, "last_error": None}


def test_an_adapter_that_does_not_stop_is_left_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor, "STOP_TIMEOUT_S", 0.01)
    free = threading.Event()

    class Stubborn(Scripted):
        def run(self, stop: Stop) -> None:  # noqa: ARG002
            self.running.set()
            free.wait(wire.DEADLINE)

    stubborn = Stubborn(failures=0)
    supervised = Supervisor("stubborn", stubborn)
    supervised.start()
    assert stubborn.running.wait(wire.DEADLINE)
    supervised.stop()
    supervised.join()
    free.set()
    supervised.join()


def test_what_is_to_be_called_at_the_stop_is_called_once() -> None:
    stop, called = Stop(), []
    stop.then(lambda: called.append(1))
    assert not stop.wait(0)
    stop.set()
    stop.set()
    stop.then(lambda: called.append(2))
    assert (stop.is_set(), called) == (True, [1, 2])


def test_a_door_writes_all_memories_or_none() -> None:
    one, two = Memory(holding_registers=4), Memory(coils=4)
    memory_access = MemoryAccess("test", {"one": one, "two": two})
    grant = Grant("me", ("one", "two"), ("holding_registers", "coils"))
    good = {"memory": "one", "area": "holding_registers", "address": 0, "values": [1, 2]}
    bits = {"memory": "two", "area": "coils", "address": 2, "bools": [True, 1]}
    assert memory_access.write([good, bits], grant, "-").answer() == {
        "status": "accepted",
        "commands": 2,
        "written": 4,
    }
    with pytest.raises(Refused, match=r"commands\[1\]: values\[1\] is 2"):
        memory_access.write([good | {"values": [9, 9]}, bits | {"bools": [0, 2]}], grant, "-")
    assert one.read("holding_registers", 0, 4) == [1, 2, 0, 0]
    assert two.read("coils", 0, 4) == [0, 0, 1, 1]

"""`holdfast run` as a user has it: a process, its output, its signals, its exit codes."""

from __future__ import annotations

import json
import re
import signal
import socket
from typing import TYPE_CHECKING

import pytest

from support import wire
from support.audits import writes
from support.cli import RunCommand

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

CONFIGURATION = """
memories:
  plant: {{holding_registers: 100, coils: 8, initial: values.csv}}
listeners:
  scada:
    type: modbus-tcp
    bind: {bind}
    rules:
      - {{sources: [{sources}], units: {{1: plant}}, access: read-write}}
{more}
"""

READ_TWO = bytes.fromhex("0300000002")


@pytest.fixture
def configure(tmp_path: Path) -> Callable[..., Path]:
    """Writes a configuration, in a folder whose name has a space."""

    def write(*, bind: str = "127.0.0.1:0", sources: str = "127.0.0.0/8", more: str = "") -> Path:
        folder = tmp_path / "a plant"
        folder.mkdir(exist_ok=True)
        (folder / "values.csv").write_text("holding_registers,1,7\n")
        file = folder / "plant.yaml"
        file.write_text(CONFIGURATION.format(bind=bind, sources=sources, more=more))
        return file

    return write


@pytest.fixture
def run() -> Iterator[Callable[[Path], RunCommand]]:
    started: list[RunCommand] = []

    def start(file: Path) -> RunCommand:
        started.append(RunCommand(file))
        return started[-1]

    yield start
    for each in started:
        each.process.kill()
        each.process.communicate()


def test_it_says_what_listens_where_and_what_to_try(
    configure: Callable[..., Path], run: Callable[[Path], RunCommand]
) -> None:
    running = run(configure())
    _, port = running.wait_until_it_serves()
    assert "units 1 = plant; read-write for 127.0.0.0/8" in running.greeting
    read, write, check = running.greeting.split("Try:")[1].splitlines()[2:5]
    assert read == f"  mbpoll -m tcp -p {port} -a 1 -0 -t 4 -r 0 -c 5 -1 127.0.0.1"
    assert write == f"  mbpoll -m tcp -p {port} -a 1 -0 -t 4 -r 0 127.0.0.1 1"
    assert check.endswith("plant.yaml'")
    assert " check '" in check


def test_it_says_what_is_polled(
    configure: Callable[..., Path], run: Callable[[Path], RunCommand]
) -> None:
    reads = "reads: [{area: coils, address: 0, count: 1}]"
    forward = "forward: [{url: 'raw://127.0.0.1:1', unit: 1}]"
    devices = "".join(
        f"  meter{number}: {{url: 'tcp://127.0.0.1:1', unit: {number}, interval: 0.5, {reads}, "
        f"{forward}, enabled: {'true' if number else 'false'}}}\n"
        for number in range(12)
    )
    running = run(configure(more=f"devices:\n{devices}"))
    running.wait_until_it_serves()
    assert "  meter0  tcp://127.0.0.1:1 unit 0, not polled\n" in running.greeting
    assert "  meter9  tcp://127.0.0.1:1 unit 9, polled every 0.5 s\n" in running.greeting
    assert "  and 2 more devices\n" in running.greeting
    assert "meter10" not in running.greeting


def test_it_says_what_rights_a_unit_has_of_its_own(
    tmp_path: Path, run: Callable[[Path], RunCommand]
) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text("""
memories: {plant: {coils: 8, holding_registers: 10}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules:
      - sources: [127.0.0.0/8]
        access: read-write
        units:
          1: {memory: plant, deny: [6], read: [{area: holding_registers, start: 2, end: 4}]}
          2: {memory: plant, access: read-only, functions: [1, 3]}
""")
    running = run(file)
    _, port = running.wait_until_it_serves()
    assert (
        "    units 1 = plant (deny 6; reads holding registers 2 to 4), 2 = plant (read-only; "
        "functions 1, 3); read-write for 127.0.0.0/8\n"
    ) in running.greeting
    assert f"  mbpoll -m tcp -p {port} -a 1 -0 -t 4 -r 2 -c 3 -1 127.0.0.1\n" in running.greeting


def test_it_says_what_routes_lead_to(tmp_path: Path, run: Callable[[Path], RunCommand]) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text("""
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules:
      - sources: [127.0.0.0/8]
        units: {"20-40": {route: bus_1}, 7: {route: drive}}
        access: read-write
devices:
  drive: {url: "tcp://127.0.0.1:1", unit: 3}
links:
  bus_1: {url: "rtu:///dev/none?baud=9600"}
""")
    running = run(file)
    _, port = running.wait_until_it_serves()
    assert "    units 20-40 = bus_1, 7 = drive; read-write for 127.0.0.0/8\n" in running.greeting
    assert "  bus_1  rtu:///dev/none?baud=9600\n" in running.greeting
    assert "  drive  tcp://127.0.0.1:1 unit 3, by routes only\n" in running.greeting
    assert f"  mbpoll -m tcp -p {port} -a 20 -0 -t 4 -r 0 -c 1 -1 127.0.0.1\n" in running.greeting


def test_it_serves_the_initial_values(
    configure: Callable[..., Path], run: Callable[[Path], RunCommand]
) -> None:
    with wire.Connection(run(configure()).wait_until_it_serves()) as client:
        assert client.ask(READ_TWO) == bytes.fromhex("030400000007")


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        signal.SIGTERM,
        signal.SIGQUIT,
        signal.SIGUSR1,
        signal.SIGUSR2,
        signal.SIGALRM,
        signal.SIGVTALRM,
        signal.SIGPROF,
        signal.SIGIO,
        signal.SIGPWR,
        signal.SIGXCPU,
    ],
)
def test_a_signal_ends_it_with_exit_code_0(
    configure: Callable[..., Path], run: Callable[[Path], RunCommand], number: signal.Signals
) -> None:
    running = run(configure())
    with wire.Connection(running.wait_until_it_serves()) as client:
        assert client.ask(READ_TWO)
        code, log = running.end(number)
    assert code == 0
    assert "stopped" in log
    assert "Traceback" not in log


def test_a_reader_of_the_log_that_stops_reading_holds_up_nobody(
    configure: Callable[..., Path], run: Callable[[Path], RunCommand]
) -> None:
    """Its pipe is full after a few hundred lines."""
    file = configure()
    file.write_text(f"{file.read_text()}log: {{level: debug}}\n")
    running = run(file)
    port = running.wait_until_it_serves()
    for _ in range(3000):
        with wire.Connection(port) as client:
            assert client.ask(READ_TWO) == bytes.fromhex("030400000007")
    running.process.send_signal(signal.SIGTERM)
    assert running.process.wait(wire.DEADLINE) == 0


def test_a_signal_loses_no_line_of_the_audit_log(
    configure: Callable[..., Path], run: Callable[[Path], RunCommand]
) -> None:
    file = configure()
    file.write_text(f"{file.read_text()}audit: {{file: audit.log}}\n")
    running = run(file)
    with wire.Connection(running.wait_until_it_serves()) as client:
        client.ask_many([bytes.fromhex("06000101f4")] * 20_000)
        code, _ = running.end(signal.SIGQUIT)
    assert code == 0
    assert len(writes(file.parent / "audit.log")) == 20_000


def test_a_port_that_is_taken_is_one_line_that_names_listener_and_port(
    configure: Callable[..., Path], run: Callable[[Path], RunCommand]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        process = run(configure(bind=f"127.0.0.1:{port}")).process
        out, log = process.communicate(timeout=wire.DEADLINE)
    assert process.returncode == 1
    assert out == ""
    assert log.count("\n") == 1
    assert "listener scada" in log
    assert f"127.0.0.1:{port}" in log


def test_a_wrong_configuration_is_all_its_errors_and_exit_code_2(
    configure: Callable[..., Path], run: Callable[[Path], RunCommand]
) -> None:
    file = configure(bind="localhost", sources="10.0.0.1/8", more="worker: 2")
    process = run(file).process
    out, log = process.communicate(timeout=wire.DEADLINE)
    assert process.returncode == 2
    assert out == ""
    for line, key in [(7, "bind"), (9, "sources"), (10, "worker")]:
        assert re.search(rf"plant\.yaml:{line}\b.*{key}", log), log


def test_a_stranger_is_closed_and_logged_with_listener_and_address(
    configure: Callable[..., Path], run: Callable[[Path], RunCommand]
) -> None:
    running = run(configure(sources="127.0.0.2", more="log: {format: json}"))
    address = running.wait_until_it_serves()
    with socket.create_connection(address, timeout=wire.DEADLINE) as stranger:
        peer = f"127.0.0.1:{stranger.getsockname()[1]}"
        assert stranger.recv(1) == b""
        # A listener's refusals are logged in the order they come, and before the process ends.
        assert running.process.stderr is not None
        entries = [json.loads(running.process.stderr.readline()) for _ in range(3)]
    assert entries[2] == {
        "time": entries[2]["time"],
        "level": "warning",
        "event": "refused_source",
        "listener": "scada",
        "peer": peer,
    }

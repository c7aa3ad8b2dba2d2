"""What commands import: a command of a device must not wait for what only services need."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from holdfast.simulation import HEATER

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import holdfast

HEAVY = {
    "asyncio",
    "concurrent.futures",
    "cryptography",
    "email",
    "google",
    "holdfast.appliance",
    "holdfast.config",
    "holdfast.config.schema",
    "holdfast.tags",
    "http",
    "logging",
    "msgspec",
    "multiprocessing",
    "nats",
    "paho",
    "prometheus_client",
    "pydantic",
    "rich",
    "ruamel",
    "ssl",
    "uvloop",
}
"""Modules that take several milliseconds to import, and those that bring such modules."""

CONFIGURATION = {"holdfast.config", "pydantic", "ruamel"}
OWN = {"holdfast.appliance", "holdfast.config", "holdfast.tags", "logging"}

PLANT = """
memories: {plant: {holding_registers: 8}}
listeners:
  modbus:
    type: modbus-tcp
    bind: "127.0.0.1:0"
    rules: [{sources: [127.0.0.1], units: {1: plant}, access: read-only}]
"""

PROGRAM = """
import sys
from holdfast.cli import main
try:
    main(prog_name="holdfast")
finally:
    sys.stdout.flush()
    print("".join(f"\\n{name}" for name in sys.modules), file=sys.stderr)
"""


def heavy_after(program: str, *arguments: str, **variables: str) -> tuple[str, set[str]]:
    """What a program prints, and which heavy modules it has imported at its end."""
    ran = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        env=variables,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert "Traceback" not in ran.stderr, ran.stderr
    return ran.stdout, HEAVY & set(ran.stderr.splitlines())


@pytest.fixture(scope="module")
def server() -> Iterator[holdfast.Server]:
    import holdfast

    memory = holdfast.Memory(coils=8, holding_registers=8)
    with holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as running:
        yield running


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["--version"],
        ["--completion", "bash"],
        ["read", "--help"],
        ["write", "--help"],
        ["watch", "--help"],
    ],
    ids=" ".join,
)
def test_help_imports_nothing_heavy(arguments: list[str]) -> None:
    printed, heavy = heavy_after(PROGRAM, *arguments)
    assert printed
    assert heavy == set()


@pytest.mark.parametrize(
    "arguments",
    [
        ["read", "URL", "hr", "0", "4"],
        ["read", "URL", "hr", "0", "--type", "float32"],
        ["read", "URL", "coils", "0", "--json"],
        ["write", "URL", "hr", "1", "7", "--verify"],
        ["write", "URL", "coils", "1", "on"],
    ],
    ids=" ".join,
)
def test_reading_and_writing_a_device_imports_nothing_heavy(
    arguments: list[str], server: holdfast.Server
) -> None:
    port = server.address[1]
    words = [f"tcp://127.0.0.1:{port}" if word == "URL" else word for word in arguments]
    printed, heavy = heavy_after(PROGRAM, *words)
    assert printed
    assert heavy == set()


def test_watching_a_device_imports_nothing_heavy_but_the_clock_of_the_log(
    server: holdfast.Server,
) -> None:
    port = server.address[1]
    words = ["watch", f"tcp://127.0.0.1:{port}", "hr", "0", "4", "--every", "0.01", "--times", "2"]
    assert heavy_after(PROGRAM, *words)[1] <= {"logging"}


def test_places_with_types_import_tags_and_no_configuration(server: holdfast.Server) -> None:
    words = ["read", f"tcp://127.0.0.1:{server.address[1]}", "hr:0:float32", "hr:2"]
    printed, heavy = heavy_after(PROGRAM, *words)
    assert "hr:2" in printed
    assert not heavy & CONFIGURATION


def test_tags_of_a_file_import_no_appliance(server: holdfast.Server) -> None:
    url = f"tcp://127.0.0.1:{server.address[1]}"
    words = ["read", url, "--tags", str(HEATER), "--only", "setpoint"]
    printed, heavy = heavy_after(PROGRAM, *words)
    assert "setpoint" in printed
    assert "holdfast.appliance" not in heavy


def test_a_search_imports_no_model_of_a_configuration() -> None:
    printed, heavy = heavy_after(PROGRAM, "find", "--help")
    assert printed
    assert not heavy & {"pydantic", "ruamel"}


def test_an_appliance_with_a_memory_and_a_listener_imports_no_event_loop(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text(PLANT)
    program = """
import sys
from holdfast.cli.services.run import Appliance
from holdfast.config import load
with Appliance(load(sys.argv[1])) as appliance:
    print(appliance.endpoints()[0].name)
print(*sys.modules, sep="\\n", file=sys.stderr)
"""
    printed, heavy = heavy_after(program, str(file))
    assert printed == "modbus\n"
    assert heavy <= {"email", "pydantic", *OWN}


def test_a_configuration_does_not_read_its_own_source() -> None:
    program = (
        "import linecache; from holdfast.config import Config; print(Config, *linecache.cache)"
    )
    printed = heavy_after(program)[0]
    assert "Config" in printed
    assert "/models/" not in printed


@pytest.mark.parametrize(
    "line",
    [
        "holdfast re",
        "holdfast ",
        "holdfast read --ti",
        "holdfast write --",
        "holdfast watch tcp://plc ho",
    ],
)
def test_completing_a_line_imports_nothing_heavy(line: str) -> None:
    printed, heavy = heavy_after(
        PROGRAM,
        _HOLDFAST_COMPLETE="bash_complete",
        COMP_WORDS=line,
        COMP_CWORD=str(line.count(" ")),
    )
    assert printed
    assert heavy == set()


def test_the_library_imports_what_is_used() -> None:
    program = "import sys, holdfast; {}; print(*sys.modules, sep='\\n', file=sys.stderr)"
    assert heavy_after(program.format("holdfast.__version__"))[1] == set()
    assert heavy_after(program.format("holdfast.SyncClient('tcp://plc')"))[1] == set()
    assert "asyncio" in heavy_after(program.format("holdfast.Client"))[1]


@pytest.mark.parametrize(
    "name",
    ["polling.WriteFailed", "polling.faults.WITHDRAWN", "raw_ingest.send", "server.Identity"],
)
def test_the_library_imports_its_modules_by_their_names(name: str) -> None:
    program = f"import holdfast; holdfast.{name}"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_the_library_requires_msgspec_only() -> None:
    program = """
import sys
from importlib.metadata import packages_distributions
for name in packages_distributions():
    if name not in ("holdfast", "msgspec"):
        sys.modules.setdefault(name, None)
import holdfast
for name in holdfast.__all__:
    if name != "load_tags":
        getattr(holdfast, name)
memory = holdfast.Memory(holding_registers=8)
tags = holdfast.TagList([holdfast.Tag("level", "holding_registers", 0, "float32")])
with holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as server:
    with holdfast.SyncClient(f"tcp://127.0.0.1:{server.address[1]}") as client:
        client.write("holding_registers", 0, 21.5, "float32")
        print(client.read("holding_registers", 0, "float32"))
"""
    assert heavy_after(program)[0] == "21.5\n"

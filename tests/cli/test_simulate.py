"""`holdfast simulate`, as people use it."""

from __future__ import annotations

import json
import re
import shlex
import signal
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest

from holdfast.simulation import HEATER as HEATER_WITHOUT_FILE
from support import wire
from support.cli import ServingCommand, answer, done, invoke, usage_error
from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

HEATER = str(ROOT / "examples" / "tags" / "heater.yaml")


@pytest.fixture
def simulate() -> Iterator[Callable[..., tuple[ServingCommand, str]]]:
    running = []

    def start(*arguments: str) -> tuple[ServingCommand, str]:
        command = ServingCommand("simulate", *arguments, "--bind", ":0", "--every", "0.01")
        running.append(command)
        found = re.search(r"tcp://\S+:\d+", command.wait_for_greeting())
        assert found is not None, command.greeting
        return command, found[0]

    yield start
    for command in running:
        command.process.kill()
        command.process.communicate()


def test_the_example_is_simulated_read_and_written(
    simulate: Callable[..., tuple[ServingCommand, str]],
) -> None:
    command, url = simulate(HEATER)
    quoted = shlex.quote(HEATER)
    assert f"  holdfast watch {url} --tags {quoted}\n" in command.greeting
    assert f"  holdfast write {url} setpoint=17.5 --tags {quoted}\n" in command.greeting
    tags = ("--tags", HEATER)
    first = answer("read", url, *tags)["values"]
    assert 225 <= first["voltage"] <= 235
    assert first["setpoint"] == 17.5
    wire.until(lambda: answer("read", url, *tags)["values"] != first, "values change")
    words = ("setpoint=21.5", "mode=eco", "pump=on", "--verify")
    assert done("write", url, *words, *tags)[-1] == "Read back alike."
    now = answer("read", url, *tags)
    assert (now["values"]["setpoint"], now["states"]["mode"]) == (21.5, "eco")
    command.process.send_signal(signal.SIGINT)
    command.process.communicate(timeout=wire.DEADLINE)
    assert command.process.returncode == 0


def test_a_simulated_device_has_an_event_log(
    simulate: Callable[..., tuple[ServingCommand, str]],
) -> None:
    _, url = simulate(HEATER)
    place = urlsplit(url)
    with wire.Connection((str(place.hostname), place.port or 0)) as client:
        # Status, no event, this message, its arrival.
        assert client.ask(b"\x0c") == bytes.fromhex("0c07000000000001 80")


def test_without_a_file_a_heater_is_simulated(
    simulate: Callable[..., tuple[ServingCommand, str]], tmp_path: Path
) -> None:
    command, _ = simulate("--unit", "3")
    found = re.findall("^  holdfast (.*)$", command.greeting, re.MULTILINE)
    describe, watch = (line.replace("heater.yaml", str(tmp_path / "tags.yaml")) for line in found)
    done(*describe.split(), "--every", "0.01")
    watched = invoke(*watch.split(), "--times", "1", "--json")
    assert (watched.exit_code, "ir_0" in watched.stdout) == (0, True)
    usage = usage_error("simulate", "--profile", "heater")
    assert "--profile needs FILE, a configuration." in usage


def test_the_heater_is_that_of_the_examples() -> None:
    assert HEATER_WITHOUT_FILE.read_text() == (ROOT / "examples/tags/heater.yaml").read_text()


def test_values_faults_and_unit_can_be_chosen(
    simulate: Callable[..., tuple[ServingCommand, str]],
) -> None:
    command, url = simulate(
        *(HEATER, "--set", "w*=constant:55.5", "--set", "door_open=constant:on"),
        *("--exception", "1:6", "--unit", "9", "--seed", "x"),
    )
    assert "--unit 9" in command.greeting
    result = invoke("read", url, "ir:10", "--unit", "9", "--json")
    assert json.loads(result.stdout)["errors"]["ir:10"]["code"] == 6
    _, url = simulate(HEATER, "--set", "w*=constant:55.5", "--set", "door_open=constant:on")
    found = answer("read", url, "--tags", HEATER, "--only", "water", "--only", "door_open")
    assert found["values"] == {"water": 55.5, "door_open": True}


def test_a_recording_is_played_back(
    simulate: Callable[..., tuple[ServingCommand, str]], tmp_path: Path
) -> None:
    _, url = simulate(HEATER)
    record = tmp_path / "values.csv"
    tags = ("--tags", HEATER)
    assert done("write", url, "setpoint=21.5", *tags)
    often = ("--every", "0.01", "--times", "3", "--record", str(record))
    assert invoke("read", url, *tags, *often).exit_code == 0
    _, url = simulate(HEATER, "--play", str(record))
    played = {line.split(",")[1] for line in record.read_text().splitlines()[1:]}
    found = answer("read", url, *tags)["values"]
    assert str(found["voltage"]).removesuffix(".0") in played
    assert found["setpoint"] == 21.5


def test_a_profile_of_a_configuration_is_simulated(
    simulate: Callable[..., tuple[ServingCommand, str]], tmp_path: Path
) -> None:
    file = tmp_path / "site.yaml"
    file.write_text(
        "profiles: {kind: {tags: {level: {area: coils, address: 1}}}}\n"
        "devices: {d: {url: tcp://127.0.0.1, profile: kind, interval: 1}}\n"
    )
    command, url = simulate(str(file), "--profile", "kind")
    assert f"--tags {file} --profile kind" in command.greeting
    arguments = ("--tags", str(file), "--profile", "kind")
    assert list(answer("read", url, *arguments)["values"]) == ["level"]


def test_an_address_in_use_is_told(simulate: Callable[..., tuple[ServingCommand, str]]) -> None:
    _, url = simulate(HEATER)
    port = url.rpartition(":")[2]
    for more in ((), ("--drop", "0.1")):
        result = invoke("simulate", HEATER, "--bind", port, *more)
        assert result.exit_code == 1
        assert result.stderr.startswith(f"holdfast: can't listen on 127.0.0.1:{port}: Address ")
        assert result.stderr.count("can't listen") == result.stderr.count(port) == 1
        assert result.stderr.endswith("; --bind sets another address or port\n")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--bind", "0.0.0.0"), "--bind 0.0.0.0:5020 is reachable from other machines: name the"),
        (("--bind", "localhost"), "found 'localhost', allowed: address:port"),
        (("--set", "voltage"), "--set: 'voltage' is not NAME=GENERATOR."),
        (
            ("--set", "volts=sine:0:1:1"),
            "no tag has the name 'volts'; did you mean 'voltage'?",
        ),
        (("--set", "voltage=sine:0:1"), "--set: voltage: 'sine:0:1' is not sine:LOW:HIGH:SECONDS"),
        (
            ("--set", "water=constant:9999"),
            "--set water=constant:9999: water holds ",
        ),
        (("--set", "setpoint=sine:5:9:1"), "setpoint keeps what is written to its registers"),
        (("--drop", "5%"), "'5%' is not a share from 0 to 1, as in 0.05."),
        (("--drop", "0.6", "--exception", "0.6"), "--drop and --exception are more than 1"),
        (("--exception", "0.1:0"), "is not SHARE[:CODE] with a code from 1 to 255"),
        (("--latency", "2-1"), "'2-1' is not TIME or MIN-MAX, as in"),
        (("--play", "/nonexistent.csv"), "/nonexistent.csv: No such file or directory."),
    ],
)
def test_wrong_usage_is_told(arguments: tuple[str, ...], told: str) -> None:
    assert told in usage_error("simulate", HEATER, *arguments)


@pytest.mark.parametrize("writable", ["", ", writable: true"])
def test_a_value_that_does_not_fit_with_its_scale_is_told_with_its_line(
    tmp_path: Path, writable: str
) -> None:
    tags, file = tmp_path / "tags.yaml", tmp_path / "values.csv"
    tags.write_text(
        "tags:\n"
        "  power: {area: holding_registers, address: 0, type: int16, unit: W, "
        f"scale: {{from: sf, as: exponent}}{writable}}}\n"
        "  sf: {area: holding_registers, address: 4, type: int16}\n"
    )
    file.write_text("time,power,sf\n\n0,300000,0\n")
    told = usage_error("simulate", str(tags), "--play", str(file))
    assert f"{file}:3: power holds " in told

"""Runs `holdfast` in this process, as people and programs call it."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

from click.testing import CliRunner

from holdfast.cli import main
from support import wire
from support.commands import LONG_TIMEOUTS, Command

if TYPE_CHECKING:
    import signal
    from collections.abc import Iterable
    from pathlib import Path

    from click.testing import Result

    import holdfast


def url(server: holdfast.Server) -> str:
    host, port = server.address
    return f"tcp://{host}:{port}"


def invoke(*arguments: str) -> Result:
    """Returns the result of a command. Raises unexpected exceptions."""
    result = CliRunner().invoke(
        main, list(arguments), prog_name="holdfast", default_map=LONG_TIMEOUTS
    )
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def done(*arguments: str) -> list[str]:
    """Returns the lines that a command prints. It must succeed without warnings."""
    result = invoke(*arguments)
    assert (result.exit_code, result.stderr) == (0, ""), result.output
    return result.stdout.splitlines()


def answer(*arguments: str, code: int = 0) -> Any:
    """Returns the JSON that a command prints."""
    result = invoke(*arguments, "--json")
    assert (result.exit_code, result.stderr) == (code, "")
    return json.loads(result.stdout)


def early_lines(process: Command, count: int) -> list[str]:
    """Returns the first lines of a command that goes on."""
    assert process.stdout is not None
    lines = [process.stdout.readline() for _ in range(count)]
    assert process.poll() is None
    return lines


def elements(lines: Iterable[str]) -> list[Any]:
    """Returns the elements of a JSON list whose lines have one each, with the comma before it."""
    return [json.loads(line.lstrip(" ,")) for line in lines]


def failure(*arguments: str) -> list[str]:
    """Returns the lines on standard error of a command that fails."""
    result = invoke(*arguments)
    assert result.exit_code == 1
    return result.stderr.splitlines()


LATE = re.compile(
    r"hint: replies take (up to )?0\.\d+ s( or more)?, longer than --timeout 0\.05 s: "
    r"use --timeout [0-9.]+\n"
)
"""What a command says at its end, if replies have come after its timeout."""


def usage_error(*arguments: str) -> str:
    """Returns the last line of the error for wrong usage."""
    result = invoke(*arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("Usage: holdfast ")
    return result.stderr.splitlines()[-1]


class ServingCommand:
    """A running command that serves until a signal."""

    def __init__(self, *arguments: str) -> None:
        self.process = Command(*arguments)
        self.greeting = ""

    def wait_for_greeting(self) -> str:
        assert self.process.stdout is not None
        while "Ctrl-C stops it." not in self.greeting:
            line = self.process.stdout.readline()
            assert line, self.process.communicate()
            self.greeting += line
        return self.greeting

    def end(self, number: signal.Signals, within: float = wire.DEADLINE) -> tuple[int, str]:
        """Sends a signal. Returns the exit code and the log. The command must end in time."""
        self.process.send_signal(number)
        _, log = self.process.communicate(timeout=within)
        return self.process.wait(), log


class RunCommand(ServingCommand):
    """A running `holdfast run`, and the address of its listener `scada`."""

    def __init__(self, file: Path) -> None:
        super().__init__("run", str(file))

    def wait_until_it_serves(self) -> tuple[str, int]:
        self.wait_for_greeting()
        match = re.search(r"scada +modbus-tcp +([0-9.]+):([0-9]+)", self.greeting)
        assert match, self.greeting
        return match[1], int(match[2])


class ProxyCommand(ServingCommand):
    """A running `holdfast proxy` on a port that the system picks."""

    def __init__(self, *arguments: str) -> None:
        super().__init__("proxy", *arguments, "--bind", "127.0.0.1:0")

    def wait_until_it_serves(self) -> tuple[str, int]:
        self.wait_for_greeting()
        match = re.search(r"is served at tcp://([0-9.]+):([0-9]+):", self.greeting)
        assert match, self.greeting
        return match[1], int(match[2])

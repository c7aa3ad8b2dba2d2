"""Tries an installed Holdfast: `python smoke.py EXAMPLES`, with the Python it is installed for.

Needs nothing but Python and Holdfast, so it also runs in containers and emulators. Asks every
command for its help, reads and writes a simulated device, and runs the appliance of
examples/plant.yaml. Further arguments name commands that must say that an extra is missing.
"""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import tempfile
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

HOLDFAST = [sys.executable, "-m", "holdfast"]
UTF8 = {**os.environ, "PYTHONUTF8": "1"}
"""Else Windows encodes what is printed to a pipe in another way."""

MISSING = re.compile(r"holdfast: this command requires \S+, not installed: pip install '\S+'\n")
TIMEOUT = 120.0
"""Seconds for one command: emulators are slow."""


def ran(*arguments: str) -> str:
    """What a command prints. Raises `AssertionError` if it fails."""
    done = subprocess.run(
        [*HOLDFAST, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        env=UTF8,
        timeout=TIMEOUT,
    )
    assert done.returncode == 0, f"{arguments}: exit code {done.returncode}\n{done.stdout}"
    return done.stdout


def helps() -> tuple[int, set[str]]:
    """Asks every command and every group for its help, in one process.

    Returns how many have one, and the names of those that miss an extra.
    """
    import click

    from holdfast.cli import main

    def ask(command: Any, path: list[str]) -> int:
        printed, errors = io.StringIO(), io.StringIO()
        try:
            with redirect_stdout(printed), redirect_stderr(errors):
                main.main([*path, "--help"], "holdfast", standalone_mode=False)
        except SystemExit:
            assert MISSING.fullmatch(errors.getvalue()), errors.getvalue()
            missing.add(" ".join(path))
            return 0
        assert printed.getvalue().startswith(" ".join(["Usage: holdfast", *path])), path
        if not isinstance(command, click.Group):
            return 1
        # Else a command whose extra is missing would be an error already here.
        context = click.Context(command, resilient_parsing=True)
        below = [
            (name, command.get_command(context, name)) for name in command.list_commands(context)
        ]
        return 1 + sum(ask(each, [*path, name]) for name, each in below)

    missing: set[str] = set()
    return ask(main, []), missing


@contextmanager
def serving(*arguments: str) -> Iterator[str]:
    """A command that serves, with its first address. Stops it, which must succeed on Unix."""
    process = subprocess.Popen(
        [*HOLDFAST, *arguments],
        stdout=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        env=UTF8,
    )
    try:
        assert process.stdout is not None
        for line in process.stdout:
            found = re.search(r"127\.0\.0\.1:\d+", line)
            if found:
                yield found[0]
                break
        else:
            raise AssertionError(f"{arguments} ended with exit code {process.wait()}")
        if sys.platform == "win32":
            return  # a signal needs a console, which may be missing
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=TIMEOUT)
        assert process.returncode == 0, f"{arguments}: exit code {process.returncode}"
    finally:
        process.kill()
        process.wait()


def try_device(examples: Path) -> None:
    """Reads and writes a simulated device."""
    tags = str(examples / "tags" / "heater.yaml")
    with serving("simulate", tags, "--bind", ":0") as address:
        device = f"tcp://{address}"
        assert "setpoint" in ran("read", device, "--tags", tags)
        ran("write", device, "setpoint=21.5", "--tags", tags)
        assert "21.5" in ran("read", device, "--tags", tags)


def try_appliance(examples: Path) -> None:
    """Runs an appliance on ports that the system picks, writes and reads."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "plant.yaml"
        text = (examples / "plant.yaml").read_text(encoding="utf-8")
        config.write_text(re.sub(r"(bind: \S+):\d+", r"\1:0", text), encoding="utf-8")
        initial = (examples / "boiler.csv").read_bytes()
        (config.parent / "boiler.csv").write_bytes(initial)
        ran("check", str(config))
        with serving("run", str(config)) as address:
            device = f"tcp://{address}"
            ran("write", device, "holding_registers", "900", "4711")
            assert "4711" in ran("read", device, "holding_registers", "900")


def main() -> None:
    """Tries all; a failure ends it."""
    examples, without = Path(sys.argv[1]), set(sys.argv[2:])
    print(ran("--version").strip(), flush=True)
    asked, missing = helps()
    assert asked > 20, asked
    assert missing == without, missing
    print(f"{asked} commands have a help", flush=True)
    try_device(examples)
    print("a simulated device was read and written", flush=True)
    try_appliance(examples)
    print("an appliance was run, read and written", flush=True)


if __name__ == "__main__":
    main()

"""Measures how long a command takes from its start to its end, beside mbpoll and modbus-cli.

Each command reads registers of a server on another core, checks a file, or prints its help. The
order of the commands rotates; figures are the medians of all rounds, less that of `python -c pass`,
which no program in Python can avoid. Processor time depends less on what else the machine does.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

import common
from common import Result, TurnFailed

PYTHON = "python -c pass"
TAGS = str(common.ROOT / "examples" / "tags" / "heater.yaml")


def main() -> None:
    """Prints a table, and writes all results to the file of `--json`."""
    options = common.parsed(common.parser(__doc__, seconds=1, rounds=20))
    rounds: list[dict[str, Result]] = []
    with common.started("holdfast", common.python("holdfast_server.py"), options.core) as server:
        programs = commands(server.address)
        for command in programs.values():  # Python writes its cache of compiled modules.
            measure(command, options.other)
        for index in range(options.rounds):
            names = common.turns(list(programs), index)
            rounds.append({name: measure(programs[name], options.other) for name in names})
    show(rounds, list(programs))
    if options.json:
        options.json.write_text(json.dumps(rounds, indent=1))


def commands(address: str) -> dict[str, list[str]]:
    """The command lines, by what the table calls them. Programs that are missing are left out."""
    host, _, port = address.rpartition(":")
    url = f"tcp://{address}"
    folder = Path(sys.executable).parent
    holdfast = str(folder / "holdfast")
    found = {
        PYTHON: [sys.executable, "-c", "pass"],
        "holdfast --help": [holdfast, "--help"],
        "holdfast read": [holdfast, "read", url, "hr", "0", "10"],
        "holdfast read hr:0": [holdfast, "read", url, "hr:0:uint16[10]"],
        "holdfast write": [holdfast, "write", url, "hr", "0", "0"],
        "holdfast watch": [holdfast, "watch", url, "hr", "0", "10", "--times", "1"],
        "TAB": [holdfast],
        "holdfast find --help": [holdfast, "find", "--help"],
        "holdfast read --tags": [holdfast, "read", url, "--tags", TAGS, "--only", "setpoint"],
        "holdfast check": [holdfast, "check", str(common.ROOT / "examples" / "plant.yaml")],
    }
    if (mbpoll := shutil.which("mbpoll")) is not None:
        found["mbpoll"] = [mbpoll, "-1", "-r", "1", "-c", "10", "-p", port, host]
    # Others install it in an environment of its own: its packages are not those of Holdfast.
    if (modbus := os.environ.get("MODBUS_CLI") or shutil.which("modbus")) is not None:
        found["modbus-cli"] = [modbus, "-s", "1", address, *(f"h@{at}/H" for at in range(10))]
    return found


def measure(command: list[str], core: int) -> Result:
    """Runs a command. Returns its times in milliseconds."""
    # Else every command compiles all its modules, which an installed one does not.
    variables = {key: os.environ[key] for key in os.environ if key != "PYTHONDONTWRITEBYTECODE"}
    if len(command) == 1:
        words = "holdfast read --ti"
        variables |= {"_HOLDFAST_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": "2"}
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    ran = subprocess.run(
        command,
        env=variables,
        capture_output=True,
        timeout=common.TIMEOUT,
        preexec_fn=common.pinned(core),
    )
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if ran.returncode != 0:
        raise TurnFailed(f"{command}: {ran.stderr.decode()}")
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall": 1e3 * wall, "cpu": 1e3 * cpu}


def show(rounds: list[dict[str, Result]], names: list[str]) -> None:
    """Prints the medians, and by how much they exceed that of Python."""
    bare = common.medians(rounds, PYTHON, "wall", "cpu")
    print("| command | wall, ms | more than Python | processor, ms | more than Python |")
    print("| --- | --- | --- | --- | --- |")
    for name in names:
        cells = []
        for key, least in zip(("wall", "cpu"), bare, strict=True):
            times = [one[name][key] for one in rounds]
            cells += [f"{median(times):.0f}", f"{median(times) - least:.0f}"]
        print(f"| `{name}` | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()

"""Measures start and memory of an appliance with one memory, Modbus, Raw Ingest and REST.

The configuration is that of docs/just-the-memory.md. With `--mma COMMAND`, the Modbus Memory
Appliance takes turns with it, with the same memory and the same listeners; it listens on all
addresses. The start is the time until the first reply to a Modbus request, and the processor time
until then, which says more on a machine that does other things too.
"""

from __future__ import annotations

import contextlib
import json
import re
import shlex
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

import common

PAGE = common.ROOT / "docs" / "just-the-memory.md"
PORTS = ("5020", "9000", "8080")
"""Modbus, Raw Ingest and REST of the configurations."""
SETTLED_S = 1.0
"""Time after the first reply until the memory is read."""

MMA = """\
memory:
  memories:
    "1":
      default: true
      coils: {start: 0, size: 1024}
      discrete_inputs: {start: 0, size: 1024}
      holding_registers: {start: 0, size: 4096}
      input_registers: {start: 0, size: 4096}
routing: {unit_id_map: {1: "1"}}
ports:
  5020: {unit_ids: all, memories: all, access: read-write}
raw_ingest:
  {enabled: true, listen: "127.0.0.1:9000", max_packet_bytes: 65536, read_timeout_ms: 2000}
rest: {enabled: true, address: "127.0.0.1:8080"}
"""

Started: TypeAlias = Callable[[Path, Sequence[int]], list[str]]
"""Writes the configuration into a folder, with these ports; returns the command that runs it."""


def holdfast(folder: Path, ports: Sequence[int]) -> list[str]:
    """Prepares the configuration of the page."""
    [text, *_] = re.findall(r"^```yaml\n(.*?)^```", PAGE.read_text(), re.M | re.S)
    (folder / "plant.yaml").write_text(moved(text, ports))
    return [sys.executable, "-m", "holdfast", "run", "plant.yaml"]


def mma(command: str) -> Started:
    """Prepares the other appliance."""

    def prepare(folder: Path, ports: Sequence[int]) -> list[str]:
        (folder / "config.yaml").write_text(moved(MMA, ports))
        return shlex.split(command)

    return prepare


def moved(text: str, ports: Sequence[int]) -> str:
    """Returns a configuration with other ports."""
    changed = dict(zip(PORTS, map(str, ports), strict=True))
    return re.sub("|".join(rf"\b{port}\b" for port in PORTS), lambda at: changed[at[0]], text)


def turn(prepare: Started, core: int) -> common.Result:
    """Starts a program; returns the seconds to its first reply, its memory and its threads."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        ports = free_ports(len(PORTS))
        command = prepare(folder, ports)
        log = stack.enter_context((folder / "log").open("w"))
        begin = time.monotonic()
        process = subprocess.Popen(
            command,
            cwd=folder,
            stdout=log,
            stderr=log,
            preexec_fn=common.pinned(core),
        )
        stack.callback(process.wait)
        stack.callback(process.kill)
        until_answered(process, ports[0], folder / "log")
        seconds = time.monotonic() - begin
        cpu = time.clock_gettime(~process.pid << 3 | 2)  # As clock_getcpuclockid(3) does.
        time.sleep(SETTLED_S)
        memory = common.memory(process.pid)
        threads = len(list(Path(f"/proc/{process.pid}/task").iterdir()))
        return {"start_s": seconds, "cpu_s": cpu, "threads": threads, **memory}


def until_answered(process: subprocess.Popen[bytes], port: int, log: Path) -> None:
    """Waits until a read of a register is answered."""
    deadline = time.monotonic() + common.TIMEOUT
    while True:
        with contextlib.suppress(ConnectionRefusedError):
            common.ask(f"127.0.0.1:{port}", 1)
            return
        if process.poll() is not None or time.monotonic() > deadline:
            raise RuntimeError(log.read_text()[-2000:])
        time.sleep(0.002)


def free_ports(count: int) -> list[int]:
    """Returns ports that nobody uses."""
    with contextlib.ExitStack() as taken:
        free = [taken.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [int(one.getsockname()[1]) for one in free]


def main() -> None:
    """Prints the medians, and writes all turns to the file of `--json`."""
    options = common.parser((__doc__ or "").splitlines()[0], SETTLED_S, 9)
    options.add_argument("--mma", help="the command that runs the Modbus Memory Appliance")
    chosen = common.parsed(options)
    programs = {"Holdfast": holdfast} | ({"MMA": mma(chosen.mma)} if chosen.mma else {})
    rounds = [
        {name: turn(programs[name], chosen.core) for name in common.turns(list(programs), index)}
        for index in range(chosen.rounds)
    ]
    for name in programs:
        keys = ("start_s", "cpu_s", "resident", "own", "threads")
        start, cpu, resident, own, threads = common.medians(rounds, name, *keys)
        print(
            f"{name:10} first reply after {1000 * start:.0f} ms, {1000 * cpu:.0f} ms of a core, "
            f"{resident / 1e6:.1f} MB resident, {own / 1e6:.1f} MB its own, {threads:.0f} threads"
        )
    if chosen.json:
        chosen.json.write_text(json.dumps(rounds, indent=1))


if __name__ == "__main__":
    main()

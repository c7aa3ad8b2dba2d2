"""Measures a fleet on one machine: missed scans, memory, processor time, messages to KV.

The devices judge: they note late polls, overlapping polls, and a second connection. Nothing is
pinned to a core: nodes, NATS server, devices and this program share the machine.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import common
from nats.aio.client import Client

if TYPE_CHECKING:
    from collections.abc import Iterator

FLEET = "bench"
INTERVAL = 10
"""Seconds between scans of a device."""

TAGS = 10
OF_A_PROCESS = 10_000
"""Devices of a process, which can't open more files than the system allows."""

IN_FLIGHT = 64
"""Subscribe requests at once."""

ATTEMPTS = 10
"""Attempts to subscribe while the NATS server does not confirm in time."""

SETTLED = 2 * INTERVAL
"""Seconds between the last subscription and the measurement."""

BUCKETS = (f"KV_holdfast_fleet_{FLEET}", f"KV_holdfast_fleet_{FLEET}_wants")
TICKS = os.sysconf("SC_CLK_TCK")


@dataclass
class Process:
    """A process of the bench."""

    process: subprocess.Popen[str]
    log: IO[str]
    address: str = ""

    def cpu(self) -> float:
        """Returns the processor time so far, in seconds."""
        return time.clock_gettime(~self.process.pid << 3 | 2)  # As clock_getcpuclockid(3) does.

    def memory(self) -> int:
        """Returns its own memory in bytes."""
        return common.memory(self.process.pid)["own"]

    def count(self, event: str) -> int:
        """Returns how often an event is in the log, with those that were held back."""
        self.log.seek(0)
        found = [json.loads(line) for line in self.log if f'"event": "{event}"' in line]
        return sum(1 + int(each.get("held_back", 0)) for each in found)


@contextlib.contextmanager
def running(command: list[str], *, listens: bool = True) -> Iterator[Process]:
    """Runs a process, and kills it at the end of the context."""
    with tempfile.TemporaryFile("w+") as log:
        started = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
        )
        process = Process(started, log)
        try:
            if listens:
                assert started.stdout is not None
                process.address = started.stdout.readline().split()[-1]
            yield process
        finally:
            started.kill()
            started.communicate()


class Bench:
    """A fleet with its devices."""

    def __init__(self, options: argparse.Namespace, devices: int, stack: ExitStack) -> None:
        judge = common.python("fleet_devices.py", INTERVAL)
        count = -(-devices // OF_A_PROCESS)
        self.judges = [stack.enter_context(running(judge)) for _ in range(count)]
        self.nats = stack.enter_context(running(common.python("scanner_nats.py")))
        self.url = f"nats://{self.nats.address}"
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        self.nodes = [
            stack.enter_context(running(self._node(folder, f"n{number}", devices), listens=False))
            for number in range(options.nodes)
        ]

    def _node(self, folder: Path, name: str, devices: int) -> list[str]:
        nats = {
            "servers": [self.url],
            "devices": ["127.0.0.0/8"],
            "limits": {"devices": devices, "tags": devices * TAGS},
            "fleet": {"name": FLEET, "node": name},
        }
        file = folder / f"{name}.yaml"
        file.write_text(json.dumps({"nats": nats, "log": {"format": "json"}}))
        return [sys.executable, "-m", "holdfast", "run", str(file)]

    def judged(self) -> dict[str, Any]:
        """Returns what the devices have noted since the last call."""
        found: dict[str, Any] = {}
        for judge in self.judges:
            assert judge.process.stdin is not None
            assert judge.process.stdout is not None
            judge.process.stdin.write("\n")
            judge.process.stdin.flush()
            for key, value in json.loads(judge.process.stdout.readline()).items():
                before = found.get(key, 0)
                found[key] = max(before, value) if key == "longest" else before + value
        return found

    def nats_cpu(self) -> float:
        """Returns the processor time of the NATS server, a child process, in seconds."""
        child = common.child(self.nats.process.pid)
        user, system = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[11:13]
        return (int(user) + int(system)) / TICKS

    def lost(self) -> int:
        """Returns how many leases were lost so far."""
        return sum(node.count("lease_lost") for node in self.nodes)

    def memory(self) -> int:
        """Returns the own memory of all nodes in bytes."""
        return sum(node.memory() for node in self.nodes)

    def check(self) -> None:
        """Raises `RuntimeError` if a node has ended."""
        for node in self.nodes:
            if node.process.poll() is not None:
                node.log.seek(0)
                raise RuntimeError(f"a node has ended: {node.log.read()[-2000:]}")


async def shared(bench: Bench) -> None:
    """Waits until each node has its share of the partitions."""
    while True:
        bench.check()
        status = [sys.executable, "-m", "holdfast", "fleet", "status", FLEET, "--json"]
        done = await asyncio.create_subprocess_exec(
            *status, "--nats", bench.url, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        out, _ = await done.communicate()
        # There is no fleet before the first node is known.
        nodes = json.loads(out).get("nodes", []) if out else []
        counts = [each["partitions"] for each in nodes]
        if len(counts) == len(bench.nodes) and max(counts) <= min(counts) + 1:
            return
        await asyncio.sleep(0.5)


async def subscribe(bench: Bench, client: Client, devices: int) -> None:
    """Subscribes to all devices."""
    ports = [int(judge.address.rpartition(":")[2]) for judge in bench.judges]
    tags = [
        {"id": f"tag{at}", "address": at, "functionCode": "holding", "datatype": "uint16"}
        for at in range(TAGS)
    ]
    numbers = iter(range(devices))

    async def work() -> None:
        for number in numbers:
            request = {
                "deviceId": f"device{number}",
                "host": f"127.{number // 62500 + 1}.{number // 250 % 250}.{number % 250 + 1}",
                "port": ports[number // OF_A_PROCESS],
                "scanRate": INTERVAL * 1000,
                "subscriberId": "bench",
                "tags": tags,
            }
            for _ in range(ATTEMPTS):
                answer = await client.request(
                    "modbus.subscribe", json.dumps(request).encode(), timeout=common.TIMEOUT
                )
                if b"not stored" not in answer.data:
                    break
            if not json.loads(answer.data)["success"]:
                raise RuntimeError(answer.data.decode())

    async with asyncio.TaskGroup() as tasks:
        for _ in range(IN_FLIGHT):
            tasks.create_task(work())


async def writes(client: Client) -> int:
    """Returns how many messages were written to the buckets so far."""
    states = [(await client.jetstream().stream_info(name)).state for name in BUCKETS]
    return sum(int(state.last_seq) for state in states)


async def missed(client: Client) -> int:
    """Returns the scans that the scanners know to have missed."""
    total, offset = 0, 0
    while True:
        asked = json.dumps({"offset": offset}).encode()
        answer = await client.request("modbus.browse", asked, timeout=common.TIMEOUT)
        found = json.loads(answer.data)
        total += sum(int(device["missed"]) for device in found["devices"])
        if "next" not in found:
            return total
        offset = found["next"]


async def measured(options: argparse.Namespace, devices: int) -> dict[str, Any]:
    """Subscribes to all devices, and measures for some seconds."""
    found: dict[str, Any] = {"count": devices, "nodes": options.nodes}
    with ExitStack() as stack:
        bench = Bench(options, devices, stack)
        client = Client()
        await client.connect(bench.url)
        await shared(bench)
        memory, start = bench.memory(), time.monotonic()
        await subscribe(bench, client, devices)
        found["subscribing"] = time.monotonic() - start
        await asyncio.sleep(SETTLED)
        bench.check()
        found["storm"] = bench.judged() | {"lost": bench.lost()}
        cpu, nats_cpu = [node.cpu() for node in bench.nodes], bench.nats_cpu()
        written, start = await writes(client), time.monotonic()
        load = os.getloadavg()[0]
        await asyncio.sleep(options.seconds)
        elapsed = time.monotonic() - start
        found["judged"] = bench.judged()
        found["kv"] = (await writes(client) - written) / elapsed
        after = [node.cpu() for node in bench.nodes]
        found["cpu"] = [(end - begin) / elapsed for begin, end in zip(cpu, after, strict=True)]
        found["nats_cpu"] = (bench.nats_cpu() - nats_cpu) / elapsed
        found["memory"] = (bench.memory() - memory) / devices
        found["idle_memory"] = memory
        found["load"] = load
        found["lost"] = bench.lost()
        found["missed"] = await missed(client)
        await client.close()
    return found


def show(found: dict[str, Any]) -> None:
    """Prints one measurement."""
    devices, storm, judged = found["count"], found["storm"], found["judged"]
    print(f"\n{devices} devices of {TAGS} tags, every {INTERVAL} s, {found['nodes']} nodes")
    rate = devices / found["subscribing"]
    print(f"  subscribing     {found['subscribing']:10.1f} s, {rate:,.0f} requests/s; ", end="")
    print(f"{storm['lost']} leases lost, {storm['missed']} scans missed meanwhile")
    print(
        f"  devices say     {judged['polls']:10,d} polls of {judged['devices']} devices; ", end=""
    )
    print(f"{judged['missed']} missed, longest gap {judged['longest']:.1f} s; in all ", end="")
    print(f"{storm['doubles'] + judged['doubles']} second connections, ", end="")
    print(f"{storm['overlaps'] + judged['overlaps']} polls at once")
    print(f"  scanners say    {found['missed']:10,d} missed scans; {found['lost']} leases lost")
    memory, idle = found["memory"], found["idle_memory"] / found["nodes"]
    print(f"  memory          {memory / 1e3:10.1f} KB per device, all nodes together; ", end="")
    print(f"{idle / 1e6:.0f} MB per node without devices")
    total = sum(found["cpu"])
    print(f"  processor       {1e6 * total / devices:10.0f} us per device and second, ", end="")
    print(f"{100 * total:.1f} % of a core in all; NATS {100 * found['nats_cpu']:.1f} %")
    print(f"  messages to KV  {found['kv']:10.1f} a second;  load average {found['load']:.1f}")
    sys.stdout.flush()


def main() -> None:
    """Prints all measurements, and writes them to the file of `--json`."""
    parser = common.parser(__doc__, seconds=60, rounds=1)
    parser.add_argument("--devices", default="1000,5000,20000", help="default 1000,5000,20000")
    parser.add_argument("--nodes", type=int, default=3)
    options = common.parsed(parser)
    seconds = options.seconds = max(options.seconds, 2.0 * INTERVAL)
    results = []
    for devices in map(int, options.devices.split(",")):
        results.append(asyncio.run(measured(options, devices)))
        show(results[-1])
    if options.json:
        options.json.write_text(json.dumps({"seconds": seconds, "results": results}, indent=1))


if __name__ == "__main__":
    main()

"""Measures the scanner on one core: the values per second that reach a subscriber.

The scanner has its own core. The NATS server, the devices and the subscriber are three processes on
another core. One server on many loopback addresses stands for all devices, so each device has its
own connection.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import common
from nats import errors
from nats.aio.client import Client

from holdfast.net.nats import batch
from holdfast.net.nats_server import TemporaryServer
from holdfast.scanner.publish.publisher import Publisher
from holdfast.scanner.subscriptions.groups import Group
from holdfast.scanner.subscriptions.tag import ScannedTag

TAGS = 100
TICKS = os.sysconf("SC_CLK_TCK")
SETTLING = 2.0
"""Seconds between the last subscription and the start of the measurement."""


class Bench:
    """One scanner with its devices and a subscriber."""

    def __init__(self, options: argparse.Namespace, stack: ExitStack, *fleet: str) -> None:
        """With the name of a `fleet`, the scanner is its only node."""
        core, other = options.core, options.other
        devices = common.started("devices", common.python("devices.py"), other)
        self.devices = stack.enter_context(devices)
        self.nats = stack.enter_context(
            common.started("nats", common.python("scanner_nats.py"), other)
        )
        service = common.python("scanner_service.py", self.nats.address, *fleet)
        self.scanner = stack.enter_context(common.started("scanner", service, core))
        listener = common.python("scanner_listener.py", self.nats.address, "modbus.data.>")
        self.listener = stack.enter_context(common.started("listener", listener, other))

    def threads(self) -> dict[str, float]:
        """Returns the processor time of the scanner by thread, in seconds."""
        found: dict[str, float] = {}
        for task in Path(f"/proc/{self.scanner.process.pid}/task").iterdir():
            name = (task / "comm").read_text().strip()
            if task.name == str(self.scanner.process.pid):
                name = "event loop"
            found[name] = found.get(name, 0.0) + _seconds(task / "stat")
        return found

    def nats_cpu(self) -> float:
        """Returns the processor time of the NATS server, a child process, in seconds."""
        return _seconds(Path(f"/proc/{common.child(self.nats.process.pid)}/stat"))

    def count(self) -> dict[str, float]:
        """Returns the listener's figures since the last call."""
        assert self.listener.process.stdin is not None
        assert self.listener.process.stdout is not None
        self.listener.process.stdin.write("\n")
        self.listener.process.stdin.flush()
        found: dict[str, float] = json.loads(self.listener.process.stdout.readline())
        return found


def _seconds(stat: Path) -> float:
    """Returns the processor time in a `stat` file, in seconds."""
    user, system = stat.read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / TICKS


async def subscribe(bench: Bench, devices: int, rate: int) -> None:
    """Subscribes to all tags of all devices."""
    port = int(bench.devices.address.rpartition(":")[2])
    tags = [
        {"id": f"tag{at}", "address": at, "functionCode": "holding", "datatype": "uint16"}
        for at in range(TAGS)
    ]
    client = await _connected(bench)
    for number in range(devices):
        request = {
            "deviceId": f"device{number}",
            "host": f"127.0.{number // 250 + 1}.{number % 250 + 1}",
            "port": port,
            "scanRate": rate,
            "subscriberId": "bench",
            "tags": tags,
        }
        answer = await client.request(
            "modbus.subscribe", json.dumps(request).encode(), timeout=common.TIMEOUT
        )
        if not json.loads(answer.data)["success"]:
            raise RuntimeError(answer.data.decode())
    await client.close()


async def browse(bench: Bench) -> tuple[dict[str, int], int]:
    """Returns the counters of the service, and the missed scans of all devices."""
    client = await _connected(bench)
    missed, offset = 0, 0
    while True:
        asked = json.dumps({"offset": offset}).encode()
        answer = await client.request("modbus.browse", asked, timeout=common.TIMEOUT)
        found = json.loads(answer.data)
        missed += sum(device["missed"] for device in found["devices"])
        if "next" not in found:
            await client.close()
            return found["service"], missed
        offset = found["next"]


async def _connected(bench: Bench) -> Client:
    client = Client()
    await client.connect(f"nats://{bench.nats.address}")
    return client


def measured(
    options: argparse.Namespace, devices: int, rate: int, seconds: float, *fleet: str
) -> Any:
    """Measures throughput and processor time for some seconds."""
    with ExitStack() as stack:
        bench = Bench(options, stack, *fleet)
        asyncio.run(subscribe(bench, devices, rate))
        time.sleep(SETTLING)
        before, missed_before = asyncio.run(browse(bench))
        bench.count()
        threads, devices_cpu = bench.threads(), bench.devices.cpu()
        nats_cpu, start = bench.nats_cpu(), time.monotonic()
        time.sleep(seconds)
        elapsed = time.monotonic() - start
        used = {name: cpu - threads.get(name, 0.0) for name, cpu in bench.threads().items()}
        found: dict[str, Any] = bench.count()
        found["cpu"] = {name: cpu / elapsed for name, cpu in used.items() if cpu / elapsed > 0.001}
        found["nats_cpu"] = (bench.nats_cpu() - nats_cpu) / elapsed
        found["devices_cpu"] = (bench.devices.cpu() - devices_cpu) / elapsed
        after, missed = asyncio.run(browse(bench))
        found["missed"] = missed - missed_before
        for key in ("published", "replaced", "dropped", "lostScans"):
            found[key] = after[key] - before[key]
        return found


def show(title: str, found: Any) -> None:
    """Prints one measurement."""
    per_second = found["count"] / found["seconds"]
    total = sum(found["cpu"].values())
    print(f"\n{title}")
    print(f"  delivered       {per_second:12,.0f} values/s")
    print(f"  latency         {found['p50']:12.1f} ms p50, {found['p99']:.1f} p99, ", end="")
    print(f"{found['max']:.1f} max (from the device's response to the subscriber)")
    print(
        f"  missed scans    {found['missed']:12,d}; lost scans: {found['lostScans']}, ",
        end="",
    )
    print(f"{found['replaced']} replaced, {found['dropped']} dropped")
    parts = ", ".join(f"{name} {100 * cpu:.1f}" for name, cpu in sorted(found["cpu"].items()))
    print(f"  scanner's core  {100 * total:12.1f} % ({parts})")
    print(f"  other processes {100 * found['nats_cpu']:12.1f} % NATS, ", end="")
    print(f"{100 * found['devices_cpu']:.1f} % devices")


def costs() -> dict[str, float]:
    """Returns the microseconds per value that the event loop takes, measured in this process."""
    tags = tuple(
        ScannedTag(f"tag{at}", "holding_registers", at, "uint16", "ABCD", frozenset())
        for at in range(TAGS)
    )
    data = bytes(2 * TAGS)
    found = {}
    for name, change in (("scan", False), ("change", True)):
        publisher = Publisher("modbus", "device1")
        publisher.regroup([Group(50, change, tags, (0.0,) * TAGS)], set())
        rounds, start = 3000, time.perf_counter()
        for moment in range(rounds):
            publisher.messages(moment, [("holding_registers", 0, TAGS, data, 0, 0.0)])
        found[name] = (time.perf_counter() - start) / rounds / TAGS * 1e6
    return found


async def publishing(url: str) -> dict[str, float]:
    """Returns the microseconds per message to publish: one by one with nats-py, and in batches."""
    client = Client()
    await client.connect(url)
    subject, payload, count = "bench.data.device1", b"x" * 120, 20_000
    start = time.perf_counter()
    for _ in range(count):
        await client.publish(subject, payload)
    await client.flush()
    one = time.perf_counter() - start
    texts = batch.text(subject, payload) * TAGS
    start = time.perf_counter()
    for _ in range(count // TAGS):
        await batch.send(client, texts, TAGS)
    await client.flush()
    batched = time.perf_counter() - start
    await client.close()
    return {"publish": one / count * 1e6, "batch": batched / count * 1e6}


def main() -> None:
    """Prints all measurements, and writes them to the file of `--json`."""
    parser = common.parser(__doc__, seconds=10, rounds=1)
    parser.add_argument("--devices", type=int, default=1000)
    options = common.parsed(parser)
    seconds = max(options.seconds, 2.0)
    results: dict[str, Any] = {"us_per_value": costs()}
    scan, change = results["us_per_value"]["scan"], results["us_per_value"]["change"]
    with TemporaryServer(0) as server:
        handed = results["us_per_message"] = asyncio.run(publishing(server.url))
    print(f"\nBytes to messages: {scan:.2f} us per value, {change:.2f} us if unchanged.")
    print(f"To NATS: {handed['publish']:.2f} us each by publish, {handed['batch']:.2f} in batches.")
    once = f"{options.devices} devices of {TAGS} tags, once a second"
    for title, devices, rate, *fleet in (
        (once, options.devices, 1000),
        (f"{once}, in a fleet of one", options.devices, 1000, "bench"),
        (f"100 devices of {TAGS} tags, 20 times a second: 200,000 values/s", 100, 50),
        (f"300 devices of {TAGS} tags, 20 times a second: 600,000 values/s", 300, 50),
    ):
        try:
            results[title] = found = measured(options, devices, rate, seconds, *fleet)
            show(title, found)
        except errors.TimeoutError:
            print(f"\n{title}\n  too much: a request was not answered in {common.TIMEOUT} s")
        sys.stdout.flush()
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()

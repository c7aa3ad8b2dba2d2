"""Measures `holdfast.Poller`: its processor time for tags of many devices, and whether it keeps up.

The devices are addresses of one server, which has the other core.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import time
from pathlib import Path

from common import python

from holdfast import Poller, Tag, TagList

WARM_UP = 3.0


def main() -> None:
    """Prints the figures, and writes them to the file of `--json`."""
    options = arguments()
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    command = ["taskset", "-c", "0", *python("scanner_devices.py")]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as server:
        assert server.stdout is not None
        port = int(server.stdout.readline().rpartition(":")[2])
        os.sched_setaffinity(0, {1})
        result = measured(port, options)
        server.terminate()
    for name, figure in result.items():
        print(f"{name:28}{figure:>14,.3f}")
    if options.json is not None:
        options.json.write_text(json.dumps(result))


def measured(port: int, options: argparse.Namespace) -> dict[str, float]:
    """Polls all devices for a while."""
    tags = TagList(
        Tag(f"tag_{number}", "holding_registers", 2 * number, "float32")
        for number in range(options.tags)
    )
    with Poller() as poller:
        for number in range(options.devices):
            host = f"127.{1 + number // 250}.0.{1 + number % 250}"
            poller.add(f"tcp://{host}:{port}", tags, interval=options.interval)
        end = time.monotonic() + WARM_UP
        while time.monotonic() < end:
            poller.take(0.1)
        readings = batches = faults = 0
        missed = sum(each["missed"] for each in poller.counters().values())
        began, cpu = time.monotonic(), time.process_time()
        while time.monotonic() < began + options.seconds:
            batch = poller.take(0.1)
            if batch is not None:
                batches += 1
                readings += len(batch)
                faults += sum(reading.fault != 0 for reading in batch)
        seconds, used = time.monotonic() - began, time.process_time() - cpu
        missed = sum(each["missed"] for each in poller.counters().values()) - missed
        return {
            "devices": options.devices,
            "tags of a device": options.tags,
            "readings a second": readings / seconds,
            "batches a second": batches / seconds,
            "share of one core": used / seconds,
            "microseconds a reading": used / max(1, readings) * 1e6,
            "faults": faults,
            "missed polls": missed,
            "dropped polls": poller.dropped,
        }


def arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--devices", type=int, default=1000)
    parser.add_argument("--tags", type=int, default=100)
    parser.add_argument("--interval", type=float, default=1.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--json", type=Path)
    return parser.parse_args()


if __name__ == "__main__":
    main()

"""Runs `holdfast.Poller` under test: tags of 100 devices, each at an address of its own.

The printed figures cover the time after all devices have connected.
"""

from __future__ import annotations

import json
import sys
import time

from holdfast import Poller, Tag, TagList

DEVICES = 100
WARM_UP = 3.0

port, count, interval, seconds = int(sys.argv[1]), int(sys.argv[2]), *map(float, sys.argv[3:5])
tags = TagList(
    Tag(f"tag_{number}", "holding_registers", 2 * number, "float32") for number in range(count)
)


def missed(poller: Poller) -> int:
    return sum(each["missed"] for each in poller.counters().values())


with Poller() as poller:
    for number in range(DEVICES):
        poller.add(f"tcp://127.0.1.{1 + number}:{port}", tags, interval=interval)
    end = time.monotonic() + WARM_UP
    while time.monotonic() < end:
        poller.take(0.1)
    readings = batches = faults = 0
    before, began, cpu = missed(poller), time.monotonic(), time.process_time()
    while time.monotonic() < began + seconds:
        batch = poller.take(0.1)
        if batch is not None:
            batches += 1
            readings += len(batch)
            faults += sum(reading.fault != 0 for reading in batch)
    took, used = time.monotonic() - began, time.process_time() - cpu
    print(
        json.dumps(
            {
                "rate": readings / took,
                "cpu": used / took,
                "batches": batches / took,
                "faults": faults,
                "missed": missed(poller) - before,
                "dropped": poller.dropped,
            }
        )
    )

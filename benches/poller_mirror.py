"""Runs the poller under test: devices of ten blocks each, mirrored into one memory.

Every device has its own address, and so its own connection. The printed figures cover the time
after all devices have connected.
"""

from __future__ import annotations

import json
import resource
import sys
import time

import holdfast
from holdfast import _core

BLOCKS = 10
QUANTITY = 10
WARM_UP = 1.0

port, devices, interval, seconds = int(sys.argv[1]), int(sys.argv[2]), *map(float, sys.argv[3:5])
hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
memory = holdfast.Memory(holding_registers=1000)
poller = _core.Poller(
    [
        _core.PolledDevice(
            f"device-{number}",
            _core.Endpoint.network("tcp", f"127.0.{1 + number // 250}.{1 + number % 250}", port),
            unit=1,
            interval=interval,
            timeout=5.0,
            reads=[
                (
                    "holding_registers",
                    50 * at,
                    QUANTITY,
                    (memory, "holding_registers", 20 * at, None),
                )
                for at in range(BLOCKS)
            ],
        )
        for number in range(devices)
    ]
)


def totals() -> dict[str, int]:
    counters = poller.counters().values()
    keys = ("valid", "requests", "missed", "polls", "timeouts", "transport_errors")
    return {key: sum(device[key] for device in counters) for key in keys}


time.sleep(max(WARM_UP, interval * 1.5))
before, cpu, began = totals(), time.process_time(), time.perf_counter()
time.sleep(seconds)
took = time.perf_counter() - began
after, used = totals(), time.process_time() - cpu
poller.stop()
counted = {key: after[key] - before[key] for key in after}
print(json.dumps(counted | {"rate": counted["valid"] / took, "cpu": used / took}))

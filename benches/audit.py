"""Measures the audit log: lines per second, and the time until a line is in the file.

Lines are compared with a bare loop that encodes the same JSON and appends it: no chain, no
rotation, no look at what others do to the file. Times are those of the processor. The appliance
records Modbus writes that a client sends one after another; the time runs from the reply to the
line.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import statistics
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from holdfast.appliance import Appliance
from holdfast.config import load
from holdfast.events import log_lines
from holdfast.events.audit import Audit

if TYPE_CHECKING:
    from collections.abc import Callable

LINES = 20_000
FIELDS = {
    "listener": "scada",
    "peer": "10.0.0.7:51200",
    "unit": 1,
    "function": 16,
    "area": "holding_registers",
    "address": 2,
    "values": [7, 8],
    "outcome": "done",
}
CONFIGURATION = """
memories: {plant: {holding_registers: 10}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: read-write}]
audit: {file: audit.log}
"""
WRITE = bytes.fromhex("000100000006010600010001")


def main() -> None:
    """Prints lines per second, and times in milliseconds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--writes", type=int, default=3000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for batch in (1, 1000):
            rounds = [compared(Path(folder), batch) for _ in range(options.rounds)]
            rates = [statistics.median(each) for each in zip(*rounds, strict=True)]
            ratios = [ours / bare for ours, bare in rounds]
            print(
                f"{batch} lines at once: {rates[0]:,.0f} lines/s, "
                f"{statistics.median(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f}) "
                f"of the bare loop"
            )
        times = sorted(delays(Path(folder), options.writes))
    shown = {"median": times[len(times) // 2], "p99": times[len(times) * 99 // 100]}
    print("ms to the file:", json.dumps({**shown, "longest": times[-1]}))


def compared(folder: Path, batch: int) -> tuple[float, float]:
    """Lines per second of the audit log, and of the bare loop."""
    audit = Audit(folder / "audit.log", max_bytes=2**40, keep=1)
    ours = rate(lambda: audit.write_all([FIELDS] * batch), batch)
    audit.close()
    descriptor = os.open(folder / "bare.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    bare = rate(lambda: appended(descriptor, batch), batch)
    os.close(descriptor)
    for file in folder.glob("*.log"):
        file.unlink()
    return ours, bare


def appended(descriptor: int, batch: int) -> None:
    """Appends lines as the bare loop does."""
    now = log_lines.timestamp(time.time())
    lines = (msgspec.json.encode({"time": now, **FIELDS}) + b"\n" for _ in range(batch))
    os.write(descriptor, b"".join(lines))


def rate(call: Callable[[], object], batch: int) -> float:
    """Lines for each second of processor time."""
    began = time.process_time()
    for _ in range(LINES // batch):
        call()
    return LINES / (time.process_time() - began)


def delays(folder: Path, writes: int) -> list[float]:
    """Milliseconds from the reply to a Modbus write until its line is in the file."""
    file = folder / "plant.yaml"
    file.write_text(CONFIGURATION)
    found = []
    with Appliance(load(file)) as appliance:
        endpoint = appliance.endpoints()[0]
        log = folder / "audit.log"
        with socket.create_connection((endpoint.host, endpoint.port or 0)) as client:
            for _ in range(writes):
                size = log.stat().st_size
                client.sendall(WRITE)
                client.recv(64)
                began = time.perf_counter()
                while log.stat().st_size == size:
                    time.sleep(0.0001)
                found.append(1000 * (time.perf_counter() - began))
    return found


if __name__ == "__main__":
    main()

"""Measures how requests fare while `holdfast run` reloads its configuration.

Several connections are asked one after another. Rounds without and with reloads take turns; a
reload changes a rule for other peers. The appliance has one core, the client another one.
"""

from __future__ import annotations

import argparse
import os
import re
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from holdfast.appliance.control import ask

CONFIGURATION = """
memories: {{plant: {{holding_registers: 1000}}}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    max_connections_per_source: null
    rules:
      - {{sources: [127.0.0.1], units: {{1: plant}}, access: read-write}}
      - {{sources: [127.0.0.2], units: {{1: plant}}, access: {access}}}
"""
READ_TEN = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 0, 10)
REPLY_LEN = 29


class Reloads(threading.Thread):
    """Reloads `count` times within `seconds`."""

    def __init__(self, file: Path, count: int, seconds: float) -> None:
        super().__init__()
        self._file, self._count, self._seconds = file, count, seconds
        self.changed = 0

    def run(self) -> None:
        for number in range(self._count):
            write(self._file, number)
            self.changed += ask(self._file, "reload")["changed"] == ["listeners.scada"]
            time.sleep(self._seconds / self._count)


def write(file: Path, number: int) -> None:
    access = "read-write" if number % 2 else "read-only"
    file.write_text(CONFIGURATION.format(access=access))


def latencies(connections: list[socket.socket], until: threading.Thread) -> list[float]:
    """The sorted times of requests, in microseconds."""
    found = []
    until.start()
    while until.is_alive():
        for connection in connections:
            began = time.perf_counter()
            connection.sendall(READ_TEN)
            reply = connection.recv(300)
            found.append((time.perf_counter() - began) * 1e6)
            assert len(reply) == REPLY_LEN, reply
    until.join()
    return sorted(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connections", type=int, default=200)
    parser.add_argument("--reloads", type=int, default=50, help="in each round")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each round, about")
    parser.add_argument("--rounds", type=int, default=4)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_RUNTIME_DIR"] = folder
        file = Path(folder) / "plant.yaml"
        write(file, 1)
        command = ["taskset", "-c", "0", sys.executable, "-m", "holdfast", "run", str(file)]
        quiet = subprocess.DEVNULL
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=quiet, text=True) as process:
            assert process.stdout is not None
            lines = iter(process.stdout.readline, "")
            found = next(filter(None, (re.search(r"127\.0\.0\.1:(\d+)", line) for line in lines)))
            os.sched_setaffinity(0, {1})
            made = [
                socket.create_connection(("127.0.0.1", int(found[1])))
                for _ in range(options.connections)
            ]
            ratios = []
            for _ in range(options.rounds):
                slow = []
                for count in (0, options.reloads):
                    reloads = Reloads(file, count, options.seconds)
                    pause = threading.Thread(target=time.sleep, args=(options.seconds,))
                    times = latencies(made, reloads if count else pause)
                    p50, p999 = (times[int(len(times) * part)] for part in (0.5, 0.999))
                    slow.append(p999)
                    rate = len(times) / sum(times) * 1e6
                    told = f"{rate:.0f}/s, p50 {p50:.0f} us, p99.9 {p999:.0f} us"
                    print(f"{reloads.changed:3} reloads: {told}")
                ratios.append(slow[1] / slow[0])
            kept = len(ask(file, "sessions")["sessions"])
            print(f"connections kept: {kept} of {options.connections}")
            print(f"p99.9 with reloads, median ratio: {statistics.median(ratios):.2f}")
            process.terminate()


if __name__ == "__main__":
    main()

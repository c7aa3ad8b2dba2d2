"""Measures how start, reload and check of a configuration grow with the devices of a plant.

Each device is read into a memory, and has five tags, which a file receives. Nothing listens at the
addresses of the devices. A reload changes one device.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from holdfast.appliance.control import ask

TAGS = 5
PER_MEMORY = 50
HEAD = """\
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.1], units: {1: line0}, access: read-only}]
outputs: {table: {type: file, file: values.csv, format: csv}}
metrics: {bind: "127.0.0.1:0", values: true}
memories:
"""
DEVICE = """\
  device{number}:
    url: tcp://127.{high}.0.{low}:{port}
    interval: {interval}
    reads:
      - {{area: holding_registers, address: 0, count: 10,
         into: {{memory: line{memory}, area: holding_registers, address: {address}}}}}
    tags:
"""
TAG = "      t{number}: {{area: holding_registers, address: {address}, type: float32, unit: bar}}\n"
UNUSED_PORT = 9


def configuration(devices: int, interval: int) -> str:
    """A plant; the interval is that of the first device."""
    text = HEAD
    for memory in range(-(-devices // PER_MEMORY)):
        text += f"  line{memory}: {{holding_registers: {PER_MEMORY * 10}}}\n"
    text += "devices:\n"
    tags = "".join(TAG.format(number=number, address=2 * number) for number in range(TAGS))
    for number in range(devices):
        memory, place = divmod(number, PER_MEMORY)
        text += DEVICE.format(
            number=number,
            high=1 + number // 250,
            low=1 + number % 250,
            port=UNUSED_PORT,
            interval=5 if number else interval,
            memory=memory,
            address=place * 10,
        )
        text += tags
    return text


def measure(folder: Path, devices: int) -> dict[str, float]:
    """Seconds of start and reload, seconds of processor time of a check, and resident MB."""
    file = folder / "plant.yaml"
    file.write_text(configuration(devices, 5))
    holdfast = [str(Path(sys.executable).parent / "holdfast")]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([*holdfast, "check", str(file)], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    check = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    began = time.perf_counter()
    with subprocess.Popen(
        [*holdfast, "run", str(file)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        try:
            next(line for line in process.stdout if line.startswith("Ctrl-C"))
            start = time.perf_counter() - began
            status = Path(f"/proc/{process.pid}/status").read_text()
            file.write_text(configuration(devices, 6))
            began = time.perf_counter()
            answer = ask(file, "reload", within_s=60)
            reload = time.perf_counter() - began
            assert answer["changed"] == ["devices.device0"], answer
        finally:
            process.kill()
    found = re.search(r"VmRSS:\s+(\d+)", status)
    assert found is not None
    return {"start": start, "reload": reload, "check": check, "memory": int(found[1]) / 1024}


def main() -> None:
    """Prints a table, and writes all results to the file of `--json`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 10, 100, 1000])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    # Else each command compiles all its modules, which an installed one does not.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    results = {}
    print("| devices | start, s | reload, s | `check`, s of processor time | resident, MB |")
    print("| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_RUNTIME_DIR"] = folder
        for devices in options.devices:
            rounds = [measure(Path(folder), devices) for _ in range(options.rounds)]
            found = {key: median(each[key] for each in rounds) for key in rounds[0]}
            results[devices] = rounds
            figures = f"{found['start']:.2f} | {found['reload']:.2f} | {found['check']:.2f}"
            print(f"| {devices:,} | {figures} | {found['memory']:.0f} |", flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(results))


if __name__ == "__main__":
    main()

"""Runs the benchmarks one after another, each with its defaults, and prints what they print.

`--markdown FILE` writes it into a page, with the command of each, the commit and the machine. A
benchmark that fails, or whose peer is missing, is shown with the end of what it said.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

BENCHMARKS = {
    "server": "Modbus TCP",
    "tls": "Modbus TCP inside TLS",
    "growth": "Growth",
    "raw_ingest": "Raw Ingest",
    "http_front": "HTTP",
    "audit": "Audit log",
    "reload": "Reload",
    "adapter_load": "Modbus latency under adapter load",
    "start": "Start of commands",
    "plant": "Plants",
    "client": "Clients",
    "values": "Values",
    "poller": "Poller",
    "route": "Routes",
    "replicated": "Replicated memory",
    "scanner": "Scanner",
    "fleet": "Fleet",
    "memory": "Memory",
    "just_the_memory": "Just the memory",
    "mqtt_output": "MQTT output",
    "calibration": "Confidence of guesses",
    "address_search": "Search for addresses",
}
"""The benchmarks and the headings of their parts. `first_value` needs a wheel of `make dist`."""

LIMIT_S = 1800
SHOWN_ON_FAILURE = 10
"""Lines."""


def main() -> None:
    """Returns with 1 if a benchmark failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", help="names, separated by commas")
    parser.add_argument("--markdown", type=Path, help="file for a page")
    options = parser.parse_args()
    names = options.only.split(",") if options.only else list(BENCHMARKS)
    for unknown in set(names) - BENCHMARKS.keys():
        parser.error(f"unknown benchmark {unknown}, allowed: {', '.join(BENCHMARKS)}")
    page, has_failed = head(), False
    for name in names:
        print(f"{name} ...", flush=True)
        load = os.getloadavg()[0]
        began = time.monotonic()
        text, failed = output_of(name)
        has_failed |= failed
        took = time.monotonic() - began
        page += [
            f"## {BENCHMARKS[name]}",
            "",
            f"`make bench NAME={name}`, {took:.0f} s, load average before {load:.1f}"
            f"{'; **failed**' if failed else ''}.",
            "",
            *("```text", text, "```", ""),
        ]
        print(text, flush=True)
        if options.markdown:
            options.markdown.write_text("\n".join(page))
    sys.exit(int(has_failed))


def head() -> list[str]:
    """The first lines of the page."""
    asked = ("git", "describe", "--always", "--dirty")
    commit = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True).stdout.strip()
    machine = f"{platform.system()} on {platform.machine()}, {os.cpu_count()} cores"
    return [
        "# Benchmark runs",
        "",
        "What the benchmarks printed in one run. [benchmarks.md](benchmarks.md) says how they",
        "measure, and what the figures mean.",
        '`make bench NAME=all BENCH="--markdown docs/benchmark-runs.md"` writes this page.',
        "",
        f"{time.strftime('%Y-%m-%d')}, commit {commit or 'unknown'}, {machine}, "
        f"Python {platform.python_version()}.",
        "",
    ]


def output_of(name: str) -> tuple[str, bool]:
    """What a benchmark prints, and whether it failed."""
    command = [sys.executable, str(ROOT / "benches" / f"{name}.py")]
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            out, errors = process.communicate(timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            process.terminate()
            process.communicate()
            return f"not finished within {LIMIT_S} s", True
    if process.returncode:
        lines = (out + errors).rstrip().splitlines()
        return "\n".join(lines[-SHOWN_ON_FAILURE:]), True
    return out.rstrip(), False


if __name__ == "__main__":
    main()

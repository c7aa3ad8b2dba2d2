"""Measures TLS: handshakes, beside OpenSSL's own server, and requests, beside plain Modbus TCP.

`openssl s_time` makes one connection after another, with a client certificate, against Holdfast and
`openssl s_server` in turns: with a full handshake, or resuming a session. Then the blocking client
has one request of ten registers in flight, over TLS and over TCP in turns. The servers have one
core, their clients the other. Certificates have keys on the curve P-256.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import common
from common import Result, Round, Server, TurnFailed

if TYPE_CHECKING:
    from collections.abc import Iterator

CONFIGURATION = """
memories: {{plant: {{holding_registers: 100}}}}
listeners:
  plain:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{{sources: [127.0.0.1], units: {{1: plant}}, access: read-only}}]
  secure:
    type: modbus-tls
    bind: 127.0.0.1:0
    rules: [{{sources: [127.0.0.1], units: {{1: plant}}, access: read-only}}]
    tls: {{cert_file: {folder}/server.pem, key_file: {folder}/server.key, ca_file: {folder}/ca.pem}}
"""
HANDSHAKES = [("-tls1_3", "-new"), ("-tls1_2", "-new"), ("-tls1_2", "-reuse")]
"""`s_time` can't resume sessions of TLS 1.3: it does not wait for a ticket."""

READS = """
import sys, time
import holdfast
url, seconds = sys.argv[1], float(sys.argv[2])
with holdfast.SyncClient(url, unit=1) as client:
    for _ in range(200):
        client.read_holding_registers(0, 10)
    began, done = time.perf_counter(), 0
    while time.perf_counter() - began < seconds:
        for _ in range(100):
            client.read_holding_registers(0, 10)
        done += 100
    took = time.perf_counter() - began
print('{"rate": %f, "requests": %d, "answered": %d}' % (done / took, done, done + 200))
"""


def main() -> None:
    """Prints two tables, and writes all results to the file of `--json`."""
    options = common.parsed(common.parser(__doc__, seconds=3, rounds=7))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_certificates(folder)
        text = CONFIGURATION.format(folder=folder)
        with (
            common.appliance(text, options.core, 2) as holdfast,
            openssl_server(folder, options.core) as openssl,
        ):
            secure = holdfast.addresses["secure"]
            servers = {"holdfast": (secure, holdfast.process.pid), "openssl": openssl}
            handshakes = {
                f"{way} {version}": rounds_of_handshakes(servers, folder, version, way, options)
                for version, way in HANDSHAKES
            }
            show_handshakes(handshakes)
            reads = rounds_of_reads(holdfast, folder, options)
    show_reads(reads)
    if options.json:
        options.json.write_text(json.dumps({"handshakes": handshakes, "reads": reads}, indent=1))


def make_certificates(folder: Path) -> None:
    """Makes an authority, and what it signs for a server and a client."""
    cert = [str(Path(sys.executable).parent / "holdfast"), "cert"]
    for line in (
        ("ca", "Benchmark"),
        ("server", "server", "--san", "localhost", "--san", "127.0.0.1"),
        ("client", "panel"),
    ):
        subprocess.run([*cert, *line], cwd=folder, check=True, stdout=subprocess.DEVNULL)


@contextlib.contextmanager
def openssl_server(folder: Path, core: int) -> Iterator[tuple[str, int]]:
    """Runs OpenSSL's server, which requires client certificates. Yields address and pid."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    files = ["-cert", "server.pem", "-key", "server.key", "-CAfile", "ca.pem", "-Verify", "2"]
    command = ["openssl", "s_server", "-quiet", "-accept", f"127.0.0.1:{port}"]
    paths = [str(folder / each) if "." in each else each for each in files]
    with subprocess.Popen(
        [*command, *paths, "-verify_return_error"],
        stdin=subprocess.PIPE,  # It ends with its input.
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=common.pinned(core),
    ) as process:
        try:
            until = time.monotonic() + common.TIMEOUT
            while True:
                try:
                    socket.create_connection(("127.0.0.1", port), timeout=1).close()
                    break
                except OSError:
                    if process.poll() is not None or time.monotonic() > until:
                        raise RuntimeError("openssl s_server did not start") from None
            yield f"127.0.0.1:{port}", process.pid
        finally:
            process.kill()


def processor_time(pid: int) -> float:
    """The seconds of processor time of a process."""
    return time.clock_gettime(~pid << 3 | 2)


def rounds_of_handshakes(
    servers: dict[str, tuple[str, int]],
    folder: Path,
    version: str,
    way: str,
    options: argparse.Namespace,
) -> list[Round]:
    """Measures both servers in turns."""
    rounds: list[Round] = []
    files = ["-cert", "panel.pem", "-key", "panel.key", "-CAfile", "ca.pem"]
    for index in range(options.rounds):
        turn: dict[str, Result] = {}
        for name in common.turns(list(servers), index):
            address, pid = servers[name]
            command = ["openssl", "s_time", "-connect", address, version, way, *files]
            command += ["-time", str(max(1, round(options.seconds)))]
            before, began = processor_time(pid), time.perf_counter()
            done = subprocess.run(
                command,
                cwd=folder,
                capture_output=True,
                text=True,
                timeout=options.seconds + common.TIMEOUT,
                preexec_fn=common.pinned(options.other),
            )
            took, used = time.perf_counter() - began, processor_time(pid) - before
            found = re.search(r"(\d+) connections in", done.stdout)
            if done.returncode or found is None or not int(found[1]):
                raise TurnFailed(f"{name}: {done.stdout}{done.stderr}"[-2000:])
            count = int(found[1])
            turn[name] = {"rate": count / took, "server_us": used / count * 1e6}
        rounds.append(turn)
    return rounds


def rounds_of_reads(holdfast: Server, folder: Path, options: argparse.Namespace) -> list[Round]:
    """Measures one request in flight over TLS and over TCP, in turns."""
    files = f"ca={folder}/ca.pem&cert={folder}/panel.pem&key={folder}/panel.key"
    urls = {
        "TLS": f"tls://{holdfast.addresses['secure']}?{files}",
        "TCP": f"tcp://{holdfast.addresses['plain']}",
    }
    rounds: list[Round] = []
    for index in range(options.rounds):
        turn = {}
        for name in common.turns(list(urls), index):
            before = holdfast.cpu()
            command = [sys.executable, "-c", READS, urls[name], str(options.seconds)]
            turn[name] = common.outcome(command, options.seconds, options.other)
            used = holdfast.cpu() - before
            turn[name]["server_us"] = used / turn[name]["answered"] * 1e6
        rounds.append(turn)
    return rounds


def show_handshakes(all_rounds: dict[str, list[Round]]) -> None:
    print("\n| handshake | Holdfast/s | of `openssl s_server` | processor time, µs | OpenSSL, µs |")
    print("| --- | --- | --- | --- | --- |")
    for what, rounds in all_rounds.items():
        rate, cost = common.medians(rounds, "holdfast", "rate", "server_us")
        [other] = common.medians(rounds, "openssl", "server_us")
        against = common.ratio(rounds, "holdfast", "openssl")
        print(f"| {what} | {rate:,.0f} | {against} | {cost:.0f} | {other:.0f} |", flush=True)


def show_reads(rounds: list[Round]) -> None:
    tls, cost = common.medians(rounds, "TLS", "rate", "server_us")
    plain, plain_cost = common.medians(rounds, "TCP", "rate", "server_us")
    print(f"\nOne request in flight: {tls:,.0f} reads/s over TLS, {plain:,.0f} over TCP,")
    print(f"  ratio {common.ratio(rounds, 'TLS', 'TCP')}; processor time of the server")
    print(f"  {cost:.1f} and {plain_cost:.1f} us a request")


if __name__ == "__main__":
    main()

"""Compares REST and the gateway with a bare ASGI application on uvicorn.

Writes and reads ten registers over REST, writes a thousand, and reads ten registers of a device
through the gateway: 32 connections with one request in flight on each. Holdfast is `holdfast run`
with tokens, rules, an audit log and limits. The bare application parses the same JSON with msgspec,
and answers with the same JSON; it has no memory, no tokens and no device. Each runs in asyncio's
event loop and in uvloop.

By default, as in a configuration, the gateway sends the device one request at a time, and equal
reads that wait share a reply. With `--different` all reads differ; with `--in-flight 32` none of
them waits.

With `--against`, the server of another checkout takes part, which needs a built core and packages
of its own. `--watchers` measures event streams instead, and `--slow` connections that are slow or
idle.

The measured server has one core; the load and the device have the other. All servers run all the
time, but only one is under load at a time. Their order rotates. Ratios compare results of the same
round; figures are the medians of all rounds.
"""

from __future__ import annotations

import argparse
import hashlib
import http.client
import json
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import common
import http_slow
import http_watchers
from common import Result, Server, TurnFailed

if TYPE_CHECKING:
    from collections.abc import Iterator

CONNECTIONS = 32
LOOPS = ("asyncio", "uvloop")
TOKEN = "a token that protects nothing"
SHA256 = hashlib.sha256(TOKEN.encode()).hexdigest()
REST = f"""
memories:
  plant: {{holding_registers: 1000}}
audit: {{file: audit.log}}
listeners:
  modbus:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{{sources: [127.0.0.1], units: {{1: plant}}, access: read-only}}]
rest:
  bind: 127.0.0.1:0
  sources: [127.0.0.0/8]
  tokens:
    - name: benchmark
      sha256: {SHA256}
      memories: [plant]
      areas: [holding_registers]
      access: read-write
"""
LIMITS = "  max_connections_per_source: 64\n"
GATEWAY = f"""
gateway:
  bind: 127.0.0.1:0
  sources: [127.0.0.0/8]
  allow: [127.0.0.0/8:*]
  access: read-only
  tokens: [{{name: benchmark, sha256: {SHA256}}}]
"""
VALUES = [(address * 7919) % 65536 >> address % 16 for address in range(1000)]
"""Of one to five digits."""

QUERY = "memory=plant&area=holding_registers&address=0&count=10"
TITLES = {
    "write": "REST, write of ten registers",
    "read": "REST, read of ten registers",
    "bulk": "REST, write of 1,000 registers",
    "gateway": "gateway, read of ten registers of a device",
}


class Bench:
    """All servers, and the requests that they get."""

    def __init__(self, options: argparse.Namespace, stack: ExitStack) -> None:
        self._options, self._stack = options, stack
        self._folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        start = common.started("device", common.python("holdfast_server.py"), options.other)
        self._requests = requests(stack.enter_context(start).address)
        self.servers: dict[str, Server] = {}
        for name, loop, checkout in variants(options):
            gateway = f"{GATEWAY}  in_flight: {options.in_flight}\n"
            running = common.appliance(REST + LIMITS + gateway, options.core, 3, loop, checkout)
            self.servers[name] = stack.enter_context(running)
        self._start_peers()

    def _start_peers(self) -> None:
        """Starts the bare applications, which answer as Holdfast does."""
        first = next(iter(self.servers))
        answers = {kind: self.ask(first, kind) for kind in self._requests}
        file = self._folder / "answers.json"
        paths = {kind: path.partition("?")[0] for kind, (path, _) in self._requests.items()}
        known = {paths[kind]: json.loads(answer) for kind, answer in answers.items()}
        file.write_text(json.dumps(known))
        for loop in self._options.loops:
            command = common.python("bare_asgi.py", loop, file)
            running = common.started("bare", command, self._options.core)
            self.servers[f"bare, {loop}"] = self._stack.enter_context(running)
        for name in self.servers:
            for kind in self._requests:
                if self.ask(name, kind) != answers[kind]:
                    raise RuntimeError(f"the answer of {name} differs: {kind}")

    def ask(self, name: str, kind: str) -> bytes:
        """Sends a request, and returns the body of the answer."""
        path, body = self._requests[kind]
        headers = {"Authorization": f"Bearer {TOKEN}", "Content-Type": "application/json"}
        connection = http.client.HTTPConnection(self._address(name, kind), timeout=common.TIMEOUT)
        connection.request("GET" if body is None else "POST", path, body, headers)
        answer = connection.getresponse()
        found = answer.read()
        connection.close()
        if answer.status != http.HTTPStatus.OK:
            raise RuntimeError(f"{name}: {kind}: {answer.status}: {found!r}")
        return found

    def load(self, name: str, kind: str) -> Result:
        """Measures one server with one kind of request."""
        (path, body), address = self._requests[kind], self._address(name, kind)
        bodies = [body]
        if kind == "gateway" and self._options.different and body is not None:
            bodies = [
                json.dumps({**json.loads(body), "address": number}).encode()
                for number in range(CONNECTIONS)
            ]
        requests = [common.http_request(address, path, token=TOKEN, body=each) for each in bodies]
        command = common.http_load(address, self._folder / "request", requests, CONNECTIONS)
        return common.load(command, self._options.seconds, self._options.other, self.servers[name])

    def _address(self, name: str, kind: str) -> str:
        server = self.servers[name]
        service = "gateway" if kind == "gateway" else "rest"
        return server.addresses.get(service, server.address)


def requests(device: str) -> dict[str, tuple[str, bytes | None]]:
    """The path and the body of each kind of request."""
    host, _, port = device.rpartition(":")
    write = {"memory": "plant", "area": "holding_registers", "address": 0}
    read = {"host": host, "port": int(port), "functionCode": 3, "address": 0, "quantity": 10}
    return {
        "write": ("/api/v1/ingest", json.dumps({**write, "values": VALUES[:10]}).encode()),
        "bulk": ("/api/v1/ingest", json.dumps({**write, "values": VALUES}).encode()),
        "read": (f"/api/v1/memory/read?{QUERY}", None),
        "gateway": ("/api/modbus/read", json.dumps(read).encode()),
    }


def variants(options: argparse.Namespace) -> Iterator[tuple[str, str, Path | None]]:
    """The name, the event loop and the checkout of each Holdfast."""
    for loop in options.loops:
        yield f"holdfast, {loop}", loop, None
        if options.against:
            yield f"{options.against.name}, {loop}", loop, options.against


def main() -> None:
    """Prints the tables, and writes all results to the file of `--json`."""
    options = arguments()
    results: object
    if options.watchers:
        results = http_watchers.measured(options, list(variants(options)))
    elif options.slow:
        results = http_slow.measured(options, list(variants(options)), REST, write)
    else:
        results = requests_measured(options)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))


def arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = common.parser(__doc__, seconds=2, rounds=9)
    parser.add_argument("--against", type=Path, help="folder of another checkout to compare with")
    parser.add_argument(
        "--in-flight", type=int, default=1, help="of the gateway to the device; default 1"
    )
    parser.add_argument(
        "--different",
        action="store_true",
        help="no reads of the device are equal",
    )
    parser.add_argument("--loops", default=",".join(LOOPS), help="default: asyncio,uvloop")
    parser.add_argument("--only", default=",".join(TITLES), help=f"default: {','.join(TITLES)}")
    parser.add_argument("--watchers", action="store_true", help="measure 100 event streams")
    parser.add_argument("--slow", action="store_true", help="measure slow and idle connections")
    options = common.parsed(parser)
    options.loops, options.only = options.loops.split(","), options.only.split(",")
    return options


def write(address: str) -> bytes:
    """A request that writes ten registers."""
    path, body = requests(address)["write"]
    return common.http_request(address, path, token=TOKEN, body=body)


def requests_measured(options: argparse.Namespace) -> dict[str, list[dict[str, Result]]]:
    """Measures all kinds of requests. A server that fails in a turn has no result in that round."""
    rounds: dict[str, list[dict[str, Result]]] = {kind: [] for kind in options.only}
    with ExitStack() as stack:
        bench = Bench(options, stack)
        for index in range(options.rounds):
            for kind, found in rounds.items():
                found.append({})
                for name in common.turns(list(bench.servers), index):
                    try:
                        found[-1][name] = bench.load(name, kind)
                    except TurnFailed as failure:
                        print(f"{name}, {kind}: failed: {failure}", flush=True)
    for kind, found in rounds.items():
        show(TITLES[kind], found, list(bench.servers))
    return rounds


def show(title: str, rounds: list[dict[str, Result]], names: list[str]) -> None:
    """Prints one table."""
    peers = [name for name in names if name.startswith("bare")]
    print(f"\n{title}, {CONNECTIONS} connections:")
    print("  server                requests/s   p50 us   p99 us  cpu us/request  load busy", end="")
    print("".join(f"  of {peer:22}" for peer in peers))
    for name in names:
        if not any(name in one for one in rounds):
            continue
        rate, p50, p99, cpu, busy = common.medians(
            rounds, name, "rate", "p50", "p99", "server_us", "busy"
        )
        ratios = "".join(f"  {common.ratio(rounds, name, peer):25}" for peer in peers)
        print(
            f"  {name:20}  {rate:10,.0f}  {p50:7,.0f}  {p99:7,.0f}  {cpu:14.1f}  {busy:9.0%}"
            f"{ratios}".rstrip()
        )
    sys.stdout.flush()


if __name__ == "__main__":
    main()

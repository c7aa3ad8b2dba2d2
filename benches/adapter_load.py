"""Measures the latency of one polite Modbus client while the appliance's adapters are under load.

The client reads 10 registers with one request in flight: first at a fixed rate, then in a closed
loop. It runs alone, or together with

rest   2 clients that post bodies of 8 MiB in a loop; each body writes the memory that the polite
       client reads many times;
mqtt   a publisher that floods the broker with commands of 100 registers, QoS 0;
both   rest and mqtt;
burn   an unrelated process that keeps the appliance's core busy, at nice 0, nice 10 and SCHED_IDLE:
       the reference for the cost of the system's scheduler.

The appliance with all its threads has one core, and the burning process shares that core. The
polite client has the other core. The loads and the broker run there too, but under SCHED_IDLE, so
that the polite client never waits for them. The order of the variants rotates. Ratios compare a
variant with `alone` in the same round; figures are the medians of all rounds.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import common
from common import Result

TOKEN = "a token that protects nothing"
VALUE = 7
REGISTERS = 65536
MAX_BODY = 8 * 2**20
QUANTITY = 10
RATES = {"2,000 requests a second": 2000, "a closed loop": 0}
BURNERS = {"burn nice 0": 0, "burn nice 10": 10, "burn idle": None}
VARIANTS = ["alone", "rest", "mqtt", "both", *BURNERS]
QUIET = 0.3
"""Seconds without processor time after which a server counts as idle."""


def configuration(broker: int) -> str:
    return f"""
memories:
  plant: {{holding_registers: {REGISTERS}}}
listeners:
  modbus:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{{sources: [127.0.0.1], units: {{1: plant}}, access: read-only}}]
rest:
  bind: 127.0.0.1:0
  sources: [127.0.0.1]
  max_body: {MAX_BODY}
  request_timeout: 60
  tokens:
    - name: benchmark
      sha256: {hashlib.sha256(TOKEN.encode()).hexdigest()}
      memories: [plant]
      areas: [holding_registers]
      access: read-write
mqtt:
  url: mqtt://127.0.0.1:{broker}
  client_id: holdfast
  subscriptions: [{{topic: ingest, memories: [plant], areas: [holding_registers]}}]
"""


def command(count: int) -> str:
    values = ",".join([str(VALUE)] * count)
    return f'{{"memory":"plant","area":"holding_registers","address":0,"values":[{values}]}}'


class Bench:
    """The appliance, its broker, and the loads."""

    def __init__(self, options: argparse.Namespace, stack: ExitStack) -> None:
        self.options = options
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        self.request, self.message = folder / "request", folder / "message.json"
        self.message.write_text(command(100))
        self.broker = stack.enter_context(self._broker(folder))
        self.server = stack.enter_context(
            common.appliance(configuration(self.broker), options.core, listeners=2)
        )
        self.modbus, self.rest = self.server.addresses["modbus"], self.server.addresses["rest"]
        self._check()

    @contextlib.contextmanager
    def _broker(self, folder: Path) -> Iterator[int]:
        """Runs Mosquitto on a free port."""
        program = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin")
        if program is None:
            sys.exit("mosquitto is not installed")
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            port = int(taken.getsockname()[1])
        file = folder / "mosquitto.conf"
        file.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\nuser root\n")
        with common.running([program, "-c", str(file)], self.options.other, idle=True):
            _wait("mosquitto did not start", lambda: _listens(port))
            yield port

    def _check(self) -> None:
        """Writes over REST and MQTT, and checks over Modbus that the values arrived."""
        _wait("no connection to the broker", lambda: self.ask("diagnostics/mqtt")["connected"])
        post = [*self._post(1), "--warmup", "0", "--seconds", "0.1"]
        subprocess.run(post, check=True, stdout=subprocess.DEVNULL)
        if common.ask(self.modbus, QUANTITY)[9:] != VALUE.to_bytes(2, "big") * QUANTITY:
            raise RuntimeError("the memory does not hold what was sent")
        with self._flood():
            _wait("no MQTT message arrived", lambda: self.ask("diagnostics/mqtt")["received"] > 0)
        if self._counts()["mqtt"]["refused"]:
            raise RuntimeError("the appliance refused MQTT messages")
        self.settle()

    def ask(self, what: str) -> Any:
        """Gets a resource of the appliance's REST interface."""
        request = urllib.request.Request(f"http://{self.rest}/api/v1/{what}")
        request.add_header("Authorization", f"Bearer {TOKEN}")
        with urllib.request.urlopen(request, timeout=common.TIMEOUT) as answer:
            return json.load(answer)

    def _counts(self) -> Any:
        return self.ask("diagnostics/stats")["adapters"]

    def settle(self) -> None:
        """Waits until the server has finished all work."""
        _wait("the server did not become idle", self._is_idle)

    def _is_idle(self) -> bool:
        before = self.server.cpu()
        time.sleep(QUIET)
        return self.server.cpu() - before < QUIET / 10

    def _post(self, connections: int) -> list[str]:
        whole = command(REGISTERS)
        body = f"[{','.join([whole] * ((MAX_BODY - 1) // (len(whole) + 1)))}]".encode()
        request = common.http_request(self.rest, "/api/v1/ingest", token=TOKEN, body=body)
        return common.http_load(self.rest, self.request, [request], connections)

    def _flood(self) -> contextlib.AbstractContextManager[object]:
        flood = common.bench(
            "flood",
            *("--address", f"127.0.0.1:{self.broker}"),
            *("--topic", "ingest"),
            *("--message", self.message),
        )
        return common.running(flood, self.options.other, idle=True)

    @contextlib.contextmanager
    def loaded(self, variant: str) -> Iterator[None]:
        """Runs the loads of a variant."""
        other = self.options.other
        with ExitStack() as stack:
            if variant in ("rest", "both"):
                post = [*self._post(2), "--seconds", "100000"]
                stack.enter_context(common.running(post, other, idle=True))
            if variant in ("mqtt", "both"):
                stack.enter_context(self._flood())
            if variant in BURNERS:
                burn = [sys.executable, "-c", "while True: pass"]
                nice = BURNERS[variant]
                if nice:
                    burn = ["nice", "-n", str(nice), *burn]
                stack.enter_context(common.running(burn, self.options.core, idle=nice is None))
            time.sleep(0 if variant == "alone" else QUIET)
            yield

    def turn(self, variant: str) -> dict[str, Result]:
        """Measures the polite client at each rate."""
        results = {}
        before, start = self._counts(), time.monotonic()
        with self.loaded(variant):
            for name, rate in RATES.items():
                polite = common.bench(
                    "polite",
                    *("--address", self.modbus),
                    *("--quantity", QUANTITY),
                    *("--rate", rate),
                )
                waited = self._waited()
                results[name] = common.load(
                    polite, self.options.seconds, self.options.other, self.server
                )
                answered = results[name]["answered"]
                results[name]["queued_us"] = (self._waited() - waited) / answered / 1e3
        self.settle()
        elapsed, after = time.monotonic() - start, self._counts()
        for result in results.values():
            for adapter in ("rest", "mqtt"):
                done = after[adapter]["accepted"] - before[adapter]["accepted"]
                result[adapter] = done / elapsed
        return results

    def _waited(self) -> int:
        """Returns the nanoseconds that the Modbus thread was ready but did not run."""
        for task in Path(f"/proc/{self.server.process.pid}/task").iterdir():
            if (task / "comm").read_text().startswith("holdfast-io"):
                return int((task / "schedstat").read_text().split()[1])
        raise RuntimeError("no thread serves Modbus")


def main() -> None:
    """Prints a table for each rate, and writes all results to the file of `--json`."""
    options = common.parsed(common.parser(__doc__, seconds=4, rounds=7))
    rounds: dict[str, list[dict[str, Result]]] = {name: [] for name in RATES}
    with ExitStack() as stack:
        bench = Bench(options, stack)
        for index in range(options.rounds):
            turns = {variant: bench.turn(variant) for variant in common.turns(VARIANTS, index)}
            for name, measured in rounds.items():
                measured.append({variant: results[name] for variant, results in turns.items()})
    for name, measured in rounds.items():
        show(name, measured)
    if options.json:
        options.json.write_text(json.dumps(rounds, indent=1))


def show(name: str, rounds: list[dict[str, Result]]) -> None:
    """Prints one table. `queued` is the time that the Modbus thread waited for its core."""
    print(f"\nOne client, {name}; latencies in us:")
    print(
        "                  p50      p99    p99.9      max   queued  bodies/s  messages/s"
        "  p99.9 against alone (min to max)"
    )
    keys = ("p50", "p99", "p999", "max", "queued_us", "rest", "mqtt")
    for variant in VARIANTS:
        p50, p99, p999, most, queued, rest, mqtt = common.medians(rounds, variant, *keys)
        against = "" if variant == "alone" else common.ratio(rounds, variant, "alone", "p999")
        print(
            f"  {variant:12} {p50:8.1f} {p99:8.1f} {p999:8.1f} {most:8.0f} {queued:8.2f}"
            f"  {rest:8.1f}  {mqtt:10,.0f}  {against}".rstrip()
        )


def _wait(problem: str, done: Callable[[], bool]) -> None:
    """Waits until `done` returns true. Raises `RuntimeError` after a timeout."""
    end = time.monotonic() + common.TIMEOUT
    while not done():
        if time.monotonic() > end:
            raise RuntimeError(problem)
        time.sleep(0.05)


def _listens(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
        return True
    return False


if __name__ == "__main__":
    main()

"""Measures the processor time of the gateway with 100 watchers of one device, as in its console."""

from __future__ import annotations

import json
import selectors
import socket
import sys
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import common
from common import Result, Server

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence
    from pathlib import Path

WATCHERS = 100
INTERVAL = 200
"""Milliseconds from poll to poll of each watcher."""

WRITE = bytes.fromhex("000100000006010600000000")
PATH = "/api/modbus/watch/view"
CHANGE = b"event: change"


class Device:
    """A device whose first register changes faster than the watchers look."""

    def __init__(self, core: int, stack: ExitStack) -> None:
        start = common.started("device", common.python("holdfast_server.py"), core)
        self.address = stack.enter_context(start).address
        host, _, port = self.address.rpartition(":")
        self._connection = stack.enter_context(socket.create_connection((host, int(port))))
        self._value = 0

    def change(self) -> None:
        """Changes the register."""
        self._value = (self._value + 1) % 65536
        self._connection.sendall(WRITE[:-2] + self._value.to_bytes(2, "big"))
        self._connection.recv(64)


def measured(
    options: argparse.Namespace, variants: Sequence[tuple[str, str, Path | None]]
) -> list[dict[str, Result]]:
    """Measures each gateway once per round, and prints the table."""
    rounds: list[dict[str, Result]] = []
    with ExitStack() as stack:
        device = Device(options.other, stack)
        gateways: dict[str, Server] = {}
        for name, loop, checkout in variants:
            command = common.python("holdfast_gateway.py", loop, device.address, checkout=checkout)
            running = common.started(name, command, options.core)
            gateways[name] = stack.enter_context(running)
        for index in range(options.rounds):
            names = common.turns(list(gateways), index)
            rounds.append({name: turn(gateways[name], device, options.seconds) for name in names})
    show(rounds, list(gateways))
    return rounds


def turn(gateway: Server, device: Device, seconds: float) -> Result:
    """Opens all streams, and measures for some seconds what they cost."""
    with ExitStack() as stack, selectors.DefaultSelector() as selector:
        for _ in range(WATCHERS):
            selector.register(stack.enter_context(watcher(gateway, device)), selectors.EVENT_READ)
        received(selector, device, INTERVAL / 1000)
        cpu, began = gateway.cpu(), time.monotonic()
        events = received(selector, device, seconds)
        used, elapsed = gateway.cpu() - cpu, time.monotonic() - began
    if events < WATCHERS:
        raise RuntimeError(f"{gateway.name}: {events} events in {elapsed:.1f} s")
    return {"core": used / elapsed, "events": events / elapsed, "event_us": used / events * 1e6}


def watcher(gateway: Server, device: Device) -> socket.socket:
    """Opens a stream, and waits for its first event."""
    host, _, port = device.address.rpartition(":")
    part = {"functionCode": 3, "address": 0, "quantity": 10}
    asked = {"host": host, "port": int(port), "parts": [part], "interval": INTERVAL}
    at, _, number = gateway.address.rpartition(":")
    connection = socket.create_connection((at, int(number)), timeout=common.TIMEOUT)
    body = json.dumps(asked).encode()
    connection.sendall(common.http_request(gateway.address, PATH, body=body))
    answer = b""
    while b"event: " not in answer:
        more = connection.recv(65536)
        answer += more
        if not more or not answer.startswith(b"HTTP/1.1 200 "):
            connection.close()
            raise RuntimeError(f"{gateway.name}: no stream: {answer[:1000]!r}")
    return connection


def received(selector: selectors.BaseSelector, device: Device, seconds: float) -> int:
    """Counts changes that arrive within some seconds."""
    found, end, due = 0, time.monotonic() + seconds, 0.0
    while (now := time.monotonic()) < end:
        if now >= due:
            device.change()
            due = now + INTERVAL / 4000
        for key, _ in selector.select(min(end, due) - now):
            connection: Any = key.fileobj
            more = connection.recv(65536)
            if not more:
                raise RuntimeError("a stream has ended")
            found += more.count(CHANGE)
    return found


def show(rounds: list[dict[str, Result]], names: list[str]) -> None:
    """Prints the table."""
    print(f"\n{WATCHERS} watchers of one device, every {INTERVAL} ms:")
    print("  gateway               events/s  % of a core  cpu us/event  cpu/event of the first")
    for name in names:
        events, core, each = common.medians(rounds, name, "events", "core", "event_us")
        compared = common.ratio(rounds, name, names[0], "event_us")
        print(f"  {name:20}  {events:8,.0f}  {100 * core:11.1f}  {each:12.1f}  {compared}")
    sys.stdout.flush()

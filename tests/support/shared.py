"""A device that bears one connection and one request at a time, and appliances that use it."""

from __future__ import annotations

import contextlib
import http.client
import json
import select
from typing import TYPE_CHECKING, Any

from support import web, wire
from support.routed import LOOPBACK, configuration
from support.running import endpoint

if TYPE_CHECKING:
    from holdfast.appliance import Appliance
    from support.fake_device import Asked

GATEWAY = {
    "bind": "127.0.0.1:0",
    "sources": LOOPBACK,
    "allow": ["127.0.0.0/8:*"],
    "access": "read-write",
    "tokens": "none",
}

WINDOW = 0.002
"""Seconds in which a request that overlaps another one would arrive."""


class Careful:
    """Behaves as a correct device, and counts requests that come before the last was answered."""

    def __init__(self) -> None:
        self.overlaps = 0

    def __call__(self, asked: Asked) -> None:
        peer: Any = asked.peer
        early, _, _ = select.select([peer.socket], [], [], WINDOW)
        self.overlaps += bool(early) or bool(peer.received)
        asked.answer()


def with_gateway(url: str, **more: Any) -> str:
    """A configuration with a gateway, the listener `scada` and the link `bus` to the device."""
    return configuration(url, gateway=GATEWAY, **more)


def polled(url: str) -> dict[str, Any]:
    """The sections of a device `meter`, whose first ten holding registers are polled."""
    into = {"memory": "plant", "area": "holding_registers", "address": 0}
    read = {"area": "holding_registers", "address": 0, "count": 10, "into": into}
    meter = {"url": url, "unit": 1, "interval": 0.01, "timeout": wire.DEADLINE, "reads": [read]}
    return {"memories": {"plant": {"holding_registers": 10}}, "devices": {"meter": meter}}


def ask(appliance: Appliance, path: str, port: int, **body: Any) -> web.Answer:
    """Asks a device on this port over the gateway."""
    client = web.Client(endpoint(appliance, "gateway"))
    with contextlib.closing(client):
        return client.ask("POST", f"/api/modbus{path}", {"host": "127.0.0.1", "port": port, **body})


def read(appliance: Appliance, port: int, address: int, **body: Any) -> web.Answer:
    """Reads a holding register over the gateway."""
    return ask(appliance, "/read", port, functionCode=3, address=address, **body)


def unanswered(appliance: Appliance, path: str, body: Any) -> http.client.HTTPConnection:
    """Sends a request to the gateway, whose answer is not read."""
    sent = http.client.HTTPConnection(*endpoint(appliance, "gateway"), timeout=wire.DEADLINE)
    sent.request("POST", f"/api/modbus{path}", json.dumps(body), web.JSON)
    return sent

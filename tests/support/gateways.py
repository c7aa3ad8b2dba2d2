"""Runs gateways on a free port, sends HTTP requests, and reads event streams."""

from __future__ import annotations

import contextlib
import http.client
import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from holdfast.adapters import Stop
from holdfast.client.client import connection
from holdfast.config.values.allow_entries import parse_allowed
from holdfast.gateway import Gateway, GatewayLimits, Settings
from holdfast.net.http.port import listen
from holdfast.net.resolver import NoSuchName
from support import web, wire
from support.event_streams import EventStream

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from holdfast.client.async_transports import OwnTransport
    from holdfast.client.url import NetworkTarget
    from holdfast.net.resolver import Resolve

API = "/api/modbus"
PLC = "plc.factory.local"


class Dialed:
    """Creates connections as the gateway does, and records their targets; can redirect some."""

    def __init__(self, elsewhere: dict[tuple[str, int], tuple[str, int]] | None = None) -> None:
        self.calls: list[NetworkTarget] = []
        self._elsewhere = elsewhere or {}

    def __call__(self, target: NetworkTarget, in_flight: int) -> OwnTransport:
        self.calls.append(target)
        host, port = self._elsewhere.get((target.host, target.port), (target.host, target.port))
        there = replace(target, host=host, port=port)
        return connection(there, in_flight)


class Names:
    """A resolver that returns its answers in order, and repeats the last one."""

    def __init__(self, **names: list[list[str]]) -> None:
        self.asked: list[str] = []
        self._names = {name.replace("_", "."): list(answers) for name, answers in names.items()}

    async def __call__(self, host: str) -> list[str]:
        self.asked.append(host)
        answers = self._names.get(host)
        if answers is None:
            raise NoSuchName(host, "Name or service not known")
        return answers.pop(0) if len(answers) > 1 else answers[0]


class Running:
    """A running gateway with a client."""

    def __init__(self, gateway: Gateway, address: tuple[str, int], stop: Stop) -> None:
        self.gateway = gateway
        self.stop = stop
        self.address = address
        self.url = f"http://{gateway.address}"
        self._open = contextlib.ExitStack()

    def client(self, secret: str | None = None) -> web.Client:
        """Creates a client that is closed with the gateway."""
        client = web.Client(self.address, secret)
        self._open.callback(client.close)
        return client

    def ask(self, path: str, body: Any, secret: str | None = None) -> web.Answer:
        """Sends a POST request and returns the response."""
        return self.client(secret).ask("POST", API + path, body)

    def stream(
        self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None
    ) -> EventStream:
        connection = http.client.HTTPConnection(*self.address, timeout=wire.DEADLINE)
        self._open.callback(connection.close)
        sent = None if body is None else json.dumps(body)
        connection.request(method, API + path, sent, {**web.JSON, **(headers or {})})
        return EventStream(connection)

    def close(self) -> None:
        self._open.close()


@contextlib.contextmanager
def running(
    *,
    allow: Sequence[str] = ("127.0.0.0/8:*",),
    resolve: Resolve | None = None,
    dialed: Dialed | None = None,
    bind: str = "127.0.0.1",
    limits: dict[str, Any] | None = None,
    **settings: Any,
) -> Iterator[Running]:
    """Runs a gateway; by default it reads and writes any device on the loopback interface."""
    listener = listen(bind, 0)
    host, port, *_ = listener.getsockname()
    chosen = Settings(
        tuple(map(parse_allowed, allow)),
        limits=replace(GatewayLimits(), **(limits or {})),
        **{"writes": True, **settings},
    )
    gateway = Gateway(chosen, listener, resolve=resolve, dial=dialed or connection)
    stop = Stop()
    with listener, web.in_a_thread(gateway, stop):
        started = Running(gateway, (host, port), stop)
        try:
            yield started
        finally:
            started.close()

"""Runs HTTP adapters in a thread, as the appliance does, and HTTP clients for them.

`Client` uses the standard library's client, `raw` sends bytes as given.
"""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import json
import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, cast

from holdfast.adapters import MemoryAccess, Stop
from holdfast.adapters.rest import Rest
from holdfast.appliance.diagnostics import Diagnostics
from holdfast.appliance.liveness import Liveness
from holdfast.appliance.services.supervision import Supervisor
from holdfast.config.models.services import RestConfig
from holdfast.net.http.port import listen
from holdfast.net.http.server import STOP_TIMEOUT_S
from support import wire

if TYPE_CHECKING:
    import ssl
    from collections.abc import Iterator, Mapping

    import holdfast
    from holdfast._core import ListeningSocket
    from holdfast.appliance.parts.part import Part
    from holdfast.events.audit import Audit
    from holdfast.net.http.https import Https
    from holdfast.types import ThreadHeartbeat

AREAS = ("coils", "discrete_inputs", "holding_registers", "input_registers")
JSON = {"Content-Type": "application/json"}
INGEST = "/api/v1/ingest"
READ = "/api/v1/memory/read"

LOOPBACK = ["127.0.0.0/8", "::1"]


def token(
    name: str,
    secret: str,
    *,
    memories: tuple[str, ...] = ("plant_a",),
    areas: tuple[str, ...] = AREAS,
    access: str = "read-write",
    manage: bool = False,
) -> dict[str, object]:
    """Builds the configuration of a token."""
    digest = hashlib.sha256(secret.encode()).hexdigest()
    return {
        "name": name,
        "sha256": digest,
        "memories": list(memories),
        "areas": list(areas),
        "manage": manage,
        "access": access,
    }


def command(area: str, address: Any, values: Any, memory: Any = "plant_a") -> dict[str, Any]:
    return {"memory": memory, "area": area, "address": address, "values": values}


@dataclass
class Answer:
    """A response."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Client:
    """A connection that stays open, as far as the server allows it."""

    def __init__(
        self,
        address: tuple[str, int],
        secret: str | None = None,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._connection = (
            http.client.HTTPConnection(*address, timeout=wire.DEADLINE)
            if tls is None
            else http.client.HTTPSConnection(*address, timeout=wire.DEADLINE, context=tls)
        )
        self._more = {} if secret is None else {"Authorization": f"Bearer {secret}"}

    def ask(
        self, method: str, path: str, body: Any = None, headers: Mapping[str, str] = JSON
    ) -> Answer:
        """Sends one request; a body that is not bytes is sent as JSON."""
        if body is not None and not isinstance(body, bytes):
            body = json.dumps(body).encode()
        self._connection.request(method, path, body, {**headers, **self._more})
        reply = self._connection.getresponse()
        lower = {name.lower(): value for name, value in reply.getheaders()}
        return Answer(reply.status, lower, reply.read())

    def get(self, path: str) -> Answer:
        return self.ask("GET", path, headers={})

    def ingest(self, body: Any) -> Answer:
        return self.ask("POST", INGEST, body)

    def read(self, area: str, address: object, count: object, memory: str = "plant_a") -> Answer:
        return self.get(f"{READ}?memory={memory}&area={area}&address={address}&count={count}")

    def close(self) -> None:
        self._connection.close()


@dataclass
class StandIn:
    """Replaces the parts of an appliance for diagnostics."""

    listeners: dict[str, Any] = field(default_factory=dict)
    events_lost: int = 0
    threads: list[ThreadHeartbeat] = field(default_factory=list)
    audit: dict[str, object] | None = None
    logs: dict[str, Any] = field(default_factory=dict)

    def heartbeats(self) -> list[ThreadHeartbeat]:
        return self.threads

    def stats(self) -> dict[str, Any]:
        of_no_part = ("devices", "links", "memory_files", "certificates")
        return {
            **{key: {} for key in (*of_no_part, "revocation_lists")},
            "listeners": self.listeners,
            "events_lost": self.events_lost,
            "tag_polls_dropped": 0,
            "audit": self.audit,
            "logs": self.logs,
        }


def diagnostics_of(
    memories: Mapping[str, holdfast.Memory], others: StandIn | None = None, *parts: Part
) -> Diagnostics:
    """Diagnostics of these parts, and of a replacement for the others."""
    chosen: Any = others or StandIn()
    return Diagnostics(memories, Liveness(chosen.heartbeats), [chosen, *parts], {}, list)


def stand_in(diagnostics: Diagnostics) -> StandIn:
    """What the diagnostics read in place of an appliance."""
    found: Any = diagnostics._parts[0]
    return cast("StandIn", found)


class NoSessions:
    """Replaces the listeners of an appliance: there are no connections."""

    def sessions(self) -> list[dict[str, Any]]:
        return []

    def end_session(self, *_: object) -> bool:
        return False


class Service:
    """A REST adapter with its supervisor."""

    def __init__(
        self,
        memories: Mapping[str, holdfast.Memory],
        *,
        audit: Audit | None = None,
        bind: str = "127.0.0.1:0",
        https: Https | None = None,
        stop_timeout: float = STOP_TIMEOUT_S,
        **settings: Any,
    ) -> None:
        self.https = https
        self.stop_timeout = stop_timeout
        given = {
            "bind": bind,
            "sources": LOOPBACK,
            "tokens": "none",
            "request_timeout": wire.DEADLINE,
            **settings,
        }
        self.settings = RestConfig.model_validate(given)
        self.memories = memories
        self.memory_access = MemoryAccess("rest", memories, audit)
        self.diagnostics = diagnostics_of(memories)
        self.listener = listen(self.settings.bind.host, self.settings.bind.port)
        self.supervisor = Supervisor("rest", self.made, access=self.memory_access)
        self.diagnostics.adapters["rest"] = self.supervisor

    def made(self) -> Rest:
        parts = (self.settings, self.memory_access, self.diagnostics)
        more: Any = {"https": self.https, "stop_timeout": self.stop_timeout}
        return Rest(*parts, NoSessions(), self.listener, **more)

    @property
    def address(self) -> tuple[str, int]:
        host, port, *_ = self.listener.getsockname()
        return host, port

    def refusals(self) -> dict[str, int]:
        found: Any = self.memory_access.counts()["refused"]
        return dict(found)

    def connections(self) -> dict[str, int]:
        found: Any = self.supervisor.status()["connections"]
        return dict(found)

    def until_counted(self, event: str, times: int = 1) -> None:
        wire.until(lambda: self.connections()[event] >= times, f"{times} times {event}")


@contextlib.contextmanager
def supervised(supervisor: Supervisor, listener: ListeningSocket) -> Iterator[None]:
    """Runs an adapter. At the end its thread must have stopped, without a failure."""
    supervisor.start()
    wire.until(lambda: supervisor.status()["state"] == "running", "it runs")
    try:
        yield
    finally:
        supervisor.stop()
        supervisor.join()
        listener.close()
    status = supervisor.status()
    assert (status["state"], status["restarts"]) == ("stopped", 0), status["last_error"]


class Runs(Protocol):
    """An adapter or a server."""

    def run(self, stop: Stop) -> None: ...


@contextlib.contextmanager
def in_a_thread(what: Runs, stop: Stop | None = None) -> Iterator[None]:
    """Runs an adapter or a server. At the end its thread must have stopped without an error."""
    stop = stop or Stop()
    with ThreadPoolExecutor(1) as threads:
        running = threads.submit(what.run, stop)
        try:
            yield
        finally:
            stop.set()
            running.result(wire.DEADLINE)


def head(
    method: str, path: str, *headers: str, host: str = "127.0.0.1", version: str = "1.1"
) -> bytes:
    """Builds the header of a request."""
    lines = [f"{method} {path} HTTP/{version}", f"Host: {host}", *headers, "", ""]
    return "\r\n".join(lines).encode("latin-1")


def status_for_another(address: tuple[str, int], path: str, places: int) -> int:
    """Requests a path from 127.0.0.2 while 127.0.0.1 holds the places it can have, of `places`.

    It has begun a request on each connection. Returns the status.
    """
    with contextlib.ExitStack() as held:
        for _ in range(places):
            connection = held.enter_context(wire.Connection(address))
            with contextlib.suppress(ConnectionError):  # It is refused.
                connection.send(head("GET", path)[:-2])
        other = held.enter_context(wire.Connection(address, source="127.0.0.2"))
        other.send(head("GET", path, "Connection: close"))
        [answer] = answers(other.rest())
    return answer.status


def post(body: bytes, *headers: str) -> bytes:
    """Builds a whole ingest request."""
    length = f"Content-Length: {len(body)}"
    return head("POST", INGEST, "Content-Type: application/json", length, *headers) + body


def answers(received: bytes) -> list[Answer]:
    """Splits the received bytes of a closed connection into responses."""
    found, at = [], 0
    while at < len(received):
        end = received.index(b"\r\n\r\n", at)
        status, *lines = received[at:end].decode("latin-1").split("\r\n")
        headers = dict(line.lower().split(": ", 1) for line in lines)
        begin, at = end + 4, end + 4 + int(headers.get("content-length", 0))
        assert at <= len(received)
        found.append(Answer(int(status.split()[1]), headers, received[begin:at]))
    return found


class Records(logging.Handler):
    """The log records as text with all their fields."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []
        self.fields: list[dict[str, Any]] = []

    def emit(self, record: logging.LogRecord) -> None:
        fields = getattr(record, "fields", {})
        self.lines.append(f"{record.levelname} {record.getMessage()} {fields} {record.exc_text}")
        self.fields.append({"event": record.getMessage(), **fields})

    def of(self, event: str) -> list[dict[str, Any]]:
        return [entry for entry in self.fields if entry["event"] == event]

"""The application of REST: what each operation does.

`operations` says which operations need no token, `grants` what a token grants. The memory access
checks everything about memories. A request that is refused here never reaches it.
"""

from __future__ import annotations

import asyncio
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from holdfast.adapters.rest.changes import MAX_VALUES, ChangeStreams
from holdfast.adapters.rest.device_writes import DeviceWrites
from holdfast.adapters.rest.grants import ANYONE, Grants
from holdfast.adapters.rest.refusals import REFUSALS
from holdfast.adapters.sessions import parse_session_id
from holdfast.ingest import Refused
from holdfast.net.http import events
from holdfast.net.http.application import Application, json_response
from holdfast.net.http.fields import malformed
from holdfast.net.http.host_and_origin import Origins
from holdfast.net.http.requests import (
    COMMANDS,
    JSON,
    BadRequest,
    Request,
    Response,
    response,
    shown,
)
from holdfast.runtime.malformed_json import malformed_text

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping

    from holdfast._core import Commands, ParsedWrites
    from holdfast.adapters.diagnostics import DiagnosticsSource
    from holdfast.adapters.sessions import SessionControl
    from holdfast.config.models.services import RestConfig
    from holdfast.ingest import Begun, Grant, MemoryAccess, Written
    from holdfast.net.http.operations import Later, Operation

    Given: TypeAlias = Mapping[str, Any]

MAX_ANSWERS = 64
"""Answers to writes that are kept: sources write the same ranges again and again."""

INGEST = "/api/v1/ingest"


class EndSession(msgspec.Struct, forbid_unknown_fields=True):
    """The body of a request that ends a session."""

    id: str


class App(Application):
    """Routes operations of REST to memories, devices and diagnostics."""

    def __init__(
        self,
        operations: Iterable[Operation[App]],
        settings: RestConfig,
        memory_access: MemoryAccess,
        diagnostics: DiagnosticsSource,
        sessions: SessionControl,
        *,
        is_https: bool = False,
    ) -> None:
        self.grants = Grants(settings, memory_access.memories)
        what = "an IP address, localhost, or a name in rest.hosts"
        name_refusal = f"Host is a name, allowed without tokens: {what}"
        names = None if self.grants.secrets else frozenset(settings.hosts)
        super().__init__(
            operations,
            Origins(names=names, name_refusal=name_refusal, is_https=is_https),
            tokens=self.grants.secrets,
            anyone=ANYONE,
            max_body=settings.max_body,
        )
        self._memory_access = memory_access
        self._diagnostics = diagnostics
        self._sessions = sessions
        self._parsing: dict[str, tuple[Commands, Callable[[ParsedWrites], object]]] = {}
        self._streams = ChangeStreams(settings.max_connections)
        self._device_writes = DeviceWrites(memory_access)

    @property
    def open_streams(self) -> int:
        """How many change streams are open."""
        return self._streams.open

    def end(self) -> None:
        """Ends all streams, and withdraws the writes that wait for devices. Thread-safe."""
        self.call_soon(self._streams.end)
        self.call_soon(self._device_writes.end)

    def error_response(self, request: Request, error: Exception) -> Response:
        """Returns the refusal, and counts it unless the memory access has."""
        refused = error
        if isinstance(error, BadRequest):
            refused = Refused(error.reason, error.detail)
            # Without a valid token, a refusal is not audited: anyone could fill the audit log.
            write = request.who != "-" and (request.method, request.path) == ("POST", INGEST)
            note = self._memory_access.refuse if write else self._memory_access.note
            note(refused, request.who, request.peer)
        if not isinstance(refused, Refused):
            raise error
        return json_response(refused.answer(), status=REFUSALS.status(refused.reason))

    def check_writer(self, request: Request) -> None:
        """Raises `BadRequest` for a client that may not write, if its body has not arrived yet.

        Later, the memory access refuses it, with what it would have written for the audit log.
        """
        if request.whole is None:
            self.grants.check_writer(request.who)

    def check_manager(self, request: Request) -> None:
        """Raises `BadRequest` for a client that may not manage the appliance."""
        self.grants.check_manager(request.who)

    def ingest(self, request: Request, body: bytes) -> Response | Later:
        """Writes one command or a batch."""
        access, grant = self._memory_access, self.grants.of(request.who)
        if COMMANDS not in request.kept:
            # From now on, the core parses what comes with this head.
            request.kept[COMMANDS] = self._parser(grant)
        begun = access.begin(body, grant, request.peer)
        if begun.device is not None:
            return _written(self._device_writes.carry_out(request, begun))
        if access.may_block(begun):
            return _written(self._finish_async(request, begun))
        return lambda: response(JSON, _answer(access.finish(begun)))

    async def _finish_async(self, request: Request, begun: Begun) -> Written:
        written = await self._memory_access.finish_async(begun)
        # Since it began, a reload may have given the range to a device.
        return written or await self._device_writes.carry_out(request, begun)

    def _parser(self, grant: Grant) -> tuple[Commands, Callable[[ParsedWrites], object]]:
        """What parses the commands of a token, and carries them out."""
        known = self._parsing.get(grant.name)
        if known is None:
            commands = self._memory_access.commands(grant, self.max_body)
            known = commands, partial(self._ingest_parsed, grant)
            self._parsing[grant.name] = known
        return known

    def _ingest_parsed(self, grant: Grant, writes: ParsedWrites) -> Callable[[], None]:
        """Writes the commands of several requests, which the core has parsed."""
        finish = self._memory_access.begin_parsed(writes, grant)

        def second_step() -> None:
            answers = [_answer(written) for written in finish()]
            writes.respond(200, response(JSON, b"").headers, answers)

        return second_step

    def read(self, request: Request, given: Given) -> Response:
        """Reads a range."""
        grant = self.grants.of(request.who)
        values = self._memory_access.read(**given, grant=grant, peer=request.peer)
        return json_response({"values": values})

    async def changes(self, request: Request, given: Given) -> Response | None:
        """Follows ranges."""
        memory, ranges = given["memory"], _ranges(given)
        with self._streams.place():
            grant = self.grants.of(request.who)
            follower = self._memory_access.follow(memory, ranges, grant, request.peer)
            if request.method == "HEAD":
                return Response(200, headers=list(events.HEADERS))
            places = [(memory, area) for area, _, _ in ranges]
            await self._streams.serve(request, follower, places, given["min_interval"])
        return None

    def health(self, _: Request, __: Given) -> Response:
        """Tells that the server is running."""
        return json_response({"status": "ok"})

    def memories(self, request: Request, _: Given) -> Response:
        """Lists the memories of the token."""
        granted = self.grants.of(request.who).memories
        memories = self._diagnostics.memories()
        return json_response(
            {"memories": {name: entry for name, entry in memories.items() if name in granted}}
        )

    def stats(self, _: Request, __: Given) -> Response:
        """Returns all counters."""
        return json_response(self._diagnostics.stats())

    def mqtt(self, _: Request, __: Given) -> Response:
        """Returns the state of the MQTT connection."""
        status = self._diagnostics.adapter("mqtt")
        if status is None:
            raise BadRequest("not_configured", "the configuration has no mqtt")
        defaults: dict[str, object] = {"connected": False, "broker": None, "topics": []}
        return json_response(defaults | status)

    def sessions(self, _: Request, __: Given) -> Response:
        """Lists the connections of listeners."""
        return json_response({"sessions": self._sessions.sessions()})

    async def end_session(self, request: Request, body: bytes) -> Response:
        """Ends a connection of a listener."""
        try:
            request_body = msgspec.json.decode(body, type=EndSession)
            listener, number = parse_session_id(request_body.id)
        except ValueError as error:
            raise malformed(malformed_text(error, body)) from None
        by = {"listener": "rest", "peer": request.peer, "source": request.who}
        if not await asyncio.to_thread(self._sessions.end_session, listener, number, by):
            raise BadRequest("unknown_session", f"no session {shown(request_body.id)}")
        return json_response({"status": "ended", "id": request_body.id})


async def _written(written: Awaitable[Written]) -> Response:
    return response(JSON, _answer(await written))


@lru_cache(MAX_ANSWERS)
def _answer(written: Written) -> bytes:
    return msgspec.json.encode(written.answer())


def _ranges(given: Given) -> list[tuple[str, int, int]]:
    """Returns the ranges of a query. Raises `BadRequest` if they are incomplete or too large."""
    areas, addresses, counts = (given[key] for key in ("area", "address", "count"))
    if not len(areas) == len(addresses) == len(counts):
        found = f"{len(areas)} area, {len(addresses)} address and {len(counts)} count"
        raise malformed(f"the query has {found}, allowed: the same number of each")
    if sum(counts) > MAX_VALUES:
        raise malformed(f"the ranges have {sum(counts)} values, allowed: {MAX_VALUES}")
    return list(zip(areas, addresses, counts, strict=True))

"""The application of the gateway: limits, and what each operation does.

Only `device` communicates with devices. A request is cancelled when its client disconnects.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from holdfast import __version__, logs
from holdfast.errors import ModbusException
from holdfast.gateway import assets, port_of_call, surveying, viewing, watching
from holdfast.gateway.broadcasting import NOTE
from holdfast.gateway.device import Failed, RequestedDevice
from holdfast.gateway.egress import Egress
from holdfast.gateway.pool import Pool, dial
from holdfast.gateway.refusals import FAILURE, REFUSALS
from holdfast.gateway.sharing import Shared
from holdfast.net.allow_list import AllowList
from holdfast.net.resolver import Resolver
from holdfast.web import health as probes
from holdfast.web.application import Application, json_response
from holdfast.web.events import Stream
from holdfast.web.origin import Origins, is_direct
from holdfast.web.requests import (
    BadRequest,
    BrokenBody,
    ClientDisconnected,
    Request,
    Response,
    response,
)

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterable, Iterator, Mapping

    from holdfast._core import Poller
    from holdfast.gateway.endpoint import Answer, Endpoint, Given
    from holdfast.gateway.pool import Dial
    from holdfast.gateway.settings import Settings
    from holdfast.net.resolver import Resolve
    from holdfast.tags import TagList
    from holdfast.web.health import HealthSource
    from holdfast.web.operations import Operation

    Check: TypeAlias = Callable[[Given, Mapping[str, TagList]], Awaitable[Answer]]

Result = TypeVar("Result")

REASON = b"holdfast-reason"
FORM = b"application/x-www-form-urlencoded"
"""The default Content-Type of `curl -d`. The gateway treats it as JSON."""

STOPPING = "the gateway is stopping; a pending write may have been carried out"
HOSTS = "--hosts, or hosts in the configuration"
WRITES_ON = "enable them with --writes, or with access: read-write in the configuration"


class App(Application):
    """The application."""

    def __init__(
        self,
        operations: Iterable[Operation[App]],
        settings: Settings,
        *,
        resolve: Resolve | None = None,
        dial: Dial = dial,
        poller: Poller | None = None,
        health: HealthSource | None = None,
        is_https: bool = False,
    ) -> None:
        limits = self._limits = settings.limits
        allowed = f" without tokens: an IP address, localhost, or a name in {HOSTS}"
        names = None if settings.tokens else settings.hosts
        super().__init__(
            [each for each in operations if health is not None or each.path not in probes.PATHS],
            Origins(names=names, allowed=allowed, is_https=is_https),
            tokens=settings.tokens,
            max_body=limits.body,
        )
        self._health = health
        self._settings = settings
        # A lookup never needs more time than the longest request.
        self._egress = Egress(AllowList(settings.allow), resolve or Resolver(limits.timeout))
        self._pool = Pool(
            most=limits.devices,
            in_flight=limits.in_flight,
            idle=limits.idle,
            longest=limits.timeout,
            tls=settings.tls,
            dial=dial,
            shared=None if poller is None else Shared(poller),
        )
        self._running = {"requests": 0, "streams": 0}
        self._streams: Counter[str] = Counter()
        """The number of streams by the address of the client."""
        self._shares: dict[tuple[str, int], int] = {}
        """The number of pending requests by host and port."""
        self._requests = self._failed = self._writes = 0
        self._refused: dict[str, int] = {}
        self._ending = asyncio.Event()
        self._enders: dict[Callable[[], None], float] = {}
        """What ends requests, and how many seconds after a stop."""
        self._lenient = port_of_call.PATHS if settings.compat == "port-of-call" else frozenset()
        """The paths of endpoints that take requests as Port of Call does."""

    def counts(self) -> dict[str, object]:
        """Returns the counts of requests. Thread-safe.

        `refused` are counts by reason. `failed` are requests without a valid response of the
        device, `writes` are writes that were sent, `devices` are open connections to devices.
        """
        return {
            "requests": self._requests,
            "refused": dict(self._refused),
            "failed": self._failed,
            "writes": self._writes,
            "devices": len(self._pool),
        }

    def end(self) -> None:
        """Ends all streams. Thread-safe."""
        self.call_soon(self._end_soon)

    def _end_soon(self) -> None:
        self._ending.set()
        for end, grace in self._enders.items():
            asyncio.get_running_loop().call_later(grace, end)

    def __call__(self, request: Request) -> Response | Coroutine[Any, Any, Response | None]:
        """Counts and answers one request."""
        self._requests += 1
        return super().__call__(request)

    def check_type(self, request: Request) -> None:
        """Raises `BadRequest` for a body that is not JSON by its type."""
        if request.path in self._lenient:
            port_of_call.check_type(request)
        else:
            request.check_json(b"", FORM, parameters=True)

    def not_allowed(self, operation: Operation[Any]) -> str:
        """Returns the error for another method."""
        if operation.path in self._lenient:
            return port_of_call.METHOD_NOT_ALLOWED
        return f"{port_of_call.METHOD_NOT_ALLOWED}; allowed: {operation.methods}"

    def refused(self, request: Request, error: Exception) -> Response:
        """Returns the response to a request that was refused or has failed."""
        if isinstance(error, BrokenBody | ClientDisconnected):
            raise error
        if isinstance(error, BadRequest):
            return self._refused_by(request, error)
        if isinstance(error, Failed):
            self._failed += 1
            return rejection(FAILURE.status, error.reason, error.detail)
        logs.problem("request_failed", listener="gateway", peer=request.peer)
        return rejection(FAILURE.status, "internal_error", "internal error, see the log")

    def _refused_by(self, request: Request, unfit: BadRequest) -> Response:
        self._refused[unfit.reason] = self._refused.get(unfit.reason, 0) + 1
        logs.refused(
            "gateway_refused",
            kind=unfit.reason,
            peer=request.peer,
            who=request.who,
            path=request.path[:100],
            reason=unfit.reason,
            # The detail may contain values to be written, which are never logged.
            detail="-" if unfit.reason == "malformed" else unfit.detail,
        )
        answer = rejection(REFUSALS.status(unfit.reason), unfit.reason, unfit.detail)
        if isinstance(unfit, port_of_call.Rejected):
            answer.body, answer.status = unfit.body, unfit.status
        return answer

    # Limits.

    @contextlib.contextmanager
    def _place(self, kind: str, most: int) -> Iterator[None]:
        """Limits how many `kind` run at once. Raises `BadRequest` above the limit."""
        if self._running[kind] >= most:
            raise BadRequest("busy", f"too many {kind}: {most} are active, which is the limit")
        self._running[kind] += 1
        try:
            yield
        finally:
            self._running[kind] -= 1

    @contextlib.contextmanager
    def _share(self, device: RequestedDevice) -> Iterator[None]:
        """Limits the pending requests to one device. Raises `BadRequest` above the limit."""
        key, most = (device.host.lower(), device.port), self._limits.requests_of_device
        if self._shares.get(key, 0) >= most:
            where = f"{device.host}:{device.port}"
            raise BadRequest(
                "busy", f"too many requests to {where}: {most} are active, which is the limit"
            )
        self._shares[key] = self._shares.get(key, 0) + 1
        try:
            yield
        finally:
            self._shares[key] -= 1
            if not self._shares[key]:
                del self._shares[key]

    async def _while_there(
        self, request: Request, work: Coroutine[Any, Any, Result], *, grace: float
    ) -> Result:
        """Runs work. Cancels it when the client disconnects, or `grace` seconds after a stop.

        Raises `ClientDisconnected` in both cases.
        """
        task = asyncio.current_task()
        assert task is not None
        ends = False

        def end() -> None:
            nonlocal ends
            ends = True
            task.cancel()

        request.when_gone(end)
        self._enders[end] = grace
        if self._ending.is_set():
            asyncio.get_running_loop().call_later(grace, end)
        try:
            return await work
        except asyncio.CancelledError:
            if ends and not task.uncancel():
                raise ClientDisconnected from None
            raise
        finally:
            del self._enders[end]
            request.when_gone(None)

    # Requests to devices.

    async def carry_out(self, request: Request, endpoint: Endpoint, given: Given) -> Response:
        """Carries out one operation on a device."""
        with self._place("requests", self._limits.requests):
            changes = endpoint.writes(given)
            if changes and not self._settings.writes:
                raise BadRequest("writes_off", f"writes are disabled: {WRITES_ON}")
            device = RequestedDevice(self._egress, self._pool, given, broadcast=endpoint.broadcast)
            with self._share(device):
                work = self._asked(request, endpoint, given, device, changes)
                return await self._while_there_or_told(request, work)

    async def _while_there_or_told(
        self, request: Request, work: Coroutine[Any, Any, Result]
    ) -> Result:
        """As `_while_there`, but a request that a stop cancels is answered with `stopping`."""
        try:
            return await self._while_there(request, work, grace=self._limits.ending)
        except ClientDisconnected:
            if self._ending.is_set():
                raise BadRequest("stopping", STOPPING) from None
            raise

    async def _asked(
        self,
        request: Request,
        endpoint: Endpoint,
        given: Given,
        device: RequestedDevice,
        changes: bool,
    ) -> Response:
        outcome = "failed"
        try:
            answer = await endpoint.carry_out(given, device)
            outcome = "sent" if device.is_broadcast else "done"
            if device.is_broadcast:
                answer["note"] = NOTE
        except ModbusException as error:
            outcome = f"exception {error.code:02X}"
            answer = endpoint.on_exception(given, device, error)
        except BadRequest:
            outcome = "refused"
            raise
        finally:
            if changes:
                sent = device.asked and outcome != "refused"
                told = outcome if sent or outcome == "refused" else "not sent"
                self._note_write(request, given, device, told, sent=sent)
        return json_response(answer)

    def _note_write(
        self,
        request: Request,
        given: Given,
        device: RequestedDevice,
        outcome: str,
        *,
        sent: bool,
    ) -> None:
        """Counts a write that was sent, and logs it without the values."""
        self._writes += sent
        logs.write(
            logging.INFO,
            "gateway_write",
            peer=request.peer,
            who=request.who,
            path=request.path,
            target=f"{device.host}:{device.port}",
            unit=device.unit,
            address=given.get("address", given.get("writeAddress", "-")),
            outcome=outcome,
        )

    # Streams.

    async def map(self, request: Request, given: Given) -> None:
        """Maps a device."""
        with self._stream(request):
            self._require_stream(request, given["maxStreams"])
            device = RequestedDevice(self._egress, self._pool, given)
            survey = surveying.planned(given)
            stream = Stream(request, self._limits.heartbeat)
            work = surveying.survey(
                survey, device, stream, step=given["step"], longest=self._limits.discovery
            )
            await self._while_streaming(request, stream, work)

    async def watch(self, request: Request, given: Given) -> None:
        """Watches a range of a device."""
        if not self._settings.tokens and not is_direct(request):
            # The only GET that asks a device. Over HTTP and to a name, browsers send neither Origin
            # nor Sec-Fetch-Site with the GET of a page.
            detail = (
                f"Host is a name, allowed without tokens for GET {watching.PATH}: an IP address"
            )
            raise BadRequest("foreign_page", f"{detail}, localhost; or use POST {viewing.PATH}")
        with self._stream(request):
            device = RequestedDevice(self._egress, self._pool, given)
            stream = Stream(request, self._limits.heartbeat)
            await self._while_streaming(request, stream, watching.watch(given, device, stream))

    async def view(self, request: Request, given: Given) -> None:
        """Follows several ranges and tag lists of a device."""
        with self._place("requests", self._limits.requests):
            parts = await viewing.parts_of(given, self._settings.profiles)
        device = RequestedDevice(self._egress, self._pool, given)
        streaming = not given["once"] and self._has_stream(request, given["maxStreams"])
        once = self._place("requests", self._limits.requests)
        with self._stream(request) if streaming else once:
            stream = Stream(request, self._limits.heartbeat)
            work = viewing.follow(given, viewing.View(parts, device), stream, streaming=streaming)
            await self._while_streaming(request, stream, work)

    @contextlib.contextmanager
    def _stream(self, request: Request) -> Iterator[None]:
        """Counts a stream. Raises `BadRequest` above the limit."""
        host = host_of(request.peer)
        with self._place("streams", self._limits.streams):
            self._streams[host] += 1
            try:
                yield
            finally:
                self._streams[host] -= 1
                if not self._streams[host]:
                    del self._streams[host]

    def _has_stream(self, request: Request, most: int | None) -> bool:
        """Whether a client that asks for at most `most` streams can have one more."""
        if most is None:
            return True
        full = self._running["streams"] >= self._limits.streams
        return not full and self._streams[host_of(request.peer)] < most

    def _require_stream(self, request: Request, most: int | None) -> None:
        """Raises `BadRequest` if the client has more than `most` streams, with the newest."""
        if most is not None and self._streams[host_of(request.peer)] > most:
            raise BadRequest("busy", f"streams of this address: {most}, which is maxStreams")

    async def _while_streaming(
        self, request: Request, stream: Stream, work: Coroutine[Any, Any, None]
    ) -> None:
        try:
            await self._while_there(request, work, grace=0)
        except ClientDisconnected:
            if self._ending.is_set() and not stream.began:
                raise BadRequest("stopping", STOPPING) from None
            if self._ending.is_set():
                await stream.end()

    # Answers without a device.

    async def check(self, check: Check, given: Given) -> Response:
        """Checks tags or values."""
        with self._place("requests", self._limits.requests):
            return json_response(await check(given, self._settings.profiles))

    def profiles(self) -> Response:
        """Returns the names of the profiles, and how many tags they have."""
        profiles = self._settings.profiles.items()
        return json_response(
            {"profiles": [{"name": name, "tags": len(tags)} for name, tags in profiles]}
        )

    def status(self, _: Request, __: Given) -> Response:
        """Returns the settings of the gateway."""
        limits = self._limits
        return json_response(
            {
                "version": __version__,
                "writes": self._settings.writes,
                "tokens": bool(self._settings.tokens),
                "allow": [str(entry) for entry in self._settings.allow],
                "limits": {
                    "timeout": round(1000 * limits.timeout),
                    "interval": round(1000 * limits.interval),
                },
                "connections": len(self._pool),
            }
        )

    def probe(self, request: Request, _: Given) -> Response:
        """Answers a probe. It needs no token, so the answer has no names."""
        assert self._health is not None, "there is a route"
        return probes.answer(self._health, request.path, details=False)

    def asset(self, request: Request, _: Given) -> Response:
        """Returns a file of the console."""
        kind, body = assets.read(request.path)
        return response(kind, body, *assets.HEADERS)


def host_of(peer: str) -> str:
    """The address of a peer without its port."""
    return peer.rpartition(":")[0]


def rejection(status: int, reason: str, detail: str) -> Response:
    """Returns the response to a refused or failed request."""
    said = {"success": False, "error": detail}
    return json_response(said, (REASON, reason.encode()), status=status)

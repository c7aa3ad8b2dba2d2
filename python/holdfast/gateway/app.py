"""The application of the gateway: routing, authorization, limits and responses.

Only `device` communicates with devices. A request is cancelled when its client disconnects.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import msgspec

from holdfast import __version__, logs
from holdfast.errors import ModbusException
from holdfast.gateway import (
    assets,
    identifying,
    listing,
    openapi,
    port_of_call,
    reading,
    surveying,
    viewing,
    watching,
    writing,
)
from holdfast.gateway.broadcasting import NOTE
from holdfast.gateway.device import Failed, RequestedDevice
from holdfast.gateway.egress import Egress
from holdfast.gateway.fields import from_json, from_query, malformed, timeout
from holdfast.gateway.pool import Pool, dial
from holdfast.gateway.refusals import FAILURE, REFUSALS
from holdfast.gateway.sharing import Shared
from holdfast.net.allow_list import AllowList
from holdfast.net.resolver import Resolver
from holdfast.web import health as probes
from holdfast.web import openapi_page as page
from holdfast.web.events import Stream
from holdfast.web.openapi import DOCUMENT, PAGE
from holdfast.web.refusals import UNREAD, headers_with
from holdfast.web.requests import (
    JSON,
    SAFE,
    BadRequest,
    BrokenBody,
    ClientDisconnected,
    Request,
    Response,
    response,
    shown,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator, Sequence

    from holdfast._core import Poller
    from holdfast.gateway.endpoint import Operation
    from holdfast.gateway.fields import Field
    from holdfast.gateway.listing import Local
    from holdfast.gateway.pool import Dial
    from holdfast.gateway.settings import Settings
    from holdfast.net.resolver import Resolve
    from holdfast.web.health import HealthSource

    Later: TypeAlias = Coroutine[Any, Any, Response | None]
    Handler: TypeAlias = Callable[[Request], Response | Later]

Result = TypeVar("Result")

ENDPOINTS: tuple[Operation, ...] = (*reading.ENDPOINTS, *writing.ENDPOINTS, *identifying.ENDPOINTS)

REASON = b"holdfast-reason"
FORM = b"application/x-www-form-urlencoded"
"""The default Content-Type of `curl -d`. The gateway treats it as JSON."""

MAX_IGNORED = 4
"""The most ignored keys of a request in the log."""

STOPPING = "the gateway is stopping; a pending write may have been carried out"
HOSTS = "--hosts, or hosts in the configuration"
WRITES_ON = "enable them with --writes, or with access: read-write in the configuration"


class App:
    """The application."""

    def __init__(
        self,
        settings: Settings,
        url: str,
        *,
        resolve: Resolve | None = None,
        dial: Dial = dial,
        poller: Poller | None = None,
        health: HealthSource | None = None,
    ) -> None:
        self._health = health
        self._settings = settings
        limits = self._limits = settings.limits
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
        self._loop: asyncio.AbstractEventLoop | None = None
        self._lenient = port_of_call.PATHS if settings.compat == "port-of-call" else frozenset()
        """The paths of endpoints that take requests as Port of Call does."""
        document = openapi.document(__version__, ENDPOINTS, settings)
        if self._lenient:
            port_of_call.describe(document)
        self._document = msgspec.json.encode(document)
        self._page = page.render(document, url)
        self.routes: dict[str, tuple[str, Handler]] = {
            **{each.path: ("POST", self._handler(each)) for each in ENDPOINTS},
            surveying.PATH: ("POST", self._map),
            watching.PATH: ("GET", self._watch),
            viewing.PATH: ("POST", self._view),
            **{each.path: ("POST", self._local(each)) for each in listing.ENDPOINTS},
            listing.PROFILES: ("GET", self._profiles),
            openapi.STATUS: ("GET", self._status),
            DOCUMENT: ("GET", self._openapi),
            PAGE: ("GET", self._docs),
            **dict.fromkeys(assets.FILES, ("GET", self._asset)),
        }
        if health is not None:
            self.routes |= dict.fromkeys(probes.PATHS, ("GET", self._probe))

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
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # The loop is already closed.
                self._loop.call_soon_threadsafe(self._ending.set)

    def __call__(self, request: Request) -> Response | Later:
        """Answers one request."""
        self._loop = asyncio.get_running_loop()
        self._requests += 1
        try:
            answer = self._answer(request)
        except Exception as error:
            return self._refusal(request, error)
        return answer if isinstance(answer, Response) else self._finished(request, answer)

    async def _finished(self, request: Request, answer: Later) -> Response | None:
        try:
            return await answer
        except (BrokenBody, ClientDisconnected):
            raise
        except Exception as error:
            return self._refusal(request, error)

    def _answer(self, request: Request) -> Response | Later:
        hosts = len(request.values(b"host"))
        if hosts > 1 or (hosts == 0 and request.version == "1.1"):
            raise malformed(f"{hosts} Host headers, HTTP/1.1 requires exactly one")
        route = self.routes.get(request.path)
        if route is None:
            raise BadRequest("not_found", f"no resource at {shown(request.path)}")
        allowed, handler = route
        head = request.method == "HEAD" and allowed == "GET" and request.path != watching.PATH
        if request.method == allowed or head:
            return handler(request)
        methods = f"{allowed}, OPTIONS"
        if allowed == "GET" and request.path != watching.PATH:
            methods = "GET, HEAD, OPTIONS"
        if request.method == "OPTIONS":
            answer = Response(204, headers=list(SAFE))
        else:
            detail = port_of_call.METHOD_NOT_ALLOWED
            if request.path not in self._lenient:
                detail += f"; allowed: {methods}"
            answer = self._refusal(request, BadRequest("method_not_allowed", detail))
        answer.headers.append((b"allow", methods.encode()))
        return answer

    def _refusal(self, request: Request, error: Exception) -> Response:
        """Returns the answer to a request that was refused or has failed."""
        if isinstance(error, BadRequest):
            return self._refused_by(request, error)
        reason, detail = "internal_error", "internal error, see the log"
        if isinstance(error, Failed):
            self._failed += 1
            reason, detail = error.reason, error.detail
        else:
            logs.problem("request_failed", listener="gateway", peer=request.peer)
        return rejection(FAILURE.status, reason, detail)

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
        status = REFUSALS.status(unfit.reason)
        answer = rejection(status, unfit.reason, unfit.detail)
        if isinstance(unfit, port_of_call.Rejected):
            answer.body, answer.status = unfit.body, unfit.status
        answer.headers += headers_with(answer.status)
        answer.closes = status in UNREAD or request.header(b"expect") is not None
        return answer

    # Authorization and limits.

    def _admit(self, request: Request) -> None:
        """Raises `BadRequest` for a request of another site's page or without a valid token."""
        if request.is_foreign:
            raise BadRequest("foreign_page", "the request is from a page of another site")
        if self._settings.tokens:
            request.who = request.owner(self._settings.tokens)
        elif not request.is_direct(self._settings.hosts):
            detail = "Host is a name, allowed without tokens: an IP address, localhost"
            raise BadRequest("foreign_page", f"{detail}, or a name in {HOSTS}")
        elif request.path == watching.PATH and not request.is_direct():
            # The only GET that asks a device. Over HTTP and to a name, browsers send neither Origin
            # nor Sec-Fetch-Site with the GET of a page.
            detail = (
                f"Host is a name, allowed without tokens for GET {watching.PATH}: an IP address"
            )
            raise BadRequest("foreign_page", f"{detail}, localhost; or use POST {viewing.PATH}")

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

    async def _end(self, grace: float) -> None:
        """Returns `grace` seconds after the gateway began to stop."""
        await self._ending.wait()
        await asyncio.sleep(grace)

    async def _while_there(
        self, request: Request, work: Coroutine[Any, Any, Result], *, grace: float
    ) -> Result:
        """Runs work. Cancels it when the client disconnects, or `grace` seconds after a stop.

        Raises `ClientDisconnected` in both cases.
        """
        task = asyncio.create_task(work)
        others: list[asyncio.Task[Any]] = [
            asyncio.create_task(request.gone()),
            asyncio.create_task(self._end(grace)),
        ]
        try:
            await asyncio.wait([task, *others], return_when=asyncio.FIRST_COMPLETED)
            if not task.done():
                raise ClientDisconnected
            return task.result()
        finally:
            for each in (task, *others):
                each.cancel()
            await asyncio.gather(task, *others, return_exceptions=True)

    # Requests to devices.

    def _handler(self, endpoint: Operation) -> Handler:
        longest = round(1000 * self._limits.timeout)
        fields = (*endpoint.fields, timeout(min(endpoint.timeout, longest), longest))

        async def handle(request: Request) -> Response:
            self._admit(request)
            self._check_type(request)
            with self._place("requests", self._limits.requests):
                given = self._parsed(request, await request.body(self._limits.body), fields)
                changes = endpoint.writes(given)
                if changes and not self._settings.writes:
                    raise BadRequest("writes_off", f"writes are disabled: {WRITES_ON}")
                device = RequestedDevice(
                    self._egress, self._pool, given, broadcast=endpoint.broadcast
                )
                with self._share(device):
                    work = self._carry_out(request, endpoint, given, device, changes)
                    return await self._while_there_or_told(request, work)

        return handle

    def _check_type(self, request: Request) -> None:
        """Raises `BadRequest` for a body that is not JSON by its type."""
        if request.path in self._lenient:
            port_of_call.check_type(request)
        else:
            request.check_json(b"", FORM, parameters=True)

    def _parsed(self, request: Request, body: bytes, fields: Sequence[Field]) -> dict[str, Any]:
        """Returns the fields of a request with defaults. Raises `BadRequest`."""
        if request.path not in self._lenient:
            return from_json(body, fields)
        given, ignored = port_of_call.parsed(request.path, body, fields)
        if ignored:
            logs.refused(
                "keys_ignored",
                kind="gateway",
                listener="gateway",
                peer=request.peer,
                who=request.who,
                path=request.path,
                found=", ".join(map(shown, ignored[:MAX_IGNORED])),
            )
        return given

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

    async def _carry_out(
        self,
        request: Request,
        endpoint: Operation,
        given: dict[str, Any],
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
        return response(JSON, msgspec.json.encode(answer))

    def _note_write(
        self,
        request: Request,
        given: dict[str, Any],
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

    async def _map(self, request: Request) -> None:
        self._admit(request)
        self._check_type(request)
        with self._stream(request):
            body = await request.body(self._limits.body)
            given = from_json(body, surveying.fields(self._limits))
            self._require_stream(request, given["maxStreams"])
            device = RequestedDevice(self._egress, self._pool, given)
            survey = surveying.planned(given)
            stream = Stream(request, self._limits.heartbeat)
            work = surveying.survey(
                survey, device, stream, step=given["step"], longest=self._limits.discovery
            )
            await self._while_streaming(request, stream, work)

    async def _watch(self, request: Request) -> None:
        self._admit(request)
        with self._stream(request):
            given = from_query(request.query, watching.fields(self._limits))
            device = RequestedDevice(self._egress, self._pool, given)
            stream = Stream(request, self._limits.heartbeat)
            await self._while_streaming(request, stream, watching.watch(given, device, stream))

    async def _view(self, request: Request) -> None:
        self._admit(request)
        self._check_type(request)
        with self._place("requests", self._limits.requests):
            body = await request.body(self._limits.body)
            given = from_json(body, viewing.fields(self._limits))
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

    def _local(self, endpoint: Local) -> Handler:
        """Returns the handler of an endpoint that asks no device."""

        async def handle(request: Request) -> Response:
            self._admit(request)
            self._check_type(request)
            with self._place("requests", self._limits.requests):
                given = from_json(await request.body(self._limits.body), endpoint.fields)
                answer = await endpoint.answer(given, self._settings.profiles)
            return response(JSON, msgspec.json.encode(answer))

        return handle

    def _profiles(self, request: Request) -> Response:
        self._admit(request)
        return response(JSON, msgspec.json.encode(listing.profiles(self._settings.profiles)))

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

    # Status, documents and console.

    def _status(self, request: Request) -> Response:
        self._admit(request)
        limits = self._limits
        status = {
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
        return response(JSON, msgspec.json.encode(status))

    def _probe(self, request: Request) -> Response:
        """Answers a probe. It needs no token, so the answer has no names."""
        assert self._health is not None, "there is a route"
        return probes.answer(self._health, request.path, details=False)

    def _openapi(self, _: Request) -> Response:
        return response(JSON, self._document)

    def _docs(self, _: Request) -> Response:
        return response(page.KIND, self._page, (b"content-security-policy", page.POLICY))

    def _asset(self, request: Request) -> Response:
        kind, body = assets.read(request.path)
        return response(kind, body, *assets.HEADERS)


def host_of(peer: str) -> str:
    """The address of a peer without its port."""
    return peer.rpartition(":")[0]


def rejection(status: int, reason: str, detail: str) -> Response:
    """Returns the response to a refused or failed request."""
    body = msgspec.json.encode({"success": False, "error": detail})
    return response(JSON, body, (REASON, reason.encode()), status=status)

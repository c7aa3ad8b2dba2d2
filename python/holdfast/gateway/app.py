"""The application of the gateway: limits, and what each operation does.

Only `device` communicates with devices. A request is cancelled when its client disconnects.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from holdfast import __version__
from holdfast.client.client import connection
from holdfast.errors import ModbusException
from holdfast.events import log_lines
from holdfast.gateway import assets, port_of_call
from holdfast.gateway.broadcast import NOTE
from holdfast.gateway.device import Failed, RequestedDevice
from holdfast.gateway.device_routes import DeviceRoutes
from holdfast.gateway.endpoints import address_map
from holdfast.gateway.endpoints.request_tags import SHORT_SIZE
from holdfast.gateway.pool import Pool
from holdfast.gateway.refusals import EXCEPTION_STATUS, FAILURE, REFUSALS
from holdfast.gateway.repeated_writes import RepeatedWrites
from holdfast.gateway.shared_devices import ApplianceLinks
from holdfast.gateway.streams import views, watch
from holdfast.gateway.write_outcome import outcome
from holdfast.net.allow_list import AllowList
from holdfast.net.http import health as probes
from holdfast.net.http.application import Application, json_response
from holdfast.net.http.events import Stream
from holdfast.net.http.host_and_origin import Origins
from holdfast.net.http.requests import (
    BadRequest,
    BrokenBody,
    ClientDisconnected,
    Request,
    Response,
    response,
)
from holdfast.net.resolver import Resolver
from holdfast.runtime import tasks

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterable, Iterator, Mapping
    from contextlib import AbstractContextManager

    from holdfast._core import Poller
    from holdfast.gateway.endpoint import Answer, Endpoint, Given
    from holdfast.gateway.pool import Dial
    from holdfast.gateway.settings import Settings
    from holdfast.gateway.write_outcome import WriteOutcome
    from holdfast.net.http.health import HealthSource
    from holdfast.net.http.operations import Later, Operation
    from holdfast.net.resolver import Resolve
    from holdfast.tags import TagList

Result = TypeVar("Result")

Parse: TypeAlias = "Callable[[Given, Mapping[str, TagList]], Awaitable[Result]]"
"""Parses what a request has, with the tag lists of the profiles."""

REASON = b"holdfast-reason"
EXCEPTION = b"holdfast-exception"
FORM = b"application/x-www-form-urlencoded"
"""The default Content-Type of `curl -d`. The gateway treats it as JSON."""

STOPPING = "the gateway is stopping"
HOSTS = "--host, or hosts in the configuration"
WRITES_ON = "enable them with --access read-write, or with access: read-write in the configuration"


class App(Application):
    """The application."""

    def __init__(
        self,
        operations: Iterable[Operation[App]],
        settings: Settings,
        *,
        resolve: Resolve | None = None,
        dial: Dial = connection,
        poller: Poller | None = None,
        health: HealthSource | None = None,
        is_https: bool = False,
    ) -> None:
        limits = self._limits = settings.limits
        what = f"an IP address, localhost, or a name in {HOSTS}"
        name_refusal = f"Host is a name, allowed without tokens: {what}"
        names = None if settings.tokens else settings.hosts
        super().__init__(
            [each for each in operations if health is not None or each.path not in probes.PATHS],
            Origins(names=names, name_refusal=name_refusal, is_https=is_https),
            tokens=settings.tokens,
            max_body=limits.body,
        )
        self._health = health
        self._settings = settings
        # A lookup never needs more time than the longest request.
        resolve = resolve or Resolver(limits.timeout)
        self._routes = DeviceRoutes(AllowList(settings.allow), resolve, settings.tls)
        self._pool = Pool(
            most=limits.devices,
            in_flight=limits.in_flight,
            idle=limits.idle,
            tls=settings.tls,
            dial=dial,
            shared=None if poller is None else ApplianceLinks(poller),
        )
        self._repeated = RepeatedWrites()
        self._active: Counter[object] = Counter()
        """The number of pending `requests` and `streams`, of requests by host and port of the
        device, and of streams by address of the client."""
        self._parsing = tasks.Places(1)
        """Whose requests are parsed, by address of the client and whether they are long."""
        self._requests = self._failed = self._writes = 0
        self._refusal_counts: Counter[str] = Counter()
        self._ending = asyncio.Event()
        self._cancels: dict[Callable[[], None], float] = {}
        """What cancels the pending requests, and how many seconds after a stop."""
        self._lenient = port_of_call.PATHS if settings.compat == "port-of-call" else frozenset()
        """The paths of endpoints that take requests as Port of Call does."""

    def counts(self) -> dict[str, object]:
        """Returns the counts of requests. Thread-safe.

        `refused` are counts by reason. `failed` are requests without a valid response of the
        device, `writes` are writes that were sent, `devices` are open connections to devices.
        """
        return {
            "requests": self._requests,
            "refused": dict(self._refusal_counts),
            "failed": self._failed,
            "writes": self._writes,
            "devices": len(self._pool),
        }

    def end(self) -> None:
        """Ends all streams. Thread-safe."""
        self.call_soon(self._end_soon)

    def _end_soon(self) -> None:
        self._ending.set()
        for cancel, grace in self._cancels.items():
            asyncio.get_running_loop().call_later(grace, cancel)

    def __call__(self, request: Request) -> Response | Later:
        """Counts and answers one request."""
        self._requests += 1
        return super().__call__(request)

    def check_type(self, request: Request) -> None:
        """Raises `BadRequest` for a body that is not JSON by its type, or has a query beside it."""
        if request.path in self._lenient:
            port_of_call.check_type(request)
        else:
            request.check_json(b"", FORM, parameters=True)
            request.check_no_query()

    def not_allowed(self, operation: Operation[Any]) -> str:
        """Returns the error for another method."""
        if operation.path in self._lenient:
            return port_of_call.METHOD_NOT_ALLOWED
        return f"{port_of_call.METHOD_NOT_ALLOWED}; allowed: {operation.methods}"

    def error_response(self, request: Request, error: Exception) -> Response:
        """Returns the response to a request that was refused or has failed."""
        if isinstance(error, BrokenBody | ClientDisconnected):
            raise error
        if isinstance(error, BadRequest):
            return self._refusal_response(request, error)
        if isinstance(error, Failed):
            self._failed += 1
            return gateway_rejection(FAILURE.status, error.reason, error.detail, *error.headers)
        log_lines.problem("request_failed", listener="gateway", peer=request.peer)
        return gateway_rejection(FAILURE.status, "internal_error", "internal error, see the log")

    def _refusal_response(self, request: Request, error: BadRequest) -> Response:
        self._refusal_counts[error.reason] += 1
        log_lines.refused(
            "gateway_refused",
            kind=error.reason,
            peer=request.peer,
            who=request.who,
            path=request.path[:100],
            reason=error.reason,
            # The detail may contain values to be written, which are never logged.
            detail="-" if error.reason == "malformed" else error.detail,
        )
        status = REFUSALS.status(error.reason)
        answer = gateway_rejection(status, error.reason, error.detail, *error.headers)
        if isinstance(error, port_of_call.Rejected):
            answer.body, answer.status = error.body, error.status
        return answer

    # Limits.

    @contextlib.contextmanager
    def _place(self, key: object, most: float, what: str) -> Iterator[None]:
        """Limits how many of one key are active at once. Raises `BadRequest` above the limit."""
        if self._active[key] >= most:
            raise BadRequest("busy", f"too many {what}: {most} are active, which is the limit")
        self._active[key] += 1
        try:
            yield
        finally:
            self._active[key] -= 1
            if not self._active[key]:
                del self._active[key]

    def _request(self) -> AbstractContextManager[None]:
        return self._place("requests", self._limits.requests, "requests")

    def _request_to(self, device: RequestedDevice) -> AbstractContextManager[None]:
        where, most = (device.host.lower(), device.port), self._limits.requests_of_device
        return self._place(where, most, f"requests to {device.where}")

    async def _until_disconnect(
        self, request: Request, work: Coroutine[Any, Any, Result], *, grace: float
    ) -> Result:
        """Runs work. Cancels it when the client disconnects, or `grace` seconds after a stop.

        Raises `ClientDisconnected` in both cases.
        """
        task = asyncio.current_task()
        assert task is not None
        is_cancelled = False

        def cancel() -> None:
            nonlocal is_cancelled
            is_cancelled = True
            task.cancel()

        request.when_gone(cancel)
        self._cancels[cancel] = grace
        if self._ending.is_set():
            asyncio.get_running_loop().call_later(grace, cancel)
        try:
            return await work
        except asyncio.CancelledError:
            # The host cancels the task too, when it ends: then the cancellation goes on.
            if is_cancelled and not task.uncancel():
                raise ClientDisconnected from None
            raise
        finally:
            del self._cancels[cancel]
            request.when_gone(None)

    # Requests to devices.

    async def handle_device_request(
        self, request: Request, endpoint: Endpoint, given: Given
    ) -> Response:
        """Carries out one operation on a device."""
        is_write = endpoint.writes(given)
        try:
            return await self._within_limits(request, endpoint, given, is_write)
        except BadRequest as refusal:
            if is_write:
                self._repeated.add_maybe_written_header(request, refusal)
            raise

    async def _within_limits(
        self, request: Request, endpoint: Endpoint, given: Given, is_write: bool
    ) -> Response:
        with self._request():
            if is_write and not self._settings.writes:
                raise BadRequest("writes_off", f"writes are disabled: {WRITES_ON}")

            def check_client() -> None:
                if not request.is_client_there():
                    raise ClientDisconnected

            device = RequestedDevice(
                self._routes,
                self._pool,
                given,
                broadcast=endpoint.broadcast,
                check_client=check_client if is_write else None,
            )
            with self._request_to(device):
                reply = partial(self._reply, request, endpoint, given, device, is_write)
                work = self._repeated.write_once(request, device, reply) if is_write else reply()
                try:
                    return await self._until_disconnect(request, work, grace=self._limits.ending)
                except ClientDisconnected:
                    if not self._ending.is_set():
                        raise
                    # The client is there, and gets an answer.
                    stopping = BadRequest("stopping", STOPPING)
                    if is_write:
                        ended = outcome(device, stopping)
                        stopping.detail += "; the write " + (
                            "may have been carried out" if ended.maybe_written else "was not sent"
                        )
                        stopping.headers = (ended.header,)
                    raise stopping from None

    async def _reply(
        self,
        request: Request,
        endpoint: Endpoint,
        given: Given,
        device: RequestedDevice,
        is_write: bool,
    ) -> Response:
        """Returns what the device replies."""
        try:
            reply = await endpoint.execute(given, device)
        except BaseException as error:
            ended = outcome(device, error)
            if is_write:
                self._log_write(request, given, device, ended)
            more = (ended.header,) if is_write else ()
            if isinstance(error, ModbusException):
                return json_response(
                    endpoint.on_exception(given, device, error),
                    (EXCEPTION, b"%d" % error.code),
                    *more,
                    status=EXCEPTION_STATUS,
                )
            if isinstance(error, BadRequest | Failed):
                error.headers = more
            raise
        if is_write:
            self._log_write(request, given, device, outcome(device, None))
        # An answer that names the device itself has the order of Port of Call.
        named = {} if "host" in reply else device.target_fields
        answer = {"success": True, **named, **reply}
        if endpoint.has_rtt:
            answer["rtt"] = device.rtt
        if device.is_broadcast:
            answer["note"] = NOTE
        return json_response(answer)

    def _log_write(
        self, request: Request, given: Given, device: RequestedDevice, ended: WriteOutcome
    ) -> None:
        """Counts a write that may have been sent, and logs it without the values."""
        self._writes += device.maybe_sent
        log_lines.write(
            logging.INFO,
            "gateway_write",
            peer=request.peer,
            who=request.who,
            path=request.path,
            target=device.where,
            unit=device.unit,
            address=given.get("address", given.get("writeAddress", "-")),
            outcome=ended.word,
        )

    # Streams.

    async def map(self, request: Request, given: Given) -> None:
        """Maps a device."""
        most = given["maxStreams"]
        if self._has_streams(request, most):
            raise BadRequest("busy", f"streams of this address: {most}, which is maxStreams")
        with self._stream(request):
            device = RequestedDevice(self._routes, self._pool, given)
            longest = self._limits.discovery
            await self._while_streaming(
                request, lambda stream: address_map.map_device(given, device, stream, longest)
            )

    async def watch(self, request: Request, given: Given) -> None:
        """Watches a range of a device."""
        if not self._settings.tokens and not self.origins.browsers_mark_foreign_requests(request):
            # The only GET that asks a device.
            allowed = "localhost, 127.0.0.1, [::1], or an address over HTTPS"
            detail = f"Host is not allowed without tokens for GET {watch.PATH}, allowed: {allowed}"
            raise BadRequest("foreign_page", f"{detail}; or use POST {views.PATH}")
        with self._stream(request):
            device = RequestedDevice(self._routes, self._pool, given)
            await self._while_streaming(request, lambda stream: watch.watch(given, device, stream))

    async def view(self, request: Request, given: Given) -> None:
        """Follows several ranges and tag lists of a device."""
        parts = await self._parsed(request, views.parts_of, given)
        device = RequestedDevice(self._routes, self._pool, given)
        streaming = not given["once"] and self._may_stream(request, given["maxStreams"])
        with contextlib.ExitStack() as places:
            if streaming:
                places.enter_context(self._stream(request))
            else:
                places.enter_context(self._request())
                places.enter_context(self._request_to(device))
            view = views.View(parts, device)
            await self._while_streaming(
                request, lambda stream: views.follow(given, view, stream, streaming=streaming)
            )

    @contextlib.contextmanager
    def _stream(self, request: Request) -> Iterator[None]:
        """Counts a stream. Raises `BadRequest` above the limit."""
        of_client = self._place(host_of(request.peer), inf, "streams")
        with self._place("streams", self._limits.streams, "streams"), of_client:
            yield

    def _may_stream(self, request: Request, most: int | None) -> bool:
        """Whether a client that asks for at most `most` streams can have one more."""
        is_full = self._active["streams"] >= self._limits.streams
        return most is None or not (is_full or self._has_streams(request, most))

    def _has_streams(self, request: Request, most: int | None) -> bool:
        """Whether the client's address has `most` streams or more."""
        return most is not None and self._active[host_of(request.peer)] >= most

    async def _while_streaming(
        self, request: Request, work: Callable[[Stream], Coroutine[Any, Any, None]]
    ) -> None:
        stream = Stream(request, self._limits.heartbeat)
        try:
            await self._until_disconnect(request, work(stream), grace=0)
        except ClientDisconnected:
            if not self._ending.is_set():
                return  # The client is gone: nobody gets an answer.
            if not stream.began:
                raise BadRequest("stopping", STOPPING) from None
            await stream.end()

    # Answers without a device.

    async def check(self, request: Request, check: Parse[Answer], given: Given) -> Response:
        """Checks tags or values."""
        return json_response(await self._parsed(request, check, given))

    async def _parsed(self, request: Request, parse: Parse[Result], given: Given) -> Result:
        """Parses what a request has; of each address, one long and one short at a time."""
        is_long = len(request.whole or b"") > SHORT_SIZE

        async def in_turn() -> Result:
            async with self._parsing.of((host_of(request.peer), is_long)):
                return await parse(given, self._settings.profiles)

        with self._request():
            try:
                return await self._until_disconnect(request, in_turn(), grace=self._limits.ending)
            except ClientDisconnected:
                if not self._ending.is_set():
                    raise
                raise BadRequest("stopping", STOPPING) from None

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
                "keyPrefix": self._repeated.prefix,
            }
        )

    def probe(self, request: Request, _: Given) -> Response:
        """Answers a probe. It needs no token, so the answer has no names."""
        assert self._health is not None, "there is a route"
        return probes.answer(self._health, request, shown_to=None)

    def asset(self, request: Request, _: Given) -> Response:
        """Returns a file of the console."""
        kind, body = assets.read(request.path)
        return response(kind, body, *assets.HEADERS)


def host_of(peer: str) -> str:
    """The address of a peer without its port."""
    return peer.rpartition(":")[0]


def gateway_rejection(
    status: int, reason: str, detail: str, *more: tuple[bytes, bytes]
) -> Response:
    """Returns the response to a refused or failed request."""
    said = {"success": False, "error": detail}
    return json_response(said, (REASON, reason.encode()), *more, status=status)

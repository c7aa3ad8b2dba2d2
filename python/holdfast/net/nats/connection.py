"""The connection to NATS: connects, reconnects forever, and logs both.

nats-py reconnects and repeats the subscriptions by itself. But after some errors of the server it
closes the client permanently. Then this module creates a new client.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Iterable, Mapping
from contextlib import asynccontextmanager
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from nats.errors import Error, FlushTimeoutError
from nats.js.errors import APIError, ServiceUnavailableError

from holdfast.events import log_lines
from holdfast.net.nats import batch
from holdfast.net.nats.credentials import Credentials
from holdfast.net.nats.ping_defaults import PING_INTERVAL_S, PINGS_OUTSTANDING
from holdfast.net.nats.tolerant_client import SafeClient, ServerError
from holdfast.net.secret_file import read_secret
from holdfast.net.secure_channel import SecureChannel, failure_text
from holdfast.net.tls import NO_FILES, Tls
from holdfast.runtime import tasks
from holdfast.runtime.backoff import Backoff

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.aio.subscription import Subscription

Handler: TypeAlias = "Callable[[Msg], Awaitable[None]]"

FIRST_PAUSE_S = 0.25
MAX_PAUSE_S = 2.0
"""Seconds between attempts to connect. Each failure doubles the pause, up to the maximum."""

PROVEN_S = 2.5
"""After a connection of this many seconds, pauses start from the first: it was not refused."""

LOG_INTERVAL_S = 600.0
"""Seconds before an error, or a failure to connect, with the same reason is logged again."""

MAX_LOGGED = 100
"""Limit of remembered reasons. A server that refuses clients may have several in turn."""

MAX_PENDING_BYTES = 64 * 1024 * 1024
"""The limit of nats-py's send buffer in bytes. The outbox always stays below it."""

CHECK_INTERVAL_S = 1.0
"""Seconds between checks whether nats-py closed the client without a callback."""

CLOSE_TIMEOUT_S = 1.5
"""Seconds to send the last messages when a client is closed."""

NO_JETSTREAM = "JetStream is not enabled on the server or for this account"

FIRST_ANSWER_TIMEOUT_S = 3.0
"""Seconds in which servers must answer the first request of a command."""


@dataclass(frozen=True)
class Servers:
    """The NATS servers and the credentials. Files are read again for each new client."""

    urls: tuple[str, ...] = ("nats://127.0.0.1:4222",)
    user: str | None = None
    password_file: Path | None = None
    token_file: Path | None = None
    credentials: Path | None = None
    """A file with a JWT and a seed, see `Credentials`."""
    tls: Tls = NO_FILES
    """The TLS files for the connection."""

    @property
    def secure(self) -> bool:
        """Whether the connection requires TLS."""
        return self.tls != NO_FILES or any(url.startswith("tls://") for url in self.urls)

    @property
    def shown(self) -> str:
        """The URLs for messages, without users and passwords."""
        parts = (url.partition("://") for url in self.urls)
        return ", ".join(f"{scheme}{mark}{rest.rpartition('@')[2]}" for scheme, mark, rest in parts)

    def options(self) -> dict[str, Any]:
        """Returns options for `Client.connect`. Raises `OSError` for an unusable file."""
        options: dict[str, Any] = {"servers": list(self.urls)}
        if self.user is not None:
            options["user"] = self.user
            options["password"] = read_secret(self.password_file) if self.password_file else ""
        if self.token_file is not None:
            options["token"] = read_secret(self.token_file)
        if self.credentials is not None:
            credentials = Credentials(self.credentials)
            options["signature_cb"] = credentials.sign
            options["user_jwt_cb"] = credentials.jwt
        if self.secure:
            SecureChannel("localhost", self.tls)  # Checks the files.
            options["tls"] = self.tls
        return options


@dataclass(frozen=True)
class Ping:
    """How a server that does not answer is detected."""

    interval: float = PING_INTERVAL_S
    """Seconds between pings."""
    outstanding: int = PINGS_OUTSTANDING
    """Pings without an answer. When the next one is due, the client reconnects."""


@dataclass(eq=False)
class NatsConnection:
    """Keeps a connection to NATS. Calls `handlers` for messages of their subjects."""

    servers: Servers
    handlers: Mapping[str, Handler]
    connected: Callable[[SafeClient | None], None]
    ping: Ping
    _: KW_ONLY
    name: str
    """What the server shows of the connection."""
    shared: Collection[str] = ()
    """The subjects whose messages go to one of all members of `queue`."""
    queue: str = ""
    until_member: Callable[[], Awaitable[object]] | None = None
    """Returns when this is a member of `queue`: what it gets before, no other member gets."""
    max_pause_s: float = MAX_PAUSE_S
    """Seconds between attempts to connect."""

    def __post_init__(self) -> None:
        self._backoff = Backoff(FIRST_PAUSE_S, self.max_pause_s, jitter=True, proven_s=PROVEN_S)
        self._pause_s = min(FIRST_PAUSE_S, self.max_pause_s)
        self._failed_attempts = 0
        """Attempts to connect that have failed since there was a connection."""
        self._connected_at = 0.0
        self._logged: dict[str, float] = {}
        """When each reason was logged."""
        self._worked = False
        self.client: SafeClient | None = None
        """The client while there is a connection."""
        self._subscribed = False
        self._subscriptions: list[Subscription] = []
        self._works: list[asyncio.Task[None]] = []
        """What subscribes."""

    @property
    def serves(self) -> bool:
        """Whether messages currently reach the handlers."""
        return self.client is not None and self._subscribed

    async def run(self) -> None:
        """Connects and reconnects until it is cancelled.

        Raises `OSError` for an unusable file before the first connection.
        """
        while True:
            client = SafeClient(requires_tls=self.servers.secure)
            ended = asyncio.Event()
            try:
                await self._connect(client, ended)
            except OSError as error:
                if not self._worked:
                    raise
                self._note(client, error)
            finally:
                self._subscribed = False
                self._note_lost("stopped")
                await _closed(client)
            await asyncio.sleep(self._pause_s)

    async def drain(self) -> None:
        """Takes no further messages. Handlers are called for all that the server has sent."""
        for work in self._works:
            work.cancel()
        if self.client is not None:
            with contextlib.suppress(Error, OSError):
                await self.client.drain_all(self._subscriptions)

    async def _connect(self, client: SafeClient, ended: asyncio.Event) -> None:
        """Connects and subscribes; returns when nats-py gives up, which sets `ended`."""

        async def lost() -> None:
            if self.client is client:
                self._note_lost(client.loss_reason)

        async def again() -> None:
            if not ended.is_set():
                self._note_connected(client)

        async def closed() -> None:
            ended.set()

        async def failed(error: Exception) -> None:
            self._note(client, error)

        try:
            await client.connect(
                **self.servers.options(),
                name=self.name,
                error_cb=failed,
                disconnected_cb=lost,
                reconnected_cb=again,
                closed_cb=closed,
                max_reconnect_attempts=-1,
                reconnect_time_wait=self._pause_s,
                ping_interval=self.ping.interval,
                max_outstanding_pings=self.ping.outstanding,
                pending_size=MAX_PENDING_BYTES,
            )
        # nats-py takes what a server says of itself as it comes.
        except (Error, AttributeError, LookupError, TypeError, ValueError) as error:
            self._note(client, error)
            return
        if self.client is not client and not client.is_reconnecting:  # `again` notes these.
            self._note_connected(client)
        coroutines = self._listen(client, ended), client.repeat_refused()
        works = self._works = [asyncio.create_task(each) for each in coroutines]
        try:
            await _given_up(client, ended)
        finally:
            for work in works:
                work.cancel()
        self._note_lost(client.loss_reason)

    async def _listen(self, client: SafeClient, ended: asyncio.Event) -> None:
        """Subscribes to all subjects. Sets `ended` on failure."""
        self._subscriptions = []
        try:
            own = [each for each in self.handlers if each not in self.shared]
            await self._subscribe(client, own)
            if self.until_member is not None:
                await self.until_member()
            await self._subscribe(client, self.shared, self.queue)
            await _flushed(client)
            self._subscribed = True
        except (Error, OSError) as error:
            self._note(client, error)
            ended.set()

    async def _subscribe(
        self, client: SafeClient, subjects: Iterable[str], queue: str = ""
    ) -> None:
        for subject in subjects:
            handler = _except_answers(self.handlers[subject])
            made = await client.subscribe(subject, queue=queue, cb=handler)
            self._subscriptions.append(made)

    def _note_connected(self, client: SafeClient) -> None:
        url = client.connected_url
        log_lines.write(
            logging.INFO,
            "nats_connected",
            server="" if url is None else f"{url.hostname}:{url.port}",
            attempts=self._failed_attempts + 1,
        )
        self._logged.clear()
        self._worked = True
        self._failed_attempts, self._connected_at = 0, time.monotonic()
        self.client = client
        self.connected(client)

    def _note_lost(self, reason: str) -> None:
        client, self.client = self.client, None
        if client is None:
            return
        # A server may end each connection at once.
        self._pause(client, time.monotonic() - self._connected_at)
        self.connected(None)
        level = logging.INFO if reason == "stopped" else logging.WARNING
        log_lines.write(level, "nats_disconnected", reason=reason)

    def _note(self, client: Client, error: Exception) -> None:
        """Logs an error. Without a connection, the error is a failed attempt to connect."""
        reason, now = failure_text(error), time.monotonic()
        # A server refuses subscriptions again before it is known that there is a connection again.
        is_connected = self.client is not None or isinstance(error, ServerError)
        if not is_connected:
            self._failed_attempts += 1
            self._pause(client, 0.0)
        if now - self._logged.get(reason, -math.inf) < LOG_INTERVAL_S:
            return
        self._logged[reason] = now
        if len(self._logged) > MAX_LOGGED:
            del self._logged[min(self._logged, key=self._logged.__getitem__)]
        if is_connected:
            log_lines.refused("nats_error", kind="nats", reason=reason)
            return
        attempts = self._failed_attempts
        log_lines.write(logging.WARNING, "nats_connect_failed", reason=reason, attempts=attempts)

    def _pause(self, client: Client, worked_s: float) -> None:
        """Sets the pause before the next attempt, after a connection that worked for that long."""
        self._pause_s = client.options["reconnect_time_wait"] = self._backoff.failed(worked_s)
        if worked_s >= PROVEN_S:
            self._backoff.succeeded()  # The end of a connection is no failure to connect.


def _except_answers(handler: Handler) -> Handler:
    """Has `handler` called for messages that are not answers of a scanner.

    Who sends a request chooses the subject of its answer, and may have no right to publish there.
    """

    async def handle(message: Msg) -> None:
        if batch.ANSWER.decode() not in (message.headers or {}):
            await handler(message)
            return
        reason = "it is the answer to a request that has this reply subject"
        log_lines.refused("message_malformed", kind="reply", subject=message.subject, reason=reason)

    return handle


def nats_reason(error: Exception) -> str:
    """Why something on NATS failed, for people: without the marks of nats-py."""
    if isinstance(error, APIError) and error.description:
        return error.description
    if isinstance(error, ServiceUnavailableError):
        return NO_JETSTREAM
    return failure_text(error).removeprefix("nats: ")


@asynccontextmanager
async def connected_once(
    servers: Servers, name: str, within_s: float = FIRST_ANSWER_TIMEOUT_S
) -> AsyncIterator[SafeClient]:
    """A connection for one command, which is not made again after its end.

    Raises `ConnectionError`, which names the servers, if there is none in time, and `OSError` for
    an unusable file.
    """
    client = SafeClient(requires_tls=servers.secure)
    options = servers.options()
    failures: list[Exception] = []

    async def failed(error: Exception) -> None:
        failures.append(error)

    try:
        try:
            async with asyncio.timeout(within_s):
                await client.connect(
                    **options,
                    name=name,
                    error_cb=failed,
                    allow_reconnect=False,
                    # nats-py would try each server 60 times, with pauses of 2 s.
                    max_reconnect_attempts=1,
                    reconnect_time_wait=0,
                    # A server that does not answer leaves time for the others.
                    connect_timeout=within_s / len(servers.urls),
                    ping_interval=PING_INTERVAL_S,
                    max_outstanding_pings=PINGS_OUTSTANDING,
                )
        except (Error, OSError) as error:
            cause = failures[-1] if failures else error
            reason = "no answer in time" if isinstance(cause, TimeoutError) else nats_reason(cause)
            message = f"no connection to NATS at {servers.shown}: {reason}"
            raise ConnectionError(message) from error
        yield client
    finally:
        await _closed(client)


async def _given_up(client: SafeClient, ended: asyncio.Event) -> None:
    """Returns when nats-py has closed a client, or connects no more. It does not always call the
    callback."""
    while not (ended.is_set() or client.is_closed or client.has_stopped_reconnecting):
        await tasks.within(CHECK_INTERVAL_S, ended.wait())
    ended.set()


async def _flushed(client: SafeClient) -> None:
    """Waits until the server has all subscriptions. Raises `FlushTimeoutError`.

    A new connection of the same client has them too; who waits for the one before gets no answer.
    """
    while True:
        before = client.stats["reconnects"]
        try:
            await client.flush()
        except FlushTimeoutError:
            if client.stats["reconnects"] == before:
                raise
        else:
            return


async def _closed(client: Client) -> None:
    """Closes a client, with a timeout. Ignores errors."""
    with contextlib.suppress(Exception):
        async with asyncio.timeout(CLOSE_TIMEOUT_S):
            await client.close()

"""An output to NATS: the values of configured devices, in the messages of the scanner.

Programs that read what the scanner publishes for subscribers read these too.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import msgspec
from nats.errors import Error

from holdfast.net.event_loop import EventLoop
from holdfast.net.nats.connection import MAX_PENDING_BYTES, nats_reason
from holdfast.net.nats.tolerant_client import SafeClient, ServerError, as_quoted
from holdfast.outputs.sender import Receiver, Refused, soon_after, time_left
from holdfast.polling.faults import fault_text, is_exception
from holdfast.runtime.stop import Stop
from holdfast.scanner.dialects import DIALECTS
from holdfast.scanner.messages.types import Data, Status
from holdfast.scanner.subscriptions.tag import datatype
from holdfast.tags.text import plain

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from holdfast.config.values.scanner_settings import Dialect
    from holdfast.net.nats.connection import Servers
    from holdfast.polling import Reading

CONFIRM_TIMEOUT_S = 5.0
"""Time for the server to confirm what was sent."""

CONNECT_TIMEOUT_S = 3.0

CHECK_INTERVAL_S = 0.05
"""Time between checks whether the connection has ended."""

CLOSE_TIMEOUT_S = 1.0

_encode = msgspec.json.Encoder().encode


class NatsOutput(Receiver):
    """One connection, on an event loop that runs in the thread of the output."""

    def __init__(self, servers: Servers, prefix: str, dialect: Dialect) -> None:
        self._servers, self._prefix, self._dialect = servers, prefix, DIALECTS[dialect]
        self._runner = asyncio.Runner(loop_factory=EventLoop)
        self._client: SafeClient | None = None
        self._stop = Stop()
        self._lost: asyncio.Event | None = None
        """Set when the connection of the client has ended."""
        self._states: dict[str, str] = {}
        self._forbidden: list[Exception] = []
        """The error of each message that the server forbade, since the last step began."""

    def use_stop(self, stop: Stop) -> None:
        """Ends a wait for the server soon after the stop. Called before all else."""
        self._stop = stop
        soon_after(stop, self._end)

    def send(self, readings: list[Reading]) -> None:
        """Publishes values, and states that have changed. The server has them when this returns.

        Raises `Refused` if there are some that it never takes.
        """
        try:
            self._runner.run(self._send(readings))
        except (OSError, Error) as error:
            self._states.clear()  # What was published last is not certain.
            self._close_client()
            raise OSError(nats_reason(error)) from error

    def idle(self) -> bool:
        """Lets the client answer pings of the server."""
        if self._client is not None:
            self._runner.run(asyncio.sleep(0))
        return False

    def close(self) -> None:
        """Closes the connection."""
        self._close_client()
        self._runner.close()

    def status(self) -> dict[str, object]:
        """Where values go."""
        return {"servers": list(self._servers.urls), "prefix": self._prefix}

    def _end(self) -> None:
        """Called by another thread: what waits for the server gets an error."""
        lost = self._lost
        if lost is not None:
            with contextlib.suppress(RuntimeError):  # The loop may be closed.
                self._runner.get_loop().call_soon_threadsafe(lost.set)

    async def _send(self, readings: list[Reading]) -> None:
        client = await self._connected()
        self._forbidden = []  # Those of the connection before do not count.
        reasons: list[str] = []
        refused: set[tuple[str, int]] = set()
        """Subjects of messages, and which reading each one is of."""
        published: dict[str, set[int]] = {}
        """The same, by subject."""
        for at, reading in enumerate(readings):
            for subject, payload in self._messages(reading):
                if len(payload) > client.max_payload:
                    message = f"{subject}: found {len(payload)} bytes"
                    reasons.append(f"{message}, the server takes {client.max_payload}")
                    refused.add((subject, at))
                else:
                    published.setdefault(subject, set()).add(at)
                    await client.publish(subject, payload)
        # The server tells of each message that it forbids before it confirms the step.
        await self._confirmed(client)
        reasons += map(nats_reason, self._forbidden)
        forbidden = {each.subject for each in self._forbidden if isinstance(each, ServerError)}
        for subject, which in published.items():
            if as_quoted(subject) in forbidden:
                refused.update((subject, at) for at in which)
        for subject, at in refused:
            device = readings[at].device
            if subject in self._dialect.status_subjects(self._prefix, device):
                self._states.pop(device, None)  # It is published again.
        if reasons:
            raise Refused(reasons[0], [readings[at] for at in sorted({at for _, at in refused})])

    async def _confirmed(self, client: SafeClient) -> None:
        """Waits until the server has everything. A connection that ends is an error at once."""
        assert self._lost is not None, "set with the client"
        flushing = asyncio.ensure_future(client.flush(timeout=int(CONFIRM_TIMEOUT_S)))
        losing = asyncio.ensure_future(self._lost.wait())
        try:
            while not flushing.done():
                # nats-py does not call `disconnected_cb` if it fails to send the last bytes.
                if losing.done() or client.is_closed:
                    raise ConnectionError(client.loss_reason)
                await asyncio.wait(
                    {flushing, losing},
                    timeout=CHECK_INTERVAL_S,
                    return_when=asyncio.FIRST_COMPLETED,
                )
            flushing.result()
        finally:
            for task in (flushing, losing):
                task.cancel()

    async def _connected(self) -> SafeClient:
        if self._client is None or self._client.is_closed:
            lost = self._lost = asyncio.Event()

            async def is_lost() -> None:
                lost.set()

            client = SafeClient(requires_tls=self._servers.secure)
            try:
                seconds = min(CONNECT_TIMEOUT_S, time_left(self._stop))
                await asyncio.wait_for(self._connect(client, is_lost), seconds)
            except BaseException:
                await client.close()
                raise
            self._client = client
        return self._client

    async def _connect(self, client: SafeClient, lost: Callable[[], Awaitable[None]]) -> None:
        """Tries each server once."""
        options: dict[str, Any] = self._servers.options()
        await client.connect(
            **options,
            allow_reconnect=False,
            connect_timeout=int(CONNECT_TIMEOUT_S),
            max_reconnect_attempts=1,
            reconnect_time_wait=0,
            pending_size=MAX_PENDING_BYTES,
            error_cb=self._note_error,
            disconnected_cb=lost,
        )

    async def _note_error(self, error: Exception) -> None:
        """Notes a message that the server forbids. Any other error also ends `send`."""
        self._forbidden.append(error)

    def _close_client(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            try:
                self._runner.run(asyncio.wait_for(client.close(), CLOSE_TIMEOUT_S))
            except (TimeoutError, OSError, Error):
                return

    def _messages(self, reading: Reading) -> list[tuple[str, bytes]]:
        device, tag, value, time, fault, _ = reading
        stamp = int(time * 1000)
        made = self._state(device, fault, stamp)
        if not fault:
            kind = datatype(tag.of_type)
            message = Data(self._prefix, device, tag.name, plain(tag, value), kind, stamp)
            subject = self._dialect.data_subject(self._prefix, device, tag.name)
            made.append((subject, _encode(message)))
        return made

    def _state(self, device: str, fault: int, stamp: int) -> list[tuple[str, bytes]]:
        """The state of a device, if it has changed. One that answers with exceptions is online."""
        message = Status(device, "online", 0, stamp)
        if fault and not is_exception(fault):
            message = Status(device, "offline", 1, stamp, fault_text(fault))
        if self._states.get(device) == message.state:
            return []
        self._states[device] = message.state
        payload = _encode(message)
        subjects = self._dialect.status_subjects(self._prefix, device)
        return [(subject, payload) for subject in subjects]

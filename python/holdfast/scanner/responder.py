"""Carries out requests concurrently, and answers each of them."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, TypeAlias

import msgspec

from holdfast.events import log_lines
from holdfast.polling.write_ttl import WRITE_TTL_S
from holdfast.runtime import tasks
from holdfast.scanner.errors import STOPPING, NotConfirmed, Refused
from holdfast.scanner.messages.types import Answer, BrowseAnswer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Coroutine
    from typing import Any

    from nats.aio.msg import Msg

    from holdfast.net.nats.outbox import Outbox

Handle: TypeAlias = "Callable[[Msg], Awaitable[Answer | BrowseAnswer | bytes]]"
"""Carries out a message. Returns the answer, or its JSON."""

READY_WITHIN_S = WRITE_TTL_S
"""How long requests wait until the scanner is ready: as long as a command may wait at all."""

MAX_WAITING_BYTES = 64 * 1024 * 1024
"""The limit of the bytes of all requests that wait until then."""

LARGE_REQUEST_BYTES = 16 * 1024
"""Size of a request that takes milliseconds to parse."""


class Responder:
    """Runs requests as tasks, up to a limit."""

    def __init__(
        self, max_pending: int, outbox: Outbox, *until_ready: Callable[[], Awaitable[object]]
    ) -> None:
        """Requests wait for each of `until_ready`."""
        self._max_pending = max_pending
        self._outbox = outbox
        self._until_ready = until_ready
        self._turn = asyncio.Lock()
        """Held by the request that waits for them. The others get their turns in order."""
        self._tasks: set[asyncio.Task[None]] = set()
        self._request_lock = asyncio.Lock()
        """Held while a request is parsed and checked."""
        self._waiting_bytes = 0

    def answering(self, kind: str, handle: Handle) -> Callable[[Msg], Awaitable[None]]:
        """Returns a handler that carries out messages concurrently and answers them."""

        async def carry_out(message: Msg) -> None:
            await self.answer(message, await self._carry_out(kind, handle, message))

        async def begin(message: Msg) -> None:
            self.begin(carry_out(message))

        return begin

    async def answer(self, message: Msg, answer: Answer | BrowseAnswer | bytes) -> None:
        """Answers a message that has a reply subject.

        Its sender has chosen that subject, and may have no right to publish to it: there is no
        answer to a subject of NATS, and scanners carry out no answers.
        """
        if not message.reply:
            return
        if message.reply.startswith("$"):
            reason = f"no answer to {message.reply}: a reply subject can't begin with $"
            log_lines.refused(
                "message_malformed", kind="reply", subject=message.subject, reason=reason
            )
            return
        payload = answer if isinstance(answer, bytes) else msgspec.json.encode(answer)
        if len(payload) > self._outbox.max_answer:
            # The server would end the connection, at each repetition of the request.
            size = f"{len(payload)} bytes, allowed: {self._outbox.max_answer}"
            error = Answer(success=False, error=f"the answer is too large: {size}")
            payload = msgspec.json.encode(error)
        await self._outbox.answer(message.reply, payload)

    async def _carry_out(
        self, kind: str, handle: Handle, message: Msg
    ) -> Answer | BrowseAnswer | bytes:
        try:
            # Checked here and not before the task: a refusal is an answer, too.
            if len(self._tasks) > self._max_pending:
                limit = f"{self._max_pending} are pending, which is the limit"
                raise Refused(f"too many requests: {limit}")
            await self._wait_until_ready(kind, len(message.data))
            return await handle(message)
        except Refused as refused:
            more = {"outcome": "not_confirmed"} if isinstance(refused, NotConfirmed) else {}
            log_lines.refused(
                "request_refused",
                kind=kind,
                subject=message.subject,
                reason=str(refused),
                **more,
            )
            return Answer(success=False, error=str(refused))
        except asyncio.CancelledError:  # By `end`, while the caller waits.
            outcome = "not written" if kind == "command" else "not confirmed"
            return Answer(success=False, error=f"{outcome}: {STOPPING}")
        except Exception as error:  # An error in one request must not stop the service.
            log_lines.problem("request_failed", subject=message.subject)
            return Answer(success=False, error=f"internal error: {type(error).__name__}")

    async def _wait_until_ready(self, kind: str, size: int) -> None:
        """Raises `Refused` after some seconds, or if requests of too many bytes wait already."""
        outcome = "not written: " if kind == "command" else ""
        if self._waiting_bytes + size > MAX_WAITING_BYTES:
            limit = f"{MAX_WAITING_BYTES} bytes of them wait, which is the limit"
            raise Refused(f"{outcome}too many requests: {limit}")
        self._waiting_bytes += size
        try:
            async with asyncio.timeout(READY_WITHIN_S), self._turn:
                for wait in self._until_ready:
                    await wait()
                self._until_ready = ()  # Some wait for a limited time: only the first one does.
        except TimeoutError:
            raise Refused(f"{outcome}subscriptions are not read yet: try again") from None
        finally:
            self._waiting_bytes -= size

    def begin(self, work: Coroutine[Any, Any, None]) -> None:
        """Runs a task that `end` ends."""
        tasks.begin(work, self._tasks)

    async def finish(self, within_s: float) -> None:
        """Waits until all tasks have ended, or for this time."""
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=within_s)

    async def end(self) -> None:
        """Ends all tasks. Requests that are still being carried out are answered."""
        await tasks.end(self._tasks)

    @contextlib.asynccontextmanager
    async def in_order(self, message: Msg, *, is_large: bool = False) -> AsyncIterator[None]:
        """Serializes requests. Lets polls run before a request that takes milliseconds."""
        async with self._request_lock:
            if is_large or len(message.data) > LARGE_REQUEST_BYTES:
                await asyncio.sleep(0)  # The event loop handles the results of polls meanwhile.
            yield

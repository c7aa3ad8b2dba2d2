"""A NATS client and scanners, for tests.

Everything stays on the loopback interface, and everything that was started is stopped.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import queue
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import pytest
from nats.aio.client import Client
from nats.js import JetStreamContext
from nats.js.errors import APIError, NotFoundError

from holdfast.config.values.scanner_settings import parse_pollable
from holdfast.net.nats.connection import Servers
from holdfast.scanner.jetstream.store import BUCKET
from holdfast.scanner.service import Scanner
from holdfast.scanner.settings import Settings
from support import wire
from support.brokers import NatsServer

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Iterator
    from types import TracebackType
    from typing import Self

    from nats.aio.msg import Msg

    import holdfast
    from holdfast.scanner.messages.types import SubscriptionRequest

Result = TypeVar("Result")


class _Loop:
    """An event loop in its own thread."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()

    def do(self, work: Coroutine[Any, Any, Result], seconds: float = wire.DEADLINE) -> Result:
        """Runs a coroutine and returns its result."""
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(seconds)

    def close(self) -> None:
        self.do(self._cancel())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()

    @staticmethod
    async def _cancel() -> None:
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)


class Inbox:
    """The received JSON messages of a subject, in order."""

    def __init__(self) -> None:
        self._queue: queue.Queue[Any] = queue.Queue()

    async def put(self, message: Msg) -> None:
        self._queue.put(json.loads(message.data))

    def next(self, seconds: float = wire.DEADLINE) -> Any:
        """Returns the next message."""
        try:
            return self._queue.get(timeout=seconds)
        except queue.Empty:
            raise AssertionError(f"no message within {seconds} s") from None

    def until(self, wanted: Callable[[Any], object], what: str) -> Any:
        """Returns the next matching message; skips others."""
        deadline = time.monotonic() + wire.DEADLINE
        last: Any = None
        while (left := deadline - time.monotonic()) > 0:
            with contextlib.suppress(queue.Empty):
                last = self._queue.get(timeout=left)
                if wanted(last):
                    return last
        raise AssertionError(f"not within {wire.DEADLINE} s: {what}; the last message is {last}")

    def take(self) -> list[Any]:
        """Returns all received messages."""
        found = []
        with contextlib.suppress(queue.Empty):
            while True:
                found.append(self._queue.get_nowait())
        return found


class Caller:
    """A NATS client beside the scanner; `options` are for `Client.connect`."""

    def __init__(self, url: str | list[str], client: Client | None = None, **options: Any) -> None:
        self._loop = _Loop()
        self.client = client or Client()
        self._loop.do(
            self.client.connect(
                url,
                max_reconnect_attempts=-1,
                reconnect_time_wait=0.05,  # type: ignore[arg-type]
                error_cb=_ignored,
                **options,
            )
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._loop.do(self.client.close())
        self._loop.close()

    def request(self, subject: str, payload: object, seconds: float = wire.DEADLINE) -> Any:
        """Sends a request and returns the answer. A string is sent as is, other values as JSON."""
        message = self._loop.do(self.client.request(subject, _bytes(payload), timeout=seconds))
        return json.loads(message.data)

    def publish(self, subject: str, payload: object = b"", reply: str = "") -> None:
        """Publishes a message and waits until the server has it."""
        self._loop.do(self._published(subject, _bytes(payload), reply))

    async def _published(self, subject: str, payload: bytes, reply: str) -> None:
        await self.client.publish(subject, payload, reply)
        await self.client.flush()

    def listen(self, subject: str) -> Inbox:
        """Subscribes to a subject and returns its inbox."""
        inbox = Inbox()
        self._loop.do(self._listening(subject, inbox))
        return inbox

    async def _listening(self, subject: str, inbox: Inbox) -> None:
        await self.client.subscribe(subject, cb=inbox.put)
        await self.client.flush()
        await self.client.flush()  # The ping of the first one may overtake the subscription.

    def kept(self, bucket: str) -> dict[str, Any]:
        """Returns the JSON values of a key-value bucket; nothing if there is no bucket."""
        found = self._loop.do(self._values(bucket))
        return {key: json.loads(value) for key, value in found.items()}

    def keys(self, bucket: str) -> set[str]:
        """Returns the keys of a bucket. `KeyValue.keys` of nats-py finds none now and then."""
        return set(self._loop.do(self._values(bucket)))

    async def _values(self, bucket: str) -> dict[str, bytes]:
        before = f"$KV.{bucket}."
        try:
            found = await self.client.jetstream().key_value(bucket)
            info = await self.client.jetstream().stream_info(f"KV_{bucket}", subjects_filter=">")
        except NotFoundError:
            return {}
        values: dict[str, bytes] = {}
        for key in (subject.removeprefix(before) for subject in info.state.subjects or {}):
            with contextlib.suppress(NotFoundError):  # It is deleted.
                values[key] = (await found.get(key)).value or b""
        return values

    def text(self, bucket: str, key: str) -> str:
        """Returns the value of a key as text."""
        return self._loop.do(self._text(bucket, key)).decode()

    async def _text(self, bucket: str, key: str) -> bytes:
        return (await (await self.client.jetstream().key_value(bucket)).get(key)).value or b""

    def put(self, bucket: str, key: str, value: object) -> None:
        """Writes a key of a bucket; creates the bucket. A string is written as is."""
        self._loop.do(self._put(bucket, key, _bytes(value)))

    async def _put(self, bucket: str, key: str, value: bytes) -> None:
        jetstream = self.client.jetstream()
        try:
            found = await jetstream.key_value(bucket)
        except NotFoundError:
            found = await jetstream.create_key_value(bucket=bucket, history=1)
        await found.put(key, value)

    def delete(self, bucket: str, key: str) -> None:
        """Deletes a key of a bucket, as `nats kv del` does."""
        self._loop.do(self._deleted(bucket, key))

    async def _deleted(self, bucket: str, key: str) -> None:
        await (await self.client.jetstream().key_value(bucket)).delete(key)

    def forget(self, bucket: str) -> None:
        """Deletes a key-value bucket, if there is one.

        It is emptied before, because a server under load may still find the contents of a deleted
        bucket when another of the same name is created.
        """
        jetstream, stream = self.client.jetstream(), f"KV_{bucket}"
        with contextlib.suppress(NotFoundError):
            self._loop.do(jetstream.purge_stream(stream))
            self._loop.do(jetstream.delete_stream(stream))

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        """The client's loop."""
        return self._loop.loop

    def do(self, work: Coroutine[Any, Any, Result]) -> Result:
        """Runs a coroutine in the client's loop and returns its result."""
        return self._loop.do(work)


async def _ignored(_: Exception) -> None:
    pass


def _bytes(payload: object) -> bytes:
    if isinstance(payload, bytes):
        return payload
    return payload.encode() if isinstance(payload, str) else json.dumps(payload).encode()


class Running:
    """A scanner in its own thread."""

    def __init__(self, settings: Settings, former: Iterable[SubscriptionRequest] = ()) -> None:
        loop = _Loop()
        self._loop: _Loop | None = loop
        try:
            self.scanner = loop.do(self._made(settings, former))
        except BaseException:
            loop.close()
            raise
        self.ended = asyncio.run_coroutine_threadsafe(self.scanner.run(), loop.loop)

    @staticmethod
    async def _made(settings: Settings, former: Iterable[SubscriptionRequest]) -> Scanner:
        return Scanner(settings, former=former)

    @property
    def serves(self) -> bool:
        """Whether the scanner is connected and subscribed."""
        return self.scanner.serves

    def do(self, work: Coroutine[Any, Any, Result]) -> Result:
        """Runs a coroutine in the scanner's loop and returns its result."""
        assert self._loop is not None
        return self._loop.do(work)

    def stop(self) -> None:
        """Stops the scanner and waits for its end."""
        if self._loop is None:
            return
        loop, self._loop = self._loop, None
        loop.loop.call_soon_threadsafe(self.scanner.end)
        try:
            self.ended.result(2 * wire.DEADLINE)
        finally:
            loop.close()


class Run(Protocol):
    """Starts a scanner, waits until it serves, and stops it when the test ends."""

    def __call__(
        self, server: NatsServer | None = None, *, wait: bool = True, **settings: Any
    ) -> Running: ...


@pytest.fixture(scope="session")
def shared_nats(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NatsServer]:
    server = NatsServer(tmp_path_factory.mktemp("nats"), "-m", "-1")
    yield server
    server.kill()


@pytest.fixture
def nats(shared_nats: NatsServer) -> Iterator[NatsServer]:
    """A server that all tests share, if they do not disturb it.

    What a scanner keeps there is removed at the end of each test.
    """
    yield shared_nats
    with Caller(shared_nats.url) as caller:
        caller.forget(BUCKET)


@pytest.fixture
def own_nats(tmp_path: Path) -> Iterator[NatsServer]:
    """A server of one test."""
    server = NatsServer(tmp_path)
    yield server
    server.kill()


SMALL_PAYLOAD = 4096
"""The size limit of messages of `small_nats` in bytes."""


@pytest.fixture
def small_nats(tmp_path: Path) -> Iterator[NatsServer]:
    """A server of one test that ends the connection of a client with a larger message."""
    file = tmp_path / "small.conf"
    file.write_text(f"max_payload: {SMALL_PAYLOAD}\n")
    server = NatsServer(tmp_path, "-c", str(file))
    yield server
    server.kill()


@pytest.fixture
def caller(nats: NatsServer) -> Iterator[Caller]:
    with Caller(nats.url) as caller:
        yield caller


@pytest.fixture
def own_caller(own_nats: NatsServer) -> Iterator[Caller]:
    with Caller(own_nats.url) as caller:
        yield caller


@pytest.fixture
def run_scanner(nats: NatsServer) -> Iterator[Run]:
    with ExitStack() as running:

        def start(server: NatsServer | None = None, *, wait: bool = True, **more: Any) -> Running:
            more.setdefault("servers", Servers(((server or nats).url,)))
            more.setdefault("max_pause_s", 0.1)
            more["allow"] = tuple(map(parse_pollable, more.get("allow", ())))
            former = more.pop("former", ())
            scanner = Running(Settings(**more), former)
            running.callback(scanner.stop)
            if wait:
                wire.until(lambda: scanner.serves, "the scanner is connected")
            return scanner

        yield start
    # What a scanner sent last could otherwise be stored after the bucket was deleted.
    wire.until(lambda: "holdfast scan" not in nats.clients(), "scanners have left")


@pytest.fixture
def scanner(run_scanner: Run) -> Running:
    """A scanner with default settings, connected to `nats`."""
    return run_scanner()


def refuse_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on, JetStream refuses changes of the settings of streams."""

    async def refuse(*_: Any, **__: Any) -> None:
        raise APIError(code=500, description="not today")

    monkeypatch.setattr(JetStreamContext, "update_stream", refuse)


def logged(caplog: pytest.LogCaptureFixture, event: str) -> list[dict[str, Any]]:
    """Returns the fields of an event, for each time it was logged."""
    return [
        record.fields  # type: ignore[attr-defined]
        for record in caplog.records
        if record.getMessage() == event
    ]


def tag(id: str, address: int, datatype: str = "uint16", **more: Any) -> dict[str, Any]:
    """Builds a tag of a request; by default in holding registers."""
    return {"id": id, "address": address, "functionCode": "holding", "datatype": datatype, **more}


def subscription(server: holdfast.Server, *tags: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Builds a request for tags of a server with the id plc1."""
    host, port = server.address
    return {
        "deviceId": "plc1",
        "host": host,
        "port": port,
        "scanRate": 50,
        "subscriberId": "hmi",
        "tags": list(tags),
        **more,
    }


def leaving(*ids: str, **more: Any) -> dict[str, Any]:
    """Builds a request to remove tags."""
    return {"deviceId": "plc1", "subscriberId": "hmi", "tagIds": list(ids), **more}

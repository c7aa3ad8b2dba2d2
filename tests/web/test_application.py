"""Applications by the face that a host sees: a request in, a response or a stream out."""

from __future__ import annotations

import asyncio
import hashlib
import json
from typing import TYPE_CHECKING, Any, TypeAlias

import pytest

import holdfast
from holdfast.net.http.bearer import owner
from holdfast.net.http.fields import NotJson, decoded
from holdfast.net.http.requests import BadRequest, ClientDisconnected, Headers, Request, Response
from support import web

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterator

    from holdfast.adapters.rest.app import App
    from holdfast.net.http.requests import SecondStep

    Answer: TypeAlias = Response | SecondStep | Awaitable[Response | None]

HOST = (b"host", b"127.0.0.1")
KIND = (b"content-type", b"application/json")
COMMAND = json.dumps(web.command("coils", 0, [1])).encode()
COIL = b"memory=plant_a&area=coils&address=0&count=1"


class Arriving(Request):
    """A request whose body comes in pieces, or that takes a stream."""

    def __init__(
        self, method: str, path: str, query: bytes = b"", pieces: tuple[bytes, ...] = ()
    ) -> None:
        super().__init__(method, path, query, [HOST, KIND], "127.0.0.1:50000", whole=None)
        self._pieces = list(pieces)
        self.late = asyncio.Event()
        self.sent: list[bytes | int] = []
        self.leave: Callable[[], object] = lambda: None
        self.got = asyncio.Event()

    async def receive(self, most: int) -> bytes:
        body = b"".join(self._pieces)
        if self.late.is_set():
            raise BadRequest("timeout", "the body is incomplete")
        if len(body) > most:
            raise BadRequest("too_large", f"the body has more than {most} bytes")
        return body

    def when_gone(self, function: Callable[[], object] | None) -> None:
        if function is not None:
            self.leave = function

    async def begin(self, status: int, headers: Headers) -> None:  # noqa: ARG002
        self.sent.append(status)

    async def send(self, data: bytes) -> None:
        self.sent.append(data)
        self.got.set()

    async def end(self) -> None:
        self.sent.append(b"")


def whole(method: str, path: str, body: bytes = b"", query: bytes = b"") -> Request:
    return Request(method, path, query, [HOST, KIND], "127.0.0.1:50000", whole=body)


@pytest.fixture
def memory() -> holdfast.Memory:
    return holdfast.Memory(coils=8)


@pytest.fixture
def app(memory: holdfast.Memory) -> Iterator[App]:
    service = web.Service({"plant_a": memory}, max_body=1024)
    yield service.made()._app
    service.listener.close()


def at_once(answer: Answer) -> Response:
    """The answer of a handler that needs no event loop: it takes two steps at most."""
    whole = answer() if callable(answer) else answer
    assert isinstance(whole, Response)
    return whole


def waited(
    answer: Response | SecondStep | Awaitable[Response | None],
) -> Awaitable[Response | None]:
    """The coroutine of a handler that has to wait."""
    assert not isinstance(answer, Response)
    assert not callable(answer)
    return answer


def run(test: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(test())


def test_what_needs_no_waiting_is_answered_without_a_coroutine(
    app: App, memory: holdfast.Memory
) -> None:
    async def test() -> None:
        for request, body in (
            (whole("POST", web.INGEST, COMMAND), b'"accepted"'),
            (whole("GET", web.READ, query=COIL), b'{"values":[1]}'),
            (whole("GET", "/api/v1/health"), b'{"status":"ok"}'),
            (whole("GET", "/nowhere"), b"not_found"),
            (whole("POST", web.INGEST, b"{"), b"malformed"),
        ):
            assert body in at_once(app(request)).body

    run(test)
    assert memory.read("coils", 0, 1) == [1]


def test_a_body_that_still_arrives_is_answered_as_a_whole_one(
    app: App, memory: holdfast.Memory
) -> None:
    async def test() -> None:
        answer = app(Arriving("POST", web.INGEST, pieces=(COMMAND[:9], b"", COMMAND[9:])))
        assert await waited(answer) == at_once(app(whole("POST", web.INGEST, COMMAND)))

    run(test)
    assert memory.read("coils", 0, 1) == [1]


def test_a_body_that_is_too_large_or_late_closes_the_connection(app: App) -> None:
    async def test() -> None:
        large = app(Arriving("POST", web.INGEST, pieces=(b" " * 1000, b" " * 1000)))
        late = Arriving("POST", web.INGEST, pieces=(b"{", b""))
        late.late.set()
        for answer in (large, app(late), app(whole("POST", web.INGEST, b" " * 1025))):
            response = answer if isinstance(answer, Response) else await waited(answer)
            assert response is not None
            assert (response.status in (408, 413), response.closes) == (True, True)

    run(test)


def test_a_stream_begins_sends_and_ends_when_its_client_is_gone(app: App) -> None:
    async def test() -> None:
        request = Arriving("GET", "/api/v1/memory/changes", COIL)
        answer = app(request)
        task = asyncio.ensure_future(waited(answer))
        await request.got.wait()
        request.leave()
        assert await task is None
        status, event, *_, end = request.sent
        assert (status, end) == (200, b"")
        assert isinstance(event, bytes)
        assert event.startswith(b"id: 0\nevent: values\n")

    run(test)
    assert app.open_streams == 0


def test_a_stream_whose_client_cannot_be_reached_frees_its_place(
    app: App, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fail(*_: object) -> None:
        raise ClientDisconnected

    async def test() -> None:
        monkeypatch.setattr(Arriving, "send", fail)
        answer = app(Arriving("GET", "/api/v1/memory/changes", COIL))
        with pytest.raises(ClientDisconnected):
            await waited(answer)

    run(test)
    assert app.open_streams == 0


def test_a_query_that_is_sent_again_is_answered_anew(app: App, memory: holdfast.Memory) -> None:
    async def test() -> None:
        for value in (0, 1):
            memory.write("coils", 0, [value])
            answer = app(whole("GET", web.READ, query=COIL))
            assert isinstance(answer, Response)
            assert answer.body == b'{"values":[%d]}' % value

    run(test)


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (b"", "line 1 column 1"),
        (b"{\n1}", "line 2 column 1"),
        (b'{"a":NaN}', "NaN is out of range"),
        (b"[-Infinity]", "-Infinity is out of range"),
        (b"[1e999]", "1e999 is out of range"),
        (b"[-0.1e-999]", "-0.1e-999 is out of range"),
        (b"[-" + b"9" * 5000 + b"]", "an integer has 5000 digits, allowed: 4300"),
        (b'["\\ud800"]', "surrogate"),
        (b'["\xff"]', "can't decode byte 0xff"),
        (b"\xff\xfe[\x00]\x00", "can't decode byte 0xff"),
        (b'"\x01"', "control character"),
        (b"[" * 60_000, "recursion"),
        (b"[] []", "Extra data"),
    ],
)
def test_what_is_not_json_is_told_by_its_place(body: bytes, says: str) -> None:
    with pytest.raises(NotJson) as raised:
        decoded(body)
    assert raised.value.detail.startswith("the body is not JSON: ")
    assert says in raised.value.detail
    assert len(raised.value.detail) < 130


def test_a_query_beside_a_body_is_refused(app: App, memory: holdfast.Memory) -> None:
    async def test() -> None:
        answer = at_once(app(whole("POST", web.INGEST, COMMAND, query=b"value=1")))
        assert answer.status == 400
        assert b"allowed: none beside a body" in answer.body

    run(test)
    assert memory.read("coils", 0, 1) == [0]


@pytest.mark.parametrize("body", [b'{"a":1,"a":1}', b'[{"b":{"a":1,"c":2,"a":3}}]'])
def test_a_name_that_is_given_twice_is_refused(body: bytes) -> None:
    with pytest.raises(BadRequest, match='"a" is given more than once'):
        decoded(body)


def test_json_is_decoded_as_it_is_written() -> None:
    text = '{"a": [1, 1.0, true, null, "\\u00e9\\ud83d\\ude00", 18446744073709551616]}'
    found = decoded(text.encode())
    assert found == {"a": [1, 1.0, True, None, "\u00e9\U0001f600", 2**64]}
    assert [type(each) for each in found["a"][:3]] == [int, float, bool]


@pytest.mark.parametrize("value", [b"Bearer", b"Bearer ", b"Bearer  \t"])
def test_an_empty_token_is_nobodys_though_a_token_has_its_hash(value: bytes) -> None:
    request = Request("GET", "/", b"", [(b"authorization", value)], "127.0.0.1:50000")
    with pytest.raises(BadRequest, match="the token is empty") as caught:
        owner(request, [("edge", hashlib.sha256(b"").digest())])
    assert caught.value.reason == "unauthorized"


def test_streams_that_are_asked_for_at_once_do_not_exceed_the_limit() -> None:
    async def test() -> None:
        # Half of the connections are two.
        service = web.Service({"plant_a": holdfast.Memory(coils=8)}, max_connections=4)
        app = service.made()._app
        service.listener.close()
        requests = [Arriving("GET", "/api/v1/memory/changes", COIL) for _ in range(4)]
        tasks = [asyncio.ensure_future(waited(app(each))) for each in requests]
        await asyncio.gather(*(each.got.wait() for each in requests[:2]))
        assert app.open_streams == 2
        answers = [await each for each in tasks[2:]]
        assert [answer and answer.status for answer in answers] == [503, 503]
        assert [each.sent for each in requests[2:]] == [[], []]
        for each in requests[:2]:
            each.leave()
        await asyncio.gather(*tasks)
        assert app.open_streams == 0

    run(test)

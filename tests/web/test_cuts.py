"""HTTP requests cut and joined over a socket: the responses and what they do are the same.

The core has the same test without a socket, cut at every byte:
`crates/engine/src/http/cut_tests.rs`.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, NamedTuple

import pytest

import holdfast
from support import web, wire

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


class Outcome(NamedTuple):
    """What a client sees, and what was written."""

    answers: list[tuple[int, bytes]]
    coils: list[int]


class Rest:
    """A REST service and its memory."""

    def __init__(self, service: web.Service, memory: holdfast.Memory) -> None:
        self.service = service
        self.memory = memory

    def outcome(self, pieces: Sequence[bytes]) -> Outcome:
        """Sends the pieces one by one, and then no more."""
        self.memory.write("coils", 0, [0] * 8)
        with wire.Connection(self.service.address) as connection:
            # After `Connection: close`, the service may be gone before the next piece.
            with contextlib.suppress(OSError):
                for piece in pieces:
                    connection.send(piece)
                connection.finish()
            received = connection.rest().replace(b"HTTP/1.1 100 Continue\r\n\r\n", b"")
        answers = [(answer.status, answer.body) for answer in web.answers(received)]
        return Outcome(answers, self.memory.read("coils", 0, 8))


@pytest.fixture(scope="module")
def rest() -> Iterator[Rest]:
    memory = holdfast.Memory(coils=8)
    service = web.Service({"plant_a": memory}, max_body=1024)
    with web.supervised(service.supervisor, service.listener):
        yield Rest(service, memory)


def write(address: int, *headers: str) -> bytes:
    body = b'{"memory":"plant_a","area":"coils","address":%d,"values":[1]}' % address
    return web.post(body, *headers)


def chunked(address: int, *headers: str, size: int = 9) -> bytes:
    kind = ("Content-Type: application/json", "Transfer-Encoding: chunked", *headers)
    _, _, body = write(address).partition(b"\r\n\r\n")
    chunks = [body[at : at + size] for at in range(0, len(body), size)]
    framed = b"".join(b"%x\r\n%b\r\n" % (len(chunk), chunk) for chunk in chunks)
    return web.head("POST", web.INGEST, *kind) + framed + b"0\r\n\r\n"


HEALTH = web.head("GET", "/api/v1/health")
OFFER = ("Connection: Upgrade", "Upgrade: websocket")
JSON = "Content-Type: application/json"
CASES: dict[str, bytes] = {
    "read": HEALTH,
    "write": write(0),
    "chunked": chunked(1),
    "offer": write(2, *OFFER),
    "absent": web.head("GET", "/nowhere"),
    "not JSON": web.post(b"{", "X-Y: z"),
    "other type": write(3).replace(b"application/json", b"text/plain"),
    "asks first": write(4, "Expect: 100-continue"),
    "last": write(5, "Connection: close"),
    "old": write(6).replace(b"HTTP/1.1", b"HTTP/1.0"),
    "no HTTP": b"\x00garbage\r\n\r\n",
    "no host": b"GET http:// HTTP/1.1\r\n\r\n",
    "other version": HEALTH.replace(b"HTTP/1.1", b"HTTP/2.0"),
    "wrong header": web.head("GET", "/api/v1/health", "X : y"),
    "wrong chunk": chunked(7).replace(b"\r\n0\r\n", b"\r\nx\r\n"),
    "wrong chunk of another type": web.head("POST", web.INGEST, "Transfer-Encoding: chunked")
    + b"x\r\n",
    "lengths": web.head("POST", web.INGEST, JSON, "Content-Length: 1", "Content-Length: 2") + b"xx",
    "too long": web.head("POST", web.INGEST, JSON, "Content-Length: 1025") + b" " * 1025,
}


def cuts(sent: bytes) -> Iterator[list[bytes]]:
    """The bytes cut in two at several places, and byte by byte at the beginning."""
    most = min(len(sent), 400)
    for cut in range(1, most, most // 8):
        yield [sent[:cut], sent[cut:]]
    yield [*(sent[at : at + 1] for at in range(most)), sent[most:]]


@pytest.mark.parametrize("name", CASES)
def test_a_request_has_the_same_outcome_however_it_is_cut(rest: Rest, name: str) -> None:
    whole = rest.outcome([CASES[name]])
    assert whole.answers
    for pieces in cuts(CASES[name]):
        assert rest.outcome(pieces) == whole, pieces


@pytest.mark.parametrize("name", CASES)
def test_joined_requests_have_the_same_outcome_as_those_that_are_sent_apart(
    rest: Rest, name: str
) -> None:
    names = [*CASES, *CASES]
    for other in names[names.index(name) :][:5]:
        sent = [CASES[name], CASES[other], HEALTH]
        assert rest.outcome([b"".join(sent)]) == rest.outcome(sent), other

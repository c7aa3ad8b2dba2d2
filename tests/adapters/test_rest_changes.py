"""The change stream of REST: what is sent, to whom, and when it ends."""

from __future__ import annotations

import json
import socket
import threading
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Protocol
from urllib.parse import urlencode

import pytest

import holdfast
from holdfast.adapters.rest import changes
from holdfast.appliance import Appliance
from holdfast.config import load
from support import event_streams, web, wire
from support.config_folder import written
from support.event_streams import EventStream
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


PATH = "/api/v1/memory/changes"
READER, NARROW = "secret-reader", "secret-narrow"
TOKENS = [
    web.token("reader", READER, access="read-only"),
    web.token("narrow", NARROW, areas=("coils",)),
]
SOON = 0.05
Query = list[tuple[str, object]]


class Follow(Protocol):
    """Opens a stream that is closed when the test ends."""

    def __call__(
        self, service: web.Service, query: Query, secret: str | None = None, **headers: str
    ) -> EventStream: ...


class Start(Protocol):
    """Starts a service that is stopped when the test ends."""

    def __call__(self, **settings: Any) -> web.Service: ...


def span(
    area: str = "holding_registers", address: object = 0, count: object = 4, **more: object
) -> Query:
    """The query of one range."""
    usual = {"memory": "plant_a", "area": area, "address": address, "count": count}
    return list({**usual, "min_interval": SOON, **more}.items())


@pytest.fixture
def memory() -> holdfast.Memory:
    return holdfast.Memory(coils=20, holding_registers=65536, seal=("coils", 0, "level"))


@pytest.fixture
def start(memory: holdfast.Memory) -> Iterator[Start]:
    with ExitStack() as running:

        def started(**settings: Any) -> web.Service:
            service = web.Service({"plant_a": memory}, **settings)
            running.enter_context(web.supervised(service.supervisor, service.listener))
            return service

        yield started


@pytest.fixture
def service(start: Start) -> web.Service:
    return start()


@pytest.fixture
def follow() -> Iterator[Follow]:
    with ExitStack() as opened:

        def followed(
            service: web.Service, query: Query, secret: str | None = None, **headers: str
        ) -> EventStream:
            given = {} if secret is None else {"Authorization": f"Bearer {secret}"}
            more = {name.replace("_", "-"): value for name, value in headers.items()}
            path = f"{PATH}?{urlencode(query)}"
            stream = event_streams.opened(service.address, path, given | more)
            opened.callback(stream.close)
            return stream

        yield followed


def change(address: int, values: list[int], area: str = "holding_registers") -> dict[str, Any]:
    return {"memory": "plant_a", "area": area, "address": address, "values": values}


def refused(stream: EventStream) -> tuple[int, str]:
    return stream.status, json.loads(stream.reply.read())["reason"]


# What is sent.


def test_the_first_event_is_the_current_state_and_later_ones_are_what_changed(
    service: web.Service, memory: holdfast.Memory, follow: Follow
) -> None:
    memory.write("holding_registers", 1, [7, 8])
    stream = follow(service, span())
    assert (stream.status, stream.kind) == (200, "text/event-stream")
    events = iter(stream)
    first = next(events)
    assert (first.name, first.data) == ("values", change(0, [0, 7, 8, 0]))
    memory.write("holding_registers", 1, [7, 9, 65535])
    second = next(events)
    assert second.data == change(2, [9, 65535])
    assert first.number is not None
    assert second.number == first.number + 1


def test_writes_elsewhere_and_of_the_same_values_are_no_events(
    service: web.Service, memory: holdfast.Memory, follow: Follow
) -> None:
    stream = follow(service, span())
    assert stream.next("values")["values"] == [0, 0, 0, 0]
    memory.write("holding_registers", 4, [5])
    memory.write("holding_registers", 0, [0])
    memory.write("holding_registers", 3, [6])
    assert stream.next("values") == change(3, [6])


def test_ranges_of_one_moment_have_one_number(
    service: web.Service, memory: holdfast.Memory, follow: Follow
) -> None:
    second = [("area", "coils"), ("address", 9), ("count", 10)]
    stream = follow(service, [*span(address=65535, count=1), *second])
    events = iter(stream)
    assert [next(events).data for _ in range(2)] == [
        change(65535, [0]),
        change(9, [0] * 10, "coils"),
    ]
    memory.write_many([("coils", 11, [1]), ("coils", 14, [1]), ("holding_registers", 65535, [3])])
    register, coils = next(events), next(events)
    assert register.data == change(65535, [3])
    assert coils.data == change(11, [1, 0, 0, 1], "coils")
    assert register.number == coils.number


def test_every_kind_of_writer_is_followed(
    service: web.Service, memory: holdfast.Memory, follow: Follow
) -> None:
    stream = follow(service, span())
    stream.next("values")
    memory.write("coils", 0, [1])
    with (
        holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as server,
        holdfast.SyncClient(f"tcp://127.0.0.1:{server.address[1]}") as plc,
    ):
        plc.write_register(0, 1)
        assert stream.next("values") == change(0, [1])
        plc.mask_write(1, and_mask=0, or_mask=2)
        assert stream.next("values") == change(1, [2])
    client = web.Client(service.address)
    client.ingest(web.command("holding_registers", 2, [3]))
    client.close()
    assert stream.next("values") == change(2, [3])


def test_a_reconnect_begins_with_the_current_state(
    service: web.Service, memory: holdfast.Memory, follow: Follow
) -> None:
    first = follow(service, span())
    event = next(iter(first))
    first.close()
    memory.write("holding_registers", 0, [5])
    again = follow(service, span(), Last_Event_ID=str(event.number))
    assert again.next("values") == change(0, [5, 0, 0, 0])


def test_while_nothing_changes_there_are_signs_of_life(
    monkeypatch: pytest.MonkeyPatch, service: web.Service, follow: Follow
) -> None:
    monkeypatch.setattr(changes, "HEARTBEAT_INTERVAL_S", 0.02)
    events = iter(follow(service, span(min_interval=3600)))
    assert [next(events).name for _ in range(4)] == ["values", ":", ":", ":"]


def test_head_has_the_header_only(service: web.Service) -> None:
    client = web.Client(service.address)
    path = f"{PATH}?{urlencode(span())}"
    for _ in range(2):
        answer = client.ask("HEAD", path)
        assert (answer.status, answer.body) == (200, b"")
        assert answer.headers["content-type"] == "text/event-stream"
    client.close()


# A slow reader.


def test_a_slow_reader_gets_the_newest_state_and_nothing_is_queued_for_it(
    service: web.Service, memory: holdfast.Memory
) -> None:
    query = urlencode(span(count=60000))
    with socket.socket() as slow:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.settimeout(wire.DEADLINE)
        slow.connect(service.address)
        slow.sendall(web.head("GET", f"{PATH}?{query}"))
        # Each write changes every register, so no event is small.
        written = threading.Event()

        def write() -> None:
            for number in range(1, 200):
                memory.write("holding_registers", 0, [10000 + number] * 60000)
            written.set()

        writing = threading.Thread(target=write)
        writing.start()
        assert written.wait(wire.DEADLINE), "a writer does not wait for a reader"
        writing.join()
        received = bytearray()
        while b"10199]" not in received:
            piece = slow.recv(1 << 20)
            assert piece, "the stream ended before the newest state"
            received += piece
    assert received.count(b"data: ") < 100


def test_a_reader_that_stops_reading_is_disconnected(start: Start, memory: holdfast.Memory) -> None:
    service = start(request_timeout=1)
    query = urlencode(span(count=60000))
    with socket.socket() as silent:
        silent.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        silent.connect(service.address)
        silent.sendall(web.head("GET", f"{PATH}?{query}"))
        number = 0

        def cut() -> bool:
            nonlocal number
            number += 1
            memory.write("holding_registers", 0, [number] * 60000)
            return service.connections()["slow_reader"] == 1

        wire.until(cut, "it is disconnected")
        wire.until(lambda: service.connections()["open"] == 0, "its place is free")


# Who may, and how many.


def test_a_token_follows_what_it_may_read(start: Start, follow: Follow) -> None:
    service = start(tokens=TOKENS)
    assert refused(follow(service, span())) == (401, "unauthorized")
    assert refused(follow(service, span(), "secret-wrong")) == (401, "unauthorized")
    assert refused(follow(service, span(), NARROW)) == (403, "not_granted")
    second = [("area", "holding_registers"), ("address", 0), ("count", 1)]
    both = [*span("coils"), *second]
    assert refused(follow(service, both, NARROW)) == (403, "not_granted")
    assert follow(service, both, READER).next("values") == change(0, [0] * 4, "coils")
    assert service.refusals() == {"unauthorized": 2, "not_granted": 2}


@pytest.mark.parametrize(
    ("query", "status", "reason", "says"),
    [
        (span()[1:], 400, "malformed", "memory is missing, required: memory, area, address, count"),
        (span(memory="plant_z"), 404, "unknown_memory", 'no memory "plant_z"'),
        (span("registers"), 400, "invalid_area", "allowed: coils"),
        (span("input_registers"), 400, "out_of_range", "but plant_a has no input_registers"),
        (span("coils", 18), 400, "out_of_range", "allowed: 1 to 2"),
        (span(count=0), 400, "malformed", 'count is "0", allowed: an integer from 1 to 65536'),
        (span(address="0x1"), 400, "malformed", "address is"),
        (span(min_interval=0.04), 400, "malformed", "allowed: a number from 0.05 to 3600"),
        (span(min_interval="1e1"), 400, "malformed", "min_interval is"),
        (span(min_interval="nan"), 400, "malformed", "min_interval is"),
        ([*span(), ("memory", "plant_a")], 400, "malformed", "memory is given more than once"),
        ([*span(), ("count", 1)], 400, "malformed", "1 area, 1 address and 2 count"),
        ([*span(), ("every", 1)], 400, "malformed", '"every" is not a parameter'),
        ([*span(), *[("count", 1)] * 16], 400, "malformed", "count is given more than 16 times"),
        ([*span(), *[("x", 1)] * 99], 400, "malformed", "more than 54 parameters"),
        (
            [*span(count=65536), ("area", "coils"), ("address", 0), ("count", 1)],
            400,
            "malformed",
            "the ranges have 65537 values, allowed: 65536",
        ),
    ],
)
def test_a_stream_that_can_not_be_is_refused(
    service: web.Service, query: Query, status: int, reason: str, says: str
) -> None:
    client = web.Client(service.address)
    answer = client.get(f"{PATH}?{urlencode(query)}")
    client.close()
    assert (answer.status, answer.json["reason"]) == (status, reason)
    assert says in answer.json["detail"]
    assert service.refusals() == {reason: 1}


def test_the_number_of_streams_is_limited_and_leaves_room_for_requests(
    start: Start, follow: Follow
) -> None:
    service = start(max_connections=4)
    streams = [follow(service, span()) for _ in range(2)]
    for stream in streams:
        stream.next("values")
    client = web.Client(service.address)
    answer = client.get(f"{PATH}?{urlencode(span())}")
    assert (answer.status, answer.json["reason"]) == (503, "busy")
    assert answer.json["detail"] == "too many change streams: 2 are open, which is the limit"
    assert answer.headers["retry-after"] == "1"
    assert client.read("coils", 0, 1).status == 200
    client.close()
    assert service.supervisor.status()["streams"] == 2
    streams[0].close()
    wire.until(lambda: service.supervisor.status()["streams"] == 1, "its place is free")
    follow(service, span()).next("values")


# When it ends.


def test_a_stop_ends_the_response_of_a_stream_and_does_not_cut_it_off(start: Start) -> None:
    service = start()
    with wire.Connection(service.address) as connection:
        connection.send(web.head("GET", f"{PATH}?{urlencode(span(min_interval=3600))}"))
        wire.until(lambda: service.supervisor.status()["streams"] == 1, "it is open")
        service.supervisor.stop()
        assert connection.rest().endswith(b"\r\n0\r\n\r\n")
    service.supervisor.join()


def configure(file: Path, *tokens: dict[str, object]) -> None:
    rest = {"bind": "127.0.0.1:0", "sources": web.LOOPBACK, "tokens": list(tokens)}
    settings = {"memories": {"plant_a": {"holding_registers": 10}}, "rest": rest}
    file.write_text(written(settings))


def test_revoked_rights_end_a_stream_and_another_reload_does_not(tmp_path: Path) -> None:
    kept, revoked = (web.token(name, f"secret-{name}") for name in ("kept", "revoked"))
    file = tmp_path / "plant.yaml"
    configure(file, kept, revoked)
    running = Appliance(load(file)).start()
    with ExitStack() as opened:
        opened.callback(running.stop)

        def stream(name: str) -> EventStream:
            path = f"{PATH}?{urlencode(span())}"
            headers = {"Authorization": f"Bearer secret-{name}"}
            made = event_streams.opened(endpoint(running, "rest"), path, headers)
            opened.callback(made.close)
            return made

        first = stream("revoked")
        assert first.next("values")["values"] == [0] * 4
        assert running.reload(load(file)) == []
        running.memories["plant_a"].write("holding_registers", 0, [1])
        assert first.next("values") == change(0, [1])
        configure(file, kept)
        running.reload(load(file))
        assert list(first) == []
        assert stream("revoked").status == 401
        assert stream("kept").next("values") == change(0, [1, 0, 0, 0])

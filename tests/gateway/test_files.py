"""Files and queues of devices through the gateway."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from support import gateways

if TYPE_CHECKING:
    from collections.abc import Iterator

    from support import web
    from support.gateways import Running


@pytest.fixture
def memory() -> holdfast.Memory:
    return holdfast.Memory(holding_registers=50, files={4: 100})


@pytest.fixture
def device(memory: holdfast.Memory) -> Iterator[dict[str, Any]]:
    rule = holdfast.Rule({1: memory}, sources=["127.0.0.1"], access="read-write", fifo={1: [10]})
    with holdfast.Server(bind="127.0.0.1:0", rules=[rule]) as server:
        host, port = server.address
        yield {"host": host, "port": port, "unitId": 1}


@pytest.fixture
def gateway() -> Iterator[Running]:
    with gateways.running() as running:
        yield running


def done(answer: web.Answer) -> dict[str, Any]:
    assert (answer.status, answer.json["success"]) == (200, True), answer.json
    given = ("host", "port", "unitId", "success", "rtt")
    return {name: value for name, value in answer.json.items() if name not in given}


def test_records_are_written_and_read(
    gateway: Running, device: dict[str, Any], memory: holdfast.Memory
) -> None:
    place = {"file": 4, "record": 98}
    written = gateway.ask("/write/file", {**device, **place, "values": [7, 8]})
    assert done(written) == {**place, "quantity": 2}
    assert memory.read("file:4", 97, 3) == [0, 7, 8]
    read = gateway.ask("/read/file", {**device, **place, "quantity": 2})
    assert done(read) == {**place, "values": [7, 8]}


def test_a_queue_is_read(gateway: Running, device: dict[str, Any], memory: holdfast.Memory) -> None:
    memory.write("holding_registers", 10, [2, 5, 6, 7])
    answer = gateway.ask("/read/fifo", {**device, "address": 10})
    assert done(answer) == {"address": 10, "values": [5, 6]}


def test_an_exception_is_an_answer(gateway: Running, device: dict[str, Any]) -> None:
    answer = gateway.ask("/read/file", {**device, "file": 5, "record": 0})
    assert (answer.status, answer.json["success"]) == (200, False)
    assert "Illegal Data Address" in answer.json["error"]


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/read/file", {"file": 0, "record": 0}),
        ("/read/file", {"file": 4, "record": 0, "quantity": 122}),
        ("/read/file", {"file": 4, "record": 9999, "quantity": 2}),
        ("/write/file", {"file": 4, "record": 0, "values": []}),
        ("/write/file", {"file": 4, "record": 9999, "values": [1, 2]}),
    ],
)
def test_what_no_device_can_have_is_not_asked(
    gateway: Running, device: dict[str, Any], path: str, body: dict[str, Any]
) -> None:
    assert gateway.ask(path, {**device, **body}).status == 400


def test_without_writes_no_record_is_written(device: dict[str, Any]) -> None:
    with gateways.running(writes=False) as gateway:
        body = {**device, "file": 4, "record": 0, "values": [1]}
        assert gateway.ask("/write/file", body).status == 403
        assert gateway.ask("/read/file", {**device, "file": 4, "record": 0}).status == 200

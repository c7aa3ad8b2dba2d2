"""Requirements of the application protocol that no test of a part shows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

import holdfast
from support.fake_device import Stream

if TYPE_CHECKING:
    from collections.abc import Iterator


def test_a_client_fills_the_last_byte_of_coils_with_zeros() -> None:
    with Stream("tcp") as device, holdfast.SyncClient(device.url) as client:
        for count in range(1, 17):
            client.write_coils(0, [True] * count)

    data = [asked.pdu[6:] for asked in device.requests]
    assert data == [
        ((1 << count) - 1).to_bytes((count + 7) // 8, "little") for count in range(1, 17)
    ]


# Files (6.14, 6.15)


@pytest.fixture
def plant() -> Iterator[holdfast.SyncClient]:
    memory = holdfast.Memory(holding_registers=1, files={1: 1, 4: 10_000, 65_535: 10_000})
    with (
        holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as server,
        holdfast.SyncClient("tcp://{}:{}".format(*server.address)) as client,
    ):
        yield client


def test_the_last_record_of_the_last_file_is_served(plant: holdfast.SyncClient) -> None:
    plant.write_file_record(65_535, 9_999, [0xFFFF])
    assert plant.read_file_record(65_535, 9_998, 2) == [0, 0xFFFF]


def test_the_most_records_of_one_request_are_served(plant: holdfast.SyncClient) -> None:
    values = list(range(122))
    plant.write_file_record(4, 0, values)
    assert plant.read_file_record(4, 0, 121) == values[:121]
    assert plant.read_file_records([(4, 0, 1)] * 35) == [[0]] * 35
    assert refusal(plant, 20, bytes([7, 6, 0, 4, 0, 0, 0, 122])) == 3
    assert refusal(plant, 20, bytes([14, *2 * (6, 0, 4, 0, 0, 0, 61)])) == 3


@pytest.mark.parametrize(
    ("function", "body"),
    [
        (20, [0]),
        (20, [6, 6, 0, 4, 0, 0, 0]),
        (20, [8, 6, 0, 4, 0, 0, 0, 1]),
        (20, [8, 6, 0, 4, 0, 0, 0, 1, 0]),
        (20, [251, *35 * (6, 0, 1, 0, 0, 0, 1), *6 * [0]]),
        (21, [0]),
        (21, [7, 6, 0, 4, 0, 0, 0, 0]),
        (21, [9, 6, 0, 4, 0, 0, 0, 1, 0]),
        (21, [10, 6, 0, 4, 0, 0, 0, 1, 0, 0, 0]),
    ],
)
def test_a_byte_count_of_files_has_limits(
    plant: holdfast.SyncClient, function: int, body: list[int]
) -> None:
    assert refusal(plant, function, bytes(body)) == 3


def refusal(client: holdfast.SyncClient, function: int, body: bytes) -> int:
    with pytest.raises(holdfast.ModbusException) as raised:
        client.call_function(function, body)
    return raised.value.code

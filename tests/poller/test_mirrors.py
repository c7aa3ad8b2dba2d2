"""Writes into ranges that mirror a device: refused on every way in, unless they are local."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast import raw_ingest
from support import web, wire
from support.polled import Fake, configuration, data, device, read, until_polled
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.appliance import Appliance
    from support.running import Run

SOURCES = ["127.0.0.1"]
MORE: dict[str, Any] = {
    "listeners": {
        "scada": {
            "type": "modbus-tcp",
            "bind": "127.0.0.1:0",
            "rules": [{"sources": SOURCES, "units": {1: "mirror"}, "access": "read-write"}],
        },
        "raw": {
            "type": "raw-ingest",
            "bind": "127.0.0.1:0",
            "rules": [{"sources": SOURCES, "units": {1: "mirror"}, "areas": ["coils"]}],
        },
    },
    "rest": {"bind": "127.0.0.1:0", "sources": SOURCES, "tokens": "none"},
}

READS = [
    read("holding_registers", 0, 3, ("holding_registers", 10)),
    read("coils", 0, 8, ("coils", 100)),
]
"""The mirror has holding registers 10 to 12 and coils 100 to 107."""


@pytest.fixture
def source() -> Iterator[Fake]:
    """A device whose registers are all 7."""
    with Fake(lambda request: data(request, 7)) as fake:
        yield fake


@contextlib.contextmanager
def refused_with(code: int) -> Iterator[None]:
    with pytest.raises(holdfast.ModbusException) as raised:
        yield
    assert raised.value.code == code


def client(appliance: Appliance) -> holdfast.SyncClient:
    host, port = endpoint(appliance, "scada")
    return holdfast.SyncClient(f"tcp://{host}:{port}", timeout=wire.DEADLINE)


WRITES: dict[str, Callable[[holdfast.SyncClient], object]] = {
    "one register": lambda plc: plc.write_register(12, 1),
    "registers that begin before it": lambda plc: plc.write_registers(9, [1, 1]),
    "registers around it": lambda plc: plc.write_registers(0, [1] * 50),
    "one coil": lambda plc: plc.write_coil(100, True),
    "coils that begin in it": lambda plc: plc.write_coils(107, [True, True]),
    "a mask": lambda plc: plc.mask_write(11, and_mask=0, or_mask=1),
    "write and read": lambda plc: plc.read_write(0, 1, 10, [1]),
}


@pytest.mark.parametrize("write", WRITES.values(), ids=WRITES)
def test_a_modbus_write_into_a_mirror_is_refused_and_changes_nothing(
    write: Callable[[holdfast.SyncClient], object], run: Run, source: Fake
) -> None:
    appliance = run(configuration({"meter": device(source.url, *READS)}, **MORE))
    until_polled(appliance, "meter")
    with client(appliance) as plc:
        with refused_with(2):
            write(plc)
        assert plc.read_holding_registers(0, 50) == [0] * 10 + [7] * 3 + [0] * 37


def test_what_is_beside_a_mirror_is_written(run: Run, source: Fake) -> None:
    appliance = run(configuration({"meter": device(source.url, *READS)}, **MORE))
    until_polled(appliance, "meter")
    with client(appliance) as plc:
        plc.write_registers(8, [1, 2])
        plc.write_register(13, 3)
        plc.write_coil(99, True)
        plc.write_coil(108, True)
        assert plc.read_holding_registers(8, 6) == [1, 2, 7, 7, 7, 3]


def test_rest_and_raw_ingest_say_so_in_their_own_words(run: Run, source: Fake) -> None:
    appliance = run(configuration({"meter": device(source.url, *READS)}, **MORE))
    until_polled(appliance, "meter")
    rest = web.Client(endpoint(appliance, "rest"))
    batch = [
        web.command("holding_registers", 0, [1], "mirror"),
        web.command("holding_registers", 12, [1, 1], "mirror"),
    ]
    with contextlib.closing(rest):
        answer = rest.ingest(batch)
    assert (answer.status, answer.json["reason"], answer.json["command"]) == (409, "mirrored", 1)
    assert "overlap a range that mirrors a device" in answer.json["detail"]

    with pytest.raises(raw_ingest.RawRefused):
        raw_ingest.send_sync(*endpoint(appliance, "raw"), "coils", 100, [1], unit=1)
    mirror = appliance.memories["mirror"]
    assert mirror.read("holding_registers", 0, 20) == [0] * 10 + [7] * 3 + [0] * 7


def test_a_local_write_holds_until_the_next_poll(run: Run, source: Fake) -> None:
    meter = device(source.url, *READS, writes="local")
    appliance = run(configuration({"meter": meter}, **MORE))
    until_polled(appliance, "meter")
    with client(appliance) as plc:
        plc.write_register(10, 1)
    mirror = appliance.memories["mirror"]
    wire.until(lambda: mirror.read("holding_registers", 10, 1) == [7], "the poll undoes it")


def test_a_device_that_is_not_polled_reserves_nothing(run: Run, source: Fake) -> None:
    meter = device(source.url, *READS, enabled=False)
    appliance = run(configuration({"meter": meter}, **MORE))
    with client(appliance) as plc:
        plc.write_register(10, 1)
        assert plc.read_holding_registers(10, 1) == [1]

"""`Reader`: the values of tags, from the blocks of polls."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from holdfast.polling.readings import Reader
from holdfast.tags import Tag, TagList
from holdfast.tags.scale import RegisterScale

if TYPE_CHECKING:
    from holdfast.types import PolledBlock

HR: Final = "holding_registers"
TAGS = TagList(
    [
        Tag("power", HR, 0, "int16", scale=RegisterScale("exponent", "sf")),
        Tag("sf", HR, 3, "int16"),
    ]
)


def block(address: int, *registers: int) -> PolledBlock:
    data = b"".join(each.to_bytes(2) for each in registers)
    return HR, address, len(registers), data, 0, 1.0


def read(*blocks: PolledBlock) -> dict[str, tuple[Any, int, str | None]]:
    readings = Reader("meter", TAGS).poll(blocks).readings
    return {each.name: (each.value, each.fault, each.undecoded) for each in readings}


def test_one_field_has_a_value_and_its_scale() -> None:
    assert list(Reader("meter", TAGS).fields) == [(HR, 0, 4), (HR, 3, 1)]
    assert read(block(0, 432, 0, 0, 1)) == {"power": (4320, 0, None), "sf": (1, 0, None)}


def test_a_value_without_a_valid_scale_is_undecoded() -> None:
    value, fault, why = read(block(0, 432, 0, 0, 0x8000))["power"]
    assert (value, fault) == (None, 0)
    assert why == f"the scale in {HR} 3 is 10^-32768, allowed: exponents from -10 to 10"


def test_a_scale_of_another_request_is_never_taken() -> None:
    none = (None, 0, "no request has read it together with its scale")
    assert read(block(0, 432), block(3, 1)) == {"power": none, "sf": (1, 0, None)}
    assert read(block(0, 432, 0), block(2, 0, 1)) == {"power": none, "sf": (1, 0, None)}
    failed: PolledBlock = (HR, 0, 4, None, 2, 1.0)
    assert read(failed, block(3, 1)) == {"power": (None, 2, None), "sf": (1, 0, None)}


def test_an_element_of_an_array_is_never_from_two_requests() -> None:
    reader = Reader("meter", [Tag("counters", HR, 0, "uint32[3]")], 5)
    assert list(reader.fields) == [(HR, 0, 4), (HR, 4, 2)]
    halves = block(0, 0, 1, 0, 2, 7, 8), block(4, 7, 8), block(0, 0, 1, 0, 2)
    assert [each.value for each in reader.poll(halves[:1]).readings] == [[1, 2, 0x70008]]
    assert [each.value for each in reader.poll(halves[1:]).readings] == [[1, 2, 0x70008]]
    [reading] = reader.poll([block(0, 0, 1, 0, 2, 0), block(5, 8)]).readings
    assert (reading.value, reading.error) == (None, "no request has read it whole")

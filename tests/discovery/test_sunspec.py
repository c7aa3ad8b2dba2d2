"""SunSpec models are found and decoded by their definitions."""

from __future__ import annotations

import json
from importlib import resources
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast import values
from holdfast.discovery import sunspec
from holdfast.errors import (
    ConnectFailed,
    ConnectionLost,
    InvalidResponse,
    ModbusError,
    ModbusException,
    RequestTimeout,
)
from support import sunspec_device

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.discovery.sunspec import Point


def reader(registers: list[int], base: int = 40000) -> Callable[[int, int], list[int]]:
    """Reads these registers at an address; others do not exist."""

    def read(address: int, count: int) -> list[int]:
        first = address - base
        if first < 0 or first + count > len(registers):
            raise ModbusException(2)
        return registers[first : first + count]

    return read


def points(*models: list[int]) -> dict[str, Point]:
    found = sunspec.find(reader(sunspec_device.registers(*models)))
    assert found is not None
    return {point.name: point for model in found.models for point in model.points}


@pytest.mark.parametrize("base", [0, 40000, 50000])
def test_models_are_found_at_every_base(base: int) -> None:
    registers = sunspec_device.registers(sunspec_device.common(), sunspec_device.inverter())
    found = sunspec.find(reader(registers, base))
    assert found is not None
    assert (found.base, found.is_complete) == (base, True)
    assert [(model.id, model.length) for model in found.models] == [(1, 66), (103, 50)]
    assert found.extent == range(base, base + len(registers))


def test_values_have_their_units_scales_and_states() -> None:
    found = points(sunspec_device.common(), sunspec_device.inverter())
    assert (found["Mn"].value, found["Mn"].type, found["Opt"].value) == ("Acme", "string:32", None)
    current = found["A"]
    assert (current.address, current.value, current.scale, current.unit) == (40072, 215, 0.1, "A")
    assert (current.scaled_by, current.scaled_at) == ("A_SF", 40076)
    assert (found["W"].type, found["W"].value, found["W"].scale) == ("int16", -4950, 1)
    assert (found["Hz"].value, found["Hz"].scale) == (4998, 0.01)
    assert (found["WH"].type, found["WH"].value, found["WH"].scale) == ("uint32", 1234567, 10)
    assert found["St"].states[4] == "MPPT"
    assert found["PPVphAB"].value is None
    assert not {"ID", "L", "A_SF", "Pad"} & set(found)


def test_repeated_groups_have_numbers() -> None:
    found = points(sunspec_device.mppt())
    assert [found[f"module_{each}_IDStr"].value for each in (1, 2)] == ["East", "West"]
    assert (found["module_2_DCA"].value, found["module_2_DCA"].scale) == (52, 0.1)
    assert found["module_2_DCA"].scaled_at == found["module_1_DCA"].scaled_at == 40004
    assert found["module_2_DCA"].address - found["module_1_DCA"].address == 20


def test_groups_in_groups_are_as_many_as_points_say() -> None:
    found = points(sunspec_device.curves())
    assert [name for name in found if name.endswith("_V")] == [
        f"Crv_{curve}_Pt_{point}_V" for curve in (1, 2) for point in (1, 2)
    ]
    last = found["Crv_2_Pt_2_Var"]
    assert (last.value, last.scale, last.can_be_written) == (-3000, 0.01, True)


def test_a_name_does_not_depend_on_how_many_a_device_has() -> None:
    fixed = [1, 0, 0, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0]
    found = points([705, 25, *fixed, *[1, 1, 1, 1000, 1000, 0, 5, 0, 10, 1, 920, 3000]])
    assert [name for name in found if name.endswith("_V")] == ["Crv_1_Pt_1_V"]
    assert set(found) < set(points(sunspec_device.curves()))


def test_a_model_that_is_not_known_has_no_points() -> None:
    registers = sunspec_device.registers([64999, 3, 1, 2, 3], sunspec_device.inverter())
    found = sunspec.find(reader(registers))
    assert found is not None
    assert [(each.id, each.name) for each in found.models] == [
        (64999, None),
        (103, "inverter_three_phase"),
    ]
    assert found.models[0].points == ()


def test_models_that_do_not_end_are_incomplete() -> None:
    registers = [*sunspec_device.text("SunS", 4), *sunspec_device.common()]
    found = sunspec.find(reader(registers))
    assert found is not None
    assert (found.is_complete, len(found.models)) == (False, 1)
    assert found.extent == range(40000, 40000 + len(registers))


@pytest.mark.parametrize("model", [[0, 0], [1, 0], [64999, 0]])
def test_a_model_without_registers_ends_the_search(model: list[int]) -> None:
    asked = []
    registers = [*sunspec_device.text("SunS", 4), *sunspec_device.inverter(), *model * 20_000]

    def read(address: int, count: int) -> list[int]:
        asked.append((address, count))
        return reader(registers, 0)(address, count)

    found = sunspec.find(read)
    assert found is not None
    assert [each.id for each in found.models] == [103]
    assert not found.is_complete
    assert asked[1:] == [(0, 2), (2, 2), (4, 50), (54, 2)]


def test_unknown_models_are_passed_over_without_being_read() -> None:
    asked = []
    registers = sunspec_device.registers([64999, 2000, *[1] * 2000], sunspec_device.inverter())

    def read(address: int, count: int) -> list[int]:
        asked.append(count)
        return reader(registers)(address, count)

    found = sunspec.find(read)
    assert found is not None
    assert [each.length for each in found.models] == [2000, 50]
    assert asked == [2, 2, 2, 50, 2]


def test_a_device_without_models_is_none_and_a_silent_one_an_error() -> None:
    assert sunspec.find(reader([0] * 10)) is None

    asked = []

    def silent(address: int, count: int) -> list[int]:
        asked.append(address)
        raise RequestTimeout(f"no reply to {count} from {address}")

    with pytest.raises(RequestTimeout):
        sunspec.find(silent)
    assert asked == [40000, 0, 50000]


UNANSWERED = [
    RequestTimeout("no reply"),
    InvalidResponse("other bytes"),
    ConnectionLost("closed"),
]


@pytest.mark.parametrize("error", UNANSWERED, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("base", [0, 50000])
def test_absent_addresses_may_have_no_answer(base: int, error: ModbusError) -> None:
    registers = [*sunspec_device.text("SunS", 4), *sunspec_device.inverter()]

    def read(address: int, count: int) -> list[int]:
        try:
            return reader(registers, base)(address, count)
        except ModbusException:
            raise error from None

    found = sunspec.find(read)
    assert found is not None
    assert ([each.id for each in found.models], found.is_complete) == ([103], False)
    registers[0] = 0
    if base == 0:
        assert sunspec.find(read) is None


@pytest.mark.parametrize("answered", [0, 2])
def test_without_a_connection_the_search_ends(answered: int) -> None:
    asked = []

    def read(address: int, count: int) -> list[int]:
        asked.append(address)
        if len(asked) > answered:
            raise ConnectFailed("tcp://10.0.0.1", "refused")
        return reader([*sunspec_device.text("SunS", 4), *sunspec_device.inverter()])(address, count)

    with pytest.raises(ConnectFailed):
        sunspec.find(read)
    assert len(asked) == answered + 1


@given(
    st.sampled_from([int(each) for each in sunspec.definitions()]),
    st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=120),
)
def test_any_content_of_a_model_is_decoded_within_its_length(
    number: int, content: list[int]
) -> None:
    registers = sunspec_device.registers([number, len(content), *content])
    found = sunspec.find(reader(registers))
    assert found is not None
    [model] = found.models
    taken: set[int] = set()
    for point in model.points:
        own = range(point.address, point.address + values.register_count(point.type))
        assert own.start >= model.address + 2
        assert own.stop <= model.stop
        assert not taken.intersection(own)
        taken.update(own)


def test_every_definition_has_known_types_and_the_source_is_named() -> None:
    for definition in sunspec.definitions().values():
        for group in _groups(definition):
            for row in group["points"]:
                kind = row[1]
                assert kind in sunspec.TYPES or kind in sunspec.HIDDEN or kind[:7] == "string:"
    text = resources.files("holdfast.discovery").joinpath("sunspec_models.json").read_text()
    assert "Apache License 2.0" in json.loads(text)["about"]


def _groups(definition: dict[str, Any]) -> list[dict[str, Any]]:
    inner = [each for group in definition.get("groups", []) for each in _groups(group)]
    return [definition, *inner]

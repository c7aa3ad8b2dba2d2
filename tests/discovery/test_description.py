"""A device is described as tags that do not overlap."""

from __future__ import annotations

import dataclasses
import itertools
import random
import struct
import time
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import holdfast
from holdfast import values
from holdfast.client.tag_reading import TagReader
from holdfast.config.tag_files.read import load_tags
from holdfast.config.tag_files.write import tags_as_yaml
from holdfast.discovery import description, segments, sunspec
from holdfast.discovery.address_search import LimitReached, Survey
from holdfast.discovery.description import Description
from holdfast.tags.scale import RegisterScale
from support import cli, plant_data, sunspec_device
from support.cases import examples
from support.fake_device import FakeDevice, exception, registers

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from holdfast.discovery.described_tag import DescribedTag
    from support.running import Serve


def described(server: holdfast.Server, **options: Any) -> Description:
    """Describes unit 1 of a server, with one read."""
    found = Description(1, Survey(**options))
    with holdfast.SyncClient(cli.url(server)) as client:
        description.describe(found, client, reads=1, every=1, delay=0)
    description.conclude(found)
    return found


def test_every_read_has_the_unit_of_the_description(serve: Serve) -> None:
    other = holdfast.Memory(holding_registers=10)
    memory = holdfast.Memory(holding_registers=20, coils=3)
    memory.write("holding_registers", 0, [555] * 20)
    found = Description(5, Survey(span=range(100)))
    with holdfast.SyncClient(cli.url(serve({1: other, 5: memory}))) as client:
        description.describe(found, client, reads=1, every=1, delay=0)
    contents = {
        (area, address): value
        for (area, block), [read] in found.reads.items()
        for address, value in zip(block, read, strict=True)
    }
    assert contents == {
        **{("holding_registers", address): 555 for address in range(20)},
        **{("coils", address): 0 for address in range(3)},
    }


def types(found: Description) -> dict[str, tuple[str, str]]:
    return {each.tag.name: (each.tag.type, each.tag.order) for each in found.tags}


def test_values_of_a_device_are_recognised(serve: Serve) -> None:
    memory = holdfast.Memory(coils=(5, 3), holding_registers=60, input_registers=(30001, 3))
    volts = [each for v in (230.1, 231.4, 229.8) for each in values.encode(v, "float32", "CDAB")]
    memory.write("holding_registers", 0, [*volts, *values.encode(1234567, "uint32", "CDAB")])
    memory.write("holding_registers", 40, [455, 65481, *values.encode("PUMP-01", "string:8")])
    memory.write("input_registers", 30001, [215, 1013, 48])
    found = described(serve({1: memory}))
    assert types(found) == {
        "co_5": ("bool", "ABCD"),
        "co_6": ("bool", "ABCD"),
        "co_7": ("bool", "ABCD"),
        "hr_0": ("float32", "CDAB"),
        "hr_2": ("float32", "CDAB"),
        "hr_4": ("float32", "CDAB"),
        "hr_6": ("uint32", "CDAB"),
        "hr_8": ("uint16[32]", "ABCD"),
        "hr_40": ("uint16", "ABCD"),
        "hr_41": ("int16", "ABCD"),
        "hr_42": ("string:8", "ABCD"),
        "hr_46": ("uint16[14]", "ABCD"),
        "ir_30001": ("uint16", "ABCD"),
        "ir_30002": ("uint16", "ABCD"),
        "ir_30003": ("uint16", "ABCD"),
    }
    sure = {each.tag.name: each.confidence for each in found.tags}
    assert sure["hr_0"] > 0.9
    assert sure["hr_8"] == 0.3
    assert found.orders["CDAB"] > 0.9


def test_sunspec_is_decoded_and_not_guessed(serve: Serve) -> None:
    registers = sunspec_device.registers(sunspec_device.common(), sunspec_device.inverter())
    memory = holdfast.Memory(holding_registers=(40000, 200))
    memory.write("holding_registers", 40000, registers)
    memory.write("holding_registers", 40000 + len(registers), [455])
    found = described(serve({1: memory}), areas=["holding_registers"])
    tags = {each.tag.name: each.tag for each in found.tags}
    current = tags["inverter_three_phase_A"]
    assert (current.address, current.unit) == (40072, "A")
    assert current.null == {0xFFFF}
    assert isinstance(current.scale, RegisterScale)
    assert current.span == range(40072, 40077)
    assert current.with_scale(-1).value(215) == 21.5
    assert not current.writable
    assert tags["inverter_three_phase_St"].state(4) == "MPPT"
    assert "inverter_three_phase_PPVphAB" not in tags
    behind = 40000 + len(registers)
    assert tags[f"hr_{behind}"].type == "uint16"
    assert not any(name.startswith("hr_400") for name in tags)


def test_a_sunspec_value_follows_its_scale_factor(serve: Serve, tmp_path: Path) -> None:
    registers = sunspec_device.registers(sunspec_device.inverter())
    power, factor = 40004 + 12, 40004 + 13
    memory = holdfast.Memory(holding_registers=(40000, len(registers)))
    memory.write("holding_registers", 40000, registers)
    memory.write("holding_registers", power, [4320, 0])
    server = serve({1: memory})
    found = described(server, areas=["holding_registers"])
    file = tmp_path / "inverter.yaml"
    file.write_text(tags_as_yaml(each.tag for each in found.tags), encoding="utf-8")
    reader = TagReader([load_tags(file)["inverter_three_phase_W"]])
    with holdfast.SyncClient(cli.url(server)) as client:
        for number, exponent, expected in ((4320, 0, 4320), (432, 1, 4320), (15, 0xFFFF, 1.5)):
            memory.write("holding_registers", power, [number, exponent])
            [reading] = reader.read(client)
            assert (reading.value, reading.error) == (expected, None)
        memory.write("holding_registers", factor, [0x8000])
        [reading] = reader.read(client)
        assert reading.value is None
        assert "10^-32768, allowed: exponents from -10 to 10" in str(reading.error)


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_a_sunspec_text_is_read_as_it_is_described(
    serve: Serve, tmp_path: Path, encoding: str
) -> None:
    registers = sunspec_device.registers(sunspec_device.common())
    registers[4:20] = values.encode("Müller", "string:32", encoding=encoding)
    registers[44:52] = [0x8000] * 8
    memory = holdfast.Memory(holding_registers=(40000, len(registers)))
    memory.write("holding_registers", 40000, registers)
    server = serve({1: memory})
    found = {each.tag.name: each for each in described(server, areas=["holding_registers"]).tags}
    assert "common_Vr" not in found
    file = tmp_path / "device.yaml"
    file.write_text(tags_as_yaml(each.tag for each in found.values()), encoding="utf-8")
    reader = TagReader([load_tags(file)["common_Mn"]])
    with holdfast.SyncClient(cli.url(server)) as client:
        [reading] = reader.read(client)
    assert (found["common_Mn"].values, reading.value) == (("Müller",), "Müller")


def test_a_scale_factor_that_is_too_far_leaves_the_raw_number() -> None:
    far = sunspec.Point(
        name="far",
        address=200,
        type="int16",
        scale=0.1,
        scaled_by="X_SF",
        scaled_at=40,
        unit="W",
        label="",
        can_be_written=False,
        states={},
        missing=None,
        value=7,
    )
    near = dataclasses.replace(far, name="near", address=164)
    model = sunspec.Model(160, "mppt", "", 2, 300, (near, far))
    spec = sunspec.SunSpec(0, (model,))
    found = Description(1, Survey(["holding_registers"]), sunspec=spec)
    description.conclude(found)
    factor, first, second = (each.tag for each in found.tags)
    assert (factor.name, factor.address, factor.scale) == ("mppt_X_SF", 40, 1)
    assert (first.name, first.unit, first.span) == ("mppt_near", "W", range(40, 165))
    assert (second.name, second.unit, second.scale) == ("mppt_far_raw", "", 1)
    assert "no scale from X_SF, which is at 40" in second.description


def overlaps(tags: list[DescribedTag]) -> bool:
    ends: dict[str, int] = {}
    for each in tags:
        if each.tag.address < ends.get(each.tag.area, 0):
            return True
        ends[each.tag.area] = each.tag.end
    return False


@given(st.integers(0, 10_000), st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=60))
@settings(max_examples=examples(30))
def test_tags_cover_every_address_once(seed: int, noise: list[int]) -> None:
    chosen = random.Random(seed)
    registers = [*plant_data.sample(chosen).reads[0], *noise, *[0] * chosen.randint(0, 90)]
    found = Description(1, Survey(["holding_registers", "coils"]))
    found.reads["holding_registers", range(7, 7 + len(registers))] = [registers]
    found.reads["coils", range(300)] = [[1, 0, 1] * 100]
    description.conclude(found)
    assert not overlaps(found.tags)
    sizes = {"holding_registers": len(registers), "coils": 300}
    for area, size in sizes.items():
        assert sum(each.tag.count for each in found.tags if each.tag.area == area) == size
    assert len({each.tag.name for each in found.tags}) == len(found.tags)
    assert all(0 <= each.confidence <= 1 for each in found.tags)


def test_what_was_seen_is_described_if_the_search_ends_early(serve: Serve) -> None:
    memory = holdfast.Memory(holding_registers=10)
    memory.write("holding_registers", 0, [455, 2150, 1])
    found = Description(1, Survey(["holding_registers"], max_requests=30))
    with holdfast.SyncClient(cli.url(serve({1: memory}))) as client, pytest.raises(LimitReached):
        description.describe(found, client, reads=3, every=1, delay=0)
    description.conclude(found)
    assert found.tags[0].values == (455,)
    assert found.survey.areas[0].state == "partly"


def test_a_device_that_does_not_answer_absent_addresses_is_described() -> None:
    def answers(pdu: bytes) -> bytes | None:
        if pdu[0] != 3:
            return exception(pdu, 1)
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        return registers(pdu, 455) if first + count <= 9 else None

    found = Description(1, Survey(["holding_registers"], span=range(12)))
    with FakeDevice(answers) as device, holdfast.SyncClient(device.url, timeout=0.05) as client:
        description.describe(found, client, reads=1, every=1, delay=0)
    assert found.survey.areas[0].ranges == [range(9)]


def test_a_device_that_refuses_reads_across_borders_is_described_whole(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each read is within 20 registers, wherever those that worked before have begun."""
    refused = []

    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] != 3 or first // 20 != (first + count - 1) // 20 or first + count > 60:
            refused.append(pdu)
            return exception(pdu, 2)
        return registers(pdu)

    found = Description(1, Survey(["holding_registers"], span=range(3, 70)))
    turns = []
    with FakeDevice(answers) as device, holdfast.SyncClient(device.url) as client:
        monkeypatch.setattr(time, "sleep", lambda _: turns.append(len(refused)))
        description.describe(found, client, reads=3, every=1, delay=0)
    assert turns == [len(refused)] * 2, "what was refused is not asked again"
    description.conclude(found)
    assert not found.unread
    assert list(description.undescribed(found)) == []
    assert sum(each.tag.count for each in found.tags) == 57
    assert all(each.tag.address // 20 == (each.tag.end - 1) // 20 for each in found.tags)
    assert all(len(each.values) == 3 for each in found.tags)


def test_what_can_not_be_read_again_costs_nothing_else() -> None:
    asked: list[bytes] = []

    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        asked.append(pdu)
        is_again = len(asked) > searched > 0
        if pdu[0] != 3 or first + count > 40 or (is_again and first <= 17 < first + count):
            return exception(pdu, 2)
        return registers(pdu, 7)

    searched = 0
    found = Description(1, Survey(["holding_registers"], span=range(50)))

    def note(survey: Survey) -> None:
        nonlocal searched
        if survey.is_done:
            searched = len(asked)

    with FakeDevice(answers) as device, holdfast.SyncClient(device.url) as client:
        description.describe(found, client, reads=2, every=0, delay=0, progress=note)
    description.conclude(found)
    assert found.unread == {
        ("holding_registers", "exception 02 (Illegal Data Address)"): [range(17, 18)]
    }
    assert list(description.undescribed(found)) == [("holding_registers", range(17, 18))]
    assert sum(each.tag.count for each in found.tags) == 39


def test_texts_and_arrays_are_what_the_device_takes_at_once() -> None:
    text = "Pump station 7, river bank west, dr"
    content = [
        *values.encode(text, "string:38"),
        *values.encode(230.1, "float32"),
        *[0xFFFF] * 6,
        *values.encode(231.2, "float32"),
    ]

    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] != 3 or first + count > len(content):
            return exception(pdu, 2)
        if count > 5:
            return exception(pdu, 3)
        return bytes([3, 2 * count]) + struct.pack(f">{count}H", *content[first : first + count])

    found = Description(1, Survey(["holding_registers"], span=range(40)))
    with FakeDevice(answers) as device, holdfast.SyncClient(device.url) as client:
        description.describe(found, client, reads=2, every=0, delay=0)
        description.conclude(found)
        assert list(description.undescribed(found)) == []
        assert not overlaps(found.tags)
        for reading in TagReader([each.tag for each in found.tags]).read(client):
            assert reading.error is None
    texts = [each for each in found.tags if each.tag.type.startswith("string")]
    assert len(texts) > 4
    assert all(each.tag.count <= 5 for each in found.tags)
    assert "".join(str(each.values[-1]) for each in texts).split() == text.split()


@pytest.mark.parametrize(
    ("failure", "failing", "unread", "values"),
    [
        (6, [0, 2, 4], [], (7, 7, 7)),
        (6, [2, 3], [range(9)], (7, 7)),
        (6, [0, 1], [range(9)], (7, 7)),
        (6, range(6), [range(9)], None),
        (None, [0, 2, 4], [], (7, 7, 7)),
        (None, [2, 3], [range(9)], (7, 7)),
        (None, range(6), [range(9)], None),
        (4, [0], [range(9)], (7, 7)),
        (1, [0], [range(9)], None),
    ],
)
def test_what_fails_once_is_read_again_and_what_was_read_is_kept(
    failure: int | None,
    failing: Sequence[int],
    unread: list[range],
    values: tuple[int, ...] | None,
) -> None:
    """A reading is one request, and one more if the device is busy or the reply is invalid."""
    again = itertools.count()
    is_searched = False

    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] != 3 or first + count > 9:
            return exception(pdu, 2)
        if not is_searched or next(again) not in failing:
            return registers(pdu, 7)
        return bytes([3, 0]) if failure is None else exception(pdu, failure)

    def note(survey: Survey) -> None:
        nonlocal is_searched
        is_searched = survey.is_done

    found = Description(1, Survey(["holding_registers"], span=range(12)))
    found.survey.areas[0].largest = 9
    with FakeDevice(answers) as device, holdfast.SyncClient(device.url) as client:
        description.describe(found, client, reads=3, every=0, delay=0, progress=note)
    description.conclude(found)
    assert [each for ranges in found.unread.values() for each in ranges] == unread
    assert {each.values for each in found.tags} == ({values} if values else set())


def test_unused_registers_of_a_device_of_whole_values_are_whole_values() -> None:
    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] != 3 or first % 2 or count % 2 or first + count > 300 or count > 80:
            return exception(pdu, 2)
        values = [5 if address in (0, 150, 299) else 0 for address in range(first, first + count)]
        return bytes([3, 2 * count]) + struct.pack(f">{count}H", *values)

    found = Description(1, Survey(["holding_registers"], span=range(400)))
    with FakeDevice(answers) as device, holdfast.SyncClient(device.url) as client:
        description.describe(found, client, reads=1, every=0, delay=0)
    description.conclude(found)
    unused = [each.tag for each in found.tags if each.tag.count > 4]
    assert sum(each.count for each in unused) > 280
    assert all(not each.address % 2 and not each.count % 2 for each in unused)
    assert max(each.count for each in unused) <= 80


@pytest.mark.parametrize(
    ("unreadable", "models", "flaw"),
    [
        (-1, [1, 103], None),
        (80, [1], "exception 03 (Illegal Data Value), of the model at 70"),
    ],
)
def test_sunspec_models_are_read_in_parts_if_they_must(
    unreadable: int, models: list[int], flaw: str | None
) -> None:
    content = sunspec_device.registers(sunspec_device.common(), sunspec_device.inverter())

    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] != 3 or first + count > len(content):
            return exception(pdu, 2)
        if count > 30 or first <= unreadable < first + count:
            return exception(pdu, 3)
        return bytes([3, 2 * count]) + struct.pack(f">{count}H", *content[first : first + count])

    found = Description(1, Survey(["holding_registers"], span=range(200)))
    with FakeDevice(answers) as device, holdfast.SyncClient(device.url) as client:
        description.describe(found, client, reads=0, every=0, delay=0)
    assert found.sunspec is not None
    assert [each.id for each in found.sunspec.models] == models
    assert found.sunspec.flaw == flaw


def test_sunspec_tags_are_what_the_device_takes_at_once() -> None:
    models = [sunspec_device.common(), sunspec_device.inverter(), sunspec_device.mppt()]
    models[0][2:18] = sunspec_device.text("Acme Works of the North", 32)
    models[0][18:34] = struct.unpack(">16H", "Onduleur 30 modèle 5".encode().ljust(32, b"\0"))
    content = sunspec_device.registers(*models)

    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] != 3 or first + count > len(content):
            return exception(pdu, 2)
        if count > 10:
            return exception(pdu, 3)
        return bytes([3, 2 * count]) + struct.pack(f">{count}H", *content[first : first + count])

    found = Description(1, Survey(["holding_registers"], span=range(200)))
    with FakeDevice(answers) as device, holdfast.SyncClient(device.url) as client:
        description.describe(found, client, reads=0, every=0, delay=0)
        description.conclude(found)
        readings = list(TagReader([each.tag for each in found.tags]).read(client))
    assert [each.error for each in readings] == [None] * len(found.tags)
    values = {each.tag.name: each.values for each in found.tags}
    assert values["common_Mn_1"] + values["common_Mn_2"] == ("Acme Works of th", "e North")
    assert "mppt_module_2_DCA_raw" in values
    assert not any(name.startswith("common_Md") for name in values)


def test_an_interruption_costs_only_the_registers_at_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    found = Description(1, Survey(["holding_registers"]))
    found.reads["holding_registers", range(90)] = [[*range(1000, 1090)]]
    found.survey.areas[0].ranges.append(range(90))
    divide, calls = segments.divide, iter(range(2))

    def interrupted(*args: Any, **options: Any) -> segments.Division:
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return divide(*args, **options)

    monkeypatch.setattr(description, "MAX_REGISTERS_AT_ONCE", 40)
    monkeypatch.setattr(segments, "divide", interrupted)
    with pytest.raises(KeyboardInterrupt):
        description.conclude(found)
    # The last value of each part is divided with the next one.
    assert sum(each.tag.count for each in found.tags) == 78
    assert list(description.undescribed(found)) == [("holding_registers", range(78, 90))]


def test_a_value_across_the_registers_at_hand_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    volts = [230.1 + index / 7 for index in range(60)]
    words = struct.unpack(">120H", struct.pack(">60f", *volts))
    for most in (1000, 41):
        monkeypatch.setattr(description, "MAX_REGISTERS_AT_ONCE", most)
        found = Description(1, Survey(["holding_registers"]))
        found.reads["holding_registers", range(120)] = [[*words]]
        found.survey.areas[0].ranges.append(range(120))
        description.conclude(found)
        assert {each.tag.type for each in found.tags} == {"float32"}, most
        assert [each.tag.address for each in found.tags] == [*range(0, 120, 2)]


def test_what_there_is_no_time_for_is_named() -> None:
    found = Description(1, Survey(["holding_registers", "coils"]))
    found.reads["holding_registers", range(7, 307)] = [[*range(1000, 1300)]]
    found.reads["coils", range(3)] = [[1, 0, 1]]
    for area in found.survey.areas:
        area.ranges += [extent for name, extent in found.reads if name == area.area]
    description.conclude(found, seconds=0)
    assert [each.tag.name for each in found.tags] == ["co_0", "co_1", "co_2"]
    assert list(description.undescribed(found)) == [("holding_registers", range(7, 307))]

"""A simulated device: what its values do, what it keeps, and what exists."""

from __future__ import annotations

import codecs
import csv
import itertools
import math
import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast import values
from holdfast.client.tag_reading import TagReader
from holdfast.errors import ModbusException
from holdfast.simulation import capacity, generators, playback
from holdfast.simulation.device import Refused, SimulatedDevice
from holdfast.tags import Tag, TagList
from holdfast.tags.scale import RegisterScale
from holdfast.tags.text import text_of
from support import cli

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

EVERYTHING = TagList(
    [
        Tag("voltage", "input_registers", 0, "float32", "CDAB", unit="V"),
        Tag("scaled", "input_registers", 2, "int16", scale=0.001, unit="V"),
        Tag("energy", "input_registers", 3, "uint32", scale=0.01, unit="kWh"),
        Tag("half", "input_registers", 5, "float16", unit="MW"),
        Tag("bcd", "input_registers", 6, "bcd16"),
        Tag("big", "input_registers", 7, "uint64", "BADCFEHG"),
        Tag("state", "input_registers", 11, states={0: "off", 5: "on", 9: "fault"}),
        Tag("name", "input_registers", 12, "string:5"),
        Tag("blob", "input_registers", 15, "bytes:3"),
        Tag("many", "input_registers", 17, "int16[3]", unit="A"),
        Tag("bit_0", "input_registers", 20, "bit:0"),
        Tag("bit_9", "input_registers", 20, "bit:9"),
        Tag("limited", "input_registers", 21, min=40, max=50),
        Tag("door", "discrete_inputs", 9, "bool"),
        Tag("doors", "discrete_inputs", 10, "bool[3]"),
        Tag("flag", "input_registers", 30, "bool"),
        Tag("setpoint", "holding_registers", 0, "int16", scale=0.1, writable=True, min=5, max=30),
        Tag("mode", "holding_registers", 1, states={3: "off", 4: "on"}, writable=True),
        Tag("run", "holding_registers", 2, "bit:1", writable=True),
        Tag("ready", "holding_registers", 2, "bit:0"),
        Tag("label", "holding_registers", 3, "string:4", writable=True),
        Tag("pump", "coils", 3, "bool", writable=True),
        Tag("pumps", "coils", 4, "bool[2]", writable=True),
        Tag("gains", "holding_registers", 8, "float32[2]", writable=True),
    ]
)


@pytest.fixture
def serve_simulated() -> Iterator[Any]:
    servers = []

    def start(device: SimulatedDevice) -> holdfast.SyncClient:
        rule = device.rule(1, ["127.0.0.1"])
        server = holdfast.Server(rules=[rule], bind="127.0.0.1:0").start()
        client = holdfast.SyncClient(cli.url(server), timeout=5)
        servers.append((server, client))
        return client

    yield start
    for server, client in servers:
        client.close()
        server.stop()


def read(client: holdfast.SyncClient, tags: TagList) -> dict[str, Any]:
    return {each.tag.name: each.error or each.value for each in TagReader(tags).read(client)}


def test_every_type_of_tag_has_values_that_change_and_can_be_read(serve_simulated: Any) -> None:
    device = SimulatedDevice(EVERYTHING, seed="1")
    client = serve_simulated(device)
    found = []
    for _ in range(25):
        found.append(read(client, EVERYTHING))
        device.step()
    assert not [each for each in found[0].values() if isinstance(each, Exception)]
    changing = {name for name in found[0] if len({str(each[name]) for each in found}) > 1}
    still = {tag.name for tag in EVERYTHING if tag.writable} | {"ready", "name", "blob"}
    assert changing == {tag.name for tag in EVERYTHING} - still
    assert all(225 <= each["voltage"] <= 235 for each in found)
    assert all(-32.8 < each["scaled"] < 32.8 for each in found)
    assert all(40 <= each["limited"] <= 50 for each in found)
    assert [each["energy"] for each in found[:3]] == [0.0, 0.5, 1.0]
    assert {each["state"] for each in found} == {0, 5, 9}
    first = found[0]
    assert (first["name"], first["blob"], first["setpoint"]) == ("name", bytes(3), 17.5)
    assert (first["mode"], first["run"], first["pump"]) == (3, False, False)


def test_the_same_seed_gives_the_same_values() -> None:
    def values(seed: str) -> list[list[int]]:
        device = SimulatedDevice(EVERYTHING, seed=seed)
        found = []
        for _ in range(20):
            found.append(device.memory.read("input_registers", 0, 31))
            device.step()
        return found

    assert values("a") == values("a")
    assert values("a") != values("b")


def test_what_is_written_stays(serve_simulated: Any) -> None:
    device = SimulatedDevice(EVERYTHING, seed="1")
    client = serve_simulated(device)
    client.write("holding_registers", 0, 215, "int16")
    client.write("holding_registers", 2, True, "bit:1")
    client.write_coil(3, True)
    for _ in range(30):
        device.step()
    found = read(client, EVERYTHING)
    assert (found["setpoint"], found["run"], found["pump"]) == (21.5, True, True)


@pytest.mark.parametrize(
    ("area", "address"),
    [("input_registers", 22), ("holding_registers", 7), ("coils", 2), ("discrete_inputs", 8)],
)
def test_only_addresses_of_tags_exist(serve_simulated: Any, area: Any, address: int) -> None:
    client = serve_simulated(SimulatedDevice(EVERYTHING))
    kind = "bool" if area in holdfast.types.BIT_AREAS else "uint16"
    with pytest.raises(ModbusException, match="exception 02"):
        client.read(area, address, kind)


def test_only_writable_tags_can_be_written(serve_simulated: Any) -> None:
    tags = TagList(
        [Tag("a", "holding_registers", 0, writable=True), Tag("b", "holding_registers", 1)]
    )
    client = serve_simulated(SimulatedDevice(tags))
    client.write_register(0, 7)
    with pytest.raises(ModbusException):
        client.write_register(1, 7)
    other = serve_simulated(SimulatedDevice(TagList([Tag("b", "coils", 1)])))
    with pytest.raises(ModbusException):
        other.write_coil(1, True)


def numbers(text: str, count: int, step: float = 1, **more: Any) -> list[Any]:
    tag = Tag("t", "holding_registers", 0, "float64", **more)
    device = SimulatedDevice(
        TagList([tag]), step=step, seed="1", chosen={"t": generators.parsed(tag, text)}
    )
    found = []
    for _ in range(count):
        raw = device.memory.read("holding_registers", 0, 4)
        found.append(holdfast.values.decode(raw, "float64"))
        device.step()
    return found


def test_generators_do_what_they_are_called() -> None:
    assert numbers("constant:21.5", 3) == [21.5] * 3
    assert numbers("ramp:0:8:4", 6) == [0, 2, 4, 6, 0, 2]
    assert numbers("counter:2.5", 3, step=0.5) == [0, 1.25, 2.5]
    sine = numbers("sine:10:20:8", 17)
    assert all(10 <= each <= 20 for each in sine)
    assert sine[:8] == pytest.approx(sine[8:16])
    assert max(sine) - min(sine) > 9
    walk = numbers("walk:-1:1:0.5", 200)
    assert all(-1 <= each <= 1 for each in walk)
    assert all(abs(one - other) <= 0.5 for one, other in itertools.pairwise(walk))
    assert len(set(walk)) > 100


@pytest.mark.parametrize(
    ("tag", "text", "message"),
    [
        (Tag("t", "coils", 0), "sine:0:1:5", "bool is not a number, allowed: constant:VALUE"),
        (Tag("t", "coils", 0), "noise:1", "'noise' is not a generator, allowed: constant:VALUE, "),
        (Tag("t", "input_registers", 0), "sine:0:1", "'sine:0:1' is not sine:LOW:HIGH:SECONDS"),
        (Tag("t", "input_registers", 0), "sine:5:1:9", "sine: 5 is not less than 1"),
        (Tag("t", "input_registers", 0), "sine:0:1:0", "sine: 0 is not more than 0"),
        (Tag("t", "input_registers", 0), "ramp:0:nan:1", "is not ramp:"),
        (Tag("t", "input_registers", 0), "constant:1,5", "decimal comma"),
        (Tag("t", "input_registers", 0), "constant:1.5", "between two values"),
        (Tag("t", "input_registers", 0), "constant:1e999", "'1e999' is not a finite number"),
        (Tag("t", "input_registers", 0), "cycle:5", "cycle requires states, or a tag with one bit"),
        (Tag("t", "input_registers", 0), "counter", "is not counter:PER_SECOND"),
    ],
)
def test_a_generator_that_a_tag_can_not_have_is_refused(tag: Tag, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        generators.parsed(tag, text)


def test_a_tag_that_keeps_what_is_written_only_has_a_first_value() -> None:
    tag = Tag("t", "holding_registers", 0, writable=True)
    shared = Tag("shared", "holding_registers", 0, "bit:3")
    device = SimulatedDevice(TagList([tag]), chosen={"t": generators.parsed(tag, "constant:7")})
    assert device.memory.read("holding_registers", 0, 1) == [7]
    for name in ("t", "shared"):
        generator = generators.Generator("cycle", (1,), (False, True))
        with pytest.raises(Refused, match=f"{name} keeps what is written to its registers"):
            SimulatedDevice(TagList([tag, shared]), chosen={name: generator})
    device = SimulatedDevice(TagList([tag]), played={"t": [5, 6]})
    device.step()
    assert device.memory.read("holding_registers", 0, 1) == [5]


def simulated(tags: list[Tag], **texts: str) -> SimulatedDevice:
    known = TagList(tags)
    chosen = {name: generators.parsed(known[name], text) for name, text in texts.items()}
    return SimulatedDevice(known, chosen=chosen)


TENTHS = {"scale": 0.1, "unit": "V"}
U = "t holds 0 to 6553.5 V (uint16, scale 0.1), found"


@pytest.mark.parametrize(
    ("type", "more", "text", "message"),
    [
        ("uint16", TENTHS, "constant:9999999", f"{U} 9999999 V; the nearest is 6553.5 V"),
        ("uint16", TENTHS, "ramp:0:6553.6:9", f"{U} 6553.6 V; the nearest is 6553.5 V"),
        ("uint16", TENTHS, "sine:-0.1:9:9", f"{U} -0.1 V; the nearest is 0 V"),
        ("uint16", TENTHS, "walk:1:7000:9", f"{U} 7000 V; the nearest is 6553.5 V"),
        ("uint16", TENTHS, "counter:7000", f"{U} 7000 V; the nearest is 6553.5 V"),
        ("uint16", TENTHS, "counter:-0.01", f"{U} -0.1 V; the nearest is 0 V"),
        ("uint16", {"offset": 5}, "counter:9", "t holds 5 to 65540 (uint16, offset 5), found 0; "),
        ("int16", {"scale": -1}, "constant:-32768", "t holds -32767 to 32768 (int16, scale -1), "),
        ("bcd16", {}, "ramp:0:10000:9", "t holds 0 to 9999 (bcd16), found 10000; the nearest is"),
        ("float16", {}, "sine:0:70000:9", "t holds -65504 to 65504 (float16), found 70000; the"),
        ("float32", {}, "constant:1e39", "t holds -3.4028235e+38 to 3.4028235e+38 (float32), "),
        ("uint16", {"null": frozenset([65535])}, "constant:70000", "t holds 0 to 65534 (uint16)"),
        ("int16[2]", {}, "constant:[1, 40000]", "t holds -32768 to 32767 (int16[2]), found 40000"),
        ("int16[2]", {}, "constant:[1]", "t: int16[2] takes 2 values, found 1"),
        ("bool[2]", {}, "constant:[true, 5]", "t: 5 is not False, True, 0 or 1, which bool"),
        ("string:4", {}, "constant:longer", "t: 'longer' has 6 bytes in ascii, allowed in string"),
    ],
)
def test_values_that_the_registers_can_not_hold_are_refused(
    type: str, more: dict[str, Any], text: str, message: str
) -> None:
    tag = Tag("t", "holding_registers", 0, type, **more)
    generator = generators.parsed(tag, text)
    with pytest.raises(Refused, match=re.escape(message)):
        SimulatedDevice(TagList([tag]), chosen={"t": generator})
    with pytest.raises(Refused):
        SimulatedDevice(TagList([tag]), played={"t": generator.items or [0, 70000, 1e39]})
    if generator.items:
        tag = replace(tag, writable=True)
        with pytest.raises(Refused, match=re.escape(message)):
            SimulatedDevice(TagList([tag]), chosen={"t": generator})


@pytest.mark.parametrize("value", [7, "on"])
def test_a_number_that_stands_for_no_value_is_refused(value: Any) -> None:
    states = {7: "on"} if value == "on" else {}
    tag = Tag("t", "holding_registers", 0, states=states, null=frozenset([7]))
    with pytest.raises(values.DoesNotFit, match="7 stands for no value"):
        generators.parsed(tag, f"constant:{value}")
    with pytest.raises(Refused, match="t: found 7, which stands for no value"):
        SimulatedDevice(TagList([tag]), played={"t": [value]})


def test_values_at_the_ends_of_the_registers_fit() -> None:
    tag = Tag("t", "holding_registers", 0, "int16", scale=0.1, null=frozenset([-32768, 32767]))
    device = simulated([tag], t="ramp:-3276.74:3276.64:2")
    assert device.memory.read("holding_registers", 0, 1) == [0x10000 - 32767]
    assert simulated([tag], t="constant:3276.6").memory.read("holding_registers", 0, 1) == [32766]
    half = Tag("t", "holding_registers", 0, "float16")  # A sine has such values beside its zeros.
    assert capacity.nearest(half, 1e-9) == 0


def test_a_counter_begins_again_at_the_end_of_its_registers_and_says_so() -> None:
    tag = Tag("t", "holding_registers", 0, "uint16", scale=0.1)
    told: list[str] = []
    chosen = {"t": generators.parsed(tag, "counter:2000")}
    device = SimulatedDevice(TagList([tag]), chosen=chosen, warn=told.append)
    found = []
    for _ in range(9):
        found += device.memory.read("holding_registers", 0, 1)
        device.step()
    assert found == [at * 20000 % 65536 for at in range(9)]
    assert told == ["t has counted to the end of uint16, and begins again at 0"]


def test_usual_values_fit_into_every_type() -> None:
    for tag in [
        Tag("t", "input_registers", 0, "bcd16", unit="kWh", offset=-3),
        Tag("t", "input_registers", 0, "uint16", scale=1e-4, unit="V"),
        Tag("t", "input_registers", 0, "uint16", min=-5, max=70000),
        Tag("t", "input_registers", 0, "uint16", states={7: "never", 2: "on"}, null=frozenset([7])),
        Tag("t", "input_registers", 0, "uint16", states={7: "never"}, null=frozenset([7])),
    ]:
        SimulatedDevice(TagList([tag]))


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_values_are_played_back_and_begin_again(tmp_path: Path, separator: str) -> None:
    tags = TagList(
        [
            Tag("t", "holding_registers", 0, "int16", scale=0.1),
            Tag("door", "coils", 0),
            Tag("pair", "holding_registers", 1, "uint16[2]"),
        ]
    )
    file = tmp_path / "values.csv"
    text = 'time|t|door|pair\n1|21.5|true|"[1,2]"\n2||false|"[3,4]"\n'
    file.write_text(text.replace("|", separator))
    device = SimulatedDevice(tags, played=playback.load(file, tags).values)
    found = []
    for _ in range(3):
        found.append(device.memory.read("holding_registers", 0, 3))
        found[-1] += device.memory.read("coils", 0, 1)
        device.step()
    assert found == [[215, 1, 2, 1], [215, 3, 4, 0], [215, 1, 2, 1]]


def test_infinity_is_played_back_and_null_in_an_array_repeats_its_item(tmp_path: Path) -> None:
    tags = TagList(
        [
            Tag("flow", "input_registers", 0, "float32"),
            Tag("loss", "input_registers", 2, "float32", scale=-0.5),
            Tag("pair", "holding_registers", 0, "int16[2]", null=frozenset([-1])),
        ]
    )
    file = tmp_path / "values.csv"
    file.write_text('flow,loss,pair\n1.5,inf,"[1,null]"\n-inf,-1,"[null,2]"\n,,\n')
    device = SimulatedDevice(tags, played=playback.load(file, tags).values)
    found = []
    for _ in range(3):
        floats = values.decode(device.memory.read("input_registers", 0, 4), "float32[2]")
        found.append([*floats, *device.memory.read("holding_registers", 0, 2)])
        device.step()
    assert found == [[1.5, -math.inf, 1, 0], [-math.inf, 2, 1, 2], [-math.inf, 2, 1, 2]]


def test_the_largest_floats_and_a_negative_zero_are_played_back(tmp_path: Path) -> None:
    tags = TagList(
        [
            Tag("f32", "input_registers", 0, "float32"),
            Tag("scaled", "input_registers", 2, "float32", scale=0.1),
            Tag("pair", "input_registers", 4, "float32[2]"),
        ]
    )
    most, minus_zero = [0x7F7F, 0xFFFF], [0x8000, 0]
    of_zero = [*minus_zero, 0, 0, *minus_zero, *minus_zero]
    file = tmp_path / "values.csv"
    for registers in (most * 4, [each ^ 0x8000 for each in most] * 4, of_zero):
        scaled = tags["scaled"].value(values.decode(registers[2:4], "float32"))
        f32 = values.decode(registers[:2], "float32")
        row = {"f32": f32, "scaled": scaled, "pair": [f32, f32]}
        with file.open("w", newline="") as opened:
            writer = csv.writer(opened)
            writer.writerow(row)
            writer.writerow(text_of(tags[name], value) for name, value in row.items())
        device = SimulatedDevice(tags, played=playback.load(file, tags).values)
        assert device.memory.read("input_registers", 0, 8) == registers


@pytest.mark.parametrize("cell", ["1e-46", "1e-400"])
def test_a_value_too_small_for_its_registers_is_played_back_as_zero(
    tmp_path: Path, cell: str
) -> None:
    tags = TagList([Tag("f32", "input_registers", 0, "float32")])
    file = tmp_path / "values.csv"
    file.write_text(f"f32\n{cell}\n")
    device = SimulatedDevice(tags, played=playback.load(file, tags).values)
    assert device.memory.read("input_registers", 0, 2) == [0, 0]


def test_a_state_is_played_back_by_its_name(tmp_path: Path) -> None:
    tags = TagList(
        [
            Tag("mode", "holding_registers", 0, states={2: "off", 3: "eco"}),
            Tag("relay", "coils", 0, states={0: "on", 1: "off"}),
        ]
    )
    file = tmp_path / "values.csv"
    file.write_text("mode,relay\neco,off\n2,on\n")
    device = SimulatedDevice(tags, played=playback.load(file, tags).values)
    found = []
    for _ in range(2):
        found.append(
            (device.memory.read("holding_registers", 0, 1)[0], device.memory.read("coils", 0, 1)[0])
        )
        device.step()
    assert found == [(3, 1), (2, 0)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("time,t\n", "no values"),
        ("time,x\n1,2\n", ":1: found the column 'x', allowed: names of tags"),
        ("t,t\n1,2\n", ":1: two columns have the same name"),
        ("t\n1\nmuch\n", ":3: t: 'much' is not a number"),
        ("time,t\n1\n", ":2: found 1 cells, allowed: 2"),
        ('t\n"1,5"\n', ":2: t: '1,5' has a decimal comma"),
        ("time;t\n1;1,5\n", ":2: t: '1,5' has a decimal comma"),
        ("t\n1\n\xb0\n", ":3: not UTF-8, allowed: CSV in UTF-8"),
        (codecs.BOM_UTF16_LE.decode("latin-1"), "a file in UTF-16, allowed: CSV in UTF-8"),
        ("t\n1e999\n", ":2: t: '1e999' is not a finite number"),
        ("t\ninf\n", ":2: t: 'inf' is not a number"),
        ("t\n1\n70000\n", r":3: t holds 0 to 65535 \(uint16\), found 70000; the nearest is 65535"),
    ],
)
def test_a_file_that_can_not_be_played_back_is_refused(
    tmp_path: Path, text: str, message: str
) -> None:
    file = tmp_path / "values.csv"
    file.write_text(text, encoding="latin-1")
    tags = TagList([Tag("t", "holding_registers", 0)])
    with pytest.raises(playback.Unplayable, match=message):
        playback.load(file, tags)


def test_a_file_is_not_read_beyond_its_maximum_number_of_rows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(playback, "MAX_ROWS", 2)
    file = tmp_path / "values.csv"
    file.write_bytes(b"t\n1\n2\n3\n\xb0\n")
    tags = TagList([Tag("t", "holding_registers", 0)])
    with pytest.raises(playback.Unplayable, match=":4: more than 2 rows"):
        playback.load(file, tags)


def test_a_cell_that_is_not_finite_is_refused_without_a_known_scale(tmp_path: Path) -> None:
    file = tmp_path / "values.csv"
    file.write_text("power\n-1e999\n")
    with pytest.raises(playback.Unplayable, match=":2: power: '-1e999' is not a finite number"):
        playback.load(file, scaled_tags())
    with pytest.raises(ValueError, match="'1e999' is not a finite number"):
        generators.parsed(scaled_tags()["power"], "constant:1e999")


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("uint16", math.inf),
        ("uint16", -math.inf),
        ("uint16", math.nan),
        ("uint16", 10**400),
        ("float32", math.nan),
        ("float32", 10**400),
    ],
    ids=lambda value: "too large" if value == 10**400 else None,
)
@pytest.mark.parametrize("writable", [False, True])
def test_numbers_that_registers_do_not_have_are_refused(
    kind: str, value: float, writable: bool
) -> None:
    tags = TagList([Tag("t", "holding_registers", 0, kind, writable=writable)])
    with pytest.raises(Refused, match=r"t: .* is not a finite number$"):
        SimulatedDevice(tags, played={"t": [value]})
    with pytest.raises(Refused, match=r"^t: .* is not a finite number$"):
        SimulatedDevice(tags, chosen={"t": generators.constant(value)})


def scaled_tags(**source: Any) -> TagList:
    scale = RegisterScale("exponent", "sf")
    return TagList(
        [
            Tag("power", "holding_registers", 0, "int16", scale=scale, unit="W"),
            Tag("limit", "holding_registers", 1, scale=scale, writable=True),
            Tag("sf", "holding_registers", 4, "int16", **source),
            Tag(
                "current",
                "input_registers",
                0,
                scale=RegisterScale("factor", source=Tag("", "input_registers", 7)),
                unit="A",
            ),
        ]
    )


def values_of(client: holdfast.SyncClient, tags: TagList) -> dict[str, Any]:
    readings = TagReader(tags).read(client)
    assert [each.error for each in readings] == [None] * len(tags)
    return {each.tag.name: each.value for each in readings}


def test_values_are_simulated_with_the_scale_of_their_register(serve_simulated: Any) -> None:
    tags = scaled_tags()
    device = SimulatedDevice(
        tags, chosen={"power": generators.parsed(tags["power"], "constant:432")}
    )
    client = serve_simulated(device)
    found = values_of(client, tags)
    assert (found["power"], found["sf"], device.memory.read("holding_registers", 0, 1)) == (
        432,
        -1,
        [4320],
    )
    assert 1 <= found["current"] <= 15


def test_a_simulated_scale_can_move(serve_simulated: Any) -> None:
    tags = scaled_tags()
    chosen = {
        "power": generators.parsed(tags["power"], "constant:3200"),
        "sf": generators.parsed(tags["sf"], "ramp:-1:2:3"),
    }
    device = SimulatedDevice(tags, chosen=chosen)
    client = serve_simulated(device)
    moved = set()
    for _ in range(6):
        device.step()
        found = values_of(client, tags)
        moved.add((found["sf"], found["power"]))
    assert moved == {(0, 3200), (1, 3200), (-1, 3200)}


@pytest.mark.parametrize(
    ("power", "scale", "message"),
    [
        ("constant:4300", None, "power holds -3276.8 to 3276.7 W (int16, scale 0.1 in holding_reg"),
        ("ramp:0:4300:60", "ramp:-1:2:3", "scale 0.1 in holding_registers 4), found 4300 W; the"),
        ("sine:-400:0:60", "sine:-2:2:3", "power holds -327.68 to 327.67 W (int16, scale 0.01 in"),
        ("counter:4300", None, "power holds -3276.8 to 3276.7 W (int16, scale 0.1 in holding_reg"),
    ],
)
def test_values_that_do_not_fit_with_a_scale_that_the_register_will_have_are_refused(
    power: str, scale: str | None, message: str
) -> None:
    tags = list(scaled_tags())
    with pytest.raises(Refused, match=re.escape(message)):
        simulated(tags, power=power, **({} if scale is None else {"sf": scale}))


def test_usual_values_fit_with_all_scales_that_the_register_will_have() -> None:
    device = simulated(list(scaled_tags()), sf="ramp:-3:3:6")
    for _ in range(130):
        [power] = device.memory.read("holding_registers", 0, 1)
        [scale] = device.memory.read("holding_registers", 4, 1)
        assert (scale, power) != (0x10000 - 3, 32767)
        device.step()


def test_a_factor_that_passes_by_0_is_refused_for_values_that_do_not_fit_then() -> None:
    scale = RegisterScale("factor", source=Tag("", "holding_registers", 1, "int16"))
    tag = Tag("t", "holding_registers", 0, "int16", scale=scale)
    source = "holding_registers 1"
    chosen = {"t": generators.constant(100_000), source: generators.Generator("ramp", (-9, 9, 18))}
    with pytest.raises(Refused, match=r"t holds -32767 to 32768 \(int16, scale -1 in"):
        SimulatedDevice(TagList([tag]), chosen=chosen)


def test_rows_are_played_with_the_scale_of_their_row() -> None:
    tags = scaled_tags()
    played = {"power": [300, 300_000], "sf": [-2, 1]}
    device = SimulatedDevice(tags, played=played)
    found = []
    for _ in range(3):
        found.append(device.memory.read("holding_registers", 0, 5)[::4])
        device.step()
    assert found == [[30000, 0x10000 - 2], [30000, 1], [30000, 0x10000 - 2]]
    with pytest.raises(Refused, match=r"scale 1 in holding_registers 4.*found 300000 W"):
        SimulatedDevice(tags, played={"power": [300, 300_000], "sf": [1, 0]})
    with pytest.raises(Refused, match=r"scale 0.01 in holding_registers 4.*found 300000 W"):
        SimulatedDevice(tags, played={"power": [300_000], "sf": [1, -2]})


def test_rows_without_a_valid_scale_are_played(tmp_path: Path) -> None:
    """As `--record` writes them: 0x8000 is no exponent, and the value has an error."""
    file = tmp_path / "recorded.csv"
    file.write_text("time,power,sf\n0,,-32768\n1,300,0\n2,,-32768\n")
    tags = scaled_tags()
    device = SimulatedDevice(tags, played=playback.load(file, tags).values)
    found = []
    for _ in range(3):
        found.append(device.memory.read("holding_registers", 0, 5)[::4])
        device.step()
    assert found == [[0, 0x8000], [300, 0], [300, 0x8000]]


def test_a_played_value_that_does_not_fit_with_its_scale_names_its_row() -> None:
    with pytest.raises(Refused, match="power holds -32768 to 32767 W") as caught:
        SimulatedDevice(scaled_tags(), played={"power": [300, 300_000], "sf": [1, 0]})
    assert caught.value.row == 1


def test_a_written_scale_is_that_of_the_next_values(serve_simulated: Any) -> None:
    tags = scaled_tags(writable=True)
    device = SimulatedDevice(
        tags, chosen={"power": generators.parsed(tags["power"], "constant:300")}
    )
    client = serve_simulated(device)
    client.write_register(4, 1)
    device.step()
    assert device.memory.read("holding_registers", 0, 1) == [30]
    client.write_register(4, 0x8000)
    device.step()
    assert device.memory.read("holding_registers", 0, 1) == [30]


def test_a_value_that_does_not_fit_with_a_written_scale_is_told(serve_simulated: Any) -> None:
    tags = scaled_tags(writable=True)
    told: list[str] = []
    chosen = {"power": generators.parsed(tags["power"], "constant:300")}
    device = SimulatedDevice(tags, chosen=chosen, warn=told.append)
    client = serve_simulated(device)
    for scale in (0x10000 - 3, 0x10000 - 3, 0, 0x10000 - 2, 0x10000 - 3):
        client.write_register(4, scale)
        device.step()
    message = (
        "power holds -32.768 to 32.767 W (int16, scale 0.001 in holding_registers 4), "
        "found 300 W; the nearest is 32.767 W"
    )
    assert told == [message] * 2
    assert device.memory.read("holding_registers", 0, 1) == [32767]


def test_a_scale_that_is_none_is_refused() -> None:
    tags = scaled_tags()
    with pytest.raises(Refused, match="power: the scale in holding_registers 4 is 10\\^99"):
        SimulatedDevice(tags, chosen={"sf": generators.parsed(tags["sf"], "constant:99")})

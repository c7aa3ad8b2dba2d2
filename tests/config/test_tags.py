"""Profiles and tags in a configuration, tag lists in files, and devices written once for many."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING

import pytest

from holdfast.config import ConfigError, load
from holdfast.config.checks import rule_order
from holdfast.config.tag_files.read import load_tags
from holdfast.net.addresses import covers
from holdfast.tags import Tag

if TYPE_CHECKING:
    from pathlib import Path

PROFILE = """
  pump:
    order: CDAB
    tags:
      flow: {area: input_registers, address: 0, type: float32, unit: m³/h}
      state: {area: holding_registers, address: 8, states: {0: off, 1: running}, null: [65535]}
"""

DEVICE = "devices: {a: {url: tcp://a, tags: {x: {area: coils, address: 1}}, interval: 1}}\n"
FLOW = Tag("flow", "input_registers", 0, "float32", "CDAB", unit="m³/h")
STATE = Tag(
    "state",
    "holding_registers",
    8,
    "uint16",
    "CDAB",
    states={0: "off", 1: "running"},
    null=frozenset([65535]),
)


def written(folder: Path, text: str, name: str = "p.yaml") -> Path:
    file = folder / name
    file.write_text(text, encoding="utf-8")
    return file


def problems(file: Path) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        load(file) if file.name == "p.yaml" else load_tags(file)
    folder = f"{file.parent}/"
    return [str(problem).removeprefix(folder) for problem in caught.value.problems]


def test_a_device_has_the_tags_of_its_profile_and_its_own(tmp_path: Path) -> None:
    file = written(
        tmp_path,
        f"profiles:{PROFILE}"
        "devices:\n"
        "  a: {url: tcp://10.0.0.5, profile: pump, interval: 1}\n"
        "  b: {url: tcp://10.0.0.6, profile: pump, interval: 1, tags: {\n"
        "    state: {area: coils, address: 3}, more: {area: coils, address: 4, writable: true}}}\n",
    )
    config = load(file)
    assert list(config.tags("a")) == [FLOW, STATE]
    assert list(config.tags("b")) == [
        FLOW,
        Tag("state", "coils", 3),
        Tag("more", "coils", 4, writable=True),
    ]
    assert (config.devices["a"].unit, config.warnings) == (1, ())
    assert load(written(tmp_path, config.dump(), "again.yaml")) == config


def test_classes_that_home_assistant_would_not_take_have_a_warning(tmp_path: Path) -> None:
    tags = (
        "a: {area: coils, address: 0, device_class: door},"
        "b: {area: coils, address: 0, device_class: energy},"
        "c: {area: holding_registers, address: 0, unit: VAR, device_class: reactive_power},"
        "d: {area: holding_registers, address: 0, unit: kVA, device_class: energy_storge},"
        "e: {area: holding_registers, address: 0, unit: kVA, device_class: power_factor},"
        "f: {area: holding_registers, address: 0, state_class: totals}"
    )
    written(tmp_path, f"tags: {{{tags}}}", "m.yaml")
    devices = "".join(
        f"  {name}: {{url: tcp://{name}, profile: m, interval: 1}}\n" for name in "xy"
    )
    warnings = load(written(tmp_path, f"profiles: [m.yaml]\ndevices:\n{devices}")).warnings
    passed_on = "Home Assistant refuses an entity if it is unknown there"
    assert [(each.key.rpartition("tags.")[2], each.message) for each in warnings] == [
        ("b.device_class", "energy has no effect: it is no class of bits"),
        (
            "d.device_class",
            f"'energy_storge' is unknown here: {passed_on}; did you mean 'energy_storage'?",
        ),
        (
            "e.device_class",
            "Home Assistant refuses power_factor with the unit 'kVA' over MQTT, allowed: %",
        ),
        ("f.state_class", f"'totals' is unknown here: {passed_on}; did you mean 'total'?"),
    ]
    text = DEVICE.replace("address: 1", "address: 1, device_class: power factor")
    message = "found 'power factor', allowed: a word, such as energy_storage"
    assert problems(written(tmp_path, text)) == [
        f"p.yaml:1: devices.a.tags.x.device_class: {message}"
    ]


SCALED = """
  meter:
    tags:
      power: {area: input_registers, address: 0, type: int16, scale: {from: sf, as: exponent}}
      energy: {area: input_registers, address: 2, scale: {from: {area: input_registers, address: 9},
               as: factor}}
      sf: {area: input_registers, address: 12, type: int16}
"""


def test_a_scale_can_be_in_a_register(tmp_path: Path) -> None:
    file = written(
        tmp_path,
        f"profiles:{SCALED}"
        "devices:\n"
        "  a: {url: tcp://10.0.0.5, profile: meter, interval: 1}\n"
        "  b: {url: tcp://10.0.0.6, profile: meter, interval: 1, tags: {\n"
        "    sf: {area: input_registers, address: 40}}}\n",
    )
    config = load(file)
    spans = {name: [tag.span for tag in config.tags(name)] for name in "ab"}
    assert spans == {
        "a": [range(13), range(2, 10), range(12, 13)],
        "b": [range(41), range(2, 10), range(40, 41)],
    }
    assert config.tags("a")["energy"].with_scale(10).value(5) == 50
    assert load(written(tmp_path, config.dump(), "again.yaml")) == config


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x", "found 'x', allowed: a number, or a mapping with the keys from, as"),
        ("{from: sf}", "the key as is missing, allowed: from, as"),
        ("{from: sf, as: power}", "as: found 'power', allowed: factor or exponent"),
        ("{form: sf, as: factor}", "found the key 'form', allowed: from, as; did you mean 'from'?"),
        ("{from: 3, as: factor}", "from: found 3, allowed: the name of a tag, or a mapping with"),
        ("{from: {area: x, address: 1}, as: factor}", "from: area: found 'x', allowed: coils"),
        ("{from: {area: coils}, as: factor}", "from: the key address is missing"),
        (
            "{from: {area: input_registers, address: 70000}, as: factor}",
            "from: address: found 70000, allowed: an integer from 0 to 65535",
        ),
        (
            "{from: {area: input_registers, address: 1, type: int13}, as: factor}",
            "from: type 'int13' is unknown, allowed: ",
        ),
        (
            "{from: {area: input_registers, address: 1, type: ''}, as: factor}",
            "from: type: found '', allowed: a type, such as uint16",
        ),
        (
            "{from: {area: holding_registers, address: 1}, as: factor}",
            "the scale is from holding_registers 1, allowed: a register in input_registers, as the",
        ),
        (
            "{from: {area: input_registers, address: 1000}, as: exponent}",
            "the scale is from input_registers 1000: 0 to 1000 are 1001 registers, one request",
        ),
        ("{from: sg, as: factor}", "the tag 'sg' does not exist in this list"),
    ],
)
def test_a_scale_that_cannot_be_is_named_with_its_line(
    tmp_path: Path, text: str, expected: str
) -> None:
    lines = f"  a: {{area: input_registers, address: 0, scale: {text}}}\n"
    file = written(
        tmp_path, f"tags:\n{lines}  sf: {{area: input_registers, address: 1}}\n", "list.yaml"
    )
    [problem] = problems(file)
    assert problem.startswith(f"list.yaml:2: tags.a.scale: {expected}")


@pytest.mark.parametrize(
    ("settings", "where", "flaw"),
    [
        ("max_registers: 12", "profile: power: ", "0 to 12 are 13 registers, max_registers is 12"),
        (
            "forbidden: [{area: input_registers, start: 10, end: 10}]",
            "profile: power: ",
            "0 to 12 overlaps the forbidden range 10 to 10",
        ),
        (
            "max_gap: 5, readable: [{area: input_registers, start: 0, end: 9}]",
            "profile: power: ",
            "1 to 11 are not readable",
        ),
        (
            "max_registers: 20, tags: {power: {area: input_registers, address: 40, "
            "scale: {from: sf, as: exponent}}}",
            "tags.power.scale: ",
            "12 to 40 are 29 registers, max_registers is 20",
        ),
    ],
)
def test_a_device_must_be_able_to_read_a_value_with_its_scale(
    tmp_path: Path, settings: str, where: str, flaw: str
) -> None:
    device = f"{{url: tcp://10.0.0.5, profile: meter, interval: 1, {settings}}}"
    file = written(tmp_path, f"profiles:{SCALED}devices:\n  a: {device}\n")
    [problem] = problems(file)
    assert problem == (
        f"p.yaml:9: devices.a.{where}the scale is from input_registers 12, {flaw}, and a value is "
        "only read together with its scale"
    )


def test_a_request_must_be_able_to_read_a_number(tmp_path: Path) -> None:
    tags = (
        "{flow: {area: input_registers, address: 0, type: 'uint32[9]'}, "
        "name: {area: input_registers, address: 0, type: 'string:8'}}"
    )
    device = f"{{url: tcp://10.0.0.5, interval: 1, max_registers: 1, tags: {tags}}}"
    [problem] = problems(written(tmp_path, f"devices:\n  a: {device}\n"))
    assert problem == (
        "p.yaml:2: devices.a.tags.flow.type: a number of uint32[9] has 2 registers, max_registers "
        "is 1, and all of them must be from one request"
    )


def test_all_tags_are_checked_if_max_registers_is_invalid(tmp_path: Path) -> None:
    forbidden = "forbidden: [{area: coils, start: 3, end: 9}]"
    tags = "{a: {area: coils, address: 3}, b: {area: coils, address: 4}}"
    device = f"{{url: tcp://10.0.0.5, interval: 1, max_registers: 0, {forbidden}, tags: {tags}}}"
    found = problems(written(tmp_path, f"devices:\n  a: {device}\n"))
    keys = ["max_registers", "tags.a.address", "tags.b.address"]
    assert [each.split(": ")[1] for each in found] == [f"devices.a.{key}" for key in keys]


def test_a_device_cannot_move_a_scale_out_of_reach(tmp_path: Path) -> None:
    own = "tags: {sf: {area: holding_registers, address: 1}}"
    device = f"{{url: tcp://10.0.0.5, profile: meter, interval: 1, {own}}}"
    file = written(tmp_path, f"profiles:{SCALED}devices:\n  a: {device}\n")
    [problem] = problems(file)
    assert problem.startswith("p.yaml:9: devices.a.tags.sf: power has its scale here: ")


def test_csv_has_scales_in_registers(tmp_path: Path) -> None:
    file = written(
        tmp_path,
        "name,area,address,type,order,scale\n"
        "power,ir,0,int16,,exponent sf\n"
        "energy,ir,2,,,factor ir 9\n"
        "share,ir,3,,,factor ir 10 float32\n"
        "sf,ir,12,int16,,\n",
        "meter.csv",
    )
    spans = {tag.name: tag.span for tag in load_tags(file)}
    assert (spans["power"], spans["energy"], spans["share"]) == (
        range(13),
        range(2, 10),
        range(3, 12),
    )
    wrong = written(tmp_path, "a,ir,0,,,exponent x y z w\n", "wrong.csv")
    assert problems(wrong)[0].startswith("wrong.csv:1: tags.a.scale: found 'exponent x y z w'")


def test_profiles_can_be_files(tmp_path: Path) -> None:
    written(tmp_path, PROFILE.replace("\n  pump:", "").replace("\n    ", "\n"), "pump.yaml")
    written(
        tmp_path,
        "# a list of the manufacturer\n"
        "name;Area;address;type;scale;writable;null;unit\n"
        "t;HR;3;int16;0.1;yes;-32768|32767;°C\n"
        'on;coil;4;;;;;"a; b"\n',
        "fan.CSV",
    )
    file = written(
        tmp_path,
        "profiles: [pump.yaml, fan.CSV]\n"
        "devices:\n"
        "  a: {url: tcp://10.0.0.5, profile: pump, interval: 1}\n"
        "  b: {url: tcp://10.0.0.6, profile: fan, interval: 1}\n",
    )
    config = load(file)
    assert list(config.tags("a")) == [FLOW, STATE]
    null = frozenset([-32768, 32767])
    t = Tag("t", "holding_registers", 3, "int16", scale=0.1, writable=True, null=null, unit="°C")
    assert list(config.tags("b")) == [t, Tag("on", "coils", 4, unit="a; b")]
    assert config.profile_files == (tmp_path / "pump.yaml", tmp_path / "fan.CSV")


@pytest.mark.parametrize("number", [2**53 + 1, 2**63, 10**23, 1e23, 2.0**63, -(2**63), 3, 0.5])
@pytest.mark.parametrize("key", ["scale", "offset", "min", "max", "deadband"])
def test_numbers_keep_their_digits(tmp_path: Path, key: str, number: float) -> None:
    number = abs(number) if key == "deadband" else number
    yaml = f"tags: {{x: {{area: holding_registers, address: 0, type: uint64, {key}: {number}}}}}"
    written(tmp_path, yaml, "y.yaml")
    written(tmp_path, f"name,area,address,type,{key}\nx,hr,0,uint64,{number}\n", "c.csv")
    devices = (f"{name}: {{url: tcp://{name}, profile: {name}, interval: 1}}" for name in "yc")
    text = f"profiles: [y.yaml, c.csv]\ndevices: {{{', '.join(devices)}}}\n"
    config = load(written(tmp_path, text))
    again = load(written(tmp_path, config.dump()))
    for device, of in (("y", config), ("c", config), ("y", again), ("c", again)):
        [tag] = of.tags(device)
        found = getattr(tag, key)
        # A float stands for its shortest decimal, as in the calculations of a tag.
        assert Fraction(repr(found)) == Fraction(repr(number)), device


def test_the_columns_of_csv_have_an_order(tmp_path: Path) -> None:
    text = "t,holding_registers,3,int16,CDAB,0.1,2,°C,true,outside\n"
    [tag] = load_tags(written(tmp_path, text, "t.csv"))
    plain = Tag("t", "holding_registers", 3, "int16", "CDAB", scale=0.1, offset=2.0)
    assert tag == replace(plain, unit="°C", writable=True, description="outside")


@pytest.mark.parametrize("first", ["", "sep=;\n", "# a list\n\nsep=;\n"])
@pytest.mark.parametrize("names", ["", "name;area;address;type;order;scale;unit\n"])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_the_first_line_tells_what_separates_cells(
    tmp_path: Path, first: str, names: str, separator: str
) -> None:
    text = f"{first}{names}t;hr;3;int16;;0.1;{'' if names else ';'}V\n".replace(";", separator)
    [tag] = load_tags(written(tmp_path, text, "t.csv"))
    assert tag == Tag("t", "holding_registers", 3, "int16", scale=0.1, unit="V")


def test_a_tag_list_has_more_room_than_a_configuration(tmp_path: Path) -> None:
    lines = ["a,hr,1\n", *["# a comment\n"] * 150_000]
    assert len(load_tags(written(tmp_path, "".join(lines), "t.csv"))) == 1
    with pytest.raises(ConfigError, match="more than 3145728 bytes"):
        load_tags(written(tmp_path, "".join(lines) * 3, "t.csv"))


def test_types_and_orders_are_in_any_case(tmp_path: Path) -> None:
    text = "tags: {a: {area: holding_registers, address: 1, type: Float32, order: cdab}}\n"
    [in_yaml] = load_tags(written(tmp_path, text, "t.yaml"))
    [in_csv] = load_tags(written(tmp_path, "a,hr,1,FLOAT32,cdab\n", "t.csv"))
    assert in_yaml == in_csv == Tag("a", "holding_registers", 1, "float32", "CDAB")


def test_problems_in_profile_files_name_file_line_and_tag(tmp_path: Path) -> None:
    written(tmp_path, "tags:\n  a: {area: coils, address: 1, scale: 2}\n  b: {area: x}\n", "a.yaml")
    written(tmp_path, "v,hr,0,float32\nw,ir,70000\nv,ir,1\nz,hr,1,flaot\n,hr,1\n", "b.csv")
    found = problems(
        written(tmp_path, f"profiles: [a.yaml, b.csv, c.yaml, d.txt, a.yaml]\n{DEVICE}")
    )
    assert [text.partition(", allowed")[0] for text in found] == [
        "p.yaml:1: profiles[2]: found 'c.yaml', which can't be read: No such file or directory",
        "p.yaml:1: profiles[3]: found 'd.txt'",
        "p.yaml:1: profiles[4]: found 'a.yaml', a second file for the profile a",
        "a.yaml:2: tags.a.scale: scale is 2.0",
        "a.yaml:3: tags.b.address: missing",
        "a.yaml:3: tags.b.area: found 'x'",
        "b.csv:2: tags.w.address: found 70000",
        "b.csv:3: the tag 'v' is given twice, first in line 1",
        "b.csv:4: tags.z.type: type 'flaot' is unknown",
        "b.csv:5: the tag has no name",
    ]


@pytest.mark.parametrize(
    ("settings", "keys"),
    [
        ("area: coil, address: 0, type: U16, order: LE, scale: 0", "area type order scale"),
        ("area: holding_registers, address: 70000, type: U16, scale: 0", "address type scale"),
        ("area: input_registers, address: 0, round: up, writable: true", "round writable"),
        # What only the invalid value makes an error is none.
        ("area: hr, address: 0, type: 'bool[200]', writable: true, null: [yes]", "area"),
        ("area: coils, address: 0, type: int16, scale: 0.1, max: 3", "type"),
        ("area: holding_registers, address: 0, type: f32, states: {-1: a}, null: [nan]", "type"),
        ("area: hr, address: 900, scale: {from: {area: coils, address: 0}, as: factor}", "area"),
        ("area: holding_registers, address: 65534, type: double, order: GHEFCDAB", "type"),
        ("area: coil, address: 0, order: GHEFCDAB", "area"),
        (
            "area: holding_registers, address: 0, type: float64, order: GHEFCDAB, "
            "scale: {from: {area: holding_registers, address: 9}, as: factor}",
            "scale",
        ),
        (
            "area: holding_registers, address: 0, order: LE, "
            "scale: {from: {area: holding_registers, address: 9}, as: factor}",
            "order",
        ),
        ("area: holding_registers, address: 0, scale: 0,1", "scale"),
    ],
)
def test_each_wrong_key_of_a_tag_is_reported(tmp_path: Path, settings: str, keys: str) -> None:
    listed = problems(written(tmp_path, f"tags: {{a: {{{settings}}}}}", "tags.yaml"))
    assert {each.split(": ")[1] for each in listed} == {f"tags.a.{key}" for key in keys.split()}
    mapped = f"mqtt: {{map: [{{topic: t, memory: m, tag: {{{settings}}}}}]}}"
    found = {each.split(": ")[1] for each in problems(written(tmp_path, mapped))}
    assert found >= {f"mqtt.map[0].tag.{key}" for key in keys.split()}


def test_a_table_without_a_valid_row_is_not_judged_as_yaml(tmp_path: Path) -> None:
    (problem,) = problems(written(tmp_path, ",hr,1\n", "t.csv"))
    assert "t.csv:1: the tag has no name" in problem


def test_a_tag_with_markers_for_no_value_is_checked_too(tmp_path: Path) -> None:
    tags = (
        "a: {area: input_registers, address: 1, null: [-5]}, "
        "b: {area: coils, address: 1, scale: 2, null: [true]}"
    )
    assert problems(written(tmp_path, f"profiles: {{p: {{tags: {{{tags}}}}}}}\n{DEVICE}")) == [
        "p.yaml:1: profiles.p.tags.a.null: -5 is outside 0 to 65535 of uint16",
        "p.yaml:1: profiles.p.tags.b.scale: scale is 2.0, allowed: only with numbers",
    ]


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("t.csv", "name,adress\nx,1\n", "t.csv:1: found the column 'adress', allowed: name, area"),
        ("t.csv", "x,hr,1,,,,,,,,more\n", "t.csv:1: found 11 cells, allowed: up to 10"),
        (
            "t.csv",
            'name,area,address,type,order,scale,offset,unit\na,hr,0,,,,,V\nb,hr,1,,,,,"A\nc,hr,2\n',
            "t.csv:3: not CSV: unexpected end of data, allowed: a cell that begins with a quote",
        ),
        ("t.csv", 'a,hr,0,,,,,"V\nb,hr,1,,,,,"A\n', "t.csv:1: not CSV: ',' expected after '\"'"),
        ("t.csv", 'a,hr,0,,,,,"V\nA"\n', "t.csv:2: tags.a.unit: found 'V\\nA', allowed: text"),
        (
            "t.csv",
            "name;area;address;scale\nx;hr;1;0,1\n",
            "t.csv:2: tags.x.scale: '0,1' has a decimal comma, allowed: a decimal point, as in 0.1",
        ),
        ("t.csv", "a;hr;1\nsep=;\n", "t.csv:2: tags.'sep='"),
        ("t.csv", "", "t.csv:1: found no tags, allowed: one in each line"),
        ("t.csv", "name,area,address\n", "t.csv:1: found no tags, allowed: one in each line"),
        ("t.yaml", "- a\n", "t.yaml:1: found a list, allowed: a mapping with the keys order"),
        ("t.yaml", "tags: {a: {area: coils}}\n", "t.yaml:1: tags.a.address: missing"),
        (
            "t.yaml",
            "tags: {a: {area: coils, address: 1, type: ''}}\n",
            "t.yaml:1: tags.a.type: found '', allowed: a type, such as float32",
        ),
        (
            "t.yaml",
            "tags: {a: {area: IR, address: 1}}\n",
            "t.yaml:1: tags.a.area: found 'IR', allowed: coils, discrete_inputs, "
            "holding_registers or input_registers; did you mean 'input_registers'?",
        ),
        (
            "t.yaml",
            "tags: {a: {area: holding_registers, address: 1, min: 0,05}}\n",
            "t.yaml:1: tags.a.min: found a comma behind 0, allowed: numbers such as 0.1 and 1000",
        ),
        (
            "t.yaml",
            "tags: {a: {area: holding_registers, address: 1, min: 10, 5: }}\n",
            "t.yaml:1: tags.a.5: unknown key",
        ),
        (
            "t.yaml",
            "tags:\n  a:\n    area: coils\n    address: 1\n    scale: 0,1\n",
            "t.yaml:5: tags.a.scale: '0,1' has a decimal comma, allowed: a decimal point",
        ),
        (
            "p.yaml",
            DEVICE.replace("interval: 1", "interval: '1,000'"),
            "p.yaml:1: devices.a.interval: found '1,000', allowed: a number from 0.01",
        ),
        (
            "t.csv",
            "name;area;address;scale\nx;hr;1;1,000\n",
            "t.csv:2: tags.x.scale: found '1,000', allowed: a number, or a mapping",
        ),
        (
            "p.yaml",
            DEVICE.replace("interval: 1", "interval: '0,250'"),
            "p.yaml:1: devices.a.interval: '0,250' has a decimal comma, allowed: a decimal point",
        ),
        (
            "t.yaml",
            "tags: {a: {area: coils, address: 1,\xa0min: 2}}\n",
            "t.yaml:1: tags.a.'\\xa0min': found the character U+00A0 (no-break space) before",
        ),
        (
            "t.yaml",
            "order: A\ntags: {a: {area: input_registers, address: 1}}\n",
            "t.yaml:1: order",
        ),
    ],
)
def test_a_wrong_file_is_refused(tmp_path: Path, name: str, text: str, expected: str) -> None:
    assert problems(written(tmp_path, text, name))[0].startswith(expected)


def test_a_wrong_column_is_the_only_problem_of_its_file(tmp_path: Path) -> None:
    file = written(tmp_path, "name,area,adress\na,hr,1\nb,hr,2\n", "t.csv")
    [problem] = problems(file)
    assert problem.startswith("t.csv:1: found the column 'adress'")


def test_a_column_that_occurs_twice_is_one_problem(tmp_path: Path) -> None:
    file = written(tmp_path, "name,area,address,Address\na,hr,1,2\n", "t.csv")
    assert problems(file) == ["t.csv:1: two columns have the name 'address'"]


def test_one_entry_makes_many_devices(tmp_path: Path) -> None:
    file = written(
        tmp_path,
        f"profiles:{PROFILE}"
        "devices:\n"
        '  "p{floor}_{n:02}":\n'
        "    for: {floor: [1, 3], n: 8-10}\n"
        '    url: "tcp://10.0.{floor}.{n}"\n'
        '    unit: "{n}"\n'
        "    profile: pump\n"
        "    interval: 1\n",
    )
    devices = load(file).devices
    assert list(devices) == ["p1_08", "p1_09", "p1_10", "p3_08", "p3_09", "p3_10"]
    assert (devices["p3_09"].url, devices["p3_09"].unit) == ("tcp://10.0.3.9", 9)


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ("'m{n}': {for: {n: 1-3}, url: 'tcp://a{m}', unit: 1}", "devices.'m{n}': found {m}, "),
        (
            "'m{n}': {for: {n: 1-3}, url: 'tcp://10.0.0.{ n }', unit: 1}",
            "devices.'m{n}': found { n }, allowed: {n}, {n:03} for at least three digits",
        ),
        ("'m{n}': {for: {n: 1-3}, url: 'tcp://a{n:2}'}", "devices.'m{n}': found {n:2}, allowed: "),
        ("'m{n}': {for: {n: 3-1}, url: tcp://a}", "devices.'m{n}'.for.n: found '3-1', allowed: as"),
        ("'m{n}': {for: 3, url: tcp://a}", "devices.'m{n}'.for: found 3, allowed: as in"),
        ("'m{n}': {for: {}, url: tcp://a}", "devices.'m{n}'.for: found an empty mapping"),
        ("m: {for: {n: 1-3}, url: tcp://a}", "devices.m: a second device has the name 'm'"),
        ("'m{n}': {for: {n: 1-10001}, url: tcp://a}", "devices.'m{n}'.for: the file would have"),
        ("'m{n}': {for: {n: 0-300}, url: tcp://a, unit: '{n}'}", "devices.'m{n}'.unit: found 256"),
        (
            "a: {url: tcp://a, profile: x, interval: 1}",
            "devices.a.profile: found 'x', allowed",
        ),
        ("a: {url: tcp://a, tags: {x: {area: coils, address: 1}}}", "devices.a.interval: missing"),
    ],
)
def test_a_wrong_entry_is_refused_once(tmp_path: Path, entry: str, expected: str) -> None:
    [found] = problems(written(tmp_path, f"devices:\n  {entry}\n"))
    assert found.startswith(f"p.yaml:2: {expected}")


LISTENER = (
    "listeners: {s: {type: modbus-tcp, bind: '127.0.0.1:0', rules: ["
    "{sources: [127.0.0.1], access: read-only, units: {1: %s}}]}}\n"
)
QUOTES = "allowed: 1 to 64 letters, digits, '_', '.' and '-'; quote it to make it text"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "memories: {1: {coils: 5}}\n" + LISTENER % "plant",
            [f"memories.1: found 1, {QUOTES}", "units.1: found 'plant', allowed: 1"],
        ),
        (
            "profiles: {1: {tags: {a: {area: coils, address: 0}}}}\n"
            "devices: {d: {url: tcp://a, interval: 1, profile: '1'}}\n",
            [f"profiles.1: found 1, {QUOTES}"],
        ),
        (
            DEVICE.replace("{a:", "{1:") + "outputs: {m: {type: mqtt, url: 'mqtt://a'}}\n",
            [f"devices.1: found 1, {QUOTES}"],
        ),
        (
            DEVICE.replace("interval", "forbidden: [{area: coils, start: 0, end: 5}], interval"),
            [
                "devices.a.tags.x.address: found 1, which overlaps the forbidden range 0 to 5, "
                "allowed: other addresses"
            ],
        ),
        (
            DEVICE.replace("address: 1", "address: 1, states: {0: false, 1: true}"),
            ["states.0: found false, allowed: text", "states.1: found true, allowed: text"],
        ),
        (
            DEVICE.replace(
                "address: 1", r"""address: 1, states: {0: "", 1: "on ", 2: "a\tb", 3: "\ud800"}"""
            ).replace("coils", "holding_registers"),
            [
                f"tags.x.states.{number}: found {found}, allowed: a name without control "
                "characters, and without blanks at its ends"
                for number, found in enumerate(["''", "'on '", r"'a\tb'", r"'\ud800'"])
            ],
        ),
        (
            "profiles: {p: p.csv}\n" + DEVICE,
            ["profiles.p: found 'p.csv', allowed: a mapping with the keys order, tags; files are"],
        ),
        (
            "memories: {plant: {coils: 5}}\n" + LISTENER % "{memry: plant, access: read-only}",
            [
                "units.1.memory: missing, allowed: text",
                "units.1.memry: unknown key, allowed: memory, access, functions, deny, read, "
                "write, exception_status, route; did you mean 'memory'?",
            ],
        ),
        (": 5\n" + DEVICE, ["found an empty key, allowed: text or an integer"]),
        (DEVICE + LISTENER % "{memory: plant}", ["memories: missing, allowed: a mapping"]),
        (
            "devices: {'d{n}': {for: {n: 1-999999999}, url: tcp://a, interval: 1}}\n",
            ["the file would have more than 10000 devices, allowed: up to 10000"],
        ),
        (
            DEVICE + "outputs: {n: {type: nats, servers: 'nats://u:s3cret@h'}}\n",
            ["outputs.n.servers: found text of 17 characters, allowed: a list"],
        ),
        (
            DEVICE + "outputs: {n: {type: influx, url: 'http://h/x', tags: {device: x}}}\n",
            ["tags.device: found device, which has the name of the device, allowed: another name"],
        ),
        (
            DEVICE + "outputs: {n: {type: influx, url: 'http://h/x', tags: {site: ''}}}\n",
            ["outputs.n.tags.site: found '', allowed: text"],
        ),
        (
            DEVICE.replace("address: 1", "address: 1, states: {on: up}"),
            ["states.on: found 'on', allowed: an integer"],
        ),
        (
            "logs: {site-leases: {servers: ['nats://127.0.0.1:1'], node: n}}\n" + DEVICE,
            ["logs.site-leases: found 'site-leases', allowed: a name that does not end in -leases"],
        ),
        (
            "logs: {site-devices: {servers: ['nats://127.0.0.1:1'], node: n}}\n" + DEVICE,
            ["allowed: a name that does not end in -devices, as buckets of another log do"],
        ),
        (
            "logs: {site: {servers: ['nats://127.0.0.1:1'],\n  node: a.plant.example}}\n" + DEVICE,
            ["2: logs.site.node: found 'a.plant.example', allowed: 1 to 64 letters, digits, - and"],
        ),
        (
            "logs: {a.b: {servers: ['nats://127.0.0.1:1'], node: n}}\n" + DEVICE,
            ["logs.'a.b': found 'a.b', allowed: 1 to 64 letters, digits, - and _"],
        ),
        (
            f"memories: {{plant: {{coils: 5, keep: {{file: {'a' * 300}/b}}}}}}\n"
            + LISTENER % "plant",
            ["which can't be used: File name too long"],
        ),
    ],
)
def test_what_would_fail_at_the_start_is_a_problem(
    tmp_path: Path, text: str, expected: list[str]
) -> None:
    found = problems(written(tmp_path, text))
    assert len(found) == len(expected), found
    for problem, part in zip(found, expected, strict=True):
        assert part in problem


def test_markers_that_json_can_not_have_are_text(tmp_path: Path) -> None:
    place = "input_registers, address: 1, type: float32, null: [.nan, .inf, -.inf, 0]"
    config = load(written(tmp_path, DEVICE.replace("coils, address: 1", place)))
    markers = config.effective()["devices"]["a"]["tags"]["x"]["null"]
    assert markers == ["nan", "inf", "-inf", 0]
    [tag] = config.tags("a")
    assert {str(marker) for marker in tag.null} == {"nan", "inf", "-inf", "0.0"}
    assert load(written(tmp_path, config.dump())) == config


def test_what_is_called_options_is_printed_like_all_else(tmp_path: Path) -> None:
    config = load(written(tmp_path, DEVICE.replace("{a:", "{options:")))
    assert load(written(tmp_path, config.dump())) == config
    assert "id: null" not in config.dump()


def test_the_rules_of_many_units_are_compared_once_for_equal_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def counted(networks: object, network: object) -> bool:
        asked.append(network)
        return covers(networks, network)  # type: ignore[arg-type]

    monkeypatch.setattr(rule_order, "covers", counted)
    rules = ", ".join(
        f"{{sources: [10.0.0.{number}], access: read-only, units: {{0-255: m}}}}"
        for number in range(20)
    )
    text = "memories: {m: {coils: 5}}\nlisteners: {s: {type: modbus-tcp, bind: '127.0.0.1:0', "
    load(written(tmp_path, f"{text}rules: [{rules}]}}}}\n"))
    assert len(asked) <= 20 * 20

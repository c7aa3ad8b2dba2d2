"""Importing Telegraf: what its Modbus inputs and its output for InfluxDB become."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.config import ConfigError, load
from holdfast.importing import NotImportable, read_telegraf
from holdfast.outputs.line_protocol import lines
from holdfast.polling import Reading
from holdfast.tags import Tag
from holdfast.values import decode

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.importing import Imported

REGISTER = """\
[agent]
  interval = "10s"
[[inputs.modbus]]
  name = "press"
  slave_id = 7
  timeout = "1500ms"
  controller = "tcp://10.0.0.5:502"
  coils = [{ name = "run", address = [3], data_type = "BOOL" }]
  holding_registers = [
    { name = "voltage", byte_order = "AB", data_type = "FIXED", scale=0.1, address = [0]},
    { name = "energy", byte_order = "CDAB", data_type = "UFIXED", scale=0.001, address = [5,6]},
  ]
  input_registers = [
    { name = "speed", byte_order = "ABCD", data_type = "INT32", scale=1.0, address = [3,4]},
  ]
"""

REQUEST = """\
[[inputs.modbus]]
  name = "line"
  controller = "tcp://10.0.0.5:502"
  timeout = "1s"
  configuration_type = "request"
  [[inputs.modbus.request]]
    slave_id = 1
    register = "holding"
    byte_order = "MSW-LE"
    fields = [
      { address=0, name="voltage", type="INT16", scale=0.1 },
      { address=1, type="INT32", omit=true },
      { address=3, type="INT16", omit=true },
      { address=4, name="energy", type="FLOAT32" },
    ]
  [[inputs.modbus.request]]
    slave_id = 2
    register = "coil"
    fields = [ { address=9, name="run", output="BOOL" } ]
"""

METRIC = """\
[[inputs.modbus]]
  name = "meter"
  controller = "tcp://10.0.0.5:502"
  timeout = "1s"
  configuration_type = "metric"
  [[inputs.modbus.metric]]
    slave_id = 4
    fields = [
      { register="discrete", address=2, name="door", output="BOOL" },
      { register="input", address=8, name="hours", type="UINT32" },
      { address=20, name="ready", type="BIT", bit=3 },
    ]
"""

SERIAL = """\
[[inputs.modbus]]
  name = "pump"
  slave_id = 3
  timeout = "1s"
  controller = "file:///dev/ttyUSB0"
  baud_rate = 9600
  data_bits = 8
  parity = "N"
  stop_bits = 2
  coils = [{ name = "run", address = [0], data_type = "BOOL" }]
"""

OUTPUT = """\
[[outputs.influxdb_v2]]
  urls = ["http://10.0.0.9:8086"]
  token = "s3cret-token"
  organization = "plant"
  bucket = "modbus"
"""


@pytest.fixture
def imported(tmp_path: Path) -> Callable[[str], Imported]:
    """Imports text; the result must be a valid configuration."""

    def read(text: str) -> Imported:
        file = tmp_path / "telegraf.conf"
        file.write_text(text)
        found = read_telegraf(file)
        made = tmp_path / "made.yaml"
        made.write_text(found.to_yaml())
        (tmp_path / "token.txt").write_text("token")
        assert load(made).warnings == ()
        return found

    return read


def changed(old: str, new: str, text: str = REGISTER) -> str:
    assert text.count(old) == 1, old
    return text.replace(old, new)


NO_AGENT = "no agent in this file: 10 s, the default of Telegraf"


def notes(found: Imported) -> list[str]:
    """The notes, without the one that most of these files cause."""
    told = [each for each in found.notes if each.message != NO_AGENT]
    return [f"{each.line}: {each.key}: {each.kind}: {each.message}" for each in told]


def problems(read: Callable[[str], Imported], text: str) -> list[str]:
    with pytest.raises(NotImportable) as refused:
        read(text)
    return [f"{each.line}: {each.key}: {each.message}" for each in refused.value.problems]


def device(found: Imported) -> dict[str, Any]:
    (only,) = found.data["devices"].values()
    assert isinstance(only, dict)
    return only


def test_an_input_becomes_a_device(imported: Callable[[str], Imported]) -> None:
    found = imported(REGISTER)
    assert found.data == {
        "devices": {
            "press": {
                "url": "tcp://10.0.0.5:502",
                "unit": 7,
                "interval": 10,
                "timeout": 1.5,
                "max_gap": 0,
                "tags": {
                    "run": {"area": "coils", "address": 3},
                    "voltage": {
                        "area": "holding_registers",
                        "address": 0,
                        "type": "int16",
                        "scale": 0.1,
                    },
                    "energy": {
                        "area": "holding_registers",
                        "address": 5,
                        "type": "uint32",
                        "order": "CDAB",
                        "scale": 0.001,
                    },
                    "speed": {"area": "input_registers", "address": 3, "type": "int32"},
                },
            }
        }
    }
    assert notes(found) == []


def test_requests_become_a_device_for_each_unit(imported: Callable[[str], Imported]) -> None:
    found = imported(REQUEST)
    devices = found.data["devices"]
    assert {name: each["unit"] for name, each in devices.items()} == {"line-1": 1, "line-2": 2}
    assert devices["line-1"]["tags"] == {
        "voltage": {
            "area": "holding_registers",
            "address": 0,
            "type": "int16",
            "order": "BADC",
            "scale": 0.1,
        },
        "energy": {
            "area": "holding_registers",
            "address": 4,
            "type": "float32",
            "order": "BADC",
        },
    }
    assert devices["line-1"]["max_gap"] == 3, "what is omitted was read to join requests"
    assert devices["line-2"]["tags"] == {"run": {"area": "coils", "address": 9}}
    assert devices["line-2"]["max_gap"] == 0
    assert notes(found) == []


def test_metrics_become_devices(imported: Callable[[str], Imported]) -> None:
    found = imported(METRIC)
    assert device(found)["tags"] == {
        "door": {"area": "discrete_inputs", "address": 2},
        "hours": {"area": "input_registers", "address": 8, "type": "uint32"},
        "ready": {"area": "holding_registers", "address": 20, "type": "bit:3"},
    }
    bits = "bits without BOOL are true and false; Telegraf had 1 and 0"
    assert notes(found) == [f"1: inputs.modbus[0]: changed: {bits}"]


@pytest.mark.parametrize(
    ("old", "new", "url"),
    [
        ('"tcp://10.0.0.5:502"', '"tcp://[fd00::5]:1502"', "tcp://[fd00::5]:1502"),
        ('"tcp://10.0.0.5:502"', '"tcp://:502"', "tcp://127.0.0.1:502"),
        ("  slave_id", '  transmission_mode = "auto"\n  slave_id', "tcp://10.0.0.5:502"),
        ("  slave_id", '  transmission_mode = "RTUoverTCP"\n  slave_id', "rtu+tcp://10.0.0.5:502"),
        (
            "  slave_id",
            '  transmission_mode = "ASCIIoverTCP"\n  slave_id',
            "ascii+tcp://10.0.0.5:502",
        ),
    ],
)
def test_a_controller_becomes_a_url(
    imported: Callable[[str], Imported], old: str, new: str, url: str
) -> None:
    assert device(imported(changed(old, new)))["url"] == url


@pytest.mark.parametrize(
    ("old", "new", "url"),
    [
        ("  name", "  name", "rtu:///dev/ttyUSB0?baud=9600&parity=none&stop_bits=2"),
        ('"file:///dev/ttyUSB0"', '"/dev/ttyS1"', "rtu:///dev/ttyS1?baud=9600&parity=none&stop_bits=2"),
        ('"file:///dev/ttyUSB0"', '"COM3"', "rtu:///COM3?baud=9600&parity=none&stop_bits=2"),
        ('"file:///dev/ttyUSB0"', '"file:///COM3"', "rtu:///COM3?baud=9600&parity=none&stop_bits=2"),
        ("  baud_rate = 9600\n", "", "rtu:///dev/ttyUSB0?baud=19200&parity=none&stop_bits=2"),
        ('  parity = "N"\n  stop_bits = 2\n', "", "rtu:///dev/ttyUSB0?baud=9600&parity=even&stop_bits=1"),
        ("data_bits = 8", 'data_bits = 7\n  transmission_mode = "ASCII"',
         "ascii:///dev/ttyUSB0?baud=9600&parity=none&stop_bits=2&data_bits=7"),
    ],
)  # fmt: skip
def test_a_serial_line_becomes_a_url(
    imported: Callable[[str], Imported], old: str, new: str, url: str
) -> None:
    assert device(imported(changed(old, new, SERIAL)))["url"] == url


@pytest.mark.parametrize(
    ("during", "after", "option"),
    [("true", "false", "&rs485=rts"), ("false", "true", "&rs485=rts-low"), ("true", "true", "")],
)
def test_rs485_is_the_level_of_rts(
    imported: Callable[[str], Imported], during: str, after: str, option: str
) -> None:
    table = (
        f"  [inputs.modbus.rs485]\n    rts_high_during_send = {during}\n"
        f'    rts_high_after_send = {after}\n    delay_rts_before_send = "2ms"\n'
    )
    found = imported(SERIAL + table)
    assert device(found)["url"].endswith(f"stop_bits=2{option}")
    place = "14: inputs.modbus[0].rs485"
    assert f"{place}.delay_rts_before_send: left out: RTS switches without a delay" in notes(found)
    same = "11: inputs.modbus[0].rs485: left out: RTS is the same during and after sending, so it "
    assert (f"{same}switches nothing" in notes(found)) == (not option)


@pytest.mark.parametrize(
    ("text", "interval"),
    [
        ("10s", 10), ("1m30s", 90), ("500ms", 0.5), ("1h", 3600), ("1.5s", 1.5), ("250000us", 0.25),
        ("1ms", 0.01), ("1d", 86400), ("0s", 10),
    ],
)  # fmt: skip
def test_intervals_are_durations(
    imported: Callable[[str], Imported], text: str, interval: float
) -> None:
    found = imported(changed("  slave_id", f'  interval = "{text}"\n  slave_id'))
    assert device(found)["interval"] == interval
    raised = "5: inputs.modbus[0].interval: changed: raised to 10 ms, the shortest interval"
    assert notes(found) == ([raised] if text == "1ms" else [])


def test_each_input_has_its_interval(imported: Callable[[str], Imported]) -> None:
    second = REQUEST.replace("[[inputs.modbus]]\n", '[[inputs.modbus]]\n  interval = "1s"\n')
    agent = changed('interval = "10s"', 'interval = "20s"')
    devices = imported(agent + second).data["devices"]
    assert [each["interval"] for each in devices.values()] == [20, 1, 1]
    found = imported(REGISTER.partition('interval = "10s"')[2])
    assert device(found)["interval"] == 10
    (note,) = found.notes
    assert (note.line, note.key, note.kind, note.message) == (
        2,
        "inputs.modbus[0]",
        "check",
        NO_AGENT,
    )
    found = imported(changed("  slave_id", "  interval = 5\n  slave_id"))
    assert device(found)["interval"] == 10
    assert notes(found) == [
        "5: inputs.modbus[0].interval: left out: Telegraf ignored an interval that is not text; "
        "see that of the agent"
    ]


def test_without_a_timeout_there_is_one_here(imported: Callable[[str], Imported]) -> None:
    found = imported(changed('  timeout = "1500ms"\n', ""))
    assert device(found)["timeout"] == 1
    assert notes(found) == [
        "3: inputs.modbus[0]: check: no timeout: 1 s; Telegraf waited without an end"
    ]


def test_workarounds_and_retries(imported: Callable[[str], Imported]) -> None:
    text = changed("  slave_id", '  busy_retries = 20\n  busy_retries_wait = "5s"\n  slave_id')
    text += """\
  [inputs.modbus.workarounds]
    pause_after_connect = "2s"
    pause_between_requests = "20ms"
    close_connection_after_gather = true
    max_word_registers_per_request = 20
    max_bit_registers_per_request = 100
"""
    found = imported(text)
    assert device(found)["tolerance"] == {
        "pause_after_connect": 2,
        "pause": 0.02,
        "retries": 10,
        "retry_busy": True,
    }
    assert (device(found)["max_registers"], device(found)["max_bits"]) == (20, 100)
    assert notes(found) == [
        "5: inputs.modbus[0].busy_retries: changed: 10 retries, also after timeouts and lost "
        "connections",
        "6: inputs.modbus[0].busy_retries_wait: left out: the pause before a retry is at least "
        "0.1 s; see pause of tolerance",
        "21: inputs.modbus[0].workarounds.close_connection_after_gather: left out: the "
        "connection stays open: with close_after, each request would wait for pause_after_connect",
    ]


def test_inputs_of_one_controller_share_its_settings(imported: Callable[[str], Imported]) -> None:
    """Devices at one address need the same tolerance."""
    pauses = '  [inputs.modbus.workarounds]\n    pause_between_requests = "20ms"\n'
    found = imported(REGISTER + pauses + REQUEST)
    assert [each["tolerance"] for each in found.data["devices"].values()] == [{"pause": 0.02}] * 3
    assert notes(found) == [
        "18: inputs.modbus[1]: changed: devices at one address share pauses and retries: the "
        "largest value of each applies"
    ]
    closing = "  [inputs.modbus.workarounds]\n    close_connection_after_gather = true\n"
    found = imported(REGISTER + closing)
    assert device(found)["tolerance"] == {"close_after": 1}
    assert "changed: the connection is closed after each request" in notes(found)[0]
    waiting = '  [inputs.modbus.workarounds]\n    pause_after_connect = "1s"\n'
    found = imported(REGISTER + closing + REQUEST + waiting)
    shared = [each["tolerance"] for each in found.data["devices"].values()]
    assert shared == [{"pause_after_connect": 1}] * 3
    assert any("left out: the connection stays open" in note for note in notes(found))
    second = changed("baud_rate = 9600", "baud_rate = 19200", SERIAL)
    assert problems(imported, SERIAL + second) == [
        "15: inputs.modbus[1].controller: the serial settings differ from those of the input at "
        "line 2 of the file, allowed: the same settings"
    ]


def test_names_are_unique(imported: Callable[[str], Imported]) -> None:
    second = changed("slave_id = 7", "slave_id = 8").partition("[[")[2]
    found = imported(f"{REGISTER}[[{second}")
    assert list(found.data["devices"]) == ["press-7", "press-8"]
    text = changed('name = "energy"', 'name = "voltage"')
    text = changed('name = "speed"', 'name = "Speed (rpm)"', text)
    found = imported(changed('name = "press"', 'name = "press 1"', text))
    assert list(found.data["devices"]) == ["press_1"]
    tags = device(found)["tags"]
    assert list(tags) == ["run", "voltage", "voltage-2", "Speed__rpm_"]
    assert (tags["voltage-2"]["description"], tags["Speed__rpm_"]["description"]) == (
        "voltage",
        "Speed (rpm)",
    )
    assert len([note for note in notes(found) if "renamed" in note]) == 3


# Values: what Telegraf makes of registers, by its documentation, against the decoded tag.

PAYLOADS = (
    bytes.fromhex("4048f5c3bf9d7001"),
    bytes.fromhex("c1230000800000ff"),
    bytes.fromhex("0001000000000000"),
    bytes.fromhex("3ff199999999999a"),
)
FORMATS = {
    "INT16": "h", "UINT16": "H", "INT32": "i", "UINT32": "I", "INT64": "q", "UINT64": "Q",
    "FLOAT16": "e", "FLOAT32": "f", "FLOAT64": "d",
}  # fmt: skip
BYTES_AND_WORDS = {
    "ABCD": ("big", False),
    "BADC": ("little", False),
    "CDAB": ("big", True),
    "DCBA": ("little", True),
}
SPELLED = {
    1: {"AB": "ABCD", "BA": "DCBA"},
    2: {order: order for order in BYTES_AND_WORDS},
    4: {"ABCDEFGH": "ABCD", "HGFEDCBA": "DCBA", "BADCFEHG": "BADC", "GHEFCDAB": "CDAB"},
}
DESCRIBED = {"MSW-BE": "ABCD", "MSW-LE": "BADC", "LSW-BE": "CDAB", "LSW-LE": "DCBA"}


def expected(payload: bytes, kind: str, order: str, scale: float) -> float:
    """The value in the source: whole words, then the number that their bits are."""
    endian, low_word_first = BYTES_AND_WORDS[order]
    words = [
        payload[at : at + 2] if endian == "big" else payload[at : at + 2][::-1]
        for at in range(0, len(payload), 2)
    ]
    data = b"".join(words[::-1] if low_word_first else words)
    number: float = struct.unpack(f">{FORMATS[kind]}", data)[0]
    return number if scale == 1 else float(number) * scale


def tags_of(tmp_path: Path) -> dict[str, Tag]:
    """The tags of the imported configuration."""
    (only,) = load(tmp_path / "made.yaml").devices.values()
    return {name: tag.tag(name, "ABCD") for name, tag in only.tags.items()}


def value_of(tag: Tag, registers: list[int]) -> object:
    return tag.value(decode(registers, tag.type, tag.order, encoding=tag.encoding))


def words(payload: bytes) -> list[int]:
    return list(struct.unpack(f">{len(payload) // 2}H", payload))


@pytest.mark.parametrize("scale", [1.0, 0.1, -0.001, 20.0])
def test_values_of_the_style_register(
    imported: Callable[[str], Imported], tmp_path: Path, scale: float
) -> None:
    ieee = {"FLOAT16-IEEE": "FLOAT16", "FLOAT32-IEEE": "FLOAT32", "FLOAT64-IEEE": "FLOAT64"}
    fixed = {1: ("INT16", "UINT16"), 2: ("INT32", "UINT32"), 4: ("INT64", "UINT64")}
    plain = {kind: kind for kind in FORMATS if not kind.startswith("FLOAT")}
    fields: list[str] = []
    cases: dict[str, tuple[str, str, int]] = {}
    for size, orders in SPELLED.items():
        kinds = {**plain, **ieee, "FIXED": fixed[size][0], "UFIXED": fixed[size][1]}
        kinds = {
            name: kind for name, kind in kinds.items() if struct.calcsize(FORMATS[kind]) == 2 * size
        }
        for spelled, order in orders.items():
            for data_type, kind in kinds.items():
                name = f"f{len(fields)}"
                fields.append(
                    f'{{name="{name}", byte_order="{spelled}", data_type="{data_type}", '
                    f"scale={scale}, address={list(range(100, 100 + size))}}}"
                )
                cases[name] = (kind, order, size)
    imported(f"{REGISTER.partition('  coils')[0]}  holding_registers = [{','.join(fields)}]\n")
    tags = tags_of(tmp_path)
    assert len(cases) == 2 * 5 + 4 * 5 + 4 * 5
    for name, (kind, order, size) in cases.items():
        for payload in PAYLOADS:
            data = payload[: 2 * size]
            value = value_of(tags[name], words(data))
            wanted = expected(data, kind, order, scale)
            if scale == 1:
                assert value == wanted, (name, kind, order)
            else:
                # Floats are scaled as the decimals that they stand for.
                nearly = {"FLOAT16": 1e-3, "FLOAT32": 1e-6}.get(kind, 1e-12)
                assert value == pytest.approx(wanted, rel=nearly), (name, kind, order)


@pytest.mark.parametrize("style", ["request", "metric"])
def test_values_of_the_other_styles(
    imported: Callable[[str], Imported], tmp_path: Path, style: str
) -> None:
    head = f"""\
[[inputs.modbus]]
  name = "a"
  controller = "tcp://10.0.0.5:502"
  timeout = "1s"
  configuration_type = "{style}"
"""
    tables: list[str] = []
    cases: dict[str, tuple[str, str]] = {}
    for spelled, order in {**DESCRIBED, **{each: each for each in BYTES_AND_WORDS}}.items():
        fields = []
        for kind in FORMATS:
            name = f"f{len(cases)}"
            fields.append(f'{{address=100, name="{name}", type="{kind}"}}')
            cases[name] = (kind, order)
        tables.append(
            f'[[inputs.modbus.{style}]]\n  slave_id=1\n  byte_order="{spelled}"\n'
            f"  fields=[{','.join(fields)}]\n"
        )
    imported(head + "".join(tables))
    tags = tags_of(tmp_path)
    for name, (kind, order) in cases.items():
        for payload in PAYLOADS:
            data = payload[: struct.calcsize(FORMATS[kind])]
            value = value_of(tags[name], words(data))
            assert value == expected(data, kind, order, 1), (name, kind, order)


@pytest.mark.parametrize("order", list(BYTES_AND_WORDS))
def test_text_and_bits_keep_the_order_of_registers(
    imported: Callable[[str], Imported], tmp_path: Path, order: str
) -> None:
    text = changed('"MSW-LE"', f'"{order}"', REQUEST).partition("    fields")[0]
    fields = """\
    fields = [
      { address=0, name="text", type="STRING", length=3 },
      { address=9, name="bit", type="BIT", bit=11 },
    ]
"""
    found = imported(text + fields)
    tags = tags_of(tmp_path)
    swapped = order in ("BADC", "DCBA")
    wire = b"".join(pair[::-1] if swapped else pair for pair in (b"PU", b"MP", "é".encode()))
    assert value_of(tags["text"], words(wire)) == "PUMPé"
    assert value_of(tags["bit"], [0x0008 if swapped else 0x0800]) is True
    assert value_of(tags["bit"], [0xF7FF if not swapped else 0xFFF7]) is False
    assert (
        "11: inputs.modbus[0].request[0].fields[0]: changed: all NULs at its end are removed, "
        "not only one; other text than UTF-8 is an error"
    ) in notes(found)


def field_of(settings: str) -> str:
    """A request with one field, in line 11."""
    before = REQUEST.partition("      { address=0")[0]
    return f'{before}      {{ address=0, name="a", {settings} }},\n    ]\n'


PLACE = "11: inputs.modbus[0].request[0].fields[0]"
BEYOND = "changed: numbers beyond {} stay as they are; Telegraf had other ones"


@pytest.mark.parametrize(
    ("settings", "note"),
    [
        ('type="INT16", scale=0.1, output="INT64"',
         f"{PLACE}.scale: changed: digits behind the point are kept; Telegraf dropped them"),
        ('type="INT16", output="UINT64"', f"{PLACE}.output: {BEYOND.format('UINT64')}"),
        ('type="UINT64", output="INT64"', f"{PLACE}.output: {BEYOND.format('INT64')}"),
        ('type="UINT16", scale=-2.0, output="UINT64"',
         f"{PLACE}.output: {BEYOND.format('UINT64')}"),
        ('type="INT64", scale=10.0, output="INT64"', f"{PLACE}.output: {BEYOND.format('INT64')}"),
        ('type="BIT", scale=2.0', f"{PLACE}.scale: left out: Telegraf ignored it for bits"),
        ('type="INT16", digits=2', f"{PLACE}.digits: left out: unknown key"),
    ],
)  # fmt: skip
def test_a_note_names_a_value_that_differs(
    imported: Callable[[str], Imported], settings: str, note: str
) -> None:
    assert note in notes(imported(field_of(settings)))


@pytest.mark.parametrize(
    "settings",
    [
        'type="INT16", scale=10.0, output="INT64"',
        'type="INT16", scale=0.1',
        'type="UINT64", scale=1.0, output="UINT64"',
    ],
)
def test_values_that_are_the_same_need_no_note(
    imported: Callable[[str], Imported], settings: str
) -> None:
    assert notes(imported(field_of(settings))) == []


def test_integers_of_the_style_register_are_not_truncated(
    imported: Callable[[str], Imported],
) -> None:
    found = imported(changed("scale=1.0", "scale=0.5"))
    assert notes(found) == [
        "14: inputs.modbus[0].input_registers[0].scale: changed: digits behind the point are "
        "kept; Telegraf dropped them"
    ]


@pytest.mark.parametrize("scale", ["10.0", "-1.0"])
def test_numbers_beyond_the_integers_of_the_style_register_have_a_note(
    imported: Callable[[str], Imported], scale: str
) -> None:
    found = imported(changed("scale=1.0", f"scale={scale}"))
    place = "14: inputs.modbus[0].input_registers[0].scale"
    assert notes(found) == [f"{place}: {BEYOND.format('INT32')}"]


@pytest.mark.parametrize("kind", ["INT8L", "INT8H", "UINT8L", "UINT8H"])
def test_a_field_of_one_byte_is_left_out(imported: Callable[[str], Imported], kind: str) -> None:
    found = imported(changed('"FIXED"', f'"{kind}"'))
    assert list(device(found)["tags"]) == ["run", "energy", "speed"]
    assert notes(found) == [
        f"10: inputs.modbus[0].holding_registers[0]: left out: no type has one byte ({kind}): "
        "read the register as uint16, or its bits"
    ]


def test_a_float32_at_one_address_is_the_fixed_number_of_older_versions(
    imported: Callable[[str], Imported],
) -> None:
    found = imported(changed('"FIXED"', '"FLOAT32"'))
    assert device(found)["tags"] == device(imported(changed('"FIXED"', '"UFIXED"')))["tags"]
    assert notes(found) == [
        "10: inputs.modbus[0].holding_registers[0].data_type: check: FLOAT32 at one address: "
        "UFIXED, as until Telegraf 1.36"
    ]


def test_text_in_half_of_each_register_is_left_out(imported: Callable[[str], Imported]) -> None:
    text = changed('"FIXED", scale=0.1', '"STRING"')
    text += '  [inputs.modbus.workarounds]\n    string_register_location = "lower"\n'
    found = imported(text)
    assert "voltage" not in device(found)["tags"]
    assert notes(found) == [
        "10: inputs.modbus[0].holding_registers[0]: left out: text in the lower byte of each "
        "register: there is no such type; read the registers as uint16[1]"
    ]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('"UFIXED"', '"FLOAT32"',
         "11: inputs.modbus[0].holding_registers[1].data_type: found FLOAT32, unsigned integers "
         "until Telegraf 1.36 and IEEE floats since, allowed: UFIXED or FLOAT32-IEEE"),
        ("[5,6]", "[6,5]",
         "11: inputs.modbus[0].holding_registers[1].address: found 6, 5, allowed: addresses that "
         "follow each other, the lowest first"),
        ("[5,6]", "[5,7]",
         "11: inputs.modbus[0].holding_registers[1].address: found 5, 7, allowed: addresses that "
         "follow each other, the lowest first"),
        ("[5,6]", "[5]",
         "11: inputs.modbus[0].holding_registers[1].byte_order: found CDAB with 1 addresses, "
         "allowed: 2 letters"),
        ("[5,6]", "[5,6,7]",
         "11: inputs.modbus[0].holding_registers[1].address: found 3 addresses, allowed with "
         "UFIXED: 1, 2 or 4"),
        ("[3,4]", "[3]",
         "14: inputs.modbus[0].input_registers[0].address: found 1 addresses, allowed with INT32: "
         "2"),
        ("[0]", "[70000]",
         "10: inputs.modbus[0].holding_registers[0].address[0]: found 70000, allowed: an address "
         "from 0 to 65535"),
        ("scale=1.0, ", "",
         "14: inputs.modbus[0].input_registers[0].scale: missing or 0, allowed: any other number; "
         "1.0 leaves the value as it is"),
        ("[3], data", "[3, 4], data",
         "8: inputs.modbus[0].coils[0].address: found 2 addresses, allowed with coils and discrete "
         "inputs: 1"),
        ('"CDAB"', '"ACBD"',
         "11: inputs.modbus[0].holding_registers[1].byte_order: found 'ACBD', allowed: AB, BA, "
         "ABCD, CDAB, BADC, DCBA, ABCDEFGH, GHEFCDAB, BADCFEHG or HGFEDCBA"),
        ('  name = "press"\n', "", "3: inputs.modbus[0].name: missing, allowed: text"),
        ("10.0.0.5:502", "10.0.0.5",
         "7: inputs.modbus[0].controller: found 'tcp://10.0.0.5', allowed: tcp://host:502, "
         "file:///dev/ttyUSB0 or COM1"),
        ("tcp://10.0.0.5:502", "udp://10.0.0.5:502",
         "7: inputs.modbus[0].controller: found 'udp://10.0.0.5:502', allowed: tcp://host:502, "
         "file:///dev/ttyUSB0 or COM1"),
        ("slave_id = 7", "slave_id = 256",
         "5: inputs.modbus[0].slave_id: found 256, allowed: a unit id from 0 to 255"),
        ('"1500ms"', '"1500"x', "not TOML"),
        ('"1500ms"', '"soon"',
         "6: inputs.modbus[0].timeout: found 'soon', allowed: a duration of up to 366 days, as in "
         "'1m30s'"),
        ("slave_id = 7", 'slave_id = 7\n  configuration_type = "auto"',
         "6: inputs.modbus[0].configuration_type: found 'auto', allowed: register, request or "
         "metric"),
        ("10.0.0.5", "${PLC_HOST:-plc}",
         "7: inputs.modbus[0].controller: found the environment variable PLC_HOST, which "
         "Telegraf replaces, allowed: its value"),
        ('name = "speed"', 'name = "$NAME"',
         "14: inputs.modbus[0].input_registers[0].name: found the environment variable NAME, "
         "which Telegraf replaces, allowed: its value"),
    ],
)  # fmt: skip
def test_what_would_be_wrong_is_refused(
    imported: Callable[[str], Imported], old: str, new: str, problem: str
) -> None:
    if problem == "not TOML":
        with pytest.raises(ConfigError, match=r"telegraf\.conf:6: not TOML: "):
            imported(changed(old, new))
        return
    assert problem in problems(imported, changed(old, new))


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ('type="FLOAT32", output="INT64"',
         f"{PLACE}.output: found INT64 with FLOAT32, allowed: FLOAT64"),
        ('type="INT16", output="STRING"',
         f"{PLACE}.output: found STRING, allowed: only with type STRING"),
        ('type="INT16", length=2', f"{PLACE}.length: found 2, allowed: only with STRING"),
        ('type="INT16", bit=2', f"{PLACE}.bit: found 2, allowed: only with BIT"),
        ('type="BIT", bit=16', f"{PLACE}.bit: found 16, allowed: a bit from 0 to 15"),
        ('type="STRING"', f"{PLACE}.length: missing, allowed: the number of registers"),
        ('type="STRING", length=65536',
         f"{PLACE}.length: found 65536, allowed: registers from 0 to 65535"),
    ],
)  # fmt: skip
def test_fields_that_the_source_refuses(
    imported: Callable[[str], Imported], settings: str, problem: str
) -> None:
    assert problem in problems(imported, field_of(settings))


def test_a_reserved_unit_id_of_a_serial_line_is_kept(
    imported: Callable[[str], Imported],
) -> None:
    found = imported(changed("slave_id = 3", "slave_id = 248", SERIAL))
    assert device(found)["unit"] == 248


def test_serial_lines_have_no_broadcasts(imported: Callable[[str], Imported]) -> None:
    for number in ("  slave_id = 0\n", ""):
        found = problems(imported, changed("  slave_id = 3\n", number, SERIAL))
        message = "found slave_id 0, allowed on a serial line: 1 to 255"
        assert found == [f"1: inputs.modbus[0]: {message}"]
    assert problems(imported, changed("data_bits = 8", "data_bits = 7", SERIAL)) == [
        "7: inputs.modbus[0].data_bits: found 7, allowed: 8 with transmission_mode RTU"
    ]


def test_a_global_tag_may_be_named_tags(imported: Callable[[str], Imported]) -> None:
    text = REGISTER + '[global_tags]\n  tags = "$SITE"\n' + OUTPUT
    assert problems(imported, text) == [
        "17: global_tags.tags: found the environment variable SITE, which Telegraf replaces, "
        "allowed: its value"
    ]


def test_an_output_for_influxdb(imported: Callable[[str], Imported]) -> None:
    tags = '[global_tags]\n  site = "north"\n  "a b" = "x"\n  device = "y"\n  disk = "C:\\\\"\n'
    found = imported(REGISTER + tags + OUTPUT)
    assert found.data["outputs"] == {
        "influx": {
            "type": "influx",
            "publish": "scan",
            "token_file": "token.txt",
            "url": "http://10.0.0.9:8086",
            "org": "plant",
            "bucket": "modbus",
            "tags": {"site": "north"},
        }
    }
    assert notes(found) == [
        "18: global_tags.'a b': left out: a tag of an output has 1 to 64 letters, digits, '_', '.' "
        "and '-'",
        "19: global_tags.device: left out: the tag device is the name of the device",
        "20: global_tags.disk: left out: the value of a tag of an output is text without control "
        'characters, and without a backslash at its end or before a blank, comma, =, " or \\',
        "21: outputs.influxdb_v2[0]: changed: points have the tag device in place of name, "
        "slave_id, type and host: change the queries",
        "23: outputs.influxdb_v2[0].token: check: put the token into token.txt, next to the new "
        "configuration",
    ]


def test_a_token_is_never_shown(imported: Callable[[str], Imported]) -> None:
    found = imported(REGISTER + OUTPUT)
    assert "s3cret" not in found.to_yaml()
    text = changed('"s3cret-token"', '"${INFLUX_TOKEN}"', REGISTER + OUTPUT)
    assert "INFLUX_TOKEN" not in imported(text).to_yaml()
    wrong = changed('"s3cret-token"', "73313373", REGISTER + OUTPUT)
    assert problems(imported, wrong) == [
        "18: outputs.influxdb_v2[0].token: not text (value hidden), allowed: text in quotes"
    ]
    text = 'urls = "http://me:s3cret@10.0.0.9"'
    wrong = changed('urls = ["http://10.0.0.9:8086"]', text, REGISTER + OUTPUT)
    assert problems(imported, wrong) == [
        "17: outputs.influxdb_v2[0].urls: found text of 25 characters, allowed: a list of URLs"
    ]
    user = imported(changed("http://10", "http://me:s3cret@10", REGISTER + OUTPUT))
    assert "s3cret" not in user.to_yaml()
    assert "outputs" not in user.data
    assert any(
        "16: outputs.influxdb_v2[0]: left out: found a user in the URL" in each
        for each in notes(user)
    )


@pytest.mark.parametrize(
    ("old", "new", "key", "value"),
    [
        ('["http://10.0.0.9:8086"]', '["http://a:8086", "http://b:8086"]', "url", "http://a:8086"),
        ('  urls = ["http://10.0.0.9:8086"]\n', "", "url", "http://localhost:8086"),
        ("10.0.0.9:8086", "a/influx/", "url",
         "http://a:80/influx/api/v2/write?org=plant&bucket=modbus&precision=ns"),
        ("  bucket", '  timeout = "20s"\n  bucket', "timeout", 20),
        ("  bucket", '  content_encoding = "identity"\n  bucket', "gzip", False),
        ('  token = "s3cret-token"\n', "", "token_file", None),
    ],
)  # fmt: skip
def test_settings_of_the_output(
    imported: Callable[[str], Imported], old: str, new: str, key: str, value: object
) -> None:
    found = imported(REGISTER + changed(old, new, OUTPUT))
    assert found.data["outputs"]["influx"].get(key) == value


def test_a_type_that_influxdb_would_refuse_is_named(imported: Callable[[str], Imported]) -> None:
    """A field keeps its type in a measurement: an integer after a float is refused."""
    text = changed("scale=0.1", "scale=1.0", REGISTER + OUTPUT)
    text = changed(', data_type = "BOOL"', "", text)
    assert (
        "16: outputs.influxdb_v2[0]: check: run, voltage have another type than in Telegraf "
        "(bits are booleans, whole numbers integers, or floats if some are beyond int64); InfluxDB "
        "refuses them in the same measurement of a bucket: use another bucket"
    ) in notes(imported(text))


@pytest.mark.parametrize(
    ("kind", "scale", "was_float"),
    [
        ("INT64", 1, False),
        ("INT64", -1, False),
        ("INT64", 10, False),
        ("UINT64", 1, False),
        ("INT32", 1000, False),
        ("INT16", 0.1, False),
        ("FIXED", 1, True),
        ("FIXED", 10, True),
        ("FIXED", 0.1, True),
    ],
)
def test_the_named_fields_are_those_of_another_type_in_line_protocol(
    imported: Callable[[str], Imported], kind: str, scale: float, was_float: bool
) -> None:
    width = {"INT16": 1, "INT32": 2}.get(kind, 4)
    text = f"""\
[[inputs.modbus]]
  name = "line"
  controller = "tcp://10.0.0.5:502"
  [[inputs.modbus.holding_registers]]
    name = "count"
    byte_order = "{"ABCDEFGH"[: 2 * width]}"
    data_type = "{kind}"
    scale = {scale}
    address = {list(range(width))}
"""
    found = imported(text + OUTPUT)
    is_named = any("count have another type" in each for each in notes(found))
    [(name, settings)] = device(found)["tags"].items()
    tag = Tag(name, **settings)
    written = lines([Reading("line", tag, tag.value(5), 0)], "modbus", {}).split()[1]
    assert is_named == (was_float == written.endswith(b"i"))


def test_measurements(imported: Callable[[str], Imported]) -> None:
    metric = METRIC.replace("    slave_id", '    measurement = "grid"\n    slave_id')
    found = imported(metric + OUTPUT)
    assert found.data["outputs"]["influx"]["measurement"] == "grid"
    prefixed = metric.replace("  name =", '  name_prefix = "plant_"\n  name =', 1)
    found = imported(prefixed + OUTPUT)
    assert found.data["outputs"]["influx"]["measurement"] == "plant_grid"
    found = imported(metric + REGISTER + OUTPUT)
    first, second = found.data["outputs"].values()
    assert (first["measurement"], first["devices"]) == ("grid", ["meter"])
    assert ("measurement" in second, second["devices"]) == (False, ["press"])
    assert {**first, "measurement": "", "devices": []} == {
        **second,
        "measurement": "",
        "devices": [],
    }
    place = "7: inputs.modbus[0].metric[0].measurement"
    found = imported(metric.replace("grid", "#1") + OUTPUT)
    assert "measurement" not in found.data["outputs"]["influx"]
    form = "a measurement is text that does not begin with #, without control characters, and "
    form += 'without a backslash at its end or before a blank, comma, =, " or \\'
    assert f"{place}: left out: {form}" in notes(found)
    none = "no output is converted; see measurement of outputs"
    assert f"{place}: left out: {none}" in notes(imported(metric))


SERIES = """\
[[inputs.modbus]]
  name = "meter"
  controller = "tcp://10.0.0.5:502"
  timeout = "1s"
  configuration_type = "metric"
  [[inputs.modbus.metric]]
    measurement = "power"
    fields = [
      { address=0, name="voltage", type="INT16" }, { address=3, name="current", type="INT16" },
    ]
    tags = { phase = "L1" }
  [[inputs.modbus.metric]]
    measurement = "power"
    fields = [
      { address=1, name="voltage", type="INT16" }, { address=4, name="current", type="INT16" },
    ]
    tags = { phase = "L2" }
  [[inputs.modbus.metric]]
    measurement = "energy"
    fields = [{ address=2, name="total", type="INT16" }]
"""


def test_fields_with_other_tags_or_measurements_are_a_device_of_their_own(
    imported: Callable[[str], Imported],
) -> None:
    """An output has one measurement, and the same tags for all of its devices."""
    found = imported(SERIES + OUTPUT)
    read = {
        name: {key: tag["address"] for key, tag in each["tags"].items()}
        for name, each in found.data["devices"].items()
    }
    assert read == {
        "meter-power-L1": {"voltage": 0, "current": 3},
        "meter-power-L2": {"voltage": 1, "current": 4},
        "meter-energy": {"total": 2},
    }
    gaps = [each["max_gap"] for each in found.data["devices"].values()]
    assert gaps == [2, 2, 0], "what was one request is one for each device"
    outputs = found.data["outputs"].values()
    assert {each["measurement"]: each["devices"] for each in outputs} == {
        "power": ["meter-power-L1", "meter-power-L2"],
        "energy": ["meter-energy"],
    }
    message = "left out: add an output with these tags, and list {} in its devices"
    assert [each for each in notes(found) if "these tags" in each] == [
        f"11: inputs.modbus[0].metric[0].tags: {message.format('meter-power-L1')}",
        f"17: inputs.modbus[0].metric[1].tags: {message.format('meter-power-L2')}",
    ]


def test_tags_that_all_fields_of_a_unit_have_are_in_no_name(
    imported: Callable[[str], Imported],
) -> None:
    text = SERIES.partition('  [[inputs.modbus.metric]]\n    measurement = "energy"')[0]
    for phase in ("L1", "L2"):
        text = changed(f'phase = "{phase}"', f'phase = "{phase}", site = "north"', text)
    assert list(imported(text).data["devices"]) == ["meter-L1", "meter-L2"]
    only = text.rpartition("  [[inputs.modbus.metric]]\n")[0]
    assert list(imported(only).data["devices"]) == ["meter"]


def test_nothing_is_dropped_silently(imported: Callable[[str], Imported]) -> None:
    others = """\
[[inputs.cpu]]
  percpu = true
[[outputs.file]]
  files = ["stdout"]
[[processors.rename]]
  order = 1
[global_tags]
  site = "north"
"""
    text = changed(
        "  slave_id", '  alias = "$ALIAS"\n  fieldpass = ["x"]\n  colour = 7\n  slave_id'
    )
    text = changed('  interval = "10s"\n', '  interval = "10s"\n  flush_interval = "5s"\n', text)
    text += '  [inputs.modbus.tags]\n    hall = "${HALL}"\n'
    assert notes(imported(text + others)) == [
        "3: agent.flush_interval: left out: values are sent when they are read",
        "6: inputs.modbus[0].alias: left out: a device has one name",
        "7: inputs.modbus[0].fieldpass: left out: nothing is filtered: all tags are published",
        "8: inputs.modbus[0].colour: left out: unknown key",
        "20: inputs.modbus[0].tags: left out: add an output with these tags, and list the devices "
        "of this input in its devices",
        "22: inputs.cpu: left out: not a Modbus input",
        "24: outputs.file: left out: add an output of type file, with format: influx for line "
        "protocol",
        "26: processors: left out: values are published as they are read",
        "28: global_tags: left out: no output is converted; see tags of outputs",
    ]


def test_keys_of_other_styles_are_ignored(imported: Callable[[str], Imported]) -> None:
    text = REQUEST.replace("  timeout", "  slave_id = 9\n  timeout")
    assert notes(imported(text)) == [
        "4: inputs.modbus[0].slave_id: left out: Telegraf ignored it with configuration_type "
        "request"
    ]


def test_gaps_are_those_of_the_optimization(imported: Callable[[str], Imported]) -> None:
    insert = '    optimization = "max_insert"\n    optimization_max_register_fill = 20\n'
    text = REQUEST.replace('    byte_order = "MSW-LE"\n', f'    byte_order = "MSW-LE"\n{insert}')
    last = '{ register="input", address=%d, name="ready"'
    for address, gap in ((24, 23), (25, 0)):
        far = changed("address=4,", f"address={address},", text)
        assert imported(far).data["devices"]["line-1"]["max_gap"] == gap
    text = METRIC.replace("  timeout", '  optimization = "max_insert"\n  timeout')
    for address, gap in ((60, 50), (61, 0)):
        far = changed('{ address=20, name="ready"', last % address, text)
        assert device(imported(far))["max_gap"] == gap


def test_requests_are_no_longer_than_those_of_the_source(
    imported: Callable[[str], Imported],
) -> None:
    """A device may answer longer ones with exception 04, or not at all."""
    more = """\
  [[inputs.modbus.request]]
    slave_id = 1
    fields = [ { address=%d, name="a", type="INT64" }, { address=%d, name="b", type="INT16" } ]
"""
    line = imported(REQUEST + more % (6, 10)).data["devices"]["line-1"]
    assert (line["max_registers"], line["max_gap"], "max_bits" in line) == (6, 3, False)
    for apart in (more % (7, 11), more % (66, 70)):
        line = imported(REQUEST + apart).data["devices"]["line-1"]
        assert "max_registers" not in line, "the source joined all that follows another"
    fields = ",".join(f'{{address={each}, name="a{each}", type="INT16"}}' for each in range(6, 260))
    long = f"  [[inputs.modbus.request]]\n    slave_id = 1\n    fields = [{fields}]\n"
    assert "max_registers" not in imported(REQUEST + long).data["devices"]["line-1"]
    given = "  [inputs.modbus.workarounds]\n    max_word_registers_per_request = 20\n"
    line = imported(REQUEST + more % (6, 10) + given).data["devices"]["line-1"]
    assert line["max_registers"] == 20
    found = imported(REQUEST + more % (6, 10) + given.replace("20", "1"))
    assert found.data["devices"]["line-1"]["max_registers"] == 4
    assert any(
        "max_word_registers_per_request: changed: raised to 4" in each for each in notes(found)
    )
    assert "max_registers" not in device(imported(changed("address=20,", "address=10,", METRIC)))


@pytest.mark.parametrize("optimization", ["none", "max_insert", "aggressive"])
def test_with_one_request_per_field_none_is_longer_than_a_field(
    imported: Callable[[str], Imported], optimization: str
) -> None:
    fields = ",".join(f'{{address={each}, name="a{each}", type="INT16"}}' for each in range(3))
    text = f"""\
  [[inputs.modbus.request]]
    slave_id = 1
    optimization = "{optimization}"
    fields = [{fields}]
  [inputs.modbus.workarounds]
    one_request_per_field = true
    max_word_registers_per_request = 20
"""
    found = imported(REQUEST[: REQUEST.index("  [[")] + text)
    assert (device(found)["max_registers"], device(found)["max_gap"]) == (1, 0)
    assert notes(found) == [
        "11: inputs.modbus[0].workarounds.one_request_per_field: changed: no request is longer "
        "than the longest field; shorter ones may share one",
        "12: inputs.modbus[0].workarounds.max_word_registers_per_request: left out: "
        "one_request_per_field makes requests as short as fields",
    ]


def test_a_single_table_is_an_input_too(imported: Callable[[str], Imported]) -> None:
    assert imported(changed("[[inputs.modbus]]", "[inputs.modbus]")).data == imported(REGISTER).data


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "1: inputs: no inputs.modbus with a field that can be converted, allowed: at least "
         "one"),
        ("[[inputs.cpu]]\n", "1: inputs: no inputs.modbus with a field that can be converted, "
         "allowed: at least one"),
        ("[inputs]\nmodbus = 7\n", "2: inputs.modbus: found 7, allowed: a mapping"),
    ],
)  # fmt: skip
def test_a_file_without_modbus_is_refused(
    imported: Callable[[str], Imported], text: str, problem: str
) -> None:
    assert problem in problems(imported, text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[agent]\ninterval = 10s\n", "telegraf.conf:2: not TOML: "),
        ("[agent]\nport = ${PORT}\n", "replace environment variables by their values"),
        ("[agent\n", "telegraf.conf:1: not TOML: "),
        ("a = " + "[" * 5000, "not TOML: nested too deeply"),
    ],
)
def test_a_syntax_error_has_its_line(
    imported: Callable[[str], Imported], text: str, message: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        imported(text)
    assert message in str(refused.value)

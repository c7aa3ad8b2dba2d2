"""What wrong devices are told, and what has no effect."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from holdfast.client.tolerance import Tolerance
from holdfast.client.url import NetworkTarget, Tls
from support.config_folder import Folder

if TYPE_CHECKING:
    from pathlib import Path

HEAD = """\
memories:
  plant: {coils: 8, input_registers: {start: 100, size: 100}, holding_registers: 65536}
"""
METER = """\
devices:
  meter:
    url: tcp://10.0.0.9
    unit: 1
    interval: 1
    reads:
      - area: input_registers
        address: 10
        count: 20
        into: {memory: plant, area: input_registers, address: 100}
    status: {memory: plant, area: input_registers, slot: 4}
"""
ANOTHER = """\
  other:
    url: tcp://10.0.0.9
    unit: 2
    interval: 1
    reads: [{area: coils, address: 0, count: 8, into: {memory: plant, area: coils, address: 0}}]
"""
URLS = (
    "tcp://host:502, tls://host:802?ca=ca.pem, udp://host:502, rtu+tcp://host:502, "
    "ascii+tcp://host:502, rtu+udp://host:502, rtu:///dev/ttyUSB0?baud=19200&parity=even, ascii:///dev/ttyUSB0"
)
RECEIVER = "raw://10.0.2.9:9000 or raw+tls://10.0.2.9:9000?ca=ca.pem"
READS = "  reads: a list"
WORD = "an integer from 0 to 65535"
SERIAL = "a unit id from 1 to 255; 0 is the broadcast"
OWN = "allowed: addresses without overlap"


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


def changed(old: str, new: str, text: str = METER) -> str:
    assert text.count(old) == 1, old
    return HEAD + text.replace(old, new)


def test_files_of_a_url_are_relative_to_the_folder_of_the_configuration(folder: Folder) -> None:
    (folder.path / "a b.pem").write_text("")
    url = "tls://plc:1802?ca=a%20b.pem&name=plc7"

    config = folder.config(changed("tcp://10.0.0.9", url))

    path = f"{folder.path}/a%20b.pem"
    assert config.devices["meter"].url == f"tls://plc:1802?ca={path}&name=plc7"
    assert config.devices["meter"].target == NetworkTarget(
        "tls", "plc", 1802, Tls(ca=f"{folder.path}/a b.pem", name="plc7")
    )
    assert folder.config(config.dump()) == config


def told(folder: Folder, text: str) -> list[str]:
    """The problems, without the name of the file and of the device."""
    return [
        problem.removeprefix("p.yaml:").replace(" devices.meter.", " ", 1)
        for problem in folder.problems(text)
    ]


def test_a_right_device_is_right(folder: Folder) -> None:
    assert folder.warnings(HEAD + METER + ANOTHER) == []


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("    url: tcp://10.0.0.9\n", "", "4: url: missing, allowed: text, as in "
         "tcp://10.0.0.9:502 or rtu:///dev/ttyUSB0?baud=9600"),
        ("url: tcp://10.0.0.9", "url: 7", f"5: url: found 7, allowed: {URLS}"),
        ("tcp://10.0.0.9", "http://a", "5: url: 'http://a' is not the URL of a device, allowed: "
         f"{URLS}"),
        ("tcp://10.0.0.9", "tcp://a:0", "5: url: 'tcp://a:0': port 0, allowed: 1 to 65535"),
        ("tcp://10.0.0.9", "tcp://10.0.0.09", "5: url: 'tcp://10.0.0.09': the host is '10.0.0.09', "
         "allowed: a host name, an IPv4 address of four numbers without leading zeros, or an IPv6 "
         "address in brackets"),
        ("tcp://10.0.0.9", "tls://plc?ca=none.pem",
         "5: url: found ca='none.pem', which can't be read: No such file or directory"),
        ("tcp://10.0.0.9", "tls://plc?cert=p.yaml&key=/",
         "5: url: found key='/', which can't be read: Is a directory"),
        ("tcp://10.0.0.9", "tls://plc?cert=p.yaml",
         "5: url: 'tls://plc?cert=p.yaml': cert without key: give both, or neither"),
        ("tcp://10.0.0.9", "rtu:///dev/a%00",
         "5: url: found 'rtu:///dev/a%00', allowed: a URL without NUL"),
        ("unit: 1", "unit: 256", "6: unit: found 256, allowed: a unit id from 0 to 255"),
        ("    interval: 1\n", "",
         "4: interval: missing, allowed: a number from 0.01 to 31622400 seconds"),
        ("interval: 1", "interval: 500ms",
         "7: interval: found '500ms', allowed: a number from 0.01 to 31622400 seconds; did you "
         "mean 0.5?"),
        ("interval: 1", "interval: 0.009",
         "7: interval: found 0.009, allowed: a number from 0.01 to 31622400 seconds"),
        ("interval: 1", "interval: .nan",
         "7: interval: found nan, allowed: a number from 0.01 to 31622400 seconds"),
        ("    reads", "    timeout: 0\n    reads",
         "8: timeout: found 0, allowed: a number from 0.001 to 31622400 seconds"),
        ("    reads", "    enabled: 1\n    reads",
         "8: enabled: found 1, allowed: true or false"),
        ("    reads", "    max_gap: -1\n    reads",
         f"8: max_gap: found -1, allowed: {WORD} or auto"),
        ("    reads", "    max_registers: 126\n    reads",
         "8: max_registers: found 126, allowed: an integer from 1 to 125"),
        ("    reads", "    max_bits: 0\n    reads",
         "8: max_bits: found 0, allowed: an integer from 1 to 2000"),
        ("    reads", "    in_flight: 0\n    reads",
         "8: in_flight: found 0, allowed: an integer from 1 to 1024 or auto"),
        ("    reads", "    in_flight: many\n    reads",
         "8: in_flight: found 'many', allowed: an integer from 1 to 1024 or auto"),
        ("    reads", "    tolerance: {pause: 61}\n    reads",
         "8: tolerance.pause: found 61, allowed: a number from 0 to 60 seconds"),
        ("    reads", "    tolerance: {retries: 11}\n    reads",
         "8: tolerance.retries: found 11, allowed: an integer from 0 to 10"),
        ("    reads", "    tolerance: {accept_unit: all}\n    reads",
         "8: tolerance.accept_unit: found 'all', allowed: an integer from 0 to 255 or any"),
        ("    reads", "    tolerance: {close_after: 65536}\n    reads",
         "8: tolerance.close_after: found 65536, allowed: an integer from 0 to 65535"),
        ("    reads", "    tolerance: {padding: true}\n    reads",
         "8: tolerance.padding: unknown key, allowed: accept_unit, pad, echo, pause, "
         "pause_after_connect, retries, retry_busy, close_after, reconnect, write_multiple; "
         "did you mean 'pad'?"),
        ("    reads", "    tolerance: {echo: true}\n    reads",
         "8: tolerance.echo: found true, allowed with RTU and ASCII frames only"),
        ("url: tcp://10.0.0.9\n", "url: tcp://10.0.0.9?pad=1\n    tolerance: {retries: 1}\n",
         "6: tolerance: found together with options of the URL, allowed: only one of them"),
        ("    reads", "    cost: {per_request: 1, per_register: 1}\n    reads",
         "8: cost: removed, allowed: max_gap: auto, which measures the device, or max_gap: N with "
         "N = per_request / per_register"),
        ("    reads", "    forbidden: [{area: coils, start: 1}]\n    reads",
         "8: forbidden[0].end: missing, allowed: an integer from 0 to 65535"),
        ("    reads", "    forbidden: [{area: coils, start: 1, end: 1, count: 1}]\n    reads",
         "8: forbidden[0].count: removed, allowed: end, the last address: start + count - 1"),
        ("    reads", "    readable: [{area: coils, start: 1, end: 1, count: 1}]\n    reads",
         "8: readable[0].count: removed, allowed: end, the last address: start + count - 1"),
        ("    reads", "    readable: [{area: coils, start: 2, end: 1}]\n    reads",
         "8: readable[0].end: found 1, allowed: the last address, 2 or more"),
        ("    reads", "    readable: [{area: coils, start: 65535, end: 65536}]\n    reads",
         "8: readable[0].end: found 65536, allowed: an integer from 0 to 65535"),
        ("    reads", "    forbidden: [{area: input_registers, start: 29, end: 29}]\n    reads",
         "10: reads[0]: found 10 to 29, which overlaps 29 to 29 of forbidden[0] in line 8, "
         "allowed: other addresses"),
        ("    reads", "    forbidden: [{area: input_registers, start: 0, end: 10}]\n    reads",
         "10: reads[0]: found 10 to 29, which overlaps 0 to 10 of forbidden[0] in line 8, "
         "allowed: other addresses"),
        ("area: input_registers\n", "area: registers\n", "9: reads[0].area: found 'registers', "
         "allowed: coils, discrete_inputs, holding_registers or input_registers; did you mean "
         "'input_registers'?"),
        ("address: 10\n", "address: 65536\n",
         f"10: reads[0].address: found 65536, allowed: {WORD}"),
        ("count: 20", "count: 0",
         "11: reads[0].count: found 0, allowed: an integer from 1 to 65536"),
        ("address: 10\n", "address: 65517\n",
         "11: reads[0].count: found address 65517 and count 20, allowed: a sum up to 65536"),
        ("{memory: plant, area: input_registers, address: 100}", "{}",
         "12: reads[0].into.memory: missing, allowed: text"),
        ("into: {memory: plant,", "into: {memory: plan,",
         "12: reads[0].into.memory: found 'plan', allowed: plant; did you mean 'plant'?"),
        ("area: input_registers, address", "area: coils, address", "12: reads[0].into.area: found "
         "'coils', allowed for input_registers: holding_registers or input_registers"),
        ("address: 100}", "address: 181}", "12: reads[0].into.address: found 20 registers from "
         "181, "
         "allowed in input_registers of plant: 100 to 199"),
        ("address: 100}", "address: 99}", "12: reads[0].into.address: found 20 registers from 99, "
         "allowed in input_registers of plant: 100 to 199"),
        ("slot: 4", "slot: 3", "13: status.slot: found 3, which covers addresses 90 to 119, "
         "allowed in "
         "input_registers of plant: 100 to 199"),
        ("slot: 4", "slot: 6", "13: status.slot: found 6, which covers addresses 180 to 209, "
         "allowed in input_registers of plant: 100 to 199"),
        ("slot: 4", "slot: 2184",
         "13: status.slot: found 2184, allowed: an integer from 0 to 2183"),
        ("area: input_registers, slot", "area: coils, slot",
         "13: status.area: found 'coils', "
         "allowed: holding_registers or input_registers"),
        ("    status: {memory: plant", "    status: {memory: other",
         "13: status.memory: found 'other', allowed: plant"),
        ("    status", "    forward: [{url: 'raw://a', unit: 1}]\n    status",
         f"13: forward[0].url: found 'raw://a', allowed: {RECEIVER}"),
        ("    status", "    forward: [{url: 'tcp://a:1', unit: 1}]\n    status",
         f"13: forward[0].url: found 'tcp://a:1', allowed: {RECEIVER}"),
        ("    status", "    forward: [{url: 'raw://a:1/', unit: 1}]\n    status",
         f"13: forward[0].url: found 'raw://a:1/', allowed: {RECEIVER}"),
        ("    status", "    forward: [{url: 'raw://u@a:1', unit: 1}]\n    status",
         f"13: forward[0].url: found 'raw://***@a:1', allowed: {RECEIVER}"),
        ("    status", "    forward: [{url: 'raw://a:0', unit: 1}]\n    status",
         "13: forward[0].url: 'raw://a:0': port 0, allowed: 1 to 65535"),
        ("    status", "    forward: [{url: 'raw://a:1'}]\n    status",
         f"13: forward[0].unit: missing with format v1, allowed: {WORD}"),
        ("    status", "    forward: [{url: 'raw://a:1', format: crc}]\n    status",
         f"13: forward[0].memory_id: missing with format crc, allowed: {WORD}"),
        ("    status", "    forward: [{url: 'raw://a:1', unit: 1, memory_id: 1}]\n    status",
         "13: forward[0].memory_id: found with format v1, allowed: unit"),
        ("    status", "    forward: [{url: 'raw://a:1', unit: 1, status: {area: coils, slot: 0, "
         "unit: 2}}]\n    status",
         "13: forward[0].status.area: found 'coils', allowed: holding_registers or "
         "input_registers"),
        ("    status", "    forward: [{url: 'raw://a:1', unit: 1, status: {area: input_registers, "
         "slot: 0}}]\n    status",
         f"13: forward[0].status.unit: missing with format v1, allowed: {WORD}"),
        ("    status", "    forward: [{url: 'raw://a:1', unit: 1, status: {area: input_registers, "
         "slot: 0, unit: 1, memory_id: 2}}]\n    status",
         "13: forward[0].status.memory_id: found with format v1, allowed: unit"),
        ("    status", "    forward: [{url: 'raw://a:1', unit: 1, status: {area: input_registers, "
         "slot: 2184, unit: 1}}]\n    status",
         "13: forward[0].status.slot: found 2184, allowed: an integer from 0 to 2183"),
        ("    status", "    forward: [{url: 'raw://a:1', unit: 1, offsets: "
         "{input_registers: 65417}}]\n    status",
         "13: forward[0].offsets.input_registers: found 65417, which moves 100 to 119 "
         "beyond 65535, allowed: 0 to 65416"),
        ("    status", "    forward: [{url: 'raw://a:1', unit: 1, offsets: "
         "{relays: 1}}]\n    status",
         "13: forward[0].offsets.relays: unknown key, allowed: coils, discrete_inputs, "
         "holding_registers, input_registers"),
        ("    status", "    retry: {first: 0}\n    status",
         "13: retry.first: found 0, allowed: a number from 0.001 to 31622400 seconds"),
        ("    status", "    retry: {most: 0.5}\n    status",
         "13: retry.first: found 1, allowed: up to most, which is 0.5"),
        ("slot: 4}", "slot: 4, name: 'a name of 17 chars'}",
         "13: status.name: found 'a name of 17 chars', "
         "allowed: up to 16 printable ASCII characters"),
        ("    status", "    forward: [{url: 'raw://a:1', unit: 1, crc: none}]\n    status",
         "13: forward[0].crc: found with format v1, allowed: only with format crc"),
    ],
)  # fmt: skip
def test_a_device_is_checked(folder: Folder, old: str, new: str, problem: str) -> None:
    assert problem in told(folder, changed(old, new))


SHARED = HEAD + METER + ANOTHER


@pytest.mark.parametrize(
    ("changes", "differs"),
    [
        ({"    unit: 2": "    unit: 2\n    in_flight: 2"},
         "17: devices.other.in_flight: found another in_flight"),
        ({"    unit: 1": "    unit: 1\n    in_flight: auto"},
         "16: devices.other.url: found another in_flight"),
        ({"    unit: 2": "    unit: 2\n    tolerance: {pad: true}"},
         "17: devices.other.tolerance: found another tolerance"),
        ({"    unit: 1": "    unit: 1\n    tolerance: {pad: true}"},
         "16: devices.other.url: found another tolerance"),
        ({"    unit: 2": "    unit: 2\n    retry: {first: 2}"},
         "17: devices.other.retry: found another retry"),
        ({"    unit: 1": "    unit: 1\n    retry: {first: 2}"},
         "16: devices.other.url: found another retry"),
        ({"tcp://10.0.0.9\n    unit: 2": "tcp://10.0.0.9?retries=1\n    unit: 2"},
         "15: devices.other.url: found another tolerance"),
    ],
)  # fmt: skip
def test_devices_at_one_address_have_the_same_settings_of_their_connection(
    folder: Folder, changes: dict[str, str], differs: str
) -> None:
    text = SHARED
    for old, new in changes.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)

    [problem] = folder.problems(text)

    assert problem.startswith(f"p.yaml:{differs} than ")
    assert problem.endswith(" has at this address, allowed: the same")
    other = text.replace("  other:\n    url: tcp://10.0.0.9", "  other:\n    url: udp://10.0.0.9")
    assert folder.config(other)


def test_a_tolerance_is_that_of_the_url_or_of_the_block(folder: Folder) -> None:
    options = folder.config(changed("10.0.0.9", "10.0.0.9?pad=1&accept_unit=any&pause=0.5"))
    block = folder.config(
        changed("    reads", "    tolerance: {pad: true, accept_unit: any, pause: 0.5}\n    reads")
    )

    expected = Tolerance(pad=True, accept_unit="any", pause=0.5)
    assert options.devices["meter"].target.tolerance == expected
    assert block.devices["meter"].target.tolerance == expected
    for config in (options, block):
        assert folder.config(config.dump()) == config


def test_devices_of_one_line_have_the_same_tolerance(folder: Folder) -> None:
    text = SHARED.replace("tcp://10.0.0.9", "rtu:///dev/line")
    assert folder.config(text)
    assert folder.problems(text.replace("unit: 2", "unit: 2\n    tolerance: {echo: true}")) == [
        "p.yaml:15: devices.other.url: found line settings that differ from those of devices.meter "
        "in line 4, allowed: the same settings"
    ]


def test_an_area_that_the_memory_lacks_is_told(folder: Folder) -> None:
    text = HEAD + METER + ANOTHER.replace("plant, area: coils", "plant, area: discrete_inputs")
    assert folder.problems(text) == [
        "p.yaml:18: devices.other.reads[0].into.area: found 'discrete_inputs', an area that plant "
        "does not have, allowed: coils, holding_registers, input_registers"
    ]


def test_a_read_of_a_whole_area_is_not_forwarded(folder: Folder) -> None:
    read = "{area: holding_registers, address: 0, count: 65536}"
    forward = "forward: [{url: 'raw://a:1', unit: 1}]"
    text = f"devices: {{a: {{url: tcp://a, unit: 1, interval: 1, reads: [{read}], {forward}}}}}\n"
    assert folder.problems(HEAD + text) == [
        "p.yaml:3: devices.a.reads[0].count: found 65536, allowed with forward: up to 65535, "
        "the limit of one packet"
    ]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (HEAD + METER + ANOTHER.replace(
            "{memory: plant, area: coils, address: 0}",
            "{memory: plant, area: coils, address: 0}}, {area: input_registers, address: 0, "
            "count: 2, into: {memory: plant, area: input_registers, address: 118}"),
         "p.yaml:18: devices.other.reads[1].into: found input_registers 118 to 119 of plant, which "
         f"overlaps 100 to 119 of devices.meter.reads[0].into in line 12, {OWN}"),
        (HEAD + METER.replace("address: 100}", "address: 140}"),
         "p.yaml:13: devices.meter.status: found input_registers 120 to 149 of plant, which "
         f"overlaps 140 to 159 of devices.meter.reads[0].into in line 12, {OWN}"),
        (HEAD + METER + ANOTHER + "    status: {memory: plant, area: input_registers, slot: 4}\n",
         "p.yaml:19: devices.other.status: found input_registers 120 to 149 of plant, which "
         f"overlaps 120 to 149 of devices.meter.status in line 13, {OWN}"),
    ],
)  # fmt: skip
def test_no_address_is_written_by_two(folder: Folder, text: str, problem: str) -> None:
    assert folder.problems(text) == [problem]


def test_every_overlap_in_a_long_range_is_told(folder: Folder) -> None:
    reads = [(0, 1000), (10, 5), (900, 50), (999, 1), (1000, 1)]
    into = "into: {{memory: plant, area: holding_registers, address: {}}}"
    written = ", ".join(
        f"{{area: input_registers, address: 0, count: {count}, {into.format(address)}}}"
        for address, count in reads
    )
    text = f"devices: {{a: {{url: tcp://a, unit: 1, interval: 1, reads: [{written}]}}}}\n"
    found = [problem.split(": ")[1] for problem in folder.problems(HEAD + text)]
    assert found == [f"devices.a.reads[{index}].into" for index in (1, 2, 3)]


@pytest.mark.parametrize("scheme", ["rtu", "ascii"])
def test_a_device_of_a_serial_line_is_not_the_broadcast(folder: Folder, scheme: str) -> None:
    text = changed("tcp://10.0.0.9", f"{scheme}:///dev/ttyX").replace("unit: 1", "unit: 0")
    assert told(folder, text) == [f"6: unit: found 0, allowed on a serial line: {SERIAL}"]


@pytest.mark.parametrize("unit", [248, 255])
@pytest.mark.parametrize("scheme", ["rtu", "ascii"])
def test_a_device_of_a_serial_line_may_have_a_reserved_unit_id(
    folder: Folder, unit: int, scheme: str
) -> None:
    """Some do: 248 is the general address of common energy meters."""
    text = changed("tcp://10.0.0.9", f"{scheme}:///dev/ttyX").replace("unit: 1", f"unit: {unit}")
    assert folder.config(text).devices["meter"].unit == unit


def test_a_serial_line_is_driven_in_one_way(folder: Folder) -> None:
    one, other = "'rtu:///dev/ttyX?baud=9600'", "'rtu:///dev/ttyX'"
    text = changed("tcp://10.0.0.9", one) + ANOTHER.replace("tcp://10.0.0.9", other)
    assert folder.problems(text) == [
        "p.yaml:15: devices.other.url: found line settings that differ from those of "
        "devices.meter in "
        "line 4, allowed: the same settings"
    ]


def test_a_serial_line_has_one_name(folder: Folder) -> None:
    """Links of /dev/serial may name different lines after adapters were plugged in again."""
    one, other = "'rtu:///dev/ttyX'", "'rtu:///dev/../dev/ttyX'"
    text = changed("tcp://10.0.0.9", one) + ANOTHER.replace("tcp://10.0.0.9", other)
    assert folder.problems(text) == [
        "p.yaml:15: devices.other.url: found another name of the serial line of devices.meter in "
        "line 4, allowed: '/dev/ttyX'"
    ]


def test_a_serial_line_is_not_served_and_polled(folder: Folder) -> None:
    listener = (
        "listeners: {line: {type: modbus-rtu, serial: {device: /dev/ttyX}, "
        "rules: [{units: {1: plant}, access: read-only}]}}\n"
    )
    text = changed("tcp://10.0.0.9", "ascii:///dev/ttyX") + listener
    assert told(folder, text) == [
        "5: url: found '/dev/ttyX', which is the device of listeners.line in line 14, "
        "allowed: a different one"
    ]


def test_a_read_that_goes_nowhere_is_a_warning(folder: Folder) -> None:
    text = changed("        into: {memory: plant, area: input_registers, address: 100}\n", "")
    assert folder.warnings(text) == [
        "p.yaml:9: devices.meter.reads[0]: has no effect: the read has no into "
        "and the device has no forward"
    ]
    forward = "    forward: [{url: 'raw://a:1', unit: 1}]\n"
    assert folder.warnings(text + forward) == []


@pytest.mark.parametrize(
    ("more", "warned"),
    [
        ("", True),
        ("    max_gap: 0\n", True),
        ("    max_gap: 1\n", False),
        ("    max_gap: auto\n", False),
    ],
)
def test_readable_ranges_without_holes_are_a_warning(
    folder: Folder, more: str, warned: bool
) -> None:
    text = HEAD + METER + "    readable: [{area: coils, start: 0, end: 1}]\n" + more
    message = "p.yaml:14: devices.meter.readable: has no effect: gaps are read only with max_gap"
    assert folder.warnings(text) == ([message] if warned else [])


@pytest.mark.parametrize(
    ("tolerance", "pauses"),
    [
        ("pause_after_connect: 1, close_after: 1", "2 requests take 2 s"),
        ("pause: 0.6", "2 requests take 1.2 s"),
        ("reconnect: 3, close_after: 4", "2 requests take 1.5 s"),
        ("pause: 0.4, pause_after_connect: 60, retries: 1", None),
    ],
)
def test_pauses_that_last_longer_than_the_interval_are_a_warning(
    folder: Folder, tolerance: str, pauses: str | None
) -> None:
    text = """
devices:
  meter: {url: tcp://a, interval: 1, tolerance: {%s}, tags: {
    a: {area: coils, address: 1}, b: {area: holding_registers, address: 1}}}
"""
    message = f"found 1, but the pauses of {pauses} in each poll: polls are late"
    found = folder.warnings(text % tolerance)
    assert [each.partition("interval: ")[2] for each in found] == ([message] if pauses else [])


def test_pauses_are_between_the_requests_for_whole_numbers(folder: Folder) -> None:
    text = """
devices:
  meter: {url: tcp://a, interval: 1, tolerance: {pause: 0.2}, max_registers: 3, tags: {
    a: {area: holding_registers, address: 0, type: "uint32[6]"}}}
"""
    [warning] = folder.warnings(text)
    assert "the pauses of 6 requests take 1.2 s" in warning


@pytest.mark.parametrize("pause", ["0.1, max_registers: 1", "0.6, max_gap: auto"])
def test_pauses_that_may_be_short_enough_are_no_warning(folder: Folder, pause: str) -> None:
    text = """
devices:
  meter: {url: tcp://a, tolerance: {pause: %s}, %s, interval: 0.3, tags: {
    a: {area: coils, address: 1}, b: {area: discrete_inputs, address: 1},
    c: {area: holding_registers, address: 1}}}
"""
    assert folder.warnings(text % tuple(pause.split(", "))) == []


@pytest.mark.parametrize(
    ("stale", "told"),
    [
        ("{after: 10}", []),
        (
            "{after: 1, answer: exception}",
            ["stale.after: found 1, which is not more than interval"],
        ),
    ],
)
def test_values_that_are_stale_between_two_polls_are_a_warning(
    folder: Folder, stale: str, told: list[str]
) -> None:
    warnings = folder.warnings(HEAD + METER + f"    stale: {stale}\n")
    assert len(warnings) == len(told)
    assert all(part in each for part, each in zip(told, warnings, strict=True)), warnings


@pytest.mark.parametrize(("after", "told"), [(2, True), (2.5, False)])
def test_values_that_are_stale_on_other_nodes_are_a_warning(
    folder: Folder, after: float, told: bool
) -> None:
    text = f"""
memories: {{plant: {{holding_registers: 8, replicate: {{log: site}}}}}}
logs: {{site: {{servers: ["nats://127.0.0.1"], node: a, max_lag: 10}}}}
rest: {{bind: "127.0.0.1:0", sources: [127.0.0.0/8], tokens: none}}
devices:
  meter:
    url: tcp://192.0.2.9
    interval: 1
    stale: {{after: {after}}}
    reads:
      - {{area: holding_registers, address: 0, count: 2,
          into: {{memory: plant, area: holding_registers, address: 0}}}}
"""
    message = "devices.meter.stale.after: found 2, which is less than 2.5 (max_lag / 4 of"
    assert [message in each for each in folder.warnings(text)] == ([True] if told else [])


def test_stale_has_no_effect_without_a_place_in_memory(folder: Folder) -> None:
    into = "        into: {memory: plant, area: input_registers, address: 100}\n"
    forward = "    forward: [{url: 'raw://a:1', unit: 1}]\n"
    text = changed(into, "") + forward + "    stale: {after: 10}\n"
    assert folder.warnings(text) == [
        "p.yaml:14: devices.meter.stale: has no effect: no read has an into"
    ]


@pytest.mark.parametrize("stale", ["{answer: keep}", "{after: 0}", "{after: 5, answer: zero}", "5"])
def test_stale_has_a_time_and_one_of_two_answers(folder: Folder, stale: str) -> None:
    [problem] = folder.problems(HEAD + METER + f"    stale: {stale}\n")
    assert "devices.meter.stale" in problem
    assert "allowed: " in problem


def test_a_block_of_a_receiver_has_one_device(folder: Folder) -> None:
    block = (
        "forward: [{url: 'raw://A:1', unit: 1, status: {unit: 2, area: input_registers, slot: 3}}]"
    )
    read = "reads: [{area: coils, address: 0, count: 1}]"
    each = f"{{url: tcp://a, unit: 1, interval: 1, {read}, {block}}}"
    other = each.replace("A:1", "a:1").replace("address: 0", "address: 1")
    text = f"devices:\n  a: {each}\n  b: {other}\n"
    assert folder.problems(text) == [
        "p.yaml:3: devices.b.forward[0].status: found input_registers 90 to 119 of unit 2 of a:1, "
        "which overlaps 90 to 119 of devices.a.forward[0].status in line 2, " + OWN
    ]
    assert folder.warnings(text.replace("slot: 3", "slot: 4", 1)) == []


def test_sources_of_one_address_of_a_receiver_overwrite_each_other(folder: Folder) -> None:
    def device(reads: str, forward: str = "{url: 'raw://a:1', unit: 1}") -> str:
        return f"{{url: tcp://a, unit: 1, interval: 1, reads: [{reads}], forward: [{forward}]}}"

    def into(memory: str) -> str:
        return f"into: {{memory: {memory}, area: holding_registers, address: 50}}"

    def read(address: int, more: str = "") -> str:
        return f"{{area: holding_registers, address: {address}, count: 10{more}}}"

    memories = "memories: {m: {holding_registers: 60}, n: {holding_registers: 60}}\n"
    text = f"{memories}devices:\n  a: {device(read(0))}\n  b: {device(read(9))}\n"
    assert folder.warnings(text) == [
        "p.yaml:4: devices.b.reads[0]: found holding_registers 9 to 18 of unit 1 of a:1, which "
        "overlaps 0 to 9 of devices.a.reads[0] in line 3: the values overwrite each other at the "
        "receiver"
    ]
    offset = "{url: 'raw://a:1', unit: 1, offsets: {holding_registers: 1}}"
    assert folder.warnings(text.replace(device(read(9)), device(read(9), offset))) == []

    both = f"{read(0, ', ' + into('m'))}, {read(20, ', ' + into('n'))}"
    [warning] = folder.warnings(f"{memories}devices:\n  a: {device(both)}\n")
    assert warning.startswith("p.yaml:3: devices.a.reads[1]: found holding_registers 50 to 59")

    same = f"{memories}devices:\n  a: {device(f'{read(0)}, {read(5)}')}\n"
    assert folder.warnings(same) == []

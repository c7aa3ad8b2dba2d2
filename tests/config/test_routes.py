"""Routes and links: valid configurations, errors, and what has no effect."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from holdfast.client.tolerance import Tolerance
from holdfast.client.url import parse
from holdfast.config.models.links import LinkConfig
from holdfast.config.models.listeners import ModbusTcpListener, RouteConfig, UnitMemoryConfig
from support.config_folder import Folder

if TYPE_CHECKING:
    from pathlib import Path

HEAD = """\
memories: {plant: {holding_registers: 10}}
devices:
  drive: {url: "tcp://10.0.0.9", unit: 7}
links:
  bus: {url: "rtu:///dev/none?baud=9600"}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:5020
    rules:
      - sources: [10.0.0.0/8]
        access: read-write
"""
UNITS = '        units: {1: plant, 7: {route: drive}, "20-40": {route: bus}}\n'
GOOD = HEAD + UNITS
READS = "interval: 1, reads: [{area: coils, address: 0, count: 8}]"
UNIT = "a unit id from 0 to 255, or a range, as in 20-40"


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


def changed(old: str, new: str, text: str = GOOD) -> str:
    assert text.count(old) == 1, old
    return text.replace(old, new)


def told(folder: Folder, text: str) -> list[str]:
    return [problem.removeprefix("p.yaml:") for problem in folder.problems(text)]


def units_of(folder: Folder, text: str) -> dict[int | str, str | UnitMemoryConfig | RouteConfig]:
    listener = folder.config(text).listeners["scada"]
    assert isinstance(listener, ModbusTcpListener)
    return dict(listener.rules[0].units)


def test_a_unit_id_or_a_range_has_a_memory_or_a_route(folder: Folder) -> None:
    assert units_of(folder, GOOD) == {
        1: "plant",
        7: RouteConfig(route="drive"),
        "20-40": RouteConfig(route="bus"),
    }
    assert folder.warnings(GOOD) == []


def test_a_range_can_have_a_memory(folder: Folder) -> None:
    assert units_of(folder, changed("1: plant", "0x1: plant, 100-255: plant")) == {
        1: "plant",
        "100-255": "plant",
        7: RouteConfig(route="drive"),
        "20-40": RouteConfig(route="bus"),
    }


def test_a_configuration_only_for_routes_needs_no_memory(folder: Folder) -> None:
    text = changed("memories: {plant: {holding_registers: 10}}\n", "")
    assert folder.warnings(text.replace("1: plant, ", "")) == []


def test_settings_of_a_link_have_defaults(folder: Folder) -> None:
    link = folder.config(GOOD).links["bus"]
    assert link == LinkConfig(
        url="rtu:///dev/none?baud=9600",
        timeout=1.0,
        in_flight=1,
        queue=256,
        priority={},
        coalesce=True,
        cache=0.0,
    )
    assert link.target == parse(link.url)


def test_all_settings_of_a_link_survive_a_dump(folder: Folder) -> None:
    more = (
        "{url: 'tcp://plc', timeout: 0.5, in_flight: auto, queue: 65535, coalesce: false, "
        "cache: 0.25, priority: {10.0.0.5: high, 'fd00::0:7': high}, tolerance: {retries: 1}}"
    )
    config = folder.config(changed('{url: "rtu:///dev/none?baud=9600"}', more))

    assert config.links["bus"].priority == {"10.0.0.5": "high", "fd00::7": "high"}
    assert config.links["bus"].target.tolerance == Tolerance(retries=1)
    assert folder.config(config.dump()) == config
    assert folder.warnings(config.dump()) == []


def test_a_serial_listener_has_routes_too(folder: Folder) -> None:
    line = (
        "  line: {type: modbus-rtu, serial: {device: /dev/other}, rules: "
        '[{access: read-only, units: {"1-247": {route: bus}}}]}\n'
    )
    assert folder.warnings(GOOD + line) == []


def test_a_route_to_a_serial_line_may_have_reserved_unit_ids(folder: Folder) -> None:
    assert folder.warnings(changed("20-40", "200-255")) == []


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('"20-40": {route: bus}', "40-20: {route: bus}",
         f"13: listeners.scada.rules[0].units.40-20: found '40-20', allowed: {UNIT}"),
        ("20-40", "20-256",
         f"13: listeners.scada.rules[0].units.20-256: found '20-256', allowed: {UNIT}"),
        ("20-40", "1-",
         f"13: listeners.scada.rules[0].units.1-: found '1-', allowed: {UNIT}"),
        ("20-40", "5-10", "13: listeners.scada.rules[0].units.5-10: found 5-10, which overlaps 7 "
         "in line 13, allowed: each unit id once"),
        ("7: {route: drive}", "5-7: {route: drive}",
         "13: listeners.scada.rules[0].units.5-7: found 5-7, allowed with a route to a device: "
         "one unit id; a route to a link takes ranges"),
        ("{route: drive}", "{route: driv}", "13: listeners.scada.rules[0].units.7.route: found "
         "'driv', allowed: drive, bus; did you mean 'drive'?"),
        ("{route: drive}", "{route: 7}", "13: listeners.scada.rules[0].units.7.route: found 7, "
         "allowed: 1 to 64 letters, digits, '_', '.' and '-'; quote it to make it text"),
        ("{route: drive}", "{}", "13: listeners.scada.rules[0].units.7.route: missing, allowed: "
         "text"),
        ("{route: drive}", "{route: drive, unit: 1}",
         "13: listeners.scada.rules[0].units.7.unit: unknown key, allowed: route, access, "
         "functions, deny"),
        ("{route: drive}", "drive", "13: listeners.scada.rules[0].units.7: found 'drive', the name "
         "of a device, allowed: a memory, or {route: drive}"),
        ("{route: drive}", "[drive]", "13: listeners.scada.rules[0].units.7: found a list, "
         "allowed: 1 to 64 letters, digits, '_', '.' and '-'"),
        ("unit: 7}", "unit: 7, enabled: false}", "13: listeners.scada.rules[0].units.7.route: "
         "found 'drive', which is disabled, allowed: an enabled device"),
        ("  bus: {url", "  drive: {url: 'tcp://10.0.0.8'}\n  bus: {url",
         "5: links.drive: found the name of the device in line 3, allowed: a different name"),
        ("  bus: {url", "  two: {url: 'rtu:///dev/none'}\n  bus: {url",
         "6: links.bus.url: found the address of links.two in line 5, allowed: one link for each "
         "address"),
        ('"rtu:///dev/none?baud=9600"', '"x://y"', None),
        ('"rtu:///dev/none?baud=9600"', '"tcp://a", queue: 0',
         "5: links.bus.queue: found 0, allowed: an integer from 1 to 65535"),
        ('"rtu:///dev/none?baud=9600"', '"tcp://a", cache: 0.0001',
         "5: links.bus.cache: found 0.0001, allowed: 0, or 0.001 to 31622400 seconds"),
        ('"rtu:///dev/none?baud=9600"', '"tcp://a", timeout: 0',
         "5: links.bus.timeout: found 0, allowed: a number from 0.001 to 31622400 seconds"),
        ('"rtu:///dev/none?baud=9600"', '"tcp://a", in_flight: 1025',
         "5: links.bus.in_flight: found 1025, allowed: an integer from 1 to 1024 or auto"),
        ('"rtu:///dev/none?baud=9600"', '"tcp://a", coalesce: 1',
         "5: links.bus.coalesce: found 1, allowed: true or false"),
        ('"rtu:///dev/none?baud=9600"', '"tcp://a", priority: {10.0.0.0/8: high}',
         "5: links.bus.priority.'10.0.0.0/8': found '10.0.0.0/8', allowed: an IP address, as in "
         "10.0.0.7 or fd00::7"),
        ('"rtu:///dev/none?baud=9600"', '"tcp://a", priority: {"::ffff:10.0.0.7": high}',
         "5: links.bus.priority.'::ffff:10.0.0.7': found '::ffff:10.0.0.7', write its IPv4 form "
         "10.0.0.7"),
        ('"rtu:///dev/none?baud=9600"', '"tcp://a", priority: {10.0.0.7: low}',
         "5: links.bus.priority.'10.0.0.7': found 'low', allowed: high"),
        ('"rtu:///dev/none?baud=9600"', '"tcp://a", tolerance: {echo: true}',
         "5: links.bus.tolerance.echo: found true, allowed with RTU and ASCII frames only"),
        ('"rtu:///dev/none?baud=9600"', '"tls://plc?ca=none.pem"',
         "5: links.bus.url: found ca='none.pem', which can't be read: No such file or directory"),
        ('"rtu:///dev/none?baud=9600"', '"tcp://a", units: 1',
         "5: links.bus.units: unknown key, allowed: url, timeout, in_flight, tolerance, retry, "
         "queue, priority, coalesce, cache"),
    ],
)  # fmt: skip
def test_a_wrong_route_or_link_is_named(
    folder: Folder, old: str, new: str, problem: str | None
) -> None:
    problems = told(folder, changed(old, new))
    assert len(problems) == 1
    if problem is None:
        problem = problems[0]
        assert problem.startswith("5: links.bus.url: 'x://y' is not the URL of a device")
    assert problems == [problem]


def test_a_route_without_any_device_or_link_is_told_what_it_takes(folder: Folder) -> None:
    text = changed('devices:\n  drive: {url: "tcp://10.0.0.9", unit: 7}\n', "")
    text = text.replace('links:\n  bus: {url: "rtu:///dev/none?baud=9600"}\n', "")
    assert told(folder, text) == [
        "9: listeners.scada.rules[0].units.7.route: found 'drive', allowed: a device or a link",
        "9: listeners.scada.rules[0].units.20-40.route: found 'bus', allowed: a device or a link",
    ]


def test_raw_ingest_takes_no_routes(folder: Folder) -> None:
    raw = (
        "  raw: {type: raw-ingest, bind: '127.0.0.1:9000', rules: [{sources: [10.0.0.1], "
        "areas: [holding_registers], units: {1: {route: drive}}}]}\n"
    )
    assert told(folder, GOOD + raw) == [
        "14: listeners.raw.rules[0].units.1: found a route, allowed: a memory; a route takes "
        "Modbus requests only"
    ]


def test_a_serial_line_of_a_listener_can_t_be_the_one_of_a_link(folder: Folder) -> None:
    line = (
        "  line: {type: modbus-rtu, serial: {device: /dev/none}, rules: "
        "[{access: read-only, units: {1: plant}}]}\n"
    )
    assert told(folder, GOOD + line) == [
        "5: links.bus.url: found '/dev/none', which is the device of listeners.line in line 14, "
        "allowed: a different one"
    ]


def test_a_serial_line_of_a_link_can_t_be_polled_for_nats(folder: Folder) -> None:
    nats = "nats: {servers: ['nats://127.0.0.1'], devices: [/dev/none]}\n"
    assert told(folder, GOOD + nats) == [
        "14: nats.devices[0]: found '/dev/none', which is the device of links.bus in line 5, "
        "allowed: a different one"
    ]


# A link and a device at one address


@pytest.mark.parametrize(
    ("link", "device"),
    [
        ("url: 'tcp://a', in_flight: 8, tolerance: {pad: true}", "url: 'tcp://a'"),
        ("url: 'tcp://a', in_flight: 8", "url: 'tcp://a', in_flight: 8"),
        ("url: 'tcp://a', retry: {most: 5}", "url: 'tcp://a'"),
        ("url: 'rtu:///dev/x', retry: {most: 5}", "url: 'rtu:///dev/x'"),
        ("url: 'tcp://a?retries=1'", "url: 'tcp://a', tolerance: {retries: 1}"),
        ("url: 'rtu:///dev/x?pad=1'", "url: 'rtu:///dev/x'"),
    ],
)
def test_a_link_decides_for_the_devices_at_its_address(
    folder: Folder, link: str, device: str
) -> None:
    text = changed('url: "rtu:///dev/none?baud=9600"', link)
    assert folder.warnings(changed('url: "tcp://10.0.0.9"', device, text)) == []


@pytest.mark.parametrize(
    ("link", "device", "problem"),
    [
        ("url: 'tcp://a'", "url: 'tcp://a', in_flight: 2",
         "3: devices.drive.in_flight: found another in_flight than links.bus in line 5 has at "
         "this address, allowed: the same"),
        ("url: 'tcp://a', tolerance: {retries: 1}", "url: 'tcp://a?retries=2'",
         "3: devices.drive.url: found another tolerance than links.bus in line 5 has at this "
         "address, allowed: the same"),
        ("url: 'tcp://a'", "url: 'tcp://a', tolerance: {pad: true}",
         "3: devices.drive.tolerance: found another tolerance than links.bus in line 5 has at "
         "this address, allowed: the same"),
        ("url: 'tcp://a', retry: {most: 5}", "url: 'tcp://a', retry: {most: 6}",
         "3: devices.drive.retry: found another retry than links.bus in line 5 has at this "
         "address, allowed: the same"),
        ("url: 'rtu:///dev/x'", "url: 'rtu:///dev/x', retry: {most: 6}",
         "3: devices.drive.retry: found another retry than links.bus in line 5 has at this "
         "address, allowed: the same"),
        ("url: 'rtu:///dev/x?baud=9600'", "url: 'rtu:///dev/x'",
         "3: devices.drive.url: found line settings that differ from those of links.bus in line "
         "5, allowed: the same settings"),
    ],
)  # fmt: skip
def test_a_device_can_t_contradict_the_link_at_its_address(
    folder: Folder, link: str, device: str, problem: str
) -> None:
    text = changed('url: "rtu:///dev/none?baud=9600"', link)
    assert told(folder, changed('url: "tcp://10.0.0.9"', device, text)) == [problem]


# Functions


def test_a_rule_with_a_route_takes_functions_that_only_devices_know(folder: Folder) -> None:
    assert folder.warnings(GOOD + "        functions: [3, 65, 127]\n") == []
    assert folder.warnings(GOOD + "        deny: [7, 20]\n") == []


@pytest.mark.parametrize("key", ["functions", "deny"])
def test_a_rule_without_a_route_takes_only_functions_of_memories(folder: Folder, key: str) -> None:
    units = changed(', 7: {route: drive}, "20-40": {route: bus}', "")
    assert told(folder, f"{units}        {key}: [3, 65]\n") == [
        f"14: listeners.scada.rules[0].{key}[1]: found 65, allowed: 1, 2, 3, 4, 5, 6, 7, 8, 11, "
        "12, 15, 16, 17, 20, 21, 22, 23, 24 or 43"
    ]


@pytest.mark.parametrize(("code", "shown"), [("0", "0"), ("128", "128"), ("'3'", "'3'")])
def test_a_function_code_is_1_to_127(folder: Folder, code: str, shown: str) -> None:
    assert told(folder, f"{GOOD}        functions: [{code}]\n") == [
        f"14: listeners.scada.rules[0].functions[0]: found {shown}, allowed: a function code from "
        "1 to 127"
    ]


# Devices without reads


@pytest.mark.parametrize(
    "setting",
    [
        "interval: 1",
        "max_gap: auto",
        "forbidden: [{area: coils, start: 1, end: 2}]",
        "forward: [{url: 'raw://a:1', unit: 1}]",
    ],
)
def test_settings_of_polling_have_no_effect_without_reads(folder: Folder, setting: str) -> None:
    key = setting.partition(":")[0]
    assert folder.warnings(changed("unit: 7}", f"unit: 7, {setting}}}")) == [
        f"p.yaml:3: devices.drive.{key}: has no effect: the device has no reads and no tags"
    ]


@pytest.mark.parametrize("url", ["rtu:///dev/none?baud=9600", "udp://a", "rtu+tcp://a"])
@pytest.mark.parametrize(("number", "warns"), [("4", True), ("auto", False), ("1", False)])
def test_what_carries_one_request_at_a_time_has_no_more_in_flight(
    folder: Folder, url: str, number: str, *, warns: bool
) -> None:
    text = changed('"rtu:///dev/none?baud=9600"', f"{url!r}, in_flight: {number}")
    expected = (
        "p.yaml:5: links.bus.in_flight: has no effect: only tcp and tls carry more than one "
        "request at a time"
    )
    assert folder.warnings(text) == ([expected] if warns else [])


def test_reads_need_an_interval(folder: Folder) -> None:
    reads = READS.removeprefix("interval: 1, ")
    assert told(folder, changed("unit: 7}", f"unit: 7, {reads}}}")) == [
        "3: devices.drive.interval: missing, allowed: a number from 0.01 to 31622400 seconds"
    ]


def test_what_no_route_names_has_no_effect(folder: Folder) -> None:
    assert folder.warnings(changed(', 7: {route: drive}, "20-40": {route: bus}', "")) == [
        "p.yaml:3: devices.drive: has no effect: the device has no reads and no tags, and no route "
        "names it",
        "p.yaml:5: links.bus: has no effect: no route names the link",
    ]


def test_a_link_decides_for_polled_devices_without_a_route(folder: Folder) -> None:
    forward = "forward: [{url: 'raw://a:1', unit: 1}]"
    text = changed('"tcp://10.0.0.9", unit: 7', f'"rtu:///dev/none?baud=9600", unit: 7, {READS}, '
                   f"{forward}")  # fmt: skip
    assert folder.warnings(text.replace(', 7: {route: drive}, "20-40": {route: bus}', "")) == []


def test_a_function_that_may_write_has_no_effect_in_a_read_only_rule(folder: Folder) -> None:
    text = changed("read-write", "read-only") + "        functions: [6, 7, 65]\n"
    assert folder.warnings(text) == [
        "p.yaml:14: listeners.scada.rules[0].functions[0]: function 6 has no effect: it writes, "
        "and access is read-only",
        "p.yaml:14: listeners.scada.rules[0].functions[2]: function 65 has no effect: it may "
        "write, and access is read-only",
    ]

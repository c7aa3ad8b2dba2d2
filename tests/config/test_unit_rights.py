"""Rights for single units: valid forms, errors, and what never matches."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from holdfast.config.models.devices import RangeConfig
from holdfast.config.models.listeners import ModbusTcpListener, RouteConfig, UnitMemoryConfig
from holdfast.config.unit_rights import together
from support.config_folder import Folder

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.unit_rights import UnitRights

HEAD = """\
memories:
  plant: {coils: 8, holding_registers: {start: 100, size: 100}}
devices:
  drive: {url: "tcp://10.0.0.9", unit: 7, interval: 1, reads: [{area: coils, address: 0, count: 1,
    into: {memory: plant, area: coils, address: 0}}]}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:5020
    rules:
"""
FILES = """\
  files: {coils: 1, files: {4: 10}}
  queues: {holding_registers: 9, fifo: [3]}
"""
UNIT = "{memory: plant, access: read-only, functions: [3, 8]}"
STATUS = "1: {memory: plant, exception_status: {area: coils, address: 0}}"
RANGES = (
    "{memory: plant, read: [{area: holding_registers, start: 100, end: 199}], "
    "write: [{area: coils, start: 2, end: 4}]}"
)


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


def rule(units: str, more: str = "access: read-write", sources: str = "10.0.0.0/8") -> str:
    return f"      - {{sources: [{sources}], {more}, units: {{{units}}}}}\n"


def line(*rules: str) -> str:
    head = "  line:\n    type: modbus-rtu\n    serial: {device: /dev/none}\n    rules:\n"
    return head + "".join(
        f"      - {{access: read-write, units: {{{units}}}}}\n" for units in rules
    )


def rights(folder: Folder, text: str) -> dict[int, UnitRights]:
    listener = folder.config(text).listeners["scada"]
    assert isinstance(listener, ModbusTcpListener)
    return together(listener.rules)


def test_a_unit_can_have_fewer_rights_than_its_rule(folder: Folder) -> None:
    text = HEAD + rule(f"1: plant, 2: {UNIT}, 3: {RANGES}, 4: {{route: drive, deny: [6]}}")
    config = folder.config(text)
    listener = config.listeners["scada"]

    assert isinstance(listener, ModbusTcpListener)
    assert dict(listener.rules[0].units) == {
        1: "plant",
        2: UnitMemoryConfig(memory="plant", access="read-only", functions=(3, 8)),
        3: UnitMemoryConfig(
            memory="plant",
            read=(RangeConfig(area="holding_registers", start=100, end=199),),
            write=(RangeConfig(area="coils", start=2, end=4),),
        ),
        4: RouteConfig(route="drive", deny=(6,)),
    }
    assert folder.warnings(text) == []
    assert folder.config(config.dump()) == config


@pytest.mark.parametrize(
    ("of_rule", "of_unit", "functions", "deny"),
    [
        ("", "", None, None),
        ("functions: [3, 4]", "", (3, 4), None),
        ("deny: [5, 6]", "", None, (5, 6)),
        ("", "functions: [3]", (3,), None),
        ("functions: [3, 4]", "functions: [4]", (4,), None),
        ("functions: [3, 4]", "deny: [4]", (3,), None),
        ("deny: [5, 6]", "functions: [3]", (3,), None),
        ("deny: [5, 6]", "deny: [15, 16]", None, (5, 6, 15, 16)),
        ("functions: [3]", "deny: [3]", (), None),
    ],
)
def test_functions_of_a_unit_narrow_those_of_its_rule(
    folder: Folder,
    of_rule: str,
    of_unit: str,
    functions: tuple[int, ...] | None,
    deny: tuple[int, ...] | None,
) -> None:
    more = ", ".join(("access: read-write", *filter(None, [of_rule])))
    unit = ", ".join(("memory: plant", *filter(None, [of_unit])))
    of_1 = rights(folder, HEAD + rule(f"1: {{{unit}}}", more))[1]

    assert (of_1.functions, of_1.deny) == (functions, deny)


def test_the_first_rule_that_names_a_unit_decides_for_it(folder: Folder) -> None:
    first = rule("1: plant, 5-7: plant", "access: read-only")
    units = rights(folder, HEAD + first + rule('"1-6": plant, 9: plant'))

    access = {unit: each.access for unit, each in units.items()}
    assert access == {
        **dict.fromkeys((1, 5, 6, 7), "read-only"),
        **dict.fromkeys((2, 3, 4, 9), "read-write"),
    }
    memories = folder.config(HEAD + first).memories
    assert 3 in units[2].codes(memories, event_log=False)
    assert not {5, 6, 15, 16, 22, 23} & set(units[1].codes(memories, event_log=False))


@pytest.mark.parametrize(
    ("units", "more", "problem"),
    [
        ("1: {memory: plant, access: read-write}", "access: read-only",
         "access: found read-write, allowed: read-only, the access of the rule"),
        ("1: {memory: plant, access: rw}", "access: read-only",
         "access: found 'rw', allowed: read-only or read-write"),
        ("1: {memory: plan}", "access: read-only",
         "memory: found 'plan', allowed: plant; did you mean 'plant'?"),
        ("1: {memory: drive}", "access: read-only",
         "memory: found 'drive', the name of a device, allowed: a memory, or {route: drive}"),
        ("1: {memory: plant, route: drive}", "access: read-only",
         "route: unknown key, allowed: memory, access, functions, deny, read, write, "
         "exception_status; did you mean 'write'?"),
        ("1: {memory: plant, acess: read-only}", "access: read-only",
         "acess: unknown key, allowed: memory, access, functions, deny, read, write, "
         "exception_status; did you mean 'access'?"),
        ("1: {route: drive, read: []}", "access: read-only",
         "read: unknown key, allowed: route, access, functions, deny"),
        ("1: {memory: plant, functions: [3, 4]}", "access: read-only, functions: [3, 1]",
         "functions[1]: found 4, allowed: 3, 1, the functions of the rule"),
        ("1: {memory: plant, functions: [3, 4]}", "access: read-only, deny: [4]",
         "functions[1]: found 4, which the rule denies, allowed: functions that the rule allows"),
        ("1: {memory: plant, functions: [3, 3]}", "access: read-only",
         "functions[1]: found 3 again, allowed: once"),
        ("1: {memory: plant, functions: []}", "access: read-only",
         "functions: found an empty list, allowed: a list with at least one entry"),
        ("1: {memory: plant, functions: [65]}", "access: read-only",
         "functions[0]: found 65, allowed: 1, 2, 3, 4, 5, 6, 7, 8, 11, 12, 15, 16, 17, 20, 21, 22, "
         "23, 24 or 43"),
        ("1: {memory: plant, functions: [3], deny: [4]}", "access: read-only",
         "deny: found together with functions, allowed: only one of them"),
        ("1: {memory: plant, read: []}", "access: read-only",
         "read: found an empty list, allowed: a list with at least one entry"),
        ("1: {memory: plant, read: [{area: coils, start: 4, end: 8}]}", "access: read-only",
         "read[0].start: found 4 to 8, allowed in coils of plant: 0 to 7"),
        ("1: {memory: plant, read: [{area: holding_registers, start: 99, end: 100}]}",
         "access: read-only", "read[0].start: found 99 to 100, allowed in holding_registers of "
         "plant: 100 to 199"),
        ("1: {memory: plant, read: [{area: coils, start: 4, end: 3}]}", "access: read-only",
         "read[0].end: found 3, allowed: the last address, 4 or more"),
        ("1: {memory: plant, read: [{area: coils, start: 4}]}", "access: read-only",
         "read[0].end: missing, allowed: an integer from 0 to 65535"),
        ("1: {memory: plant, write: [{area: input_registers, start: 4, end: 4}]}",
         "access: read-write", "write[0].area: found input_registers, which Modbus clients can't "
         "write, allowed: coils or holding_registers"),
        ("1: {memory: plant, exception_status: {area: coils, address: 1}}", "access: read-only",
         "exception_status.address: found 1 to 8, allowed in coils of plant: 0 to 7"),
        ("1: {memory: plant, exception_status: {area: discrete_inputs, address: 0}}",
         "access: read-only", "exception_status.area: found 'discrete_inputs', an area that plant "
         "does not have, allowed: coils, holding_registers"),
        ("1: {memory: plant, exception_status: {area: holding_registers, address: 100}}",
         "access: read-only", "exception_status.area: found 'holding_registers', allowed: coils or "
         "discrete_inputs"),
        ("1: {memory: plant, exception_status: {area: coils}}", "access: read-only",
         "exception_status.address: missing, allowed: an integer from 0 to 65528"),
        ("1: {memory: plant, exception_status: {area: coils, address: 65529}}",
         "access: read-only", "exception_status.address: found 65529, allowed: an integer from 0 "
         "to 65528"),
        ("1: {memory: plant, read: [{area: coils, start: 0, end: 6}, {area: holding_registers, "
         "start: 107, end: 107}], exception_status: {area: coils, address: 0}}",
         "access: read-only", "exception_status: found coils 0 to 7, which read does not list, "
         "allowed: bits that may be read"),
        ("1: {route: drive, exception_status: {area: coils, address: 0}}", "access: read-only",
         "exception_status: unknown key, allowed: route, access, functions, deny"),
        ("1: {memory: plant, read: [{area: discrete_inputs, start: 4, end: 4}]}",
         "access: read-write", "read[0].area: found 'discrete_inputs', an area that plant does not "
         "have, allowed: coils, holding_registers"),
    ],
)  # fmt: skip
def test_a_wrong_right_of_a_unit_is_an_error(
    folder: Folder, units: str, more: str, problem: str
) -> None:
    found = folder.problems(HEAD + rule(units, more))
    assert found == [f"p.yaml:11: listeners.scada.rules[0].units.1.{problem}"]


def test_a_raw_ingest_rule_has_no_rights_of_units(folder: Folder) -> None:
    raw = (
        "  raw: {type: raw-ingest, bind: '127.0.0.1:9000', rules: [{sources: [10.0.0.0/8], "
        "areas: [coils], units: {1: {memory: plant}}}]}\n"
    )
    assert folder.problems(HEAD + rule("1: plant") + raw) == [
        "p.yaml:12: listeners.raw.rules[0].units.1: found a mapping, allowed: a memory; areas "
        "limit a raw ingest rule"
    ]


@pytest.mark.parametrize(
    ("units", "more", "warning"),
    [
        ("1: {memory: plant, functions: [3, 6]}", "access: read-only",
         "functions[1]: function 6 has no effect: it writes, and access is read-only"),
        ("1: {memory: plant, access: read-only, functions: [3, 6]}", "access: read-write",
         "functions[1]: function 6 has no effect: it writes, and access is read-only"),
        ("1: {memory: plant, deny: [4]}", "access: read-only, deny: [4]",
         "deny[0]: 4 has no effect: the rule does not allow it either"),
        ("1: {memory: plant, deny: [4]}", "access: read-only, functions: [3]",
         "deny[0]: 4 has no effect: the rule does not allow it either"),
        ("1: {memory: plant, write: [{area: coils, start: 0, end: 0}]}", "access: read-only",
         "write: has no effect: access is read-only"),
        (STATUS, "access: read-only, deny: [7]",
         "exception_status: has no effect: function 7 is not allowed"),
        (STATUS, "access: read-only, functions: [3]",
         "exception_status: has no effect: function 7 is not allowed"),
    ],
)  # fmt: skip
def test_a_right_without_effect_is_a_warning(
    folder: Folder, units: str, more: str, warning: str
) -> None:
    found = folder.warnings(HEAD + rule(units, more))
    assert found == [f"p.yaml:11: listeners.scada.rules[0].units.1.{warning}"]


def test_a_function_that_no_unit_has_is_a_warning(folder: Folder) -> None:
    text = HEAD + rule("1: plant", "access: read-only, functions: [3, 7, 12]")
    place = "p.yaml:11: listeners.scada.rules[0].functions"
    assert folder.warnings(text) == [
        f"{place}[1]: function 7 has no effect: no unit has an exception_status",
        f"{place}[2]: function 12 has no effect: the listener has no event_log",
    ]
    both = HEAD.replace("    rules:", "    event_log: true\n    rules:")
    assert folder.warnings(both + rule(STATUS, "access: read-only, functions: [3, 7, 12]")) == []
    routed = rule("1: {route: drive}", "access: read-only, functions: [7, 12]")
    assert folder.warnings(HEAD + routed) == []


def test_functions_of_files_and_queues_that_no_memory_has_are_warnings(folder: Folder) -> None:
    text = HEAD + rule("1: plant", "access: read-write, functions: [3, 20, 21, 24]")
    place = "p.yaml:11: listeners.scada.rules[0].functions"
    assert folder.warnings(text) == [
        f"{place}[1]: function 20 has no effect: no memory of the rule has files",
        f"{place}[2]: function 21 has no effect: no memory of the rule has files",
        f"{place}[3]: function 24 has no effect: no memory of the rule has fifo",
    ]
    with_both = text.replace("{coils: 8,", "{coils: 8, files: {4: 10}, fifo: [100],")
    assert folder.warnings(with_both) == []


def test_the_codes_of_a_unit_are_those_that_it_has(folder: Folder) -> None:
    units = rights(folder, HEAD + rule(f"{STATUS}, 2: plant, 3: {{route: drive}}"))

    special = {7, 12, 20, 21, 24}

    def codes(unit: int, memory: str = "plant", *, event_log: bool = False) -> set[int]:
        config = folder.config(HEAD.replace("devices:", f"{FILES}devices:") + rule("1: plant"))
        memories = {"plant": config.memories[memory]}
        return special.intersection(units[unit].codes(memories, event_log=event_log))

    assert codes(1) == {7}
    assert codes(1, event_log=True) == {7, 12}
    assert codes(2, event_log=True) == {12}
    assert codes(2, "files") == {20, 21}
    assert codes(2, "queues") == {24}
    assert codes(3) == special


# What never matches


def test_rules_of_the_same_peers_for_other_units_are_no_warning(folder: Folder) -> None:
    assert folder.warnings(HEAD + rule("1: plant") + rule("2: plant", "access: read-only")) == []


def test_a_rule_never_matches_if_earlier_ones_decide_all_its_units(folder: Folder) -> None:
    text = HEAD + rule("1: plant, 3: plant") + rule("2: plant") + rule("'1-2': plant")
    assert folder.warnings(text) == [
        "p.yaml:13: listeners.scada.rules[2]: never matches: all its sources and units are covered "
        "by rules[0] in line 11 and rules[1] in line 12"
    ]


def test_a_unit_that_earlier_rules_decide_is_a_warning(folder: Folder) -> None:
    text = (
        HEAD
        + rule("1-9: plant", sources="10.0.0.0/9")
        + rule("1-5: plant", sources="10.128.0.0/9")
        + rule("5: plant, 6: plant, 2-3: plant")
    )
    both = "rules[0] in line 11 and rules[1] in line 12 decide"
    assert folder.warnings(text) == [
        f"p.yaml:13: listeners.scada.rules[2].units.5: never matches: {both} for unit 5",
        f"p.yaml:13: listeners.scada.rules[2].units.2-3: never matches: {both} for units 2-3",
    ]


def test_a_range_of_units_that_is_decided_in_part_is_no_warning(folder: Folder) -> None:
    assert folder.warnings(HEAD + rule("1-9: plant") + rule("5-10: plant")) == []


def test_rules_of_a_serial_line_are_judged_unit_by_unit(folder: Folder) -> None:
    text = HEAD + rule("1: plant") + line(f"1: plant, 2: {UNIT}", "2: plant, 3: plant", "3: plant")
    assert folder.warnings(text) == [
        "p.yaml:17: listeners.line.rules[1].units.2: never matches: rules[0] in line 16 decides "
        "for unit 2",
        "p.yaml:18: listeners.line.rules[2]: never matches: all its units are covered by rules[1] "
        "in line 17",
    ]

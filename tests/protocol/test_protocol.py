"""What the standard fixes: written down here a second time, to compare."""

from __future__ import annotations

import json
import re
from typing import get_args

import pytest

from holdfast import _core, protocol, types
from holdfast.gateway import assets
from holdfast.gateway.assets import FOLDER
from holdfast.polling import faults
from holdfast.scanner.messages.types import FunctionCode
from holdfast.scanner.subscriptions.tag import AREA_OF_CODE
from support import server_model

COILS, DISCRETE_INPUTS, HOLDING_REGISTERS, INPUT_REGISTERS = (
    "coils",
    "discrete_inputs",
    "holding_registers",
    "input_registers",
)

FUNCTIONS = [
    (1, "Read Coils", False, COILS, 2000, 0),
    (2, "Read Discrete Inputs", False, DISCRETE_INPUTS, 2000, 0),
    (3, "Read Holding Registers", False, HOLDING_REGISTERS, 125, 0),
    (4, "Read Input Registers", False, INPUT_REGISTERS, 125, 0),
    (5, "Write Single Coil", True, COILS, 0, 1),
    (6, "Write Single Register", True, HOLDING_REGISTERS, 0, 1),
    (7, "Read Exception Status", False, None, 0, 0),
    (8, "Diagnostics", False, None, 0, 0),
    (11, "Get Comm Event Counter", False, None, 0, 0),
    (12, "Get Comm Event Log", False, None, 0, 0),
    (15, "Write Multiple Coils", True, COILS, 0, 1968),
    (16, "Write Multiple Registers", True, HOLDING_REGISTERS, 0, 123),
    (17, "Report Server ID", False, None, 0, 0),
    (20, "Read File Record", False, None, 0, 0),
    (21, "Write File Record", True, None, 0, 0),
    (22, "Mask Write Register", True, HOLDING_REGISTERS, 0, 1),
    (23, "Read/Write Multiple Registers", True, HOLDING_REGISTERS, 125, 121),
    (24, "Read FIFO Queue", False, None, 0, 0),
    (43, "Encapsulated Interface Transport", False, None, 0, 0),
]


def test_the_functions_are_those_of_the_standard() -> None:
    assert [tuple(each) for each in protocol.FUNCTIONS] == FUNCTIONS
    assert protocol.WRITING_CODES == server_model.WRITES == (5, 6, 15, 16, 21, 22, 23)
    assert protocol.BROADCAST_CODES == (5, 6, 15, 16, 21, 22)


@pytest.mark.parametrize("function", protocol.FUNCTIONS, ids=lambda each: each.name)
def test_a_function_writes_if_it_has_something_to_write(function: protocol.Function) -> None:
    of_files = function.code in protocol.FILE_FUNCTIONS
    assert of_files or function.writes == (function.most_written > 0)
    assert (function.area is None) == (function.most_read == function.most_written == 0)


def test_the_limits_are_those_of_the_standard() -> None:
    bits, registers = (COILS, DISCRETE_INPUTS), (HOLDING_REGISTERS, INPUT_REGISTERS)
    assert dict.fromkeys(bits, 2000) | dict.fromkeys(registers, 125) == protocol.READ_LIMITS
    assert protocol.WRITE_LIMITS == {COILS: 1968, HOLDING_REGISTERS: 123}
    assert (protocol.READ_WRITE.most_read, protocol.READ_WRITE.most_written) == (125, 121)
    assert (protocol.ADDRESSES, protocol.LAST_ADDRESS, protocol.MAX_PDU) == (65536, 65535, 253)


def test_a_request_beyond_a_limit_is_refused() -> None:
    for area, most in protocol.READ_LIMITS.items():
        _core.Request.read(area, 0, most)
        with pytest.raises(ValueError, match=f"allowed: 1 to {most}"):
            _core.Request.read(area, 0, most + 1)
    read, written = protocol.READ_WRITE.most_read, protocol.READ_WRITE.most_written
    for make, most in (
        (_core.Request.write_coils, protocol.WRITE_BITS),
        (_core.Request.write_registers, protocol.WRITE_REGISTERS),
        (lambda at, values: _core.Request.read_write(at, read, at, values), written),
    ):
        make(0, [0] * most)
        with pytest.raises(ValueError, match=f"allowed: 1 to {most}"):
            make(0, [0] * (most + 1))


def test_the_areas_are_the_native_ones() -> None:
    assert types.AREAS == get_args(types.Area) == _core.AREAS
    assert types.AREAS == types.BIT_AREAS + types.REGISTER_AREAS
    assert tuple(protocol.READ_FUNCTIONS) == types.AREAS
    assert [each.code for each in protocol.READ_FUNCTIONS.values()] == [1, 2, 3, 4]


def test_the_scanner_names_each_area_by_a_word() -> None:
    assert AREA_OF_CODE == {
        "coil": COILS,
        "discrete": DISCRETE_INPUTS,
        "holding": HOLDING_REGISTERS,
        "input": INPUT_REGISTERS,
    }
    assert tuple(AREA_OF_CODE) == get_args(FunctionCode)


def test_exceptions_have_the_names_of_the_standard() -> None:
    assert protocol.EXCEPTIONS == {
        1: "Illegal Function",
        2: "Illegal Data Address",
        3: "Illegal Data Value",
        4: "Server Device Failure",
        5: "Acknowledge",
        6: "Server Device Busy",
        8: "Memory Parity Error",
        10: "Gateway Path Unavailable",
        11: "Gateway Target Device Failed To Respond",
    }
    known = (
        protocol.ILLEGAL_FUNCTION,
        protocol.ILLEGAL_ADDRESS,
        protocol.ILLEGAL_VALUE,
        protocol.BUSY,
        protocol.PATH_UNAVAILABLE,
        protocol.TARGET_SILENT,
    )
    assert known == (1, 2, 3, 6, 10, 11)


def test_diagnostics_that_change_nothing_are_the_echo_the_register_and_the_counters() -> None:
    assert (0, 2, *range(11, 19)) == protocol.HARMLESS_DIAGNOSTICS
    assert [code for code, _, _ in _core.SUB_FUNCTIONS] == list(server_model.SUB_FUNCTIONS)


@pytest.mark.parametrize(
    ("fault", "word", "text"),
    [
        (0x8001, "timeout", "no reply in time"),
        (0x8002, "refused", "no connection"),
        (0x8003, "reset", "the connection was lost"),
        (0x8004, "invalid reply", "an invalid reply"),
        (2, "exception 02", "exception 02 (Illegal Data Address)"),
        (0x0B, "exception 0B", "exception 0B (Gateway Target Device Failed To Respond)"),
        (0x55, "exception 55", "exception 55"),
    ],
)
def test_a_fault_has_a_word_and_a_text(fault: int, word: str, text: str) -> None:
    assert (faults.fault_word(fault), faults.fault_text(fault)) == (word, text)
    assert faults.is_exception(fault) == (fault < 256)


def test_no_fault_is_called_none() -> None:
    assert faults.fault_word(0) == "none"


def test_the_console_has_the_same_areas_and_limits() -> None:
    script = assets.read("/console/standard.js")[1].decode()
    [found] = re.findall(r"= (\{.*\});", script)
    standard = json.loads(found)
    rows = standard["AREAS"]
    assert [(area, row["code"], row["most"]) for area, row in rows.items()] == [
        (area, function.code, function.most_read)
        for area, function in protocol.READ_FUNCTIONS.items()
    ]
    written = {area: row["mostWritten"] for area, row in rows.items() if row["mostWritten"]}
    assert written == protocol.WRITE_LIMITS
    assert [row["title"].lower().replace(" ", "_") for row in rows.values()] == list(types.AREAS)
    assert standard["LAST_ADDRESS"] == protocol.LAST_ADDRESS


def test_nothing_else_of_the_console_knows_a_limit() -> None:
    for file in FOLDER.glob("*.js"):
        found = re.findall(r"\b(2000|1968|125|123|121|65535)\b", file.read_text())
        assert found == [], file.name
    page = assets.read("/")[1].decode()
    [quantity] = re.findall(r'id="quantity"[^>]* max="(\d+)"', page)
    assert int(quantity) == protocol.READ_REGISTERS
    addresses = re.findall(r'(?:id="address"|name="first"|name="last")[^>]* max="(\d+)"', page)
    assert list(map(int, addresses)) == [protocol.LAST_ADDRESS] * 3

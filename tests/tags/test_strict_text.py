"""Text as a value of a type, as commands and writes give it."""

from __future__ import annotations

import re
from typing import Any

import pytest

from holdfast.tags.strict_text import from_text
from holdfast.values.types import parsed


def value(text: str, kind: str) -> Any:
    return from_text(text, parsed(kind), f"TYPE {kind}")


@pytest.mark.parametrize(
    ("text", "kind", "expected"),
    [
        ("true", "bool", True),
        ("1", "bool", True),
        ("false", "bit:3", False),
        ("0", "bit:3", False),
        (" 42 ", "uint16", 42),
        ("-7", "int16", -7),
        ("+7.", "int16", 7),
        ("2.50e1", "uint16", 25),
        ("1e20", "uint64", 10**20),
        ("123456789012345678901", "uint64", 123456789012345678901),
        ("18446744073709551615", "uint64", 2**64 - 1),
        ("9999", "bcd16", 9999),
        ("42", "float32", 42.0),
        (" -1.5e3", "float64", -1500.0),
        (".5", "float16", 0.5),
        ("1e308", "float64", 1e308),
        (" on ", "string:8", " on "),
        (" AQL/ ", "bytes:3", b"\x01\x02\xff"),
        ("[1, 2.5]", "uint16[2]", [1, 2.5]),
        ("[9007199254740993.0, 1.8446744073709551615e19]", "uint64[2]", [2**53 + 1, 2**64 - 1]),
        ("[0.5, -0.0, 1e2]", "int64[3]", [0.5, 0, 100]),
        ("[1e2, 0.1]", "float32[2]", [100.0, 0.1]),
        ("0e-400", "float32", 0.0),
        ("[5e-324, -0.0e-400]", "float64[2]", [5e-324, -0.0]),
        ('["AQL/", 5]', "bytes:3[2]", [b"\x01\x02\xff", 5]),
        ('["AQL/"]', "string:4[1]", ["AQL/"]),
    ],
    ids=repr,
)
def test_text_becomes_a_value_of_its_type(text: str, kind: str, expected: Any) -> None:
    found = value(text, kind)
    assert (found, type(found)) == (expected, type(expected))


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("True", "bool", "'True' is not a valid TYPE bool, allowed: true, false, 1 and 0"),
        ("on", "bit:3", "'on' is not a valid TYPE bit:3, allowed: true, false, 1 and 0"),
        ("2", "bool", "'2' is not a valid TYPE bool, allowed: true, false, 1 and 0"),
        ("much", "uint16", "'much' is not a valid TYPE uint16, allowed: a JSON number"),
        ("", "uint16", "'' is not a valid TYPE uint16, allowed: a JSON number"),
        ("1_000", "uint16", "'1_000' is not a valid TYPE uint16, allowed: a JSON number"),
        ("nan", "float32", "'nan' is not a valid TYPE float32, allowed: a JSON number"),
        ("0x10", "float32", "'0x10' is not a valid TYPE float32, allowed: a JSON number"),
        ("1e309", "float64", "'1e309' does not fit TYPE float64"),
        ("2.5", "uint16", "'2.5' is not a valid TYPE uint16"),
        ("1e21", "uint64", "'1e21' is not a valid TYPE uint64"),
        ("1e999", "uint64", "'1e999' is not a valid TYPE uint64"),
        ("zz!", "bytes:3", "'zz!' is not a valid TYPE bytes:3, allowed: base64"),
        ("AQL/é", "bytes:3", "'AQL/é' is not a valid TYPE bytes:3, allowed: base64"),
        ("AQ L/", "bytes:3", "'AQ L/' is not a valid TYPE bytes:3, allowed: base64"),
        ("1 2", "uint16[2]", "'1 2' is not a valid TYPE uint16[2], allowed: a JSON array"),
        ("5", "uint16[2]", "'5' is not a valid TYPE uint16[2], allowed: a JSON array"),
        ("null", "uint16[2]", "'null' is not a valid TYPE uint16[2], allowed: a JSON array"),
        (
            "[1, 900719925474099.37]",
            "int64[2]",
            "'900719925474099.37' has too many digits, allowed with a point: 15 - at `$[1]`",
        ),
        ("[1e999]", "float64[1]", "'1e999' is not a finite number - at `$[0]`"),
        ("1e-400", "float64", "'1e-400' is too small for TYPE float64, which would hold 0"),
        (
            "[1, -1e-99999999999999999999]",
            "int16[2]",
            "'-1e-99999999999999999999' is too small for int16[2], which would hold 0 - at `$[1]`",
        ),
        ('["zz!"]', "bytes:3[1]", "'zz!' is not a valid TYPE bytes:3[1], allowed: base64"),
    ],
    ids=repr,
)
def test_text_of_another_form_is_refused(text: str, kind: str, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        value(text, kind)


def test_an_array_nested_too_deeply_is_refused() -> None:
    with pytest.raises(ValueError, match=r"allowed: a JSON array$"):
        value("[" * 100_000, "uint16[2]")

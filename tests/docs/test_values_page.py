"""The page about values: its examples print what it says."""

from __future__ import annotations

import doctest
import re

from holdfast.values import encode
from support.paths import DOCS

PAGE = DOCS / "values.md"


def test_the_examples_of_the_page_print_what_it_says() -> None:
    blocks = re.findall(r"^```pycon\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    examples = doctest.DocTestParser().get_doctest("\n".join(blocks), {}, PAGE.name, str(PAGE), 0)
    told: list[str] = []

    results = doctest.DocTestRunner().run(examples, out=told.append)

    assert results.attempted > 20
    assert told == []


def test_the_picture_of_four_letters_is_what_encode_makes() -> None:
    rows = re.findall(r"^([A-D]{4})  .*?(\[\S+ .*?\])\s+(\[.*\])$", PAGE.read_text(), re.MULTILINE)

    assert [order for order, _, _ in rows] == ["ABCD", "DCBA", "BADC", "CDAB"]
    for order, four, eight in rows:
        assert bytes.fromhex(re.sub(r"[\[\]]", " ", four)) == packed(
            encode(0x01020304, "uint32", order)
        )
        assert bytes.fromhex(re.sub(r"[\[\]]", " ", eight)) == packed(
            encode(0x0102030405060708, "uint64", order)
        )


def packed(registers: list[int]) -> bytes:
    return b"".join(register.to_bytes(2) for register in registers)

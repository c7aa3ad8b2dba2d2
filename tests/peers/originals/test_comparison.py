"""A comparison fails for a new difference, for another one, and for one that has vanished."""

from __future__ import annotations

import pytest

from peers.originals.comparison import Difference, Original, Reason, table, unexpected

REASON = Reason("a device must not be harmed", "modbus.md", "words")


def original(*rows: Difference, variable: str = "HOLDFAST_ORIGINAL_NOTHING") -> Original:
    return Original("it", variable, rows, lambda *_: {}, lambda _: {})


def test_a_difference_with_its_row_is_expected() -> None:
    row = Difference("read", "02", "03", REASON)
    assert unexpected(original(row), {"read": "02", "write": ""}, {"read": "03", "write": ""}) == []


def test_a_difference_without_a_row_is_new() -> None:
    wrong = unexpected(original(), {"read": "02"}, {"read": "03"})
    assert wrong == ["read: a new difference: '02', ours: '03'"]


@pytest.mark.parametrize(
    ("theirs", "ours", "what"),
    [("03", "03", "has vanished"), ("02", "04", "is another one"), ("01", "03", "is another one")],
)
def test_a_row_must_be_exactly_what_was_found(theirs: str, ours: str, what: str) -> None:
    row = Difference("read", "02", "03", REASON)
    wrong = unexpected(original(row), {"read": theirs}, {"read": ours})
    assert wrong == [f"read: the difference {what}: {theirs!r}, ours: {ours!r}"]


def test_a_row_needs_an_input() -> None:
    wrong = unexpected(original(Difference("write", "02", "03", REASON)), {}, {})
    assert wrong == ["write: there is no such input"]


def test_the_table_names_what_is_not_documented() -> None:
    row = Difference("read", "02", "03", REASON)
    lines = table(
        original(row), {"read": "02", "write": 1}, {"read": "03", "write": 2}
    ).splitlines()
    assert lines[0] == "it: 2 inputs, 2 differences"
    assert lines[-2:] == [
        '| read | "02" | "03" | a device must not be harmed (modbus.md) |',
        "| write | 1 | 2 | NOT DOCUMENTED |",
    ]


def test_a_reason_must_be_in_the_words_of_its_page() -> None:
    assert not Reason("", "modbus.md", "no such words in any page").is_documented
    assert Reason("", "index.md", "A Modbus memory that many writers fill and many").is_documented


def test_without_its_variable_a_comparison_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CI", "true")
    monkeypatch.delenv("HOLDFAST_ORIGINAL_NOTHING", raising=False)
    with pytest.raises(pytest.skip.Exception, match="HOLDFAST_ORIGINAL_NOTHING is not set"):
        original().command()

"""Values and lists in messages."""

from __future__ import annotations

from holdfast.runtime.text import all_of, clip, either, listing, quote, suggestion


def test_a_long_text_is_cut() -> None:
    assert clip("a" * 40) == "a" * 40
    assert clip("a" * 41) == "a" * 40 + "…"
    assert clip("abc", 2) == "ab…"


def test_a_quoted_text_is_cut_and_has_no_control_characters() -> None:
    assert quote("pump\x1b[2J\n") == r"'pump\x1b[2J\n'"
    assert quote("a" * 1000) == f"'{'a' * 40}'…"


def test_lists_are_as_in_a_sentence() -> None:
    assert [either("a"), either("ab"), either("abc")] == ["a", "a or b", "a, b or c"]
    assert [all_of([5]), all_of([5, 6]), all_of([5, 6, 15])] == ["5", "5 and 6", "5, 6 and 15"]
    assert either(["a", "b", "a"]) == "a or b"
    assert listing([1, 2, 3]) == "1, 2, 3"


def test_a_close_word_is_suggested() -> None:
    assert suggestion("coil", ["holding_registers", "coils"]) == "; did you mean 'coils'?"
    assert suggestion("x", ["holding_registers"]) == ""

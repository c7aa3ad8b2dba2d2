"""Which known word is suggested."""

from __future__ import annotations

from holdfast.runtime.suggestion import suggestion


def test_a_close_word_is_suggested() -> None:
    assert suggestion("coil", ["holding_registers", "coils"]) == "; did you mean 'coils'?"
    assert suggestion("x", ["holding_registers"]) == ""


def test_nothing_is_suggested_for_a_long_word() -> None:
    assert suggestion("m" * 256 + "emory", ["m" * 256 + "emory"]) == ""


def test_a_word_in_another_case_is_suggested_before_words_that_are_close() -> None:
    types = ["modbus-udp", "modbus-tcp", "read_only"]
    assert suggestion("Modbus-TCP", types) == "; did you mean 'modbus-tcp'?"
    assert suggestion("Read-Only", types) == "; did you mean 'read_only'?"
    assert suggestion("plant_b", ["plant_a", "Plant_B"]) == "; did you mean 'Plant_B'?"

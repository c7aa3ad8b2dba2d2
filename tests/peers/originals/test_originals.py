"""Holdfast and the programs that it replaces differ only where the documentation says so.

`comparison` describes how a comparison is run. `pytest -s` prints the tables of differences.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from peers.originals import mma, mma2, port_of_call, replicator, tentacle_modbus, tentacle_next
from peers.originals.comparison import table, unexpected

if TYPE_CHECKING:
    from pathlib import Path

    from peers.originals.comparison import Answers, Original

ORIGINALS = (
    mma.ORIGINAL,
    mma2.ORIGINAL,
    replicator.ORIGINAL,
    port_of_call.ORIGINAL,
    tentacle_modbus.ORIGINAL,
    tentacle_next.ORIGINAL,
)


def name(original: Original) -> str:
    return original.name


@pytest.fixture(params=ORIGINALS, ids=name)
def original(request: pytest.FixtureRequest) -> Original:
    found: Original = request.param
    return found


def folder(tmp_path: Path, name: str) -> Path:
    (tmp_path / name).mkdir()
    return tmp_path / name


def test_the_answers_differ_from_those_of_the_original_only_where_the_table_says_so(
    original: Original, tmp_path: Path
) -> None:
    command = original.command()
    theirs = original.theirs(command, folder(tmp_path, "theirs"))
    ours = original.ours(folder(tmp_path, "ours"))
    print(f"\n{table(original, theirs, ours)}")
    wrong = unexpected(original, theirs, ours)
    assert not wrong, "\n".join(wrong)


def test_holdfast_answers_as_the_table_says(original: Original, tmp_path: Path) -> None:
    ours: Answers = original.ours(folder(tmp_path, "ours"))
    expected = {row.input: row.ours for row in original.differences}
    assert {name: ours[name] for name in expected} == expected


def test_each_difference_is_in_the_documentation(original: Original) -> None:
    reasons = {row.reason for row in original.differences}
    assert [reason.words for reason in reasons if not reason.is_documented] == []

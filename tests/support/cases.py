"""The cases of a run: how many a property test draws, and which `make test` leaves out."""

from __future__ import annotations

import fnmatch
import os
from typing import TYPE_CHECKING

from support.paths import TESTS

if TYPE_CHECKING:
    from collections.abc import Iterable

IS_EXPLORING = os.environ.get("HOLDFAST_EXPLORE") == "1"
"""Whether `make explore` runs: property tests draw new cases, and more of them."""

FACTOR = 20
"""How many times as many cases `make explore` draws."""

SLOW = TESTS / "slow.txt"


def examples(count: int) -> int:
    """The `max_examples` of a property test that draws `count` cases in `make test`."""
    return count * FACTOR if IS_EXPLORING else count


def slow_ids() -> list[str]:
    """The cases that `make test` leaves out."""
    lines = (line.partition("#")[0].strip() for line in SLOW.read_text().splitlines())
    return [line for line in lines if line]


def is_listed(case: str, ids: Iterable[str]) -> bool:
    """Whether a case is in the list: whole files, functions, single cases, and patterns with *."""
    function = case.partition("[")[0]
    names = {case, function, function.partition("::")[0]}
    return any(
        fnmatch.fnmatchcase(case, line.replace("[", "[[]")) if "*" in line else line in names
        for line in ids
    )

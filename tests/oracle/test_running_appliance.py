"""Many writers and readers over every face of a running appliance, while everything is disturbed.

Nobody may see what no order of their requests explains. In short by default; with
HOLDFAST_TORTURE=1 for HOLDFAST_TORTURE_SECONDS (600), half of them with `holdfast run` in a
process of its own. HOLDFAST_SEED repeats the requests of a run, though not how threads meet.
"""

from __future__ import annotations

import os
import random
import time
from collections import Counter
from contextlib import nullcontext
from itertools import islice
from typing import TYPE_CHECKING

import pytest

from oracle.checker import check
from oracle.plant import InProcess, OwnProcess, Plant
from oracle.planted_faults import FAULTS, Evidence
from oracle.rounds import WAYS, Round, started

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

IS_LONG = os.environ.get("HOLDFAST_TORTURE") == "1"
SECONDS = float(os.environ.get("HOLDFAST_TORTURE_SECONDS", "600"))
SEED = int(os.environ.get("HOLDFAST_SEED") or (time.time() if IS_LONG else 1))

REQUESTS = 120
"""Of each client, in the short form."""
EVERY = 40
"""So many operations are between two disturbances."""

LONG_REQUESTS = 1500
LONG_EVERY = 500

EACH = 3
"""Faults of each kind that are planted."""
SAMPLE = 3
"""Kinds of faults that are planted in a round of the long form."""

ENDS = {
    "write done",
    "write refused",
    "cut within refused",
    "cut behind unknown",
    "read done",
    "write and read done",
    "publish done",
    "passed write done",
    "passed write refused",
}
"""What became of requests."""

FACES = {way.name for way, _ in WAYS} | {"mqtt"}


def report(found: Round) -> str:
    """What is wrong with a round; empty if nothing is."""
    return "\n".join([*map(str, check(found.history)), *found.surprises][:20])


def planted(found: Round, each: int, names: Collection[str] = tuple(FAULTS)) -> dict[str, bool]:
    """Plants some faults of each kind, where there is a place for one. Returns which are found."""
    evidence = Evidence(found.history, random.Random(SEED))
    return {
        f"{name} {number}": bool(check(history))
        for name in names
        for number, history in enumerate(islice(FAULTS[name](evidence), each))
    }


def test_an_order_of_the_requests_explains_all_that_was_seen(tmp_path: Path) -> None:
    with started(InProcess, tmp_path, SEED) as oracle:
        found = oracle.round(REQUESTS, EVERY)
    assert report(found) == ""
    faults = planted(found, EACH)
    assert len(faults) >= 30
    assert [name for name, is_found in faults.items() if not is_found] == []
    assert {face: count for face, count in found.by_face.items() if count < REQUESTS / 3} == {}
    assert set(found.by_face) == FACES
    assert found.sights > 2000
    assert len(set(found.disturbances)) > 4
    assert set(found.ends) >= ENDS


@pytest.mark.skipif(not IS_LONG, reason="minutes to hours: HOLDFAST_TORTURE=1 runs it")
@pytest.mark.timeout(SECONDS + 600)
@pytest.mark.parametrize("kind", [InProcess, OwnProcess])
def test_nothing_unexplained_is_seen_for_long(
    kind: type[Plant], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def say(text: str) -> None:
        with capsys.disabled() if IS_LONG else nullcontext():
            print(text, flush=True)

    say(f"\nHOLDFAST_SEED={SEED}, {kind.__name__}")
    began = time.monotonic()
    by_face: Counter[str] = Counter()
    ends: Counter[str] = Counter()
    disturbances: Counter[str] = Counter()
    sights = count_of_faults = 0
    chance = random.Random(SEED)
    with started(kind, tmp_path, SEED) as oracle:
        while time.monotonic() < began + SECONDS / 2:
            start = time.monotonic()
            found = oracle.round(LONG_REQUESTS, LONG_EVERY)
            seconds = time.monotonic() - start
            by_face += found.by_face
            ends += found.ends
            disturbances.update(found.disturbances)
            sights += found.sights
            count = found.by_face.total()
            say(f"{count} operations, {count / seconds:.0f} a second, {found.sights} values seen")
            if wrong := report(found):
                file = tmp_path / "history.txt"
                file.write_text(found.history.lines())
                raise AssertionError(f"{wrong}\nThe history is in {file}")
            some = chance.sample(list(FAULTS), SAMPLE)
            faults = planted(found, 1, some)
            assert [name for name, is_found in faults.items() if not is_found] == []
            count_of_faults += len(faults)
    say(f"{by_face.total()} operations, {sights} values seen, 0 violations")
    say(f"{count_of_faults} faults were planted, and found")
    for counts in (by_face, ends, disturbances):
        say(", ".join(f"{name} {count}" for name, count in sorted(counts.items())))

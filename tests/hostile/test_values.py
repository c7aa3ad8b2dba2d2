"""No value that reaches a caller or a memory answers another request, however a device misbehaves.

Every mode runs on every transport with the blocking client, and with one of the other clients.
`HOLDFAST_TORTURE=1` runs all combinations, for an hour; `HOLDFAST_TORTURE_SECONDS` sets another
time.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import pytest

from hostile.clients import CLIENTS, Blocking, Passed
from hostile.devices import Device
from hostile.judge import Judge
from hostile.modes import MODES
from support import wire

if TYPE_CHECKING:
    from pathlib import Path

    from hostile.clients import Asking
    from hostile.modes import Mode

IS_LONG = bool(os.environ.get("HOLDFAST_TORTURE"))
SECONDS = float(os.environ.get("HOLDFAST_TORTURE_SECONDS", "3600"))
AT_ONCE = 8
"""Combinations that run at the same time."""

KINDS = ("tcp", "udp", "rtu+tcp", "rtu")
MORE_KINDS = ("rtu+udp", "ascii+tcp", "ascii")

TIMEOUT = 0.1
"""Of the clients."""

REQUESTS = 10
"""That a device gets in the short form."""


class Combination(NamedTuple):
    """A device and its client."""

    mode: str
    kind: str
    client: type[Asking]

    def __str__(self) -> str:
        return f"{self.mode} / {self.kind} / {self.client.__name__}"


class Outcome(NamedTuple):
    """What came of a combination."""

    of: Combination
    counts: Counter[str]
    faults: list[str]

    @property
    def is_wrong(self) -> bool:
        mode = MODES[self.of.mode]
        return self.counts["wrong"] > 0 and not mode.is_undetectable(self.of.kind)


def with_client(mode: int, kind: int) -> list[Combination]:
    """The combinations of the short form: those of the first client, and of another one in turn."""
    names = list(MODES)
    others = [client for client in CLIENTS[1:] if KINDS[kind] in client.kinds]
    chosen = others[(mode + kind) % len(others)]
    return [Combination(names[mode], KINDS[kind], client) for client in (Blocking, chosen)]


def must_be_right(of: Combination) -> bool:
    """Whether some reads have right values. Writes that are passed on are no reads."""
    mode = MODES[of.mode]
    return not mode.fails(of.kind) and of.client is not Passed


def outcome(of: Combination, folder: Path, seconds: float = 0.0) -> Outcome:
    """Lets a client ask a device for some time, and until there are enough requests."""
    mode: Mode = MODES[of.mode]
    with Device(of.kind, mode.vice, TIMEOUT, folder) as device:
        judge = Judge(device)
        until = time.monotonic() + seconds
        with of.client(device, judge, folder) as client:

            def is_enough() -> bool:
                client.step()
                is_right = judge.counts["right"] > 0 or not must_be_right(of)
                is_over = time.monotonic() >= until and device.received >= REQUESTS
                return is_over and (is_right or bool(judge.faults))

            wire.until(is_enough, f"{of}: some values are right", seconds + wire.DEADLINE)
    judge.end()
    return Outcome(of, judge.counts, judge.faults)


def outcomes(combinations: list[Combination], folder: Path, seconds: float = 0.0) -> list[Outcome]:
    with ThreadPoolExecutor(AT_ONCE) as threads:
        return list(threads.map(lambda of: outcome(of, folder, seconds), combinations))


def judged(found: list[Outcome]) -> None:
    wrong = [f"{each.of}: {each.counts}: {each.faults[:3]}" for each in found if each.is_wrong]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("mode", range(len(MODES)), ids=list(MODES))
def test_no_value_answers_another_request(mode: int, tmp_path: Path) -> None:
    combinations = [each for kind in range(len(KINDS)) for each in with_client(mode, kind)]
    judged(outcomes(combinations, tmp_path))


def test_a_mode_that_can_not_be_detected_says_why() -> None:
    for name, mode in MODES.items():
        is_undetectable = any(mode.is_undetectable(kind) for kind in (*KINDS, *MORE_KINDS))
        assert is_undetectable == bool(mode.reason), name


@pytest.mark.timeout(0)
@pytest.mark.skipif(not IS_LONG, reason="an hour: HOLDFAST_TORTURE=1 runs it")
def test_no_value_answers_another_request_in_any_combination(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kinds = (*KINDS, *MORE_KINDS)
    combinations = [
        Combination(mode, kind, client)
        for mode in MODES
        for kind in kinds
        for client in CLIENTS
        if kind in client.kinds
    ]
    seconds = SECONDS * AT_ONCE / len(combinations)
    found = outcomes(combinations, tmp_path, seconds)
    with capsys.disabled():
        print("\n" + "\n".join(f"{each.of}: {dict(each.counts)}" for each in found))
    judged(found)

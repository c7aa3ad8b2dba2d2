"""Counts the requests of `describe map` and what they find, on simulated devices.

One area, three searches: all samples, those of `--sparse`, and every address (`--exact`). No time
is measured, and no network is used: two runs of one version print the same.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from random import Random
from typing import TypeAlias

from holdfast.client.requests import carry_out
from holdfast.discovery.address_search import Outcome, Probe, Survey
from holdfast.protocol import ADDRESSES, ILLEGAL_ADDRESS, ILLEGAL_FUNCTION, ILLEGAL_VALUE
from holdfast.types import Area

Device: TypeAlias = Callable[[Probe], Outcome]

SHORT = (
    *((0, 2), (100, 4), (210, 3), (350, 2), (501, 2), (1000, 2), (2001, 4), (4096, 2), (5020, 2)),
    *((8000, 1), (12300, 2), (20000, 5), (30001, 6), (40001, 100), (40230, 4), (50000, 2)),
)
"""Short ranges at the places of real maps."""

AREAS: tuple[Area, ...] = ("holding_registers",)
SEARCHES: dict[str, Callable[[], Survey]] = {
    "samples": lambda: Survey(AREAS),
    "--sparse": lambda: Survey(AREAS, dense=False),
    "--exact": lambda: Survey(AREAS, exact=True),
}


def main() -> None:
    """Prints a table, and writes all figures to the file of `--json`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="file for all figures")
    options = parser.parse_args()
    print(
        f"{'device':34}{'exist':>12}", *(f"{name + ': requests, found':>31}" for name in SEARCHES)
    )
    figures: dict[str, dict[str, list[int]]] = {}
    for name, (layout, device) in devices().items():
        there = f"{len(layout)} / {sum(map(len, layout))}"
        row = figures[name] = {search: searched(device, search) for search in SEARCHES}
        cells = (
            f"{f'{sent:,}':>13}, {f'{ranges} / {found}':>16}"
            for sent, ranges, found in row.values()
        )
        print(f"{name:34}{there:>12}", *cells)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1))


def searched(device: Device, search: str) -> list[int]:
    """The requests of a search, and how many ranges and addresses it finds."""
    survey = SEARCHES[search]()
    carry_out(survey.steps(), device)
    [found] = survey.areas
    return [found.requests, len(found.ranges), found.addresses]


def devices() -> dict[str, tuple[list[range], Device]]:
    """Each device with the ranges that it has."""
    short = [range(first, first + count) for first, count in SHORT]
    blocks = [range(500), range(1000, 1300), range(5000, 5700)]
    single = [range(at, at + 1) for at in range(0, 400, 2)]
    everything = [range(ADDRESSES)]
    floats = [range(36), range(52, 54), range(70, 76)]
    return {
        "16 short ranges": (short, having(short)),
        "30 ranges of 20 to 200, anywhere": (anywhere := scattered(30, 20, 200), having(anywhere)),
        "30 ranges of 2 to 8, anywhere": (tiny := scattered(30, 2, 8), having(tiny)),
        "every second register of 400": (single, having(single)),
        "3 blocks, 64 registers a read": (blocks, having(blocks, most=64)),
        "SunSpec": (sunspec := [range(40_000, 40_180)], having(sunspec)),
        "zeros everywhere": (everything, having(everything)),
        "zeros everywhere, 32 a read": (everything, having(everything, most=32)),
        "22 floats, only read whole": (floats, having(floats, width=2)),
        "nothing": ([], having([])),
        "function not supported": ([], lambda _: ILLEGAL_FUNCTION),
    }


def having(layout: Iterable[range], most: int = 125, width: int = 1) -> Device:
    """A device with these addresses, which reads at most so many at once, and only whole values of
    `width` registers."""
    addresses = {address for each in layout for address in each}

    def answer(probe: Probe) -> Outcome:
        if probe.count > most:
            return ILLEGAL_VALUE
        asked = range(probe.address, probe.address + probe.count)
        if asked.start % width or asked.stop % width:
            return ILLEGAL_ADDRESS
        return None if addresses.issuperset(asked) else ILLEGAL_ADDRESS

    return answer


def scattered(number: int, least: int, most: int) -> list[range]:
    """Ranges at random addresses, the same in every run, that do not touch."""
    chance = Random(1)
    found: list[range] = []
    while len(found) < number:
        first = chance.randrange(ADDRESSES - most)
        new = range(first, first + chance.randint(least, most))
        if all(new.stop < each.start or each.stop < new.start for each in found):
            found.append(new)
    return sorted(found, key=lambda each: each.start)


if __name__ == "__main__":
    main()

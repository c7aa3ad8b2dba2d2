"""Measures how far the confidence of `describe guess` and `describe` can be trusted.

Judges their claims about the blocks of `tests/calibration`: the corpus that judges (`judging.py`),
and the one to which the rules are adjusted (`tuning.py`), if it exists. The result depends on the
rules only: no time is measured.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

# The folder of the corpora has the name of this script, and must be found instead of it.
sys.path[0] = str(Path(__file__).parent.parent / "tests")

from calibration import judge  # noqa: E402
from calibration.judge import Claim, Row  # noqa: E402

CORPORA = ("judging", "tuning")


def main() -> None:
    """Prints the tables of each corpus."""
    options = arguments()
    kept: dict[str, Any] = {}
    for name in options.corpus or CORPORA:
        if importlib.util.find_spec(f"calibration.{name}") is None:
            print(f"\ntests/calibration/{name}.py does not exist.")
            continue
        cases = list(importlib.import_module(f"calibration.{name}").cases())
        values = sum(truth.type != "empty" for case in cases for truth in case.values)
        print(f"\n## {name}: {len(cases)} blocks with {values} values")
        claims = judge.judged(cases)
        show(claims, options)
        kept[name] = sorted(judge.held(claims))
        if options.against:
            compare(claims, json.loads(options.against.read_text())[name])
    if options.held:
        options.held.write_text(json.dumps(kept, indent=0))


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--corpus", action="append", choices=CORPORA, help="default: all")
    parser.add_argument("--wrong", type=int, default=0, help="print so many sure, wrong claims")
    parser.add_argument("--held", type=Path, help="file for the true claims that are sure")
    parser.add_argument("--against", type=Path, help="file of --held of an earlier version")
    return parser.parse_args()


def show(claims: Sequence[Claim], options: argparse.Namespace) -> None:
    for face in ("guess", "describe"):
        some = [each for each in claims if each.face == face]
        table(f"{face}, confidence", judge.buckets(some))
        sure = judge.by(some, lambda _: "all")
        table(f"{face}, from {judge.SURE}", [*sure, *judge.by(some, lambda one: one.case.kind)])
        table(f"{face}, from {judge.SURE}", judge.by(some, lambda one: change(one)))
        table(f"{face}, from {judge.SURE}", judge.by(some, lambda one: family(one.type)))
        for each in spread(judge.wrong(some), options.wrong):
            print(f"* {each}")


def change(claim: Claim) -> str:
    return "live block" if claim.case.live else "still block"


def family(type: str) -> str:
    """A type without its size in bytes or elements."""
    return type.split(":")[0].split("[")[0]


def spread(claims: Sequence[Claim], count: int) -> Iterable[Claim]:
    """So many claims, at equal distances."""
    return claims[:: max(1, len(claims) // count)][:count] if count else ()


def table(title: str, rows: Iterable[Row]) -> None:
    print(f"\n| {title} | claims | true | wrong | share |\n| --- | --- | --- | --- | --- |")
    for row in rows:
        share = f"{row.share:.3f}" if row.count else ""
        print(f"| {row.name} | {row.count} | {row.true} | {row.wrong} | {share} |")


def compare(claims: Sequence[Claim], before: Iterable[Sequence[Any]]) -> None:
    """Prints how many of the sure and true claims of an earlier version are still made, and what is
    claimed with less confidence, or something else, instead of the others.
    """
    old = {tuple(each) for each in before}
    now = judge.held(claims)
    share = len(old & now) / len(old) if old else 1.0
    print(f"\n{len(old & now)} of {len(old)} sure and true claims remain ({share:.3f})")
    others = [each for each in claims if each.key in old - now]
    for face in ("guess", "describe"):
        some = [each for each in others if each.face == face]
        rows = judge.by(some, lambda one: f"{family(one.type)}, {change(one)}", at_least=0.0)
        table(f"{face}, no longer sure", rows)


if __name__ == "__main__":
    main()

"""The table of what other documents say: tests show each sentence, or a page explains it."""

from __future__ import annotations

import re
from pathlib import Path

from support.paths import ROOT

ROWS = [
    [cell.strip() for cell in line.strip("|").split(" | ")]
    for line in (Path(__file__).parent / "sentences.md").read_text().splitlines()
    if re.match(r"\| \d+ \|", line)
]
TEST = re.compile(r"`([\w/]+\.(?:py|rs))::(\w+)")


def test_every_sentence_that_holds_names_tests_that_exist() -> None:
    missing = [
        (number, file, name)
        for number, _, _, holds, shown in ROWS
        for file, name in TEST.findall(shown) or [("none", "")]
        if holds == "yes"
        and not (
            (ROOT / file).exists() and re.search(rf"\b(def|fn) {name}\(", (ROOT / file).read_text())
        )
    ]
    assert missing == []


def test_every_other_sentence_is_on_a_page_and_they_are_few() -> None:
    others = [shown for _, _, _, holds, shown in ROWS if holds != "yes"]
    assert all((ROOT / shown.split(":")[0]).exists() for shown in others), others
    assert len(others) / len(ROWS) <= 0.03

"""The pages on the structure name what exists, and docs/architecture.md stays short."""

from __future__ import annotations

import re

import pytest

from support.paths import DOCS, ROOT

MAX_LINES = 250
PATH = re.compile(r"`((?:crates|python|tests|docs|benches|examples)/[\w/.]+)`")


@pytest.mark.parametrize("page", ["architecture.md", "extending.md", "decisions.md"])
def test_every_file_that_a_page_names_exists(page: str) -> None:
    named = PATH.findall((DOCS / page).read_text(encoding="utf-8"))
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_the_tree_has_every_room() -> None:
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    tree = text.split("## The tree")[1].split("## Floors")[0]
    rooms = [
        *(path.name for path in (ROOT / "python" / "holdfast").iterdir() if path.is_dir()),
        *(path.parent.name for path in (ROOT / "crates").glob("*/Cargo.toml")),
    ]
    named = set(re.findall(r"[\w]+", " ".join(re.findall(r"`[^`]+`", tree))))
    assert [room for room in rooms if room not in named and not room.startswith("_")] == []


def test_architecture_can_be_read_at_once() -> None:
    lines = (DOCS / "architecture.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= MAX_LINES

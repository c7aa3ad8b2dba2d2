"""Names of constants: `MAX_` starts a maximum, `TIMEOUT` is a time after which a wait ends."""

from __future__ import annotations

import re

from support.paths import ROOT

OLD = re.compile(
    r"\b(?:(?!AT_)[A-Z]+_)*(?:(?:MOST|LONGEST|LARGEST|LEAST)(?:_[A-Z]\w*)?|PATIENCE)\b"
)
KINDS = {".py", ".pyi", ".rs", ".js"}


def test_each_limit_has_the_usual_name() -> None:
    files = [
        file
        for folder in ("python", "crates", "benches", "tests")
        for file in (ROOT / folder).rglob("*")
        if file.suffix in KINDS and file.name != "test_names.py"
    ]
    assert len(files) > 500
    found = {
        f"{file.relative_to(ROOT)}: {name[0]}"
        for file in files
        for name in OLD.finditer(file.read_text(encoding="utf-8"))
    }
    assert not found

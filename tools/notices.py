"""Writes the licences of the crates that are part of the native core."""

from __future__ import annotations

import re
import tomllib
from typing import TYPE_CHECKING

import vendoring

if TYPE_CHECKING:
    from pathlib import Path

NAME = "LICENSE-third-party.txt"
"""`license-files` in pyproject.toml matches it, so every wheel has it."""

LICENCE = re.compile(r"(?i)(licen[cs]e|copying|copyright|notice|unlicense)")
CODE = {".rs", ".c", ".h", ".py", ".go", ".json", ".toml"}
TITLE = """\
The native core of Holdfast contains the crates below, which have these licences.

"""


def write(folder: Path) -> None:
    """Writes the notices of an unpacked source distribution, and names them in its metadata."""
    texts: dict[str, list[str]] = {}
    for name, version in sorted(vendoring.used(folder, "normal")):
        crate = folder / "vendor" / f"{name}-{version}"
        stated = tomllib.loads((crate / "Cargo.toml").read_text())["package"]
        title = f"{name} {version}: {stated.get('license') or stated['license-file']}"
        for text in _licences(crate) or ["No text in the crate: see the licence named above."]:
            texts.setdefault(text, []).append(title)
    parts = ["\n".join(titles) + f"\n\n{text}\n" for text, titles in texts.items()]
    rule = "\n" + "-" * 80 + "\n\n"
    (folder / NAME).write_text(TITLE + rule.join(parts))
    about = folder / "PKG-INFO"
    named = about.read_text().replace(
        "License-File: LICENSE\n", f"License-File: LICENSE\nLicense-File: {NAME}\n", 1
    )
    about.write_text(named)


def _licences(crate: Path) -> list[str]:
    """The texts of a crate, each once."""
    files = (each for each in sorted(crate.rglob("*")) if LICENCE.match(each.name))
    texts = [
        each.read_text(errors="replace").replace("\r\n", "\n").strip()
        for each in files
        if each.is_file() and each.suffix not in CODE
    ]
    return list(dict.fromkeys(texts))

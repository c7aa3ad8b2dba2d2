"""Crates in the source distribution, and their licences. `test_dist.py` checks what was built."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

import notices
import vendoring

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An unpacked source distribution with two crates that have the same licence."""
    (tmp_path / "PKG-INFO").write_text("Name: holdfast\nLicense-File: LICENSE\n\nLicense-File: x\n")
    for name in ("one", "two"):
        crate = tmp_path / "vendor" / f"{name}-1.0.0"
        (crate / "src").mkdir(parents=True)
        (crate / "src" / "license.rs").write_text("code")
        (crate / "Cargo.toml").write_text(f'[package]\nname = "{name}"\nlicense = "MIT"\n')
        (crate / ".cargo-checksum.json").write_text('{"files": {"LICENSE": "0"}, "package": "1"}')
        (crate / "LICENSE-MIT").write_text("Permission is granted\r\n")
    (tmp_path / "vendor" / "two-1.0.0" / "NOTICE").write_text("By two\n")
    return tmp_path


def test_the_notices_have_each_licence_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    crates = {("one", "1.0.0"), ("two", "1.0.0")}
    monkeypatch.setattr(vendoring, "used", lambda folder, edges: crates)  # noqa: ARG005
    notices.write(folder)
    text = (folder / notices.NAME).read_text()
    assert text.count("Permission is granted") == text.count("By two") == 1
    assert "one 1.0.0: MIT\ntwo 1.0.0: MIT\n\nPermission is granted\n" in text
    assert "two 1.0.0: MIT\n\nBy two\n" in text
    assert "code" not in text
    named = (folder / "PKG-INFO").read_text()
    assert named.startswith(
        f"Name: holdfast\nLicense-File: LICENSE\nLicense-File: {notices.NAME}\n"
    )


def test_a_crate_that_no_build_uses_keeps_only_its_manifest(folder: Path) -> None:
    crate = folder / "vendor" / "one-1.0.0"
    manifest = (crate / "Cargo.toml").read_text()
    vendoring.empty(crate)
    files = {str(each.relative_to(crate)) for each in crate.rglob("*") if each.is_file()}
    assert files == {"Cargo.toml", ".cargo-checksum.json", "src/lib.rs"}
    assert (crate / "Cargo.toml").read_text() == manifest
    assert (crate / "src" / "lib.rs").read_text() == ""
    assert json.loads((crate / ".cargo-checksum.json").read_text()) == {
        "files": {},
        "package": "1",
    }


def test_a_crate_loses_what_no_build_reads(folder: Path) -> None:
    crate = folder / "vendor" / "one-1.0.0"
    kept = ["src/license.rs", "src/tests/case.rs", "docs/notes.md", "Cargo.toml", "LICENSE-MIT"]
    removed = ["tests/data/large.txt", "benches/speed.rs", "Cargo.lock", "src/c/sum_test.cc"]
    for name in kept + removed:
        (crate / name).parent.mkdir(parents=True, exist_ok=True)
        (crate / name).touch()
    sums = {"files": dict.fromkeys(kept + removed, "0"), "package": "1"}
    (crate / ".cargo-checksum.json").write_text(json.dumps(sums))
    vendoring.prune(crate)
    files = {str(each.relative_to(crate)) for each in crate.rglob("*") if each.is_file()}
    assert files == {*kept, ".cargo-checksum.json"}
    assert json.loads((crate / ".cargo-checksum.json").read_text()) == {
        "files": dict.fromkeys(kept, "0"),
        "package": "1",
    }

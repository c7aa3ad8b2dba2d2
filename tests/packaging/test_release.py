"""What is checked before a release."""

from __future__ import annotations

import zipfile
from typing import TYPE_CHECKING, Any

import pytest

from support.packaging_programs import program
from support.paths import ROOT

if TYPE_CHECKING:
    from pathlib import Path

CHANGELOG = """\
# Changelog

## [Unreleased]

### Added

## [0.2.0] - 2027-01-31

### Fixed

## [0.1.0] - 2026-12-01
"""


@pytest.fixture
def check(monkeypatch: pytest.MonkeyPatch) -> Any:
    return program("release/check", monkeypatch)


@pytest.fixture
def changelog(monkeypatch: pytest.MonkeyPatch) -> Any:
    return program("release/changelog", monkeypatch)


def test_the_changelog_has_the_form_of_keep_a_changelog(changelog: Any) -> None:
    assert changelog.problems((ROOT / "CHANGELOG.md").read_text()) == []
    assert changelog.problems(CHANGELOG) == []
    assert changelog.released(CHANGELOG) == ["0.2.0", "0.1.0"]


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("[0.2.0] - 2027", "0.2.0 (2027", "CHANGELOG.md:7: found '## 0.2.0 (2027-01-31'"),
        ("[0.2.0]", "[0.0.9]", "CHANGELOG.md:11: 0.1.0 is below an older release"),
        ("### Fixed", "### Repaired", "CHANGELOG.md:9: found 'Repaired', allowed: Added, Changed"),
        ("## [0.1.0] - 2026-12-01", "## [Unreleased]", "CHANGELOG.md:11: unreleased changes"),
    ],
)
def test_what_is_wrong_in_a_changelog_is_named(
    changelog: Any, old: str, new: str, told: str
) -> None:
    [problem] = changelog.problems(CHANGELOG.replace(old, new))
    assert problem.startswith(told)
    assert changelog.problems("# Changelog\n") == ["CHANGELOG.md: no section"]


def test_versions_agree(check: Any) -> None:
    assert check.versions(check.current_version()) == []


def test_other_versions_are_named(check: Any) -> None:
    told = check.versions("99.0.0")
    assert any("holdfast-engine is" in problem for problem in told)
    assert any("packaging/kubernetes/holdfast.yaml: the image is" in problem for problem in told)


def test_a_tag_needs_its_version_and_its_section(
    check: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "CHANGELOG.md").write_text(CHANGELOG)
    monkeypatch.setattr(check, "ROOT", tmp_path)
    assert check.changes("0.2.0", "v0.2.0") == []
    assert check.changes("0.3.0", None) == []
    assert check.changes("0.2.0", "v0.3.0") == [
        "the tag is v0.3.0, but Cargo.toml has 0.2.0: it must be v0.2.0"
    ]
    assert check.changes("0.3.0", "v0.3.0") == [
        "CHANGELOG.md: the first section is not '## [0.3.0] - DATE'"
    ]


def test_missing_packages_are_named(check: Any, tmp_path: Path) -> None:
    assert check.wheels(tmp_path, "0.2.0") == [f"{tmp_path}: no wheel of 0.2.0: make dist"]
    assert check.debian(tmp_path, "0.2.0") == [f"{tmp_path}: no Debian package of 0.2.0: make deb"]


def test_a_core_that_is_too_large_is_named(check: Any, tmp_path: Path) -> None:
    wheel = tmp_path / "holdfast_modbus-0.2.0-cp311-abi3-linux_x86_64.whl"

    def problems(size: int) -> list[str]:
        with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("holdfast/_core.abi3.so", bytes(size))
            for part in check.IN_WHEELS[1:]:
                archive.writestr(part, b"")
        found: list[str] = check.wheels(tmp_path, "0.2.0")
        return found

    assert problems(13_000_000) == []
    assert problems(13_000_001) == [
        f"{wheel.name}: holdfast/_core.abi3.so has 13,000,001 bytes, allowed: 13,000,000"
    ]

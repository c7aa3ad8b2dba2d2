"""Checks that CHANGELOG.md has the form of Keep a Changelog."""

from __future__ import annotations

import re

RELEASE = re.compile(r"## \[(?P<version>\d+\.\d+\.\d+)\] - \d{4}-\d\d-\d\d")
UNRELEASED = "## [Unreleased]"
KINDS = ("Added", "Changed", "Deprecated", "Removed", "Fixed", "Security")


def problems(text: str) -> list[str]:
    """What is wrong, a line each."""
    found = []
    versions: list[tuple[int, ...]] = []
    section = ""
    for number, line in enumerate(text.splitlines(), 1):
        place = f"CHANGELOG.md:{number}: "
        if line.startswith("## "):
            section, release = line, RELEASE.fullmatch(line)
            if release is not None:
                versions.append(ordered(release["version"]))
                if versions != sorted(versions, reverse=True):
                    found.append(f"{place}{release['version']} is below an older release")
            elif line != UNRELEASED:
                found.append(
                    f"{place}found {line!r}, allowed: {UNRELEASED!r} or '## [1.2.3] - DATE'"
                )
            elif versions:
                found.append(f"{place}unreleased changes are below a release")
        elif line.startswith("### ") and line[4:] not in KINDS:
            found.append(f"{place}found {line[4:]!r}, allowed: {', '.join(KINDS)}")
    if not section:
        found.append("CHANGELOG.md: no section")
    return found


def released(text: str) -> list[str]:
    """The versions that have a section with a date."""
    return [match["version"] for match in map(RELEASE.fullmatch, text.splitlines()) if match]


def ordered(version: str) -> tuple[int, ...]:
    """A version in the order of releases."""
    return tuple(map(int, version.split(".")))

"""The page on conformance has the peers of the tests, in the versions that are locked."""

from __future__ import annotations

import json
import re
import tomllib
from typing import TYPE_CHECKING

import pytest

from support.paths import DOCS, ROOT, TESTS

if TYPE_CHECKING:
    from collections.abc import Iterator

DRIVERS = TESTS / "peers" / "drivers"
PAGE = (DOCS / "conformance.md").read_text()


def rows(heading: str) -> dict[str, list[str]]:
    """The table of a section, by its first column."""
    section = PAGE.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("| ")][2:]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {first: rest for first, *rest in cells}


def python_versions() -> dict[str, str]:
    lock = (ROOT / "requirements" / "dev.lock").read_text()
    return dict(re.findall(r"^([a-z0-9-]+)==(\S+)", lock, re.MULTILINE))


def node_versions() -> dict[str, str]:
    lock = json.loads((DRIVERS / "node" / "package-lock.json").read_text())
    return {
        path.removeprefix("node_modules/"): package["version"]
        for path, package in lock["packages"].items()
        if path
    }


def go_versions() -> dict[str, str]:
    text = (DRIVERS / "go" / "go.mod").read_text()
    return dict(re.findall(r"github\.com/(\S+) v(\S+)", text))


def rust_versions() -> dict[str, str]:
    lock = (DRIVERS / "rust" / "Cargo.lock").read_text()
    return dict(re.findall(r'name = "(\S+)"\nversion = "(\S+)"', lock))


def java_versions() -> dict[str, str]:
    """The versions of the direct dependencies."""
    found = re.findall(
        r"<groupId>(\S+)</groupId>\s*<artifactId>(\S+)</artifactId>\s*<version>(\S+)</version>",
        (DRIVERS / "java" / "pom.xml").read_text(),
    )
    versions = {artifact: version for _, artifact, version in found}
    return versions | {"digitalpetri/modbus": versions["modbus-tcp"]}


@pytest.mark.parametrize(
    ("peer", "locked"),
    [
        ("pymodbus", python_versions),
        ("pyModbusTCP", python_versions),
        ("MinimalModbus", python_versions),
        ("tModbus", python_versions),
        ("uModbus", python_versions),
        ("jsmodbus", node_versions),
        ("modbus-serial", node_versions),
        ("j2mod", java_versions),
        ("digitalpetri/modbus", java_versions),
        ("tokio-modbus", rust_versions),
        ("simonvetter/modbus", go_versions),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_the_page_has_the_locked_version(peer: str, locked: object) -> None:
    assert callable(locked)
    versions = locked()
    assert rows("Peers")[peer][1] == versions.get(peer, versions.get(peer.lower()))


@pytest.mark.parametrize(
    "file", ["node/package-lock.json", "node/.npmrc", "go/go.sum", "go/go.mod"]
)
def test_lock_files_name_no_registry(file: str) -> None:
    text = (DRIVERS / file).read_text()
    assert '"resolved"' not in text
    assert "registry." not in text


def test_the_host_of_sparkplug_is_the_locked_one() -> None:
    assert f"(tahu-host {java_versions()['tahu-host']}, " in PAGE
    assert f"(sparkplug-payload {node_versions()['sparkplug-payload']}, " in PAGE


def requirements() -> Iterator[tuple[str, str, str]]:
    """The rows of all tables that say what holds: where, whether it holds, and the tests."""
    for page in sorted(DOCS.glob("conformance*.md")):
        header: list[str] = []
        for number, line in enumerate(page.read_text().splitlines(), 1):
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            if not line.startswith("| "):
                header = []
            elif not header:
                header = cells
            elif "holds" in header and not line.startswith("| ---"):
                row = dict(zip(header, cells, strict=True))
                yield f"{page.name}:{number}", row["holds"], row["test"]


def known_tests() -> set[str]:
    """The names of all tests, in Python and in Rust."""
    python = (file.read_text() for file in TESTS.rglob("test_*.py"))
    rust = (file.read_text() for file in (ROOT / "crates").rglob("*.rs"))
    return {
        *(name for text in python for name in re.findall(r"def (test_\w+)\(", text)),
        *(name for text in rust for name in re.findall(r"#\[test\]\s+fn (\w+)", text)),
    }


def test_what_holds_has_a_test_and_the_tests_exist() -> None:
    there = known_tests()
    problems, pages = [], set()
    for place, holds, tests in requirements():
        named = re.findall(r"`(\w+)`", tests)
        pages.add(place.partition(":")[0])
        problems += [f"{place}: there is no {name}" for name in named if name not in there]
        if "yes" in holds and not named:
            problems.append(f"{place}: it holds, but no test shows it")
        if not re.search(r"yes|no\b|not |partly", holds):
            problems.append(f"{place}: {holds!r} is no verdict")
    assert problems == []
    assert len(pages) == 4


def test_each_planted_fault_has_its_place() -> None:
    planted = tomllib.loads((TESTS / "conformance" / "mutations.toml").read_text())["mutation"]
    counts = {each["row"]: (ROOT / each["file"]).read_text().count(each["old"]) for each in planted}
    assert {row: count for row, count in counts.items() if count != 1} == {}

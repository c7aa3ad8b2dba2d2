"""The page on dependencies: it has all that the project names, and the lists agree."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from support.paths import DOCS, ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MAX_BASE_PACKAGES = 13
SETS = ("run", "dev", "docs", "release", "rust", "zig")


def listed(name: str) -> list[str]:
    """The requirements of a set, as its file has them."""
    text = (ROOT / "requirements" / f"{name}.in").read_text()
    return [line for line in text.splitlines() if re.match("[a-z]", line)]


def named(requirement: str) -> str:
    return re.split("[^A-Za-z0-9._-]", requirement)[0]


def crates() -> set[str]:
    """The crates of others that the workspaces depend on."""
    found: set[str] = set()
    for path in [*ROOT.glob("*/Cargo.toml"), *ROOT.glob("crates/*/Cargo.toml")]:
        parts: dict[str, Any] = tomllib.loads(path.read_text())
        for part in [parts, *parts.get("target", {}).values()]:
            found |= set(part.get("dependencies", ())) | set(part.get("dev-dependencies", ()))
    return {
        "rustls-webpki" if name == "webpki" else name for name in found if "holdfast" not in name
    }


def test_the_page_has_every_dependency() -> None:
    page = (DOCS / "dependencies.md").read_text().partition("\n## aws-lc-rs")[0]
    rows = {
        name.strip()
        for line in page.splitlines()
        if line.startswith("| ")
        for name in line.split("|")[1].split(",")
    }
    sets = [line for name in SETS for line in listed(name)]
    python = {named(each) for each in [*PROJECT["dependencies"], *sets]}
    assert sorted((python | crates()) - rows) == []


def test_the_set_to_run_is_that_of_the_project() -> None:
    extras = PROJECT["optional-dependencies"]
    required = {*PROJECT["dependencies"], *extras["certs"], *extras["mqtt"], *extras["nats"]}
    assert {each for each in listed("run") if named(each) != "maturin"} == required


def test_the_base_and_each_extra_are_on_the_page_on_installation() -> None:
    page = (DOCS / "install.md").read_text()
    rows = set(re.findall(r"^\| `([a-z]+)` \|", page, re.MULTILINE))
    assert rows == set(PROJECT["optional-dependencies"])
    names = [named(each) for each in PROJECT["dependencies"]]
    assert f"packages: {', '.join(names)}" in page


def test_the_base_requires_few_packages() -> None:
    """Those that the base requires, with all that these require, in the versions of `run.lock`."""
    found: set[str] = set()
    left = list(PROJECT["dependencies"])
    while left:
        name = canonicalize_name(named(left.pop()))
        if name in found:
            continue
        found.add(name)
        left += [
            each
            for each in metadata.requires(name) or ()
            if (marker := Requirement(each).marker) is None or marker.evaluate({"extra": ""})
        ]
    assert len(found) <= MAX_BASE_PACKAGES, sorted(found)


@pytest.mark.parametrize("name", SETS)
def test_the_lock_file_has_versions_that_are_allowed(name: str) -> None:
    lock = (ROOT / "requirements" / f"{name}.lock").read_text()
    locked = dict(re.findall(r"^([a-z0-9-]+)==(\S+)", lock, re.MULTILINE))
    with_run = "-r run.in" in (ROOT / "requirements" / f"{name}.in").read_text()
    for each in map(Requirement, [*(listed("run") if with_run else ()), *listed(name)]):
        found = locked[each.name.lower().replace(".", "-").replace("_", "-")]
        assert each.specifier.contains(found), f"{each}: {found} is locked"

"""Copies the crates of others into the source distribution, so that it builds without a network."""

from __future__ import annotations

import json
import shutil
import subprocess
import tomllib
from pathlib import Path

FROM_FOLDER = """
[source.crates-io]
replace-with = "vendored-sources"

[source.vendored-sources]
directory = "vendor"
"""


NOT_BUILT = {
    *("tests", "test", "test-macros", "testdata", "benches", "bench", "benchmarks", "examples"),
    *("branding", "img", ".github", "Cargo.lock", "Cargo.toml.orig"),
}
"""Files and folders of a crate that no build reads. Documentation stays: code includes some."""


class VendoringError(Exception):
    """The source distribution would not have what the checkout was tested with."""


def vendor(folder: Path, checkout: Path) -> None:
    """Puts the crates into `vendor` of an unpacked source distribution."""
    before = _locked(folder)
    # Without --locked: the benchmarks are not in the source distribution, so their crates go.
    subprocess.run(
        ["cargo", "vendor", "--quiet", "--versioned-dirs", "vendor"],
        cwd=folder,
        check=True,
        stdout=subprocess.DEVNULL,
    )
    changed = _locked(folder) - before
    if changed:
        raise VendoringError(f"cargo vendor changed the versions of {sorted(changed)}")
    settings = folder / ".cargo" / "config.toml"
    settings.parent.mkdir()
    settings.write_text((checkout / ".cargo" / "config.toml").read_text() + FROM_FOLDER)
    kept = {f"{name}-{version}" for name, version in used(folder, "normal,build")}
    for crate in (folder / "vendor").iterdir():
        if crate.name in kept:
            prune(crate)
        else:
            empty(crate)


def used(folder: Path, edges: str) -> set[tuple[str, str]]:
    """Names and versions of the crates that a build for some system uses."""
    tree = ["cargo", "tree", "--locked", "--offline", "-p", "holdfast-binding"]
    tree += ["--edges", edges, "--prefix", "none", "--format", "{p}"]
    # Not `all`, which adds crates for conditions that no system meets.
    systems = subprocess.check_output(["rustc", "--print", "target-list"], text=True).split()
    tree += [f"--target={system}" for system in systems]
    found = subprocess.check_output(tree, cwd=folder, text=True)
    # Those of the source distribution itself are shown with their folder.
    own = f"({folder.resolve()}"
    words = [line.split() for line in found.splitlines() if line and own not in line]
    return {(each[0], each[1].removeprefix("v")) for each in words}


def prune(crate: Path) -> None:
    """Removes what no build reads from a crate."""
    for name in NOT_BUILT:
        path = crate / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    for path in crate.rglob("*_test.cc"):
        path.unlink()
    file = crate / ".cargo-checksum.json"
    sums = json.loads(file.read_text())
    sums["files"] = {name: each for name, each in sums["files"].items() if (crate / name).exists()}
    file.write_text(json.dumps(sums))


def empty(crate: Path) -> None:
    """Removes the code of a crate that no build uses. Cargo only reads its manifest."""
    manifest = (crate / "Cargo.toml").read_text()
    package = json.loads((crate / ".cargo-checksum.json").read_text())["package"]
    shutil.rmtree(crate)
    (crate / "src").mkdir(parents=True)
    library = tomllib.loads(manifest).get("lib", {}).get("path", "src/lib.rs")
    (crate / library).parent.mkdir(parents=True, exist_ok=True)
    (crate / library).touch()
    (crate / "Cargo.toml").write_text(manifest)
    (crate / ".cargo-checksum.json").write_text(json.dumps({"files": {}, "package": package}))


def _locked(folder: Path) -> set[tuple[str, str]]:
    packages = tomllib.loads((folder / "Cargo.lock").read_text())["package"]
    return {(each["name"], each["version"]) for each in packages}

"""Builds a Debian package of each wheel in a folder that has the current version and glibc.

Wheels for 32-bit ARM are left out: some libraries have no wheels for it.
One package serves all versions of Python in PYTHONS. It is packed with debhelper.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tomllib
from email.utils import formatdate
from importlib.metadata import distributions
from pathlib import Path
from typing import TYPE_CHECKING

import libraries

if TYPE_CHECKING:
    from collections.abc import Iterator

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]

PYTHONS = ["3.11", "3.12", "3.13", "3.14"]
"""Debian 12 has 3.11, Ubuntu 24.04 has 3.12, Debian 13 has 3.13, Ubuntu 26.04 has 3.14."""

ARCHITECTURES = {"x86_64": "amd64", "aarch64": "arm64"}

OLDEST_LIBC = (2, 28)
"""That of the wheels of dependencies."""


def main() -> None:
    """Writes `holdfast-modbus_VERSION_ARCHITECTURE.deb` into the folder of the wheels."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="the folder with the wheels")
    folder = parser.parse_args().folder
    if shutil.which("dh") is None or shutil.which("dpkg-buildpackage") is None:
        sys.exit("debhelper is missing: apt-get install debhelper")
    found = packable(folder, current_version())
    for wheel in found:
        print(build(wheel), flush=True)
    if not found:
        sys.exit(
            f"{folder} has no wheel of Holdfast {current_version()} for Linux with glibc: make dist"
        )


def packable(folder: Path, version: str) -> list[Path]:
    """The wheels that packages are built of."""
    wheels = sorted(folder.glob(f"holdfast_modbus-{version}-*manylinux*.whl"))
    return [wheel for wheel in wheels if wheel.stem.endswith(tuple(ARCHITECTURES))]


def current_version() -> str:
    """The version in Cargo.toml, which is that of everything."""
    with (ROOT / "Cargo.toml").open("rb") as file:
        version: str = tomllib.load(file)["workspace"]["package"]["version"]
    return version


def build(wheel: Path) -> Path:
    """Builds the package of a wheel."""
    version, architecture, libc = described(wheel.name)
    staged = ROOT / "build" / "deb" / f"holdfast-{architecture}"
    shutil.rmtree(staged, ignore_errors=True)
    shutil.copytree(HERE, staged, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    libraries.collect(wheel, architecture, PYTHONS, staged / "lib")
    fill(staged / "debian", version, libc)
    pack(staged, architecture)
    name = f"holdfast-modbus_{version}_{architecture}.deb"
    return Path(shutil.copyfile(staged.parent / name, wheel.parent / name))


def described(wheel: str) -> tuple[str, str, tuple[int, int]]:
    """The Debian version, the architecture and the oldest C library of a wheel, by its name."""
    found = re.fullmatch(
        r"holdfast_modbus-([0-9.]+)-cp311-abi3-(.*manylinux.*_(x86_64|aarch64))\.whl", wheel
    )
    if found is None:
        sys.exit(f"{wheel} is not a wheel of Holdfast for Linux with glibc on amd64 or arm64")
    version, tags, machine = found.groups()
    versions = re.findall(r"manylinux_(\d+)_(\d+)_", tags) or [("2", "17")]
    libc = max(OLDEST_LIBC, min((int(major), int(minor)) for major, minor in versions))
    return version, ARCHITECTURES[machine], libc


def fill(debian: Path, version: str, libc: tuple[int, int]) -> None:
    """Writes the files that depend on the version."""
    oldest, newest = PYTHONS[0], PYTHONS[-1]
    after = f"3.{int(newest.removeprefix('3.')) + 1}"
    python = f"python3 (>= {oldest}), python3 (<< {after}~)"
    control = (debian / "control.in").read_text()
    control = control.replace("@PYTHON@", python).replace("@LIBC@", ".".join(map(str, libc)))
    (debian / "control").write_text(control)
    (debian / "changelog").write_text(
        f"holdfast-modbus ({version}) unstable; urgency=medium\n\n"
        "  * See /usr/share/doc/holdfast-modbus/release-notes.md.gz.\n\n"
        f" -- {maintainer(control)}  {formatdate(commit_time())}\n"
    )
    shutil.copyfile(ROOT / "CHANGELOG.md", debian / "release-notes.md")
    own = (debian / "copyright.in").read_text()
    (debian / "copyright").write_text(own + "".join(licences(debian.parent / "lib")))


def licences(folder: Path) -> Iterator[str]:
    """A line for each library, from its metadata."""
    for distribution in sorted(distributions(path=[str(folder)]), key=lambda one: one.name.lower()):
        about = distribution.metadata
        licence = about["License-Expression"] or about["License"] or ""
        if not licence or "\n" in licence:
            kinds = [kind for kind in about.get_all("Classifier", []) if kind.startswith("License")]
            licence = ", ".join(kind.rpartition(" :: ")[2] for kind in kinds)
        if distribution.name != "holdfast-modbus":
            yield f"  {distribution.name} {distribution.version}: {licence}\n"


def maintainer(control: str) -> str:
    """The field of that name."""
    return re.search(r"^Maintainer: (.*)$", control, re.MULTILINE)[1]  # type: ignore[index]


def commit_time() -> int:
    """The time of the last commit, so that two builds of it are the same."""
    if "SOURCE_DATE_EPOCH" in os.environ:
        return int(os.environ["SOURCE_DATE_EPOCH"])
    command = ["git", "-C", str(ROOT), "log", "-1", "--format=%ct"]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def pack(staged: Path, architecture: str) -> None:
    """Runs debhelper."""
    log = staged.parent / f"{staged.name}.log"
    command = ["dpkg-buildpackage", "--build=binary", "--no-sign", "--host-arch", architecture]
    with log.open("w") as output:
        done = subprocess.run(command, cwd=staged, stdout=output, stderr=subprocess.STDOUT)
    if done.returncode:
        sys.exit(f"{log.read_text()}\ndpkg-buildpackage failed")


if __name__ == "__main__":
    main()

"""Checks a release before it is published: `check.py dist [TAG]`.

Versions agree, the changelog has its form, metadata is valid, each package is complete. Also writes
the bills of materials (CycloneDX) next to the packages.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import changelog

ROOT = Path(__file__).resolve().parents[2]
IMAGE = re.compile(r"image: localhost/holdfast-modbus:(\S+)")
IN_WHEELS = (
    "holdfast/_core",
    "holdfast/py.typed",
    ".dist-info/licenses/LICENSE",
    ".dist-info/sboms/",
)
MAX_CORE_BYTES = 13_000_000
"""The most bytes of the native core. One with symbols, or with a dependency more, has more."""

IN_PACKAGES = (
    "./etc/holdfast/holdfast.yaml",
    "./usr/bin/holdfast",
    "./usr/lib/holdfast/holdfast/_core.abi3.so",
    "./usr/share/doc/holdfast-modbus/copyright",
)


def main() -> None:
    """Prints every problem, and exits with 1 if there is one."""
    folder = Path(sys.argv[1])
    tag = sys.argv[2] if len(sys.argv) > 2 else None
    version = current_version()
    found = [*versions(version), *changes(version, tag), *wheels(folder, version)]
    found += [*metadata(folder, version), *debian(folder, version)]
    materials(folder, version)
    for problem in found:
        print(problem)
    if found:
        sys.exit(1)
    for file in sorted(folder.iterdir()):
        print(f"{file.stat().st_size:>12,}  {file.name}")
    print(f"{version} is consistent" + ("" if tag else "; without a TAG, its date was not checked"))


def current_version() -> str:
    """The version in Cargo.toml, which is that of everything."""
    with (ROOT / "Cargo.toml").open("rb") as file:
        version: str = tomllib.load(file)["workspace"]["package"]["version"]
    return version


def versions(version: str) -> list[str]:
    """Where another version stands."""
    found = []
    with (ROOT / "Cargo.lock").open("rb") as file:
        packages = tomllib.load(file)["package"]
    for package in packages:
        own = package["name"].startswith("holdfast-") and "source" not in package
        if own and package["version"] != version:
            found.append(f"Cargo.lock: {package['name']} is {package['version']}: cargo update -w")
    for manifest in sorted((ROOT / "packaging/kubernetes").glob("*.yaml")):
        for other in IMAGE.findall(manifest.read_text()):
            if other != version:
                found.append(f"{manifest.relative_to(ROOT)}: the image is {other}, not {version}")
    return found


def changes(version: str, tag: str | None) -> list[str]:
    """What is wrong with the changelog, and with the tag."""
    text = (ROOT / "CHANGELOG.md").read_text()
    found = changelog.problems(text)
    if tag is not None and tag != f"v{version}":
        found.append(f"the tag is {tag}, but Cargo.toml has {version}: it must be v{version}")
    if tag is not None and changelog.released(text)[:1] != [version]:
        found.append(f"CHANGELOG.md: the first section is not '## [{version}] - DATE'")
    return found


def wheels(folder: Path, version: str) -> list[str]:
    """What the wheels lack, and what they have too much of."""
    found = []
    made = sorted(folder.glob(f"holdfast_modbus-{version}-*.whl"))
    for wheel in made:
        with zipfile.ZipFile(wheel) as archive:
            sizes = {each.filename: each.file_size for each in archive.infolist()}
        missing = [part for part in IN_WHEELS if not any(part in name for name in sizes)]
        found += [f"{wheel.name}: no {part}" for part in missing]
        for name, size in sizes.items():
            if IN_WHEELS[0] in name and size > MAX_CORE_BYTES:
                found.append(
                    f"{wheel.name}: {name} has {size:,} bytes, allowed: {MAX_CORE_BYTES:,}"
                )
    return found or ([] if made else [f"{folder}: no wheel of {version}: make dist"])


def metadata(folder: Path, version: str) -> list[str]:
    """What an index would refuse."""
    own = f"holdfast_modbus-{version}"
    files = [*folder.glob(f"{own}-*.whl"), *folder.glob(f"{own}.tar.gz")]
    command = [sys.executable, "-m", "twine", "--no-color", "check", "--strict", *map(str, files)]
    done = subprocess.run(command, capture_output=True, text=True)
    return [done.stdout + done.stderr] if done.returncode else []


def debian(folder: Path, version: str) -> list[str]:
    """What the Debian packages lack."""
    found = []
    made = sorted(folder.glob(f"holdfast-modbus_{version}_*.deb"))
    for package in made:
        command = ["dpkg-deb", "--contents", str(package)]
        listed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        names = {line.split(maxsplit=5)[5] for line in listed.splitlines()}
        found += [f"{package.name}: no {name}" for name in IN_PACKAGES if name not in names]
    return found or ([] if made else [f"{folder}: no Debian package of {version}: make deb"])


def materials(folder: Path, version: str) -> None:
    """Writes what the native core and the packages are made of."""
    python = folder / f"holdfast-modbus-{version}-python.cdx.json"
    command = [sys.executable, "-m", "cyclonedx_py", "requirements", "--output-reproducible"]
    command += ["--pyproject", str(ROOT / "pyproject.toml"), "--output-file", str(python)]
    subprocess.run([*command, str(ROOT / "requirements/appliance.lock")], check=True)
    for wheel in sorted(folder.glob(f"holdfast_modbus-{version}-*.whl"))[:1]:
        with zipfile.ZipFile(wheel) as archive:
            [name] = [
                name for name in archive.namelist() if name.endswith("binding.cyclonedx.json")
            ]
            core = json.loads(archive.read(name))
        (folder / f"holdfast-modbus-{version}-rust.cdx.json").write_text(json.dumps(core, indent=2))


if __name__ == "__main__":
    main()

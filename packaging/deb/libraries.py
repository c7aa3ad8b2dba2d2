"""Collects a wheel and its pinned dependencies in one folder, for several versions of Python.

The file names of compiled modules contain the version of Python, so those of all versions fit in
one folder. All other files are the same for each version; this module fails if they are not.
"""

from __future__ import annotations

import filecmp
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

PLATFORMS = {"amd64": "x86_64-manylinux_2_28", "arm64": "aarch64-manylinux_2_28"}
"""The platform of wheels for each Debian architecture, as uv names it."""

LOCK = ROOT / "requirements/appliance.lock"

OF_INSTALLERS = {"RECORD", "INSTALLER", "REQUESTED", "WHEEL", "direct_url.json", "uv_cache.json"}
"""Files of `*.dist-info` that describe one installation, not the package."""


def collect(wheel: Path, architecture: str, pythons: list[str], target: Path) -> None:
    """Fills `target` with the wheel and its dependencies."""
    with tempfile.TemporaryDirectory() as folder:
        for python in pythons:
            unpacked = Path(folder) / python
            _install(python, PLATFORMS[architecture], unpacked)
            _merge(unpacked, target)
        own = Path(folder) / "own"
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(own)
        _merge(own, target)


def _install(python: str, platform: str, target: Path) -> None:
    """Unpacks wheels for a version of Python that need not be installed here."""
    command = [sys.executable, "-m", "uv", "pip", "install", "--quiet"]
    command += ["--no-deps", "--no-build", "--require-hashes", "-r", str(LOCK)]
    command += ["--python-version", python, "--python-platform", platform]
    command += ["--target", str(target), "--link-mode", "copy"]
    subprocess.run(command, check=True)


def _merge(source: Path, target: Path) -> None:
    """Adds the files of `source`. A file that is there already must be the same."""
    for file in sorted(source.rglob("*")):
        path = file.relative_to(source)
        if file.is_dir() or path.parts[0] in ("bin", ".lock") or path.suffix == ".pyc":
            continue
        if path.name in OF_INSTALLERS and path.parts[0].endswith(".dist-info"):
            continue
        place = target / path
        if not place.exists():
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, place)
        elif not _is_bill_of_materials(path) and not filecmp.cmp(file, place, shallow=False):
            sys.exit(f"{path} is not the same for all versions of Python")


def _is_bill_of_materials(path: Path) -> bool:
    """Whether it lists what was built in. That of the oldest version of Python stands for all."""
    return path.parent.name == "sboms" and path.parts[0].endswith(".dist-info")

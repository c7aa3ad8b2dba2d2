"""What `make dist` made: contents of all packages, and a try of the wheel for this machine.

`make dist-check` runs it: HOLDFAST_DIST names the folder. Installing needs a package index.
"""

from __future__ import annotations

import functools
import os
import platform
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import vendoring
from support.pages import blocks
from support.paths import EXAMPLES, ROOT

FOLDER = os.environ.get("HOLDFAST_DIST")
pytestmark = pytest.mark.skipif(FOLDER is None, reason="`make dist-check` runs it")
PACKAGES = Path(FOLDER or ROOT / "dist").resolve()
WHEELS = sorted(PACKAGES.glob("*.whl")) if FOLDER else []
each_wheel = pytest.mark.parametrize("wheel", WHEELS, ids=lambda wheel: wheel.stem)

VERSION = tomllib.loads((ROOT / "Cargo.toml").read_text())["workspace"]["package"]["version"]
MAX_WHEEL = 12e6
"""Bytes of the largest wheel: a package that all can download in a moment."""
MAX_SOURCE = 30e6
"""Bytes of the source distribution, most of which are the crates of others."""


MAX_BASE_PACKAGES = 13

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = list(PROJECT["optional-dependencies"])

COMMANDS_OF_EXTRAS = {"mqtt": (), "nats": ("fleet", "log", "scan"), "certs": ("cert",)}
"""The commands that require an extra."""

PROVIDES = {
    "sparkplug": ["sparkplug", "mqtt"],
    "nats": ["nats", "certs"],
    "all": ["certs", "mqtt", "nats", "sparkplug"],
}
"""What extras install besides their own packages."""

MISSING_EXTRA = re.compile(r"not installed: pip install 'holdfast-modbus\[(\w+)\]'")

MISSING = """\
nats: {devices: [127.0.0.0/8]}
outputs:
  broker: {type: mqtt, url: 'mqtt://h'}
  host: {type: sparkplug, url: 'mqtt://h', group: g, edge_node: e}
"""


def missing_commands(extra: str) -> list[str]:
    """The commands that an environment with one extra does not have."""
    provided = PROVIDES.get(extra, [extra])
    return [
        command
        for other, commands in COMMANDS_OF_EXTRAS.items()
        if other not in provided
        for command in commands
    ]


@functools.cache
def package() -> set[str]:
    """The files of the Python package in the checkout."""
    listed = subprocess.check_output(["git", "ls-files", "python/holdfast"], cwd=ROOT, text=True)
    return {line.removeprefix("python/") for line in listed.splitlines()}


def test_there_are_packages() -> None:
    assert WHEELS
    [source] = PACKAGES.glob("*.tar.gz")
    assert source.name == f"holdfast_modbus-{VERSION}.tar.gz"


@each_wheel
def test_a_wheel_has_the_package_the_core_and_the_licences(wheel: Path) -> None:
    about = f"holdfast_modbus-{VERSION}.dist-info"
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
        metadata = archive.read(f"{about}/METADATA").decode()
        notices = archive.read(f"{about}/licenses/LICENSE-third-party.txt").decode()
    code = {name for name in names if name.startswith("holdfast/")}
    core = "holdfast/_core.pyd" if "win_" in wheel.name else "holdfast/_core.abi3.so"
    assert sorted(code ^ package()) == [core]
    assert f"{about}/licenses/LICENSE" in names
    assert f"\nVersion: {VERSION}\n" in metadata
    for crate in ("aws-lc-sys", "rustls", "tokio", "pyo3"):
        assert f"\n{crate} " in notices, crate
    assert "-cp311-abi3-" in wheel.name
    assert wheel.stat().st_size < MAX_WHEEL


def test_the_source_distribution_has_all_crates() -> None:
    packed = PACKAGES / f"holdfast_modbus-{VERSION}.tar.gz"
    assert packed.stat().st_size < MAX_SOURCE
    with tarfile.open(packed) as archive:
        names = set(archive.getnames())
        lock = archive.extractfile(f"holdfast_modbus-{VERSION}/Cargo.lock")
        assert lock is not None
        locked = tomllib.loads(lock.read().decode())["package"]
    for crate in locked:
        if "source" in crate:
            folder = f"holdfast_modbus-{VERSION}/vendor/{crate['name']}-{crate['version']}"
            assert f"{folder}/Cargo.toml" in names, folder
    below = {name.split("/")[3] for name in names if name.split("/")[1] == "vendor"}
    assert not below & vendoring.NOT_BUILT
    for name in [".cargo/config.toml", "LICENSE", "LICENSE-third-party.txt", "PKG-INFO"]:
        assert f"holdfast_modbus-{VERSION}/{name}" in names
    assert {f"holdfast_modbus-{VERSION}/python/{name}" for name in package()} <= names


for_this_machine = pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64", reason="no wheel for this machine"
)


@for_this_machine
@pytest.mark.timeout(900)
@pytest.mark.parametrize("extra", ["", *EXTRAS])
def test_a_machine_without_rust_installs_and_runs_the_wheel(tmp_path: Path, extra: str) -> None:
    """The base, and each extra in an environment of its own."""
    libc = "manylinux" if platform.libc_ver()[0] == "glibc" else "musllinux"
    [wheel] = [each for each in WHEELS if libc in each.name and "x86_64" in each.name]
    variables = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    variables["PATH"] = "/nowhere"
    python = tmp_path / "venv" / "bin" / "python"
    with_extra = f"{wheel}[{extra}]" if extra else str(wheel)
    file = tmp_path / "extras.yaml"
    file.write_text(MISSING)
    commands: list[list[str | Path]] = [
        [sys.executable, "-m", "venv", tmp_path / "venv"],
        [python, "-m", "pip", "install", "--quiet", "--only-binary=:all:", with_extra],
        [python, ROOT / "tools" / "smoke.py", EXAMPLES, *missing_commands(extra)],
    ]
    for command in commands:
        ran = subprocess.run(
            command, env=variables, cwd=tmp_path, capture_output=True, text=True, timeout=600
        )
        assert ran.returncode == 0, f"{command}: {ran.stdout}{ran.stderr}"
    check: list[str | Path] = [python, "-m", "holdfast", "check", file]
    checked = subprocess.run(check, env=variables, capture_output=True, text=True, timeout=60)
    assert "Traceback" not in checked.stderr
    assert set(MISSING_EXTRA.findall(checked.stderr)) == {
        each for each in ("mqtt", "nats", "sparkplug") if each not in PROVIDES.get(extra, [extra])
    }
    if not extra:
        listed: list[str | Path] = [python, "-m", "pip", "list", "--format=freeze"]
        packages = subprocess.check_output(listed, env=variables, text=True).splitlines()
        own = {each.partition("==")[0].partition(" @")[0] for each in packages}
        assert len(own - {"holdfast-modbus", "pip", "setuptools"}) <= MAX_BASE_PACKAGES, own


@for_this_machine
@pytest.mark.timeout(900)
def test_the_commands_of_the_page_on_installing_run(tmp_path: Path) -> None:
    wheel, download, offline = (
        block.text
        for block in blocks.of_pages()["docs/install.md"]
        if block.language == "sh" and "pip" in block.text and "--no-build" not in block.text
    )
    (tmp_path / "dist").symlink_to(PACKAGES)
    (tmp_path / "home").mkdir()

    def run(script: str, environment: str) -> str:
        path = f"{tmp_path}/{environment}/bin{os.pathsep}{os.environ['PATH']}"
        ran = subprocess.run(
            ["bash", "-e", "-c", script],
            cwd=tmp_path,
            env={**os.environ, "HOME": str(tmp_path / "home"), "PATH": path},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=600,
        )
        assert ran.returncode == 0, ran.stdout
        return ran.stdout

    run(wheel, "none")
    assert VERSION in run(f"{download}\nholdfast --version", ".venv")
    run("python3 -m venv other", "none")
    assert VERSION in run(f"{offline}\nholdfast --version", "other")

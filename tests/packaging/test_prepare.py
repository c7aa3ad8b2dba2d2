"""`tools/prepare.py`: what is downloaded on which machine. The downloads are stand-ins."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from support.paths import ROOT

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the stand-ins are shell scripts")

PIP_DOWNLOADS = """
case "$*" in
  *puccinialin\\ --location*) bin=$(dirname "$0")/../../.cache/toolchain/rust/cargo/bin
    mkdir -p "$bin"; for each in cargo rustc rustdoc rustup; do
      printf '#!/bin/sh\\necho "$RUSTUP_TOOLCHAIN from rustup"' > "$bin/$each"
      chmod +x "$bin/$each"
    done;;
  *zig.lock) zig=$(dirname "$0")/../../.cache/toolchain/zig/ziglang
    mkdir -p "$zig"; printf '#!/bin/sh\\necho "zig $@"' > "$zig/zig"; chmod +x "$zig/zig";;
esac
"""
PIP_FAILS = "echo 'pip: no network' >&2; exit 1"


@dataclass
class Machine:
    """A checkout, and a PATH with only the programs of `has`."""

    checkout: Path
    programs: Path

    def has(self, name: str, script: str) -> None:
        program = self.programs / name
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)

    def downloads(self, script: str) -> None:
        """What the Python of the environment does instead of running a module."""
        python = self.checkout / ".venv" / "bin" / "python"
        python.parent.mkdir(parents=True, exist_ok=True)
        python.write_text(f"#!/bin/sh\nPATH=/usr/bin:/bin\n{script}\n")
        python.chmod(0o755)

    def prepare(self, what: str = "toolchain") -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, str(self.checkout / "tools" / "prepare.py"), what],
            env={"PATH": f"{self.brought}:{self.programs}"},
            capture_output=True,
            text=True,
            timeout=60,
        )

    @property
    def brought(self) -> Path:
        return self.checkout / ".cache" / "toolchain" / "bin"

    def says(self, name: str) -> str:
        """What a program that was brought in prints."""
        return subprocess.check_output([self.brought / name, "--version"], text=True).strip()


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    """A machine with all that is needed, where nothing can be downloaded."""
    checkout = tmp_path / "checkout"
    for name in ("tools/prepare.py", "Cargo.toml"):
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, checkout / name)
    (tmp_path / "bin").mkdir()
    found = Machine(checkout, tmp_path / "bin")
    for name, version in {
        "cargo": "cargo 1.99.0 (0 2026-01-01)",
        "rustc": "rustc 1.99.0 (0 2026-01-01)",
        "cc": "cc (Debian) 12.2.0",
        "ar": "GNU ar 2.40",
    }.items():
        found.has(name, f"echo '{version}'")
    found.downloads(PIP_FAILS)
    return found


def test_a_machine_that_has_a_toolchain_uses_its_own(machine: Machine) -> None:
    ran = machine.prepare()
    assert (ran.returncode, ran.stderr) == (0, "")
    assert list(machine.brought.iterdir()) == []


@pytest.mark.parametrize(
    ("script", "said"),
    [
        (None, "Rust is missing: "),
        ("exit 1", "Rust is missing: "),
        ("echo 'cargo 1.63.0'", "Rust 1.63.0 is too old: "),
    ],
)
def test_a_machine_without_a_new_rust_downloads_the_pinned_one(
    machine: Machine, script: str | None, said: str
) -> None:
    if script is None:
        (machine.programs / "cargo").unlink()
    else:
        machine.has("cargo", script)
    machine.downloads(PIP_DOWNLOADS)
    ran = machine.prepare()
    assert ran.returncode == 0, ran.stderr
    [line] = ran.stderr.splitlines()
    assert line.startswith(f"{said}downloading Rust 1."), line
    brought = ["cargo", "rustc", "rustdoc", "rustup"]
    assert sorted(each.name for each in machine.brought.iterdir()) == brought
    assert machine.says("cargo").endswith("from rustup")
    assert machine.says("cargo").split()[0] in line


def test_a_machine_without_a_compiler_uses_zig(machine: Machine) -> None:
    machine.has("cc", "exit 1")
    (machine.programs / "ar").unlink()
    machine.downloads(PIP_DOWNLOADS)
    ran = machine.prepare()
    assert ran.returncode == 0, ran.stderr
    assert ran.stderr.startswith("No C compiler: downloading zig to .cache/toolchain")
    assert sorted(each.name for each in machine.brought.iterdir()) == ["ar", "c++", "cc"]
    assert machine.says("cc").startswith("zig cc -mcpu=baseline ")
    compiled = subprocess.check_output(
        [machine.brought / "cc", "-O2", "--target=x86_64-unknown-linux-gnu", "a b.c"], text=True
    )
    assert compiled.endswith(" -O2 a b.c\n")
    assert machine.says("ar") == "zig ar --version"


def test_programs_that_were_downloaded_before_do_not_count(machine: Machine) -> None:
    (machine.programs / "cargo").unlink()
    machine.downloads(PIP_DOWNLOADS)
    assert machine.prepare().returncode == 0
    assert machine.prepare().stderr.startswith("Rust is missing: ")


@pytest.mark.parametrize(("name", "lock"), [("cargo", "rust"), ("cc", "zig")])
def test_a_machine_without_a_network_gets_an_error(machine: Machine, name: str, lock: str) -> None:
    (machine.programs / name).unlink()
    ran = machine.prepare()
    assert ran.returncode == 1
    assert "pip: no network" in ran.stderr
    last = ran.stderr.splitlines()[-1]
    assert last.startswith(f"make: pip can't install the packages of requirements/{lock}.lock")


def test_an_environment_is_kept_when_what_it_requires_changes(machine: Machine) -> None:
    machine.downloads("echo pip $@")
    before = (machine.checkout / ".venv" / "bin" / "python").read_bytes()
    made = machine.prepare("environment")
    assert (made.returncode, made.stderr) == (0, "")
    assert "requirements/run.lock" in made.stdout
    assert (machine.checkout / ".venv" / "bin" / "python").read_bytes() == before


def test_a_python_that_makes_no_environments_gets_an_error(machine: Machine) -> None:
    without = (
        "import runpy, sys; sys.modules['ensurepip'] = None; "
        "sys.argv = [sys.argv[1], 'environment']; runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    ran = subprocess.run(
        [sys.executable, "-c", without, str(machine.checkout / "tools" / "prepare.py")],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert ran.returncode == 1
    assert ran.stderr.startswith("make: ")
    assert ran.stderr.endswith("apt install python3-venv\n")

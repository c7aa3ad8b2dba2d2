"""Sets up what the Makefile builds with: `.venv`, and a toolchain if the machine has none.

    prepare.py environment   the environment, with the packages of requirements/run.lock
    prepare.py toolchain     Rust and a C compiler in `.cache/toolchain`, where the machine has none

Nothing is installed outside the checkout. The Makefile puts `.cache/toolchain/bin` first in PATH;
it contains only what the machine lacks.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

ROOT = Path(__file__).resolve().parent.parent
TOOLCHAIN = ROOT / ".cache" / "toolchain"
PROGRAMS = TOOLCHAIN / "bin"

RUST = "1.95.0"
"""The version that is downloaded."""

ZIG_OPTIONS = "-mcpu=baseline -fno-sanitize=undefined"
"""Else zig compiles for this very processor, and builds without optimization with checks."""

ZIG_CACHES = {f"ZIG_{which}_CACHE_DIR": TOOLCHAIN / "zig-cache" for which in ("GLOBAL", "LOCAL")}

WITHOUT_TARGET = """\
for each; do
  shift
  case $each in --target=*) ;; *) set -- "$@" "$each" ;; esac
done
"""
"""The `cc` crate passes the target with the name that clang has for it, which zig doesn't know."""


class Refused(Exception):
    """The machine can't be set up: the message says what is missing."""


def environment() -> None:
    """Makes `.venv`."""
    if sys.version_info < (3, 11):  # noqa: UP036
        found = ".".join(map(str, sys.version_info[:3]))
        raise Refused(
            f"{sys.executable} is Python {found}, required: 3.11 or newer; "
            "choose another with make PYTHON=python3.12"
        )
    try:
        import ensurepip  # noqa: F401
    except ImportError:
        raise Refused(
            f"{sys.executable} has no ensurepip, so it can't make an environment; "
            "on Debian and Ubuntu: apt install python3-venv"
        ) from None
    if not _has_pip():
        say("Making .venv, with the packages of requirements/run.lock")
        venv.create(ROOT / ".venv", with_pip=True, clear=True, symlinks=os.name != "nt")
    install("run", python=_python())


def toolchain() -> None:
    """Downloads Rust and a C compiler, where they are missing or too old."""
    path = os.pathsep.join(each for each in os.get_exec_path() if Path(each).resolve() != PROGRAMS)
    shutil.rmtree(PROGRAMS, ignore_errors=True)
    PROGRAMS.mkdir(parents=True)
    found, required = rust_found(path), rust_required()
    if found is None or found < required:
        _refuse_on_windows(f"Rust {'.'.join(map(str, required))} or newer", "rustup")
        have = "is missing" if found is None else f"{'.'.join(map(str, found))} is too old"
        say(f"Rust {have}: downloading Rust {RUST} to .cache/toolchain, for this checkout only")
        download_rust()
    if not works("cc", path):
        _refuse_on_windows("a C compiler", "the Visual Studio Build Tools")
        say("No C compiler: downloading zig to .cache/toolchain, for this checkout only")
        zig = download_zig()
        for name in ("cc", "c++"):
            program(name, f'"{zig}" {name} {ZIG_OPTIONS}', ZIG_CACHES, before=WITHOUT_TARGET)
        if not works("ar", path):
            program("ar", f'"{zig}" ar', ZIG_CACHES)


def rust_required() -> tuple[int, ...]:
    """The oldest Rust that builds the core."""
    import tomllib

    workspace = tomllib.loads((ROOT / "Cargo.toml").read_text())["workspace"]
    return _numbers(workspace["package"]["rust-version"])


def rust_found(path: str) -> tuple[int, ...] | None:
    """The version of the machine's Rust, or None."""
    versions = [works(name, path) for name in ("cargo", "rustc")]
    return None if None in versions else min(_numbers(each or "") for each in versions)


def works(name: str, path: str) -> str | None:
    """What a program says about its version, or None if it is missing or fails.

    Some programs are only placeholders: `cc` of macOS without its tools, `cargo` of rustup without
    a toolchain.
    """
    found = shutil.which(name, path=path)
    if found is None:
        return None
    try:
        ran = subprocess.run([found, "--version"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return ran.stdout


def download_rust() -> None:
    """Rust, by rustup, which puccinialin downloads."""
    packages, location = TOOLCHAIN / "puccinialin", TOOLCHAIN / "rust"
    shutil.rmtree(packages, ignore_errors=True)
    install("rust", "--target", str(packages))
    settings = location / "rustup" / "settings.toml"
    settings.parent.mkdir(parents=True, exist_ok=True)
    # rustup-init installs the default toolchain that it finds here.
    settings.write_text(f'version = "12"\nprofile = "minimal"\ndefault_toolchain = "{RUST}"\n')
    command = [str(_python()), "-m", "puccinialin", "--location", str(location)]
    homes = {"CARGO_HOME": location / "cargo", "RUSTUP_HOME": location / "rustup"}
    try:
        ran = subprocess.run(
            command,
            env={**os.environ, "PYTHONPATH": str(packages), "RUSTUP_INIT_SKIP_PATH_CHECK": "yes"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=True,
        )
    except subprocess.CalledProcessError as error:
        raise Refused(
            f"{error.stdout.strip()}\nRust can't be downloaded, see above: connect this machine to "
            f"the network, or install Rust {'.'.join(map(str, rust_required()))} or newer"
        ) from None
    variables = {**homes, "RUSTUP_TOOLCHAIN": RUST}
    for name in ("cargo", "rustc", "rustdoc", "rustup"):
        program(name, f'"{location / "cargo" / "bin" / name}"', variables)
    if works("cargo", str(PROGRAMS)) is None:
        raise Refused(
            f"{ran.stdout.strip()}\nRust {RUST} was downloaded, but doesn't run, see above"
        )


def download_zig() -> Path:
    """Zig, from its Python package. Returns the program."""
    packages = TOOLCHAIN / "zig"
    shutil.rmtree(packages, ignore_errors=True)
    install("zig", "--target", str(packages))
    return packages / "ziglang" / "zig"


def program(name: str, command: str, variables: Mapping[str, object], before: str = "") -> None:
    """Writes a program that runs a command in an environment of its own."""
    lines = [f'export {key}="{value}"' for key, value in variables.items()]
    path = PROGRAMS / name
    path.write_text("\n".join(["#!/bin/sh", *lines, f'{before}exec {command} "$@"', ""]))
    path.chmod(0o755)


def install(lock: str, *options: str, python: Path | None = None) -> None:
    """Installs the packages of a lock file. Raises `Refused` if pip can't."""
    file = ROOT / "requirements" / f"{lock}.lock"
    pip = [str(python or _python()), "-m", "pip", "install", "--quiet"]
    pip += ["--disable-pip-version-check", "--require-hashes", *options, "-r", str(file)]
    try:
        subprocess.run(pip, check=True)
    except subprocess.CalledProcessError:
        raise Refused(
            f"pip can't install the packages of {file.relative_to(ROOT)}, see above: connect this "
            "machine to a package index, or let PIP_FIND_LINKS name a folder with these packages"
        ) from None


def say(text: str) -> None:
    """Prints one line."""
    print(text, file=sys.stderr, flush=True)


def _refuse_on_windows(what: str, name: str) -> None:
    if os.name == "nt":
        raise Refused(f"{what} is required: install {name}")


def _python() -> Path:
    return ROOT / ".venv" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def _has_pip() -> bool:
    if not _python().exists():
        return False
    return not subprocess.run([_python(), "-m", "pip", "--version"], capture_output=True).returncode


def _numbers(version: str) -> tuple[int, ...]:
    found = re.search(r"\d+(\.\d+)+", version)
    return tuple(map(int, found[0].split("."))) if found else (0,)


def main() -> None:
    """Runs the part that the command line names."""
    parts = {"environment": environment, "toolchain": toolchain}
    if sys.argv[1:] not in [[name] for name in parts]:
        sys.exit(__doc__)
    try:
        parts[sys.argv[1]]()
    except Refused as refused:
        sys.exit(f"make: {refused}")


if __name__ == "__main__":
    main()

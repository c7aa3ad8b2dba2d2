"""Builds what is published into `dist`: the source distribution, and wheels for the systems below.

    dist.py [SYSTEM...]      all systems that this machine can build for, or those that are named

The source distribution contains the source of all crates, so it builds without a network. Wheels
are built from it, without a network.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import time
import zipfile
from dataclasses import dataclass
from pathlib import Path

import notices
import prepare
import vendoring

ROOT = prepare.ROOT
BUILD = ROOT / "build" / "dist"
DIST = ROOT / "dist"
MINGW = "x86_64-w64-mingw32-gcc"
STAMP = 1_000_000_000
"""The time of all files in what is made, so that the same source makes the same file."""


@dataclass(frozen=True)
class System:
    """What a wheel runs on."""

    name: str
    target: str
    policy: str | None
    """The standard that names the oldest C library."""


SYSTEMS = [
    System("linux-x86_64", "x86_64-unknown-linux-gnu", "manylinux2014"),
    System("linux-aarch64", "aarch64-unknown-linux-gnu", "manylinux2014"),
    System("linux-armv7", "armv7-unknown-linux-gnueabihf", "manylinux2014"),
    System("musl-x86_64", "x86_64-unknown-linux-musl", "musllinux_1_2"),
    System("musl-aarch64", "aarch64-unknown-linux-musl", "musllinux_1_2"),
    System("windows-x86_64", "x86_64-pc-windows-gnu", None),
]


class Skipped(Exception):
    """This machine can't build for a system: the message says what is missing."""


def source() -> tuple[Path, Path]:
    """Makes the source distribution. Returns its folder and its archive."""
    shutil.rmtree(BUILD, ignore_errors=True)
    run("maturin", "sdist", "--out", str(BUILD))
    [packed] = BUILD.glob("*.tar.gz")
    with tarfile.open(packed) as archive:
        archive.extractall(BUILD, filter="data")
    [folder] = (each for each in BUILD.iterdir() if each.is_dir())
    for each in folder.rglob("*"):
        os.utime(each)  # Cargo compares times, and all files of the archive have the same
    vendoring.vendor(folder, ROOT)
    notices.write(folder)
    return folder, pack(folder)


def pack(folder: Path) -> Path:
    """Packs the source distribution."""
    DIST.mkdir(exist_ok=True)
    packed = DIST / f"{folder.name}.tar.gz"
    with (
        packed.open("wb") as file,
        gzip.GzipFile("", "wb", 9, mtime=STAMP, fileobj=file) as zipped,
        tarfile.open(fileobj=zipped, mode="w", format=tarfile.PAX_FORMAT) as archive,
    ):
        for each in sorted(path for path in folder.rglob("*") if path.is_file()):
            member = archive.gettarinfo(each, f"{folder.name}/{each.relative_to(folder)}")
            member.uid = member.gid = 0
            member.uname = member.gname = ""
            member.mtime = STAMP
            with each.open("rb") as content:
                archive.addfile(member, content)
    return packed


def wheel(system: System, folder: Path) -> Path:
    """Builds the wheel of a system. Raises `Skipped`."""
    needs_target(system.target)
    options = ["--release", "--strip", "--locked", "--target", system.target]
    target = ROOT / "target" / "dist"
    variables = {
        "CARGO_NET_OFFLINE": "true",
        "CARGO_TARGET_DIR": str(target),
        # So that the same source makes the same file, wherever it lies.
        "SOURCE_DATE_EPOCH": str(STAMP),
        "RUSTFLAGS": f"--remap-path-prefix={folder}=. --remap-path-prefix={target}=target",
        "CFLAGS": f"-ffile-prefix-map={folder}=. -ffile-prefix-map={target}=target",
    }
    if system.policy:
        options += ["--zig", "--compatibility", system.policy]
        variables["CARGO_ZIGBUILD_ZIG_PATH"] = str(zig())
        variables |= {key: str(value) for key, value in prepare.ZIG_CACHES.items()}
    else:
        # The last link with zig fails: it looks for `PyInit_holdfast._core`.
        if shutil.which(MINGW) is None:
            raise Skipped(f"{MINGW} is missing; on Debian: apt install gcc-mingw-w64-x86-64")
        variables["CARGO_TARGET_X86_64_PC_WINDOWS_GNU_LINKER"] = MINGW
    out = BUILD / system.name
    run("maturin", "build", *options, "--out", str(out), folder=folder, **variables)
    [built] = out.glob("*.whl")
    return without_folder(built, folder, DIST / built.name)


def without_folder(built: Path, folder: Path, made: Path) -> Path:
    """Writes a wheel anew whose list of components does not name the folder of the build."""
    with zipfile.ZipFile(built) as wheel:
        files = {each: wheel.read(each) for each in wheel.infolist()}
    record = next(each for each in files if each.filename.endswith(".dist-info/RECORD"))
    for each, content in files.items():
        if "/sboms/" in each.filename:
            files[each] = content.replace(f"{folder}/".encode(), b"/")
            files[record] = files[record].replace(
                recorded(each, content), recorded(each, files[each])
            )
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as wheel:
        for each, content in files.items():
            wheel.writestr(each, content)
    return made


def recorded(file: zipfile.ZipInfo, content: bytes) -> bytes:
    """The line of a file in RECORD."""
    digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
    return f"{file.filename},sha256={digest},{len(content)}\n".encode()


def needs_target(target: str) -> None:
    """Installs Rust's standard library for a target. Raises `Skipped` if it can't."""
    if shutil.which("rustup") is not None:
        subprocess.run(["rustup", "--quiet", "target", "add", target], capture_output=True)
    asked = ["rustc", "--print", "target-libdir", "--target", target]
    if not Path(subprocess.check_output(asked, text=True).strip()).is_dir():
        raise Skipped(f"Rust has no standard library for {target} here; rustup installs it")


def zig() -> Path:
    """The program zig, which is downloaded if it is missing."""
    found = prepare.TOOLCHAIN / "zig" / "ziglang" / "zig"
    return found if found.exists() else prepare.download_zig()


def run(module: str, *arguments: str, folder: Path = ROOT, **variables: str) -> None:
    """Runs a Python program of the environment."""
    command = [sys.executable, "-m", module, *arguments]
    subprocess.run(command, cwd=folder, env={**os.environ, **variables}, check=True)


def main() -> None:
    """Builds all, and prints what was made, how large it is and how long it took."""
    names = {each.name: each for each in SYSTEMS}
    unknown = [name for name in sys.argv[1:] if name not in names]
    if unknown:
        sys.exit(f"{', '.join(unknown)}: unknown system, allowed: {', '.join(names)}")
    began = time.monotonic()
    folder, packed = source()
    report(packed, began)
    failed = []
    for system in [names[name] for name in sys.argv[1:]] or SYSTEMS:
        began = time.monotonic()
        try:
            report(wheel(system, folder), began)
        except Skipped as skipped:
            prepare.say(f"{system.name}: skipped, {skipped}")
        except subprocess.CalledProcessError:
            prepare.say(f"{system.name}: failed, see above")
            failed.append(system.name)
    if failed:
        sys.exit(1)


def report(made: Path, began: float) -> None:
    """Prints what was made."""
    size = made.stat().st_size / 1e6
    print(f"{made.relative_to(ROOT)}: {size:.1f} MB, {time.monotonic() - began:.0f} s", flush=True)


if __name__ == "__main__":
    try:
        main()
    except (prepare.Refused, vendoring.VendoringError) as error:
        sys.exit(f"dist: {error}")

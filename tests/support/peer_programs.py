"""The drivers of peers: how each is built, and how it is run as a client or a server.

A driver is a program in `tests/peers/drivers` with two forms:

    DRIVER client URL UNIT    executes operations: JSON lines on standard input, a result for each
    DRIVER server URL         prints its port (0 on a serial line), and serves until it is killed

What a driver needs is downloaded once, by the package manager of its language, with the versions
and check sums of a lock file. It is kept in `.cache/peers`.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from support.machine import missing, tool
from support.paths import ROOT, TESTS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

DRIVERS = TESTS / "peers" / "drivers"
CACHE = ROOT / ".cache" / "peers"

TIMEOUT = 60.0
"""Seconds that a driver has for all its operations."""
BUILD_TIMEOUT = 600.0

COPY_JARS = "org.apache.maven.plugins:maven-dependency-plugin:3.6.1:copy-dependencies"


FAILURES: dict[str, str] = {}
"""The drivers that could not be made in this run, and why."""


class BuildFailed(Exception):
    """A package manager or compiler failed."""


@dataclass(frozen=True)
class Driver:
    """The command that runs a driver, with its working directory and further environment."""

    command: tuple[str, ...]
    folder: Path = TESTS
    environment: dict[str, str] = field(default_factory=dict)

    def results(
        self, url: str, unit: int, operations: Sequence[dict[str, Any]]
    ) -> list[dict[str, Any]]:
        """Runs the driver as a client, and returns the result of each operation."""
        ran = subprocess.run(
            [*self.command, "client", url, str(unit)],
            cwd=self.folder,
            env=os.environ | self.environment,
            input="".join(f"{json.dumps(operation)}\n" for operation in operations),
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
            check=False,
        )
        assert ran.returncode == 0, f"{ran.stdout}{ran.stderr}"
        return [json.loads(line) for line in ran.stdout.splitlines()]

    @contextlib.contextmanager
    def serving(self, url: str) -> Iterator[int]:
        """Runs the driver as a server, and returns its port."""
        with subprocess.Popen(
            [*self.command, "server", url],
            cwd=self.folder,
            env=os.environ | self.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as process:
            try:
                assert process.stdout is not None
                line = process.stdout.readline()
                assert line.strip().isdigit(), f"the server printed {line!r} in place of its port"
                yield int(line)
            finally:
                process.kill()


def python(name: str, requires: tuple[int, int] = (3, 11)) -> Driver:
    """A driver in Python. Its packages are those of `requirements/dev.lock`."""
    if sys.version_info < requires:
        pytest.skip(f"{name} requires Python {'.'.join(map(str, requires))}")
    return Driver((sys.executable, "-m", f"peers.drivers.{name}"))


def node(name: str) -> Driver:
    """A driver for Node.js, with the packages of `package-lock.json`."""
    return Driver(
        (tool("node"), str(DRIVERS / "node" / f"{name}.cjs")),
        environment={"NODE_PATH": str(node_modules())},
    )


@functools.cache
def node_modules() -> Path:
    npm = tool("npm")
    files = [DRIVERS / "node" / "package.json", DRIVERS / "node" / "package-lock.json"]

    def install(folder: Path) -> None:
        for file in files:
            shutil.copy(file, folder)
        # Scripts would compile serial ports, which are there as compiled files.
        built(
            [npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error"], folder
        )

    return made("node", files, install) / "node_modules"


@functools.cache
def go() -> Driver:
    """The driver in Go, with the modules of `go.sum`."""
    compiler = tool("go")
    source = DRIVERS / "go"

    def install(folder: Path) -> None:
        options = {"GOTOOLCHAIN": "local", "GOFLAGS": "-mod=readonly"}
        built([compiler, "build", "-o", str(folder / "driver"), "."], source, options)

    return Driver((str(made("go", sorted(source.iterdir()), install) / "driver"),))


@functools.cache
def rust() -> Driver:
    """The driver in Rust, with the crates of `Cargo.lock`."""
    cargo = tool("cargo")
    source = DRIVERS / "rust"
    files = [source / "Cargo.toml", source / "Cargo.lock", source / "src" / "main.rs"]

    def install(folder: Path) -> None:
        target = CACHE / "rust-target"
        options = {"CARGO_TARGET_DIR": str(target)}
        built([cargo, "build", "--locked", "--quiet"], source, options)
        shutil.copy(target / "debug" / "driver", folder)

    return Driver((str(made("rust", files, install) / "driver"),))


def java(name: str) -> Driver:
    """A driver in Java, with the packages of `pom.xml`."""
    classes = java_classes()
    path = os.pathsep.join([str(classes), str(classes / "jars" / "*")])
    # A driver runs for a second: compiling it to fast code takes longer than it saves.
    return Driver((tool("java"), "-XX:TieredStopAtLevel=1", "-Xshare:auto", "-cp", path, name))


@functools.cache
def java_classes() -> Path:
    """The compiled drivers, with `jars` as a folder beside them."""
    maven, compiler = tool("mvn"), tool("javac")
    source = DRIVERS / "java"

    def install(folder: Path) -> None:
        jars = folder / "jars"
        built([maven, "-q", "-B", COPY_JARS, f"-DoutputDirectory={jars}"], source)
        found = {jar.name: hashlib.sha256(jar.read_bytes()).hexdigest() for jar in jars.iterdir()}
        lines = (source / "jars.sha256").read_text().splitlines()
        assert found == {name: digest for digest, name in map(str.split, lines)}
        files = map(str, sorted(source.glob("*.java")))
        built([compiler, "-nowarn", "-d", str(folder), "-cp", f"{jars}/*", *files], source)

    return made("java", sorted(source.iterdir()), install)


def made(name: str, sources: Sequence[Path], install: Callable[[Path], None]) -> Path:
    """Returns the folder made from these files. It is made once, and is complete or absent."""
    if name in FAILURES:
        # Without the network, each attempt takes long.
        missing(FAILURES[name])
    digest = hashlib.sha256()
    for source in sources:
        digest.update(f"{source.name}\0".encode() + source.read_bytes())
    folder = CACHE / f"{name}-{digest.hexdigest()[:16]}"
    CACHE.mkdir(parents=True, exist_ok=True)
    with alone(CACHE / f"{name}.lock"):
        if folder.exists():
            return folder
        with tempfile.TemporaryDirectory(dir=CACHE, prefix=f"{name}-") as building:
            whole = Path(building) / "whole"
            whole.mkdir()
            try:
                install(whole)
            except BuildFailed as failure:
                FAILURES[name] = str(failure)
                missing(FAILURES[name])
            whole.rename(folder)
    return folder


@contextlib.contextmanager
def alone(file: Path) -> Iterator[None]:
    """Waits until no other process is inside with the same file."""
    with file.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def built(command: Sequence[str], folder: Path, environment: dict[str, str] | None = None) -> None:
    """Runs a package manager or compiler."""
    ran = subprocess.run(
        command,
        cwd=folder,
        env=os.environ | (environment or {}),
        capture_output=True,
        text=True,
        timeout=BUILD_TIMEOUT,
        check=False,
    )
    if ran.returncode != 0:
        output = ran.stdout[-2000:] + ran.stderr[-2000:]
        raise BuildFailed(f"what `{' '.join(command)}` makes: {output}")

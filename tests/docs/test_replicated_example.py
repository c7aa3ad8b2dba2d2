"""The example of three nodes: a client that loses its node finds what was confirmed to it."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from holdfast.config import load
from support import wire
from support.brokers import free_port
from support.machine import missing
from support.paths import EXAMPLES

if TYPE_CHECKING:
    from collections.abc import Iterator

FOLDER = EXAMPLES / "replicated"
PORT = re.compile(r"\b(504[0-3]|[46]24[1-3])\b")
TIMEOUT = wire.DEADLINE
"""Three servers elect leaders, three interpreters start."""


@pytest.fixture
def ports() -> dict[str, str]:
    """Ports of this machine that are free, in place of those of the example."""
    own = sorted({port for file in FOLDER.iterdir() if file.is_file() for port in found(file)})
    free: set[int] = set()
    while len(free) < len(own):
        free.add(free_port())
    return dict(zip(own, map(str, free), strict=True))


def found(file: Path) -> list[str]:
    return PORT.findall(file.read_text())


@pytest.fixture
def folder(tmp_path: Path, ports: dict[str, str]) -> Path:
    for file in filter(Path.is_file, FOLDER.iterdir()):
        text = PORT.sub(lambda match: ports[match[0]], file.read_text())
        (tmp_path / file.name).write_text(text)
    return tmp_path


class Script:
    """A script of the example, running, and what it has printed."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self._out = folder / f"{arguments[0]}.out"
        with self._out.open("wb") as out:
            self.process = subprocess.Popen(
                [sys.executable, *arguments], cwd=folder, stdout=out, stderr=out
            )

    @property
    def lines(self) -> list[str]:
        return self._out.read_text().splitlines()

    def wait_for(self, line: str, times: int = 1) -> None:
        def is_there() -> bool:
            assert self.process.poll() is None, self.lines
            return sum(re.fullmatch(line, each) is not None for each in self.lines) >= times

        wire.until(is_there, f"{line}, {times} times", TIMEOUT)

    def end(self, number: signal.Signals) -> int:
        self.process.send_signal(number)
        return self.process.wait(TIMEOUT)


@pytest.fixture
def cluster(folder: Path) -> Iterator[Script]:
    if shutil.which("haproxy", path=f"/usr/sbin:{os.environ['PATH']}") is None:
        missing("the program haproxy")
    if not (Path(sys.executable).parent / "nats-server").exists():
        missing("the program nats-server")
    script = Script(folder, "cluster.py", "start")
    with ExitStack() as at_the_end:
        at_the_end.callback(script.end, signal.SIGTERM)
        script.wait_for("Ctrl-C stops them all.")
        yield script


def kill(folder: Path, *name: str) -> str:
    command = [sys.executable, "cluster.py", "kill", *name]
    return subprocess.run(
        command, cwd=folder, check=True, capture_output=True, text=True, timeout=TIMEOUT
    ).stdout.strip()


def test_a_client_finds_every_write_that_was_confirmed(
    cluster: Script, folder: Path, ports: dict[str, str]
) -> None:
    back = {own: port for port, own in ports.items()}
    page = (FOLDER / "README.md").read_text()
    _, started, _, shown, *_ = re.findall(r"```\w*\n(.*?)```", page, re.DOTALL)
    assert started.splitlines() == [
        re.sub(r"(?<=:)\d+", lambda match: back[match[0]], line) for line in cluster.lines
    ]
    again = subprocess.run(
        [sys.executable, "cluster.py", "start"],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
    )
    assert again.stderr.endswith("is in use: does the example run already?\n")
    client = Script(folder, "client.py")
    try:
        client.wait_for("100 writes")
        assert kill(folder) == "a is killed"
        client.wait_for(r"back after \d+ writes: 0 missing")
        cluster.wait_for("a is started again")
        written = sum(line.endswith(" writes") for line in client.lines)
        client.wait_for(r"\d+ writes", written + 1)
        assert kill(folder) == "b is killed"
        client.wait_for(r"back after \d+ writes: 0 missing", 2)
        assert client.end(signal.SIGTERM) == 0
    finally:
        client.process.kill()
        client.process.wait()
    # The signal may come before the end of a line.
    assert re.search(
        r"\d+ writes were confirmed, [2-9] interruptions, 0 are missing$", client.lines[-1]
    )
    # The page has lines of the same form.
    forms = {form_of(line) for line in client.lines}
    assert {form_of(line) for line in shown.splitlines()} - {"^C"} - forms <= {
        "N writes were confirmed, N interruption, N are missing"
    }
    assert cluster.end(signal.SIGTERM) == 0
    for port in ports.values():
        with pytest.raises(ConnectionRefusedError):
            wire.Connection(("127.0.0.1", int(port)))


def form_of(line: str) -> str:
    return re.sub(r"\d+", "N", line)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("haproxy", "haproxy is not installed; to install it: apt install haproxy"),
        ("nats-server", "nats-server is not installed; to install it: pip install"),
    ],
)
def test_a_program_that_is_missing_is_named(folder: Path, name: str, message: str) -> None:
    programs = folder / "programs"
    programs.mkdir()
    for each in {"haproxy", "nats-server"} - {name}:
        (programs / each).write_text("#!/bin/sh\n")
        (programs / each).chmod(0o755)
    script = folder / "cluster.py"
    text = script.read_text().replace("/usr/sbin:/usr/local/sbin", "/nowhere")
    script.write_text(text.replace("str(Path(sys.executable).parent)", '"/nowhere"'))
    done = subprocess.run(
        [sys.executable, script, "start"],
        env={**os.environ, "PATH": str(programs)},
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
    )
    assert done.returncode == 1
    assert done.stderr.startswith(message)


def test_the_configurations_are_right_and_alike() -> None:
    texts = set()
    for name in "abc":
        config = load(FOLDER / f"{name}.yaml")
        assert config.warnings == ()
        assert config.logs["site"].node == name
        text = (FOLDER / f"{name}.yaml").read_text().replace(f"node: {name}", "node: -")
        texts.add(re.sub(r":504\d", ":-", text))
    assert len(texts) == 1

"""The programs that Holdfast replaces: the same inputs to each of them and to Holdfast.

An original is a program of somebody else. Some have no licence, and no package registry has one
that can be installed by its version, so nothing here fetches or builds one: an environment
variable names a command that runs the program, such as `HOLDFAST_ORIGINAL_MMA2="/opt/mma2"`. It
is split as a shell does, and started without a shell, in an empty folder. `ORIGINALS` of the test
module lists the variables, and each module says which arguments the command gets. Without its
variable, a comparison is skipped, also in CI.

Each difference that the documentation names is a row of a table: input, their answer, our answer,
reason. A difference without a row fails the comparison, and so does a row without a difference.

Some originals listen on all addresses. Run them where nobody else reaches them, such as in a
network namespace of its own: `unshare -n sh -c 'ip link set lo up; …'`.
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import socket
import subprocess
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

import pytest

from support import wire
from support.brokers import free_port
from support.paths import DOCS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

Answers: TypeAlias = "dict[str, object]"
"""The answer to each input, by the input's name: what JSON can express."""


Launch: TypeAlias = "tuple[Sequence[str], Mapping[str, str]]"
"""Arguments and further environment."""


@dataclass(frozen=True)
class Reason:
    """Why answers differ, and the words of a page in `docs` that say so."""

    text: str
    page: str
    words: str

    @property
    def is_documented(self) -> bool:
        # Line breaks of a page mean nothing.
        return self.words in " ".join((DOCS / self.page).read_text().split())


@dataclass(frozen=True)
class Difference:
    """A row of the table."""

    input: str
    theirs: object
    ours: object
    reason: Reason


@dataclass(frozen=True)
class Original:
    """A program, and how both sides are asked."""

    name: str
    variable: str
    differences: Sequence[Difference]
    theirs: Callable[[Command, Path], Answers]
    """Starts the original in an empty folder, and asks it."""
    ours: Callable[[Path], Answers]
    """Starts Holdfast as the documentation says, and asks it the same."""

    def command(self) -> Command:
        """Returns the command that runs the original; skips the test without one."""
        words = shlex.split(os.environ.get(self.variable, ""))
        if not words:
            pytest.skip(f"{self.variable} is not set: the command that runs {self.name}")
        return Command(words)


class Command:
    """The command that runs an original."""

    def __init__(self, words: Sequence[str]) -> None:
        self._words = words

    @contextlib.contextmanager
    def running(
        self, folder: Path, *arguments: str, environment: Mapping[str, str] | None = None
    ) -> Iterator[subprocess.Popen[bytes]]:
        """Runs the program in a folder; its output is in `original.log` there."""
        with contextlib.ExitStack() as cleanup:
            log = cleanup.enter_context((folder / "original.log").open("ab"))
            process = subprocess.Popen(
                [*self._words, *arguments],
                cwd=folder,
                env=os.environ | (environment or {}),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
            cleanup.callback(process.wait)
            cleanup.callback(process.kill)
            yield process

    @contextlib.contextmanager
    def serving(
        self, folder: Path, count: int, configure: Callable[[Sequence[int]], Launch]
    ) -> Iterator[list[int]]:
        """Runs a program that listens at `count` ports, with what `configure` makes of them."""
        for _ in range(10):
            ports = [free_port() for _ in range(count)]
            arguments, environment = configure(ports)
            with self.running(folder, *arguments, environment=environment) as process:
                if _listens(process, ports):
                    yield ports
                    return
        raise AssertionError((folder / "original.log").read_text(errors="replace"))


@contextlib.contextmanager
def closed_port() -> Iterator[int]:
    """Keeps a port of this machine where nothing listens, and nothing else begins to."""
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        yield int(bound.getsockname()[1])


def is_open(port: int) -> bool:
    """Tells whether a program on this machine accepts connections at a port."""
    with contextlib.suppress(OSError):
        wire.Connection(("127.0.0.1", port)).close()
        return True
    return False


def _has_decided(process: subprocess.Popen[bytes], port: int) -> bool:
    return process.poll() is not None or is_open(port)


def _listens(process: subprocess.Popen[bytes], ports: Sequence[int]) -> bool:
    """Waits until a program listens at all ports of this machine; it may end, if one is taken."""
    for port in ports:
        wire.until(partial(_has_decided, process, port), f"{port} is open")
    return process.poll() is None


def unexpected(original: Original, theirs: Answers, ours: Answers) -> list[str]:
    """Returns what the table and the answers disagree about."""
    assert theirs.keys() == ours.keys()
    rows = {row.input: row for row in original.differences}
    assert len(rows) == len(original.differences), "an input has two rows"
    wrong = [f"{name}: there is no such input" for name in rows.keys() - theirs.keys()]
    for name in theirs:
        found, row = (theirs[name], ours[name]), rows.get(name)
        if row is None and found[0] != found[1]:
            wrong.append(f"{name}: a new difference: {found[0]!r}, ours: {found[1]!r}")
        elif row is not None and found != (row.theirs, row.ours):
            what = "has vanished" if found[0] == found[1] else "is another one"
            wrong.append(f"{name}: the difference {what}: {found[0]!r}, ours: {found[1]!r}")
    return wrong


def table(original: Original, theirs: Answers, ours: Answers) -> str:
    """Returns the differences as a table in Markdown."""
    reasons = {row.input: row.reason for row in original.differences}
    differing = [name for name in theirs if theirs[name] != ours[name]]
    lines = [
        f"{original.name}: {len(theirs)} inputs, {len(differing)} differences",
        "",
        "| input | original | Holdfast | reason |",
        "| --- | --- | --- | --- |",
    ]
    for name in differing:
        reason = reasons.get(name)
        why = f"{reason.text} ({reason.page})" if reason else "NOT DOCUMENTED"
        lines.append(f"| {name} | {_cell(theirs[name])} | {_cell(ours[name])} | {why} |")
    return "\n".join([*lines, ""])


def _cell(answer: object) -> str:
    text = json.dumps(answer, ensure_ascii=False).replace("|", "\\|")
    return (
        text
        if len(text) <= MAX_CELL_CHARS
        else f"{text[:MAX_CELL_CHARS]}… ({len(text)} characters)"
    )


MAX_CELL_CHARS = 160

"""The page on TLS: its walk-through runs as pasted."""

from __future__ import annotations

import re
import shlex
from typing import TYPE_CHECKING

from holdfast.config import load
from support.brokers import free_port
from support.cli import RunCommand, invoke
from support.paths import DOCS

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

SECTION = (DOCS / "modbus-tls.md").read_text().split("\n## Create certificates\n")[1]


def block(kind: str) -> str:
    """The first block of a kind in the section."""
    found = re.search(rf"^```{kind}\n(.*?)^```$", SECTION, re.MULTILINE | re.DOTALL)
    assert found
    return found[1]


def test_the_walk_through_serves_two_roles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    port = str(free_port())
    file = tmp_path / "secure.yaml"
    file.write_text(block("yaml").replace("8802", port))
    *commands, run = block("sh").splitlines()
    for command in commands:
        result = invoke(*shlex.split(command.removeprefix("holdfast ")))
        assert (result.exit_code, result.stderr) == (0, "")
    assert run == "holdfast run secure.yaml"
    assert load(file).warnings == ()

    running = RunCommand(file)
    try:
        running.wait_for_greeting()
        for asked in block("console").replace("8802", port).split("$ holdfast ")[1:]:
            command, _, output = asked.partition("\n")
            result = invoke(*shlex.split(command))
            assert result.stdout + result.stderr == output
    finally:
        running.process.kill()
        running.process.communicate()


def test_the_table_has_every_command() -> None:
    told = set(re.findall(r"^\| `cert (\w+)", SECTION, re.MULTILINE))
    listed = invoke("cert", "--help").stdout.split("Commands:")[1].split("Example:")[0]
    assert told == set(re.findall(r"^  (\w+)  ", listed, re.MULTILINE))

"""`holdfast --completion`: what a shell gets."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from holdfast.cli import COMMANDS
from support.cli import done, invoke, usage_error
from support.machine import tool

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_there_is_a_script_for_every_shell(shell: str) -> None:
    script = "\n".join(done("--completion", shell))
    assert f"_HOLDFAST_COMPLETE={shell}_complete" in script


def test_other_shells_are_wrong_usage() -> None:
    assert "'csh' is not one of 'bash', 'zsh', 'fish'." in usage_error("--completion", "csh")


def test_bash_completes_commands(tmp_path: Path) -> None:
    bash = tool("bash")
    script = tmp_path / "holdfast.bash"
    script.write_text("\n".join(done("--completion", "bash")))
    program = tmp_path / "holdfast"
    main = "from holdfast.cli import main; main(prog_name='holdfast')"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -c "{main}" "$@"\n')
    program.chmod(0o755)
    asked = f'. "{script}"; COMP_WORDS=(holdfast re); COMP_CWORD=1; _holdfast_completion holdfast'
    result = subprocess.run(
        [bash, "-c", f'{asked}; printf "%s\\n" "${{COMPREPLY[@]}}"'],
        env=os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert result.stdout.split() == ["read", "reload", "replicas", "replay"]


def test_commands_areas_and_options_are_completed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("_HOLDFAST_COMPLETE", "bash_complete")

    def completed(*words: str) -> list[str]:
        """What the script for bash gets."""
        monkeypatch.setenv("COMP_WORDS", " ".join(words))
        monkeypatch.setenv("COMP_CWORD", str(len(words) - 1))
        return [line.partition(",")[2] for line in invoke().stdout.splitlines()]

    assert set(completed("holdfast", '""')) == set(COMMANDS)
    assert completed("holdfast", "read", "tcp://plc", "hol") == ["holding_registers"]
    for words in (("map",), ("describe", "map")):
        assert completed("holdfast", *words, "--ex") == ["--exact"]
    assert completed("holdfast", "gue") == ["guess"]
    assert completed("holdfast", "describe", '""') == ["map", "guess", "identify", "status"]
    assert completed("holdfast", "check", "pl")[0] == "plan"
    for mistyped in ("reed", "import telegraff", "log statuss", "cert sho"):
        *group, word = mistyped.split()
        assert completed("holdfast", *group, word, '""') == completed("holdfast", *group, '""')

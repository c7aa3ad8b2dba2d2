"""`holdfast completion`: what a shell gets."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from holdfast.cli import COMMANDS
from support.cli import done, usage_error
from support.machine import tool

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_there_is_a_script_for_every_shell(shell: str) -> None:
    script = "\n".join(done("completion", shell))
    assert f"_HOLDFAST_COMPLETE={shell}_complete" in script


def test_other_shells_are_wrong_usage() -> None:
    assert "'csh' is not one of 'bash', 'zsh', 'fish'." in usage_error("completion", "csh")


def test_bash_completes_commands_areas_and_options(tmp_path: Path) -> None:
    bash = tool("bash")
    script = tmp_path / "holdfast.bash"
    script.write_text("\n".join(done("completion", "bash")))
    program = tmp_path / "holdfast"
    main = "from holdfast.cli import main; main(prog_name='holdfast')"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -c "{main}" "$@"\n')
    program.chmod(0o755)

    def completed(*words: str) -> list[str]:
        line = f"COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}"
        asked = f'. "{script}"; {line}; _holdfast_completion holdfast; printf "%s\\n" '
        result = subprocess.run(
            [bash, "-c", f'{asked} "${{COMPREPLY[@]}}"'],
            env=os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"},
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
        return result.stdout.split()

    assert completed("holdfast", "re") == ["read", "reload", "replicas", "replay"]
    assert set(completed("holdfast", '""')) == set(COMMANDS)
    assert completed("holdfast", "read", "tcp://plc", "hol") == ["holding_registers"]
    assert completed("holdfast", "map", "--ex") == ["--exact"]

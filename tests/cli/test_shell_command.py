"""Commands that a user can paste into a shell."""

from __future__ import annotations

import os
import shlex
import sys

import click
import pytest

from holdfast.cli.services import run
from holdfast.cli.shell_command import shell_command


def test_words_are_quoted_for_the_shell_of_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["check", 5, "C:\\my plant\\a.yaml"]
    monkeypatch.setattr(sys, "platform", "linux")
    assert shlex.split(shell_command(*words)) == list(map(str, words))
    monkeypatch.setattr(sys, "platform", "win32")
    assert shell_command(*words) == r'check 5 "C:\my plant\a.yaml"'


def test_a_program_on_another_drive_has_its_whole_path(monkeypatch: pytest.MonkeyPatch) -> None:
    def relative(path: str) -> str:
        raise ValueError(f"path is on mount '{path[:2]}', start on mount 'D:'")

    program = "C:\\Holdfast\\Scripts\\holdfast.exe"
    monkeypatch.setattr(os.path, "relpath", relative)
    monkeypatch.setattr("shutil.which", lambda _: None)
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(sys, "argv", [program])
    with click.Context(click.Command("holdfast"), info_name="holdfast"):
        assert run._program() == program

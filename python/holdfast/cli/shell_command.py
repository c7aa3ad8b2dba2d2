"""Commands to paste into the shell of this system."""

from __future__ import annotations

import shlex
import sys


def shell_command(*words: object) -> str:
    """A command line that gives a program exactly these words."""
    texts = list(map(str, words))
    if sys.platform == "win32":
        import subprocess

        return subprocess.list2cmdline(texts)
    return shlex.join(texts)

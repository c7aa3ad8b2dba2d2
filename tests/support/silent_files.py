"""Files that don't answer, as those of a mount whose server is gone."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from support import wire

if TYPE_CHECKING:
    import pytest


class Silent:
    """Blocks calls of a function of `os` for files, until `answer` or the end of the block."""

    def __init__(self, patch: pytest.MonkeyPatch, function: str, *files: Path) -> None:
        self._answers = threading.Event()
        self.calls = 0
        real = getattr(os, function)
        names = {str(file) for file in files}

        def silent(file: Any, *arguments: Any, **options: Any) -> Any:
            at = str(Path(f"/proc/self/fd/{file}").readlink() if isinstance(file, int) else file)
            if at in names:
                self.calls += 1
                self._answers.wait(wire.DEADLINE)
            return real(file, *arguments, **options)

        self._patch, self._function, self._real = patch, function, real
        patch.setattr(os, function, silent)

    def answer(self) -> None:
        self._patch.setattr(os, self._function, self._real)
        self._answers.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.answer()


def threads() -> list[threading.Thread]:
    """The threads that work with files."""
    return [each for each in threading.enumerate() if each.name == "holdfast-files"]

"""Files that can't be renamed, as on Windows while a program has them open."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    import pytest


def not_renamed(monkeypatch: pytest.MonkeyPatch, *files: Path) -> Callable[[], None]:
    """Lets files keep their names. Returns how to let them be renamed again."""
    real = Path.replace

    def replaced(file: Path, target: Path) -> Path:
        if file in files:
            raise PermissionError(13, "The process cannot access the file", str(file))
        return real(file, target)

    monkeypatch.setattr(Path, "replace", replaced)
    return lambda: monkeypatch.setattr(Path, "replace", real)

"""Prepares an imported configuration of MMA for a run on free ports."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.importing import read_mma

if TYPE_CHECKING:
    from pathlib import Path


def imported(text: str, folder: Path, **options: Any) -> dict[str, Any]:
    """Imports a configuration as `holdfast import mma` does, with `options`, on free ports."""
    path = folder / "mma.yaml"
    path.write_text(text)
    data: dict[str, Any] = read_mma(path, **options).data
    for settings in (*data["listeners"].values(), data.get("rest")):
        if settings:
            settings["bind"] = "127.0.0.1:0"
    return data

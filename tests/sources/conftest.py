"""Fixtures of the tests that send what other documents print: the documented import, running."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import pytest

from holdfast.importing import read_mma
from support.config_folder import written

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.running import Run


class RunImported(Protocol):
    """Imports a configuration as `holdfast import mma` does, and runs it on free ports.

    `change` is what a person changes in the new configuration.
    """

    def __call__(
        self, text: str, *, change: Callable[[dict[str, Any]], None] | None = None, **options: Any
    ) -> Appliance: ...


@pytest.fixture
def run_imported(tmp_path: Path, run: Run) -> RunImported:
    def imported(
        text: str, *, change: Callable[[dict[str, Any]], None] | None = None, **options: Any
    ) -> Appliance:
        path = tmp_path / "mma.yaml"
        path.write_text(text)
        data: dict[str, Any] = read_mma(path, **options).data
        for settings in (*data["listeners"].values(), data.get("rest", {})):
            if settings:
                settings["bind"] = "127.0.0.1:0"
        if change is not None:
            change(data)
        return run(written(data))

    return imported

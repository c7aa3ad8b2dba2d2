"""Fixtures of the tests that send what other documents print: the documented import, running."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import pytest

from support.config_folder import written
from support.imported import imported

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
    def start(
        text: str, *, change: Callable[[dict[str, Any]], None] | None = None, **options: Any
    ) -> Appliance:
        data = imported(text, tmp_path, **options)
        if change is not None:
            change(data)
        return run(written(data))

    return start

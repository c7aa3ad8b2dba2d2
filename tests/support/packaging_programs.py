"""The programs of the folder `packaging`, as modules."""

from __future__ import annotations

import importlib.util
import sys
from typing import TYPE_CHECKING, Any

from support.paths import ROOT

if TYPE_CHECKING:
    import pytest


def program(name: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports `packaging/NAME.py`, which can import its neighbours."""
    file = ROOT / "packaging" / f"{name}.py"
    monkeypatch.syspath_prepend(str(file.parent))
    spec = importlib.util.spec_from_file_location(f"packaging_{file.stem}", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module

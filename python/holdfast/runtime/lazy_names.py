"""Packages whose names are imported when they are first used: see `imported_on_use`."""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


def imported_on_use(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package that exports names of other modules.

    `homes` has the module of each name. A command uses few names of a package, and would wait for
    the imports of all others.
    """

    def found(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = importlib.import_module(homes[name])
        value = module if homes[name] == f"{package}.{name}" else getattr(module, name)
        # Python asks only for names that the package does not have.
        setattr(sys.modules[package], name, value)
        return value

    return found

"""The configuration of an appliance: one YAML file, checked as a whole before anything starts.

Call `load`. It returns a valid `Config`, or raises a `ConfigError` with every problem of the file.
This package never starts anything and never opens a socket. It uses only the constants of the
native core.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.runtime.lazy_names import imported_on_use

if TYPE_CHECKING:
    from holdfast.config.loader import load
    from holdfast.config.models.root import Config
    from holdfast.config.schema import json_schema
    from holdfast.config.text.problems import ConfigError, Problem
else:
    __getattr__ = imported_on_use(
        __name__,
        {
            "Config": "holdfast.config.models.root",
            "ConfigError": "holdfast.config.text.problems",
            "Problem": "holdfast.config.text.problems",
            "json_schema": "holdfast.config.schema",
            "load": "holdfast.config.loader",
        },
    )

__all__ = ["Config", "ConfigError", "Problem", "json_schema", "load"]

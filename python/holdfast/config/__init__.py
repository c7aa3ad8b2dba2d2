"""The configuration of an appliance: one YAML file, checked as a whole before anything starts.

`load` is the way in. It returns a `Config` that is right in every respect, or raises a
`ConfigError` that holds every problem of the file at once. This room must never start anything,
open a socket or import the native core.
"""

from __future__ import annotations

from holdfast.config.addresses import Bind, Network
from holdfast.config.initial import InitialRun
from holdfast.config.loading import load
from holdfast.config.model import (
    Config,
    IdentityConfig,
    LogConfig,
    MemoryConfig,
    ModbusTcpListener,
    RuleConfig,
    Seal,
    Span,
)
from holdfast.config.problems import ConfigError, Problem
from holdfast.config.schema import json_schema

__all__ = [
    "Bind",
    "Config",
    "ConfigError",
    "IdentityConfig",
    "InitialRun",
    "LogConfig",
    "MemoryConfig",
    "ModbusTcpListener",
    "Network",
    "Problem",
    "RuleConfig",
    "Seal",
    "Span",
    "json_schema",
    "load",
]

"""Holdfast: Modbus servers with shared memories, and clients of Modbus devices.

This module exports the public names of the library. The command line is in `holdfast.cli`, the
configuration in `holdfast.config`, and the native core in `holdfast._core`.
"""

from __future__ import annotations

import importlib
from typing import Any

from holdfast import raw_ingest, values
from holdfast._core import Memory, OutOfRange, Rule, __version__
from holdfast.client import Client, SyncClient
from holdfast.errors import (
    ConnectFailed,
    ConnectionLost,
    InvalidResponse,
    ModbusError,
    ModbusException,
    RequestTimeout,
    TlsFailed,
)
from holdfast.server import Server

__all__ = [
    "Client",
    "ConnectFailed",
    "ConnectionLost",
    "InvalidResponse",
    "Memory",
    "ModbusError",
    "ModbusException",
    "OutOfRange",
    "RequestTimeout",
    "Rule",
    "Server",
    "SyncClient",
    "TlsFailed",
    "__version__",
    "raw_ingest",
    "values",
]


def __getattr__(name: str) -> Any:
    """Supports the former name of `raw_ingest`, with a deprecation warning."""
    if name == "raw":
        return importlib.import_module("holdfast.raw")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

"""Holdfast: a Modbus memory that many writers fill and many readers read, and clients of devices.

The public names of the library. Everything else is the command line's (`holdfast.cli`), the
configuration's (`holdfast.config`) or native (`holdfast._core`, which some of these come from).
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
    """The former name of `raw_ingest`, which warns."""
    if name == "raw":
        return importlib.import_module("holdfast.raw")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

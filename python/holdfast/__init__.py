"""Holdfast: Modbus servers with shared memories, and clients of Modbus devices.

This module exports the public names of the library. The command line is in `holdfast.cli`, the
configuration in `holdfast.config`, and the native core in `holdfast._core`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from holdfast import raw_ingest, values
from holdfast._core import Memory, OutOfRange, Rule, ServerTls, __version__
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
from holdfast.polling import Poller
from holdfast.server import Server
from holdfast.tags import Tag, TagError, TagList
from holdfast.write_callback import WriteCallback

if TYPE_CHECKING:
    from holdfast.config.tag_files import load_tags

__all__ = [
    "Client",
    "ConnectFailed",
    "ConnectionLost",
    "InvalidResponse",
    "Memory",
    "ModbusError",
    "ModbusException",
    "OutOfRange",
    "Poller",
    "RequestTimeout",
    "Rule",
    "Server",
    "ServerTls",
    "SyncClient",
    "Tag",
    "TagError",
    "TagList",
    "TlsFailed",
    "WriteCallback",
    "__version__",
    "load_tags",
    "raw_ingest",
    "values",
]


def __getattr__(name: str) -> Any:
    """Supports the former name of `raw_ingest`, and imports what needs a YAML parser on demand."""
    if name == "load_tags":
        return importlib.import_module("holdfast.config.tag_files").load_tags
    if name == "raw":
        return importlib.import_module("holdfast.raw")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

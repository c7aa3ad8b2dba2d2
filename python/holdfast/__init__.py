"""Holdfast: Modbus servers with shared memories, and clients of Modbus devices.

This module exports the public names of the library. The command line is in `holdfast.cli`, the
configuration in `holdfast.config`, and the native core in `holdfast._core`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.runtime.lazy_names import imported_on_use

if TYPE_CHECKING:
    from holdfast import polling, raw_ingest, server, values
    from holdfast._core import Memory, OutOfRange, Rule, ServerTls, __version__
    from holdfast.client import Client, SyncClient
    from holdfast.config.tag_files.read import load_tags
    from holdfast.config.text.problems import ConfigError
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
    from holdfast.server.write_callback import WriteCallback
    from holdfast.tags import Tag, TagError, TagList
else:
    _CORE = ("Memory", "OutOfRange", "Rule", "ServerTls", "__version__")
    _ERRORS = (
        "ConnectFailed",
        "ConnectionLost",
        "InvalidResponse",
        "ModbusError",
        "ModbusException",
        "RequestTimeout",
        "TlsFailed",
    )
    __getattr__ = imported_on_use(
        __name__,
        {
            **dict.fromkeys(_CORE, "holdfast._core"),
            **dict.fromkeys(("Client", "SyncClient"), "holdfast.client"),
            **dict.fromkeys(_ERRORS, "holdfast.errors"),
            **dict.fromkeys(("Tag", "TagError", "TagList"), "holdfast.tags"),
            "ConfigError": "holdfast.config.text.problems",
            "Poller": "holdfast.polling",
            "Server": "holdfast.server",
            "WriteCallback": "holdfast.server.write_callback",
            "load_tags": "holdfast.config.tag_files.read",
            "polling": "holdfast.polling",
            "raw_ingest": "holdfast.raw_ingest",
            "server": "holdfast.server",
            "values": "holdfast.values",
        },
    )

__all__ = [
    "Client",
    "ConfigError",
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
    "polling",
    "raw_ingest",
    "server",
    "values",
]


def __dir__() -> list[str]:
    return __all__

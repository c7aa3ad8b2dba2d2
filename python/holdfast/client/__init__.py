"""Clients of Modbus devices, over every transport: `Client` for asyncio, `SyncClient` without it.

Both have the same methods, run the same steps (`requests`) and raise the same errors
(`holdfast.errors`). This package never polls.

A client connects on its first call and keeps the connection. When the connection is lost, pending
calls fail, and the next call reconnects. No call is retried.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.runtime.lazy_names import imported_on_use

if TYPE_CHECKING:
    from holdfast.client.client import Client
    from holdfast.client.sync_client import SyncClient
else:
    __getattr__ = imported_on_use(
        __name__,
        {"Client": "holdfast.client.client", "SyncClient": "holdfast.client.sync_client"},
    )

__all__ = ["Client", "SyncClient"]

"""A NATS server of our own: nats-server as a child process.

The server of a log has a folder that it alone uses. That of a command is temporary.
"""

from __future__ import annotations

from holdfast.net.nats_server.folder import Access, InUse, ServerUnusable, TemporarilyUnusable
from holdfast.net.nats_server.server import NatsServer
from holdfast.net.nats_server.temporary import HOST, TemporaryServer

__all__ = [
    "HOST",
    "Access",
    "InUse",
    "NatsServer",
    "ServerUnusable",
    "TemporarilyUnusable",
    "TemporaryServer",
]

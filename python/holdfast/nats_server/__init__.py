"""A NATS server of our own: nats-server as a child process, with a folder that it alone uses."""

from __future__ import annotations

from holdfast.nats_server.folder import Access, InUse, ServerUnusable
from holdfast.nats_server.server import NatsServer

__all__ = ["Access", "InUse", "NatsServer", "ServerUnusable"]

"""`Server`: serves memories from Python, over every Modbus transport.

The server is one listener of the native engine, whose threads serve it outside the interpreter.
`holdfast.appliance` has appliances with several listeners.
"""

from __future__ import annotations

from holdfast.server.identity import Identity
from holdfast.server.options import ServerOptions
from holdfast.server.server import Server

__all__ = ["Identity", "Server", "ServerOptions"]

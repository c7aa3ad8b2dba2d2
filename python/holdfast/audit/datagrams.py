"""Sockets that send datagrams to one address."""

from __future__ import annotations

import socket
import sys
from typing import Any


def datagrams(family: int, address: Any) -> socket.socket:
    """A socket that sends datagrams to an address. Raises `OSError`."""
    made = socket.socket(family, socket.SOCK_DGRAM)
    try:
        made.connect(address)
    except OSError:
        made.close()
        raise
    return made


def unix_datagrams(path: str) -> socket.socket:
    """A socket that sends datagrams to a Unix socket. Raises `OSError`."""
    if sys.platform == "win32":
        raise OSError("this system has no Unix sockets for datagrams")
    return datagrams(socket.AF_UNIX, path)

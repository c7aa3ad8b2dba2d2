"""What nodes of a fleet ask each other."""

from __future__ import annotations

from typing import Any

import msgspec


class Command(msgspec.Struct, kw_only=True):
    """A command for a device that the other node polls."""

    device: str
    tag: str
    text: str
    epoch: int
    """The revision of the lease that the sender knows. A node with an older one must not write."""
    within: float = 0.0
    """Seconds that it may wait for the device, besides one timeout of the device."""


class Executed(msgspec.Struct, kw_only=True, omit_defaults=True):
    """The answer to a command."""

    error: str | None = None
    moved: bool = False
    """The node does not poll the device any more. Nothing was written."""


class ReportQuestion(msgspec.Struct, kw_only=True):
    """Asks for reports, or for variables, of devices that the other node polls."""

    devices: list[str]


class NodeReports(msgspec.Struct, kw_only=True):
    """The reports, or the variables, of some of the devices: as many as fit into a message."""

    devices: dict[str, Any]


def subject(prefix: str, node: str, what: str, process: str = "") -> str:
    """Where a node is asked; with `process`, only that one: two may have the same name."""
    return ".".join((prefix, "fleet", node, *([process] if process else []), what))

"""Raises the limit on open files to what a configuration needs."""

from __future__ import annotations

import logging
import sys
from typing import TYPE_CHECKING

from holdfast.appliance.services.gateway import gateway_settings
from holdfast.appliance.services.scanner import scanner_settings
from holdfast.config.fingerprint import files_of
from holdfast.events import log_lines

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config import Config

OTHER_FILES = 128
"""Open files that are not connections: listeners, metrics requests, the interpreter's files."""


def allow_open_files(config: Config, file: Path | None) -> None:
    """Raises the limit for the connections of a configuration, and the files that are watched."""
    raise_open_file_limit(_connections(config) + _watched(config, file))


def raise_open_file_limit(connections: int) -> None:
    """Raises the limit on open files for `connections`; logs if the system does not allow it."""
    if sys.platform == "win32":  # It has no such limit.
        return
    import resource

    needed = connections + OTHER_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return
    allowed = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
    except (ValueError, OSError):  # The system has a lower limit that it does not report.
        allowed = soft
    if allowed < needed:
        log_lines.write(logging.WARNING, "too_few_open_files", needed=needed, allowed=allowed)


def _connections(config: Config) -> int:
    """The maximum number of open connections of a configuration."""
    served = [*config.listeners.values(), config.rest]
    limits = ("max_connections", "max_handshakes")
    most = sum(getattr(each, limit, 0) or 0 for each in served for limit in limits)
    most += sum(1 + len(device.forward) for device in config.devices.values())
    most += len(config.links)
    if config.nats is not None:
        most += scanner_settings(config.nats).limits.devices
    if config.gateway is not None:
        of_gateway = gateway_settings(config.gateway).limits
        most += of_gateway.connections + of_gateway.devices
    return most


def _watched(config: Config, file: Path | None) -> int:
    """The number of files that are kept open while they are watched."""
    if file is None or config.reload != "on-change":
        return 0
    return len(files_of(file, config))

"""Checks the NATS servers of logs, and those that are started with the appliance."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from holdfast.config.lenient import entries, mapping, parsed
from holdfast.config.logs import EMBEDDED_URL
from holdfast.config.scanning import parse_server
from holdfast.config.unique import Owners
from holdfast.config.words import show
from holdfast.net.addresses import parse_address

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.remote import Remote
    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath
    from holdfast.net.addresses import Address

_FORM = "nats:// with an IP address of this machine, as in nats://127.0.0.1:4222"


def check_servers(path: KeyPath, log: dict[Any, Any], report: Report) -> None:
    """Reports missing servers, and settings that an embedded server does not have."""
    if "embedded" not in log:
        if "servers" not in log:
            message = "missing, allowed: a list of nats://host:port (optional with embedded)"
            report.add((*path, "servers"), message, of_key=True)
        return
    for key in ("credentials_file", "tls"):
        if key in log:
            message = "found with embedded, allowed: username and password_file, or token_file"
            report.add((*path, key), message, of_key=True)
    if "monitoring" in log:
        message = "found with embedded, allowed: without, its sync_interval is always"
        report.add((*path, "monitoring"), message, of_key=True)
    if log.get("replicas", 1) != 1:
        message = f"found {show(log['replicas'])} with embedded, allowed: 1, it is one server"
        report.add((*path, "replicas"), message)
    if "username" in log and "password_file" not in log:
        message = "found with embedded and without password_file, allowed: both or neither"
        report.add((*path, "username"), message, of_key=True)
    _check_bind(path, log, report)


def check_embedded(logs: dict[Any, Any], folder: Path, report: Report) -> None:
    """Reports embedded servers that share a folder or a port."""
    folders, ports = Owners(report, "folder"), Owners(report, "address")
    for name, log in logs.items():
        file = mapping(log).get("embedded")
        if not isinstance(file, str) or not file or "\0" in file:
            continue
        path = ("logs", name)
        folders.claim((*path, "embedded"), os.path.realpath(folder / file), show(file), path)
        bind = _bind(mapping(log))
        if bind is not None:
            key = "servers" if "servers" in log else "embedded"
            ports.claim((*path, key), (bind.host, bind.port), str(bind), path)


def _address(host: object) -> Address:
    return parse_address(str(host))


def _bind(log: dict[Any, Any]) -> Remote | None:
    given = entries(log.get("servers", [EMBEDDED_URL]))
    return parsed(parse_server, given[0]) if len(given) == 1 else None


def _check_bind(path: KeyPath, log: dict[Any, Any], report: Report) -> None:
    given = entries(log.get("servers"))
    if len(given) > 1:
        message = f"found {len(given)} entries with embedded, allowed: one, where it listens"
        report.add((*path, "servers"), message)
    remote = parsed(parse_server, given[0]) if len(given) == 1 else None
    if remote is None:
        return
    address = parsed(_address, remote.host)
    if remote.scheme != "nats" or address is None:
        report.add((*path, "servers", 0), f"found {show(str(remote))}, allowed: {_FORM}")
    elif not address.is_loopback and not log.keys() & {"username", "token_file"}:
        message = "found with embedded, without username or token_file, allowed: a loopback address"
        report.add((*path, "servers", 0), message)

"""Checks NATS servers, wherever they are configured, and the logs of writes that they have."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from holdfast import _core
from holdfast.client.url import connection_of
from holdfast.config.checks.common import Owners, check_name, items, until_invalid
from holdfast.config.checks.tls import check_client_tls, check_files
from holdfast.config.models.base import INVALID
from holdfast.config.models.logs import SharedLogConfig
from holdfast.config.models.services import NatsConfig
from holdfast.config.text.messages import show
from holdfast.config.values.scanner_settings import check_dialect, parse_server
from holdfast.net.addresses import parse_address
from holdfast.runtime.text import all_of, listing

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.checks.common import Scope
    from holdfast.config.models.logs import SharedLogConfig
    from holdfast.config.models.memories import MemoryConfig
    from holdfast.config.models.outputs import NatsOutputConfig
    from holdfast.config.models.services import NatsServersConfig
    from holdfast.config.text.report import Report
    from holdfast.config.text.yaml_document import KeyPath


_IDENTITIES = ("username", "token_file", "credentials_file")
"""Keys that authenticate a client at the NATS server; only one of them is allowed."""

_FORM = "nats:// with an IP address of this machine, as in nats://127.0.0.1:4222"


def check_logs(scope: Scope) -> None:
    """Reports what is wrong."""
    config, report = scope.config, scope.report
    with until_invalid():
        for path, settings in items(("logs",), config.logs):
            check_nats(path, settings, report)
            check_servers(path, settings, report)
        check_embedded(scope)
    with until_invalid():
        for path, memory in items(("memories",), config.memories):
            with until_invalid():
                if memory.replicate is not None:
                    where = (*path, "replicate", "log")
                    check_name(where, memory.replicate.log, scope.names("logs"), "logs", report)
        _check_files(scope)
        _check_devices(scope)


def warn_of_logs(scope: Scope) -> None:
    """Warns about logs without memories."""
    used = {_log(memory) for memory in scope.config.memories.values()}
    for name in scope.config.logs:
        if name not in used:
            scope.report.warn(("logs", name), "has no effect: no memory is replicated through it")


def _log(memory: MemoryConfig) -> str | None:
    """The log of a memory; `None` without one, or if it is invalid."""
    with until_invalid():
        if memory.replicate is not None:
            return memory.replicate.log
    return None


def _file(memory: MemoryConfig) -> Path | None:
    """The file of a memory; `None` without one, or if it is invalid."""
    with until_invalid():
        if memory.keep is not None:
            return memory.keep.file
    return None


def _check_files(scope: Scope) -> None:
    """Reports files that don't have all memories of one log, and no others."""
    memories = {path[-1]: each for path, each in items(("memories",), scope.config.memories)}
    logs = {name: _log(memory) for name, memory in memories.items()}
    files = {name: _file(memory) for name, memory in memories.items()}
    for name, log in logs.items():
        if log is None:
            continue
        path = ("memories", name, "keep")
        own = files[name]
        for other, of_other in files.items():
            if logs[other] == log and own is None and of_other is not None:
                message = f"missing, required: all memories of a log have keep if {other} has"
                scope.report.add(("memories", name), message)
                break
            if own is None or of_other is None or other == name:
                continue
            if logs[other] == log and of_other != own:
                allowed = f"allowed: {show(str(of_other))}, as {other} has"
                scope.report.add((*path, "file"), f"found {show(str(own))}, {allowed}")
                break
            if logs[other] != log and of_other == own:
                message = f"found the file of {other}, which is not of this log"
                scope.report.add((*path, "file"), message)
                break
        with until_invalid():
            keep = memories[name].keep
            if keep is not None and keep.sync == 0:
                scope.report.add((*path, "sync"), "found 0, allowed with replicate: more than 0")


def _check_devices(scope: Scope) -> None:
    """Reports devices of more than one log, also at one address: one lease says who polls it."""
    at_address: dict[str, tuple[KeyPath, str]] = {}
    for path, device in items(("devices",), scope.config.devices):
        with until_invalid():
            places: list[Any] = [
                read.into for _, read in items(path, device.reads) if read.into is not None
            ]
            if device.status is not None:
                places.append(device.status)
            memories = [scope.config.memories.get(place.memory) for place in places]
            known = [each for each in memories if each is not None and each is not INVALID]
            logs = dict.fromkeys(log for memory in known if (log := _log(memory)) is not None)
            if len(logs) > 1:
                message = f"found memories of the logs {all_of(logs)}, allowed: those of one log"
                scope.report.add_key(path, message)
            elif logs and device.is_polled:
                [log] = logs
                first, other = at_address.setdefault(connection_of(device.target), (path, log))
                if log != other:
                    found = f"found a memory of the log {show(log)}"
                    shared = f"as {scope.report.named(first)} has at this address"
                    scope.report.add_key(path, f"{found}, allowed: one of {show(other)}, {shared}")


def check_nats(path: KeyPath, nats: NatsServersConfig, report: Report) -> None:
    """Reports what is wrong with the servers of a section."""
    written = report.raw(path)  # An embedded server adds keys that are not in the file.
    if "password_file" in written and "username" not in written:
        report.add_key((*path, "password_file"), "found without username, allowed: both or neither")
    files: tuple[str, ...] = ("password_file", "token_file", "credentials_file")
    with until_invalid():
        if isinstance(nats, SharedLogConfig) and nats.makes_token:
            files = ("password_file",)
    check_files(path, nats, tuple(key for key in files if key in written), report)
    first, *others = [key for key in _IDENTITIES if key in written] or [""]
    for key in others:
        message = f"found together with {first}, allowed: only one of {listing(_IDENTITIES)}"
        report.add_key((*path, key), message)
    with until_invalid():
        servers = [parse_server(url) for _, url in items(path, nats.servers)]
        secure = len(servers) < len(nats.servers) or any(each.scheme == "tls" for each in servers)
        # With embedded, check_servers says that tls is not for it.
        if "tls" in written and "embedded" not in written and servers and not secure:
            message = "found with servers that begin with nats://, allowed: only with tls://"
            report.add_key((*path, "tls"), message)
    with until_invalid():
        check_client_tls((*path, "tls"), nats.tls, report)


def check_dialect_of(path: KeyPath, nats: NatsConfig | NatsOutputConfig, report: Report) -> None:
    """Reports what the dialect of a scanner or output does not allow."""
    with until_invalid():
        try:
            check_dialect(nats.dialect, nats.prefix)
        except ValueError as error:
            report.add((*path, "prefix"), str(error))
    if not isinstance(nats, NatsConfig) or "fleet" not in report.raw(path):
        return
    with until_invalid():
        if nats.dialect == "tentacle-next":
            message = "found tentacle-next together with fleet, allowed: tentacle"
            report.add((*path, "dialect"), message)
    with until_invalid():
        if not nats.keep_subscriptions:
            message = "found false together with fleet, allowed: true"
            report.add((*path, "keep_subscriptions"), message)


def check_servers(path: KeyPath, log: SharedLogConfig, report: Report) -> None:
    """Reports names that the log refuses, missing servers, and what an embedded server has not."""
    written, name = report.raw(path), str(path[-1])
    try:
        _core.check_log_name(name)
    except ValueError as error:
        report.add_key(path, f"found {show(name)}, allowed: {error}")
    with until_invalid():
        try:
            _core.check_log_node(log.node)
        except ValueError as error:
            report.add((*path, "node"), f"found {show(log.node)}, allowed: {error}")
    if "embedded" not in written:
        if "servers" not in written:
            message = "missing, allowed: a list of nats://host:port (optional with embedded)"
            report.add_key((*path, "servers"), message)
        return
    for key in ("credentials_file", "tls"):
        if key in written:
            message = "found with embedded, allowed: username and password_file, or token_file"
            report.add_key((*path, key), message)
    if written.get("monitoring"):
        message = "found with embedded, allowed: without, its sync_interval is always"
        report.add_key((*path, "monitoring"), message)
    with until_invalid():
        if log.replicas != 1:
            message = f"found {log.replicas} with embedded, allowed: 1, it is one server"
            report.add((*path, "replicas"), message)
    if "username" in written and "password_file" not in written:
        message = "found with embedded and without password_file, allowed: both or neither"
        report.add_key((*path, "username"), message)
    if "servers" in written:
        with until_invalid():
            _check_bind(path, log, report)


def _check_bind(path: KeyPath, log: SharedLogConfig, report: Report) -> None:
    if len(log.servers) > 1:
        message = f"found {len(log.servers)} entries with embedded, allowed: one, where it listens"
        report.add((*path, "servers"), message)
        return
    for where, server in items((*path, "servers"), log.servers):
        remote = parse_server(server)
        try:
            address = parse_address(remote.host)
        except ValueError:
            address = None
        if remote.scheme != "nats" or address is None:
            report.add(where, f"found {show(str(remote))}, allowed: {_FORM}")
        elif not address.is_loopback and not report.raw(path).keys() & {"username", "token_file"}:
            message = "found with embedded, without username or token_file"
            report.add(where, f"{message}, allowed: a loopback address")


def check_embedded(scope: Scope) -> None:
    """Reports embedded servers that share a folder or a port."""
    folders, ports = Owners(scope.report, "folder"), Owners(scope.report, "address")
    for path, log in items(("logs",), scope.config.logs):
        with until_invalid():
            if log.embedded is None:
                continue
            written = scope.report.raw(path)
            shown = show(written["embedded"])
            folders.claim((*path, "embedded"), os.path.realpath(log.embedded), shown, path)
            for _, server in items(path, log.servers[:1] if len(log.servers) == 1 else ()):
                bind = parse_server(server)
                key = "servers" if "servers" in written else "embedded"
                ports.claim((*path, key), (bind.host, bind.port), str(bind), path)

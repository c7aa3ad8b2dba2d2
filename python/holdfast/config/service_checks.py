"""Checks rules between keys of the services: REST, MQTT, scanner, gateway, adapters, audit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holdfast import bounded_files
from holdfast.config.broker import parse_topic_filter
from holdfast.config.broker_checks import check_broker
from holdfast.config.connection_checks import doubt_source_limit
from holdfast.config.files import check_readable
from holdfast.config.ip_addresses import parse_bind, parse_source
from holdfast.config.lenient import entries, mapping, parsed
from holdfast.config.map_checks import check_map
from holdfast.config.nats_checks import check_nats
from holdfast.config.scalars import parse_sha256
from holdfast.config.services import HTTP_SERVICES, RestConfig
from holdfast.config.tls_checks import check_client_tls, check_https
from holdfast.config.unique import Owners
from holdfast.config.words import show
from holdfast.runtime.text import either

if TYPE_CHECKING:
    from holdfast.config.grant_checks import GrantChecks
    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath

_USERS_OF_MEMORIES = ("rest", "mqtt", "adapters")
_USERS_OF_NONE = {"nats", "gateway", "links", "devices"}
_INSTEAD_OF_LISTENERS = ("rest", "mqtt", "nats", "gateway", "devices")
_REST_CONNECTIONS = RestConfig.model_fields["max_connections"].default


@dataclass
class ServiceChecks:
    """Checks the services of one file; files are relative to `folder`."""

    folder: Path
    report: Report
    grants: GrantChecks

    def check(self, data: dict[Any, Any]) -> None:
        """Reports what is wrong."""
        self._served(data)
        self._rest(mapping(data.get("rest")))
        self._mqtt(data, mapping(data.get("mqtt")))
        self._nats(mapping(data.get("nats")))
        self._gateway(mapping(data.get("gateway")))
        for name, adapter in mapping(data.get("adapters")).items():
            self.grants.grant(("adapters", name), mapping(adapter))
        if isinstance(data.get("audit"), dict):
            self._audit(data["audit"])
        for name in HTTP_SERVICES:
            tls = mapping(mapping(data.get(name)).get("tls"))
            check_https((name, "tls"), tls, self.folder, self.report)

    def _served(self, data: dict[Any, Any]) -> None:
        """Reports a missing server, and missing memories if a section uses them."""
        used = any(data.get(key, {}) != {} for key in _USERS_OF_MEMORIES) or _uses_memories(data)
        if data.get("memories", {}) == {} and (used or not data.keys() & _USERS_OF_NONE):
            none = "nats, gateway, routes and devices that are forwarded or have tags"
            self._empty("memories", data, f"when only {none} are configured")
        if data.get("listeners", {}) == {} and not data.keys() & {*_INSTEAD_OF_LISTENERS}:
            self._empty("listeners", data, f"with {either(_INSTEAD_OF_LISTENERS)}")

    def _empty(self, key: str, data: dict[Any, Any], unless: str) -> None:
        found = "found an empty mapping" if key in data else "missing"
        message = f"{found}, allowed: a mapping with at least one entry (optional {unless})"
        self.report.add((key,), message, of_key=True)

    def _rest(self, rest: dict[Any, Any]) -> None:
        self._tokens("rest", rest)
        doubt_source_limit(("rest",), rest, _REST_CONNECTIONS, self.report)
        for index, token in enumerate(entries(rest.get("tokens"))):
            self.grants.grant(("rest", "tokens", index), mapping(token))

    def _gateway(self, gateway: dict[Any, Any]) -> None:
        self._tokens("gateway", gateway)
        self._tls(("gateway", "device_tls"), gateway.get("device_tls"))
        if gateway.get("tokens") != "none":
            return
        for index, source in enumerate(entries(gateway.get("sources"))):
            network = parsed(parse_source, source)
            if network is not None and not network.is_loopback:
                allowed = "allowed with tokens none: loopback addresses, as in 127.0.0.0/8"
                self.report.add(("gateway", "sources", index), f"found {show(source)}, {allowed}")

    def _tokens(self, section: str, settings: dict[Any, Any]) -> None:
        """Tokens have unique names and hashes; `none` requires a loopback address."""
        bind, tokens = parsed(parse_bind, settings.get("bind")), settings.get("tokens")
        if tokens != "none" and settings.get("hosts"):
            self.report.doubt((section, "hosts"), "has no effect with tokens")
        if tokens == "none" and bind is not None and not bind.address.is_loopback:
            message = f"found 'none' with bind {bind}, allowed: none only on a loopback address"
            self.report.add((section, "tokens"), message)
        names, hashes = Owners(self.report, "name"), Owners(self.report, "sha256")
        for index, token in enumerate(entries(tokens)):
            path: KeyPath = (section, "tokens", index)
            name = mapping(token).get("name")
            if isinstance(name, str):
                names.claim((*path, "name"), name, show(name), path)
            digest = parsed(parse_sha256, mapping(token).get("sha256"))
            if digest is not None:
                hashes.claim((*path, "sha256"), digest, "a hash", path)

    def _mqtt(self, data: dict[Any, Any], mqtt: dict[Any, Any]) -> None:
        check_broker(("mqtt",), mqtt, self.folder, self.report)
        topics = Owners(self.report, "topic")
        for index, subscription in enumerate(entries(mqtt.get("subscriptions"))):
            path: KeyPath = ("mqtt", "subscriptions", index)
            self.grants.grant(path, mapping(subscription))
            topic = parsed(parse_topic_filter, mapping(subscription).get("topic"))
            if topic is not None:
                topics.claim((*path, "topic"), topic, show(topic), path)
        check_map(data, self.report, self.grants)
        if mqtt and not mqtt.get("subscriptions", []) and not mqtt.get("map", []):
            found = "found an empty list" if mqtt.get("subscriptions") == [] else "missing"
            message = f"{found}, allowed: a list with at least one entry (optional with map)"
            self.report.add(("mqtt", "subscriptions"), message, of_key=True)

    def _nats(self, nats: dict[Any, Any]) -> None:
        check_nats(("nats",), nats, self.folder, self.report)
        self._tls(("nats", "device_tls"), nats.get("device_tls"))
        defaults = mapping(nats.get("defaults"))
        if defaults.get("deadband") and defaults.get("publish") != "change":
            message = "found without publish: change, allowed: only with it"
            self.report.add(("nats", "defaults", "deadband"), message, of_key=True)

    def _password(self, section: str, settings: dict[Any, Any]) -> None:
        if "password_file" in settings and "username" not in settings:
            message = "found without username, allowed: both or neither"
            self.report.add((section, "password_file"), message, of_key=True)
        self._readable((section, "password_file"), settings.get("password_file"))

    def _tls(self, path: KeyPath, tls: object) -> None:
        check_client_tls(path, mapping(tls), self.folder, self.report)

    def _readable(self, path: KeyPath, file: object) -> None:
        check_readable(path, file, self.folder, self.report)

    def _audit(self, audit: dict[Any, Any]) -> None:
        if "file" in audit:
            self._audit_file(audit["file"])
            return
        if "syslog" not in audit and audit.get("journald") is not True:
            message = "missing, allowed: text (optional with syslog or journald: true)"
            self.report.add(("audit", "file"), message)
        if audit.get("fail") == "closed":
            message = "found 'closed' without file, allowed: only with it"
            self.report.add(("audit", "fail"), message)
        for key in ("max_bytes", "keep"):
            if key in audit:
                message = "found without file, allowed: only with it"
                self.report.add(("audit", key), message, of_key=True)

    def _audit_file(self, file: object) -> None:
        if not isinstance(file, str) or not file or "\0" in file:
            return
        path = self.folder / file
        if bounded_files.call(path, path.is_dir):
            message = f"found {show(file)}, which is a folder, allowed: a file"
            self.report.add(("audit", "file"), message)
        elif not bounded_files.call(path, path.parent.is_dir):
            message = f"found {show(file)}, allowed: a file in an existing folder"
            self.report.add(("audit", "file"), message)


def _uses_memories(data: dict[Any, Any]) -> bool:
    """Whether a listener or a device needs a memory: all do that only route or forward."""
    devices, listeners = data.get("devices", {}), data.get("listeners", {})
    if devices != {} and not isinstance(devices, dict):
        return True
    if listeners != {} and not isinstance(listeners, dict):
        return True
    rules = [rule for each in listeners.values() for rule in entries(mapping(each).get("rules"))]
    only_routes = all(
        isinstance(target, dict)
        for rule in rules
        for target in mapping(mapping(rule).get("units")).values() or [None]
    )
    return (bool(listeners) and not (rules and only_routes)) or any(
        _is_stored(device) for device in devices.values() if isinstance(device, dict)
    )


def _is_stored(device: dict[Any, Any]) -> bool:
    """Whether a memory has values or the status of a device."""
    reads = [mapping(read) for read in entries(device.get("reads"))]
    stored = "status" in device or any("into" in read for read in reads)
    return stored or ("reads" in device and not device.get("forward"))

"""What the keys of REST, MQTT, adapters and the audit file must keep together."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holdfast.config.addresses import parse_bind
from holdfast.config.broker import parse_broker, parse_topic_filter
from holdfast.config.files import unreadable
from holdfast.config.tolerance import entries, mapping, parsed
from holdfast.config.unique import Owners
from holdfast.config.values import parse_sha256
from holdfast.config.words import show

if TYPE_CHECKING:
    from holdfast.config.grant_checks import GrantChecks
    from holdfast.config.problems import Report
    from holdfast.config.source import KeyPath


@dataclass
class ServiceChecks:
    """Checks the sections beside the listeners; files are relative to `folder`."""

    folder: Path
    report: Report
    grants: GrantChecks

    def check(self, data: dict[Any, Any]) -> None:
        """Reports what is wrong."""
        self._served(data)
        self._rest(mapping(data.get("rest")))
        self._mqtt(mapping(data.get("mqtt")))
        for name, adapter in mapping(data.get("adapters")).items():
            self.grants.grant(("adapters", name), mapping(adapter))
        self._audit(mapping(data.get("audit")).get("file"))

    def _served(self, data: dict[Any, Any]) -> None:
        if data.get("listeners", {}) != {} or data.keys() & {"rest", "mqtt", "devices"}:
            return
        found = "found an empty mapping" if "listeners" in data else "missing"
        message = (
            f"{found}, allowed: a mapping with at least one entry, or none beside rest, mqtt "
            "or devices"
        )
        self.report.add(("listeners",), message, of_key=True)

    def _rest(self, rest: dict[Any, Any]) -> None:
        bind = parsed(parse_bind, rest.get("bind"))
        if rest.get("tokens") == "none" and bind is not None and not bind.address.is_loopback:
            message = f"found 'none' beside bind {bind}, allowed: none on a loopback address only"
            self.report.add(("rest", "tokens"), message)
        names, hashes = Owners(self.report, "name"), Owners(self.report, "sha256")
        for index, token in enumerate(entries(rest.get("tokens"))):
            path: KeyPath = ("rest", "tokens", index)
            self.grants.grant(path, mapping(token))
            name = mapping(token).get("name")
            if isinstance(name, str):
                names.claim((*path, "name"), name, show(name), path)
            digest = parsed(parse_sha256, mapping(token).get("sha256"))
            if digest is not None:
                hashes.claim((*path, "sha256"), digest, "a hash", path)

    def _mqtt(self, mqtt: dict[Any, Any]) -> None:
        if "password_file" in mqtt and "username" not in mqtt:
            message = "found without username, allowed: both or none"
            self.report.add(("mqtt", "password_file"), message, of_key=True)
        self._readable(("mqtt", "password_file"), mqtt.get("password_file"))
        broker = parsed(parse_broker, mqtt.get("url"))
        if "tls" in mqtt and broker is not None and not broker.secure:
            message = "found beside a url that begins with mqtt://, allowed: beside mqtts:// only"
            self.report.add(("mqtt", "tls"), message, of_key=True)
        self._certificates(mapping(mqtt.get("tls")))
        topics = Owners(self.report, "topic")
        for index, subscription in enumerate(entries(mqtt.get("subscriptions"))):
            path: KeyPath = ("mqtt", "subscriptions", index)
            self.grants.grant(path, mapping(subscription))
            topic = parsed(parse_topic_filter, mapping(subscription).get("topic"))
            if topic is not None:
                topics.claim((*path, "topic"), topic, show(topic), path)

    def _certificates(self, tls: dict[Any, Any]) -> None:
        for key, other in (("cert_file", "key_file"), ("key_file", "cert_file")):
            if key in tls and other not in tls:
                message = f"found without {other}, allowed: both or none"
                self.report.add(("mqtt", "tls", key), message, of_key=True)
        for key in ("ca_file", "cert_file", "key_file"):
            self._readable(("mqtt", "tls", key), tls.get(key))

    def _readable(self, path: KeyPath, file: object) -> None:
        if isinstance(file, str) and file and "\0" not in file:
            reason = unreadable(self.folder / file)
            if reason:
                self.report.add(path, f"found {show(file)}, which can't be read: {reason}")

    def _audit(self, file: object) -> None:
        if not isinstance(file, str) or not file or "\0" in file:
            return
        path = self.folder / file
        if path.is_dir():
            message = f"found {show(file)}, which is a folder, allowed: a file"
            self.report.add(("audit", "file"), message)
        elif not path.parent.is_dir():
            message = f"found {show(file)}, allowed: a file in a folder that is there"
            self.report.add(("audit", "file"), message)

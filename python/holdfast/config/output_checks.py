"""Checks rules between keys of outputs."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from holdfast.config.broker_checks import check_broker
from holdfast.config.files import check_readable
from holdfast.config.http_url import parse_http
from holdfast.config.lenient import entries, mapping, parsed
from holdfast.config.nats_checks import check_nats
from holdfast.config.tls_checks import check_client_tls
from holdfast.config.topics import TAG, TopicNames, parse_topic_name, parse_topic_template
from holdfast.config.words import show
from holdfast.runtime.text import guess, listing

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath


@dataclass
class OutputChecks:
    """Checks the outputs of one file; files are relative to `folder`."""

    folder: Path
    report: Report

    def check(self, data: dict[Any, Any]) -> None:
        """Reports what is wrong."""
        devices = mapping(data.get("devices"))
        outputs = mapping(data.get("outputs"))
        if outputs and not any(
            mapping(device).get("tags") or "profile" in mapping(device)
            for device in devices.values()
        ):
            self.report.doubt(("outputs",), "has no effect: no device has tags")
        for name, output in outputs.items():
            path: KeyPath = ("outputs", name)
            for index, device in enumerate(entries(mapping(output).get("devices"))):
                if isinstance(device, str) and device not in devices:
                    words = f"allowed: {listing(devices) or 'none, there are no devices'}"
                    near = guess(device, [str(each) for each in devices])
                    message = f"found {show(device)}, {words}{near}"
                    self.report.add((*path, "devices", index), message)
            kind = mapping(output).get("type")
            if kind == "influx":
                self._influx(path, output)
            elif kind == "nats":
                check_nats(path, output, self.folder, self.report)
            elif kind == "mqtt":
                self._mqtt(path, output, devices)
            if mapping(output).get("type") == "sparkplug":
                self._sparkplug(path, output, outputs)

    def _influx(self, path: KeyPath, output: dict[Any, Any]) -> None:
        target = parsed(parse_http, output.get("url"))
        if target is None:
            return
        if target.path in ("", "/") and "bucket" not in output:
            message = "missing, allowed: a bucket, or a url with a path"
            self.report.add((*path, "bucket"), message, of_key=True)
        if "tls" in output and not target.secure:
            message = "found with http://, allowed: only with https://"
            self.report.add((*path, "tls"), message, of_key=True)
        if "username" in output and "token_file" in output:
            message = "found together with token_file, allowed: only one of them"
            self.report.add((*path, "username"), message, of_key=True)
        if ("username" in output) != ("password_file" in output):
            given, other = "username", "password_file"
            if given not in output:
                given, other = other, given
            self.report.add((*path, given), f"found without {other}", of_key=True)
        for key in ("token_file", "password_file"):
            check_readable((*path, key), output.get(key), self.folder, self.report)
        check_client_tls((*path, "tls"), mapping(output.get("tls")), self.folder, self.report)

    def _sparkplug(self, path: KeyPath, output: dict[Any, Any], outputs: dict[Any, Any]) -> None:
        check_broker(path, output, self.folder, self.report)
        if find_spec("google") is None or find_spec("google.protobuf") is None:
            message = (
                "found 'sparkplug', which requires the Python package protobuf, not installed here"
            )
            self.report.add((*path, "type"), message)
        for name, other in outputs.items():
            if other is output:
                break
            if all(mapping(other).get(key) == output.get(key) for key in ("group", "edge_node")):
                found = f"found {show(output.get('edge_node'))}"
                message = f"{found}, which outputs.{name} has in the same group"
                self.report.add((*path, "edge_node"), message)

    def _mqtt(self, path: KeyPath, output: dict[Any, Any], devices: dict[Any, Any]) -> None:
        check_broker(path, output, self.folder, self.report)
        template = parsed(parse_topic_template, output.get("topic"))
        whole = output.get("payload") == "device"
        if template is not None and whole and TAG in template:
            message = f"found {show(template)} with payload: device, allowed: without {TAG}"
            self.report.add((*path, "topic"), message)
        if template is not None and not whole and TAG not in template:
            message = f"found {show(template)}, allowed: with {TAG} (optional with payload: device)"
            self.report.add((*path, "topic"), message)
        status = parsed(parse_topic_name, output.get("status"))
        names = TopicNames(template, status, whole_device=whole)
        clash = next(
            (str(name) for name in devices if names.is_of_device(names.status, str(name))), ""
        )
        if clash:
            message = f"found {show(names.status)}, which is a topic of the device {clash}"
            self.report.add((*path, "status"), f"{message}, allowed: another topic", of_key=True)
        if "discovery_prefix" in output and "discovery" not in output:
            self.report.doubt((*path, "discovery_prefix"), "has no effect without discovery")
        if "discovery" in output and output.get("retain") is False:
            message = "with it, Home Assistant has no value after a start until one changes"
            self.report.doubt((*path, "retain"), message)

"""Checks rules between the keys of a connection to an MQTT broker."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.broker import parse_broker
from holdfast.config.files import check_readable
from holdfast.config.lenient import mapping, parsed
from holdfast.config.tls_checks import check_client_tls

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath


def check_broker(path: KeyPath, settings: dict[Any, Any], folder: Path, report: Report) -> None:
    """Reports what is wrong in user, password and TLS."""
    if "password_file" in settings and "username" not in settings:
        message = "found without username, allowed: both or neither"
        report.add((*path, "password_file"), message, of_key=True)
    check_readable((*path, "password_file"), settings.get("password_file"), folder, report)
    broker = parsed(parse_broker, settings.get("url"))
    if "tls" in settings and broker is not None and not broker.secure:
        message = "found with a url that begins with mqtt://, allowed: only with mqtts://"
        report.add((*path, "tls"), message, of_key=True)
    check_client_tls((*path, "tls"), mapping(settings.get("tls")), folder, report)

"""Loads a configuration for a command, including certificates and keys."""

from __future__ import annotations

import sys
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from holdfast.appliance.parts import certificate_expiry
from holdfast.appliance.parts.native_listeners import server_tls
from holdfast.appliance.services.services import https
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.terminal_text import show_problems
from holdfast.client.endpoint import check_files, endpoint, receiver_endpoint
from holdfast.config import ConfigError
from holdfast.config.loader import loaded
from holdfast.config.models.listeners import tls_of
from holdfast.config.models.services import HTTP_SERVICES
from holdfast.config.text.problems import ConfigNotAnswered
from holdfast.config.text.report import Report
from holdfast.runtime.bounded_files import NotAnswered, answered
from holdfast.runtime.text import file_error_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from holdfast.config import Config
    from holdfast.config.models.server_tls import HttpsConfig, ServerTlsConfig
    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.net.tls import Tls


def load_whole(path: Path | str) -> Config:
    """Loads a configuration and checks the contents of its certificates and keys.

    Doubtful certificates are among its warnings. Raises `ConfigError` with every problem.
    """
    try:
        return answered(lambda: _load_whole(path))
    except NotAnswered as error:
        raise ConfigNotAnswered.of(error) from None


def _load_whole(path: Path | str) -> Config:
    config, document = loaded(path)
    problems: dict[KeyPath, str] = {}
    warnings: list[tuple[KeyPath, str]] = []
    for place, check in _checks(config):
        try:
            warnings += [(place, warning) for warning in check()]
        except (OSError, ValueError) as error:
            problems[place] = str(error)
    if not problems:
        warnings += certificate_expiry.warnings(config)
    report = Report(document)
    for place, message in problems.items():
        report.add(place, message)
    if problems:
        raise ConfigError(str(path), report.problems)
    for place, message in warnings:
        report.warn(place, message)
    config.set_warnings([*config.warnings, *report.warnings])
    return config


def _checks(config: Config) -> Iterator[tuple[KeyPath, Callable[[], Iterable[str]]]]:
    """Checks of files: the place in the configuration, and what returns warnings or raises."""
    for name, listener in config.listeners.items():
        if (tls := tls_of(listener)) is not None:
            yield ("listeners", name, "tls"), partial(_server_warnings, tls)
    for name, device in config.devices.items():
        yield ("devices", name, "url"), partial(_usable, endpoint, device.target)
    for name, link in config.links.items():
        yield ("links", name, "url"), partial(_usable, endpoint, link.target)
    for name, device in config.devices.items():
        for index, forward in enumerate(device.forward):
            place = "devices", name, "forward", index, "url"
            yield place, partial(_usable, receiver_endpoint, forward.receiver)
    if config.nats is not None and config.nats.device_tls is not None:
        yield ("nats", "device_tls"), partial(_usable, _check_scanner, config.nats.device_tls.files)
    if config.gateway is not None and config.gateway.device_tls is not None:
        files = config.gateway.device_tls.files
        yield ("gateway", "device_tls"), partial(_usable, check_files, files)
    for service in HTTP_SERVICES:
        settings = getattr(config, service)
        if settings is not None and settings.tls is not None:
            yield (service, "tls"), partial(_https_warnings, settings.tls)


def _server_warnings(tls: ServerTlsConfig) -> Iterable[str]:
    return server_tls(tls).warnings


def _https_warnings(tls: HttpsConfig) -> Iterable[str]:
    return https(tls).core.warnings


def _usable(check: Callable[[Any], object], checked: object) -> Iterable[str]:
    """No warnings: the check raises or not."""
    check(checked)
    return ()


def _check_scanner(files: Tls) -> None:
    # The scanner takes long to import.
    from holdfast.scanner.polling import device_tls

    device_tls.check(files)


def load_or_exit(path: Path | str, *, shows_warnings: bool = True) -> Config:
    """Loads a configuration. If it is not valid, prints every problem and exits.

    Prints warnings on standard error, unless the caller logs them.
    """
    try:
        config = load_whole(path)
    except ConfigError as error:
        show_problems(error)
        # Service managers start nothing again after `WRONG`, but a mount may answer later.
        is_answered = not isinstance(error, ConfigNotAnswered)
        sys.exit(ExitCode.WRONG if is_answered else ExitCode.FAILED)
    except OSError as error:  # No thread can start.
        fail(file_error_text(error))
    for warning in config.warnings if shows_warnings else ():
        click.echo(f"warning: {warning}", err=True)
    return config

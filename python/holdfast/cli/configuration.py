"""Loads a configuration for a command, including certificates and keys."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import click

from holdfast.appliance import assembly, configured_certificates
from holdfast.bounded_files import NotAnswered, answered
from holdfast.client.endpoint import check_files, endpoint, receiver_endpoint
from holdfast.config import HTTP_SERVICES, ConfigError, tls_of
from holdfast.config.load import loaded, unanswered
from holdfast.config.report import Report

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.client.url import Target
    from holdfast.config import Config
    from holdfast.config.source import KeyPath

WRONG = 2
"""The exit code for wrong usage or an invalid configuration."""


def load_whole(path: Path | str) -> Config:
    """Loads a configuration and checks the contents of its certificates and keys.

    Doubtful certificates are among its warnings. Raises `ConfigError` with every problem.
    """
    try:
        return answered(lambda: _load_whole(path))
    except NotAnswered as error:
        raise ConfigError(str(path), [unanswered(error)]) from None


def _load_whole(path: Path | str) -> Config:
    config, document = loaded(path)
    file = str(path)
    problems: dict[KeyPath, str] = {}
    doubts: list[tuple[KeyPath, str]] = []
    for name, listener in config.listeners.items():
        tls = tls_of(listener)
        if tls is not None:
            place: KeyPath = ("listeners", name, "tls")
            try:
                checked = assembly.server_tls(tls)
            except ValueError as error:
                problems[place] = str(error)
            else:
                doubts += [(place, warning) for warning in checked.warnings]
    targets: list[tuple[KeyPath, Target]] = [
        (("devices", name), device.target) for name, device in config.devices.items()
    ]
    targets += [(("links", name), link.target) for name, link in config.links.items()]
    for where, target in targets:
        try:
            endpoint(target)
        except (OSError, ValueError) as error:
            problems[*where, "url"] = str(error)
    for name, device in config.devices.items():
        for index, forward in enumerate(device.forward):
            try:
                receiver_endpoint(forward.receiver)
            except (OSError, ValueError) as error:
                problems["devices", name, "forward", index, "url"] = str(error)
    if config.nats is not None and config.nats.device_tls is not None:
        from holdfast.scanner.polling import device_tls

        try:
            device_tls.check(assembly.scanner(config.nats).device_tls)
        except OSError as error:
            problems["nats", "device_tls"] = str(error)
    if config.gateway is not None and config.gateway.device_tls is not None:
        try:
            check_files(assembly.gateway_tls(config.gateway))
        except (OSError, ValueError) as error:
            problems["gateway", "device_tls"] = str(error)
    for service in HTTP_SERVICES:
        settings = getattr(config, service)
        if settings is not None and settings.tls is not None:
            place = (service, "tls")
            try:
                warnings = assembly.https(settings.tls).core.warnings
            except ValueError as error:
                problems[place] = str(error)
            else:
                doubts += [(place, warning) for warning in warnings]
    if not problems:
        doubts += configured_certificates.doubts(config)
    if not problems and not doubts:
        return config
    report = Report(document)
    for where, message in problems.items():
        report.add(where, message)
    if problems:
        raise ConfigError(file, report.problems)
    for where, message in doubts:
        report.doubt(where, message)
    return config.with_warnings([*config.warnings, *report.doubts])


def load_or_exit(path: Path | str) -> Config:
    """Loads a configuration. If it is not valid, prints every problem and exits with 2.

    Prints warnings on standard error.
    """
    try:
        config = load_whole(path)
    except ConfigError as error:
        show_problems(error)
        sys.exit(WRONG)
    for warning in config.warnings:
        click.echo(f"warning: {warning}", err=True)
    return config


def show_problems(error: ConfigError) -> None:
    """Prints each problem as a line on standard error, and their number."""
    for problem in error.problems:
        click.echo(str(problem), err=True)
    count = len(error.problems)
    click.echo("1 problem" if count == 1 else f"{count} problems", err=True)

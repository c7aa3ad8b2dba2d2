"""Checks what devices and links at one address share, which have one connection or line.

A serial line that is polled for NATS subscribers can't have another user.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from holdfast.client.tolerance import STRICT, Tolerance
from holdfast.client.url import SerialTarget, parse
from holdfast.config.devices import RetryConfig, ToleranceConfig
from holdfast.config.files import check_readable
from holdfast.config.lenient import entries, fitting, integer, mapping, parsed
from holdfast.config.listeners import SERIAL_TYPES
from holdfast.config.scalars import NOT_ON_A_LINE, parse_receiver_url, parse_url
from holdfast.config.scanning import parse_pollable
from holdfast.config.words import show
from holdfast.net.allow_list import AllowedDevice
from holdfast.protocol import MAX_SERIAL_UNIT, MAX_UNIT
from holdfast.types import SERIAL_FRAMES

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.client.url import NetworkTarget, Target
    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath
    from holdfast.net.tls import Tls


@dataclass(frozen=True)
class _Shared:
    """What the users of one address have in common."""

    tolerance: Tolerance
    in_flight: object
    retry: RetryConfig


@dataclass
class AddressChecks:
    """Checks the URLs of devices, links and receivers of one file; files are relative to `folder`.

    A link decides for the devices at its address, except for what they set differently.
    """

    folder: Path
    report: Report

    def __post_init__(self) -> None:
        self._lines: dict[str, tuple[KeyPath, SerialTarget, RetryConfig]] = {}
        self._addresses: dict[tuple[str, str, int], tuple[KeyPath, _Shared]] = {}

    def check(self, data: dict[Any, Any]) -> None:
        """Reports what is wrong."""
        taken = _serial_listeners(data)
        for section in ("links", "devices"):
            for name, user in mapping(data.get(section)).items():
                if isinstance(user, dict):
                    self._user((section, name), user, taken)
                    self._receivers((section, name, "forward"), user.get("forward"))
        self._subscribed(entries(mapping(data.get("nats")).get("devices")), taken)

    def _user(self, path: KeyPath, user: dict[Any, Any], taken: dict[str, KeyPath]) -> None:
        """Checks a device or a link."""
        target = parsed(target_of, user.get("url"))
        if target is None:
            return
        target = self._tolerance(path, target, user)
        retry = self._retry(path, user)
        if isinstance(target, SerialTarget):
            self._line(path, target, retry, user, taken)
            return
        self._shared(path, target, retry, user)
        self._files((*path, "url"), target.tls)

    def _receivers(self, path: KeyPath, forward: object) -> None:
        for index, each in enumerate(entries(forward)):
            receiver = parsed(parse_receiver_url, mapping(each).get("url"))
            if receiver is not None and receiver.tls is not None:
                self._files((*path, index, "url"), receiver.tls)

    def _files(self, path: KeyPath, tls: Tls) -> None:
        for key, file in tls.files():
            shown = f"{key}={show(file)}"
            check_readable(path, file, self.folder, self.report, shown=shown)

    def _tolerance(self, path: KeyPath, target: Target, user: dict[Any, Any]) -> Target:
        """The target with what its device needs tolerated."""
        block = user.get("tolerance")
        if block is None:
            return target
        where = (*path, "tolerance")
        if target.tolerance != STRICT:
            message = "found together with options of the URL, allowed: one of both"
            self.report.add(where, message, of_key=True)
        if mapping(block).get("echo") is True and not _has_echo(target):
            message = "found true, allowed with RTU and ASCII frames only"
            self.report.add((*where, "echo"), message)
        found = fitting(TypeAdapter(ToleranceConfig), block)
        tolerance = STRICT if found is None else Tolerance(**found.model_dump())
        return replace(target, tolerance=tolerance)

    def _retry(self, path: KeyPath, user: dict[Any, Any]) -> RetryConfig:
        """The pauses of a device or link; the default if they are invalid."""
        found = fitting(TypeAdapter(RetryConfig), user.get("retry", {})) or RetryConfig()
        if found.first > found.most:
            message = f"found {found.first:g}, allowed: up to most, which is {found.most:g}"
            self.report.add((*path, "retry", "first"), message)
        return found

    def _shared(
        self, path: KeyPath, target: NetworkTarget, retry: RetryConfig, user: dict[Any, Any]
    ) -> None:
        """What all at one network address share."""
        key = (target.transport, target.host, target.port)
        settings = _Shared(target.tolerance, user.get("in_flight", 1), retry)
        first, other = self._addresses.setdefault(key, (path, settings))
        if first == path:
            return
        if path[0] == "links":
            self._second_link(path, first)
            return
        if first[0] == "links":
            settings = _Shared(
                _tolerated(target, user, other.tolerance),
                user.get("in_flight", other.in_flight),
                retry if "retry" in user else other.retry,
            )
        for differs in ("in_flight", "tolerance", "retry"):
            if getattr(settings, differs) != getattr(other, differs):
                self._different(path, differs, user, first)
                return

    def _different(self, path: KeyPath, differs: str, user: dict[Any, Any], first: KeyPath) -> None:
        where = (*path, differs if differs in user else "url")
        message = f"found another {differs} than {self._named(first)} has at this address"
        self.report.add(where, f"{message}, allowed: the same")

    def _line(
        self,
        path: KeyPath,
        target: SerialTarget,
        retry: RetryConfig,
        user: dict[Any, Any],
        taken: dict[str, KeyPath],
    ) -> None:
        """A serial line is shared only with equal settings, and never with a listener."""
        number = integer(user.get("unit"), 0, MAX_UNIT)
        if number is not None and not 1 <= number <= MAX_SERIAL_UNIT:
            allowed = (
                f"allowed on a serial line: a unit id from 1 to {MAX_SERIAL_UNIT}{NOT_ON_A_LINE}"
            )
            self.report.add((*path, "unit"), f"found {number}, {allowed}")
        port = os.path.realpath(target.device)
        if port in taken:
            self._taken((*path, "url"), target.device, taken[port])
        first, other, pauses = self._lines.setdefault(port, (path, target, retry))
        if path[0] == "links" and first != path:
            self._second_link(path, first)
            return
        if first[0] == "links":
            target = replace(target, tolerance=_tolerated(target, user, other.tolerance))
        if replace(target, device=other.device) != other:
            message = f"found line settings that differ from those of {self._named(first)}"
            self.report.add((*path, "url"), f"{message}, allowed: the same settings")
        elif retry != pauses and not (first[0] == "links" and "retry" not in user):
            self._different(path, "retry", user, first)

    def _second_link(self, path: KeyPath, first: KeyPath) -> None:
        message = f"found the address of {self._named(first)}, allowed: one link for each address"
        self.report.add((*path, "url"), message)

    def _subscribed(self, devices: list[Any], taken: dict[str, KeyPath]) -> None:
        """Reports serial lines of the scanner that a device, a link or a listener uses."""
        lines = {port: path for port, (path, *_) in self._lines.items()} | taken
        for index, device in enumerate(devices):
            entry = parsed(parse_pollable, device)
            port = os.path.realpath(entry.path) if isinstance(entry, AllowedDevice) else None
            if port in lines:
                self._taken(("nats", "devices", index), str(entry), lines[port])

    def _taken(self, path: KeyPath, device: str, owner: KeyPath) -> None:
        of = self._named(owner)
        message = f"found {show(device)}, which is the device of {of}, allowed: a different one"
        self.report.add(path, message)

    def _named(self, path: KeyPath) -> str:
        return f"{self.report.document.spell(path)} in line {self.report.line(path)}"


def target_of(url: object) -> Target:
    """The target of a valid URL. Raises `ValueError` for anything else."""
    return parse(parse_url(url))


def _tolerated(target: Target, user: dict[Any, Any], otherwise: Tolerance) -> Tolerance:
    """The tolerance that a device sets, `otherwise` if it sets none."""
    sets = "tolerance" in user or target.tolerance != STRICT
    return target.tolerance if sets else otherwise


def _serial_listeners(data: dict[Any, Any]) -> dict[str, KeyPath]:
    """The serial ports of listeners, each with the path of its listener."""
    ports: dict[str, KeyPath] = {}
    for name, listener in mapping(data.get("listeners")).items():
        if mapping(listener).get("type") in SERIAL_TYPES:
            device = mapping(mapping(listener).get("serial")).get("device")
            if isinstance(device, str) and device and "\0" not in device:
                ports.setdefault(os.path.realpath(device), ("listeners", name))
    return ports


def _has_echo(target: Target) -> bool:
    return isinstance(target, SerialTarget) or target.transport in SERIAL_FRAMES

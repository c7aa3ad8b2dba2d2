"""Checks what can't be used twice: serial lines, addresses of devices and links.

Devices and links at one address share a connection or line. A serial line that is polled for NATS
subscribers can't have another user.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.client.base import is_broadcast
from holdfast.client.serial_settings import SerialTarget
from holdfast.client.tolerance import STRICT, Tolerance
from holdfast.client.url import IN_FLIGHT, parse, parse_receiver
from holdfast.config.checks.common import check_readable, given, items, until_invalid
from holdfast.config.models.devices import DeviceConfig, RetryConfig, tolerating
from holdfast.config.models.listeners import SerialListener
from holdfast.config.text.messages import show
from holdfast.net.allow_list import AllowedDevice
from holdfast.protocol import MAX_UNIT
from holdfast.types import SERIAL_FRAMES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from holdfast.client.url import NetworkTarget, Target
    from holdfast.config.checks.common import Scope
    from holdfast.config.models.links import LinkConfig
    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.net.allow_list import AllowEntry
    from holdfast.net.tls import Tls

    User: TypeAlias = DeviceConfig | LinkConfig


@dataclass(frozen=True)
class _Shared:
    """What the users of one address have in common."""

    tolerance: Tolerance
    in_flight: object
    retry: RetryConfig


@dataclass
class AddressChecks:
    """Checks the URLs of devices, links and receivers of one file; files are relative to `folder`.

    Devices at the address of a link use its settings, and may not set different ones.
    """

    scope: Scope

    def __post_init__(self) -> None:
        self.report = self.scope.report
        self._lines: dict[str, tuple[KeyPath, SerialTarget, RetryConfig]] = {}
        self._addresses: dict[tuple[str, str, int], tuple[KeyPath, _Shared]] = {}
        self._listener_ports: dict[str, KeyPath] = {}
        for port, path in _serial_listeners(self.scope):
            self._listener_ports.setdefault(port, path)

    def check(self) -> None:
        """Reports what is wrong."""
        config = self.scope.config
        for section in ("links", "devices"):
            with until_invalid():
                for path, user in items((section,), getattr(config, section)):
                    with until_invalid():
                        self._user(path, user)
                    with until_invalid():
                        self._receivers((*path, "forward"), user)
        with until_invalid():
            if config.nats is not None:
                self._subscribed(config.nats.devices)

    def _user(self, path: KeyPath, user: User) -> None:
        """Checks a device or a link."""
        target = self._tolerance(path, parse(user.url), user)
        retry = _whole_retry(user)
        one = isinstance(target, SerialTarget) or target.transport not in IN_FLIGHT
        if one and user.in_flight not in (1, "auto"):
            message = f"has no effect: only {' and '.join(IN_FLIGHT)} carry more than one request"
            self.report.warn((*path, "in_flight"), f"{message} at a time")
        if isinstance(target, SerialTarget):
            self._line(path, target, retry, user)
            return
        self._shared(path, target, retry, user)
        if target.tls.files():
            self._files((*path, "url"), target.tls, parse)

    def _receivers(self, path: KeyPath, user: User) -> None:
        for where, forward in items(path, user.forward if isinstance(user, DeviceConfig) else ()):
            with until_invalid():
                tls = forward.receiver.tls
                if tls is not None:
                    self._files((*where, "url"), tls, parse_receiver)

    def _files(self, path: KeyPath, tls: Tls, parsed: Callable[[str], Any]) -> None:
        """Reports files of a URL that can't be read; messages name them as the URL does."""
        written: Tls = parsed(self.report.raw(path)).tls
        for (key, file), (_, name) in zip(tls.files(), written.files(), strict=True):
            check_readable(path, Path(file), self.report, shown=f"{key}={show(name)}")

    def _tolerance(self, path: KeyPath, target: Target, user: User) -> Target:
        """The target with the tolerance of its user, checked."""
        if not given(user, "tolerance"):
            return target
        where = (*path, "tolerance")
        if target.tolerance != STRICT:
            message = "found together with options of the URL, allowed: only one of them"
            self.report.add_key(where, message)
        with until_invalid():
            block = user.tolerance
            if block is not None and block.echo is True and not _has_echo(target):
                message = "found true, allowed with RTU and ASCII frames only"
                self.report.add((*where, "echo"), message)
        with until_invalid():
            block = user.tolerance
            return tolerating(target, None if block is None else block.whole())
        return replace(target, tolerance=STRICT)

    def _shared(self, path: KeyPath, target: NetworkTarget, retry: RetryConfig, user: User) -> None:
        """Checks that all users of an address have equal settings."""
        key = (target.transport, target.host, target.port)
        settings = _Shared(target.tolerance, user.in_flight, retry)
        first, other = self._addresses.setdefault(key, (path, settings))
        if first == path:
            return
        if path[0] == "links":
            self._second_link(path, first)
            return
        if first[0] == "links":
            settings = _Shared(
                _tolerated(target, user, other.tolerance),
                user.in_flight if given(user, "in_flight") else other.in_flight,
                retry if given(user, "retry") else other.retry,
            )
        for differs in ("in_flight", "tolerance", "retry"):
            if getattr(settings, differs) != getattr(other, differs):
                self._different(path, differs, user, first)
                return

    def _different(self, path: KeyPath, differs: str, user: User, first: KeyPath) -> None:
        where = (*path, differs if given(user, differs) else "url")
        message = f"found another {differs} than {self.report.named(first)} has at this address"
        self.report.add(where, f"{message}, allowed: the same")

    def _line(self, path: KeyPath, target: SerialTarget, retry: RetryConfig, user: User) -> None:
        """A serial line is shared only with equal settings, and never with a listener.

        All its users give it the same name: the names may be of different lines after adapters were
        plugged in again, and each user must have the line that its URL names.
        """
        with until_invalid():
            if isinstance(user, DeviceConfig) and is_broadcast(target, user.unit):
                allowed = f"allowed on a serial line: a unit id from 1 to {MAX_UNIT}"
                message = f"found {user.unit}, {allowed}; 0 is the broadcast"
                self.report.add((*path, "unit"), message)
        port = os.path.realpath(target.device)
        if port in self._listener_ports:
            self._refuse_used((*path, "url"), target.device, self._listener_ports[port])
        first, other, other_retry = self._lines.setdefault(port, (path, target, retry))
        if path[0] == "links" and first != path:
            self._second_link(path, first)
            return
        if first[0] == "links":
            target = replace(target, tolerance=_tolerated(target, user, other.tolerance))
        if target.device != other.device:
            message = f"found another name of the serial line of {self.report.named(first)}"
            self.report.add((*path, "url"), f"{message}, allowed: {show(other.device)}")
        elif target != other:
            message = f"found line settings that differ from those of {self.report.named(first)}"
            self.report.add((*path, "url"), f"{message}, allowed: the same settings")
        elif retry != other_retry and not (first[0] == "links" and not given(user, "retry")):
            self._different(path, "retry", user, first)

    def _second_link(self, path: KeyPath, first: KeyPath) -> None:
        message = (
            f"found the address of {self.report.named(first)}, allowed: one link for each address"
        )
        self.report.add((*path, "url"), message)

    def _subscribed(self, devices: Sequence[AllowEntry]) -> None:
        """Reports serial lines of the scanner that a device, a link or a listener uses."""
        lines = {port: path for port, (path, *_) in self._lines.items()} | self._listener_ports
        for path, entry in items(("nats", "devices"), devices):
            if isinstance(entry, AllowedDevice):
                port = os.path.realpath(entry.path)
                if port in lines:
                    self._refuse_used(path, str(entry), lines[port])

    def _refuse_used(self, path: KeyPath, device: str, owner: KeyPath) -> None:
        of = self.report.named(owner)
        message = f"found {show(device)}, which is the device of {of}, allowed: a different one"
        self.report.add(path, message)


def _whole_retry(user: User) -> RetryConfig:
    """The pauses of a device or link; the default if they are invalid."""
    with until_invalid():
        return user.retry.whole()
    return RetryConfig()


def _tolerated(target: Target, user: User, otherwise: Tolerance) -> Tolerance:
    """The tolerance that a device sets, `otherwise` if it sets none."""
    sets = given(user, "tolerance") or target.tolerance != STRICT
    return target.tolerance if sets else otherwise


def _serial_listeners(scope: Scope) -> Iterator[tuple[str, KeyPath]]:
    """The serial ports of listeners, each with the path of its listener."""
    with until_invalid():
        for path, listener in items(("listeners",), scope.config.listeners):
            with until_invalid():
                if isinstance(listener, SerialListener):
                    yield os.path.realpath(listener.serial.device), path


def _has_echo(target: Target) -> bool:
    return isinstance(target, SerialTarget) or target.transport in SERIAL_FRAMES

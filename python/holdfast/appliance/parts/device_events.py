"""Logs what happens to devices and links: their health, their receivers, unrequested data."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Any

from holdfast.events import log_lines
from holdfast.polling.faults import fault_word

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from holdfast.config.models.devices import ForwardConfig

_QUIET_S = 600.0
"""The time without unrequested data after which more of it is logged again."""


class DeviceEvents:
    """Compares counters with those of the last call. For one thread, except for `health`."""

    def __init__(self) -> None:
        self.health: dict[str, str] = {}
        """The health of each polled device at the last call."""
        self._plan_errors: dict[str, str | None] = {}
        self._unstored: dict[str, int] = {}
        self._strays: dict[tuple[str, str, str], tuple[int, float]] = {}
        self._forwarded: dict[tuple[str, int], Mapping[str, Any]] = {}
        self._unreachable: set[tuple[str, int]] = set()
        self._down: set[str] = set()
        self._full: dict[str, int] = {}

    def replace(
        self,
        gone: Collection[str],
        polled: Collection[str],
        links: Collection[str],
        refused: Mapping[str, int],
    ) -> None:
        """Forgets devices that are gone or polled with other settings, and all but these links.

        `refused` is how often the queue of each link was full until now: links may have exchanged
        their names.
        """
        self._down &= set(links)
        self._full = dict(refused)
        names = {*gone, *polled}
        for known in (self.health, self._plan_errors):
            for name in names & known.keys():
                del known[name]
        # The poller keeps the counters of a replaced device, except those of its receivers.
        for name in gone:
            self._unstored.pop(name, None)
        self._strays = {key: at for key, at in self._strays.items() if key[1] not in gone}
        self._forwarded = {key: at for key, at in self._forwarded.items() if key[0] not in names}
        self._unreachable = {key for key in self._unreachable if key[0] not in names}
        self.health |= dict.fromkeys(polled, "unknown")

    def log_device(
        self, name: str, counted: Mapping[str, Any], forwards: Sequence[ForwardConfig]
    ) -> None:
        """Logs changes of a polled device."""
        health, plan_error, unstored = counted["health"], counted["plan_error"], counted["unstored"]
        if plan_error is not None and plan_error != self._plan_errors.get(name):
            log_lines.write(logging.ERROR, "device_unplanned", device=name, error=plan_error)
        self._plan_errors[name] = plan_error
        refused = unstored - self._unstored.get(name, 0)
        if refused:
            log_lines.write(logging.ERROR, "device_unstored", device=name, count=refused)
        self._unstored[name] = unstored
        of_receivers = zip(forwards, counted.get("forward", ()), strict=True)
        for index, (forward, now) in enumerate(of_receivers):
            self._log_forward((name, index), str(forward.receiver), now)
        if health != self.health[name]:
            self.health[name] = health
            fields: dict[str, object] = {"device": name, "health": health}
            if health == "error":
                error = fault_word(counted["last_error"])
                fields |= {"error": error, "failures": counted["failures"]}
                if counted["error"] is not None:
                    fields["reason"] = counted["error"]
            usual = health in ("ok", "standby")
            log_lines.write(logging.INFO if usual else logging.WARNING, "device_health", **fields)
        self.log_strays("device", name, counted)

    def log_link(self, name: str, counted: Mapping[str, int], error: str | None) -> None:
        """Logs that requests of a link begin to fail, that they no longer do, and a full queue."""
        if error is not None and name not in self._down:
            self._down.add(name)
            log_lines.write(logging.WARNING, "link_down", link=name, error=error)
        elif error is None and name in self._down:
            self._down.discard(name)
            log_lines.write(logging.INFO, "link_back", link=name)
        refused = counted["refused_full"] - self._full.get(name, 0)
        if refused > 0:
            log_lines.refused("link_full", kind=name, link=name, count=refused)
        self._full[name] = counted["refused_full"]

    def log_strays(self, kind: str, name: str, counted: Mapping[str, int]) -> None:
        """Logs that a device or link has begun to send unrequested data, or late replies only."""
        if self._has_begun((kind, name, "stray_bytes"), counted):
            strays = {"replies": counted["unexpected_replies"], "bytes": counted["stray_bytes"]}
            log_lines.write(logging.WARNING, "unrequested_data", **{kind: name}, **strays)
        if self._has_begun((kind, name, "raised_timeouts"), counted):
            late = counted["late_replies"]
            log_lines.write(logging.WARNING, "timeout_raised", **{kind: name}, late_replies=late)

    def _has_begun(self, key: tuple[str, str, str], counted: Mapping[str, int]) -> bool:
        """Whether a counter has begun to count, or goes on after a while."""
        now, count = time.monotonic(), counted[key[-1]]
        before, since = self._strays.get(key, (0, -_QUIET_S))
        if count < before:
            # That of another connection: a reload has changed the address.
            before, since = self._strays[key] = 0, -_QUIET_S
        if count != before:
            self._strays[key] = (count, now)
        return count > before and now - since >= _QUIET_S

    def _log_forward(self, key: tuple[str, int], receiver: str, now: Mapping[str, Any]) -> None:
        """Logs what happened at one receiver of a device."""
        before = self._forwarded.get(key, {})
        self._forwarded[key] = now
        refused = now["refused"] - before.get("refused", 0)
        replied = refused + now["sent"] - before.get("sent", 0)
        failed = now["failed"] - before.get("failed", 0)
        fields: dict[str, object] = {"device": key[0], "receiver": receiver}
        if refused:
            log_lines.refused("forward_refused", kind=key, **fields, count=refused)
        if replied and key in self._unreachable:
            self._unreachable.discard(key)
            log_lines.write(logging.INFO, "forward_back", **fields)
        elif failed and not replied and key not in self._unreachable:
            self._unreachable.add(key)
            fields |= {key: now[key] for key in ("reason", "error") if now[key] is not None}
            log_lines.write(logging.WARNING, "forward_failed", **fields)

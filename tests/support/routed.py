"""Appliances that pass requests on to devices."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

from support import wire
from support.config_folder import written
from support.transports import TYPES

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.fake_device import Asked

LOOPBACK = ["127.0.0.0/8"]


def configuration(
    url: str,
    *,
    kind: str = "tcp",
    link: dict[str, Any] | None = None,
    units: dict[int | str, Any] | None = None,
    rule: dict[str, Any] | None = None,
    **more: Any,
) -> str:
    """One listener, `scada`. By default all its unit ids, 0 to 247, are behind the link `bus`."""
    units = units or {"0-247": {"route": "bus"}}
    rules = [{"sources": LOOPBACK, "access": "read-write", "units": units, **(rule or {})}]
    return written(
        {
            "listeners": {"scada": {"type": TYPES[kind], "bind": "127.0.0.1:0", "rules": rules}},
            "links": {"bus": {"url": url, "timeout": wire.DEADLINE, **(link or {})}},
            **more,
        }
    )


def serial_configuration(url: str, kind: str, device: Path) -> str:
    """One listener, `line`, on a serial line; all its unit ids are behind the link `bus`."""
    rules = [{"access": "read-write", "units": {"1-247": {"route": "bus"}}}]
    serial = {"device": str(device), "parity": "none"}
    return written(
        {
            "listeners": {"line": {"type": kind, "serial": serial, "rules": rules}},
            "links": {"bus": {"url": url, "timeout": wire.DEADLINE}},
        }
    )


def counters(appliance: Appliance, link: str = "bus") -> dict[str, int]:
    """Returns the counters of a link."""
    counted: dict[str, int] = appliance.diagnostics.stats()["links"][link]
    return counted


def await_count(appliance: Appliance, counter: str, number: int, link: str = "bus") -> None:
    """Waits until a counter of a link has this number."""
    wire.until(lambda: counters(appliance, link)[counter] == number, f"{counter} is {number}")


class Held:
    """Behaves as a correct device that answers only after `release`."""

    def __init__(self) -> None:
        self._released = threading.Event()

    def __call__(self, asked: Asked) -> None:
        self._released.wait(wire.DEADLINE)
        asked.answer()

    def release(self) -> None:
        self._released.set()

"""What a reload changes: settings with the contents of their files, and what requires a restart."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.fingerprint import fingerprint

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.config import Config, MemoryConfig
    from holdfast.config.links import LinkConfig


class ReloadRefused(Exception):
    """A reload would need a restart. `reasons` has one line for each setting."""

    def __init__(self, reasons: list[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = reasons


SINGLE = ("identity", "rest", "mqtt", "nats", "gateway", "metrics", "log")
SEVERAL = ("memories", "listeners", "devices", "links", "adapters")


def fingerprints(config: Config) -> dict[str, str]:
    """The fingerprint of each part of a configuration, by its key: `rest`, `devices.pump`."""
    found = {key: fingerprint(getattr(config, key)) for key in SINGLE}
    for key in SEVERAL:
        for name, settings in getattr(config, key).items():
            found[f"{key}.{name}"] = fingerprint(settings)
    return found


def differences(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """The keys whose fingerprints differ, in order."""
    return [key for key in sorted({*before, *now}) if before.get(key) != now.get(key)]


def restarts(before: Config, now: Config) -> list[str]:
    """What differs between two configurations and takes effect only after a restart."""
    reasons = []
    for name, memory in before.memories.items():
        if name not in now.memories:
            reasons.append(f"memories.{name}: removed; its values would be lost")
        elif _layout(memory) != _layout(now.memories[name]):
            reasons.append(f"memories.{name}: areas or seal changed")
    known = {_connection(link): link for link in before.links.values()}
    for name, link in now.links.items():
        running = known.get(_connection(link))
        if running is not None and _waiting(running) != _waiting(link):
            reasons.append(f"links.{name}: settings of a connection in use changed")
    if before.workers != now.workers:
        reasons.append("workers: changed")
    if fingerprint(before.audit) != fingerprint(now.audit):
        reasons.append("audit: changed")
    return [f"{reason}; requires a restart" for reason in reasons]


def _layout(memory: MemoryConfig) -> object:
    return {area: (span.start, span.size) for area, span in memory.areas().items()}, memory.seal


def _connection(link: LinkConfig) -> str:
    return link.url


def _waiting(link: LinkConfig) -> dict[str, Any]:
    """The settings that a connection keeps as long as it is in use."""
    return link.model_dump(exclude={"url", "timeout"})

"""What a reload changes: settings with the contents of their files, and what requires a restart."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.bounded_files import answered
from holdfast.config.fingerprint import fingerprint

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.config import Config, DeviceConfig, MemoryConfig
    from holdfast.config.links import LinkConfig


class ReloadRefused(Exception):
    """A reload would need a restart. `reasons` has one line for each setting."""

    def __init__(self, reasons: list[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = reasons


class ReloadIncomplete(Exception):
    """An internal error after a part of the configuration has changed. Requires a restart."""


SINGLE = ("identity", "rest", "mqtt", "nats", "gateway", "metrics", "log")
SEVERAL = ("memories", "listeners", "devices", "links", "outputs", "adapters")


def fingerprints(config: Config) -> dict[str, str]:
    """The fingerprint of each part of a configuration, by its key: `rest`, `devices.pump`.

    Raises `NotAnswered`: the first file that does not answer ends it.
    """
    return answered(lambda: _fingerprints(config))


def _fingerprints(config: Config) -> dict[str, str]:
    found = {key: fingerprint(getattr(config, key)) for key in SINGLE}
    for key in SEVERAL:
        for name, settings in getattr(config, key).items():
            found[f"{key}.{name}"] = fingerprint(settings)
    # The tags of a device are a part of it, but one profile is that of many devices.
    profiles = {name: fingerprint(profile) for name, profile in config.profiles.items()}
    for name, device in config.devices.items():
        if device.profile is not None:
            found[f"devices.{name}"] += profiles[device.profile]
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
        else:
            reasons += (
                f"memories.{name}: {key} changed"
                for key in ("keep", "replicate")
                if getattr(memory, key) != getattr(now.memories[name], key)
            )
    for name, memory in now.memories.items():
        if name not in before.memories and (memory.keep or memory.replicate):
            reasons.append(f"memories.{name}: added with keep or replicate")
    if before.logs != now.logs:
        reasons.append("logs: changed")
    known = {link.url: link for link in before.links.values()}
    for name, link in now.links.items():
        if link.url in known and _waiting(known[link.url]) != _waiting(link):
            reasons.append(f"links.{name}: settings of a connection in use changed")
    used = {device.url: device for device in before.devices.values()}
    for name, device in now.devices.items():
        if device.url in used and _pace(used[device.url]) != _pace(device):
            message = "in_flight, retry or tolerance of a connection in use changed"
            reasons.append(f"devices.{name}: {message}")
    if before.workers != now.workers:
        reasons.append("workers: changed")
    if fingerprint(before.audit) != fingerprint(now.audit):
        reasons.append("audit: changed")
    return [f"{reason}; requires a restart" for reason in reasons]


def _layout(memory: MemoryConfig) -> object:
    return {area: (span.start, span.size) for area, span in memory.areas().items()}, memory.seal


def _waiting(link: LinkConfig) -> dict[str, Any]:
    """The settings that a connection keeps as long as it is in use."""
    return link.model_dump(exclude={"url", "timeout"})


def _pace(device: DeviceConfig) -> dict[str, Any]:
    """The settings that a connection of devices keeps as long as it is in use."""
    return device.model_dump(include={"in_flight", "retry", "tolerance"})

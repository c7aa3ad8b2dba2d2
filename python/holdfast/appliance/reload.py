"""What a reload changes, with the contents of files, and what it refuses."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.config.fingerprint import fingerprint
from holdfast.runtime.bounded_files import answered

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from holdfast.config import Config
    from holdfast.config.models.devices import DeviceConfig
    from holdfast.config.models.links import LinkConfig
    from holdfast.config.models.memories import MemoryConfig


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


def restart_reasons(before: Config, now: Config) -> Iterator[str]:
    """Yields what differs and takes effect only after a restart, so that a reload is refused.

    In the order of the table in docs/operations.md.
    """
    for name, memory in before.memories.items():
        if name not in now.memories:
            yield f"memories.{name}: removed; its values would be lost"
        elif _layout(memory) != _layout(now.memories[name]):
            yield f"memories.{name}: areas or seal changed"
        else:
            for key in ("keep", "replicate"):
                if getattr(memory, key) != getattr(now.memories[name], key):
                    yield f"memories.{name}: {key} changed"
    for name, memory in now.memories.items():
        if name not in before.memories and (memory.keep or memory.replicate):
            yield f"memories.{name}: added with keep or replicate"
    if before.logs != now.logs:
        yield "logs: changed"
    if before.workers != now.workers:
        yield "workers: changed"
    # Threads and services use the audit log as it is.
    if fingerprint(before.audit) != fingerprint(now.audit):
        yield "audit: changed"
    links = {link.url: link for link in before.links.values()}
    for name, link in now.links.items():
        own = set(type(link).model_fields) - {"url", "timeout"}
        if _differs(links.get(link.url), link, own):
            yield f"links.{name}: settings of a connection in use changed"
    devices = {device.url: device for device in before.devices.values()}
    for name, device in now.devices.items():
        if _differs(devices.get(device.url), device, {"in_flight", "retry", "tolerance"}):
            message = "in_flight, retry or tolerance of a connection in use changed"
            yield f"devices.{name}: {message}"


def _layout(settings: MemoryConfig) -> object:
    areas = {area: (span.start, span.size) for area, span in settings.areas().items()}
    return areas, settings.files, settings.seal


def _differs(before: DeviceConfig | LinkConfig | None, now: object, keys: set[str]) -> bool:
    """Whether a connection that is in use has other settings."""
    return before is not None and any(getattr(before, key) != getattr(now, key) for key in keys)

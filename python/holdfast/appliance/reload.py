"""What a reload changes, with the contents of files, and what it refuses."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.client.url import other_name, shared_connection, shared_options
from holdfast.config.checks.units import routed
from holdfast.config.fingerprint import fingerprint
from holdfast.config.models.links import LinkConfig
from holdfast.runtime.bounded_files import answered

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from holdfast.config import Config
    from holdfast.config.models.devices import DeviceConfig
    from holdfast.config.models.memories import MemoryConfig


class ReloadRefused(Exception):
    """A reload would need a restart. `reasons` has one line for each setting."""

    def __init__(self, reasons: list[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = reasons


class ReloadIncomplete(Exception):
    """An internal error after a part of the configuration has changed. Requires a restart."""


SECTIONS = ("identity", "rest", "mqtt", "nats", "gateway", "metrics", "log", "reload")
NAMED_SECTIONS = ("memories", "listeners", "devices", "links", "outputs", "adapters")
OF_ALL_PROFILES = ("nats", "gateway")
"""Services that know the tags of every profile."""
OF_ROUTES = ("queue", "priority", "coalesce", "cache")
"""Settings of a link that matter only for routes."""


def fingerprints(config: Config) -> dict[str, str]:
    """The fingerprint of each part that a reload can replace, by its key: `rest`, `devices.pump`.

    `restart_reasons` compares the others. Raises `NotAnswered` for a file that can't be read in
    time.
    """
    return answered(lambda: _fingerprints(config))


def _fingerprints(config: Config) -> dict[str, str]:
    found = {key: fingerprint(getattr(config, key)) for key in SECTIONS}
    for key in NAMED_SECTIONS:
        for name, settings in getattr(config, key).items():
            found[f"{key}.{name}"] = fingerprint(settings)
    # The tags of a device are a part of it, but one profile is that of many devices.
    profiles = {name: fingerprint(profile) for name, profile in config.profiles.items()}
    for name, device in config.devices.items():
        if device.profile is not None:
            found[f"devices.{name}"] += profiles[device.profile]
    for key in OF_ALL_PROFILES:
        if getattr(config, key) is not None:
            found[key] += fingerprint(config.profiles)
    if config.mqtt is not None:
        found["mqtt"] += fingerprint(list(config.mqtt_tags().items()))
    return found


def differences(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """The keys whose fingerprints differ, in order."""
    return [key for key in sorted({*before, *now}) if before.get(key) != now.get(key)]


def described(changed: list[str], before: Config, now: Config) -> list[str]:
    """The keys that have changed, with what takes effect later."""
    later = {
        f"memories.{name}"
        for name, memory in now.memories.items()
        if name in before.memories and memory.initial_values != before.memories[name].initial_values
    }
    return [f"{key} (initial values at the next start)" if key in later else key for key in changed]


def restart_reasons(before: Config, now: Config) -> Iterator[str]:
    """Yields what differs and takes effect only after a restart, so that a reload is refused.

    In the order of the last row of the table in docs/operations.md.
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
    in_use, routes = _connections_in_use(before), _settings_of_routes(before)
    changed = {
        connection
        for connection, settings in _settings_of_routes(now).items()
        if routes.get(connection, settings) != settings
    }
    changed |= {
        shared_connection(link.target) for link in now.links.values() if _is_changed(in_use, link)
    }
    links = {
        shared_connection(link.target): name
        for config in (before, now)
        for name, link in config.links.items()
    }
    for connection, name in links.items():
        if connection in changed:
            yield f"links.{name}: settings of a connection in use changed"
    for name, device in _deciding_devices(now):
        if _is_changed(in_use, device):
            keys = "in_flight, retry, tolerance or serial settings"
            yield f"devices.{name}: {keys} of a connection in use changed"
    # The connection with the former name still has the line, which nobody else can open then.
    users = [(f"links.{name}", link.target) for name, link in now.links.items()]
    users += [(f"devices.{name}", device.target) for name, device in _deciding_devices(now)]
    for key, target in users:
        if other_name(target, in_use) is not None:
            yield f"{key}: another name of a serial line in use"


def _settings_of_routes(config: Config) -> dict[tuple[str, str], list[object]]:
    """The settings that all routes to an address share: those of its link, or the defaults."""
    found = {
        shared_connection(link.target): [getattr(link, key) for key in OF_ROUTES]
        for link in config.links.values()
    }
    defaults = [LinkConfig.model_fields[key].default for key in OF_ROUTES]
    for name in routed(config):
        if name in config.devices:
            found.setdefault(shared_connection(config.devices[name].target), defaults)
    return found


def _connections_in_use(config: Config) -> dict[tuple[str, str], list[object]]:
    """The settings of each connection, by its address."""
    found: dict[tuple[str, str], list[object]] = {}
    users: list[DeviceConfig | LinkConfig] = list(config.links.values())
    users += [device for _, device in _deciding_devices(config)]
    for user in users:
        found.setdefault(shared_connection(user.target), []).append(_connection_settings(user))
    return found


def _deciding_devices(config: Config) -> Iterator[tuple[str, DeviceConfig]]:
    """The devices that are used, and whose connection does not have the settings of a link."""
    linked = {shared_connection(link.target) for link in config.links.values()}
    named = routed(config)
    for name, device in config.devices.items():
        if (device.enabled or name in named) and shared_connection(device.target) not in linked:
            yield name, device


def _connection_settings(user: DeviceConfig | LinkConfig) -> object:
    """What a connection or line has from its first user."""
    return shared_options(user.target), user.in_flight, user.retry


def _is_changed(
    in_use: Mapping[tuple[str, str], list[object]], user: DeviceConfig | LinkConfig
) -> bool:
    """Whether the connection of a device or link is in use with other settings."""
    known = in_use.get(shared_connection(user.target))
    return known is not None and _connection_settings(user) not in known


def _layout(settings: MemoryConfig) -> object:
    areas = {area: (span.start, span.size) for area, span in settings.areas().items()}
    return areas, settings.files, settings.seal

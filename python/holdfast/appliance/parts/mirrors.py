"""The ranges that devices are read into: who may write them, and how old their values are."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, NamedTuple

from holdfast import _core
from holdfast.appliance.parts.device_leases import key_of
from holdfast.appliance.parts.mirror_place import place_of
from holdfast.appliance.parts.part import Part
from holdfast.events import log_lines

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.appliance.parts.mirror_place import Place
    from holdfast.appliance.parts.part import Plan
    from holdfast.config import Config
    from holdfast.config.models.devices import StaleConfig
    from holdfast.types import Area


class Mirror(NamedTuple):
    """A range that a device is read into, whose age is watched."""

    device: str
    source: tuple[object, ...]
    """Where the values come from. If it changes, those in memory are of the old source."""
    place: Place
    stale: StaleConfig
    age: _core.MirrorAge


def _lease_number(config: Config, device: str, place: Place) -> int | None:
    """The number of the lease under which all nodes write there what they read from the device."""
    if config.memories[place.memory].replicate is None:
        return None
    # Only an appliance with logs loads the client of NATS.
    from holdfast.replication.leases.leases import lease_number

    return lease_number(key_of(config, device))


class Mirrors(Part):
    """The ranges of all devices. `status` is thread-safe."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self._mirrors: tuple[Mirror, ...] = ()
        self._stale: set[Place] = set()

    def prepare(self, plan: Plan) -> Callable[[], None]:
        """Reserves the ranges of the configuration before its devices are polled."""
        mirrors = tuple(self._mirrors_of(plan.config))
        plan.ages = {mirror.place: mirror.age for mirror in mirrors}
        return lambda: self.adopt(plan, mirrors)

    def _mirrors_of(self, config: Config) -> Iterator[Mirror]:
        """The mirrors of a configuration. Ranges that are read as before keep their age."""
        known = {(mirror.source, mirror.place): mirror.age for mirror in self._mirrors}
        for name, device in config.devices.items():
            if (stale := device.stale) is None:
                continue
            for read in device.reads:
                if read.into is None:
                    continue
                place = place_of(read.into, read.count)
                # Nobody reads a disabled device: its values are not current, however young.
                source = (name, device.enabled, device.url, device.unit, read.area, read.address)
                age = known.get((source, place))
                if age is None:
                    refuses = stale.answer == "exception"
                    lease = _lease_number(config, name, place) if device.enabled else None
                    age = _core.MirrorAge(stale.after, refuses=refuses, lease=lease)
                yield Mirror(name, source, place, stale, age)

    def adopt(self, plan: Plan, mirrors: tuple[Mirror, ...]) -> None:
        """Takes over the mirrors of a configuration."""
        reserved: dict[str, list[tuple[Area, int, int]]] = {}
        for device in plan.config.devices.values():
            if device.enabled and device.writes != "local":
                for read in device.reads:
                    if (into := read.into) is not None:
                        place = place_of(into, read.count)
                        reserved.setdefault(into.memory, []).append(place.range)
        for mirror in mirrors:
            mirror.age.set(mirror.stale.after, refuses=mirror.stale.answer == "exception")
        for name, memory in plan.memories.items():
            aging = [(*each.place.range, each.age) for each in mirrors if each.place.memory == name]
            memory.mirror(reserved.get(name, []), aging)
        self._mirrors = mirrors
        self._stale &= {mirror.place for mirror in mirrors}

    def status(self) -> dict[str, list[dict[str, Any]]]:
        """Returns the ranges of each device whose age is watched, and since when they are stale."""
        found: dict[str, list[dict[str, Any]]] = {}
        now = time.time()
        for mirror in self._mirrors:
            age, stale_for = mirror.age.seconds, mirror.age.stale_for
            entry = {
                **asdict(mirror.place),
                "age": None if age is None else round(age, 3),
                "stale_since": None if stale_for is None else round(now - stale_for, 3),
            }
            found.setdefault(mirror.device, []).append(entry)
        return found

    def tick(self) -> None:
        """Logs which ranges have become stale, or are read again, since the last call."""
        for device, place, age in ((each.device, each.place, each.age) for each in self._mirrors):
            was_stale = place in self._stale
            # A range whose source has changed stays stale until it is read.
            is_stale = age.stale_for is not None and (was_stale or age.seconds is not None)
            if is_stale == was_stale:
                continue
            self._stale ^= {place}
            log_lines.write(
                logging.WARNING if is_stale else logging.INFO,
                "mirror_stale" if is_stale else "mirror_fresh",
                device=device,
                **asdict(place),
            )

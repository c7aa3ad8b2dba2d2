"""Checks rules between keys of tags, and the tags and profiles of devices."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from holdfast.config.devices import RangeConfig
from holdfast.config.lenient import entries, fitting, integer, mapping
from holdfast.config.tags import TagConfig
from holdfast.config.words import show
from holdfast.protocol import READ_REGISTERS
from holdfast.runtime.text import guess, listing
from holdfast.tags import Tag, TagError
from holdfast.tags.register_scale import RegisterScale

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath

_TAG: TypeAdapter[TagConfig] = TypeAdapter(TagConfig)
_RANGE: TypeAdapter[RangeConfig] = TypeAdapter(RangeConfig)


@dataclass
class TagChecks:
    """Checks the tags of one file."""

    report: Report
    _of_profiles: dict[str, dict[str, Tag]] = field(default_factory=dict)
    """The valid tags of each profile, by name."""

    def profiles(self, profiles: object) -> None:
        """Reports what is wrong in profiles."""
        for name, profile in mapping(profiles).items():
            path: KeyPath = ("profiles", name)
            own = self.tags(path, mapping(profile))
            found = self._resolved(path, mapping(mapping(profile).get("tags")), own)
            self._of_profiles[str(name)] = found

    def devices(self, devices: object, profiles: dict[Any, Any]) -> None:
        """Reports what is wrong in the tags of devices."""
        for name, device in mapping(devices).items():
            if not isinstance(device, dict):
                continue
            path: KeyPath = ("devices", name)
            profile = device.get("profile")
            if isinstance(profile, str) and profile not in profiles:
                known = listing(profiles) or "none, there are no profiles"
                message = f"found {show(profile)}, allowed: {known}{guess(profile, profiles)}"
                self.report.add((*path, "profile"), message)
            of_profile = profiles.get(profile) if isinstance(profile, str) else None
            order = mapping(of_profile).get("order")
            given = mapping(device.get("tags"))
            own = self.tags(path, {"order": order, "tags": given})
            inherited = self._of_profiles.get(profile, {}) if isinstance(profile, str) else {}
            tags = self._resolved(path, given, own, inherited) if given else inherited
            self._readable(path, device, tags)

    def tags(self, path: KeyPath, of: dict[Any, Any]) -> dict[str, Tag]:
        """Reports tags that can't be, and returns the others. `of` has their default order."""
        order = of.get("order")
        found: dict[str, Tag] = {}
        for name, given in mapping(of.get("tags")).items():
            settings = fitting(_TAG, given)
            if settings is None:
                continue
            try:
                found[str(name)] = settings.tag(
                    str(name), order if isinstance(order, str) else "ABCD"
                )
            except TagError as error:
                at = (*path, "tags", name, error.key)
                if error.key == "order" and "order" not in mapping(given):
                    at = (*path, "order") if "order" in of else at
                self.report.add(at, str(error))
        return found

    def _resolved(
        self,
        path: KeyPath,
        given: dict[Any, Any],
        own: Mapping[str, Tag],
        inherited: Mapping[str, Tag] | None = None,
    ) -> dict[str, Tag]:
        """The tags with the registers of their scales. Reports scales that can't be."""
        tags = {**(inherited or {}), **own}
        found: dict[str, Tag] = {}
        for name, tag in tags.items():
            scale = tag.scale
            source = scale.name if isinstance(scale, RegisterScale) else None
            if source is not None and source in given and source not in own:
                continue  # That tag has been reported.
            try:
                found[name] = tag.resolved(tags)
            except TagError as error:
                if name in own:
                    hint = "" if source is None or source in tags else guess(source, tags)
                    self.report.add((*path, "tags", name, error.key), f"{error}{hint}")
                else:
                    assert source is not None, "only a tag of the device can change it"
                    self.report.add((*path, "tags", source), f"{name} has its scale here: {error}")
        return found

    def _readable(self, path: KeyPath, device: dict[Any, Any], tags: Mapping[str, Tag]) -> None:
        """Reports values that the rules of a device don't let one request read with their scale."""
        most = integer(device.get("max_registers"), 1, READ_REGISTERS) or READ_REGISTERS
        own = mapping(device.get("tags"))
        for name, tag in tags.items():
            for flaw in _flaws(tag, device, most):
                scale = tag.scale
                assert isinstance(scale, RegisterScale), "others have no flaws"
                message = f"the scale is from {scale.where}, {flaw}"
                if name in own:
                    self.report.add((*path, "tags", name, "scale"), message)
                else:
                    self.report.add((*path, "profile"), f"{name}: {message}")


def _flaws(tag: Tag, device: dict[Any, Any], most: int) -> Iterator[str]:
    """Why no request can read a value together with its scale."""
    source = tag.source
    if source is None:
        return
    span, both = tag.span, "and a value is only read together with its scale"
    place = f"{span.start} to {span.stop - 1}"
    if len(span) > most:
        yield f"{place} are {len(span)} registers, max_registers is {most}, {both}"
    for start, stop in _stretches(device.get("forbidden"), tag.area):
        if start < span.stop and span.start < stop:
            yield f"{place} overlaps the forbidden range {start} to {stop - 1}, {both}"
    first, last = sorted((tag, source), key=lambda each: each.address)
    allowed = list(_stretches(device.get("readable"), tag.area))
    inside = any(start <= first.end and last.address <= stop for start, stop in allowed)
    if allowed and first.end < last.address and not inside:
        yield f"{first.end} to {last.address - 1} are not readable, {both}"


def _stretches(ranges: object, area: str) -> Iterator[tuple[int, int]]:
    for given in entries(ranges):
        settings = fitting(_RANGE, given)
        if settings is not None and settings.area == area:
            yield settings.addresses.start, settings.addresses.stop

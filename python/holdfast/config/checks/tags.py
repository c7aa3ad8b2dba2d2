"""Checks rules between keys of tags, and the tags and profiles of devices."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.config.checks.common import Scope, check_name, items, until_invalid
from holdfast.config.models.base import InvalidValue
from holdfast.protocol import READ_REGISTERS
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import extent
from holdfast.tags import Tag, TagError
from holdfast.tags.scale import RegisterScale
from holdfast.values.orders import DEFAULT_ORDER
from holdfast.values.types import LONGEST_NUMBER

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from holdfast.config.models.devices import DeviceConfig, RangeConfig
    from holdfast.config.models.tags import TagConfig
    from holdfast.config.text.yaml_document import KeyPath


def check_profiles(scope: Scope) -> dict[str, dict[str, Tag]]:
    """Reports what is wrong in profiles. Returns the valid tags of each, by name."""
    found: dict[str, dict[str, Tag]] = {}
    with until_invalid():
        for path, profile in items(("profiles",), scope.config.profiles):
            with until_invalid():
                own = _tags(scope, path, profile.tags, profile.__dict__.get("order", DEFAULT_ORDER))
                found[str(path[-1])] = _resolved(scope, path, profile.tags, own, {})
    return found


def check_tags(scope: Scope) -> None:
    """Reports what is wrong in profiles, and in the tags of devices."""
    of_profiles = check_profiles(scope)
    with until_invalid():
        for path, device in items(("devices",), scope.config.devices):
            with until_invalid():
                _check_device(scope, path, device, of_profiles)


def _check_device(
    scope: Scope, path: KeyPath, device: DeviceConfig, of_profiles: Mapping[str, dict[str, Tag]]
) -> None:
    tags: Mapping[str, Tag] = {}
    order = DEFAULT_ORDER
    with until_invalid():
        name, profiles = device.profile, scope.config.profiles
        if name is not None and check_name(
            (*path, "profile"), name, profiles, "profiles", scope.report
        ):
            tags, order = of_profiles.get(name, {}), profiles[name].order
    if device.tags:
        own = _tags(scope, path, device.tags, order)
        tags = _resolved(scope, path, device.tags, own, tags)
    most = READ_REGISTERS
    with until_invalid():
        most = device.max_registers
    for tag in tags.values():
        for key, flaw in _flaws(tag, device, most):
            if tag.name in device.tags:
                scope.report.add((*path, "tags", tag.name, key), flaw)
            else:
                scope.report.add((*path, "profile"), f"{tag.name}: {flaw}")


def _tags(scope: Scope, path: KeyPath, tags: Mapping[str, TagConfig], order: str) -> dict[str, Tag]:
    """Reports tags that can't be, and returns the others. `order` is their default."""
    found: dict[str, Tag] = {}
    for where, settings in items((*path, "tags"), tags):
        name = str(where[-1])
        with until_invalid():
            try:
                found[name] = tag = settings.tag(name, order)
                _warn_of_classes(scope, where, tag)
            except (TagError, InvalidValue):
                for error in settings.flaws(name, order):
                    at = (*where, error.key)
                    if error.key == "order" and settings.order is None:
                        at = (*path, "order") if path[0] == "profiles" else where
                    scope.report.add(at, str(error))
    return found


def _warn_of_classes(scope: Scope, where: KeyPath, tag: Tag) -> None:
    """Warns of classes with which Home Assistant would show no entity; most tags have none."""
    if tag.device_class or tag.state_class:
        from holdfast.config.values.home_assistant_classes import flaws

        for key, flaw in flaws(tag):
            scope.report.warn((*where, key), flaw)


def _resolved(
    scope: Scope,
    path: KeyPath,
    given: Mapping[str, TagConfig],
    own: Mapping[str, Tag],
    inherited: Mapping[str, Tag],
) -> dict[str, Tag]:
    """The tags with the registers of their scales. Reports scales that can't be."""
    tags = {**inherited, **own}
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
                hint = "" if source is None or source in tags else suggestion(source, tags)
                scope.report.add((*path, "tags", name, error.key), f"{error}{hint}")
            else:
                assert source is not None, "only a tag of the device can change it"
                scope.report.add((*path, "tags", source), f"{name} has its scale here: {error}")
    return found


def _flaws(tag: Tag, device: DeviceConfig, most: int) -> Iterator[tuple[str, str]]:
    """Why no request to the device, of `most` registers, can read a value, or not with its scale;
    and the tag's key.
    """
    span, source = tag.span, tag.source
    if source is None:
        if (overlapped := next(_overlapped(tag, device), None)) is not None:
            place = str(tag.address) if len(span) == 1 else extent(span)
            message = f"found {place}, which overlaps {overlapped}, allowed: other addresses"
            yield "address", message
        if most < LONGEST_NUMBER and tag.of_type.is_number:
            number = tag.of_type.width // 2
            if number > most:
                found = f"a number of {tag.type} has {number} registers, max_registers is {most}"
                yield "type", f"{found}, and all of them must be from one request"
        return
    assert isinstance(tag.scale, RegisterScale), "others have no source"
    where, both = tag.scale.where, "and a value is only read together with its scale"
    found = f"the scale is from {where}, {extent(span)}"
    if len(span) > most:
        yield "scale", f"{found} are {len(span)} registers, max_registers is {most}, {both}"
    for overlapped in _overlapped(tag, device):
        yield "scale", f"{found} overlaps {overlapped}, {both}"
    first, last = sorted((tag, source), key=lambda each: each.address)
    allowed = list(_stretches(device.readable, tag.area))
    inside = any(start <= first.end and last.address <= stop for start, stop in allowed)
    if allowed and first.end < last.address and not inside:
        between = extent(range(first.end, last.address))
        yield "scale", f"the scale is from {where}, {between} are not readable, {both}"


def _overlapped(tag: Tag, device: DeviceConfig) -> Iterator[str]:
    """The forbidden ranges that a read of the tag would touch."""
    for start, stop in _stretches(device.forbidden, tag.area):
        if start < tag.span.stop and tag.span.start < stop:
            yield f"the forbidden range {extent(range(start, stop))}"


def _stretches(ranges: Sequence[RangeConfig], area: str) -> Iterator[tuple[int, int]]:
    for _, each in items((), ranges):
        with until_invalid():
            if each.area == area:
                yield each.addresses.start, each.addresses.stop

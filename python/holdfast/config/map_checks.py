"""Checks the topics of the MQTT client that have plain values."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from holdfast.config.lenient import entries, fitting, mapping, parsed
from holdfast.config.memories import MemoryConfig
from holdfast.config.tags import ProfileConfig, TagConfig
from holdfast.config.topics import parse_topic_name
from holdfast.config.unique import Owners
from holdfast.config.words import show
from holdfast.runtime.text import guess, listing
from holdfast.tags import Tag, TagError
from holdfast.tags.register_scale import RegisterScale

if TYPE_CHECKING:
    from holdfast.config.grant_checks import GrantChecks
    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath

_TAG: TypeAdapter[TagConfig] = TypeAdapter(TagConfig)
_PROFILE: TypeAdapter[ProfileConfig] = TypeAdapter(ProfileConfig)
_MEMORY: TypeAdapter[MemoryConfig] = TypeAdapter(MemoryConfig)


def check_map(data: dict[Any, Any], report: Report, grants: GrantChecks) -> None:
    """Reports what is wrong."""
    topics = Owners(report, "topic")
    for index, given in enumerate(entries(mapping(data.get("mqtt")).get("map"))):
        entry = mapping(given)
        path: KeyPath = ("mqtt", "map", index)
        grants.memory((*path, "memory"), entry.get("memory"))
        topic = parsed(parse_topic_name, entry.get("topic"))
        if topic is not None:
            topics.claim((*path, "topic"), topic, show(topic), path)
        if isinstance(given, dict):
            found = _tag(data, path, entry, report)
            if found is not None:
                _check_place(data, path, entry, found, report)


def _tag(data: dict[Any, Any], path: KeyPath, entry: dict[Any, Any], report: Report) -> Tag | None:
    """The tag of an entry, if there is a valid one."""
    if "tag" in entry:
        for key in ("profile", "name"):
            if key in entry:
                message = "found together with tag, allowed: only one of them"
                report.add((*path, key), message, of_key=True)
        settings = fitting(_TAG, entry["tag"])
        try:
            return None if settings is None else settings.tag("tag", "ABCD")
        except TagError as error:
            report.add((*path, "tag", error.key), str(error))
            return None
    for key in ("profile", "name"):
        if key not in entry:
            message = "missing, allowed: tag, or profile and name"
            report.add((*path, "tag" if key == "profile" else key), message, of_key=True)
            return None
    profiles, profile, name = mapping(data.get("profiles")), entry["profile"], entry["name"]
    if not isinstance(profile, str) or not isinstance(name, str):
        return None  # Reported by the model.
    if profile not in profiles:
        words = f"allowed: {listing(profiles) or 'none, there are no profiles'}"
        report.add((*path, "profile"), f"found {show(profile)}, {words}{guess(profile, profiles)}")
        return None
    tags = mapping(mapping(profiles[profile]).get("tags"))
    if name not in tags:
        words = f"allowed: {listing(tags)}{guess(name, tags)}"
        report.add((*path, "name"), f"found {show(name)}, {words}")
        return None
    of_profile = fitting(_PROFILE, profiles[profile])
    try:
        return None if of_profile is None else of_profile.tag_list[name]
    except TagError:
        return None  # Reported with the profile.


def _check_place(
    data: dict[Any, Any], path: KeyPath, entry: dict[Any, Any], tag: Tag, report: Report
) -> None:
    """A tag must fit its memory, and a message must be able to write it alone."""
    at: KeyPath = (*path, "tag" if "tag" in entry else "name")
    if tag.of_type.base == "bit":
        message = f"found the type {tag.type}, allowed: types of whole registers, and bool"
        report.add((*at, "type") if "tag" in entry else at, message)
    if isinstance(tag.scale, RegisterScale):
        message = f"the scale is the {tag.scale}, allowed: a number, for what a topic writes"
        report.add((*at, "scale") if "tag" in entry else at, message)
    name = entry.get("memory")
    if not isinstance(name, str):
        return  # Reported by the model.
    memory = fitting(_MEMORY, mapping(data.get("memories")).get(name))
    if memory is None:
        return
    span = memory.areas().get(tag.area)
    if span is None:
        report.add(at, f"found {tag.area}, which the memory {entry['memory']} does not have")
    elif tag.address not in span.addresses or tag.end - 1 not in span.addresses:
        found = f"found {tag.area} {tag.address} to {tag.end - 1}"
        allowed = f"{span.addresses.start} to {span.addresses.stop - 1}"
        report.add(at, f"{found}, allowed: addresses {allowed}")

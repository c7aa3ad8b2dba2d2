"""The entries that `store` writes: subscribe requests and states, and their keys. Does no I/O."""

from __future__ import annotations

import base64
import math
import re
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast.client.url import NetworkTarget
from holdfast.runtime.malformed_json import MALFORMED_JSON
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.decoding import decode
from holdfast.scanner.messages.subject_parts import subject_id
from holdfast.scanner.messages.types import MAX_DESCRIPTION, SubscribeRequest, TagRequest
from holdfast.scanner.subscriptions.device import NO_OPTIONS, TagOptions
from holdfast.scanner.subscriptions.subscription import SETTINGS
from holdfast.scanner.subscriptions.tag import CODE_OF_AREA

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from holdfast.scanner.messages.types import Marker
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.tag import ScannedTag
    from holdfast.tags import TagList

    Profiles = Mapping[str, TagList]

MAX_PART_BYTES = 128 * 1024
"""The size in bytes of tags above which a further entry is made."""

MAX_ENTRY_BYTES = 8 * 1024 * 1024
"""The size limit of a stored request in bytes."""

_PLAIN = re.compile(r"[A-Za-z0-9_-]+")
_encode = msgspec.json.Encoder().encode


def subscription_keys(prefix: str) -> str:
    """Returns what the keys of all requests begin with, see `numbered`."""
    return f"{prefix}.subscription."


def status_keys(prefix: str) -> str:
    """Returns what the keys of the states of all devices begin with."""
    return f"{prefix}.status."


def status_key(prefix: str, device: str) -> str:
    """Returns the key of the state of a device."""
    return status_keys(prefix) + subject_id(device)


def numbered(
    prefix: str, device: str, subscriber: str, values: Iterable[bytes]
) -> dict[str, bytes]:
    """Returns the requests of a subscriber for a device by their keys."""
    keys = f"{subscription_keys(prefix)}{_token(subscriber)}.{subject_id(device)}"
    return {f"{keys}.{number}": value for number, value in enumerate(values)}


def number(key: str) -> int:
    """Returns the number of a request from its key; 0 for a key of another form."""
    last = key.rpartition(".")[2]
    return int(last) if last.isdecimal() else 0


def _token(text: str) -> str:
    """Returns a text as part of a key: in base64 after `=`, if it has other characters."""
    if _PLAIN.fullmatch(text):
        return text
    return "=" + base64.urlsafe_b64encode(text.encode()).rstrip(b"=").decode()


def requests(
    device: ScannedDevice, subscriber: str, max_bytes: int = MAX_ENTRY_BYTES
) -> Iterator[bytes]:
    """Yields the requests that make the subscription of a subscriber, each of limited size.

    Each has the profile, if there is one: it adds the tags that the profile has gained. One is
    larger than `max_bytes` only if it has a single tag.
    """
    known = device.subscribers[subscriber]
    head = {
        "deviceId": device.id,
        "subscriberId": subscriber,
        **_place(device),
        "unitId": device.source.unit,
        "timeout": device.source.timeout,
        "release": device.source.release,
        "scanRate": known.rate,
        "publish": known.publish,
        "deadband": known.deadband if known.publish == "change" else None,
        "plan": device.source.plan.request,
        "ttl": known.ttl,
        "profile": known.profile,
    }
    tags = (_tag(device.tags[id], options, known.profile) for id, options in known.tags.items())
    yield from _parts(head, tags, max_bytes)


def _parts(
    head: Mapping[str, object], tags: Iterable[TagRequest], max_bytes: int
) -> Iterator[bytes]:
    before = _encode({key: value for key, value in head.items() if value is not None})[:-1]
    before, after = before + b',"tags":[', b"]}"
    room = min(MAX_PART_BYTES, max_bytes - len(before) - len(after))
    part: list[bytes] = []
    size = 0
    for text in map(_encode, tags):
        if part and size + len(text) > room:
            yield before + b",".join(part) + after
            part, size = [], 0
        part.append(text)
        size += len(text) + len(b",")
    if part:
        yield before + b",".join(part) + after


def resized(found: Iterable[SubscribeRequest], max_bytes: int) -> Iterator[bytes]:
    """Yields stored requests again, as parts of limited size like those of `requests`."""
    for each in found:
        head = msgspec.to_builtins(msgspec.structs.replace(each, tags=[]))
        del head["tags"]
        yield from _parts(head, each.tags, max_bytes)


def restored(value: bytes) -> SubscribeRequest:
    """Returns a stored request. Raises `Refused`."""
    try:
        return decode(value, SubscribeRequest, MAX_ENTRY_BYTES)
    except Refused:
        # It may be older than the limit of descriptions. A description ends no subscription.
        return decode(_with_cut_descriptions(value), SubscribeRequest, MAX_ENTRY_BYTES)


def _with_cut_descriptions(value: bytes) -> bytes:
    """Returns a stored request with descriptions of a valid length; other values as they are."""
    try:
        found = msgspec.json.decode(value, type=dict[str, Any])
        tags = msgspec.convert(found.get("tags"), list[dict[str, Any]])
    except MALFORMED_JSON:
        return value
    for tag in tags:
        if type(text := tag.get("description")) is str:
            tag["description"] = text[:MAX_DESCRIPTION]
    return _encode(found | {"tags": tags})


def tag_ids(parts: Iterable[SubscribeRequest], profiles: Profiles) -> set[str]:
    """Returns the ids of the tags of stored requests, and of those that their profile has now."""
    ids: set[str] = set()
    for each in parts:
        ids |= {tag.id for tag in each.tags} | _names(each.profile, profiles)
    return ids


def without(
    found: Iterable[SubscribeRequest], ids: Collection[str], profiles: Profiles
) -> list[SubscribeRequest]:
    """Returns the requests of a subscriber without these tags, if they have tags left."""
    parts = list(found)
    profile = next(filter(None, (each.profile for each in parts)), None)
    of_profile = {tag.id for each in parts for tag in each.tags if tag.profile == profile}
    # Also one that the profile has gained, which is in no request yet.
    if not (of_profile | _names(profile, profiles)).isdisjoint(ids):
        profile = None  # The subscriber has not all of its tags any more.
    left = (
        msgspec.structs.replace(each, tags=[tag for tag in each.tags if tag.id not in ids])
        for each in parts
    )
    return [with_profile(each, profile, profiles) for each in left if each.tags]


def _names(profile: str | None, profiles: Profiles) -> set[str]:
    """Returns the ids of the tags that a profile has now."""
    return set() if profile is None else {tag.name for tag in profiles.get(profile, ())}


def with_profile(
    request: SubscribeRequest, profile: str | None, profiles: Profiles
) -> SubscribeRequest:
    """Returns a stored request with another profile, or without one.

    The tags of its own profile keep what that one sets, which is not stored with them.
    """
    former = request.profile
    tags = request.tags
    if former is not None and former != profile and former in profiles:
        tags = [
            _with_options(tag, profiles[former]) if tag.profile == former else tag for tag in tags
        ]
    return msgspec.structs.replace(request, tags=tags, profile=profile)


def _with_options(tag: TagRequest, profile: TagList) -> TagRequest:
    if tag.id not in profile or tag.writable is not None or tag.description is not None:
        return tag
    options = TagOptions.of_profile(profile[tag.id])
    text = None if options.description is None else options.description[:MAX_DESCRIPTION]
    return msgspec.structs.replace(tag, writable=options.writable, description=text)


def with_later(
    parts: Sequence[SubscribeRequest],
    device: ScannedDevice,
    subscriber: str,
    given: Collection[str],
    profiles: Profiles,
) -> list[SubscribeRequest]:
    """Returns stored requests together with the later ones of a known subscriber.

    The later ones replace tags and settings; of `SETTINGS`, only those that are `given`, unless the
    device has other subscribers. Returns nothing if the stored requests add nothing.
    """
    later = [restored(value) for value in requests(device, subscriber)]
    kept = [key for key in SETTINGS if key not in given] if len(device.subscribers) == 1 else []
    return replaced_by(parts, later, profiles, kept)


def replaced_by(
    parts: Sequence[SubscribeRequest],
    later: Sequence[SubscribeRequest],
    profiles: Profiles,
    kept: Iterable[str] = (),
) -> list[SubscribeRequest]:
    """Returns stored requests together with later ones, which replace tags and settings.

    The stored settings that are `kept` stay. Returns nothing if the stored requests add nothing.
    """
    ids = {tag.id for each in later for tag in each.tags}
    profile = next(filter(None, (each.profile for each in (later[0], *parts))), None)
    own = [with_profile(each, profile, profiles) for each in parts]
    earlier = [[tag for tag in _ordered(each) if tag.id not in ids] for each in own]
    changes: dict[str, Any] = {"profile": profile}
    for key in kept:
        if (value := getattr(parts[0], key)) is not None:
            changes[key] = value
    head = msgspec.structs.replace(later[0], **changes)
    if head == later[0] and not any(earlier):
        return []
    tags = filter(None, [*earlier, *(each.tags for each in later)])
    return [msgspec.structs.replace(head, tags=each) for each in tags]


def _ordered(request: SubscribeRequest) -> list[TagRequest]:
    """Returns the tags of a request, each with its byte order."""
    order = request.byte_order
    return [
        msgspec.structs.replace(tag, byte_order=tag.byte_order or order) for tag in request.tags
    ]


def is_last(parts: Iterable[SubscribeRequest]) -> bool:
    """Whether a stored subscription is carried out after others, as a key for sorting.

    Those with a profile are: a tag that it has gained must not displace one of another.
    """
    return any(part.profile is not None for part in parts)


def joined(parts: Sequence[SubscribeRequest]) -> SubscribeRequest:
    """Returns the stored requests of a subscription as one.

    A profile is expanded for the whole subscription: a tag that it has may be in any of them.
    """
    tags = {tag.id: tag for each in parts for tag in each.tags}
    return msgspec.structs.replace(parts[0], tags=list(tags.values()))


def _place(device: ScannedDevice) -> dict[str, object]:
    if device.source.url is not None:
        return {"url": device.source.url}
    target = device.source.target
    assert isinstance(target, NetworkTarget)
    return {"host": target.host, "port": target.port, "transport": target.transport}


def _tag(tag: ScannedTag, options: TagOptions, profile: str | None) -> TagRequest:
    """Returns a tag as a request; without what a subscription to its whole `profile` sets."""
    if tag.profile_tag is not None and tag.profile == profile:
        options = NO_OPTIONS if options == TagOptions.of_profile(tag.profile_tag) else options
    text = options.description
    return TagRequest(
        id=tag.id,
        address=tag.address,
        function_code=CODE_OF_AREA[tag.area],
        datatype=tag.requested_type,
        byte_order=tag.order,
        encoding=tag.encoding,
        writable=options.writable,
        # A tag of a profile may have a longer one than requests.
        description=None if text is None or len(text) > MAX_DESCRIPTION else text,
        # Sorted: each process has its own order of a set, and nodes of a fleet compare requests.
        null=sorted(map(_marker, tag.null), key=str) or None,
        profile=tag.profile,
    )


def _marker(marker: Marker) -> Marker:
    return "nan" if isinstance(marker, float) and math.isnan(marker) else marker

"""A subscribe request and its tags, checked without regard to other subscriptions. Does no I/O."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING
from urllib.parse import parse_qsl, urlsplit

import msgspec

from holdfast import tags
from holdfast.client import url as urls
from holdfast.client.serial_settings import SerialTarget
from holdfast.client.tolerance import STRICT
from holdfast.client.url import NetworkTarget
from holdfast.net.addresses import address_in, unbracketed
from holdfast.net.hosts import HOST_FORM, is_host
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, WRITE_LIMITS, usual_port
from holdfast.runtime.text import quote
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.types import TagRequest
from holdfast.scanner.subscriptions.device import NO_OPTIONS, Source, TagOptions
from holdfast.scanner.subscriptions.key import SubscriptionKey
from holdfast.scanner.subscriptions.plan import Plan
from holdfast.scanner.subscriptions.tag import AREA_OF_CODE, CODE_OF_AREA, ScannedTag
from holdfast.scanner.subscriptions.write_access import read_only
from holdfast.tags.tag import as_decoded
from holdfast.types import BIT_AREAS, SERIAL_FRAMES
from holdfast.values import ConversionError, WrongArea, codec_for
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.client.url import Target
    from holdfast.config.values.scanner_settings import Publish
    from holdfast.scanner.messages.decoding import Adjustments
    from holdfast.scanner.messages.types import SubscribeRequest
    from holdfast.scanner.subscriptions.request_rules import Rules
    from holdfast.tags.base import Marker
    from holdfast.values.types import Type

SETTINGS = ("timeout", "release", "plan")
"""The settings of a device that a request may leave out, once another has set them."""


@dataclass(frozen=True)
class Subscription:
    """A valid subscribe request. It may still contradict other subscriptions."""

    device: str
    subscriber: str
    source: Source
    given_settings: frozenset[str]
    """The settings that the request contains. Others are those of the known device, or defaults."""
    tags: Mapping[str, ScannedTag]
    options: Mapping[str, TagOptions]
    rate: int
    publish: Publish
    deadband: float
    ttl: int | None
    """Seconds."""
    profile: str | None
    """The profile whose tags are among `tags`: all of them, unless it was not expanded."""

    @property
    def key(self) -> SubscriptionKey:
        """What identifies it."""
        return SubscriptionKey(self.device, self.subscriber)


def subscription_of(
    request: SubscribeRequest,
    rules: Rules,
    adjustments: Adjustments,
    *,
    expands: bool = True,
) -> Subscription:
    """Checks a request alone. Adds to `adjustments` what is adjusted. Raises `Refused`.

    Unless it `expands` the profile of the request, only the tags of the request are subscribed to.
    """
    defaults = rules.defaults
    if not request.device_id.isprintable():  # It becomes a part of subjects.
        found = f"deviceId is {request.device_id!r}"
        raise Refused(f"{found}, allowed: printable characters and blanks")
    publish = request.publish or defaults.publish
    if request.deadband and publish != "change":
        raise Refused('deadband requires "publish": "change"')
    deadband = defaults.deadband if request.deadband is None else request.deadband
    rate = rules.scan_rate(request.scan_rate, adjustments)
    timeout = rules.timeout(request.timeout)
    source = Source(
        _target(request),
        1 if request.unit_id is None else request.unit_id,
        timeout,
        bool(request.release),
        Plan.of(request.plan),
        request.url,
    )
    target = source.target
    if source.unit == 0 and (isinstance(target, SerialTarget) or target.transport in SERIAL_FRAMES):
        raise Refused("unitId is 0, which is the broadcast of a serial line")
    tags, options = requested_tags(request, rules, adjustments, expands=expands)
    source.plan.check(list(tags.values()))
    return Subscription(
        request.device_id,
        request.subscriber_id,
        source,
        frozenset(key for key in SETTINGS if getattr(request, key) is not None),
        tags,
        options,
        rate,
        publish,
        deadband if publish == "change" else 0.0,
        request.ttl,
        request.profile,
    )


def _target(request: SubscribeRequest) -> Target:
    given = [key for key in ("host", "port", "transport") if getattr(request, key) is not None]
    if request.url is not None:
        if given:
            raise Refused(f"both url and {given[0]} are given, allowed: only one")
        try:
            parts = urlsplit(request.url)
            for key in dict(parse_qsl(parts.query, keep_blank_values=True)):
                if parts.scheme == "tls" and key != "name" and key not in asdict(STRICT):
                    allowed = "allowed: name and the tolerance options; files are the scanner's"
                    raise Refused(f"url: {key} is given, {allowed}")
            return urls.parse(request.url)
        except ValueError as error:
            raise Refused(f"url: {error}") from None
    if request.host is None:
        raise Refused("host is missing: give host or url")
    if not is_host(request.host):
        raise Refused(f"host is {quote(request.host)}, allowed: {HOST_FORM}")
    transport = request.transport or "tcp"
    port = usual_port(transport) if request.port is None else request.port
    is_address = address_in(request.host) is not None
    host = unbracketed(request.host) if is_address else request.host
    return NetworkTarget(transport, host, port)


ORDERS = {"big": "ABCD", "little": "DCBA"}
"""Other names of byte orders, as callers of tentacle-modbus use them."""

NO_MARKERS: frozenset[Marker] = frozenset()
"""One object for nearly all tags."""


def requested_tags(
    request: SubscribeRequest, rules: Rules, adjustments: Adjustments, *, expands: bool = True
) -> tuple[dict[str, ScannedTag], dict[str, TagOptions]]:
    """Returns the tags of a request by id, and what it sets for each. Raises `Refused`.

    A tag of the request replaces that of its profile.
    """
    order = ORDERS.get(request.byte_order or "big", request.byte_order or "")
    profile = request.profile if expands else None
    of_profile = [] if profile is None else _profile_requests(profile, rules)
    replaceable = {entry.id for entry in of_profile}
    entries = [(f"profile {request.profile}", entry) for entry in of_profile]
    entries += ((f"tags[{index}]", entry) for index, entry in enumerate(request.tags))
    options = {entry.id: _options(entry) for _, entry in entries}
    found: dict[str, ScannedTag] = {}
    for where, entry in entries:
        made = _tag(entry, order, where, rules, adjustments)
        before = found.get(made.id)
        if before is not None and made.id in replaceable:
            replaceable -= {made.id}  # A second one in the request would be a repetition.
        elif before is not None:
            if rules.strict:
                raise Refused(f"{where}: duplicate id {made.id!r}")
            if made != before and not rules.dialect.last_definition_counts:
                raise Refused(f"{where}: {made.id!r} is {made}, and already {before}")
            adjustments.changes.append(("tag_repeated", made.id))
        found[made.id] = made
    return found, options


def without_lost(request: SubscribeRequest, rules: Rules) -> tuple[SubscribeRequest, list[str]]:
    """Returns a stored request without the tags that their profile has lost, and their ids."""
    left, lost = [], []
    for tag in request.tags:
        profile = None if tag.profile is None else rules.profiles.get(tag.profile)
        if profile is None or tag.id in profile:
            left.append(tag)
        else:
            lost.append(tag.id)
    return msgspec.structs.replace(request, tags=left), lost


def gained(request: SubscribeRequest, rules: Rules) -> list[str]:
    """Returns the ids of the tags that the profile of a stored request has, and it has not."""
    profile = None if request.profile is None else rules.profiles.get(request.profile)
    stored = {tag.id for tag in request.tags}
    return [] if profile is None else [tag.name for tag in profile if tag.name not in stored]


def _options(entry: TagRequest) -> TagOptions:
    if entry.writable is None and entry.description is None:
        return NO_OPTIONS
    return TagOptions(entry.writable, entry.description)


def _tag(
    request: TagRequest, order: str, where: str, rules: Rules, adjustments: Adjustments
) -> ScannedTag:
    """Creates the tag of a request; `order` is the default byte order. Raises `Refused`.

    Unless the rules are strict, a number in an area of bits becomes a boolean, and `writable` is
    ignored in an area that can't be written. Adds this to `adjustments`.
    """
    if request.profile is not None:
        return _of_profile(request.profile, request.id, where, rules)
    area = AREA_OF_CODE[request.function_code]
    name = request.datatype
    if name == "boolean" or name.startswith("boolean["):
        name = "bool" + name.removeprefix("boolean")
    order = request.byte_order or order
    order = ORDERS.get(order, order)
    try:
        type = parsed(name)
        if type.is_number and type.count is None and area in BIT_AREAS and not rules.strict:
            adjustments.changes.append(("datatype_ignored", f"{request.id} ({name} in {area})"))
            name, type = "bool", parsed("bool")
        if type.base == "bool":
            order = "ABCD"  # It has none: then equal tags are equal, whatever a request says.
        elif area not in BIT_AREAS:
            for note in rules.dialect.byte_order_notes(request, area, order):
                adjustments.byte_orders.append((request.id, note))
            order = rules.dialect.byte_orders.get((name, order), order)
        codec_for(area, name, order, request.encoding)
    except WrongArea:
        raise Refused(
            f"{where}: datatype is {name}, functionCode {request.function_code} reads boolean"
        ) from None
    except ConversionError as error:
        raise Refused(f"{where}: {error}") from None
    if request.address + type.registers > ADDRESSES:
        raise Refused(
            f"{where}: {name} from address {request.address}: the last address is {LAST_ADDRESS}"
        )
    null = _null_markers(request, type, where)
    made = ScannedTag(request.id, area, request.address, name, order, null, request.encoding)
    if request.writable and (flaw := read_only(made)) is not None:
        if area in WRITE_LIMITS or rules.strict:
            raise Refused(f"{where}: {flaw}")
        adjustments.changes.append(("writable_ignored", f"{request.id} ({area})"))
    return made


def _null_markers(request: TagRequest, type: Type, where: str) -> frozenset[Marker]:
    if not request.null:
        return NO_MARKERS
    try:
        return frozenset(as_decoded(each, type, request.encoding) for each in request.null)
    except ValueError as error:
        raise Refused(f"{where}.null: {error}") from None


def _profile_requests(name: str, rules: Rules) -> list[TagRequest]:
    """Returns the tags of a profile as requests. Raises `Refused`."""
    return [
        TagRequest(
            id=tag.name,
            address=tag.address,
            function_code=CODE_OF_AREA[tag.area],
            datatype=tag.type,
            profile=name,
        )
        for tag in _profile(name, "profile", rules)
    ]


def _of_profile(name: str, id: str, where: str, rules: Rules) -> ScannedTag:
    profile = _profile(name, f"{where}.profile", rules)
    if id not in profile:
        raise Refused(f"{where}: the profile {name} has no tag {id!r}")
    tag = profile[id]
    made = (tag.area, tag.address, tag.type, tag.order, frozenset(tag.null), tag.encoding)
    return ScannedTag(id, *made, profile=name, profile_tag=tag)


def _profile(name: str, where: str, rules: Rules) -> tags.TagList:
    found = rules.profiles.get(name)
    if found is None:
        allowed = ", ".join(rules.profiles) or "none, the configuration has no profiles"
        raise Refused(f"{where} is {name!r}, allowed: {allowed}")
    return found

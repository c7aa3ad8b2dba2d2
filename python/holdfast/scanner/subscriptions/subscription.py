"""A subscribe request, checked without regard to other subscriptions. Does no I/O."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING
from urllib.parse import parse_qsl, urlsplit

from holdfast.client import url as urls
from holdfast.client.tolerance import STRICT
from holdfast.client.url import NetworkTarget, SerialTarget
from holdfast.net.addresses import address_in, unbracketed
from holdfast.protocol import usual_port
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.leniency import Adjustments
from holdfast.scanner.subscriptions.device import Plan, Source
from holdfast.scanner.subscriptions.requested_tags import requested_tags
from holdfast.types import SERIAL_FRAMES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.client.url import Target
    from holdfast.config.scanning import Publish
    from holdfast.scanner.messages.types import SubscribeRequest
    from holdfast.scanner.subscriptions.device import TagOptions
    from holdfast.scanner.subscriptions.rules import Rules
    from holdfast.scanner.subscriptions.tag import Tag

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
    tags: Mapping[str, Tag]
    options: Mapping[str, TagOptions]
    rate: int
    publish: Publish
    deadband: float
    ttl: int | None
    """Seconds."""


def subscription_of(
    request: SubscribeRequest, rules: Rules, adjustments: Adjustments | None = None
) -> Subscription:
    """Checks a request alone. Adds to `adjustments` what is adjusted. Raises `Refused`."""
    adjustments = Adjustments() if adjustments is None else adjustments
    defaults = rules.defaults
    _check_id(request.device_id)
    publish = request.publish or defaults.publish
    if request.deadband and publish != "change":
        raise Refused('deadband requires "publish": "change"')
    deadband = defaults.deadband if request.deadband is None else request.deadband
    rate, timeout = _rate(request, rules, adjustments), _timeout(request, rules)
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
    tags, options = requested_tags(request, rules, adjustments)
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
    )


def _check_id(id: str) -> None:
    """Checks a device id, which becomes a part of subjects. Raises `Refused`."""
    if not id.isprintable():
        raise Refused(f"deviceId is {id!r}, allowed: printable characters and blanks")


def _rate(request: SubscribeRequest, rules: Rules, adjustments: Adjustments) -> int:
    """Returns the scan rate; one that is too short is raised. Raises `Refused`."""
    limits, rate = rules.limits, request.scan_rate
    if rate is None:
        return rules.defaults.scan_rate
    if rate < limits.shortest_scan and not rules.strict:
        adjustments.changes.append(("scan_rate_raised", f"{rate} to {limits.shortest_scan} ms"))
        return limits.shortest_scan
    return _within("scanRate", rate, limits.shortest_scan, limits.longest_scan)


def _timeout(request: SubscribeRequest, rules: Rules) -> int:
    timeout = rules.defaults.timeout if request.timeout is None else request.timeout
    limits = rules.limits
    return _within("timeout", timeout, limits.shortest_timeout, limits.longest_timeout)


def _within(key: str, value: int, least: int, most: int) -> int:
    if not least <= value <= most:
        raise Refused(f"{key} is {value}, allowed: {least} to {most} ms")
    return value


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
    transport = request.transport or "tcp"
    port = usual_port(transport) if request.port is None else request.port
    is_address = address_in(request.host) is not None
    host = unbracketed(request.host) if is_address else request.host
    return NetworkTarget(transport, host, port)

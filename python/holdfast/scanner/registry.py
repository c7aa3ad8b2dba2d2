"""The registry of all subscriptions. A request is carried out completely or not at all.

All checks run before the first change, without an await in between. `understood` checks a request
by itself. The registry checks it against the existing subscriptions.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING
from urllib.parse import parse_qsl, urlsplit

from holdfast.client import target as targets
from holdfast.client.target import NetworkTarget, SerialTarget
from holdfast.client.tolerance import STRICT
from holdfast.net.addresses import address_in, unbracketed
from holdfast.protocol import usual_port
from holdfast.scanner.devices import Plan, ScannedDevice, Source, Subscriber, Wanted
from holdfast.scanner.errors import Refused
from holdfast.scanner.health import Health
from holdfast.scanner.tags import tag
from holdfast.types import SERIAL_FRAMES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.client.target import Target
    from holdfast.scanner.limits import ScannerLimits
    from holdfast.scanner.messages import SubscribeRequest, UnsubscribeRequest
    from holdfast.scanner.tags import Tag

SCAN_RATE = 1000
TIMEOUT = 1000

LINE_SETTINGS = ("mode", "baud", "parity", "stop_bits", "data_bits", "silence")
"""What all devices on one serial line have alike."""


@dataclass(frozen=True)
class Subscription:
    """A subscribe request that is valid by itself."""

    device: str
    subscriber: str
    source: Source
    said: frozenset[str]
    """The settings that the request contains. Others are those of the known device, or defaults."""
    tags: Mapping[str, Tag]
    wanted: Mapping[str, Wanted]
    rate: int
    publish: str
    deadband: float


def understood(request: SubscribeRequest, limits: ScannerLimits) -> Subscription:
    """Checks a request by itself. Raises `Refused`."""
    _check_id(request.device_id)
    if request.deadband and request.publish != "change":
        raise Refused('deadband requires "publish": "change"')
    source = Source(
        _target(request),
        1 if request.unit_id is None else request.unit_id,
        _within(
            "timeout", request.timeout, TIMEOUT, limits.shortest_timeout, limits.longest_timeout
        ),
        bool(request.release),
        Plan.of(request.plan),
    )
    target = source.target
    if source.unit == 0 and (isinstance(target, SerialTarget) or target.transport in SERIAL_FRAMES):
        raise Refused("unitId is 0, which is the broadcast of a serial line")
    tags: dict[str, Tag] = {}
    for index, entry in enumerate(request.tags):
        where = f"tags[{index}]"
        made = tag(entry, request.byte_order or "ABCD", where)
        if made.id in tags:
            raise Refused(f"{where}: duplicate id {made.id!r}")
        tags[made.id] = made
    source.plan.check(list(tags.values()))
    said = {key for key in ("timeout", "release", "plan") if getattr(request, key) is not None}
    return Subscription(
        request.device_id,
        request.subscriber_id,
        source,
        frozenset(said),
        tags,
        {entry.id: Wanted(bool(entry.writable), entry.description) for entry in request.tags},
        _within(
            "scanRate", request.scan_rate, SCAN_RATE, limits.shortest_scan, limits.longest_scan
        ),
        request.publish or "scan",
        request.deadband or 0.0,
    )


def _check_id(id: str) -> None:
    """Checks a device id, which becomes a part of subjects. Raises `Refused`."""
    flaw = not id.isprintable() or " " in id or "*" in id or ">" in id
    if flaw or "" in id.split("."):
        raise Refused(
            f"deviceId is {id!r}, which can't be a part of a subject: it must have no spaces, * or "
            ">, and no dots at its ends or beside each other"
        )


def _target(request: SubscribeRequest) -> Target:
    beside = [key for key in ("host", "port", "transport") if getattr(request, key) is not None]
    if request.url is not None:
        if beside:
            raise Refused(f"both url and {beside[0]} are given, allowed is only one")
        try:
            parts = urlsplit(request.url)
            for key in dict(parse_qsl(parts.query, keep_blank_values=True)):
                if parts.scheme == "tls" and key != "name" and key not in asdict(STRICT):
                    allowed = "allowed are name and the tolerance options; files are the scanner's"
                    raise Refused(f"url: {key} is given, {allowed}")
            return targets.parse(request.url)
        except ValueError as error:
            raise Refused(f"url: {error}") from None
    if request.host is None:
        raise Refused("host is missing: give host or url")
    transport = request.transport or "tcp"
    port = usual_port(transport) if request.port is None else request.port
    is_address = address_in(request.host) is not None
    host = unbracketed(request.host) if is_address else request.host
    return NetworkTarget(transport, host, port)


def _within(key: str, value: int | None, default: int, least: int, most: int) -> int:
    if value is None:
        return default
    if not least <= value <= most:
        raise Refused(f"{key} is {value}, allowed are {least} to {most} ms")
    return value


class Registry:
    """The devices by id, with their subscribers."""

    def __init__(self, limits: ScannerLimits) -> None:
        self.devices: dict[str, ScannedDevice] = {}
        self._limits = limits
        self._tags = 0
        self._holders: dict[str, set[str]] = {}
        """The ids of the devices that have a tag id."""

    def subscribe(self, asked: Subscription, address: Target) -> tuple[ScannedDevice | None, bool]:
        """Adds a subscription. Returns the device, and whether its polling must change.

        A request without tags adds no subscriber, and no device. Raises `Refused`.
        """
        device = self.devices.get(asked.device)
        new = [id for id in asked.tags if device is None or id not in device.tags]
        self._check_limits(device, asked, len(new))
        if device is None:
            self._check_shared(asked)
        else:
            _check_known(device, asked)
            device.source.plan.check([asked.tags[id] for id in new])
        if not asked.tags and (device is None or asked.subscriber not in device.subscribers):
            return device, False
        if device is None:
            device = ScannedDevice(asked.device, asked.source, address, Health())
            self.devices[device.id] = device
        before = device.rate if device.subscribers else None
        subscriber = device.subscribers.setdefault(
            asked.subscriber, Subscriber(asked.rate, "scan", 0.0)
        )
        subscriber.rate = asked.rate
        subscriber.publish = "change" if asked.publish == "change" else "scan"
        subscriber.deadband = asked.deadband
        subscriber.tags |= asked.wanted
        device.tags |= {id: asked.tags[id] for id in new}
        for id in new:
            self._holders.setdefault(id, set()).add(device.id)
        self._tags += len(new)
        return device, bool(new) or device.rate != before

    def unsubscribe(self, request: UnsubscribeRequest) -> tuple[ScannedDevice | None, bool]:
        """Removes tags of a subscriber. Returns the device, and whether its polling must change.

        Removes the device with its last subscriber. Unknown ids are ignored.
        """
        device = self.devices.get(request.device_id)
        subscriber = None if device is None else device.subscribers.get(request.subscriber_id)
        if device is None or subscriber is None:
            return device, False
        before = device.rate
        ids = list(subscriber.tags) if request.tag_ids is None else request.tag_ids
        for id in ids:
            subscriber.tags.pop(id, None)
        if not subscriber.tags:
            del device.subscribers[request.subscriber_id]
        unwanted = device.forget(ids)
        for id in unwanted:
            self._holders[id].discard(device.id)
            if not self._holders[id]:
                del self._holders[id]
        self._tags -= len(unwanted)
        if not device.subscribers:
            del self.devices[device.id]
            return device, True
        return device, bool(unwanted) or device.rate != before

    def commanded(self, name: str) -> tuple[ScannedDevice, Tag]:
        """Returns the tag of a command's name: an id, or device and id. Raises `Refused`."""
        found = {(device, name) for device in self._holders.get(name, ())}
        parts = name.split(".")
        for at in range(1, len(parts)):
            device, id = ".".join(parts[:at]), ".".join(parts[at:])
            if device in self._holders.get(id, ()):
                found.add((device, id))
        if not found:
            raise Refused(f"no tag {name!r}")
        if len(found) > 1:
            known = ", ".join(f"{device}.{id}" for device, id in sorted(found))
            raise Refused(f"{name!r} is ambiguous: {known}")
        [(of, id)] = found
        return self.devices[of], self.devices[of].tags[id]

    def _check_shared(self, asked: Subscription) -> None:
        """Checks that a new device has the settings of the devices that share its connection."""
        target = asked.source.target
        place, settings = _place(target), _settings(target)
        for device in self.devices.values():
            if _place(device.source.target) != place:
                continue
            for key, known in _settings(device.source.target).items():
                if known != settings[key]:
                    at = (
                        "on one serial line"
                        if isinstance(target, SerialTarget)
                        else "at one address"
                    )
                    raise Refused(
                        f"{key} of {place} is already {_shown(known)} for {device.id}, "
                        f"not {_shown(settings[key])}; devices {at} have the same settings"
                    )

    def _check_limits(self, device: ScannedDevice | None, asked: Subscription, new: int) -> None:
        limits = self._limits
        if device is None and len(self.devices) >= limits.devices:
            raise Refused(f"there are already {limits.devices} devices, which is the limit")
        subscribers = {} if device is None else device.subscribers
        if asked.subscriber not in subscribers and len(subscribers) >= limits.subscribers:
            raise Refused(
                f"{asked.device} already has {limits.subscribers} subscribers, which is the limit"
            )
        tags = new + (0 if device is None else len(device.tags))
        if tags > limits.device_tags:
            raise Refused(
                f"{asked.device} would have {tags} tags, allowed are {limits.device_tags}"
            )
        if self._tags + new > limits.tags:
            raise Refused(f"there would be {self._tags + new} tags, allowed are {limits.tags}")


def _check_known(device: ScannedDevice, asked: Subscription) -> None:
    """Checks that a request agrees with earlier requests for the device. Raises `Refused`."""
    check_address(device, asked)
    for key in ("timeout", "release", "plan"):
        known, said = getattr(device.source, key), getattr(asked.source, key)
        if key in asked.said and said != known:
            raise Refused(
                f"{key} of {device.id} is already different; end all of its subscriptions first"
            )
    for id, wanted in asked.tags.items():
        if id in device.tags and device.tags[id] != wanted:
            raise Refused(
                f"tag {id!r} of {device.id} already has another definition; unsubscribe it first"
            )


def check_address(device: ScannedDevice, asked: Subscription) -> None:
    """Checks that a request names the known address of a device. Raises `Refused`."""
    known, said = device.source, asked.source
    if (known.target, known.unit) != (said.target, said.unit):
        raise Refused(
            f"{device.id} is known as {_told(known)}, not as {_told(said)}; end all of its "
            "subscriptions first"
        )


def _place(target: Target) -> str:
    """What devices share that have one connection."""
    return target.device if isinstance(target, SerialTarget) else str(target)


def _settings(target: Target) -> dict[str, object]:
    """What devices of one connection have in common."""
    line = LINE_SETTINGS if isinstance(target, SerialTarget) else ()
    return {key: getattr(target, key) for key in line} | asdict(target.tolerance)


def _told(source: Source) -> str:
    """Formats the address of a device with everything that identifies it."""
    target = source.target
    usual: dict[str, object] = asdict(STRICT)
    more = ""
    if isinstance(target, SerialTarget):
        usual["mode"] = target.mode
    elif target.tls.name is not None:
        more = f" with the name {target.tls.name}"
    said = [
        f"{key} {_shown(value)}"
        for key, value in _settings(target).items()
        if key not in usual or value != usual[key]
    ]
    more += f" ({', '.join(said)})" if said else ""
    return f"{target}{more} unit {source.unit}"


def _shown(setting: object) -> object:
    return "the default" if setting is None else setting

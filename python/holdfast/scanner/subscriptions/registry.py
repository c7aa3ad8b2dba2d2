"""The registry of all subscriptions. A request is carried out completely or not at all.

All checks run before the first change, without an await in between. A `Subscription` was checked
alone before; the registry compares it with those that it has.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

from holdfast.client.tolerance import STRICT
from holdfast.client.url import SerialTarget
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.dialects import TENTACLE
from holdfast.scanner.messages.subjects import subject_id
from holdfast.scanner.subscriptions.device import ScannedDevice, Source, Subscriber
from holdfast.scanner.subscriptions.health import Health
from holdfast.scanner.subscriptions.subscription import SETTINGS

if TYPE_CHECKING:
    from collections.abc import Collection

    from holdfast.client.url import Target
    from holdfast.config.scanning import Writes
    from holdfast.scanner.messages.dialect import Dialect
    from holdfast.scanner.messages.types import UnsubscribeRequest
    from holdfast.scanner.subscriptions.limits import ScannerLimits
    from holdfast.scanner.subscriptions.subscription import Subscription
    from holdfast.scanner.subscriptions.tag import Tag

LINE_SETTINGS = ("mode", "baud", "parity", "stop_bits", "data_bits", "silence")
"""What all devices on one serial line have alike."""


@dataclass(frozen=True)
class Change:
    """What a request has changed."""

    device: ScannedDevice | None
    """The device of the request, if it is known."""
    polling: bool = False
    """Whether its polling must change."""
    former: ScannedDevice | None = None
    """The device that `device` replaces, because its address or a setting is another."""
    fresh: Collection[str] = ()
    """The tags whose next values must be published in any case: the subscriber waits for them."""
    only_adds_tags: bool = False
    """Whether a known subscriber has requested only tags that are new."""


class Registry:
    """The devices by id, with their subscribers."""

    def __init__(
        self, limits: ScannerLimits, writes: Writes = "tags", dialect: Dialect = TENTACLE
    ) -> None:
        self.devices: dict[str, ScannedDevice] = {}
        self._limits = limits
        self._writes = writes
        self._dialect = dialect
        self._tags = 0
        self._devices_of_tag: dict[str, set[str]] = {}
        """The ids of the devices that have a tag id."""
        self._tags_by_name: dict[str, set[str]] = {}
        """The tag ids that have another name in subjects, by this name."""
        self._subjects: dict[str, str] = {}
        """The ids of the devices, by their names in subjects."""
        self._devices_by_connection: dict[str, list[str]] = {}
        """The ids of the devices that share a connection, by its address or line."""

    @property
    def tags(self) -> int:
        """The number of tags of all devices."""
        return self._tags

    def known(self, asked: Subscription) -> ScannedDevice | None:
        """Returns the device of a request, if the request does not replace it.

        Raises `Refused` if it would replace a device that others use.
        """
        device = self.devices.get(asked.device)
        if device is None or not _replaces(device, asked):
            return device
        return None

    def fresh(self, asked: Subscription) -> Collection[str]:
        """Returns the tags of a request that its subscriber does not have yet, or not alike."""
        device = self.devices.get(asked.device)
        subscriber = None if device is None else device.subscribers.get(asked.subscriber)
        if device is None or subscriber is None:
            return asked.tags
        return {
            id
            for id, tag in asked.tags.items()
            if id not in subscriber.tags or device.tags[id] != tag
        }

    def subscribe(self, asked: Subscription, address: Target) -> Change:
        """Adds a subscription. Returns what has changed.

        A request without tags adds no subscriber, and no device. Raises `Refused`.
        """
        device = self.devices.get(asked.device)
        new = [id for id in asked.tags if device is None or id not in device.tags]
        source, former = self._check(device, asked, len(new))
        if not asked.tags and (device is None or asked.subscriber not in device.subscribers):
            return Change(device)
        # From here on, nothing is refused any more.
        before = device.rate if device is not None and device.subscribers else None
        fresh = self.fresh(asked)
        if former is not None or asked.publish == "scan" or self._dialect.repeats_values:
            fresh = asked.tags
        only_adds_tags = device is not None and device.is_extended_by(asked.subscriber, asked.tags)
        if device is None or former is not None:
            device = self._new_device(asked, source, address, former)
        subscriber = device.subscribers.setdefault(
            asked.subscriber, Subscriber(asked.rate, "scan", 0.0)
        )
        subscriber.rate = asked.rate
        subscriber.publish = asked.publish
        subscriber.deadband = asked.deadband
        subscriber.ttl = asked.ttl
        redefined = any(device.tags.get(id, tag) != tag for id, tag in asked.tags.items())
        for kept in map(self._shared_tag, asked.tags.values()):
            device.tags[kept.id] = kept
            subscriber.tags[kept.id] = asked.options[kept.id]
        for id in new:
            self._devices_of_tag.setdefault(id, set()).add(device.id)
            if (name := self._dialect.tag_name(id)) != id:
                self._tags_by_name.setdefault(name, set()).add(id)
        self._tags += len(new)
        polling = bool(new) or redefined or device.rate != before
        return Change(device, polling, former, fresh, only_adds_tags)

    def _check(
        self, device: ScannedDevice | None, asked: Subscription, new_tags: int
    ) -> tuple[Source, ScannedDevice | None]:
        """Checks a subscription against all others. Raises `Refused`.

        Returns the source of its device, and the device that it replaces, if any.
        """
        self._check_limits(device, asked, new_tags)
        if device is None:
            self._check_subject(asked.device)
            self._check_shared(asked)
            self._dialect.check_tag_ids((), asked.tags)
            return asked.source, None
        source, former = _merged(device.source, asked), None
        if _replaces(device, asked):
            former = device
            self._check_shared(asked)
        _check_tags(device, asked)
        self._dialect.check_tag_ids(device.tags, asked.tags)
        source.plan.check(list((device.tags | dict(asked.tags)).values()))
        return source, former

    def _shared_tag(self, tag: Tag) -> Tag:
        """Returns the same tag of another device, if there is one: many devices are of one kind."""
        holder = next(iter(self._devices_of_tag.get(tag.id, ())), None)
        known = None if holder is None else self.devices[holder].tags.get(tag.id)
        return known if known is not None and known == tag else tag

    def _new_device(
        self, asked: Subscription, source: Source, address: Target, former: ScannedDevice | None
    ) -> ScannedDevice:
        """Adds a device; with the subscribers and the tags of the one that it replaces, if any."""
        device = ScannedDevice(asked.device, source, address, Health(), self._writes, self._dialect)
        if former is not None:
            device.subscribers, device.tags = dict(former.subscribers), dict(former.tags)
            self._release_connection(former)
        self.devices[device.id] = device
        self._devices_by_connection.setdefault(_connection(source.target), []).append(device.id)
        self._subjects |= dict.fromkeys(_subjects(device), device.id)
        return device

    def unsubscribe(self, request: UnsubscribeRequest) -> tuple[ScannedDevice | None, bool]:
        """Removes tags of a subscriber. Returns the device, and whether its polling must change.

        Removes the device with its last subscriber. Unknown ids are ignored.
        """
        device = self.devices.get(request.device_id)
        subscriber = None if device is None else device.subscribers.get(request.subscriber_id)
        if device is None or subscriber is None:
            return device, False
        before = device.rate
        ids = list(subscriber.tags) if request.ids is None else request.ids
        for id in ids:
            subscriber.tags.pop(id, None)
        if not subscriber.tags:
            del device.subscribers[request.subscriber_id]
        unwanted = device.forget(ids)
        for id in unwanted:
            self._devices_of_tag[id].discard(device.id)
            if not self._devices_of_tag[id]:
                del self._devices_of_tag[id]
                self._forget_name(id)
        self._tags -= len(unwanted)
        if not device.subscribers:
            del self.devices[device.id]
            self._release_connection(device)
            for name in _subjects(device):
                del self._subjects[name]
            return device, True
        return device, bool(unwanted) or device.rate != before

    def commanded(self, name: str) -> tuple[ScannedDevice, Tag]:
        """Returns the tag of a command's name: an id, or device and id. Raises `Refused`."""
        found = {
            (device, id) for id in self._ids(name) for device in self._devices_of_tag.get(id, ())
        }
        # Device ids and tag ids may have dots, so each dot may be the border between them.
        parts = name.split(".")
        for at in range(1, len(parts)):
            device = ".".join(parts[:at])
            for id in self._ids(".".join(parts[at:])):
                for named in {device, self._subjects.get(device, device)}:
                    if named in self._devices_of_tag.get(id, ()):
                        found.add((named, id))
        if not found:
            raise Refused(f"no tag {name!r}")
        if len(found) > 1:
            known = ", ".join(f"{device}.{id}" for device, id in sorted(found))
            raise Refused(f"{name!r} is ambiguous: {known}")
        [(of, id)] = found
        return self.devices[of], self.devices[of].tags[id]

    def _ids(self, name: str) -> set[str]:
        """Returns the tag ids that a command may mean by a name."""
        return {name} | self._tags_by_name.get(name, set())

    def _forget_name(self, id: str) -> None:
        name = self._dialect.tag_name(id)
        ids = self._tags_by_name.get(name, set())
        ids.discard(id)
        if not ids:
            self._tags_by_name.pop(name, None)

    def _check_subject(self, id: str) -> None:
        """Checks that no other device has the same name in subjects. Raises `Refused`."""
        name = subject_id(id)
        other = self._subjects.get(name)
        if other is not None:
            raise Refused(
                f"deviceId {id!r} has the same name in subjects as {other!r}, which is known: "
                f"{name}; give one of them another id"
            )

    def _check_shared(self, asked: Subscription) -> None:
        """Checks that a new device has the settings of the devices that share its connection."""
        target = asked.source.target
        place = _connection(target)
        others = (id for id in self._devices_by_connection.get(place, ()) if id != asked.device)
        id = next(others, None)
        if id is None:
            return
        settings = _settings(target)
        # One is enough: each was compared with the others when it was added.
        for key, known in _settings(self.devices[id].source.target).items():
            if known != settings[key]:
                at = "on one serial line" if isinstance(target, SerialTarget) else "at one address"
                raise Refused(
                    f"{key} of {place} is already {_setting_text(known)} for {id}, "
                    f"not {_setting_text(settings[key])}; devices {at} have the same settings"
                )

    def _release_connection(self, device: ScannedDevice) -> None:
        """Notes that a device does not use its connection any more."""
        place = _connection(device.source.target)
        self._devices_by_connection[place].remove(device.id)
        if not self._devices_by_connection[place]:
            del self._devices_by_connection[place]

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
            raise Refused(f"{asked.device} would have {tags} tags, allowed: {limits.device_tags}")
        if self._tags + new > limits.tags:
            raise Refused(f"there would be {self._tags + new} tags, allowed: {limits.tags}")


def _replaces(device: ScannedDevice, asked: Subscription) -> bool:
    """Returns whether a request changes the address or a setting of a device.

    Raises `Refused` if other subscribers use the device.
    """
    known, requested = device.source, asked.source
    found = ""
    if (known.target, known.unit) != (requested.target, requested.unit):
        found = f"{device.id} is known as {_described(known)}, not as {_described(requested)}"
    else:
        for key in SETTINGS:
            one, other = getattr(known, key), getattr(requested, key)
            if key in asked.given_settings and one != other:
                found = f"{key} of {device.id} is already different: {one}, not {other}"
                break
    if not found:
        return False
    _check_unused(found, [name for name in device.subscribers if name != asked.subscriber])
    return True


def _merged(known: Source, asked: Subscription) -> Source:
    """Returns the source of a request, with the known settings in place of those left out."""
    kept = {key: getattr(known, key) for key in SETTINGS if key not in asked.given_settings}
    return replace(asked.source, **kept)


def _check_tags(device: ScannedDevice, asked: Subscription) -> None:
    """Checks that no other subscriber uses another definition of a tag. Raises `Refused`."""
    for id, wanted in asked.tags.items():
        known = device.tags.get(id)
        if known is not None and known != wanted:
            difference = f"{known}, not {wanted}"
            if str(known) == str(wanted):
                difference = "another encoding or other null values"
            found = f"tag {id!r} of {device.id} already has another definition: {difference}"
            users = [name for name in device.users(id) if name != asked.subscriber]
            _check_unused(found, users)


def _subjects(device: ScannedDevice) -> set[str]:
    """Returns the names of a device in subjects and in kept entries."""
    return {subject_id(device.id), *device.subjects}


def _check_unused(found: str, users: list[str]) -> None:
    """Raises `Refused` if there are other users of something that a request would replace."""
    if users:
        more = f" and {len(users) - 1} more" if len(users) > 1 else ""
        raise Refused(f"{found}; {users[0]}{more} must unsubscribe first")


def _connection(target: Target) -> str:
    """What devices share that have one connection."""
    return target.device if isinstance(target, SerialTarget) else str(target)


def _settings(target: Target) -> dict[str, object]:
    """What devices of one connection have in common."""
    line = LINE_SETTINGS if isinstance(target, SerialTarget) else ()
    return {key: getattr(target, key) for key in line} | asdict(target.tolerance)


def _described(source: Source) -> str:
    """Formats the address of a device with everything that identifies it."""
    target = source.target
    usual: dict[str, object] = asdict(STRICT)
    more = ""
    if isinstance(target, SerialTarget):
        usual["mode"] = target.mode
    elif target.tls.name is not None:
        more = f" with the name {target.tls.name}"
    settings = [
        f"{key} {_setting_text(value)}"
        for key, value in _settings(target).items()
        if key not in usual or value != usual[key]
    ]
    more += f" ({', '.join(settings)})" if settings else ""
    return f"{target}{more} unit {source.unit}"


def _setting_text(setting: object) -> object:
    return "the default" if setting is None else setting

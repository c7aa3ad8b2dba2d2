"""The registry of all subscriptions. A request is carried out completely or not at all.

All checks run before the first change, without an await in between. A `Subscription` is already
checked on its own; the registry checks it against all others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from holdfast.client.url import physical_connection
from holdfast.scanner.dialects import TENTACLE, Dialect
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.subject_parts import subject_id
from holdfast.scanner.messages.types import MAX_DEVICE_ID, MAX_ID
from holdfast.scanner.subscriptions.conflicts import (
    check_settings,
    check_subject,
    check_tags,
    merged,
    replaces,
)
from holdfast.scanner.subscriptions.device import (
    NO_OPTIONS,
    ScannedDevice,
    Source,
    Subscriber,
    TagOptions,
)
from holdfast.scanner.subscriptions.health import Health

if TYPE_CHECKING:
    from collections.abc import Collection

    from holdfast.client.url import Target
    from holdfast.config.values.scanner_settings import Writes
    from holdfast.scanner.messages.types import UnsubscribeRequest
    from holdfast.scanner.subscriptions.request_rules import ScannerLimits
    from holdfast.scanner.subscriptions.subscription import Subscription
    from holdfast.scanner.subscriptions.tag import ScannedTag


@dataclass(frozen=True)
class Change:
    """What a request has changed."""

    device: ScannedDevice | None
    """The device of the request, if it is known."""
    polling: bool = False
    """Whether its polling must change."""
    former: ScannedDevice | None = None
    """The device that `device` replaces, because its address or a setting has changed."""
    new: Collection[str] = ()
    """The tags that are new to the subscriber, or whose definition has changed."""
    fresh: Collection[str] = ()
    """The tags whose next values are published even if unchanged: the subscriber waits for them."""
    only_adds_tags: bool = False
    """Whether a known subscriber requested no tag that the device already had."""


class Registry:
    """The devices by id, with their subscribers."""

    def __init__(
        self, limits: ScannerLimits, writes: Writes = "tags", dialect: Dialect = TENTACLE
    ) -> None:
        self.devices: dict[str, ScannedDevice] = {}
        self._limits = limits
        self._writes = writes
        self._dialect = dialect
        self.tags = 0
        """The number of tags of all devices."""
        self._devices_of_tag: dict[str, set[str]] = {}
        """The ids of the devices that have a tag id."""
        self._tags_by_name: dict[str, set[str]] = {}
        """The tag ids that have another name in subjects, by this name."""
        self._subjects: dict[str, str] = {}
        """The ids of the devices, by their names in subjects."""
        self._devices_by_connection: dict[tuple[str, str], list[str]] = {}
        """The ids of the devices that share a connection, by its address or line."""

    def known(self, subscription: Subscription) -> ScannedDevice | None:
        """Returns the device of a request, if the request does not replace it.

        Raises `Refused` if it would replace a device that others use.
        """
        device = self.devices.get(subscription.device)
        if device is None or not replaces(device, subscription):
            return device
        return None

    def subscribe(self, subscription: Subscription, address: Target) -> Change:
        """Adds a subscription. Returns what has changed.

        A request without tags adds no subscriber, and no device. Raises `Refused`.
        """
        device = self.devices.get(subscription.device)
        added = [id for id in subscription.tags if device is None or id not in device.tags]
        source, former = self._check(device, subscription, len(added))
        # A request without tags only renews: it must not create an empty device or subscriber.
        if not subscription.tags and (
            device is None or subscription.subscriber not in device.subscribers
        ):
            return Change(device)
        # From here on, nothing is refused any more.
        before = device.rate if device is not None and device.subscribers else None
        new = _new_to_subscriber(device, subscription)
        # With `publish: scan`, or with a replaced device, an unchanged value counts as new, too.
        counts_all = former is not None or subscription.publish == "scan"
        fresh = subscription.tags if counts_all or self._dialect.repeats_values else new
        only_adds_tags = device is not None and device.is_extended_by(
            subscription.subscriber, subscription.tags
        )
        if device is None or former is not None:
            device = self._new_device(subscription, source, address, former)
        subscriber = device.subscribers.setdefault(
            subscription.subscriber, Subscriber(subscription.rate, "scan", 0.0)
        )
        subscriber.rate = subscription.rate
        subscriber.publish = subscription.publish
        subscriber.deadband = subscription.deadband
        subscriber.ttl = subscription.ttl
        if subscription.profile is not None or self._dialect.replaces_subscription:
            subscriber.profile = subscription.profile
        redefined = any(device.tags.get(id, tag) != tag for id, tag in subscription.tags.items())
        for tag in map(self._shared_tag, subscription.tags.values()):
            device.tags[tag.id] = tag
            options = subscription.options[tag.id]
            if options is NO_OPTIONS and tag.profile_tag and tag.profile == subscriber.profile:
                options = TagOptions.of_profile(tag.profile_tag)
            subscriber.tags[tag.id] = options
        for id in added:
            self._devices_of_tag.setdefault(id, set()).add(device.id)
            if (name := self._dialect.tag_name(id)) != id:
                self._tags_by_name.setdefault(name, set()).add(id)
        self.tags += len(added)
        polling = bool(added) or redefined or device.rate != before
        return Change(device, polling, former, new, fresh, only_adds_tags)

    def _check(
        self, device: ScannedDevice | None, subscription: Subscription, new_tags: int
    ) -> tuple[Source, ScannedDevice | None]:
        """Checks a subscription against all others. Raises `Refused`.

        Returns the source of its device, and the device that it replaces, if any.
        """
        self._check_limits(device, subscription, new_tags)
        if device is None:
            check_subject(subscription.device, self._subjects)
            self._check_shared(subscription)
            self._dialect.check_tag_ids((), subscription.tags)
            return subscription.source, None
        source, former = merged(device.source, subscription), None
        if replaces(device, subscription):
            # The new address may be on a line or connection that other devices share.
            former = device
            self._check_shared(subscription)
        check_tags(device, subscription)
        self._dialect.check_tag_ids(device.tags, subscription.tags)
        # All tags together, not only the new ones: their blocks are planned together.
        source.plan.check(list((device.tags | dict(subscription.tags)).values()))
        return source, former

    def _shared_tag(self, tag: ScannedTag) -> ScannedTag:
        """Returns an equal tag of another device, if there is one.

        Installations have many devices of one type, so sharing the objects saves most memory.
        """
        holder = next(iter(self._devices_of_tag.get(tag.id, ())), None)
        known = None if holder is None else self.devices[holder].tags.get(tag.id)
        return known if known is not None and known == tag else tag

    def _new_device(
        self,
        subscription: Subscription,
        source: Source,
        address: Target,
        former: ScannedDevice | None,
    ) -> ScannedDevice:
        """Adds a device; with the subscribers and the tags of the one that it replaces, if any."""
        id = subscription.device
        device = ScannedDevice(id, source, address, Health(), self._writes)
        if former is not None:
            device.subscribers, device.tags = dict(former.subscribers), dict(former.tags)
            self._release_connection(former)
        self.devices[device.id] = device
        place = physical_connection(source.target)
        self._devices_by_connection.setdefault(place, []).append(device.id)
        self._subjects |= dict.fromkeys(self._names(id), id)
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
            if subscriber.tags.pop(id, None) and device.tags[id].profile == subscriber.profile:
                subscriber.profile = None  # It has not all of its tags any more.
        if not subscriber.tags:
            del device.subscribers[request.subscriber_id]
        # `forget` keeps the tags that other subscribers use.
        forgotten = device.forget(ids)
        for id in forgotten:
            self._devices_of_tag[id].discard(device.id)
            if not self._devices_of_tag[id]:
                del self._devices_of_tag[id]
                self._forget_name(id)
        self.tags -= len(forgotten)
        if not device.subscribers:
            del self.devices[device.id]
            self._release_connection(device)
            for name in self._names(device.id):
                del self._subjects[name]
            return device, True
        return device, bool(forgotten) or device.rate != before

    def has_subjects_of(self, device_id: str) -> bool:
        """Returns whether a known device has a name in subjects that this one would have."""
        return not self._names(device_id).isdisjoint(self._subjects)

    def named(self, name: str) -> ScannedDevice | None:
        """Returns the device with a name in subjects, if there is one."""
        id = self._subjects.get(name)
        return None if id is None else self.devices[id]

    def commanded(self, name: str) -> tuple[ScannedDevice, ScannedTag]:
        """Returns the tag of a command's name: an id, or device and id. Raises `Refused`."""
        if len(name) > MAX_DEVICE_ID + len(".") + MAX_ID:
            raise Refused(f"no tag has a name of {len(name)} characters")
        matches = {
            (device, id) for id in self._ids(name) for device in self._devices_of_tag.get(id, ())
        }
        # Device ids and tag ids may have dots, so each dot may separate the two.
        dot = -1
        while (dot := name.find(".", dot + 1)) >= 0:
            device = name[:dot]
            for id in self._ids(name[dot + 1 :]):
                for named in {device, self._subjects.get(device, device)}:
                    if named in self._devices_of_tag.get(id, ()):
                        matches.add((named, id))
        if not matches:
            raise Refused(f"no tag {name!r}")
        if len(matches) > 1:
            known = ", ".join(f"{device}.{id}" for device, id in sorted(matches))
            raise Refused(f"{name!r} is ambiguous: {known}")
        [(device_id, id)] = matches
        return self.devices[device_id], self.devices[device_id].tags[id]

    def _names(self, device_id: str) -> set[str]:
        """Returns the names of a device in subjects and in stored entries."""
        return {subject_id(device_id), *self._dialect.device_names(device_id)}

    def _ids(self, name: str) -> set[str]:
        """Returns the tag ids that a command may mean by a name."""
        return {name} | self._tags_by_name.get(name, set())

    def _forget_name(self, id: str) -> None:
        name = self._dialect.tag_name(id)
        ids = self._tags_by_name.get(name, set())
        ids.discard(id)
        if not ids:
            self._tags_by_name.pop(name, None)

    def _check_shared(self, subscription: Subscription) -> None:
        """Checks that a device has the settings of others on its connection. Raises `Refused`."""
        target = subscription.source.target
        sharing = self._devices_by_connection.get(physical_connection(target), ())
        # One is enough: each was compared with the others when it was added.
        other = next((id for id in sharing if id != subscription.device), None)
        if other is not None:
            check_settings(target, self.devices[other])

    def _release_connection(self, device: ScannedDevice) -> None:
        """Notes that a device does not use its connection any more."""
        place = physical_connection(device.source.target)
        self._devices_by_connection[place].remove(device.id)
        if not self._devices_by_connection[place]:
            del self._devices_by_connection[place]

    def _check_limits(
        self, device: ScannedDevice | None, subscription: Subscription, new: int
    ) -> None:
        limits = self._limits
        if device is None and len(self.devices) >= limits.devices:
            raise Refused(f"there are already {limits.devices} devices, which is the limit")
        subscribers = {} if device is None else device.subscribers
        if subscription.subscriber not in subscribers and len(subscribers) >= limits.subscribers:
            raise Refused(
                f"{subscription.device} already has {limits.subscribers} subscribers, "
                "which is the limit"
            )
        tags = new + (0 if device is None else len(device.tags))
        if tags > limits.device_tags:
            raise Refused(
                f"{subscription.device} would have {tags} tags, allowed: {limits.device_tags}"
            )
        if self.tags + new > limits.tags:
            raise Refused(f"there would be {self.tags + new} tags, allowed: {limits.tags}")


def _new_to_subscriber(device: ScannedDevice | None, subscription: Subscription) -> Collection[str]:
    subscriber = None if device is None else device.subscribers.get(subscription.subscriber)
    if device is None or subscriber is None:
        return subscription.tags
    return {
        id
        for id, tag in subscription.tags.items()
        if id not in subscriber.tags or device.tags[id] != tag
    }

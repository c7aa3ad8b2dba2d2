"""What a request may not change, because other subscribers or devices use it.

A device has one address and one set of settings, a tag has one definition, and devices on one line
or at one address share their settings. A subscriber may change what nobody else uses.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from holdfast.client.serial_settings import SerialTarget
from holdfast.client.tolerance import STRICT
from holdfast.client.url import shared_options
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.subject_parts import subject_id
from holdfast.scanner.subscriptions.subscription import SETTINGS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.client.url import Target
    from holdfast.scanner.subscriptions.device import ScannedDevice, Source
    from holdfast.scanner.subscriptions.subscription import Subscription


def replaces(device: ScannedDevice, subscription: Subscription) -> bool:
    """Returns whether a request changes the address or a setting of a device.

    Raises `Refused` if other subscribers use the device.
    """
    known, requested = device.source, subscription.source
    conflict = ""
    if (known.target, known.unit) != (requested.target, requested.unit):
        conflict = f"{device.id} is known as {_described(known)}, not as {_described(requested)}"
    else:
        for key in SETTINGS:
            known_value, requested_value = getattr(known, key), getattr(requested, key)
            if key in subscription.given_settings and known_value != requested_value:
                found = f"is {known_value} for other subscribers, not {requested_value}"
                conflict = f"{key} of {device.id} {found}"
                break
    if not conflict:
        return False
    _check_unused(
        conflict, [name for name in device.subscribers if name != subscription.subscriber]
    )
    return True


def merged(known: Source, subscription: Subscription) -> Source:
    """Returns the source of a request, with the known settings in place of those left out."""
    known_settings = {
        key: getattr(known, key) for key in SETTINGS if key not in subscription.given_settings
    }
    return replace(subscription.source, **known_settings)


def check_tags(device: ScannedDevice, subscription: Subscription) -> None:
    """Checks that no other subscriber uses another definition of a tag. Raises `Refused`."""
    for id, definition in subscription.tags.items():
        known = device.tags.get(id)
        if known is not None and known != definition:
            difference = f"{known}, not {definition}"
            # The text of a tag has neither its encoding nor its null values.
            if str(known) == str(definition):
                difference = "another encoding or other null values"
            conflict = f"tag {id!r} of {device.id} already has another definition: {difference}"
            users = [name for name in device.users(id) if name != subscription.subscriber]
            _check_unused(conflict, users)


def check_subject(id: str, owners: Mapping[str, str]) -> None:
    """Checks that no other device has the same name in subjects. Raises `Refused`.

    `owners` are the ids of devices by their names in subjects.
    """
    name = subject_id(id)
    if name in owners:
        raise Refused(
            f"deviceId {id!r} has the same name in subjects as {owners[name]!r}, which is known: "
            f"{name}; give one of them another id"
        )


def check_settings(target: Target, other: ScannedDevice) -> None:
    """Raises `Refused` if a target and a device on the same connection differ in settings."""
    settings, shared = shared_options(target), other.source.target
    names = [each.device for each in (target, shared) if isinstance(each, SerialTarget)]
    if len(set(names)) > 1:
        # The poller would open the line once for each name, and only the first can have it.
        message = f"{names[0]} and {names[1]} are one serial line"
        raise Refused(f"{message}, and {other.id} uses {names[1]}: use {names[1]}")
    for key, known in shared_options(shared).items():
        if known != settings[key]:
            at = "on one serial line" if isinstance(target, SerialTarget) else "at one address"
            raise Refused(
                f"{key} of {shared} is already {_setting_text(known)} for "
                f"{other.id}, not {_setting_text(settings[key])}; devices {at} have the same "
                "settings"
            )


def _check_unused(conflict: str, users: list[str]) -> None:
    """Raises `Refused` if there are other users of something that a request would replace."""
    if users:
        more = f" and {len(users) - 1} more" if len(users) > 1 else ""
        raise Refused(f"{conflict}; {users[0]}{more} must unsubscribe first")


def _described(source: Source) -> str:
    """Formats the address of a device with everything that identifies it."""
    target = source.target
    usual: dict[str, object] = asdict(STRICT)
    more = ""
    if isinstance(target, SerialTarget):
        usual |= {"mode": target.mode, "rs485": None}
    elif target.tls.name is not None:
        more = f" with the name {target.tls.name}"
    settings = [
        f"{key} {_setting_text(value)}"
        for key, value in shared_options(target).items()
        if key not in usual or value != usual[key]
    ]
    more += f" ({', '.join(settings)})" if settings else ""
    return f"{target}{more} unit {source.unit}"


def _setting_text(setting: object) -> str:
    return "the default" if setting is None else str(setting)

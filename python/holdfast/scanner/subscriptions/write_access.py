"""Which tags may be written, by the setting `nats.writes` and by their subscribers. Does no I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.protocol import WRITE_LIMITS
from holdfast.scanner.subscriptions.tag import CODE_OF_AREA
from holdfast.tags import writing
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.config.values.scanner_settings import Writes
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.tag import ScannedTag

TAGS: dict[Writes, str] = {
    "tags": 'every subscribed coil and holding register without "writable": false',
    "explicit": 'subscribed coils and holding registers with "writable": true',
    "none": "none: all commands are refused",
}
"""Which tags may be written with each setting, in words."""

NARROWER: dict[Writes, str] = {
    "tags": "nats.writes (--writes): explicit or none",
    "explicit": "nats.writes (--writes): none",
}
"""What else each setting could be that allows less."""


def unwritable(device: ScannedDevice, tag: ScannedTag) -> str | None:
    """Returns why a tag of a device can't be written; `None` if it can.

    A subscriber that declares it writable decides, then one that declares it read-only.
    """
    if (flaw := read_only(tag)) is not None:
        return flaw
    if tag.profile_tag is not None and not tag.profile_tag.writable:
        return f"writable is not true in the profile {tag.profile}"
    if device.writes == "none":
        return "this scanner writes nothing (nats.writes is none)"
    choices = {
        user: device.subscribers[user].tags[tag.id].writable for user in device.users(tag.id)
    }
    if True in choices.values():
        return None
    if device.writes == "explicit":
        return 'no subscriber set "writable": true, which nats.writes: explicit requires'
    return next(
        (f'{user} set "writable": false' for user, each in choices.items() if each is False),
        None,
    )


def read_only(tag: ScannedTag) -> str | None:
    """Returns why no Modbus request can write a tag; `None` if one can."""
    if tag.area not in WRITE_LIMITS:
        return f"functionCode {CODE_OF_AREA[tag.area]} is not writable"
    return writing.unwritable(tag.area, parsed(tag.type), tag.requested_type)


def described(writes: Writes, places: str, subjects: Iterable[str]) -> dict[str, str]:
    """Returns which tags may be written, at which addresses, by whom, and what narrows it."""
    if writes == "none":
        return {"tags": TAGS[writes], "set_by": "nats.writes (--writes): none"}
    return {
        "tags": TAGS[writes],
        "devices": places,
        "by": f"every NATS client that may publish to {', '.join(subjects)}",
        "narrowed_by": f"{NARROWER[writes]}; nats.devices (--allow); permissions in NATS",
    }

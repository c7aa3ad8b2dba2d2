"""Commands: a value, given as text, is written to coils or holding registers of a device.

`Registry.commanded` says which tag a name means, `fleet.nodes` how long a command waits for another
node of a fleet.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from holdfast.client.requests import write_typed
from holdfast.errors import NOT_EXECUTED
from holdfast.events import log_lines
from holdfast.polling.faults import (
    EXPIRED,
    NO_CONNECTION,
    STANDBY,
    UNREACHABLE,
    WITHDRAWN,
    fault_text,
)
from holdfast.scanner.errors import Moved, NotConfirmed, Refused
from holdfast.scanner.late_commands import SEND_AGAIN, Lateness
from holdfast.scanner.messages.types import Answer
from holdfast.scanner.subscriptions.write_access import unwritable
from holdfast.tags.strict_text import from_text
from holdfast.tags.text import value_from
from holdfast.values import ConversionError, encode
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from collections.abc import Callable

    from nats.aio.msg import Msg

    from holdfast.scanner.dialects import Dialect
    from holdfast.scanner.placement import Placement
    from holdfast.scanner.polling.poller import Polling
    from holdfast.scanner.responder import Responder
    from holdfast.scanner.settings import Settings
    from holdfast.scanner.subscriptions.registry import Registry
    from holdfast.scanner.subscriptions.tag import ScannedTag

NOT_WRITTEN_FAULTS = (*NOT_EXECUTED, NO_CONNECTION, UNREACHABLE, STANDBY, EXPIRED, WITHDRAWN)
"""Faults of a write that the device certainly has not carried out."""

MOVED = f"not written: {fault_text(STANDBY)}"


def register_value(text: str, tag: ScannedTag) -> Any:
    """What the registers have to hold for a value, given as text. Raises `Refused`."""
    try:
        if tag.profile_tag is None:
            made = from_text(text, parsed(tag.type), tag.requested_type)
        else:
            made = tag.profile_tag.raw(value_from(tag.profile_tag, text))
    except ValueError as error:
        raise Refused(str(error)) from None
    try:
        encode(made, tag.type, tag.order, encoding=tag.encoding)
    except ConversionError as error:
        raise Refused(str(error).replace(tag.type, tag.requested_type)) from None
    return made


@dataclass(eq=False)
class Commands:
    """Handles the commands of callers, and those that other nodes of a fleet have received."""

    _settings: Settings
    _dialect: Dialect
    _registry: Registry
    _polling: Polling
    _placement: Placement
    _responder: Responder

    def __post_init__(self) -> None:
        self.lateness = Lateness(self._settings.standstill_s)

    async def command(self, message: Msg) -> Answer:
        """Writes to a device of the scanner, or of its fleet. Raises `Refused`."""
        name = message.subject.removeprefix(f"{self._settings.prefix}.")
        name = name.removeprefix("module.").removeprefix("command.")
        max_bytes = self._settings.limits.command
        if len(message.data) > max_bytes:
            raise Refused(f"the value has {len(message.data)} bytes, allowed: {max_bytes}")
        text = self._dialect.command_text(message.data)
        async with self._responder.in_order(message):
            device, tag = self._registry.commanded(name)
        remaining_s = partial(self.remaining_s, message)
        own = partial(self.write, device.id, tag.id, text)
        await self._placement.write(device, tag, text, own, remaining_s)
        return Answer(success=True)

    def remaining_s(self, message: Msg) -> float:
        """Returns how many seconds a command may wait now. Raises `Refused` if it is too late."""
        return self.lateness.check(message)

    async def write(
        self, device_id: str, tag_id: str, text: str, remaining_s: Callable[[], float]
    ) -> None:
        """Writes a value, given as text. Returns when the device has confirmed it.

        `remaining_s` is called at the last moment: it refuses what is too late, and returns how
        many seconds the write may wait for the device. Raises `Refused`, and `Moved` if another
        node has the device.
        """
        # A tag may have been moved to another register by a request that another node has answered.
        await self._placement.refresh(device_id)
        # No await from here to `Polling.write`, so that commands to a device stay in order.
        # Looked up again: the device may have been replaced while the command waited.
        device = self._registry.devices.get(device_id)
        if device is None or tag_id not in device.tags:
            raise Refused(f"no tag {tag_id!r} of {device_id}")
        if not self._placement.takes_writes(device):
            raise Moved(MOVED)
        tag = device.tags[tag_id]
        if (flaw := unwritable(device, tag)) is not None:
            raise Refused(f"tag {tag.id!r} of {device.id} is not writable: {flaw}")
        made = register_value(text, tag)
        try:
            [request] = write_typed(
                tag.area, tag.address, made, tag.type, tag.order, tag.encoding, split=False
            )
        except ValueError as error:
            raise Refused(f"not written: {error}") from None
        fault = await self._polling.write(device, request, within=remaining_s())
        if fault == STANDBY:  # Its fence is closed, so nothing was sent.
            raise Moved(MOVED)
        if fault:
            if fault not in NOT_WRITTEN_FAULTS:
                raise NotConfirmed(f"not confirmed: {fault_text(fault)}")
            again = f"; {SEND_AGAIN}" if fault == EXPIRED else ""
            raise Refused(f"not written: {fault_text(fault)}{again}")
        log_lines.write(logging.INFO, "tag_written", device=device.id, tag=tag.id)

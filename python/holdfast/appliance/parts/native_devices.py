"""Creates the polled devices of a configuration.

Nothing is started here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast import _core
from holdfast.appliance.parts.mirror_place import place_of
from holdfast.appliance.parts.native_links import endpoint_at
from holdfast.config import read_plans
from holdfast.types import AREAS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast._core import Memory
    from holdfast.appliance.parts.part import Plan
    from holdfast.appliance.parts.tag_values import TaggedDevice
    from holdfast.config.models.devices import (
        BlockConfig,
        ForwardConfig,
        ReadConfig,
        StatusConfig,
    )
    from holdfast.types import Area, Forward, StatusBlock


def device(
    name: str,
    plan: Plan,
    receiver: _core.PollReceiver | None,
    tagged: TaggedDevice | None,
    fence: _core.Fence | None = None,
) -> _core.PolledDevice:
    """Creates the native poller's device of that name. Raises `OSError` for unusable files.

    `receiver` takes the polls of a device that is `tagged`. A `fence` stops polls while it is
    closed.
    """
    config, memories = plan.config, plan.memories
    settings = config.devices[name]
    status = settings.status
    assert settings.interval is not None, "a device that is polled has an interval"
    return _core.PolledDevice(
        name,
        endpoint_at(f"devices.{name}.url", settings.target),
        unit=settings.unit,
        interval=settings.interval,
        timeout=settings.timeout,
        reads=[
            (read.area, read.address, read.count, _place(read, plan)) for read in settings.reads
        ],
        forward=[
            (
                endpoint_at(f"devices.{name}.forward[{index}].url", each.receiver),
                _forward(name, each),
            )
            for index, each in enumerate(settings.forward)
        ],
        status=None if status is None else (memories[status.memory], _block(name, status)),
        in_flight=None if settings.in_flight == "auto" else settings.in_flight,
        retry=settings.retry.pauses,
        measured=settings.max_gap == "auto",
        receiver=None if tagged is None else receiver,
        reported_as=None if tagged is None else tagged.reported_as,
        fields=None if tagged is None else list(tagged.reader.fields),
        fence=fence,
        **read_plans.rules(settings),
    )


def _forward(device: str, settings: ForwardConfig) -> Forward:
    """The packets for a receiver, as the native poller has them."""
    status = settings.status
    return (
        settings.format,
        settings.crc or "required",
        settings.target,
        settings.timeout,
        [(area, getattr(settings.offsets, area)) for area in AREAS],
        None if status is None else (settings.status_target, _block(device, status)),
    )


def _block(device: str, settings: BlockConfig) -> StatusBlock:
    """The status block of a device, as the native poller has it."""
    name = device if settings.name is None else settings.name
    return settings.area, settings.slot, name, settings.keep_last_error


def show_disabled(name: str, status: StatusConfig, memories: Mapping[str, Memory]) -> None:
    """Writes the status block of a device that is not polled."""
    _core.write_disabled_status(memories[status.memory], _block(name, status))


def _place(read: ReadConfig, plan: Plan) -> tuple[Memory, Area, int, _core.MirrorAge | None] | None:
    if (into := read.into) is None:
        return None
    age = plan.ages.get(place_of(into, read.count))
    return plan.memories[into.memory], into.area, into.address, age

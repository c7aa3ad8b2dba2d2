"""Creates the native links, routes and polled devices of a configuration.

Nothing is started here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast import _core
from holdfast.client.endpoint import endpoint, receiver_endpoint
from holdfast.client.url import Receiver
from holdfast.config import read_plans
from holdfast.config.checks.units import routed
from holdfast.polling.readings import Reader
from holdfast.types import AREAS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast._core import Memory
    from holdfast.client.url import Target
    from holdfast.config import Config
    from holdfast.config.models.devices import (
        BlockConfig,
        DestinationConfig,
        ForwardConfig,
        StatusConfig,
    )
    from holdfast.types import Area, Forward, StatusBlock

FIRST_POLL_SPREAD_S = 10.0
"""The time over which the first polls of devices are spread; at most the polling interval."""


@dataclass(frozen=True)
class Links:
    """What listeners pass requests on to."""

    links: dict[str, _core.Link] = field(default_factory=dict)
    """By name; a link without a name of its own has that of the first device behind it."""
    routes: dict[str, _core.Route] = field(default_factory=dict)
    """By the name of the link or device."""
    passages: dict[str, _core.Passage] = field(default_factory=dict)
    """By the name of the memory."""


def links(config: Config, memories: Mapping[str, Memory], poller: _core.Poller) -> Links:
    """Creates all links, routes and passages. Raises `OSError` for unusable files.

    The first use of an address decides the settings of its connection, so links come first, and
    polled devices later.
    """
    made = Links()
    for name, settings in config.links.items():
        link = poller.link(
            name,
            _endpoint(f"links.{name}.url", settings.target),
            in_flight=None if settings.in_flight == "auto" else settings.in_flight,
            queue=settings.queue,
            coalesce=settings.coalesce,
            cache=settings.cache,
            preferred=list(settings.priority),
            retry=settings.retry.pauses,
        )
        made.links[name] = link
        made.routes[name] = link.route(name, timeout=settings.timeout)
    for name in routed(config):
        if name not in config.devices:
            continue
        device = config.devices[name]
        link = poller.link(
            name,
            _endpoint(f"devices.{name}.url", device.target),
            in_flight=None if device.in_flight == "auto" else device.in_flight,
            retry=device.retry.pauses,
        )
        made.links.setdefault(link.name, link)
        made.routes[name] = link.route(name, unit=device.unit, timeout=device.timeout)
    passed: dict[str, list[tuple[Area, int, int, str, int, bool]]] = {}
    for name, device in config.devices.items():
        for read, into in device.passed:
            ranges = passed.setdefault(into.memory, [])
            ranges.append((into.area, into.address, read.count, name, read.address, device.emulate))
    for name, ranges in passed.items():
        made.passages[name] = poller.passage(memories[name], ranges)
    return made


def device(
    name: str,
    config: Config,
    memories: Mapping[str, Memory],
    report: _core.Results | None,
    fence: _core.Fence | None = None,
) -> _core.PolledDevice:
    """Creates the native poller's device of that name. Raises `OSError` for unusable files.

    `report` takes the polls of devices with tags. A `fence` stops polls while it is closed.
    """
    settings = config.devices[name]
    fields = Reader(name, config.tags(name)).fields
    status = settings.status
    assert settings.interval is not None, "a device that is polled has an interval"
    return _core.PolledDevice(
        name,
        _endpoint(f"devices.{name}.url", settings.target),
        unit=settings.unit,
        interval=settings.interval,
        timeout=settings.timeout,
        reads=[
            (read.area, read.address, read.count, _place(read.into, memories))
            for read in settings.reads
        ],
        forward=[
            (
                _endpoint(f"devices.{name}.forward[{index}].url", each.receiver),
                _forward(name, each),
            )
            for index, each in enumerate(settings.forward)
        ],
        status=None if status is None else (memories[status.memory], _block(name, status)),
        start_within=min(settings.interval, FIRST_POLL_SPREAD_S),
        in_flight=None if settings.in_flight == "auto" else settings.in_flight,
        retry=settings.retry.pauses,
        measured=settings.max_gap == "auto",
        report=report if fields else None,
        fields=fields,
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


def _endpoint(key: str, of: Target | Receiver) -> _core.Endpoint:
    """The native endpoint of the URL at this key. Raises `OSError` for unusable files."""
    try:
        return receiver_endpoint(of) if isinstance(of, Receiver) else endpoint(of)
    except (OSError, ValueError) as error:
        raise OSError(f"{key}: {error}") from error


def _place(
    into: DestinationConfig | None, memories: Mapping[str, Memory]
) -> tuple[Memory, Area, int] | None:
    return None if into is None else (memories[into.memory], into.area, into.address)

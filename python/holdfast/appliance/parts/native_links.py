"""Creates the native links and routes of a configuration, and names the links.

Nothing is started here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast import _core
from holdfast.client.endpoint import endpoint, receiver_endpoint
from holdfast.client.url import Receiver, shared_connection
from holdfast.config.checks.units import routed

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast._core import Memory
    from holdfast.client.url import Target
    from holdfast.config import Config
    from holdfast.types import Area


@dataclass(frozen=True)
class Links:
    """What listeners pass requests on to."""

    links: dict[str, _core.Link] = field(default_factory=dict)
    """By name; a link without a name of its own has that of the first device behind it."""
    routes: dict[str, _core.Route] = field(default_factory=dict)
    """By the name of the link or device."""
    withdrawals: dict[str, _core.Withdrawal] = field(default_factory=dict)
    """The same: of these routes, and of those before whose devices stay."""
    passages: dict[str, _core.Passage] = field(default_factory=dict)
    """By the name of the memory."""
    waits: dict[_core.Link, float] = field(default_factory=dict)
    """How many seconds clients of the routes of a link wait for a reply, at most."""

    def add_route(self, name: str, link: _core.Link, timeout: float, unit: int | None) -> None:
        """Adds the route of a link or device. The first one names the link.

        A link that is in use already may have had another name before a reload.
        """
        own = self.withdrawals.setdefault(name, _core.Withdrawal())
        self.routes[name] = link.route(name, unit=unit, timeout=timeout, withdrawal=own)
        if link not in self.waits:
            self.links[name] = link
        self.waits[link] = max(timeout, self.waits.get(link, 0.0))

    def limit_waits(self, before: Mapping[str, _core.Link]) -> None:
        """Limits the calls of the gateway on all links, instead of those `before`."""
        for link in before.values():
            link.set_longest_wait(None)
        for link, wait in self.waits.items():
            link.set_longest_wait(wait)


def destination(config: Config, route: str) -> object:
    """The device or line that the route of that name leads to, also if no listener uses it."""
    if route in config.links:
        return shared_connection(config.links[route].target)
    device = config.devices.get(route)
    return None if device is None else (shared_connection(device.target), device.unit)


def links(
    config: Config,
    memories: Mapping[str, Memory],
    poller: _core.Poller,
    withdrawals: Mapping[str, _core.Withdrawal],
) -> Links:
    """Creates all links, routes and passages. Raises `OSError` for unusable files.

    `withdrawals` are those of routes in use whose devices stay.

    The first use of an address decides the settings of its connection, so links come first, and
    polled devices later.
    """
    made = Links(withdrawals=dict(withdrawals))
    for name, settings in config.links.items():
        link = poller.link(
            endpoint_at(f"links.{name}.url", settings.target),
            in_flight=None if settings.in_flight == "auto" else settings.in_flight,
            queue=settings.queue,
            coalesce=settings.coalesce,
            cache=settings.cache,
            preferred=list(settings.priority),
            retry=settings.retry.pauses,
        )
        made.add_route(name, link, settings.timeout, None)
    for name in routed(config):
        if name not in config.devices:
            continue
        device = config.devices[name]
        link = poller.link(
            endpoint_at(f"devices.{name}.url", device.target),
            in_flight=None if device.in_flight == "auto" else device.in_flight,
            retry=device.retry.pauses,
        )
        made.add_route(name, link, device.timeout, device.unit)
    passed: dict[str, list[tuple[Area, int, int, str, int, bool]]] = {}
    for name, device in config.devices.items():
        for read, into in device.passed:
            ranges = passed.setdefault(into.memory, [])
            ranges.append((into.area, into.address, read.count, name, read.address, device.emulate))
    for name, ranges in passed.items():
        made.passages[name] = poller.passage(memories[name], ranges)
    return made


def endpoint_at(key: str, of: Target | Receiver) -> _core.Endpoint:
    """The native endpoint of the URL at this key. Raises `OSError` for unusable files."""
    try:
        return receiver_endpoint(of) if isinstance(of, Receiver) else endpoint(of)
    except (OSError, ValueError) as error:
        raise OSError(f"{key}: {error}") from error

"""The model of links: connections and serial lines that listeners pass requests on to."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from holdfast._core import LINK_QUEUE, MAX_LINK_QUEUE
from holdfast.client.base import DEFAULT_TIMEOUT_S
from holdfast.client.url import Target, parse
from holdfast.config.models.base import Model
from holdfast.config.models.devices import InFlight, RetryConfig, ToleranceConfig, tolerating
from holdfast.config.values.scalars import (
    PEER_KEYS,
    DeviceUrl,
    Duration,
    DurationOrZero,
    NotNull,
    PeerAddress,
)


class LinkConfig(Model):
    """A connection or serial line with any number of devices behind it."""

    url: DeviceUrl
    """The URL of the devices, or of the gateway in front of them."""
    timeout: Duration = DEFAULT_TIMEOUT_S
    """Seconds for a request and its reply."""
    in_flight: InFlight = 1
    """The most requests in flight, over TCP; auto: more while replies stay fast."""
    tolerance: Annotated[ToleranceConfig | None, NotNull()] = None
    """How to treat devices that deviate from the standard; replaces the same options in the URL."""
    retry: RetryConfig = RetryConfig()
    """When devices that can't be reached or do not answer are tried again."""
    queue: Annotated[int, Field(ge=1, le=MAX_LINK_QUEUE)] = LINK_QUEUE
    """The most requests that wait; more are answered with exception 06."""
    priority: dict[PeerAddress, Literal["high"]] = Field(default={}, json_schema_extra=PEER_KEYS)
    """Clients whose reads go before those of others, by IP address."""
    coalesce: bool = True
    """Whether identical reads that wait at the same time are answered by one request."""
    cache: DurationOrZero = 0.0
    """Seconds for which a reply answers identical reads; 0: none."""

    @property
    def target(self) -> Target:
        """The parts of the URL."""
        return tolerating(parse(self.url), self.tolerance)

"""The messages of the service: requests, answers and published messages.

A type has the checks of single keys. `decoding` applies them. Checks that need the state of the
scanner are in other modules.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from msgspec import Meta

from holdfast.config.values.scanner_settings import Publish
from holdfast.net.addresses import LAST_PORT
from holdfast.protocol import LAST_ADDRESS, MAX_UNIT, READ_BITS, READ_REGISTERS
from holdfast.types import Area, Transport

FunctionCode = Literal["coil", "discrete", "holding", "input"]
State = Literal["connecting", "online", "offline"]
Quality = Literal["good", "bad", "uncertain"]
DataType = Literal["number", "boolean", "string", "array"]

MAX_DEVICE_ID = 128
MAX_ID = 256
DeviceId = Annotated[str, Meta(min_length=1, max_length=MAX_DEVICE_ID)]
Id = Annotated[str, Meta(min_length=1, max_length=MAX_ID)]
Address = Annotated[int, Meta(ge=0, le=LAST_ADDRESS)]
Range = Annotated[list[FunctionCode | Address], Meta(min_length=2, max_length=3)]
Ranges = Annotated[list[Range], Meta(max_length=32)]
Word = Annotated[str, Meta(max_length=64)]
"""The name of a type, an order or an encoding."""
Marker = bool | int | float | str

MAX_DESCRIPTION = 4096
"""The most characters of a description."""

MAX_TTL_S = 31_536_000
"""The longest `ttl` in seconds: a year."""

YEAR_3000_MS = 32_503_680_000_000
"""In milliseconds since 1970. Windows has no later dates."""


class _Message(msgspec.Struct, rename="camel"):
    """A message with keys in camel case."""


class Request(_Message, forbid_unknown_fields=True):
    """A request of a caller."""


class TagRequest(Request):
    """A tag: the address and the type of a value of a device."""

    id: Id
    address: Address
    """Counted from 0."""
    function_code: FunctionCode
    datatype: Word
    """`boolean`, `int16`, `float32`, `string:10` and every other type of `holdfast.values`."""
    byte_order: Word | None = None
    """Default: the byte order of the device."""
    encoding: Word | None = None
    """The encoding of `string:N`. Default: ASCII."""
    writable: bool | None = None
    """Default: writable, in areas that can be written."""
    description: Annotated[str, Meta(max_length=MAX_DESCRIPTION)] | None = None
    null: Annotated[list[Marker], Meta(max_length=32)] | None = None
    """Values that mean "not available"; they are published as `null`."""
    profile: Id | None = None
    """A profile of the configuration, whose tag of this id applies in place of all else but
    `description` and a `writable` of false."""


class PlanRequest(Request, rename=None):
    """How the tags of a device are combined into Modbus requests."""

    max_gap: Annotated[int, Meta(ge=0, le=LAST_ADDRESS)] | None = None
    """The largest gap between tags that one request reads too. Default: 10."""
    max_registers: Annotated[int, Meta(ge=1, le=READ_REGISTERS)] | None = None
    max_bits: Annotated[int, Meta(ge=1, le=READ_BITS)] | None = None
    readable: Ranges | None = None
    """Ranges of readable addresses: `[area, first, last]`, or `[first, last]` for all areas. Gaps
    are read only inside these ranges."""
    forbidden: Ranges | None = None
    """Ranges of addresses that are never read, in the same form."""


class SubscribeRequest(Request):
    """Subscribes to tags of a device."""

    device_id: DeviceId
    subscriber_id: Id
    tags: list[TagRequest]
    profile: Id | None = None
    """A profile of the configuration: all its tags, besides those of `tags`."""
    host: Annotated[str, Meta(min_length=1, max_length=253)] | None = None
    port: Annotated[int, Meta(ge=1, le=LAST_PORT)] | None = None
    """Default: 502, with `tls` 802."""
    transport: Transport | None = None
    """Default: `tcp`."""
    url: Annotated[str, Meta(max_length=512)] | None = None
    """Replaces host, port and transport."""
    unit_id: Annotated[int, Meta(ge=0, le=MAX_UNIT)] | None = None
    """Default: 1."""
    byte_order: Word | None = None
    """Default: `ABCD`. `big` is `ABCD`, `little` is `DCBA`."""
    scan_rate: int | None = None
    """The scan interval in milliseconds. Default: 1000."""
    timeout: int | None = None
    """The timeout of a Modbus request in milliseconds. Default: 3000."""
    publish: Publish | None = None
    """Default: `scan`."""
    deadband: Annotated[float, Meta(ge=0)] | None = None
    """With `change`: the change of a number must be greater than this. Default: 0."""
    plan: PlanRequest | None = None
    release: bool | None = None
    """Whether the connection is closed after each scan."""
    ttl: Annotated[int, Meta(ge=1, le=MAX_TTL_S)] | None = None
    """Seconds after which the subscription ends, unless a request renews it. Default: it stays."""


class UnsubscribeRequest(Request):
    """Ends a subscription, or removes tags from it."""

    device_id: DeviceId
    subscriber_id: Id
    tag_ids: list[str] | Literal["all"] | None = None
    """Unknown ids are ignored. `all` is all tags of the subscriber. Required with dialect
    `tentacle`; otherwise the default is `all`."""

    @property
    def ids(self) -> list[str] | None:
        """The ids of the tags; `None` for all of the subscriber."""
        return None if self.tag_ids == "all" else self.tag_ids


SubscriptionRequest: TypeAlias = SubscribeRequest | UnsubscribeRequest


class BrowseRequest(Request):
    """Requests a report of devices. An empty message requests all devices."""

    device_id: str | None = None
    offset: Annotated[int, Meta(ge=0)] | None = None
    """The number of devices to skip."""
    tag_offset: Annotated[int, Meta(ge=0)] | None = None
    """The number of tags of `deviceId` to skip."""


class VariablesRequest(Request):
    """Requests the latest values. An empty message requests those of all devices."""

    device_id: str | None = None
    offset: Annotated[int, Meta(ge=0)] | None = None
    """The number of tags to skip."""


class ShutdownRequest(Request):
    """Ends one node of a fleet."""

    node: str


class Answer(_Message, omit_defaults=True):
    """The answer to a request."""

    success: bool
    count: int | None = None
    """The number of tags in a subscribe request."""
    error: str | None = None


class Data(_Message):
    """A value of a tag. Values that JSON can't represent, such as NaN, are `null`."""

    module_id: str
    device_id: str
    variable_id: str
    value: bool | int | float | str | list[Any] | None
    datatype: DataType
    timestamp: int
    """Time of the device's response, in milliseconds since 1970."""


class Status(_Message, omit_defaults=True):
    """A change of the state of a device."""

    device_id: str
    state: State
    failures: int
    """The number of consecutive scans without a response."""
    timestamp: int
    error: str | None = None


class Heartbeat(_Message):
    """A heartbeat of the service."""

    service_type: str
    module_id: str
    last_seen: int
    started_at: int
    metadata: HeartbeatMetadata


class HeartbeatMetadata(_Message, omit_defaults=True):
    """What a heartbeat reports of the service."""

    device_count: int
    tag_count: int
    """Tags of all devices."""
    version: str
    """The version of Holdfast."""
    enabled: bool | None = None
    """Whether the scanner is enabled in `service_enabled`; only with dialect `tentacle-next`."""


class LogEntry(_Message):
    """A line of the log."""

    timestamp: int
    """In milliseconds since 1970."""
    level: str
    """`debug`, `info`, `warn` or `error`."""
    message: str
    """The event and its fields."""
    service_type: str
    module_id: str
    logger: str


class Announcement(_Message, omit_defaults=True):
    """Announces a scanner to other scanners on the same subjects; a part of a heartbeat."""

    started_at: Annotated[int, Meta(ge=0, le=YEAR_3000_MS)]
    """In milliseconds since 1970."""
    fleet: str | None = None
    """The fleet that the scanner is a node of."""
    bucket: Annotated[str, Meta(max_length=64)] = ""
    """When the bucket of the fleet's subscriptions was made, if that is known."""


class Variable(_Message, omit_defaults=True):
    """The latest value of a tag. The answer to `variables` is an array of these."""

    module_id: str
    device_id: str
    variable_id: str
    value: bool | int | float | str | list[Any] | None
    """The latest value that was read, also while the device is offline."""
    datatype: DataType
    quality: Quality
    """`good`: of the last scan; `bad`: older, not decodable, or too large for a message;
    `uncertain`: not read yet."""
    origin: str
    last_updated: int | None = None
    """Time of the device's response, in milliseconds since 1970."""
    description: str | None = None
    error: str | None = None
    """Why the entry that has the tag is refused, with dialect `tentacle-next`; or that the variable
    is too large for a message."""


class BlockReport(_Message, omit_defaults=True):
    """One Modbus request of a scan."""

    area: Area
    address: int
    count: int
    tags: int
    holes: int
    """The number of items that belong to no tag."""
    error: str | None = None


class TagReport(_Message, omit_defaults=True):
    """A tag with at least one subscriber."""

    id: str
    address: int
    function_code: FunctionCode
    datatype: str
    byte_order: str
    writable: bool
    encoding: str | None = None
    description: str | None = None
    profile: str | None = None
    """The profile that the tag is from; its values are scaled."""
    unit: str = ""
    error: str | None = None
    """Why the tag has no value."""


class SubscriberReport(_Message, omit_defaults=True):
    """A subscriber of a device."""

    id: str
    scan_rate: int
    publish: Publish
    tag_ids: list[str]
    deadband: float | None = None
    ttl: int | None = None
    """Seconds after which the subscription ends, unless a request renews it."""


class PlanReport(_Message, rename=None, omit_defaults=True):
    """The rules for combining tags into Modbus requests."""

    max_gap: int
    max_registers: int
    max_bits: int
    readable: list[tuple[Area, int, int]] | None = None
    forbidden: list[tuple[Area, int, int]] | None = None


class DeviceReport(_Message, omit_defaults=True):
    """A device with its health, its tags and its subscribers."""

    device_id: str
    url: str
    address: str
    """The URL with the resolved address."""
    unit_id: int
    state: State
    failures: int
    scan_rate: int
    """The scan interval of the fastest subscriber, in milliseconds."""
    timeout: int
    release: bool
    scans: int
    missed: int
    """Scans skipped because they were late."""
    round_trip: float
    """The round trip of the last response, in milliseconds."""
    tag_count: int
    plan: PlanReport
    blocks: list[BlockReport] | None = None
    """The Modbus requests of the last scan; before the first scan, the planned requests."""
    tags: list[TagReport] | None = None
    """`blocks`, `tags` and `subscribers` are omitted if the answer would be too long. Request them
    with `deviceId`."""
    subscribers: list[SubscriberReport] | None = None
    error: str | None = None
    state_since: int | None = None
    """In milliseconds since 1970, as the following times."""
    last_answer: int | None = None
    last_error: str | None = None
    """The last error, also after a recovery."""
    last_error_at: int | None = None


class OtherScanner(_Message):
    """Another scanner on the same subjects."""

    started_at: int
    """In milliseconds since 1970."""


class EntryReport(_Message):
    """An entry of the bucket of subscriptions that is refused."""

    key: str
    error: str


class FleetReport(_Message):
    """The fleet that answers."""

    name: str
    node: str
    """The node that has answered."""
    nodes: list[str]


class ServiceReport(_Message, omit_defaults=True):
    """The counts of messages since the start."""

    started_at: int
    published: int
    """Messages sent to NATS."""
    replaced: int
    """Messages that a newer value of the same tag replaced while NATS was slow or disconnected."""
    dropped: int
    """Messages lost because too many waited for NATS."""
    lost_scans: int
    """Scans lost because this process did not keep up."""
    other_scanners: list[OtherScanner] | None = None
    """Other scanners on the same subjects; each of them handles every request, too."""
    enabled: bool | None = None
    """Whether the scanner is enabled in `service_enabled`; only with dialect `tentacle-next`."""
    refused_entries: list[EntryReport] | None = None
    """The first refused entries of the bucket of subscriptions, by key."""
    fleet: FleetReport | None = None
    """The other counts are those of the node that has answered."""


class BrowseAnswer(_Message, omit_defaults=True):
    """A report of devices, sorted by id."""

    success: bool
    count: int
    """The number of all devices."""
    service: ServiceReport
    devices: list[DeviceReport]
    next: int | None = None
    """The `offset` of the next request, if not all devices fit into this answer."""
    next_tag: int | None = None
    """The `tagOffset` of the next request, if the device does not fit into this answer. The answer
    then has some of its tags, with their blocks and subscribers."""

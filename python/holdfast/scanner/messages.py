"""Every message of the service: what callers send, and what they get.

Requests are checked strictly: a key that is not known, a value of another type or out of its range
refuses the whole request. `null` in place of a value that may be left out is the same as leaving it
out. What needs more than the message to be judged is judged elsewhere.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar, get_args

import msgspec
from msgspec import Meta

from holdfast.net.addresses import LAST_PORT
from holdfast.protocol import LAST_ADDRESS, MAX_UNIT, READ_BITS, READ_REGISTERS
from holdfast.scanner.errors import Refused
from holdfast.types import TRANSPORTS, Area, Transport

FunctionCode = Literal["coil", "discrete", "holding", "input"]
Publish = Literal["scan", "change"]
State = Literal["connecting", "online", "offline"]
DataType = Literal["number", "boolean", "string", "array"]

Id = Annotated[str, Meta(min_length=1, max_length=256)]
Address = Annotated[int, Meta(ge=0, le=LAST_ADDRESS)]
Range = Annotated[list[FunctionCode | Address], Meta(min_length=2, max_length=3)]
Ranges = Annotated[list[Range], Meta(max_length=32)]
Marker = bool | int | float | str

EXACT = 2.0**53
"""Below this, floats hold every integer."""

CHOICES = {
    "functionCode": get_args(FunctionCode),
    "transport": TRANSPORTS,
    "publish": get_args(Publish),
}


class _Message(msgspec.Struct, rename="camel"):
    """Keys are written in camel case."""


class _Request(_Message, forbid_unknown_fields=True):
    """A message from outside."""


class TagRequest(_Request):
    """A value of a device: where it is, and how it is read."""

    id: Id
    address: Address
    """Counted from 0."""
    function_code: FunctionCode
    datatype: str
    """`boolean`, `int16`, `float32`, `string:10` and every other type of `holdfast.values`."""
    byte_order: str | None = None
    """That of the device, if left out."""
    encoding: Annotated[str, Meta(max_length=64)] | None = None
    """Of a `string:N`; ASCII if left out."""
    writable: bool | None = None
    description: str | None = None
    null: Annotated[list[Marker], Meta(max_length=32)] | None = None
    """Values that mean "not available", and are published as `null`."""


class PlanRequest(_Request, rename=None):
    """How the tags of a device are put together into requests."""

    max_gap: Annotated[int, Meta(ge=0, le=LAST_ADDRESS)] | None = None
    """Holes of up to so many items are read; 10 if left out."""
    max_registers: Annotated[int, Meta(ge=1, le=READ_REGISTERS)] | None = None
    max_bits: Annotated[int, Meta(ge=1, le=READ_BITS)] | None = None
    readable: Ranges | None = None
    """First and last addresses of all areas, or of the one that is named before them: holes are
    read only inside these."""
    forbidden: Ranges | None = None
    """Addresses that are never read, given in the same way."""


class SubscribeRequest(_Request):
    """Somebody wants tags of a device."""

    device_id: Annotated[str, Meta(min_length=1, max_length=128)]
    subscriber_id: Id
    tags: list[TagRequest]
    host: Annotated[str, Meta(min_length=1, max_length=253)] | None = None
    port: Annotated[int, Meta(ge=1, le=LAST_PORT)] | None = None
    """502 if left out, 802 with `tls`."""
    transport: Transport | None = None
    """`tcp` if left out."""
    url: Annotated[str, Meta(max_length=512)] | None = None
    """In place of host, port and transport."""
    unit_id: Annotated[int, Meta(ge=0, le=MAX_UNIT)] | None = None
    """1 if left out."""
    byte_order: str | None = None
    """`ABCD` if left out."""
    scan_rate: int | None = None
    """Milliseconds, 1000 if left out."""
    timeout: int | None = None
    """Milliseconds for a request and its reply, 1000 if left out."""
    publish: Publish | None = None
    """`scan` if left out."""
    deadband: Annotated[float, Meta(ge=0)] | None = None
    """With `change`: numbers must differ by more than this; 0 if left out."""
    plan: PlanRequest | None = None
    release: bool | None = None
    """Whether the connection is closed after each scan."""


class UnsubscribeRequest(_Request):
    """Somebody does not want tags any more."""

    device_id: str
    subscriber_id: str
    tag_ids: list[str] | None = None
    """All that the subscriber has, if left out."""


class BrowseRequest(_Request):
    """What is to be told; an empty message asks for everything."""

    device_id: str | None = None
    offset: Annotated[int, Meta(ge=0)] | None = None
    """How many devices are left out."""
    tag_offset: Annotated[int, Meta(ge=0)] | None = None
    """How many tags of `deviceId` are left out."""


class Answer(_Message, omit_defaults=True):
    """What became of a request."""

    success: bool
    count: int | None = None
    """The tags of a subscribe request."""
    error: str | None = None


class Data(_Message):
    """One value of one tag. Values that JSON does not have, such as NaN, are `null`."""

    module_id: str
    device_id: str
    variable_id: str
    value: bool | int | float | str | list[Any] | None
    datatype: DataType
    timestamp: int
    """Milliseconds since 1970, when the device had answered."""


class Status(_Message, omit_defaults=True):
    """How a device does, when that changes."""

    device_id: str
    state: State
    failures: int
    """Scans without an answer since the last one that had one."""
    timestamp: int
    error: str | None = None


class Heartbeat(_Message):
    """That the service runs."""

    service_type: str
    module_id: str
    last_seen: int
    started_at: int
    metadata: dict[str, str]


class BlockReport(_Message, omit_defaults=True):
    """One request of a scan."""

    area: Area
    address: int
    count: int
    tags: int
    holes: int
    """Items that no tag wants."""
    error: str | None = None


class TagReport(_Message, omit_defaults=True):
    """A tag that is scanned."""

    id: str
    address: int
    function_code: FunctionCode
    datatype: str
    byte_order: str
    writable: bool
    encoding: str | None = None
    description: str | None = None
    error: str | None = None
    """Why there is no value."""


class SubscriberReport(_Message, omit_defaults=True):
    """Somebody who wants tags of a device."""

    id: str
    scan_rate: int
    publish: Publish
    tag_ids: list[str]
    deadband: float | None = None


class PlanReport(_Message, rename=None, omit_defaults=True):
    """The rules that blocks are drawn by."""

    max_gap: int
    max_registers: int
    max_bits: int
    readable: list[tuple[Area, int, int]] | None = None
    forbidden: list[tuple[Area, int, int]] | None = None


class DeviceReport(_Message, omit_defaults=True):
    """A device, all that is wanted of it, and how it does."""

    device_id: str
    url: str
    address: str
    """What it is connected to: the name in the URL was looked up once."""
    unit_id: int
    state: State
    failures: int
    scan_rate: int
    """Milliseconds: that of the fastest subscriber."""
    timeout: int
    release: bool
    scans: int
    missed: int
    """Scans that could not begin in time."""
    round_trip: float
    """Milliseconds of the last answer."""
    tag_count: int
    plan: PlanReport
    blocks: list[BlockReport] | None = None
    """The requests of the last scan that came to them; where there was none yet, the first ones."""
    tags: list[TagReport] | None = None
    """`blocks`, `tags` and `subscribers` are missing where the answer would be too long; whoever
    asks for the device by its id gets them."""
    subscribers: list[SubscriberReport] | None = None
    error: str | None = None
    state_since: int | None = None
    """Milliseconds since 1970, as the following times."""
    last_answer: int | None = None
    last_error: str | None = None
    """What went wrong last, though it may be well again."""
    last_error_at: int | None = None


class ServiceReport(_Message):
    """What became of all messages since the start."""

    started_at: int
    published: int
    """Messages that were handed to NATS."""
    replaced: int
    """Messages whose place a newer one took, while NATS did not take them."""
    dropped: int
    """Messages that were lost because too many waited for NATS."""
    lost_scans: int
    """Scans that were lost because this process did not keep up."""


class BrowseAnswer(_Message, omit_defaults=True):
    """Devices by id."""

    success: bool
    count: int
    """Of all devices."""
    service: ServiceReport
    devices: list[DeviceReport]
    next: int | None = None
    """The offset to ask for, where not all devices fit into one answer."""
    next_tag: int | None = None
    """The tag offset to ask for, where a device does not fit into one answer: it has some of its
    tags then, their blocks, and which of them each subscriber wants."""


Asked = TypeVar("Asked", bound=_Request)


def decode(data: bytes, kind: type[Asked], most: int) -> Asked:
    """The request that a message is. Raises `Refused`."""
    if len(data) > most:
        raise Refused(f"the request has {len(data)} bytes, allowed are {most}")
    try:
        try:
            return msgspec.json.decode(data, type=kind)
        except msgspec.ValidationError as error:
            if "got `float`" not in str(error):
                raise
            return msgspec.convert(_with_integers(msgspec.json.decode(data)), type=kind)
    except msgspec.ValidationError as error:
        raise Refused(_explained(str(error))) from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise Refused(f"not JSON: {error}") from None


def _with_integers(value: Any) -> Any:
    """JSON in which numbers without a fraction are integers, as callers in JavaScript have it."""
    if type(value) is dict:
        return {key: _with_integers(item) for key, item in value.items()}
    if type(value) is list:
        return [_with_integers(item) for item in value]
    if type(value) is float and value.is_integer() and abs(value) < EXACT:
        return int(value)
    return value


def _explained(text: str) -> str:
    """An error of msgspec; where only some words are right, with these."""
    if "enum" in text:
        for key, words in CHOICES.items():
            if f".{key}`" in text:
                return f"{text}, allowed are {', '.join(words)}"
    return text

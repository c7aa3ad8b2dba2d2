"""Models of devices: their reads, request limits and destinations."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import AfterValidator, ConfigDict, Field, Strict, ValidationInfo, model_validator

from holdfast._core import MAX_IN_FLIGHT, RETRY_PAUSES_S
from holdfast.client.base import DEFAULT_TIMEOUT_S, MAX_INTERVAL_S, MIN_INTERVAL_S
from holdfast.client.tolerance import Tolerance
from holdfast.client.url import (
    MAX_CLOSE_AFTER,
    MAX_PAUSE_S,
    MAX_RETRIES,
    RECEIVER_TIMEOUT_S,
    Receiver,
    Target,
    parse,
    parse_receiver,
)
from holdfast.config.models.base import Model, problem_at
from holdfast.config.models.memories import Register, Size
from holdfast.config.models.tags import TagConfig
from holdfast.config.values.scalars import (
    NAME_KEYS,
    DeviceUrl,
    Duration,
    Name,
    NotNull,
    ReceiverUrl,
    StatusName,
    Text,
    UnitId,
    seconds,
    whole_number,
)
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, MAX_UNIT, READ_BITS, READ_REGISTERS
from holdfast.tags.read_gap import gap_of_device
from holdfast.types import WRITABLE_AREAS, Area, RegisterArea

if TYPE_CHECKING:
    from collections.abc import Iterator

TAKING_TIME = ("reads", "profile", "tags")
"""The keys that make a device polled, so that it needs an interval."""
STATUS_BLOCK = 30
"""Registers in a status block."""
LAST_SLOT = ADDRESSES // STATUS_BLOCK - 1


class DestinationConfig(Model):
    """The destination of a read."""

    memory: Name
    """The memory."""
    area: Area
    """The area: an area of bits for bits, an area of registers for registers."""
    address: Register
    """The first address."""


class ReadConfig(Model):
    """A range to read; its values are written to memory in one step."""

    area: Area
    """The area of the device."""
    address: Register
    """The first address, as in the protocol: counted from 0."""
    count: Size
    """How many bits or registers; a large count takes several requests."""
    into: Annotated[DestinationConfig | None, NotNull()] = None
    """The destination in this appliance."""


class StaleConfig(Model):
    """When values that were read are too old, and what happens to requests for them then."""

    after: Duration
    """Seconds without a successful read after which values are stale."""
    answer: Literal["exception", "keep"] = "keep"
    """exception: requests that touch stale values are refused; keep: the last values stay."""


def _not_before_start(end: int, info: ValidationInfo) -> int:
    # The order of the keys of the model: start has been validated, and is absent if it is invalid.
    start = info.data.get("start")
    if isinstance(start, int) and end < start:
        raise ValueError(f"found {end}, allowed: the last address, {start} or more")
    return end


class RangeConfig(Model):
    """A range of addresses."""

    area: Area
    """The area."""
    start: Register
    """The first address."""
    end: Annotated[Register, AfterValidator(_not_before_start)]
    """The last address."""

    @property
    def addresses(self) -> range:
        """The addresses, as a range."""
        return range(self.start, self.end + 1)


def _crc(data: dict[str, Any]) -> Literal["required"] | None:
    return "required" if data["format"] == "crc" else None


class BlockConfig(Model):
    """Place and content of a block of 30 registers with the status of a device."""

    area: RegisterArea
    """The area, of registers."""
    slot: Annotated[int, Field(ge=0, le=LAST_SLOT)]
    """The slot; the block begins at address 30 × slot."""
    name: Annotated[StatusName | None, NotNull()] = None
    """The name in the block, up to 16 characters. Default: the start of the name of the device."""
    keep_last_error: bool = False
    """Whether register 1 keeps the last error after a recovery; otherwise it is 0 then."""

    @property
    def addresses(self) -> range:
        """The addresses, as a range."""
        return range(self.slot * STATUS_BLOCK, (self.slot + 1) * STATUS_BLOCK)


class StatusConfig(BlockConfig):
    """A block of 30 registers with the status of a device."""

    memory: Name
    """The memory."""


class ForwardedStatusConfig(BlockConfig):
    """A block of 30 registers with the status of a device, in a memory of a receiver."""

    unit: Annotated[Register | None, NotNull()] = None
    """Format v1: the unit id of the packets."""
    memory_id: Annotated[Register | None, NotNull()] = None
    """Format crc: the memory id of the packets."""


class OffsetsConfig(Model):
    """What is added to the addresses of each area."""

    coils: Register = 0
    """For coils."""
    discrete_inputs: Register = 0
    """For discrete inputs."""
    holding_registers: Register = 0
    """For holding registers."""
    input_registers: Register = 0
    """For input registers."""


class ForwardConfig(Model):
    """A raw ingest receiver to which every read is forwarded."""

    url: ReceiverUrl
    """The receiver: raw://host:port, or raw+tls://host:port with the options of tls:// URLs."""
    format: Literal["v1", "crc"] = "v1"
    """v1: a 10-byte header with a unit id; crc: a 12-byte header with a memory id, and a CRC."""
    crc: Annotated[Literal["required", "none"] | None, NotNull()] = Field(default_factory=_crc)
    """Format crc: whether packets end with a CRC. Default: required."""
    unit: Annotated[Register | None, NotNull()] = None
    """Format v1: the unit id of the packets."""
    memory_id: Annotated[Register | None, NotNull()] = None
    """Format crc: the memory id of the packets."""
    timeout: Duration = RECEIVER_TIMEOUT_S
    """Seconds for connection, packet and reply together."""
    offsets: OffsetsConfig = OffsetsConfig()
    """What is added to the addresses in packets, for each area."""
    status: Annotated[ForwardedStatusConfig | None, NotNull()] = None
    """The status block of the device, which is forwarded too."""

    @property
    def receiver(self) -> Receiver:
        """The receiver, parsed."""
        return parse_receiver(self.url)

    @property
    def target(self) -> int:
        """The unit id or the memory id of the packets, depending on the format."""
        return self._target(self)

    @property
    def status_target(self) -> int:
        """The unit id or the memory id of the packets with the status block."""
        return 0 if self.status is None else self._target(self.status)

    def _target(self, of: ForwardConfig | ForwardedStatusConfig) -> int:
        return (of.unit if self.format == "v1" else of.memory_id) or 0


InFlight = Annotated[int, Field(ge=1, le=MAX_IN_FLIGHT)] | Literal["auto"]
Interval = Annotated[float, seconds(MIN_INTERVAL_S, MAX_INTERVAL_S), whole_number]
Pause = Annotated[float, seconds(0, MAX_PAUSE_S), whole_number]
AcceptUnit = Annotated[Annotated[int, Field(ge=0, le=MAX_UNIT)] | Literal["any"] | None, NotNull()]


class ToleranceConfig(Model):
    """How to treat a device that deviates from the standard."""

    accept_unit: AcceptUnit = None
    """A unit id that replies may carry besides that of the request, or any."""
    pad: bool = False
    """Whether surplus bytes at the end of a reply are ignored."""
    echo: bool | Literal["auto"] = "auto"
    """Whether the adapter repeats what is sent, or auto; for RTU and ASCII frames."""
    pause: Pause = 0.0
    """Seconds between the end of a request and the next; one request is in flight then."""
    pause_after_connect: Pause = 0.0
    """Seconds between connecting and the first request."""
    retries: Annotated[int, Field(ge=0, le=MAX_RETRIES)] = 0
    """How often a read is sent again after a timeout, an invalid reply or a lost connection."""
    retry_busy: bool = False
    """Whether retries covers exceptions 05 and 06 too."""
    close_after: Annotated[int, Field(ge=0, le=MAX_CLOSE_AFTER)] = 0
    """Requests after which the connection is closed, 0 for never; one is in flight then."""
    reconnect: Pause = 0.0
    """Seconds between the end of a connection and the next attempt to connect."""
    write_multiple: bool = False
    """Whether one coil is written with function 15 and one register with function 16."""


class RetryConfig(Model):
    """When an address that can't be reached, or a unit that does not answer, is tried again."""

    first: Duration = RETRY_PAUSES_S[0]
    """Seconds after the first failure; doubled with each further one."""
    most: Duration = RETRY_PAUSES_S[1]
    """The longest pause, in seconds."""

    @model_validator(mode="after")
    def _grows(self) -> Self:
        if self.first > self.most:
            message = f"found {self.first:g}, allowed: up to most, which is {self.most:g}"
            raise problem_at("first", message)
        return self

    @property
    def pauses(self) -> tuple[float, float]:
        """The first and the longest pause."""
        return self.first, self.most


def tolerating(target: Target, tolerance: ToleranceConfig | None) -> Target:
    """The target, with a tolerance in place of its own if there is one."""
    if tolerance is None:
        return target
    return replace(target, tolerance=Tolerance(**tolerance.model_dump()))


class DeviceIdentityConfig(Model):
    """What outputs tell of a device besides its values."""

    vendor_name: Annotated[Text | None, NotNull()] = None
    """Its maker."""
    model_name: Annotated[Text | None, NotNull()] = None
    """Its model. Default: the name of its profile."""
    revision: Annotated[Text | None, NotNull()] = None
    """The version of its firmware."""


def takes_writes(area: object, into: object) -> bool:
    """Whether Modbus clients can write what is read from one area into the other."""
    return area == into and area in WRITABLE_AREAS


def _max_gap(data: dict[str, Any]) -> int:
    has_tags = bool(data.get("tags") or data.get("profile"))
    return gap_of_device(has_reads=bool(data.get("reads")), has_tags=has_tags)


class DeviceConfig(Model):
    """A device that is polled, or that routes pass requests on to."""

    model_config = ConfigDict(
        json_schema_extra={"dependentRequired": {key: ["interval"] for key in TAKING_TIME}}
    )

    url: DeviceUrl
    """The URL of the device, or of the gateway in front of it."""
    unit: UnitId = 1
    """The unit id, 0 to 255; on a serial line 1 to 255."""
    writes: Literal["refuse", "pass", "local"] = "refuse"
    """Writes into what it is read into: refused, sent to it, or kept until the next poll."""
    stale: Annotated[StaleConfig | None, NotNull()] = None
    """When what it is read into is too old. Default: never."""
    emulate: bool = False
    """With writes: pass, whether function 22 is sent as a read and function 6."""
    enabled: bool = True
    """Whether it is used."""
    interval: Annotated[Interval | None, NotNull()] = None
    """Seconds from the start of a poll to the start of the next; required with reads and tags."""
    timeout: Duration = DEFAULT_TIMEOUT_S
    """Seconds for a request and its reply."""
    in_flight: InFlight = 1
    """The most requests in flight at its address, over TCP; auto: more while replies stay fast."""
    tolerance: Annotated[ToleranceConfig | None, NotNull()] = None
    """How to treat it if it deviates from the standard; replaces the same options in the URL."""
    retry: RetryConfig = RetryConfig()
    """When it is tried again if it can't be reached or does not answer."""
    reads: Annotated[tuple[ReadConfig, ...], Strict(False)] = Field(
        default=(), min_length=1, exclude_if=lambda v: not v
    )
    """The ranges to read. Without reads and tags, the device is only reachable by routes."""
    profile: Annotated[Name | None, NotNull()] = None
    """The profile with its tags."""
    tags: dict[Name, TagConfig] = Field(
        default={}, json_schema_extra=NAME_KEYS, exclude_if=lambda v: not v
    )
    """Its own tags, by name, besides those of the profile or in place of them."""
    max_gap: Annotated[int, Field(ge=0, le=LAST_ADDRESS)] | Literal["auto"] = Field(
        default_factory=_max_gap
    )
    """The largest gap, in bits or registers, that is read to join two reads; auto: gaps are read
    where that takes less time than another request, as measured. Default: 0, or 10 with tags
    alone."""
    max_registers: Annotated[int, Field(ge=1, le=READ_REGISTERS)] = READ_REGISTERS
    """Maximum number of registers in one request."""
    max_bits: Annotated[int, Field(ge=1, le=READ_BITS)] = READ_BITS
    """Maximum number of bits in one request."""
    readable: Annotated[tuple[RangeConfig, ...], Strict(False)] = ()
    """Gaps are read only inside these ranges, in areas that have one."""
    forbidden: Annotated[tuple[RangeConfig, ...], Strict(False)] = ()
    """Addresses that are never read."""
    forward: Annotated[tuple[ForwardConfig, ...], Strict(False)] = ()
    """Raw ingest receivers to which every read is forwarded."""
    status: Annotated[StatusConfig | None, NotNull()] = None
    """The status block of the device."""
    identity: Annotated[DeviceIdentityConfig | None, NotNull()] = None
    """Its maker, model and version, for outputs that publish them."""

    @property
    def target(self) -> Target:
        """The parts of the URL."""
        return tolerating(parse(self.url), self.tolerance)

    @property
    def passed(self) -> Iterator[tuple[ReadConfig, DestinationConfig]]:
        """The reads whose destination takes writes for the device."""
        if self.enabled and self.writes == "pass":
            for read in self.reads:
                if read.into is not None and takes_writes(read.area, read.into.area):
                    yield read, read.into

    @property
    def is_polled(self) -> bool:
        """Whether it is read at an interval."""
        return self.enabled and self.has_readings

    @property
    def has_readings(self) -> bool:
        """Whether it has something to read."""
        return bool(self.reads) or self.has_tags

    @property
    def has_tags(self) -> bool:
        """Whether it has tags."""
        return bool(self.tags) or self.profile is not None

"""Devices that are polled: what is read of them, in which requests, and where it goes."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import Field, Strict

from holdfast.client.target import MAX_IN_FLIGHT, Target, parse
from holdfast.client.tolerance import MAX_CLOSE_AFTER, MAX_PAUSE, MAX_RETRIES, Tolerance
from holdfast.config.base import Model
from holdfast.config.memories import Register, Size
from holdfast.config.receiver import Receiver, parse_receiver
from holdfast.config.scalars import (
    MAX_TIME,
    DeviceUrl,
    Duration,
    Milliseconds,
    Name,
    NotNull,
    ReceiverUrl,
    UnitId,
    whole_number,
)
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, MAX_UNIT, READ_BITS, READ_REGISTERS
from holdfast.types import Area, RegisterArea

MIN_INTERVAL = 0.01
STATUS_BLOCK = 30
"""Registers of a status block."""
LAST_SLOT = ADDRESSES // STATUS_BLOCK - 1


class DestinationConfig(Model):
    """Where the bytes of a read go."""

    memory: Name
    """The memory."""
    area: Area
    """The area: of bits for bits, of registers for registers."""
    address: Register
    """The first address."""


class ReadConfig(Model):
    """Something to read, which is written as one step."""

    area: Area
    """The area of the device."""
    address: Register
    """The first address, as in the protocol: from 0."""
    count: Size
    """Bits or registers; what one request can't carry takes several."""
    into: Annotated[DestinationConfig | None, NotNull()] = None
    """Where it goes in this appliance."""


class RangeConfig(Model):
    """Addresses of a device: start and end, or start and count."""

    area: Area
    """The area."""
    start: Register
    """The first address."""
    end: Annotated[Register | None, NotNull()] = None
    """The last address."""
    count: Annotated[Size | None, NotNull()] = None
    """How many addresses there are, in place of end."""

    @property
    def addresses(self) -> range:
        """The addresses, as a range."""
        if self.count is not None:
            return range(self.start, self.start + self.count)
        return range(self.start, (self.start if self.end is None else self.end) + 1)


class CostConfig(Model):
    """What reading costs: a hole is read where that is cheaper than one more request."""

    per_request: Milliseconds
    """Milliseconds that a request takes, whatever it reads."""
    per_register: Milliseconds
    """Milliseconds that each register takes, or each 16 bits."""
    measured: bool = False
    """Whether the device's own answers take the place of both, after a hundred of them."""


def _crc(data: dict[str, Any]) -> Literal["required"] | None:
    return "required" if data["format"] == "crc" else None


class ForwardConfig(Model):
    """A receiver of raw ingest packets that gets every read too."""

    url: ReceiverUrl
    """The receiver: raw://host:port."""
    format: Literal["v1", "crc"] = "v1"
    """The layout of a packet: 10 bytes of header and a unit id, or 12, a memory id and a CRC."""
    crc: Annotated[Literal["required", "none"] | None, NotNull()] = Field(default_factory=_crc)
    """Whether packets of format crc end with their CRC; `required` when left out."""
    unit: Annotated[Register | None, NotNull()] = None
    """Format v1: the unit id that packets name."""
    memory_id: Annotated[Register | None, NotNull()] = None
    """Format crc: the memory id that packets name."""
    timeout: Duration = 5.0
    """Seconds for a connection, a packet and its reply together."""

    @property
    def receiver(self) -> Receiver:
        """Host and port."""
        return parse_receiver(self.url)

    @property
    def target(self) -> int:
        """What packets name, by either format."""
        return (self.unit if self.format == "v1" else self.memory_id) or 0


class StatusConfig(Model):
    """30 registers that tell how a device does."""

    memory: Name
    """The memory."""
    area: RegisterArea
    """The area, of registers."""
    slot: Annotated[int, Field(ge=0, le=LAST_SLOT)]
    """The block begins at address 30 × slot."""

    @property
    def addresses(self) -> range:
        """The addresses, as a range."""
        return range(self.slot * STATUS_BLOCK, (self.slot + 1) * STATUS_BLOCK)


Pause = Annotated[float, Field(ge=0, le=MAX_PAUSE, allow_inf_nan=False), whole_number]
AcceptUnit = Annotated[Annotated[int, Field(ge=0, le=MAX_UNIT)] | Literal["any"] | None, NotNull()]


class ToleranceConfig(Model):
    """How to treat a device that deviates from the standard."""

    accept_unit: AcceptUnit = None
    """A unit id that replies may carry besides that of the request, or any."""
    pad: bool = False
    """Whether surplus bytes at the end of a reply are ignored."""
    echo: bool = False
    """Whether the adapter repeats what is sent; for RTU and ASCII frames."""
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


def _max_gap(data: dict[str, Any]) -> int | None:
    return 0 if data["cost"] is None else None


class DeviceConfig(Model):
    """A device that is polled."""

    url: DeviceUrl
    """The device, or the gateway that it is behind, as clients name it."""
    unit: UnitId
    """The unit id, 0 to 255; on a serial line 1 to 247."""
    enabled: bool = True
    """Whether it is polled."""
    interval: Annotated[
        float,
        Field(ge=MIN_INTERVAL, le=MAX_TIME, allow_inf_nan=False),
        whole_number,
    ]
    """Seconds from the start of a poll to the start of the next."""
    timeout: Duration = 1.0
    """Seconds for a request and its reply."""
    in_flight: Annotated[int, Field(ge=1, le=MAX_IN_FLIGHT)] | Literal["auto"] = 1
    """The most requests in flight at its address, over TCP; auto: more while replies stay fast."""
    tolerance: Annotated[ToleranceConfig | None, NotNull()] = None
    """How to treat it if it deviates from the standard; in place of these options of the URL."""
    reads: Annotated[tuple[ReadConfig, ...], Strict(False), Field(min_length=1)]
    """What is read."""
    cost: Annotated[CostConfig | None, NotNull()] = None
    """Reads holes between reads where that is cheaper; in place of max_gap."""
    max_gap: Annotated[Annotated[int, Field(ge=0, le=LAST_ADDRESS)] | None, NotNull()] = Field(
        default_factory=_max_gap
    )
    """Reads holes between reads of up to so many bits or registers; 0 when left out."""
    max_registers: Annotated[int, Field(ge=1, le=READ_REGISTERS)] = READ_REGISTERS
    """The most registers of one request."""
    max_bits: Annotated[int, Field(ge=1, le=READ_BITS)] = READ_BITS
    """The most bits of one request."""
    readable: Annotated[tuple[RangeConfig, ...], Strict(False)] = ()
    """Holes are read only inside these, in the areas that have some."""
    forbidden: Annotated[tuple[RangeConfig, ...], Strict(False)] = ()
    """Addresses that are never read."""
    forward: Annotated[tuple[ForwardConfig, ...], Strict(False)] = ()
    """Who gets every read too."""
    status: Annotated[StatusConfig | None, NotNull()] = None
    """Where it is told how the device does."""

    @property
    def target(self) -> Target:
        """The parts of the URL."""
        target = parse(self.url)
        if self.tolerance is None:
            return target
        return replace(target, tolerance=Tolerance(**self.tolerance.model_dump()))

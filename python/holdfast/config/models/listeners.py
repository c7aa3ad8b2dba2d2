"""Models of listeners: protocol, address, and what each peer may do.

`type` selects the model. Each type has its own model, so a key of another type is an unknown key.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Discriminator, Field, Strict, Tag

from holdfast.client.serial_settings import Parity, Rs485, SerialTarget, stop_bits
from holdfast.config.models.base import Model, types_of
from holdfast.config.models.connection_limits import ConnectionLimits, handshakes
from holdfast.config.models.devices import RangeConfig
from holdfast.config.models.server_tls import ServerTlsConfig
from holdfast.config.values.scalars import (
    RAW_UNIT_KEYS,
    SECONDS,
    SERIAL_UNITS_KEYS,
    UNITS_KEYS,
    Areas,
    BindAddress,
    Codes,
    DataBits,
    DeviceName,
    Duration,
    DurationOrZero,
    MemoryNames,
    Name,
    NotNull,
    RawTarget,
    RawUnitId,
    Roles,
    SerialUnitIds,
    Sources,
    StopBits,
    UnitIds,
    seconds,
)
from holdfast.protocol import LAST_ADDRESS
from holdfast.runtime.suggestion import suggestion
from holdfast.server.options import DEFAULTS
from holdfast.types import Access, BitArea

FunctionList: TypeAlias = Annotated[Annotated[Codes, Field(min_length=1)] | None, NotNull()]
DenyList: TypeAlias = Annotated[Codes | None, NotNull()]
OwnAccess: TypeAlias = Annotated[Access | None, NotNull()]
RangeList: TypeAlias = Annotated[
    Annotated[tuple[RangeConfig, ...], Strict(False), Field(min_length=1)] | None, NotNull()
]


class RouteConfig(Model):
    """Passes the requests of a unit id on to a device."""

    route: Name
    """A device, or a link. A link keeps the unit id of the request."""
    access: OwnAccess = None
    """Whether these peers may write to this unit. Default: as the rule."""
    functions: FunctionList = None
    """The allowed function codes of this unit. Default: those of the rule."""
    deny: DenyList = None
    """Function codes that are not allowed for this unit, in addition to those of the rule."""


class ExceptionStatusConfig(Model):
    """The eight bits that function 7 reads from a memory."""

    area: BitArea
    """The area of the bits."""
    address: Annotated[int, Field(ge=0, le=LAST_ADDRESS - 7)]
    """The address of the first bit, which is the lowest of the reply."""

    @property
    def addresses(self) -> range:
        """The addresses, as a range."""
        return range(self.address, self.address + 8)


class UnitMemoryConfig(Model):
    """A memory behind a unit id, with fewer rights than the rule gives, or with function 7."""

    memory: Name
    """The memory."""
    access: OwnAccess = None
    """Whether these peers may write to this unit. Default: as the rule."""
    functions: FunctionList = None
    """The allowed function codes of this unit. Default: those of the rule."""
    deny: DenyList = None
    """Function codes that are not allowed for this unit, in addition to those of the rule."""
    read: RangeList = None
    """The ranges that may be read. Default: everything."""
    write: RangeList = None
    """The ranges that may be written. Default: everything."""
    exception_status: Annotated[ExceptionStatusConfig | None, NotNull()] = None
    """The bits that function 7 reads. Default: the unit does not have function 7."""


UNIT_TAGS = ("memory", "long", "route")


def _tag_of(value: object) -> str:
    memory, long, route = UNIT_TAGS
    if isinstance(value, UnitMemoryConfig) or (
        isinstance(value, dict) and _seems_to_have_memory(value)
    ):
        return long
    return route if isinstance(value, dict | RouteConfig) else memory


def _seems_to_have_memory(value: dict[Any, Any]) -> bool:
    """Whether a mapping has the key of a memory, or a misspelled one."""
    return "memory" in value or (
        "route" not in value and any(suggestion(key, ("memory",)) for key in value)
    )


Target: TypeAlias = Annotated[
    Annotated[Name, Tag("memory")]
    | Annotated[UnitMemoryConfig, Tag("long")]
    | Annotated[RouteConfig, Tag("route")],
    Discriminator(_tag_of),
]
"""What is behind a unit id: a memory, or a route; both with rights of their own, or without."""


class RuleConfig(Model):
    """What the peers of these sources may do."""

    sources: Sources
    """Networks and addresses of the peers, IPv4 or IPv6."""
    units: dict[UnitIds, Target] = Field(min_length=1, json_schema_extra=UNITS_KEYS)
    """What is behind each unit id, or range of unit ids: a memory, or a route to devices. With a
    mapping, the unit can have fewer rights than the rule."""
    access: Access
    """Whether these peers may write."""
    functions: FunctionList = None
    """The allowed function codes. Default: all; with a route, all standard ones."""
    deny: DenyList = None
    """Function codes that are not allowed; all others are."""


class TlsRuleConfig(RuleConfig):
    """What the peers of these sources may do, if their certificates have one of these roles."""

    roles: Roles = None
    """Roles of client certificates; "" is a certificate without a role. Default: any role."""


class SerialRuleConfig(Model):
    """What the client of a serial line may do."""

    units: dict[SerialUnitIds, Target] = Field(min_length=1, json_schema_extra=SERIAL_UNITS_KEYS)
    """What is behind each unit id, or range of unit ids, 1 to 247: a memory, or a route. With a
    mapping, the unit can have fewer rights than the rule."""
    access: Access
    """Whether the client may write."""
    functions: FunctionList = None
    """The allowed function codes. Default: all; with a route, all standard ones."""
    deny: DenyList = None
    """Function codes that are not allowed; all others are."""


class RawRuleConfig(Model):
    """What the senders of these sources may write."""

    sources: Sources
    """Networks and addresses of the senders, IPv4 or IPv6."""
    units: dict[RawUnitId, RawTarget] = Field(
        default={}, min_length=1, json_schema_extra=RAW_UNIT_KEYS, exclude_if=lambda v: not v
    )
    """Format v1: the memory behind each unit id, 0 to 65535."""
    memories: MemoryNames = Field(default=(), exclude_if=lambda v: not v)
    """Format crc: the memories that packets may write; each needs an id."""
    areas: Areas
    """The areas that may be written."""


class SecureRawRuleConfig(RawRuleConfig):
    """What the senders of these sources may write; with tls, those with one of these roles."""

    roles: Roles = None
    """With tls: roles of certificates of senders; "" is a certificate without a role. Default: any
    role."""


class _BoundListener(Model):
    """Where a listener on a network listens."""

    type: str
    """The protocol."""
    bind: BindAddress
    """Where to listen: an IP address and a port."""


class _ModbusRules(Model):
    """What peers of a Modbus server on a network may do."""

    listen_only: bool = DEFAULTS["listen_only"]
    """Function 8 may set a unit to listen only mode, for all clients of this listener."""
    event_log: bool = DEFAULTS["event_log"]
    """Function 12 answers with the latest events of this listener."""
    rules: Annotated[tuple[RuleConfig, ...], Strict(False), Field(min_length=1)]
    """For each unit id, the first rule whose sources contain the peer and that names it applies."""


class _ModbusLimits(ConnectionLimits):
    """Limits of all Modbus servers over TCP connections."""

    keepalive: Annotated[int, Field(ge=1, le=32767, json_schema_extra=SECONDS)] = DEFAULTS[
        "keepalive"
    ]
    """Seconds without a byte after which TCP asks whether the peer is still there. Some firewalls
    and mobile networks forget connections that are silent for a shorter time."""


class _ModbusOverTcp(_ModbusRules, _ModbusLimits, _BoundListener):
    """Settings of all Modbus servers over TCP connections."""


class RawCompatConfig(Model):
    """What old senders need that the locked raw ingest protocol does not allow."""

    packets: Annotated[Literal["many"] | None, NotNull()] = None
    """many: a connection carries packets until the sender closes, or one is refused. Default: one
    packet."""
    after_refusal: Annotated[Literal["continue"] | None, NotNull()] = None
    """With packets: many. continue: after a refused packet whose header and CRC are valid, the next
    packet is read. Default: the connection ends."""
    crc: Annotated[Literal["none"] | None, NotNull()] = None
    """Format crc. none: packets have no CRC; what follows the payload is not part of the packet.
    Default: a CRC is required."""
    flags: Annotated[Literal["ignore"] | None, NotNull()] = None
    """Format crc. ignore: flags and the reserved byte may be anything. Default: they must be 0."""


class RawIngestConfig(Model):
    """Raw ingest packets on the port of a Modbus TCP server: the first bytes decide."""

    format: Literal["v1", "crc"] = "v1"
    """v1: a 10-byte header with a unit id; crc: a 12-byte header with a memory id, and a CRC."""
    compat: Annotated[RawCompatConfig | None, NotNull()] = None
    """What old senders need that the protocol does not allow. Default: the strict protocol."""
    rules: Annotated[tuple[RawRuleConfig, ...], Strict(False), Field(min_length=1)]
    """The first rule whose sources contain the sender applies."""


class ModbusTcpListener(_ModbusOverTcp):
    """A Modbus TCP server."""

    type: Literal["modbus-tcp"]
    """The protocol."""
    raw_ingest: Annotated[RawIngestConfig | None, NotNull()] = None
    """Raw ingest packets on the same port. Default: none."""


class ModbusTlsListener(_ModbusOverTcp):
    """A Modbus TCP server over TLS, for clients with a certificate (Modbus/TCP Security)."""

    type: Literal["modbus-tls"]
    """The protocol."""
    tls: ServerTlsConfig
    """The server's certificate, and the clients it trusts."""
    request_timeout: Duration = DEFAULTS["request_timeout"]
    """Seconds from the first byte of a request to its last, and for the handshake."""
    rules: Annotated[tuple[TlsRuleConfig, ...], Strict(False), Field(min_length=1)]
    """For each unit id, the first rule that matches the peer and names the unit id applies."""

    @property
    def max_handshakes(self) -> int:
        """The most open connections that are not authenticated yet."""
        return handshakes(self.max_connections)


class ModbusRtuOverTcpListener(_ModbusOverTcp):
    """A server of Modbus RTU frames over TCP connections, as serial gateways send them."""

    type: Literal["modbus-rtu-over-tcp"]
    """The protocol."""
    frame_timeout: Duration = DEFAULTS["frame_timeout"]
    """Seconds without a byte after which an incomplete request is discarded."""


class ModbusAsciiOverTcpListener(_ModbusOverTcp):
    """A server of Modbus ASCII frames over TCP connections, as serial gateways send them."""

    type: Literal["modbus-ascii-over-tcp"]
    """The protocol."""


class ModbusUdpListener(_ModbusRules, _BoundListener):
    """A Modbus UDP server: one request per datagram."""

    type: Literal["modbus-udp"]
    """The protocol."""


class ModbusRtuOverUdpListener(_ModbusRules, _BoundListener):
    """A server of Modbus RTU frames over UDP: one frame per datagram."""

    type: Literal["modbus-rtu-over-udp"]
    """The protocol."""


def _stop_bits(data: dict[str, Any]) -> Literal[1, 2]:
    return stop_bits(data["parity"])


class SerialConfig(Model):
    """A serial port and its line settings."""

    device: DeviceName
    """The serial port, as in /dev/ttyUSB0 or COM3."""
    baud: Annotated[int, Field(ge=50, le=4_000_000)] = SerialTarget.baud
    """Bits per second."""
    parity: Parity = SerialTarget.parity
    """The parity bit."""
    stop_bits: StopBits = Field(default_factory=_stop_bits)
    """Stop bits. Default: 1 with a parity bit, 2 without."""
    rs485: Annotated[Rs485 | None, NotNull()] = None
    """The driver switches an RS-485 line by RTS, high or low while sending."""


class RtuSerialConfig(SerialConfig):
    """A serial port for Modbus RTU."""

    silence: Annotated[Annotated[float, seconds(0.0001, 10)] | None, NotNull()] = None
    """Seconds of silence that end a frame. Default: the time of 3.5 characters; above 19200 baud
    1.75 ms."""


class AsciiSerialConfig(SerialConfig):
    """A serial port for Modbus ASCII."""

    data_bits: DataBits = 7
    """Data bits per character."""


class _ModbusOnSerialLine(Model):
    """Settings of all servers on a serial line."""

    type: str
    """The protocol."""
    serial: SerialConfig
    """The serial port."""
    event_log: bool = DEFAULTS["event_log"]
    """Function 12 answers with the latest events of this listener."""
    rules: Annotated[tuple[SerialRuleConfig, ...], Strict(False), Field(min_length=1)]
    """What the client may do. For each unit id, the first rule that names it applies."""


class ModbusRtuListener(_ModbusOnSerialLine):
    """A Modbus RTU server on a serial line."""

    type: Literal["modbus-rtu"]
    """The protocol."""
    serial: RtuSerialConfig
    """The serial port."""


class ModbusAsciiListener(_ModbusOnSerialLine):
    """A Modbus ASCII server on a serial line."""

    type: Literal["modbus-ascii"]
    """The protocol."""
    serial: AsciiSerialConfig
    """The serial port."""


class RawIngestListener(ConnectionLimits, _BoundListener):
    """A server for raw ingest packets, which only write."""

    type: Literal["raw-ingest"]
    """The protocol."""
    format: Literal["v1", "crc"] = "v1"
    """v1: a 10-byte header with a unit id; crc: a 12-byte header with a memory id, and a CRC."""
    tls: Annotated[ServerTlsConfig | None, NotNull()] = None
    """TLS: the server's certificate, and the senders it trusts. Default: plain TCP."""
    idle_timeout: DurationOrZero = DEFAULTS["idle_timeout"]
    """With compat: {packets: many}, seconds without a packet after which a connection is closed; 0:
    unlimited."""
    request_timeout: Duration = DEFAULTS["request_timeout"]
    """Seconds from the start of a connection to the last byte of its packet; with tls, also for the
    handshake, before that."""
    compat: Annotated[RawCompatConfig | None, NotNull()] = None
    """What old senders need that the protocol does not allow. Default: the strict protocol."""
    rules: Annotated[tuple[SecureRawRuleConfig, ...], Strict(False), Field(min_length=1)]
    """The first rule that matches the sender applies: its sources and, with tls, its roles."""

    @property
    def max_handshakes(self) -> int | None:
        """The most open connections that are not authenticated yet, `None` without TLS."""
        return None if self.tls is None else handshakes(self.max_connections)


TcpListener: TypeAlias = (
    ModbusTcpListener
    | ModbusTlsListener
    | ModbusRtuOverTcpListener
    | ModbusAsciiOverTcpListener
    | RawIngestListener
)
UdpListener: TypeAlias = ModbusUdpListener | ModbusRtuOverUdpListener
SerialListener: TypeAlias = ModbusRtuListener | ModbusAsciiListener
Listener: TypeAlias = TcpListener | UdpListener | SerialListener

LISTENER_TYPES = types_of(Listener)
"""All values of `type`."""


def tls_of(listener: Listener) -> ServerTlsConfig | None:
    """The certificates of a listener; `None` without TLS."""
    return listener.tls if isinstance(listener, ModbusTlsListener | RawIngestListener) else None

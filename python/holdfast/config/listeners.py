"""Listeners: who may come in where, over which protocol, and what for.

`type` tells the kinds apart. Each has its own model, so that a key that means nothing to a kind is
an unknown key there.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, Strict

from holdfast.config.base import Model
from holdfast.config.scalars import (
    RAW_UNIT_KEYS,
    SERIAL_UNIT_KEYS,
    UNIT_KEYS,
    Areas,
    BindAddress,
    Codes,
    Connections,
    DataBits,
    DeviceName,
    Duration,
    DurationOrZero,
    EightBits,
    FilePath,
    MemoryNames,
    Name,
    NotNull,
    RawUnitId,
    Role,
    SerialUnitId,
    Sources,
    StopBits,
    UnitId,
)
from holdfast.types import Access

FunctionList: TypeAlias = Annotated[Annotated[Codes, Field(min_length=1)] | None, NotNull()]
DenyList: TypeAlias = Annotated[Codes | None, NotNull()]


class RuleConfig(Model):
    """What some peers may do."""

    sources: Sources
    """Networks and addresses of the peers, IPv4 or IPv6."""
    units: dict[UnitId, Name] = Field(min_length=1, json_schema_extra=UNIT_KEYS)
    """The memory behind each unit id."""
    access: Access
    """Whether these peers may write."""
    functions: FunctionList = None
    """The only function codes that are allowed."""
    deny: DenyList = None
    """Function codes that are not allowed, the others are."""


class TlsRuleConfig(RuleConfig):
    """What some peers may do, by where they are and what their certificates say."""

    roles: Annotated[
        Annotated[tuple[Role, ...], Strict(False), Field(min_length=1)] | None, NotNull()
    ] = None
    """The roles that a certificate may name, "" for one that names none; any when left out."""


class SerialRuleConfig(Model):
    """What the client of a serial line may do."""

    units: dict[SerialUnitId, Name] = Field(min_length=1, json_schema_extra=SERIAL_UNIT_KEYS)
    """The memory behind each unit id, 1 to 247."""
    access: Access
    """Whether the client may write."""
    functions: FunctionList = None
    """The only function codes that are allowed."""
    deny: DenyList = None
    """Function codes that are not allowed, the others are."""


class RawRuleConfig(Model):
    """What some senders of raw ingest packets may write."""

    sources: Sources
    """Networks and addresses of the senders, IPv4 or IPv6."""
    units: dict[RawUnitId, Name] = Field(
        default={}, min_length=1, json_schema_extra=RAW_UNIT_KEYS, exclude_if=lambda v: not v
    )
    """Format v1: the memory behind each unit id, 0 to 65535."""
    memories: MemoryNames = Field(default=(), exclude_if=lambda v: not v)
    """Format crc: the memories that packets may name, by their ids."""
    areas: Areas
    """The areas that may be written."""


class _ConnectionListener(Model):
    """What all servers of Modbus over TCP connections have."""

    type: str
    """The protocol."""
    bind: BindAddress
    """Where to listen: an IP address and a port."""
    max_connections: Connections = 256
    """Connections that are open at once."""
    max_connections_per_source: Connections | None = None
    """Connections that are open at once from one address; null for no limit of its own."""
    when_full: Literal["refuse", "evict"] = "refuse"
    """What becomes of a connection too many: it is refused, or takes the place of the idlest."""
    idle_timeout: DurationOrZero = 300.0
    """Seconds without a request after which a connection is closed; 0 keeps it for ever."""
    request_timeout: Duration = 10.0
    """Seconds from the first byte of a request to its last."""
    rules: Annotated[tuple[RuleConfig, ...], Strict(False), Field(min_length=1)]
    """The first rule whose sources hold the peer settles what it may do."""


class ModbusTcpListener(_ConnectionListener):
    """A Modbus TCP server."""

    type: Literal["modbus-tcp"]
    """The protocol."""


class ServerTlsConfig(Model):
    """Certificates and keys of a server, in PEM; they are read at the start."""

    cert_file: FilePath
    """The certificate that clients are shown, and those between it and its authority."""
    key_file: FilePath
    """The key of that certificate, without a passphrase."""
    ca_file: FilePath
    """The authorities that vouch for clients, and self-signed certificates of clients."""
    crl_file: Annotated[FilePath | None, NotNull()] = None
    """What the authorities have revoked: a list of each authority above a client."""


class ModbusTlsListener(_ConnectionListener):
    """A Modbus TCP server inside TLS, for clients with a certificate (Modbus/TCP Security)."""

    type: Literal["modbus-tls"]
    """The protocol."""
    tls: ServerTlsConfig
    """Who the server is, and which clients it trusts."""
    request_timeout: Duration = 10.0
    """Seconds from the first byte of a request to its last, and for the handshake."""
    rules: Annotated[tuple[TlsRuleConfig, ...], Strict(False), Field(min_length=1)]
    """The first rule whose sources and roles hold the peer settles what it may do."""


class ModbusRtuOverTcpListener(_ConnectionListener):
    """A server of Modbus RTU frames over TCP connections, as serial gateways send them."""

    type: Literal["modbus-rtu-over-tcp"]
    """The protocol."""


class ModbusUdpListener(Model):
    """A Modbus UDP server: one datagram, one request."""

    type: Literal["modbus-udp"]
    """The protocol."""
    bind: BindAddress
    """Where to listen: an IP address and a port."""
    rules: Annotated[tuple[RuleConfig, ...], Strict(False), Field(min_length=1)]
    """The first rule whose sources hold the sender settles what it may do."""


def _stop_bits(data: dict[str, Any]) -> Literal[1, 2]:
    return 2 if data["parity"] == "none" else 1


class SerialConfig(Model):
    """A serial port and how its line is driven."""

    device: DeviceName
    """The serial port, as in /dev/ttyUSB0 or COM3."""
    baud: Annotated[int, Field(ge=50, le=4_000_000)] = 19200
    """Bits a second."""
    parity: Literal["none", "even", "odd"] = "even"
    """The parity bit."""
    stop_bits: StopBits = Field(default_factory=_stop_bits)
    """Stop bits; when left out, 1 with a parity bit and 2 without."""
    data_bits: DataBits = 8
    """Data bits of a character."""


class RtuSerialConfig(SerialConfig):
    """A serial port for Modbus RTU."""

    data_bits: EightBits = 8
    """Data bits of a character."""
    silence: Annotated[
        Annotated[float, Field(ge=0.0001, le=10, allow_inf_nan=False)] | None, NotNull()
    ] = None
    """Seconds of silence that end a frame; when left out, the time of 3.5 characters, and 1.75 ms
    above 19200 baud."""


class AsciiSerialConfig(SerialConfig):
    """A serial port for Modbus ASCII."""

    data_bits: DataBits = 7
    """Data bits of a character."""


class _SerialListener(Model):
    """What all servers on a serial line have."""

    type: str
    """The protocol."""
    serial: SerialConfig
    """The serial port."""
    rules: Annotated[tuple[SerialRuleConfig, ...], Strict(False), Field(min_length=1)]
    """What the client may do; the first rule holds, as a serial line has no addresses."""


class ModbusRtuListener(_SerialListener):
    """A Modbus RTU server on a serial line."""

    type: Literal["modbus-rtu"]
    """The protocol."""
    serial: RtuSerialConfig
    """The serial port."""


class ModbusAsciiListener(_SerialListener):
    """A Modbus ASCII server on a serial line."""

    type: Literal["modbus-ascii"]
    """The protocol."""
    serial: AsciiSerialConfig
    """The serial port."""


def _crc(data: dict[str, Any]) -> Literal["required"] | None:
    return "required" if data["format"] == "crc" else None


class RawIngestListener(Model):
    """A server of raw ingest packets, which write and never read."""

    type: Literal["raw-ingest"]
    """The protocol."""
    format: Literal["v1", "crc"] = "v1"
    """The layout of a packet: 10 bytes of header and a unit id, or 12, a memory id and a CRC."""
    crc: Annotated[Literal["required", "none"] | None, NotNull()] = Field(default_factory=_crc)
    """Whether packets of format crc end with their CRC; `required` when left out."""
    bind: BindAddress
    """Where to listen: an IP address and a port."""
    max_connections: Connections = 256
    """Connections that are open at once."""
    max_connections_per_source: Connections | None = None
    """Connections that are open at once from one address; null for no limit of its own."""
    request_timeout: Duration = 10.0
    """Seconds from the start of a connection to the last byte of its packet."""
    rules: Annotated[tuple[RawRuleConfig, ...], Strict(False), Field(min_length=1)]
    """The first rule whose sources hold the sender settles what it may write."""


Listener: TypeAlias = (
    ModbusTcpListener
    | ModbusTlsListener
    | ModbusRtuOverTcpListener
    | ModbusUdpListener
    | ModbusRtuListener
    | ModbusAsciiListener
    | RawIngestListener
)

CONNECTION_TYPES = ("modbus-tcp", "modbus-tls", "modbus-rtu-over-tcp", "raw-ingest")
DATAGRAM_TYPES = ("modbus-udp",)
SERIAL_TYPES = ("modbus-rtu", "modbus-ascii")
LISTENER_TYPES = (*CONNECTION_TYPES, *DATAGRAM_TYPES, *SERIAL_TYPES)
"""The values of `type`, by what a listener needs: a TCP, UDP or serial port; and all of them."""

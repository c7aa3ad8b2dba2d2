"""The types of arguments and answers, for annotations."""

from __future__ import annotations

from typing import (
    TYPE_CHECKING,
    Literal,
    Protocol,
    SupportsIndex,
    TypeAlias,
    TypedDict,
    get_args,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from os import PathLike

Access: TypeAlias = Literal["read-only", "read-write"]
Area: TypeAlias = Literal["coils", "discrete_inputs", "holding_registers", "input_registers"]
AREAS: tuple[Area, ...] = get_args(Area)
WRITABLE_AREAS: tuple[Area, ...] = ("coils", "holding_registers")
"""The areas that Modbus clients can write."""
BitArea: TypeAlias = Literal["coils", "discrete_inputs"]
RegisterArea: TypeAlias = Literal["holding_registers", "input_registers"]
BIT_AREAS: tuple[BitArea, ...] = get_args(BitArea)
REGISTER_AREAS: tuple[RegisterArea, ...] = get_args(RegisterArea)
SHORT_AREAS: dict[str, Area] = dict(zip(("co", "di", "hr", "ir"), AREAS, strict=True))
"""The areas by their short names."""
KNOWN_AREAS = SHORT_AREAS | dict(zip(("coil", "discrete", "holding", "input"), AREAS, strict=True))
"""The areas by all names but their own that people and lists of manufacturers use."""
SHORT_OF: dict[Area, str] = {area: short for short, area in SHORT_AREAS.items()}


class Integers(Protocol):
    """Integers or bits in a sequence: a list, a tuple, a range or an array of NumPy."""

    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[SupportsIndex]: ...
    def __getitem__(self, part: slice, /) -> Integers: ...


Ranges: TypeAlias = "list[tuple[Area, int, int]]"
"""Areas, first addresses and counts."""

NarrowedRights: TypeAlias = (
    "tuple[Access, list[int] | None, list[int] | None, tuple[Ranges | None, Ranges | None]]"
)
"""Access, functions, denied functions, and the ranges to read and to write.

`None` is everything.
"""

BoolType: TypeAlias = Literal[
    "bool",
    "bit:0",
    "bit:1",
    "bit:2",
    "bit:3",
    "bit:4",
    "bit:5",
    "bit:6",
    "bit:7",
    "bit:8",
    "bit:9",
    "bit:10",
    "bit:11",
    "bit:12",
    "bit:13",
    "bit:14",
    "bit:15",
]
IntegerType: TypeAlias = Literal[
    "int16", "uint16", "int32", "uint32", "int64", "uint64", "bcd16", "bcd32"
]
FloatType: TypeAlias = Literal["float16", "float32", "float64"]
ValueType: TypeAlias = BoolType | IntegerType | FloatType | str
"""A type of `holdfast.values`. Text, bytes and arrays have a length in their names, so not every
name can be listed: `string:20`, `uint16[8]`."""

FourByteOrder: TypeAlias = Literal["ABCD", "DCBA", "BADC", "CDAB"]
ByteOrder: TypeAlias = FourByteOrder | str
"""A byte order of `holdfast.values`: four letters, or eight for a field of eight bytes."""

Transport: TypeAlias = Literal["tcp", "tls", "udp", "rtu+tcp", "ascii+tcp", "rtu+udp"]
"""How a device with an address is talked to."""

TRANSPORTS: tuple[Transport, ...] = get_args(Transport)

Framing: TypeAlias = Literal["mbap", "rtu", "ascii"]
FRAMINGS: dict[str, Framing] = {
    "tcp": "mbap",
    "tls": "mbap",
    "udp": "mbap",
    "rtu+tcp": "rtu",
    "ascii+tcp": "ascii",
    "rtu+udp": "rtu",
}
"""The framing of each transport."""
SERIAL_FRAMES = tuple(each for each in TRANSPORTS if FRAMINGS[each] != "mbap")
"""Those that carry the frames of a serial line. Unit id 0 is its broadcast."""

WhenFull: TypeAlias = Literal["refuse", "evict"]

Extent: TypeAlias = int | tuple[int, int]
"""The addresses of an area: a size, with addresses from 0, or start and size."""

Seal: TypeAlias = tuple[Area, int] | tuple[Area, int, Literal["once", "level"]]
"""The gate bit of a memory: area of bits, address, and mode."""

StatusBlock: TypeAlias = tuple[Area, int, str, bool]
"""A status block of a device: area, slot, name, and whether it keeps the last error."""

Forward: TypeAlias = tuple[
    Literal["v1", "crc"],
    Literal["required", "none"],
    int,
    float,
    list[tuple[Area, int]],
    tuple[int, StatusBlock] | None,
]
"""The packets for a raw ingest receiver of a polled device: format, crc, unit id or memory id,
timeout in seconds, what is added to the addresses of areas, and the status block with its own unit
id or memory id."""

PolledBlock: TypeAlias = tuple[Area, int, int, bytes | None, int, float]
"""One block of a poll: area, address, count, the bytes or `None`, the fault, and the time of the
result in seconds since 1970."""


TlsFiles: TypeAlias = (
    "tuple[str | PathLike[str] | None, str | PathLike[str] | None, str | PathLike[str] | None]"
)
"""Files of trusted authorities, of a certificate, and of its key."""

YamlEvent: TypeAlias = tuple[
    Literal["plain", "quoted", "list", "mapping", "end", "alias"],
    int,
    int,
    int | str | None,
    str | None,
    str | None,
]
"""What it is, its line and column from 1, the anchor that it has or names, its tag and its text."""

ThreadHeartbeat: TypeAlias = tuple[str, float, int | None]
"""A thread's name, seconds since its last heartbeat, and its number in the system, if known."""


class MemoryFileStatus(TypedDict):
    """How storing memories in their file goes.

    `failing`: why contents can't be stored at present. `stored_at`: when they were last stored, in
    seconds since 1970. `commits`: transactions. `pending`: writes that wait to be stored.
    `refused`: writes that were refused because they could not be stored. `busy`: because too many
    waited. `bytes`: size of the file. `recreated`: how often it was gone, and was written anew.
    """

    failing: str | None
    stored_at: float | None
    commits: int
    pending: int
    refused: int
    busy: int
    last_commit_seconds: float
    bytes: int
    recreated: int


class ConnectionCounters(TypedDict):
    """Connections of one listener: `open` is the current number, the others count outcomes."""

    accepted: int
    refused_source: int
    refused_role: int
    tls_failed: int
    refused_full: int
    refused_listen_only: int
    evicted: int
    evicted_handshakes: int
    rights_revoked: int
    ended: int
    idle: int
    request_timeout: int
    slow_reader: int
    accept_errors: int
    open: int


class FrameCounters(TypedDict):
    """Frames that are not requests.

    `foreign`: a protocol id other than 0. `broken`: an impossible length. `damaged`: a wrong
    checksum or character. `other_unit`: on a serial line, a unit that is not served; there
    and over UDP, an exception.
    """

    foreign: int
    broken: int
    damaged: int
    other_unit: int


class PacketCounters(TypedDict):
    """Raw Ingest packets: written packets, their values, and refused packets by reason.

    `surplus_bytes`: bytes behind written packets, where a connection carries one: their sender does
    not speak Raw Ingest, so the values may be wrong. `dropped_bytes`: bytes of packets that ended
    early, behind written ones, where a connection carries many. `held_bytes`: the memory of packets
    that are not complete.
    """

    accepted: int
    values: int
    surplus_bytes: int
    dropped_bytes: int
    held_bytes: int
    refused: dict[str, int]


class ModbusCounters(TypedDict):
    """Counters of a Modbus listener: requests by function code, exceptions by exception code."""

    requests: dict[int, int]
    exceptions: dict[int, int]
    unanswered: int
    connections: ConnectionCounters
    tls_failures: dict[str, int]
    frames: FrameCounters


class RawCounters(TypedDict):
    """Counters of a Raw Ingest listener."""

    packets: PacketCounters
    connections: ConnectionCounters
    tls_failures: dict[str, int]


ListenerCounters: TypeAlias = ModbusCounters | RawCounters


class LogNode(TypedDict):
    """A node of a log: its last message, when the stream stored that, and its last digest."""

    name: str
    sequence: int
    time_ns: int
    digest: tuple[int, str] | None


class LogStatus(TypedDict):
    """The state of a log.

    `failure`: kind and text of the error that ended it. `contact_age`: seconds since the contents
    were current for sure. `steps`, `unavailable`, `not_confirmed`, `not_stored` and `refused` count
    the outcomes of steps of this node. `stale` and `ignored` count messages of the stream that were
    applied before, and that no node has sent. `digest`: sequence, digest, and whether other nodes
    have the same. `snapshot`: the sequence of the newest one. `replicas`: on how many servers it
    is.
    """

    phase: Literal["starting", "running", "returning", "failed", "stopped"]
    failure: tuple[str, str] | None
    connected: bool
    server: str | None
    last_error: str | None
    contact_age: float | None
    sequence: int
    last_sequence: int
    lag: int
    steps: int
    unavailable: int
    not_confirmed: int
    not_stored: int
    refused: int
    stale: int
    ignored: int
    replicas: int
    digest: tuple[int, str, bool | None] | None
    snapshot: int | None
    nodes: list[LogNode]


class LogStep(TypedDict, total=False):
    """A step of a log. Memories are named.

    `writes`: memory, area, address and values. `place` and `masks` are of a mask write: memory,
    area and address; the AND mask and the OR mask. `read` follows the write of `write_then_read`.
    `refused`: why nothing was written.
    """

    access: Literal["client", "ingest", "mirror", "restore"]
    action: Literal["write", "mask", "write_then_read"]
    writes: list[tuple[str, Area, int, list[int]]]
    place: tuple[str, Area, int]
    masks: tuple[int, int]
    read: tuple[str, Area, int, int]
    refused: str


class LogRecord(TypedDict):
    """A message of a log.

    `time_ns`: when the stream stored it, in nanoseconds since 1970. `node`: `None` if no node has
    sent it. `fresh`: `False` if it was applied before.
    """

    sequence: int
    time_ns: int
    node: str | None
    fresh: bool
    steps: list[LogStep]

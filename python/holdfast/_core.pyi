"""The native core: memory and Modbus engine."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from typing import Any, Final, Literal, final

from holdfast.errors import ModbusError
from holdfast.types import Access, Area, Extent, ListenerCounters, PolledBlock, Seal, WhenFull

__all__ = [
    "ADDRESSES",
    "AREAS",
    "EXCEPTIONS",
    "FAULTS",
    "FUNCTIONS",
    "MAX_PDU",
    "SUB_FUNCTIONS",
    "Attempt",
    "BatchRefused",
    "BlockingClient",
    "Connection",
    "Endpoint",
    "Engine",
    "Listener",
    "Memory",
    "OutOfRange",
    "PolledDevice",
    "Poller",
    "RawRule",
    "Request",
    "Rule",
    "ServerTls",
    "__version__",
    "encode_raw_ingest",
    "pack_raw_ingest",
    "plan_blocks",
    "write_across",
]

__version__: str

ADDRESSES: Final[int]
"""How many addresses an area can have."""

MAX_PDU: Final[int]
"""Bytes of the longest request or reply, without what a transport puts around it."""

AREAS: Final[tuple[Area, ...]]
"""The areas, in the order of their functions."""

FUNCTIONS: Final[tuple[tuple[int, str, bool, Area | None, int, int], ...]]
"""Each function: its code, its name, whether it writes, the area it is for, and how many bits or
registers it reads and writes at most."""

SUB_FUNCTIONS: Final[tuple[tuple[int, str, bool], ...]]
"""Each sub-function of function 8: its code, its name, and whether it changes the device."""

EXCEPTIONS: Final[dict[int, str]]
"""The names of exceptions by their codes."""

FAULTS: Final[dict[str, int]]
"""Why a device did not answer, as a word: the codes that status blocks and the poller have."""

class OutOfRange(IndexError):
    """A range that is not inside its area; nothing was read or written."""

@final
class Memory:
    """Four areas of bits and 16-bit registers, of fixed size, all 0 at first.

    An area is given by its size (addresses from 0), or by start and size; one that is left out does
    not exist. `start + size` is at most 65536. Every read sees all of a write or none of it,
    whoever writes, and a write that is refused changes nothing. Any thread may call any method.

    `seal` names the gate bit, in coils or discrete inputs: Modbus clients are answered with
    exception 06 until a write from here leaves that bit at 1: for good (`once`), or as long as it
    is 1 (`level`).

    Raises `ValueError` for a size or gate that can't be.
    """

    def __new__(
        cls,
        *,
        coils: Extent | None = None,
        discrete_inputs: Extent | None = None,
        holding_registers: Extent | None = None,
        input_registers: Extent | None = None,
        seal: Seal | None = None,
    ) -> Memory: ...
    @property
    def areas(self) -> dict[Area, range]:
        """The addresses of each area that exists."""

    @property
    def sealed(self) -> bool:
        """Whether Modbus clients are refused for now."""

    @property
    def seal_changes(self) -> tuple[int, int]:
        """How often the seal opened, and how often it closed again."""

    def read(self, area: Area, address: int, count: int) -> list[int]:
        """`count` bits (0 or 1) or registers (0 to 65535) from `address`, of one moment.

        Raises `OutOfRange` outside the area, `ValueError` for an unknown area or a count below 1.
        """

    def read_many(self, ranges: Sequence[tuple[Area, int, int]]) -> list[list[int]]:
        """Several ranges of one moment, each as area, address and count; raises as `read`."""

    def write(self, area: Area, address: int, values: Iterable[int]) -> None:
        """Writes bits (0, 1, False, True) or registers (integers 0 to 65535) as one step.

        Raises `OutOfRange` outside the area, `ValueError` for no values, a value too large or an
        unknown area, `TypeError` for a value of another type; nothing has changed then.
        """

    def write_many(self, writes: Sequence[tuple[Area, int, Iterable[int]]]) -> None:
        """Several writes of any areas as one step, each as area, address and values.

        A later one wins where two overlap. Raises as `write`; when one is refused, none is done.
        """

class BatchRefused(ValueError):
    """A write of a batch that is refused; nothing has changed."""

    command: int
    """The index of the write in the batch."""
    index: int | None
    """The index of the value in the write, if the value is refused."""
    reason: Literal[
        "invalid_area",
        "empty",
        "out_of_range",
        "invalid_value",
        "invalid_type",
        "sealed",
        "gate_bit",
        "wrong_length",
        "not_registers",
    ]
    """`invalid_type` is a value of another type, or with `index` `None`, values that are no
    sequence of integers; `invalid_value` an integer that is too small or too large."""

def write_across(writes: Iterable[tuple[Memory, Area, int, Iterable[int]]]) -> int:
    """Writes to several memories as one step, each with memory, area, address and values.

    Returns how many values were written. No reader of any of the memories sees a part.

    Raises `BatchRefused` for the first write whose area, number of values or range is wrong, then
    for the first wrong value; no write is done then. An exception of `writes` itself comes before
    one of a later write, and before one of any value.
    """

@final
class Rule:
    """What peers from some networks may do.

    `units` maps unit ids, 0 to 255, to memories; `sources` are networks or addresses, IPv4 or IPv6
    (an IPv4 address mapped into IPv6 is that IPv4 address). `functions` is a list of the function
    codes that are allowed, `deny` of those that are not; both exclude each other. `roles` are those
    that the certificate of a peer may name, over TLS only; "" is the null role, `None` any role.

    Raises `ValueError` for a source or access that can't be.
    """

    def __new__(
        cls,
        units: Mapping[int, Memory],
        *,
        sources: Sequence[str],
        access: Access,
        functions: Sequence[int] | None = None,
        deny: Sequence[int] | None = None,
        roles: Sequence[str] | None = None,
    ) -> Rule: ...

@final
class RawRule:
    """What senders of Raw Ingest packets from some sources may write.

    `targets` maps unit ids (v1) or memory ids (crc), 0 to 65535, to memories. Raises `ValueError`
    for an id, source or area that can't be.
    """

    def __new__(
        cls, targets: Mapping[int, Memory], *, sources: Sequence[str], areas: Sequence[Area]
    ) -> RawRule: ...

@final
class ServerTls:
    """What a server needs for TLS with mutual authentication, of files in PEM that are read now.

    `ca_file` has the authorities that vouch for clients, and self-signed certificates of clients;
    `crl_file` the lists of what these authorities revoked. Raises `ValueError` for a file that
    can't be used.
    """

    def __new__(
        cls,
        *,
        cert_file: str | PathLike[str],
        key_file: str | PathLike[str],
        ca_file: str | PathLike[str],
        crl_file: str | PathLike[str] | None = None,
    ) -> ServerTls: ...

@final
class Listener:
    """The settings of a listener; as constructed, one for Modbus over TCP connections.

    `framing` is `mbap` for Modbus TCP, `rtu` for RTU over TCP; with `tls` it is spoken inside TLS.
    Times are in seconds, `idle_timeout` 0 is for ever. Raises `ValueError` for an address, limit or
    time that can't be.
    """

    def __new__(
        cls,
        name: str,
        bind: str,
        rules: Sequence[Rule],
        *,
        framing: Literal["mbap", "rtu"] = "mbap",
        max_connections: int = 256,
        max_connections_per_source: int | None = None,
        when_full: WhenFull = "refuse",
        idle_timeout: float = 300.0,
        request_timeout: float = 10.0,
        tls: ServerTls | None = None,
    ) -> Listener: ...
    @staticmethod
    def udp(name: str, bind: str, rules: Sequence[Rule]) -> Listener:
        """For Modbus over UDP."""

    @staticmethod
    def serial(
        name: str,
        device: str,
        rule: Rule,
        *,
        mode: Literal["rtu", "ascii"],
        baud: int,
        parity: Literal["none", "even", "odd"],
        stop_bits: int,
        data_bits: int,
        silence: float | None = None,
    ) -> Listener:
        """For a serial line; the rule's sources are not looked at.

        `silence` in seconds ends an RTU frame, `None` is 3.5 characters.
        """

    @staticmethod
    def raw_ingest(
        name: str,
        bind: str,
        rules: Sequence[RawRule],
        *,
        format: Literal["v1", "crc"] = "v1",
        crc: Literal["required", "none"] = "required",
        max_connections: int = 256,
        max_connections_per_source: int | None = None,
        request_timeout: float = 10.0,
    ) -> Listener:
        """For Raw Ingest packets."""

@final
class Engine:
    """Listeners on native threads, served from construction to `stop`.

    `identity` holds identification objects by id, 0 to 2 among them; `events` says which of the
    listeners' events are kept for `next_event`, `audit` whether writes are for `next_writes`.

    Raises `OSError` when a listener can't be bound or a device opened (then none is served),
    `ValueError` for an identity that can't be served.
    """

    def __new__(
        cls,
        listeners: Sequence[Listener],
        *,
        identity: Sequence[tuple[int, str]],
        unit_names: Sequence[tuple[int, str]] | None = None,
        workers: int = 1,
        events: Literal["nothing", "refusals", "all"] = "nothing",
        audit: bool = False,
    ) -> Engine: ...
    @property
    def addresses(self) -> list[tuple[str, int] | None]:
        """Where each listener listens, in the order they were given; `None` for serial lines."""

    def counters(self) -> dict[str, ListenerCounters]:
        """The counters of each listener by name, since the start."""

    def next_event(self, timeout: float) -> tuple[str, str, str | None, str | None] | None:
        """Listener, kind, peer and reason of the next event, if one comes in `timeout` seconds.

        The reason of `refused_role` is the role.
        """

    @property
    def lost_events(self) -> int:
        """Events that were lost because nobody took them."""

    def next_writes(self, timeout: float, most: int) -> list[dict[str, object]]:
        """Up to `most` writes that came in, done or refused, as fields of an audit log.

        Waits up to `timeout` seconds for the first.
        """

    @property
    def lost_writes(self) -> int:
        """Writes that `next_writes` misses because nobody took them."""

    def stop(self) -> None:
        """Answers what was received and ends; returns within a second. From any thread."""

@final
class Request:
    """A request of a client, checked and encoded; raises `ValueError` for what can't be asked."""

    @staticmethod
    def read(area: Area, address: int, count: int) -> Request:
        """Functions 1 to 4, by the area."""

    @staticmethod
    def write_coil(address: int, value: bool) -> Request:
        """Function 5."""

    @staticmethod
    def write_register(address: int, value: int) -> Request:
        """Function 6."""

    @staticmethod
    def write_coils(address: int, values: Iterable[int]) -> Request:
        """Function 15."""

    @staticmethod
    def write_registers(address: int, values: Iterable[int]) -> Request:
        """Function 16."""

    @staticmethod
    def mask_write(address: int, and_mask: int, or_mask: int) -> Request:
        """Function 22."""

    @staticmethod
    def read_write(
        read_address: int, count: int, write_address: int, values: Iterable[int]
    ) -> Request:
        """Function 23."""

    @staticmethod
    def diagnostics(sub_function: int, data: bytes) -> Request:
        """Function 8."""

    @staticmethod
    def event_counter() -> Request:
        """Function 11."""

    @staticmethod
    def report_server_id() -> Request:
        """Function 17."""

    @staticmethod
    def identification(code: int, object_id: int) -> Request:
        """Function 43/14."""

    @property
    def pdu(self) -> bytes:
        """As it is sent."""

@final
class Endpoint:
    """What a client, or the poller, talks to. Raises `ValueError` for what can't be."""

    @staticmethod
    def network(
        transport: Literal["tcp", "udp", "rtu+tcp", "ascii+tcp", "rtu+udp"], host: str, port: int
    ) -> Endpoint:
        """A device, or a gateway, behind an address."""

    @staticmethod
    def tls(
        host: str,
        port: int,
        ca: str | PathLike[str] | None = None,
        cert: str | PathLike[str] | None = None,
        key: str | PathLike[str] | None = None,
        name: str | None = None,
    ) -> Endpoint:
        """Modbus TCP over TLS; the files, in PEM, are read now.

        `ca` has the certificates that are trusted, of authorities or of the device itself; without
        it they are the system's. `name` is the one that the device's certificate has if it is not
        `host`. Raises `OSError` and `ValueError` for files that can't be used.
        """

    @staticmethod
    def serial(
        device: str,
        *,
        mode: Literal["rtu", "ascii"],
        baud: int,
        parity: Literal["none", "even", "odd"],
        stop_bits: int,
        data_bits: int,
        silence: float | None = None,
    ) -> Endpoint:
        """A serial line."""

    def tolerating(
        self,
        *,
        accept_unit: int | Literal["any"] | None = None,
        pad: bool = False,
        echo: bool = False,
        pause: float = 0.0,
        pause_after_connect: float = 0.0,
        retries: int = 0,
        retry_busy: bool = False,
        close_after: int = 0,
        reconnect: float = 0.0,
    ) -> Endpoint:
        """The same device, treated as `holdfast.client.tolerance.Tolerance` says."""

@final
class BlockingClient:
    """One request and its reply at a time, over any transport; connects when it is needed.

    Any thread may call it; the calls take turns. The interpreter is free while a call waits.
    """

    def __new__(cls, endpoint: Endpoint) -> BlockingClient: ...
    def call(self, request: Request, unit: int, timeout: float) -> Any:
        """The result of a request: values, bytes, or `None` for a write.

        Raises `holdfast.ModbusError`.
        """

    def close(self) -> None:
        """Ends the connection; the next call makes a new one."""

    @property
    def late(self) -> int:
        """Replies that came after their requests had been given up."""

@final
class Connection:
    """A TCP connection of a client, with TLS or not, for whoever owns its socket.

    Times are those of the owner's clock, in seconds. Completed requests are tickets, each with a
    result, a `ModbusError`, or an `Attempt` when the request may be sent again.
    """

    def __new__(cls, endpoint: Endpoint, now: float) -> Connection: ...
    @property
    def is_ready(self) -> bool:
        """Whether requests can be sent: TLS, if there is any, is agreed on."""

    def send(
        self,
        request: Request,
        unit: int,
        timeout: float,
        now: float,
        attempt: Attempt | None = None,
    ) -> int:
        """Queues a request; its ticket. Raises why the connection has ended."""

    def outgoing(self) -> bytes:
        """The bytes to send now."""

    def receive(self, data: bytes, now: float) -> list[tuple[int, Any]]:
        """Takes received bytes; the requests that they complete."""

    def advance(self, now: float) -> list[tuple[int, Any]]:
        """Ends the requests whose time is over."""

    @property
    def deadline(self) -> float | None:
        """When `advance` is to be called."""

    def cancel(self, ticket: int) -> None:
        """Drops a request: its reply, should it come, is counted."""

    def close(self) -> list[tuple[int, Any]]:
        """Ends the connection, and with it all requests. Bytes may be left to send."""

    def lost(self, error: str | None = None) -> list[tuple[int, Any]]:
        """The network has ended the connection; `error` is why, unless that was its regular end."""

    @property
    def closed(self) -> ModbusError | None:
        """Why it has ended; `None` while it has not."""

    @property
    def late(self) -> int:
        """Replies that came after their requests had been given up."""

@final
class Attempt:
    """A request that failed may be sent again. Given to `Connection.send` then."""

    @property
    def pause(self) -> float:
        """Seconds to wait before."""

    @property
    def has_own_timeout(self) -> bool:
        """Whether its timeout begins anew."""

@final
class PolledDevice:
    """A device to be polled: what is read, how often, and where it goes.

    `reads` are areas, addresses, counts and destinations (memory, area, address) or `None`.
    `max_gap` (0 when left out) or `cost` (of a request, of a register or 16 bits) says which holes
    are read; `readable` and `forbidden` are areas with start and end, the end not included.
    `forward` are hosts, ports, formats (`v1`, `crc`), crc (`required`, `none`), unit or memory ids,
    and timeouts. `status` is the memory, area and slot of the status block. `start_within` is when
    the first poll comes at the latest, an interval when left out; `report` hands polls to
    `Poller.results`; `release` closes the connection after each; with `measured` the device's own
    answers say what `cost` is after a while. Times are in seconds; interval 0 polls
    without a pause.
    """

    def __new__(
        cls,
        name: str,
        endpoint: Endpoint,
        *,
        unit: int,
        interval: float,
        timeout: float,
        reads: Sequence[tuple[Area, int, int, tuple[Memory, Area, int] | None]],
        max_gap: int | None = None,
        cost: tuple[float, float] | None = None,
        max_registers: int = 125,
        max_bits: int = 2000,
        readable: Sequence[tuple[Area, int, int]] | None = None,
        forbidden: Sequence[tuple[Area, int, int]] | None = None,
        forward: Sequence[tuple[str, int, str, str, int, float]] | None = None,
        status: tuple[Memory, Area, int] | None = None,
        start_within: float | None = None,
        in_flight: int | None = 1,
        report: bool = False,
        release: bool = False,
        measured: bool = False,
    ) -> PolledDevice: ...

@final
class Poller:
    """Devices that are polled by a native thread, from construction to `stop`.

    Raises `ValueError` for a read that no request can carry or a destination that it does not fit.
    """

    def __new__(cls, devices: Sequence[PolledDevice]) -> Poller: ...
    def add(self, device: PolledDevice) -> None:
        """Polls one more device.

        Raises `ValueError`, also for a name that is taken, and `RuntimeError` after `stop`.
        """

    def replace(self, name: str, device: PolledDevice, *, at_once: bool = True) -> None:
        """Polls a device in the place of the one called `name`; it may have the same name.

        The poll under way is completed; counters, connection and schedule stay. `at_once` the new
        device reads once beside the schedule; not more often than each second, or each interval if
        that is shorter. Raises `ValueError`, and `RuntimeError` after `stop`; then nothing has
        changed.
        """

    def write(self, name: str, request: Request) -> int:
        """Sends a write to a device over its own connection, between two reads.

        Returns the number under which `results` has its outcome. Raises `ValueError` for an
        unknown device and a request that does not write, `RuntimeError` after `stop`.
        """

    def remove(self, name: str) -> bool:
        """Stops polling a device; whether there was one of that name."""

    def results(
        self, timeout: float
    ) -> (
        tuple[
            list[tuple[str, float, list[PolledBlock]]],
            list[tuple[int, int]],
        ]
        | None
    ):
        """All polls of devices with `report`, and all writes, since the last call.

        Waits up to `timeout` seconds for the first. A poll is a device, the seconds from the
        poller's start to when the schedule wanted it (to when it began, if that was beside the
        schedule), and its blocks as they were asked: area, address, count, the bytes (`None` when
        there are none), the fault as a status block tells it, and the seconds since 1970 when that
        was known. A write is its number and the fault, 0 when the device has confirmed it. `None`
        when the poller has stopped and nothing is left.
        """

    @property
    def dropped(self) -> int:
        """Polls that `results` misses because nobody took them."""

    def counters(self) -> dict[str, dict[str, Any]]:
        """How each device does, by name: its health, counters, and those of its forwards.

        `age` is that of the last valid answer, `None` before the first. `plan_error` says why no
        plan reads the device, `None` as long as one does. `unplanned` counts the polls that were
        left out for that, `unstored` the reads and status blocks that memory refused.
        """

    def stop(self) -> None:
        """Stops polling. From any thread."""

def pack_raw_ingest(area: Area, values: list[int]) -> bytes:
    """The payload of a Raw Ingest packet.

    Raises `ValueError` for a value too large and an unknown area, `TypeError` for one of another
    type.
    """

def encode_raw_ingest(
    payload: bytes,
    *,
    area: Area,
    address: int,
    count: int,
    target: int,
    format: Literal["v1", "crc"],
    crc: Literal["required", "none"],
) -> bytes:
    """A Raw Ingest packet; `target` is a unit id (v1) or a memory id (crc).

    Raises `ValueError` for a payload that is not that of `count` values, `OverflowError` for a
    number beyond 65535.
    """

def plan_blocks(
    fields: Sequence[tuple[Area, int, int]],
    *,
    max_gap: int | None = None,
    cost: tuple[float, float] | None = None,
    max_registers: int = 125,
    max_bits: int = 2000,
    readable: Sequence[tuple[Area, int, int]] | None = None,
    forbidden: Sequence[tuple[Area, int, int]] | None = None,
) -> list[tuple[Area, int, int, list[int], int]]:
    """The requests that read all fields (area, address, count), none of which is split.

    Each is an area, an address, a count, the indexes of its fields, and how many items no field
    wants. Raises `ValueError` for a field that no request may read.
    """

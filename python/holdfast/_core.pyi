"""The native core: memory and Modbus engine."""

from __future__ import annotations

from asyncio import AbstractEventLoop, Future
from collections.abc import Callable, Iterable, Mapping, Sequence
from os import PathLike
from typing import Any, Final, Literal, Self, SupportsIndex, final

from holdfast.errors import ModbusError
from holdfast.server.options import (
    DatagramOptions,
    RawIngestOptions,
    SerialOptions,
    StreamOptions,
)
from holdfast.server.write_callback import WriteCallback
from holdfast.types import (
    Access,
    Area,
    BitArea,
    Extent,
    Forward,
    ListenerCounters,
    LogRecord,
    LogStatus,
    MemoryFileStatus,
    NarrowedRights,
    PolledBlock,
    Seal,
    StatusBlock,
    ThreadHeartbeat,
    TlsFiles,
    WhenFull,
    YamlEvent,
)

__all__ = [
    "ADDRESSES",
    "AREAS",
    "CONTACTS_PER_LAG",
    "EXCEPTIONS",
    "FAULTS",
    "FUNCTIONS",
    "LAST_RECORD",
    "LINK_QUEUE",
    "MAX_IN_FLIGHT",
    "MAX_LAG_S",
    "MAX_LATENESS_S",
    "MAX_LINK_QUEUE",
    "MAX_PDU",
    "READ_FUNCTIONS",
    "READ_RECORDS",
    "RETRY_PAUSES_S",
    "RETRY_REFUSED_AFTER_S",
    "SUB_FUNCTIONS",
    "TLS_REASONS",
    "UNMEASURED_COST_MS",
    "WRITE_RECORDS",
    "WRITE_TIMEOUT_S",
    "Attempt",
    "Batch",
    "BatchRefused",
    "BlockingClient",
    "Caller",
    "Commands",
    "Connection",
    "Endpoint",
    "Engine",
    "Fence",
    "Follower",
    "HttpExchange",
    "HttpServer",
    "Link",
    "Listener",
    "ListeningSocket",
    "Log",
    "LogError",
    "LogReader",
    "Memory",
    "MemoryFile",
    "MirrorAge",
    "OutOfRange",
    "ParsedWrites",
    "Passage",
    "PollReceiver",
    "PolledDevice",
    "Poller",
    "RawRule",
    "Request",
    "Route",
    "Rule",
    "ServerTls",
    "Stale",
    "TlsChannel",
    "UnusableMemoryFile",
    "Withdrawal",
    "WriteQueue",
    "__version__",
    "check_log_name",
    "check_log_node",
    "encode_raw_ingest",
    "https_server_tls",
    "pack_raw_ingest",
    "plan_blocks",
    "read_memory_file",
    "release_memory_file",
    "write_disabled_status",
    "yaml_events",
]

__version__: str

ADDRESSES: Final[int]
"""Maximum number of addresses in an area."""

MAX_PDU: Final[int]
"""Maximum size of a request or reply in bytes, without the framing of a transport."""

AREAS: Final[tuple[Area, ...]]
"""The areas, in the order of their functions."""

FUNCTIONS: Final[tuple[tuple[int, str, bool, Area | None, int, int], ...]]
"""Each function: code, name, whether it writes, its area, and the maximum number of bits or
registers that it reads and writes."""

READ_FUNCTIONS: Final[tuple[tuple[Area, int], ...]]
"""The code of the function that reads each area."""

SUB_FUNCTIONS: Final[tuple[tuple[int, str, bool], ...]]
"""Each sub-function of function 8: code, name, and whether it changes the device."""

READ_RECORDS: Final[int]
"""Maximum number of file records that one request reads."""

WRITE_RECORDS: Final[int]
"""Maximum number of file records that one request writes."""

LAST_RECORD: Final[int]
"""The last record number of a file."""

EXCEPTIONS: Final[dict[int, str]]
"""The names of exceptions, by code."""

FAULTS: Final[dict[str, int]]
"""Why a device did not answer, as a word, with its code in status blocks and the poller."""

TLS_REASONS: Final[tuple[str, ...]]
"""Why TLS failed, as a word."""

MAX_LATENESS_S: Final[float]
"""How long after its timeout a late reply may come, without transaction ids."""

RETRY_PAUSES_S: Final[tuple[float, float]]
"""The first and the longest pause after failures, where a device has no others."""

RETRY_REFUSED_AFTER_S: Final[float]
"""Seconds after which what a device refuses to read is tried again."""

UNMEASURED_COST_MS: Final[tuple[float, float]]
"""The costs of a request and of a register until a device with `max_gap: auto` is measured."""

MAX_IN_FLIGHT: Final[int]
"""The most requests in flight on one connection."""

LINK_QUEUE: Final[int]
"""How many requests may wait for a link that has no other number."""

MAX_LINK_QUEUE: Final[int]
"""The largest such number that a link can have."""

WRITE_TIMEOUT_S: Final[float]
"""The time until a write that a log has not confirmed is answered, where it has no other."""

CONTACTS_PER_LAG: Final[int]
"""How often a node of a log without writes has contact with it, in the time of `max_lag`."""

MAX_LAG_S: Final[float]
"""The time without contact until a node of a log is behind, where the log has no other."""

class OutOfRange(IndexError):
    """The range is not inside the area. Nothing was read or written."""

@final
class Memory:
    """Four areas of bits and 16-bit registers, of fixed size, initially 0.

    An area is a size (addresses from 0), or start and size; an omitted area does not exist.
    `start + size` is at most 65536. `files` maps numbers of files, 1 to 65535, to their numbers of
    records, 1 to 10000; `read` and `write` have them as the areas `file:NUMBER`. Every read sees a
    whole write or none of it, and a refused write changes nothing. Methods are thread-safe.

    `seal` is the gate bit, in coils or discrete inputs. Modbus clients receive exception 06 until a
    write other than by Modbus sets that bit to 1: permanently (`once`), or while it is 1 (`level`).
    `name` is its name in the audit log.

    Raises `ValueError` for an invalid size or gate bit.
    """

    def __new__(
        cls,
        *,
        coils: Extent | None = None,
        discrete_inputs: Extent | None = None,
        holding_registers: Extent | None = None,
        input_registers: Extent | None = None,
        files: Mapping[int, int] | None = None,
        seal: Seal | None = None,
        name: str | None = None,
    ) -> Memory: ...
    @property
    def areas(self) -> dict[Area, range]:
        """The addresses of each area that exists."""

    @property
    def files(self) -> dict[int, int]:
        """The number of records of each file."""

    @property
    def sealed(self) -> bool:
        """Whether the memory is sealed, so Modbus clients receive exception 06."""

    @property
    def waits(self) -> bool:
        """Whether a write waits until it is kept: in a file, or in a log."""

    @property
    def seal_changes(self) -> tuple[int, int]:
        """How often the seal opened, and how often it closed again."""

    def read(self, area: str, address: int, count: int) -> list[int]:
        """Reads `count` bits (0 or 1) or registers (0 to 65535) from `address`, as one snapshot.

        Raises `OutOfRange` outside the area, `ValueError` for an unknown area or a count below 1,
        `OSError` while the log of the memory does not let it be read, or the values of a mirrored
        device are too old.
        """

    def mirror(
        self,
        reserved: Sequence[tuple[Area, int, int]],
        aging: Sequence[tuple[Area, int, int, MirrorAge]] = ...,
    ) -> None:
        """Reserves ranges (area, address, count) for the poller; others can't write them any more.

        `aging` are ranges whose age is known, reserved or not; while one is too old, only the
        poller uses it. Both replace those of an earlier call. Raises `ValueError` for a range
        outside its area.
        """

    def read_many(self, ranges: Sequence[tuple[str, int, int]]) -> list[list[int]]:
        """Reads several ranges (area, address, count) as one snapshot. Raises like `read`."""

    def write(self, area: str, address: int, values: Iterable[SupportsIndex]) -> None:
        """Writes bits (0, 1, False, True) or registers (integers 0 to 65535) in one step.

        Raises `OutOfRange` outside the area, `ValueError` for no values, a value out of range, an
        unknown area or a reserved range, `TypeError` for a value of another type, `OSError` if the
        memory is kept in a file or a log that can't be written, or the values of a mirrored device
        are too old. An error changes nothing, except that a log may still carry out a write that it
        did not confirm in time.
        """

    def write_many(self, writes: Sequence[tuple[str, int, Iterable[SupportsIndex]]]) -> None:
        """Writes to several ranges (area, address, values) in one step.

        Where two overlap, the later one wins. Raises the errors of `write`; an error in one write
        prevents all.
        """

    def on_write(
        self, callback: Callable[[str, int, list[int]], object], *, clients_only: bool = False
    ) -> WriteCallback:
        """Calls `callback(area, address, values)` after every write to this memory.

        The area of records is `file:NUMBER`, as in `write`.

        Writes are those of Modbus clients and of everything else, also of this program; with
        `clients_only`, only those of Modbus clients. A write that changes no value is one too, and
        a write of several ranges is several calls. The calls are in the order of the writes, on one
        thread of their own, and hold up neither the memory nor a client. If the callback is slower
        than the writes, the oldest are dropped and counted.

        An exception of the callback goes to `threading.excepthook`; the next call follows. A
        callback that writes to the same memory is called for that write as well, unless
        `clients_only` is set. Close the result to end the calls; they also end with the program.
        """

class Stale(OSError):
    """The range mirrors a device, and its values are older than allowed."""

@final
class MirrorAge:
    """How old the values of a range are: the device that has it as a destination renews it.

    With a `lease`, so do the values that a log brings from that device, read by any node. Values
    are stale `after` seconds, and before the first read. With `refuses`, a memory refuses to read
    and write them then. Thread-safe; the time goes on while the machine is suspended.
    """

    def __new__(cls, after: float, *, refuses: bool, lease: int | None = ...) -> MirrorAge: ...
    def set(self, after: float, *, refuses: bool) -> None:
        """Changes the settings. The age of the values stays."""

    @property
    def seconds(self) -> float | None:
        """The age of the last values; `None` if there are none yet."""

    @property
    def stale_for(self) -> float | None:
        """For how many seconds the values have been stale; `None` if they are not."""

@final
class MemoryFile:
    """A file that keeps the contents of memories, by their names.

    Opens or creates the file, and loads contents into the memories before anybody uses them. With
    `sync` 0, it stores every write before it is answered; otherwise it stores changes every `sync`
    seconds, with one thread. With `of_log`, the memories are all those of a log, and `sync` is more
    than 0.

    Raises `UnusableMemoryFile`, and other `OSError`s for a file that is locked by another process,
    or can't be read or written; the file and the memories are unchanged then. Raises `ValueError`
    for memories that can't be kept together.
    """

    def __new__(
        cls,
        path: str | PathLike[str],
        memories: Sequence[tuple[str, Memory]],
        sync: float,
        *,
        of_log: bool = False,
    ) -> MemoryFile: ...
    @property
    def loaded(self) -> list[str]:
        """The names of the memories whose contents come from the file."""

    @property
    def warnings(self) -> list[str]:
        """Areas that were resized, and memories in the file that are not given."""

    @property
    def note(self) -> bytes | None:
        """What the log has noted of the contents that were loaded: for `Log.resume`."""

    def start(self, log: Log | None = None) -> None:
        """Stores what the memories contain, and goes on storing. A second call does nothing.

        With `of_log`, `log` is the log of the memories, which has started. Raises `OSError` if the
        contents can't be stored.
        """

    def stop(self) -> None:
        """Stores what is left, and closes the file. A second call does nothing.

        With `sync` 0, writes are refused from now on. Raises `OSError` if the last contents are not
        stored.
        """

    def status(self) -> MemoryFileStatus:
        """How storing goes."""

class UnusableMemoryFile(OSError):
    """A file of memories is damaged, of another program, of a newer version, or of another log."""

def read_memory_file(
    path: str | PathLike[str], *, set_aside: bool = False
) -> dict[str, dict[Area, tuple[int, int, bytes]]]:
    """Checks a file without changing it, and returns the areas of its memories.

    With `set_aside`, returns what was cut from them instead.

    An area is its first address, its size, and its bytes. Registers are big-endian; bits are
    packed, least significant bit first, and the last byte is padded with 0. Raises the `OSError`s
    of `MemoryFile`.
    """

def release_memory_file(path: str | PathLike[str], memory: str) -> bool:
    """Deletes what was cut from a memory of the file. Returns whether there was anything.

    Raises the `OSError`s of `MemoryFile`.
    """

@final
class Follower:
    """Follows ranges of a memory, each an area, an address and a count. Ignores the seal.

    Costs the writers of the memory nothing. Raises as `Memory.read`.
    """

    def __new__(cls, memory: Memory, ranges: Sequence[tuple[Area, int, int]]) -> Follower: ...
    def changes(self) -> tuple[int, list[tuple[int, int, list[int]]]]:
        """Returns the number of writes to the memory, and what has changed since the last call.

        A change is the index of its range, an address, and the values from there: the shortest part
        that contains all changes of the range. The first call, and the first one after an error,
        return all ranges as a whole. Raises `OSError` while the log of the memory does not allow
        to read it.
        """

@final
class WriteQueue:
    """The writes to a memory, in their order. It is bounded: it drops the oldest writes."""

    def next(self, timeout: float) -> tuple[str, int, list[int]] | None:
        """Waits for the next write: area or file, address, values.

        Returns `None` after `timeout` seconds, and when the queue is closed.
        """

    def close(self) -> None:
        """Closes the queue, and drops what waits in it."""

    @property
    def is_closed(self) -> bool:
        """Whether the queue is closed, or its memory is gone."""

    @property
    def dropped(self) -> int:
        """How many writes were dropped because the queue was full."""

@final
class Commands:
    """Parses JSON commands of a source, of at most `most` bytes.

    `targets` are what it may write: name of a memory, the same in JSON, the memory, and areas.
    """

    def __new__(
        cls, targets: Sequence[tuple[str, bytes, Memory, Sequence[Area]]], most: int
    ) -> Commands: ...

@final
class ParsedWrites:
    """Writes of several requests, which the core has parsed and checked.

    They are of commands in the form that nearly all have: one object, text without escapes,
    integers. What has another form, or is refused, comes as a request.
    """

    @property
    def handler(self) -> Callable[[ParsedWrites], Callable[[], object]]:
        """The function that takes them, and returns the second step."""

    def lines(self, before: bytes, after: bytes) -> list[bytes]:
        """The lines of the audit log, in JSON, without time and place in the chain.

        Each begins with `before`, the address of the peer, and `after`.
        """

    def write(self) -> list[tuple[str, int]]:
        """Carries them out in their order, each in one step of its own.

        Returns the memory of each that was carried out, and how many values it has.
        """

    def respond(
        self, status: int, headers: Sequence[tuple[bytes, bytes]], bodies: Sequence[bytes]
    ) -> None:
        """Answers those that were carried out, as `HttpExchange.respond` does."""

    def requests(self) -> list[tuple[Any, ...]]:
        """Takes the requests of the others, as those of `HttpServer.take`."""

class BatchRefused(ValueError):
    """A write of a batch is refused. Nothing has changed."""

    command: int
    """The index of the write in the batch."""
    index: int | None
    """The index of the refused value in the write, `None` if the error is not in one value."""
    reason: Literal[
        "invalid_area",
        "empty",
        "out_of_range",
        "invalid_value",
        "invalid_type",
        "sealed",
        "unsealed",
        "gate_bit",
        "wrong_length",
        "not_registers",
        "mirrored",
        "stale",
        "not_one_step",
        "busy",
        "too_large",
        "not_stored",
        "log_unavailable",
        "not_confirmed",
    ]
    """`invalid_type`: a value of another type, or with `index` `None`, values that are not a
    sequence of integers. `invalid_value`: an integer out of range."""
    detail: str
    """The reason as a sentence. Only of refusals by the memory, or by what keeps it."""

@final
class Batch:
    """Writes to several memories (memory, area, address, values), which were checked.

    Readers of the memories see all writes or none. If one write ends with `True`, the batch is
    written only while all its memories are sealed: they are judged under the locks of the write.
    """

    def __new__(
        cls,
        writes: Iterable[
            tuple[Memory, Area, int, Iterable[int]] | tuple[Memory, Area, int, Iterable[int], bool]
        ],
    ) -> Batch:
        """Checks the form of the writes, and their ranges.

        Raises `BatchRefused` for the first write with an invalid area, number of values or range,
        else for the first invalid value. An exception from the iterable `writes` takes precedence
        over errors in later writes, and over errors in values.
        """

    def check(self) -> None:
        """Checks what can be known before the memories are locked. Raises `BatchRefused`."""

    def lines(
        self, origin: bytes, names: Sequence[bytes], outcome: str, sequence: int | None = None
    ) -> list[bytes]:
        """The lines of the audit log for the writes, in JSON, without time and place in the chain.

        `origin` is the beginning of each line, `names` are those of the memories in JSON.
        """

    @property
    def can_be_refused(self) -> bool:
        """Whether `write` can still raise `BatchRefused` after `check`.

        A journal may refuse, a memory may not be sealed, or values may be stale.
        """

    def write(self) -> tuple[int, int | None]:
        """Writes all values in one step.

        Returns the number of written values, and the sequence of the step if a log has carried it
        out. Raises `BatchRefused`; nothing has changed then.
        """

    def submit(self, ended: Callable[[tuple[int, int | None] | BatchRefused], object]) -> None:
        """As `write`, but returns at once.

        The journal of the memories carries out the write, and calls `ended` in another thread, with
        the result or the error.
        """

@final
class Rule:
    """What the peers of some networks may do, or the client of a serial line.

    `units` maps unit ids, 0 to 255, to memories, routes and passages. `sources` are networks or
    addresses, IPv4 or IPv6; a peer's IPv4-mapped IPv6 address counts as its IPv4 address. A network
    requires them, a serial line has none. Set `functions`, the allowed function codes, or `deny`,
    the codes that are not allowed, but not both. `roles`, only with TLS, are the allowed roles of
    the peer's certificate: "" is a certificate without a role, `None` is any role. `narrowed` are
    units with rights of their own: access, functions, denied functions, and the ranges that they
    may read and write, each an area, its first address and a count; `None` is everything.
    `exception_status` is where units have the eight bits that function 7 reads: area and address.
    `fifo` are the addresses where units have the queues that function 24 reads. Other units do not
    have these functions.

    Raises `ValueError` for an invalid source or access.
    """

    def __new__(
        cls,
        units: Mapping[int, Memory | Route | Passage],
        *,
        access: Access,
        sources: Sequence[str] | None = None,
        functions: Sequence[int] | None = None,
        deny: Sequence[int] | None = None,
        roles: Sequence[str] | None = None,
        narrowed: Mapping[int, NarrowedRights] | None = None,
        exception_status: Mapping[int, tuple[BitArea, int]] | None = None,
        fifo: Mapping[int, Sequence[int]] | None = None,
    ) -> Rule: ...
    @property
    def sources(self) -> list[str] | None:
        """The networks of the peers; `None` if none were given, as on a serial line."""

    @property
    def roles(self) -> list[str] | None:
        """The roles of certificates; `None` is any role."""

    @property
    def unit_ids(self) -> set[int]:
        """The unit ids of `units`."""

@final
class RawRule:
    """What the senders of Raw Ingest packets from some sources may write.

    `targets` maps unit ids (v1) or memory ids (crc), 0 to 65535, to memories. `roles` are those of
    `Rule`. Raises `ValueError` for an invalid id, source or area.
    """

    def __new__(
        cls,
        targets: dict[int, Memory],
        *,
        sources: Sequence[str],
        areas: Sequence[Area],
        roles: Sequence[str] | None = None,
    ) -> RawRule: ...

@final
class ServerTls:
    """Settings of a TLS server with mutual authentication. Reads the PEM files at once.

    `ca_file` has the authorities of client certificates, and clients' own certificates;
    `crl_file` has the revocation lists of these authorities. `decrypted_key` is the content of
    `key_file` without its passphrase, if it has one. Raises `ValueError` for a file that can't be
    used.
    """

    def __new__(
        cls,
        *,
        cert_file: str | PathLike[str],
        key_file: str | PathLike[str],
        ca_file: str | PathLike[str],
        crl_file: str | PathLike[str] | None = None,
        decrypted_key: bytes | None = None,
    ) -> ServerTls: ...
    @property
    def warnings(self) -> list[str]:
        """What is doubtful about the files: dates, and revocation lists."""

@final
class ListeningSocket:
    """A TCP socket that listens on `address:port`; `[::]` includes IPv4. Raises `OSError`."""

    def __new__(cls, bind_address: str) -> ListeningSocket: ...
    def __enter__(self) -> Self: ...
    def __exit__(self, *args: object) -> None: ...
    def getsockname(self) -> tuple[str, int]:
        """The address and the port."""

    def close(self) -> None:
        """Stops listening, when the servers of the socket have ended too."""

@final
class HttpServer:
    """A server of HTTP/1.1 in a thread of its own.

    `grace`, `request_timeout` and `idle_timeout` are seconds: how long a connection
    in the middle of a request is never closed for another, how long a request and taking its
    response may take, and how long the pause between requests. With `leaving`, a client that
    sends no more is gone. `refusals` are the headers and bodies for what reaches no handler, by
    name: `not_http`, `header_too_large`, `not_tls`.
    """

    def __new__(
        cls,
        name: str,
        socket: ListeningSocket,
        *,
        sources: Sequence[str],
        max_connections: int,
        max_connections_per_source: int | None = None,
        when_full: WhenFull = "refuse",
        grace: float,
        request_timeout: float,
        idle_timeout: float,
        leaving: bool = False,
        tls: ServerTls | None = None,
        refusals: Sequence[tuple[str, Sequence[tuple[bytes, bytes]], bytes]],
    ) -> HttpServer: ...
    def start(self) -> None:
        """Begins to serve, in a thread of its own."""

    def detach(self) -> int:
        """The handle of a socket that is readable when there is something to take."""

    def take(
        self, most: int
    ) -> tuple[list[list[ParsedWrites | tuple[Any, ...]]], list[tuple[int, str, Any]]]:
        """Takes new requests, in batches of at most `most`, and what has happened to others.

        A request is its exchange, head, peer, length, body, and the subject, serial number and role
        of its client's certificate. The body is `None` while it arrives, the length if the head
        does not say it. A head is method, path, query, version, headers without Content-Length, and
        a dictionary for what handlers find out about it: equal heads are mostly the same object.
        Requests whose head has `commands` in its dictionary, `Commands` and a handler, are parsed:
        those that follow each other come as one `ParsedWrites`.

        What has happened is a number, a word and a value: `body` (bytes), `late` (bytes that have
        arrived), `too_large`, `broken`, `gone` or `room`.
        """

    def flush(self) -> None:
        """Sends the responses since the last call."""

    def events(self) -> list[tuple[str, dict[str, Any]]]:
        """Takes events of connections: a name, and fields for a log."""

    def counters(self) -> dict[str, int]:
        """Counts of connections."""

    def tls_failures(self) -> dict[str, int]:
        """Failures of TLS by reason."""

    @property
    def open(self) -> int:
        """How many connections are open."""

    def heartbeat(self) -> ThreadHeartbeat:
        """The name of the thread, seconds since its last beat, and the system's number of it."""

    def set_tls(self, tls: ServerTls) -> None:
        """Uses other certificates for new connections, and judges open ones by them."""

    def review(self) -> None:
        """Judges the certificates of open connections again, and ends those that fail."""

    def end(self) -> None:
        """Ends connections without a request now, and the others after their responses."""

    def close(self) -> None:
        """Ends all connections, and waits for the thread."""

@final
class HttpExchange:
    """One request and its response. If it is dropped without a response, the connection ends."""

    @property
    def number(self) -> int:
        """The number of the request."""

    def receive(self, most: int) -> None:
        """Asks for the body, at most `most` bytes. An event has it."""

    def respond(
        self, status: int, headers: Sequence[tuple[bytes, bytes]], body: bytes, closes: bool
    ) -> None:
        """Answers the request at the next `flush`; with `closes`, the connection ends after it.

        Raises `ValueError` for an invalid header or status.
        """

    def begin(self, status: int, headers: Sequence[tuple[bytes, bytes]]) -> None:
        """Answers the request with a stream. Raises `ValueError`."""

    def send(self, data: bytes) -> bool | None:
        """Sends data of a stream.

        Returns whether they were taken: otherwise the event `room` tells when to try again. `None`
        if the client is gone.
        """

    def end(self, is_complete: bool) -> None:
        """Ends a stream. One that is not complete is cut off."""

    def watch_client(self) -> bool:
        """Whether the client is still there. Thread-safe.

        From now on, one that has half-closed its connection is gone, as after `begin`.
        """

    def abandon(self) -> None:
        """Ends the connection: there will be no response."""

def https_server_tls(
    *,
    cert_file: str | PathLike[str],
    key_file: str | PathLike[str],
    client_ca_file: str | PathLike[str] | None = None,
    crl_file: str | PathLike[str] | None = None,
    roles: Sequence[str] | None = None,
    decrypted_key: bytes | None = None,
) -> ServerTls:
    """Settings of the TLS of an HTTPS server. Reads the PEM files at once.

    Without `client_ca_file`, clients need no certificate. `roles` are the allowed roles of their
    certificates: "" is a certificate without a role, `None` is any role. The rest is that of
    `ServerTls`, also what it raises.
    """

@final
class Listener:
    """The settings of a listener. The constructor makes a listener for Modbus over TCP connections.

    The options have all keys of their kind, see `holdfast.server.options`. Raises `ValueError` for
    an invalid address, limit or time, `TypeError` for a key that is missing or has another type.
    """

    def __new__(
        cls, name: str, bind: str, rules: Sequence[Rule], options: StreamOptions
    ) -> Listener: ...
    @staticmethod
    def udp(name: str, bind: str, rules: Sequence[Rule], options: DatagramOptions) -> Listener:
        """A listener for Modbus over UDP."""

    @staticmethod
    def serial(name: str, device: str, rule: Rule, options: SerialOptions) -> Listener:
        """A listener for a serial line; the sources of the rule are ignored."""

    @staticmethod
    def raw_ingest(
        name: str, bind: str, rules: Sequence[RawRule], options: RawIngestOptions
    ) -> Listener:
        """A listener for Raw Ingest packets."""

@final
class Engine:
    """Runs listeners on native threads, from construction to `stop`.

    `identity` has identification objects by id and requires objects 0 to 2. `events` selects the
    listeners' events that are queued for `next_event`. `audit` queues writes for `next_writes`:
    writes that the queue has no room for are carried out if it is `open`, and refused if `closed`.

    Raises `OSError` if a listener can't be bound or a serial device can't be opened, and then runs
    no listener; raises `ValueError` for an invalid identity.
    """

    def __new__(
        cls,
        listeners: Sequence[Listener],
        *,
        identity: Sequence[tuple[int, str]],
        unit_names: Sequence[tuple[int, str]] | None = None,
        workers: int = 1,
        events: Literal["nothing", "refusals", "all"] = "nothing",
        audit: Literal["open", "closed"] | None = None,
    ) -> Engine: ...
    @property
    def addresses(self) -> list[tuple[str, int] | None]:
        """The address and port of each listener, in their order; `None` for serial lines."""

    @property
    def sockets(self) -> list[tuple[Literal["tcp", "udp"], str, int]]:
        """The kind, address and port of each socket that listens.

        Empty after `stop`, and in a forked child.
        """

    def counters(self) -> dict[str, ListenerCounters]:
        """The counters of each listener since the start, by name."""

    def reload(
        self,
        listeners: Sequence[Listener],
        *,
        identity: Sequence[tuple[int, str]],
        unit_names: Sequence[tuple[int, str]] | None = None,
        events: Literal["nothing", "refusals", "all"] = "nothing",
    ) -> None:
        """Serves these listeners from now on, in place of those before.

        A listener with the name, protocol and address of a running one takes over its socket,
        counters and connections: those without rights are ended, the others have their new rights
        before their next request. Raises as the constructor; nothing has changed then.
        """

    def review(self) -> None:
        """Judges the certificates of all open connections again, and ends those that fail."""

    def sessions(self) -> list[dict[str, Any]]:
        """The open connections: listener, id, peer, opened (seconds since 1970), idle (seconds).

        TLS peers have role, subject and serial too.
        """

    def end_session(self, listener: str, id: int) -> bool:
        """Ends a connection. Returns whether there was one."""

    def heartbeats(self) -> list[ThreadHeartbeat]:
        """The heartbeat of each worker thread."""

    def next_event(self, timeout: float) -> tuple[str, str, dict[str, object]] | None:
        """Listener, kind and fields of the next event; `None` after `timeout` seconds.

        Fields, as far as they apply: peer, role, subject and serial (TLS), reason, bytes, unit,
        function; `count` if it occurred several times, with any port of the peer.
        """

    @property
    def lost_events(self) -> int:
        """Events that were dropped because the queue was full."""

    def next_writes(self, timeout: float, most: int) -> list[dict[str, object]]:
        """About `most` received writes, executed or refused, as fields of an audit log.

        `refusals` of a write that was certainly not carried out is the number of similar ones that
        it stands for, itself included.

        Waits up to `timeout` seconds for the first write. `stop` ends the wait.
        """

    def set_audit_failing(self, failing: bool) -> None:
        """Whether the audit log can't be written: with `audit` closed, refuses writes then.

        Ends a wait for writes.
        """

    @property
    def lost_writes(self) -> int:
        """Writes missing from `next_writes` because the queue was full."""

    @property
    def other_refused_writes(self) -> int:
        """Refused writes of too many peers, neither in `next_writes` nor in its `refusals`."""

    def stop(self) -> None:
        """Answers received requests and stops, within a second. Can be called from any thread."""

@final
class Request:
    """A request of a client, checked and encoded. Raises `ValueError` for an invalid request."""

    @staticmethod
    def read(area: Area, address: int, count: int) -> Request:
        """Functions 1 to 4, depending on the area."""

    @staticmethod
    def write_coil(address: int, value: SupportsIndex) -> Request:
        """Function 5."""

    @staticmethod
    def write_register(address: int, value: SupportsIndex) -> Request:
        """Function 6."""

    @staticmethod
    def write_coils(address: int, values: Iterable[SupportsIndex]) -> Request:
        """Function 15."""

    @staticmethod
    def write_registers(address: int, values: Iterable[SupportsIndex]) -> Request:
        """Function 16."""

    @staticmethod
    def mask_write(address: int, and_mask: int, or_mask: int) -> Request:
        """Function 22."""

    @staticmethod
    def read_write(
        read_address: int, count: int, write_address: int, values: Iterable[SupportsIndex]
    ) -> Request:
        """Function 23."""

    @staticmethod
    def diagnostics(sub_function: int, data: Iterable[int]) -> Request:
        """Function 8."""

    @staticmethod
    def exception_status() -> Request:
        """Function 7."""

    @staticmethod
    def event_log() -> Request:
        """Function 12."""

    @staticmethod
    def read_files(ranges: Sequence[tuple[int, int, int]]) -> Request:
        """Function 20. Each range is a file, its first record and the number of records."""

    @staticmethod
    def write_files(ranges: Sequence[tuple[int, int, Iterable[SupportsIndex]]]) -> Request:
        """Function 21. Each range is a file, its first record and the records."""

    @staticmethod
    def read_queue(address: int) -> Request:
        """Function 24."""

    @staticmethod
    def of_function(code: int, data: bytes) -> Request:
        """Any function. The result is what the reply has after the function code."""

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
        """The encoded request, without transport framing."""

    def as_multiple(self) -> Request | None:
        """The same write with function 15 or 16, if this is one of a single coil or register."""

@final
class Endpoint:
    """The target of a client or the poller. Raises `ValueError` for invalid arguments."""

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
        decrypted_key: bytes | None = None,
    ) -> Endpoint:
        """A device with Modbus TCP over TLS. Reads the PEM files at once.

        `ca` has the trusted certificates, of authorities or of the device itself. Default: the
        system's authorities. `name` is the name in the device's certificate, if it is not `host`.
        `decrypted_key` is the content of `key` without its passphrase, if it has one.
        Raises `OSError` and `ValueError` for files that can't be used.
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
        rs485: Literal["rts", "rts-low"] | None = None,
    ) -> Endpoint:
        """A serial line; `silence` and `rs485` are those of `Listener.serial`."""

    def tolerating(
        self,
        *,
        accept_unit: int | Literal["any"] | None = None,
        pad: bool = False,
        echo: bool | Literal["auto"] | None = None,
        pause: float = 0.0,
        pause_after_connect: float = 0.0,
        retries: int = 0,
        retry_busy: bool = False,
        close_after: int = 0,
        reconnect: float = 0.0,
        write_multiple: bool = False,
    ) -> Endpoint:
        """The same device, treated as `holdfast.client.url.Tolerance` says."""

@final
class TlsChannel:
    """The client side of TLS over a connection whose socket belongs to the caller.

    A failure is a reason, a text, and whether the peer may have carried out what it was sent.
    """

    def __new__(cls, endpoint: Endpoint) -> TlsChannel: ...
    @property
    def is_ready(self) -> bool:
        """Whether the handshake is complete."""

    @property
    def has_ended(self) -> bool:
        """Whether the peer has announced the end."""

    def send(self, data: bytes) -> None:
        """Encrypts data. During the handshake, it is queued until the end of the handshake."""

    def outgoing(self) -> bytes:
        """Takes the bytes to send now."""

    def receive(self, data: bytes) -> tuple[bytes, tuple[str, str, bool] | None]:
        """Processes received bytes. Returns their data, and why TLS has failed, if it has."""

    def end(self) -> None:
        """Announces the end."""

    def lost(self, broken: bool) -> tuple[str, str, bool] | None:
        """Interprets the end of the connection; `None` if TLS has nothing to do with it."""

@final
class BlockingClient:
    """A client with one request at a time, over any transport. Connects on the first call.

    Thread-safe: calls run one after the other. Releases the interpreter lock while a call waits.
    In the main thread, signal handlers run meanwhile; their exceptions end the call and its
    connection.
    """

    def __new__(
        cls, endpoint: Endpoint, trace: Callable[[str, bytes], object] | None = None
    ) -> BlockingClient: ...
    def call(
        self,
        request: Request,
        unit: int,
        timeout: float,
        is_cancelled: Callable[[], bool] | None = None,
    ) -> Any:
        """Sends a request and returns its result: values, bytes, or `None` for a write.

        Raises `holdfast.ModbusError`. `is_cancelled` is asked until the request is sent,
        which it is not once the answer is true.
        """

    def end_call(self) -> None:
        """Ends the call that waits for its reply, within 0.1 s: it raises `ConnectionLost`."""

    def close(self) -> None:
        """Closes the connection after the calls before it; the next call reconnects.

        Within a call of this thread, as a signal handler or trace, it waits for nothing, and ends
        the calls of all threads.
        """

    @property
    def late(self) -> int:
        """How many replies arrived after their timeout."""

    @property
    def longest_late(self) -> float:
        """How many seconds the slowest of them took; 0 if there were none."""

@final
class Connection:
    """The protocol of a client's TCP connection, with or without TLS, for an event loop. The owner
    has the socket.

    Times are those of the loop. The future of a request gets its result, a `ModbusError`, or an
    `Attempt` when the request may be sent again.
    """

    def __new__(
        cls,
        endpoint: Endpoint,
        event_loop: AbstractEventLoop,
        last: Connection | None = None,
        trace: Callable[[str, bytes], object] | None = None,
    ) -> Connection:
        """A connection that follows the `last` one to this endpoint, which has ended: late replies
        to requests of that one are recognized. `trace` is that of `BlockingClient`.
        """

    def opened(
        self,
        write: Callable[[bytes], object],
        flush_soon: Callable[[], object],
        wake_at: Callable[[float], object],
        changed: Callable[[], object],
    ) -> None:
        """The socket is open. `write` sends bytes; `flush_soon` has `flush` called in this turn of
        the loop, `wake_at` has `advance` called then. `changed` is called after received bytes if
        the handshake went on or the connection has ended.
        """

    def detach(self) -> None:
        """Drops the references to these methods."""

    @property
    def is_ready(self) -> bool:
        """Whether requests can be sent: the TLS handshake, if any, is complete."""

    def send(
        self,
        request: Request,
        unit: int,
        timeout: float,
        now: float,
        attempt: Attempt | None = None,
    ) -> Future[Any]:
        """Sends a request: at once if no other is pending, else with others of this turn of the
        loop. Raises why the connection has ended.
        """

    def flush(self) -> None:
        """Writes the bytes to send now."""

    def data_received(self, data: bytes, /) -> None:
        """Processes received bytes."""

    def get_buffer(self, size: int, /) -> bytearray:
        """Where the loop may put received bytes instead."""

    def buffer_updated(self, len: int, /) -> None:
        """Processes so many bytes of the buffer."""

    def advance(self) -> float | None:
        """Ends requests whose deadline has passed. Returns the next time to call it."""

    def cancel(self, future: Future[Any], now: float) -> None:
        """Drops a request whose caller no longer waits. Its reply, if one arrives, is counted.

        The connection may have ended then: the device closes it after so many requests.
        """

    def close(self) -> None:
        """Closes the connection and ends all requests. `flush` may still write bytes."""

    def lost(self, error: str | None = None) -> None:
        """Reports the end of the network connection; `error` is `None` for a regular close."""

    @property
    def closed(self) -> ModbusError | None:
        """The error that ended the connection, `None` while it is open."""

    @property
    def late(self) -> int:
        """How many replies arrived after their timeout."""

    @property
    def longest_late(self) -> float:
        """How many seconds the slowest of them took; 0 if there were none."""

@final
class Attempt:
    """A request that failed may be sent again. Given to `Connection.send` then."""

    @property
    def pause(self) -> float:
        """Seconds to wait before."""

    @property
    def has_own_timeout(self) -> bool:
        """Whether its timeout begins anew."""

class LogError(Exception):
    """A log can't be used."""

    kind: Literal[
        "no_connection",
        "layout",
        "version",
        "snapshot",
        "replaced",
        "name_taken",
        "too_many_nodes",
        "differs",
        "thread",
    ]

@final
class Log:
    """Shares the writes to memories with other nodes, through a stream of NATS JetStream.

    From construction on, every write to these memories is a step of the log: it is carried out when
    the log has it, on all nodes in the same order, and refused while the log can't be reached. What
    the memories contain at that time is what a new log begins with; an existing log replaces it.

    `tls` are files: trusted authorities, certificate, key. All files are read for each connection.
    With `when_behind="refuse"`, all reads are refused after `max_lag` seconds without contact.
    Servers that know less than this node have lost messages if that lasts `cut_off` seconds; the
    error names `kept_file`, where a `MemoryFile` keeps the contents. What is not given is as
    `Settings::new` has it (crates/journal/src/log/defaults.rs).

    Raises `ValueError` for an unusable argument, also for a memory that has a log already.
    """

    def __new__(
        cls,
        name: str,
        node: str,
        servers: Sequence[str],
        memories: Sequence[tuple[str, Memory]],
        *,
        replicas: int | None = None,
        write_timeout: float | None = None,
        when_behind: Literal["serve", "refuse"] | None = None,
        max_lag: float | None = None,
        digest_steps: int | None = None,
        cut_off: float | None = None,
        kept_file: str | None = None,
        user: str | None = None,
        password_file: str | PathLike[str] | None = None,
        token_file: str | PathLike[str] | None = None,
        credentials_file: str | PathLike[str] | None = None,
        tls: TlsFiles | None = None,
    ) -> Log: ...
    def resume(self, note: bytes) -> None:
        """Begins with the contents that a `MemoryFile` with this note has loaded.

        A log that does not lead to them is an error of `start` then. Raises `LogError` for an
        unusable note, and `ValueError` for that of another log.
        """

    def start(self, timeout: float) -> None:
        """Starts the thread of the log, and returns when the memories have caught up.

        While it waits for other nodes to say whether seals stay open, it may take 30 s longer.
        Raises `LogError`, and `ValueError` for a setting or a file that the servers show to be
        unusable. After a timeout or a signal the log is stopped.
        """

    def stop(self) -> None:
        """Refuses writes from now on, waits for those that were sent, and ends the thread."""

    def status(self) -> LogStatus:
        """Returns the state of the log."""

    def events(self, timeout: float) -> list[tuple[str, dict[str, str]]]:
        """Takes what has happened, as names and fields. Waits if there is nothing."""

@final
class LogReader:
    """Rebuilds what a log leads to, in these memories, without writing to the log.

    It begins with a snapshot, and ends at a sequence, at a time (nanoseconds since 1970), at the
    last message there is now, or with `follow` never. Raises `LogError`, and `ValueError` for an
    unusable argument.
    """

    def __new__(
        cls,
        name: str,
        servers: Sequence[str],
        memories: Sequence[tuple[str, Memory]],
        *,
        sequence: int | None = None,
        time_ns: int | None = None,
        follow: bool = False,
        timeout: float = 10.0,
        connect_timeout: float | None = None,
        user: str | None = None,
        password_file: str | PathLike[str] | None = None,
        token_file: str | PathLike[str] | None = None,
        credentials_file: str | PathLike[str] | None = None,
        tls: TlsFiles | None = None,
    ) -> LogReader: ...
    def next(self, timeout: float) -> LogRecord | None:
        """Applies the next message. Returns `None` if none comes in time, and at the end."""

    @property
    def ended(self) -> bool:
        """Whether all is applied."""

    @property
    def sequence(self) -> int:
        """The sequence that was applied last."""

    @property
    def time_ns(self) -> int:
        """When the stream stored the message that was applied last, in nanoseconds since 1970."""

    @property
    def last_sequence(self) -> int:
        """The last sequence that the stream had at the beginning."""

    def digest(self) -> str:
        """Returns the digest of the contents, as nodes compare it."""

@final
class PolledDevice:
    """A device to poll: reads, interval and destinations.

    `reads` are areas, addresses, counts and destinations or `None`; a destination is memory, area
    and address, and the age of its values or `None`. `max_gap` (default: 0) or `cost` (of a
    request, of a register or 16 bits) selects the gaps that are read; `readable` and `forbidden`
    are areas with start and end, exclusive. `status` is the memory of the status block, and the
    block. `start_within` is the maximum delay of the first poll (default: the interval, at most 10
    s). `receiver` takes the polls, in which the device is named `reported_as` (default: its name);
    `fields` are areas, addresses and counts that are read only for it, and not forwarded. `release`
    closes the connection after each poll. With `measured`, measurements replace `cost` after a
    while. `retry` are the first and the longest pause after failures (default: `RETRY_PAUSES_S`).
    With `jitter`, they are up to a quarter shorter, and the device is retried at the next time of
    its schedule; without, when they end. With a `fence`, the device is polled and written to while
    that is open; devices of one link have the same. Times are in seconds; interval 0 polls without
    a pause.
    """

    def __new__(
        cls,
        name: str,
        endpoint: Endpoint,
        *,
        unit: int,
        interval: float,
        timeout: float,
        reads: Sequence[tuple[Area, int, int, tuple[Memory, Area, int, MirrorAge | None] | None]],
        max_gap: int | None = None,
        cost: tuple[float, float] | None = None,
        max_registers: int = ...,
        max_bits: int = ...,
        readable: Sequence[tuple[Area, int, int]] | None = None,
        forbidden: Sequence[tuple[Area, int, int]] | None = None,
        forward: Sequence[tuple[Endpoint, Forward]] | None = None,
        status: tuple[Memory, StatusBlock] | None = None,
        start_within: float | None = None,
        in_flight: int | None = 1,
        receiver: PollReceiver | None = None,
        reported_as: str | None = None,
        fields: Sequence[tuple[Area, int, int]] | None = None,
        release: bool = False,
        measured: bool = False,
        retry: tuple[float, float] | None = None,
        jitter: bool = True,
        fence: Fence | None = None,
    ) -> PolledDevice: ...

@final
class Fence:
    """Stops the use of devices when a lease ends. Times are those of `time.monotonic`.

    It begins closed.

    It is compared with the clock at the last moment before something is sent, so a process that was
    stopped sends nothing when it goes on too late.
    """

    def __new__(cls, lease: int) -> Fence:
        """The fence of the lease with this number, which is the same on all nodes."""

    def open(self, until: float, *, term: tuple[int, int] = ..., settle: float = 0.0) -> None:
        """Opens it for a term. Later ones are greater, and end the earlier ones in logs.

        Writes wait for `settle` seconds and the timeout of the device.
        """

    def renew(self, until: float) -> None:
        """Moves the end, never to an earlier time. Without effect if it was closed."""

    def end(self) -> None:
        """Lets running polls finish, and no new ones begin.

        Renew it until `in_use` is 0, then close it.
        """

    def close(self) -> None:
        """Sends nothing more, and closes the connections to the devices."""

    @property
    def is_open(self) -> bool:
        """Whether polls and writes may begin."""

    @property
    def allows(self) -> bool:
        """Whether something may be sent."""

    @property
    def in_use(self) -> int:
        """The number of polls, writes and connections."""

@final
class Link:
    """A connection or serial line to devices, shared by all that ask them.

    Two are equal if they are the same connection or line.
    """

    def __eq__(self, value: object, /) -> bool: ...
    def __hash__(self) -> int: ...
    @property
    def error(self) -> str | None:
        """Why requests of clients fail: its address can't be reached, or several had no answer.

        `None` while something behind it answers them. Polls do not count.
        """

    def set_longest_wait(self, wait: float | None) -> None:
        """How many seconds a call may keep others of the link waiting for its reply: as long as
        clients of its routes wait. `None`: it has no routes.
        """

    def route(
        self,
        name: str,
        *,
        timeout: float,
        unit: int | None = None,
        withdrawal: Withdrawal | None = None,
    ) -> Route:
        """A target for the units of a `Rule`: their requests go to `unit` of this link.

        Without `unit`, they keep their unit id. `timeout` is in seconds, from the moment when a
        request is sent.
        """

    def call(
        self,
        caller: Caller,
        request: Request,
        unit: int,
        timeout: float,
        *,
        broadcast: bool = False,
        peers: Sequence[str] | None = None,
    ) -> int | None:
        """Sends a request when its turn comes; its ticket in `Caller.take`.

        `timeout` is in seconds and includes the wait for the turn. A `broadcast` has no reply: it
        ends when the devices had time to carry it out. Returns `None` when the queue is full.

        With `peers`, addresses, the request is sent only on a connection to one of them. If there
        is another connection, or the device's name has others, too, the call ends with the result
        `PermissionError`.
        """

    def counters(self) -> dict[str, int]:
        """The requests by their fate, without those of the poller, and how many wait now."""

@final
class Caller:
    """Calls over links from an event loop, which reads a socket to learn of results.

    Raises `OSError` without a free socket.
    """

    def __new__(cls) -> Caller: ...
    def detach(self) -> int:
        """The file descriptor or handle of the socket, which the caller then owns.

        It becomes readable when calls have ended. Raises `RuntimeError` the second time.
        """

    def take(self) -> list[tuple[int, bool, Any]]:
        """The calls that have ended: tickets, whether the device may have received the request,
        and results as of `Connection.receive`.
        """

    def withdraw(self, ticket: int) -> bool:
        """Gives a call up: it is not sent if it was not sent yet.

        Returns whether the device may have received the request. Such a call still has a result.
        """

@final
class Passage:
    """A memory, some of whose ranges are written through to devices."""

    def device_of(self, area: Area, address: int, count: int) -> str | None:
        """The device that takes a write of this range, `None` if it is not within one range."""

    def write(self, area: Area, address: int, values: list[int]) -> int | None:
        """Writes to the device, and to the memory when the device has confirmed it.

        Blocks until the device has answered, or did not in time. Returns `None` if the device has
        confirmed the write, otherwise the exception code: of the device, 10 if it can't be reached,
        11 if it does not answer. Raises `ValueError` for more values than a request can have.
        """

    def call(self, caller: Caller, area: Area, address: int, values: list[int]) -> int:
        """Writes as `write`, without blocking. Returns the ticket.

        The result is `ConnectionLost` for a write that was not sent, as while 256 wait.
        """

@final
class Route:
    """Where a listener passes on the requests to a unit."""

@final
class Withdrawal:
    """Withdraws the requests of routes."""

    def __new__(cls) -> Self: ...
    def withdraw(self) -> None:
        """What still waits for its turn is not sent any more: clients get exception 0A."""

@final
class PollReceiver:
    """A receiver of polls, and of the results of writes. Its queue is bounded."""

    def take(
        self, timeout: float
    ) -> (
        tuple[
            list[tuple[str, float, list[PolledBlock]]],
            list[tuple[int, int]],
        ]
        | None
    ):
        """All polls and results of writes since the last call.

        Waits up to `timeout` seconds for the first. A poll is a device, its scheduled time in
        seconds since the poller's start (its actual start, if outside the schedule), and its blocks
        in the order of their requests: area, address, count, the bytes (`None` without a valid
        reply), the fault as in a status block, and the time of the result in seconds since 1970. A
        write is its number and its fault, 0 if the device confirmed it. Returns `None` when the
        poller has stopped and no results are left.
        """

    def wake(self) -> None:
        """Ends the current or the next wait of `take`."""

    def withdraw(self) -> None:
        """Gives up its writes: those that were not sent yet are not sent."""

    @property
    def dropped(self) -> int:
        """Polls that are missing because the queue was full; the oldest are dropped."""

@final
class Poller:
    """Polls devices on a native thread, from construction to `stop`.

    Raises `ValueError` for a read that no request can carry, or that does not fit its destination.
    """

    def __new__(cls, devices: Sequence[PolledDevice]) -> Poller: ...
    @property
    def heartbeat(self) -> ThreadHeartbeat:
        """The heartbeat of the thread."""

    def add(self, device: PolledDevice) -> None:
        """Adds a device.

        Raises `ValueError`, also for a name in use, and `RuntimeError` after `stop`.
        """

    def replace(self, name: str, device: PolledDevice, *, at_once: bool = True) -> None:
        """Replaces the device called `name`; the new device can have the same name.

        The current poll completes; counters, connection and schedule remain. With `at_once`, the
        new device is also polled once outside the schedule, at most once per second, or per
        interval if that is shorter. Raises `ValueError`, and `RuntimeError` after `stop`; an error
        changes nothing.
        """

    def write(
        self, name: str, request: Request, receiver: PollReceiver, *, within: float | None = None
    ) -> int:
        """Sends a write to a device over its own connection, between two reads.

        Returns the number under which `receiver` has the result. What can't be sent `within`
        seconds, and one timeout of the device, or waits through a standstill, is not sent any more:
        its fault is `expired`. Raises `ValueError` for an unknown device or a request that does not
        write, `RuntimeError` after `stop`.
        """

    def link(
        self,
        endpoint: Endpoint,
        *,
        in_flight: int | None = 1,
        queue: int | None = None,
        coalesce: bool = True,
        cache: float = 0.0,
        preferred: Sequence[str] | None = None,
        retry: tuple[float, float] | None = None,
    ) -> Link:
        """The connection or serial line to an address, for the requests of listeners.

        Devices at the same address share it. The first call for an address decides its settings:
        `queue` is the most requests of listeners that wait (default: `LINK_QUEUE`), with `coalesce`
        one request answers identical reads that wait at the same time, for `cache` seconds a reply
        answers identical reads, reads of the addresses in `preferred` go before those of others,
        and `retry` are the first and the longest pause after failures (default: `RETRY_PAUSES_S`).
        Raises `ValueError`, and `RuntimeError` after `stop`.
        """

    def link_if_used(self, endpoint: Endpoint) -> Link | None:
        """The link to an address that a device or another link uses, with the same certificates.

        If only devices use it, creates the link, with default settings. Returns `None` if none
        does. Raises `RuntimeError` after `stop`.
        """

    def forget_links(self, used: Sequence[Link]) -> None:
        """Forgets the links that no device and none of `used` has.

        The next user of such an address gets a new one, with its own settings. Raises
        `RuntimeError` after `stop`.
        """

    def passage(
        self,
        memory: Memory,
        ranges: Sequence[tuple[Area, int, int, str, int, bool]],
    ) -> Passage:
        """A memory whose clients write to devices, as a target for the units of a `Rule`.

        Each range is an area of the memory, its first address, how many items, the device that they
        are read from, their first address there, and whether function 22 is sent as a read and
        function 6. Raises `ValueError` for a range that the memory or the device does not have.
        """

    def remove(self, name: str) -> bool:
        """Removes a device. Returns whether it existed."""

    def new_receiver(self) -> PollReceiver:
        """A new receiver of polls and of the results of writes. It ends with the poller."""

    def counters(self, *, receiver: PollReceiver | None = None) -> dict[str, dict[str, Any]]:
        """The health and counters of each device and of its forwards, by device name.

        `receiver` selects the devices whose polls it takes; `None` selects all.

        `error` is the text of `last_error`, `None` if no request has failed so. `age` is the age of
        the last valid reply, `None` before the first. `plan_error` is the reason why the device has
        no plan, `None` if it has one. `unplanned` counts polls skipped without a plan, `unstored`
        counts reads and status blocks that memory refused.
        """

    def stop(self) -> None:
        """Stops polling. Can be called from any thread."""

def check_log_name(name: str) -> None:
    """Raises `ValueError`, which says what is allowed, if a log can't have this name."""

def check_log_node(name: str) -> None:
    """Raises `ValueError`, which says what is allowed, if a node of a log can't have this name."""

def pack_raw_ingest(area: Area, values: Iterable[int]) -> tuple[bytes, int]:
    """The payload of a Raw Ingest packet, and its number of values.

    Raises `ValueError` for a value out of range or an unknown area, `TypeError` for a value of
    another type.
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

    Raises `ValueError` for a payload that does not match `count`, `OverflowError` for a number
    above 65535.
    """

def write_disabled_status(memory: Memory, block: StatusBlock) -> None:
    """Writes the status block of a device that is not polled.

    Raises `ValueError` if it does not fit, `OSError` if the memory can't take it now.
    """

def plan_blocks(
    fields: Sequence[tuple[Area, int, int]],
    *,
    max_gap: int | None = None,
    cost: tuple[float, float] | None = None,
    max_registers: int = ...,
    max_bits: int = ...,
    readable: Sequence[tuple[Area, int, int]] | None = None,
    forbidden: Sequence[tuple[Area, int, int]] | None = None,
) -> list[tuple[Area, int, int, list[int], int]]:
    """Plans the requests that read all fields (area, address, count). Fields are never split.

    A request is an area, an address, a count, the indexes of its fields, and the number of bits or
    registers outside all fields. Raises `ValueError` for a field that no request may read.
    """

def yaml_events(text: str, most: int) -> list[YamlEvent] | None:
    """The events of a YAML document of at most `most` values; more end it early.

    `None` for text that is not YAML, has several documents, or nests deeper than 255.
    """

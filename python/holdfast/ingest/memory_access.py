"""Memory access for adapters: checks commands, then writes them atomically.

Every adapter has its own `MemoryAccess`, and passes the grant of the source with each call. A batch
is checked completely before anything is written, and written atomically, even to several memories.
Accesses are counted, and writes are audited.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import msgspec

from holdfast import _core
from holdfast.errors import NOT_EXECUTED
from holdfast.events import log_lines
from holdfast.events.audit import Unrecorded
from holdfast.events.audit.chain import encoded
from holdfast.ingest.audit_lines import Recording, origin_around, values_of
from holdfast.ingest.counts import Counts
from holdfast.ingest.refusals import (
    REFUSED_FOR_NOW,
    Refused,
    malformed,
    place_of,
    refusal,
    shown,
    unreadable,
    unrecorded,
)
from holdfast.protocol import EXCEPTIONS, MAX_WORD
from holdfast.runtime.malformed_json import MALFORMED_JSON, malformed_text
from holdfast.types import AREAS, BIT_AREAS

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    from holdfast._core import Follower, Memory, Passage
    from holdfast.events.audit import Audit
    from holdfast.events.audit.log import Group
    from holdfast.events.throttle import Throttle

_KEYS = {"memory", "area", "address", "values"}
_BOOLS_KEYS = {"memory", "area", "address", "bools"}

Write: TypeAlias = "tuple[Memory, str, int, list[Any]] | tuple[Memory, str, int, list[Any], bool]"
"""A write; the last item says that it is granted only while the memory is sealed."""

_Outcome: TypeAlias = "tuple[int, int | None] | _core.BatchRefused"
"""The result of a write: the number of its values and its sequence in a log; or its refusal."""


@dataclass(frozen=True)
class Grant:
    """The permissions of a source: memories, areas, and whether it may write."""

    name: str
    """The name of the source, for logs."""
    memories: Collection[str]
    areas: Collection[str]
    writes: bool = True
    while_sealed: Collection[str] = ()
    """Areas that may also be written while the memory is sealed, such as to restore them."""


class Written(NamedTuple):
    """The result of a write of one command or a batch."""

    commands: int
    values: int
    memory: str | None
    """The memory of a single command; `None` for a batch."""

    def answer(self) -> dict[str, object]:
        """Returns the answer for the source."""
        if self.memory is not None:
            return {"status": "accepted", "memory": self.memory, "written": self.values}
        return {"status": "accepted", "commands": self.commands, "written": self.values}


@dataclass(slots=True)
class Begun:
    """Commands that have been checked."""

    commands: Sequence[Mapping[str, Any]]
    single: bool
    """Whether it is one command, sent alone."""
    grant: Grant
    peer: str
    stale: str | None = None
    """Why the commands may be old; `None` if nothing says so."""
    native_batch: _core.Batch | None = None
    """The same commands, to write them."""
    device: str | None = None
    """The device that takes the write, in place of a memory."""
    recording: Recording | None = None

    @property
    def where(self) -> dict[str, Any]:
        """The target of the only command; empty for a batch."""
        if not self.single:
            return {}
        [command] = self.commands
        return place_of(None, command["memory"], command["area"], command["address"])


class MemoryAccess:
    """Reads and writes memories for one adapter. Thread-safe."""

    def __init__(
        self,
        name: str,
        memories: Mapping[str, Memory],
        audit: Audit | None = None,
        passages: Mapping[str, Passage] | None = None,
    ) -> None:
        """`passages`: the memories whose ranges are written through to devices."""
        self.name = name
        self.memories = memories
        self._audit = audit
        self._passages = {} if passages is None else passages
        self._counts = Counts()
        self._lock = threading.Lock()

    def ingest(
        self,
        body: bytes | bytearray | memoryview,
        grant: Grant,
        peer: str,
        *,
        stale: str | None = None,
    ) -> Written:
        """Carries out JSON: one command, or an array of commands. Raises `Refused`.

        `stale` says why the commands may be old: memory takes them, but no device does.
        """
        return self.finish(self.begin(body, grant, peer, stale=stale))

    def write(self, commands: Sequence[Mapping[str, object]], grant: Grant, peer: str) -> Written:
        """Carries out commands atomically, each with memory, area, address and values.

        Raises `Refused`.
        """
        return self.finish(self._begin(lambda: list(commands), grant, peer))

    def begin(
        self,
        body: bytes | bytearray | memoryview,
        grant: Grant,
        peer: str,
        *,
        stale: str | None = None,
    ) -> Begun:
        """Checks JSON as `ingest`, for `finish`. Raises `Refused`.

        Writes that begin before others are carried out get into the audit log together.
        """
        return self._begin(partial(_decoded, body), grant, peer, stale)

    def finish(self, begun: Begun) -> Written:
        """Carries out what has begun, and waits for a device, a disk or a log. Raises `Refused`."""
        with self.reporting_refusals(begun):
            values = self._store(begun) if begun.device is None else None
            if values is not None:
                return self._accepted(begun, values)
            # Memory is a mirror there: the device takes the write.
            code = self._to_device(begun, lambda passage, *write: passage.write(*write))
            return self.finish_device_write(begun, code)

    async def finish_async(self, begun: Begun) -> Written | None:
        """As `finish`, for memories that a file or a log stores, without blocking a thread.

        Writes are carried out in the order in which they came, and also if nobody waits any more.
        Returns `None` if a device must take the write. Raises `Refused`.
        """
        import asyncio  # An appliance without REST has no event loop.

        assert begun.native_batch is not None
        loop = asyncio.get_running_loop()
        ended: asyncio.Future[_Outcome] = loop.create_future()
        begun.native_batch.submit(partial(_set_outcome, loop, ended))
        with self.reporting_refusals(begun):
            try:
                outcome = await ended
            except asyncio.CancelledError:
                # The record of the write must say what is known of it.
                with contextlib.suppress(Refused), self.reporting_refusals(begun):
                    outcome = _not_confirmed() if ended.cancelled() else ended.result()
                    self._record_outcome(begun, outcome)
                raise
            values = self._record_outcome(begun, outcome)
            return None if values is None else self._accepted(begun, values)

    def may_block(self, begun: Begun) -> bool:
        """Whether a write to memory can take as long as a disk or a log needs to answer."""
        return any(self.memories[command["memory"]].waits for command in begun.commands)

    @contextlib.contextmanager
    def reporting_refusals(self, begun: Begun) -> Iterator[None]:
        """Counts, logs and audits a `Refused` of what has begun."""
        try:
            yield
        except Refused as refused:
            self.refuse(refused, begun.grant.name, begun.peer)
            raise

    def call_device(self, begun: Begun, caller: _core.Caller) -> int:
        """Sends a write for a device on its way. Returns the ticket. Raises `Refused`."""
        ticket: int = self._to_device(begun, lambda passage, *write: passage.call(caller, *write))
        return ticket

    def finish_device_write(self, begun: Begun, code: int | None) -> Written:
        """Takes the answer of the device: the code of its exception, if any. Raises `Refused`."""
        assert begun.device is not None
        if begun.recording is not None:
            begun.recording.answered_by_device(begun.device, code)
        if code is None:
            return self._accepted(begun, len(values_of(begun.commands[0])))
        name = EXCEPTIONS.get(code, "unknown")
        detail = f"{begun.device} did not take the write: exception {code:02X} ({name})"
        if code not in NOT_EXECUTED:
            detail += "; it may still be carried out, or have been"
        where = begun.where | {"device": begun.device, "outcome": f"exception {code:02X}"}
        refused = Refused("device_refused", detail, **where)
        refused.is_recorded = True
        raise refused

    def commands(self, grant: Grant, most: int) -> _core.Commands:
        """Parses commands of at most `most` bytes, for `begin_parsed`.

        It has the memories that exist now.
        """
        targets = [
            (name, encoded(name), memory, [area for area in AREAS if area in grant.areas])
            for name, memory in self.memories.items()
            if grant.writes and name in grant.memories
        ]
        return _core.Commands(targets, most)

    def begin_parsed(self, writes: _core.ParsedWrites, grant: Grant) -> Callable[[], list[Written]]:
        """Records writes that were parsed and checked, those of several requests together.

        Returns the function that carries them out, and returns the results of those that were
        carried out. With the others, nothing has happened: `begin` takes them, and says why.
        """
        group = None
        if self._audit is not None:
            lines = writes.lines(*origin_around(self.name, grant.name))
            group = self._audit.queue(map(msgspec.Raw, lines))
        return partial(self._finish_parsed, writes, group)

    def read(
        self, memory: str, area: str, address: int, count: int, grant: Grant, peer: str
    ) -> list[int]:
        """Reads `count` values atomically. Raises `Refused`."""
        with self._counting_read(grant, peer):
            target = self._granted(memory, area, address, grant)
            try:
                return target.read(area, address, count)
            except (_core.OutOfRange, ValueError):  # A count below 1 is a `ValueError`.
                raise self._out_of_range(memory, area, address, count) from None
            except OSError as error:
                where = place_of(None, memory, area, address)
                raise Refused(unreadable(error), str(error), **where) from None

    def follow(
        self, memory: str, ranges: Sequence[tuple[str, int, int]], grant: Grant, peer: str
    ) -> Follower:
        """Returns a follower of ranges: area, address and count. Raises `Refused`."""
        with self._counting_read(grant, peer):
            for area, address, count in ranges:
                target = self._granted(memory, area, address, grant)
                try:
                    _core.Follower(target, [(area, address, count)])  # type: ignore[list-item]
                except (_core.OutOfRange, ValueError):  # A count below 1 is a `ValueError`.
                    raise self._out_of_range(memory, area, address, count) from None
            return _core.Follower(self.memories[memory], ranges)  # type: ignore[arg-type]

    @contextlib.contextmanager
    def _counting_read(self, grant: Grant, peer: str) -> Iterator[None]:
        """Counts a read, or notes its `Refused`."""
        try:
            yield
        except Refused as refused:
            self.note(refused, grant.name, peer)
            raise
        with self._lock:
            self._counts.reads += 1

    def refuse(
        self, refused: Refused, who: str, peer: str, *, throttle: Throttle | None = None
    ) -> None:
        """Counts, logs and audits a refused write. Adapters call it for writes they refuse.

        `throttle` limits the lines in the log, in place of the limit for all refusals.

        A write without a valid token has no line of its own: everybody can send any number of them.
        """
        by_nobody = refused.reason == "unauthorized"
        self.note(refused, who, peer, observed=by_nobody, throttle=throttle)
        if self._audit is not None and not refused.is_recorded and not by_nobody:
            line = {
                "listener": self.name,
                "peer": peer,
                "source": who,
                "function": "write",
                **refused.where,
                "outcome": refused.reason,
            }
            if refused.reason == "internal_error":  # The write may have been carried out.
                self._audit.write(**line)
            else:
                self._audit.write_refused(**line)

    def note(
        self,
        refused: Refused,
        who: str,
        peer: str,
        *,
        observed: bool = True,
        throttle: Throttle | None = None,
    ) -> None:
        """Logs and counts a refusal without a line of its own in the audit log, as of a read.

        For `observed` and `throttle`, see `log_lines.count`.
        """
        fields = {
            "adapter": self.name,
            "peer": peer,
            "source": who,
            **refused.where,
            "reason": refused.reason,
        }
        kind = (self.name, refused.reason)
        log_lines.count(
            logging.WARNING,
            "ingest_refused",
            fields,
            kind=kind,
            observed=observed,
            throttle=throttle,
        )
        with self._lock:
            self._counts.refuse(refused.reason)

    def counts(self) -> dict[str, object]:
        """Returns the counters."""
        with self._lock:
            return self._counts.snapshot()

    def _begin(
        self, read: Callable[[], object], grant: Grant, peer: str, stale: str | None = None
    ) -> Begun:
        try:
            return self._begun(read(), grant, peer, stale)
        except Refused as refused:
            self.refuse(refused, grant.name, peer)
            raise

    def _finish_parsed(self, writes: _core.ParsedWrites, group: Group | None) -> list[Written]:
        try:
            if self._audit is not None and group is not None:
                self._audit.write_group(group)
        except Unrecorded:
            return []
        written = [Written(1, count, memory) for memory, count in writes.write()]
        with self._lock:
            self._counts.accepted += len(written)
            self._counts.values += sum(each.values for each in written)
        return written

    def _origin(self, grant: Grant, peer: str) -> bytes:
        before, after = origin_around(self.name, grant.name)
        return before + encoded(peer) + after

    def _begun(self, document: object, grant: Grant, peer: str, stale: str | None) -> Begun:
        single = not isinstance(document, list)
        commands: Any = [document] if single else document
        if not commands:
            raise Refused("malformed", "the batch is empty")
        begun = Begun(commands, single, grant, peer, stale)
        try:
            # Commands are checked one by one: native code stops at the first refused command.
            begun.native_batch = _core.Batch(
                self._checked(command, grant, None if single else index)  # type: ignore[misc]
                for index, command in enumerate(commands)
            )
            if self._audit is not None:
                origin, memories = self._origin(grant, peer), [each["memory"] for each in commands]
                begun.recording = Recording(self._audit, origin, memories, begun.native_batch)
            begun.native_batch.check()
            if begun.recording is not None:
                begun.recording.checked()
        except Unrecorded:
            raise unrecorded(begun.where) from None
        except _core.BatchRefused as refused:
            begun.device = self._device(begun, refused)
        return begun

    def _accepted(self, begun: Begun, values: int) -> Written:
        with self._lock:
            self._counts.accepted += 1
            self._counts.values += values
        return Written(
            len(begun.commands), values, begun.commands[0]["memory"] if begun.single else None
        )

    def _store(self, begun: Begun) -> int | None:
        """Writes to memory. Returns the number of values; `None` if a device must take them."""
        assert begun.native_batch is not None
        try:
            if begun.recording is not None:
                begun.recording.before_write()
            outcome: _Outcome = begun.native_batch.write()
        except Unrecorded:
            raise unrecorded(begun.where) from None
        except _core.BatchRefused as refused:
            outcome = refused
        return self._record_outcome(begun, outcome)

    def _record_outcome(self, begun: Begun, outcome: _Outcome) -> int | None:
        """Records the outcome of a write to memory. Returns as `_store`."""
        if isinstance(outcome, _core.BatchRefused):
            begun.device = self._device(begun, outcome)
            return None
        values, sequence = outcome
        if begun.recording is not None:
            begun.recording.carried_out(sequence)
        return values

    def _device(self, begun: Begun, refused: _core.BatchRefused) -> str:
        """The device that takes a write in place of a memory.

        Raises `Refused` if there is none, for a write that is granted only while the memory is
        sealed, and for one that may be old: no stale command moves a machine.
        """
        command = begun.commands[refused.command]
        if begun.single and refused.reason == "mirrored":
            passage = self._passages.get(command["memory"])
            count = len(values_of(command))
            device = passage and passage.device_of(command["area"], command["address"], count)
            if device is not None:
                if command["area"] not in begun.grant.areas:
                    detail = f"area {command['area']} is granted to {begun.grant.name} only while "
                    detail += f"{command['memory']} is sealed; this write would go to {device}"
                    raise Refused("not_granted", detail, **begun.where)
                if begun.stale is None:
                    return device
                detail = f"not sent to {device}: {begun.stale}"
                raise Refused("stale_command", detail, **begun.where)
        index = None if begun.single else refused.command
        error = self._refused(command, refused, begun.grant, index)
        if refused.reason == "not_confirmed" and begun.recording is not None:
            begun.recording.not_confirmed()
            error.is_recorded = True
        raise error from None

    def _to_device(self, begun: Begun, write: Callable[..., Any]) -> Any:
        """Calls `write` with the passage, area, address and values. Raises `Refused`."""
        [command] = begun.commands
        values = [int(value) for value in values_of(command)]
        if self._audit is not None:
            try:
                self._audit.require()
            except Unrecorded:
                raise unrecorded(begun.where) from None
        passage = self._passages[command["memory"]]
        try:
            return write(passage, command["area"], command["address"], values)
        except ValueError as error:
            detail = f"{error}, in one write to {begun.device}"
            raise Refused("out_of_range", detail, **begun.where) from None

    def _checked(self, command: object, grant: Grant, index: int | None) -> Write:
        """Checks a command, except its range and its values, which native code checks."""
        if not isinstance(command, dict):
            raise malformed(index, f"is {shown(command)}, not an object")
        keys = command.keys()
        if keys != _KEYS and keys != _BOOLS_KEYS:
            raise malformed(index, _keys_wrong(command))
        memory, area, address = command["memory"], command["area"], command["address"]
        if type(memory) is not str or type(area) is not str or type(address) is not int:
            raise malformed(index, _type_wrong(command))
        place = index, memory, area, address
        restores = bool(grant.while_sealed) and self._restores(memory, area, grant)
        if restores:
            target = self.memories[memory]
        else:
            target = self._granted(memory, area, address, grant, index)
        if not grant.writes:
            raise Refused("not_granted", f"{grant.name} may not write", **place_of(*place))
        if "bools" in command and area not in BIT_AREAS:
            raise refusal("malformed", f"bools are only for bits; {area} has registers", place)
        values = values_of(command)
        if type(values) is not list:
            raise refusal("malformed", f"values are {shown(values)}, not an array", place)
        write = (target, area, address, values)
        return (*write, True) if restores else write

    def _restores(self, memory: str, area: str, grant: Grant) -> bool:
        """Whether a write is granted only while the memory is sealed."""
        return (
            area in grant.while_sealed
            and area not in grant.areas
            and grant.writes
            and memory in grant.memories
            and memory in self.memories
        )

    def _granted(
        self, memory: str, area: str, address: int, grant: Grant, index: int | None = None
    ) -> Memory:
        target = self.memories.get(memory)
        if target is not None and memory in grant.memories and area in grant.areas:
            return target
        place = index, memory, area, address
        if target is None:
            raise refusal("unknown_memory", f"no memory {shown(memory)}", place)
        if memory in grant.memories and area not in AREAS:
            detail = f"area is {shown(area)}, allowed: {', '.join(AREAS)}"
            raise refusal("invalid_area", detail, place)
        what = f"area {area}" if memory in grant.memories else f"memory {memory}"
        raise refusal("not_granted", f"{what} is not granted to {grant.name}", place)

    def _refused(
        self,
        command: Mapping[str, Any],
        refused: _core.BatchRefused,
        grant: Grant,
        index: int | None,
    ) -> Refused:
        """Converts a refusal of native code. Raises it again if no command can cause it."""
        memory, area, address = command["memory"], command["area"], command["address"]
        values, place = values_of(command), (index, memory, area, address)
        match refused.reason:
            case "empty":
                return refusal("malformed", "values are empty", place)
            case "out_of_range":
                return self._out_of_range(memory, area, address, len(values), index)
            case "mirrored":
                found = f"{len(values)} from address {shown(address)} of {area}"
                detail = f"{found} overlap a range that mirrors a device"
                return refusal("mirrored", detail, place)
            case "unsealed":
                return refusal("not_granted", _not_sealed(command, grant), place)
            case "stale":
                detail = "a range mirrors a device, and its values are too old"
                return refusal("stale", detail, place)
            case "not_one_step":
                detail = f"{memory} and other memories of the batch are not kept together"
                detail += ", so no step writes all of them"
                return refusal("not_one_step", detail, place)
            case "too_large":
                detail = f"{refused.detail}; nothing has changed"
                return Refused("too_large", detail, **place_of(*place))
            case reason if reason in REFUSED_FOR_NOW:
                return Refused(reason, REFUSED_FOR_NOW[reason], **place_of(*place))
            case "invalid_value" | "invalid_type" if refused.index is not None:
                value = shown(values[refused.index])
                wrong = "outside" if refused.reason == "invalid_value" else "not"
                allowed = f"{wrong} 0..{MAX_WORD}"
                if area in BIT_AREAS:
                    allowed = "not 0, 1, false or true"
                detail = f"values[{refused.index}] is {value}, {allowed}"
                at = refused.index
                return refusal("invalid_value", detail, place, index=at, value=value)
            case _:
                raise refused

    def _out_of_range(
        self, memory: str, area: str, address: int, count: int, index: int | None = None
    ) -> Refused:
        addresses = self.memories[memory].areas.get(area)  # type: ignore[call-overload]
        if addresses is None:
            allowed = f"but {memory} has no {area}"
        elif address in addresses:
            allowed = f"allowed: 1 to {addresses.stop - address}"
        else:
            allowed = f"allowed: addresses {addresses.start} to {addresses.stop - 1}"
        found = f"{count} from address {shown(address)} of {area}, {allowed}"
        return refusal("out_of_range", found, (index, memory, area, address))


def _set_outcome(
    loop: asyncio.AbstractEventLoop, ended: asyncio.Future[_Outcome], outcome: _Outcome
) -> None:
    """Ends a write of an event loop, from another thread."""

    def set_outcome() -> None:
        if not ended.done():
            ended.set_result(outcome)

    with contextlib.suppress(RuntimeError):  # The loop is already closed.
        loop.call_soon_threadsafe(set_outcome)


def _not_confirmed() -> _core.BatchRefused:
    """The refusal of a write whose outcome nobody waits for."""
    refused = _core.BatchRefused()
    refused.command, refused.index, refused.reason = 0, None, "not_confirmed"
    return refused


_SCALAR: Any = bool | int | float | str | None
_VALUE: Any = _SCALAR | list[msgspec.Raw] | dict[str, msgspec.Raw]
_FIELD: Any = _SCALAR | list[_VALUE] | dict[str, msgspec.Raw]
_COMMAND: Any = _SCALAR | list[msgspec.Raw] | dict[str, _FIELD]
_DOCUMENT = msgspec.json.Decoder(_SCALAR | list[_COMMAND] | dict[str, _FIELD])
"""JSON as deep as a batch of commands. What is nested deeper is not built, however deep it is."""


def _decoded(body: bytes | bytearray | memoryview) -> object:
    try:
        return _DOCUMENT.decode(body)
    except MALFORMED_JSON as error:
        raise Refused("malformed", f"not JSON: {malformed_text(error, body)}") from None


def _keys_wrong(command: Mapping[str, object]) -> str:
    unknown = [key for key in command if key not in _KEYS | _BOOLS_KEYS]
    if unknown:
        return f"has the unknown key {shown(unknown[0])}"
    if "values" in command and "bools" in command:
        return "has both values and bools, allowed: only one"
    missing = [key for key in ("memory", "area", "address", "values") if key not in command]
    return f"lacks {missing[0]}"


def _type_wrong(command: Mapping[str, object]) -> str:
    """Describes the first of memory, area and address that has the wrong type."""
    for key in ("memory", "area"):
        if type(command[key]) is not str:
            return f"{key} is {shown(command[key])}, not text"
    return f"address is {shown(command['address'])}, not an integer"


def _not_sealed(command: Mapping[str, Any], grant: Grant) -> str:
    memory, area = command["memory"], command["area"]
    if area in grant.areas:
        return f"{memory} is not sealed, which another command of the batch requires of all"
    return f"area {area} is granted to {grant.name} only while {memory} is sealed"

"""Memory access for adapters: checks commands, then writes them atomically.

Every adapter has its own `MemoryAccess`, and passes the grant of the source with each call. A batch
is checked completely before anything is written, and written atomically, even to several memories.
Accesses are counted, and writes are audited.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from holdfast import _core, logs
from holdfast.audit import Unrecorded
from holdfast.ingest.recording import Recording
from holdfast.protocol import EXCEPTIONS
from holdfast.runtime.text import clip
from holdfast.types import AREAS, BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from holdfast._core import Follower, Memory, Passage
    from holdfast.audit import Audit

MAX_SHOWN = 40

_KEYS = {"memory", "area", "address", "values"}
_BOOLS_KEYS = {"memory", "area", "address", "bools"}

Write: TypeAlias = "tuple[Memory, str, int, list[Any]] | tuple[Memory, str, int, list[Any], bool]"
"""A write; the last item says that it is granted only while the memory is sealed."""


class Refused(Exception):
    """A command was refused; nothing has changed.

    `reason` is a word for programs, `detail` a message for people. `where` locates the error:
    `command` is the index of the command in a batch, `index` the index of the value in the command.
    `memory`, `area`, `address` and `value` are from the command, as far as they could be parsed.
    `is_recorded` tells whether the audit log has it already.
    """

    is_recorded = False

    def __init__(self, reason: str, detail: str, **where: Any) -> None:
        super().__init__(detail)
        self.reason = reason
        self.detail = detail
        self.where = where

    def answer(self) -> dict[str, object]:
        """Returns the answer for the source."""
        places: dict[str, object] = {
            key: self.where[key] for key in ("command", "index") if key in self.where
        }
        return {"status": "rejected", "reason": self.reason, **places, "detail": self.detail}


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


@dataclass(frozen=True)
class Written:
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


MAX_REASONS = 64
"""The most reasons that are counted apart: adapters of other packages have their own."""

KEEPING = {
    "not_stored": "the file of the memory can't be written; nothing has changed",
    "log_unavailable": "the log of the memory can't be reached; nothing has changed",
    "not_confirmed": "the log did not confirm the write in time; it may still be carried out",
}
"""Why memories that are kept refuse writes."""

OTHER = "other"
"""The reason under which all others are counted."""


@dataclass
class Counts:
    """Counters of one memory access: accepted messages, values written, reads, refusals."""

    accepted: int = 0
    values: int = 0
    reads: int = 0
    refused: Counter[str] = field(default_factory=Counter)

    def refuse(self, reason: str) -> None:
        """Counts a refusal. Reasons beyond `MAX_REASONS` are counted together."""
        known = reason in self.refused or len(self.refused) < MAX_REASONS
        self.refused[reason if known else OTHER] += 1

    def snapshot(self) -> dict[str, object]:
        """Returns a copy of the counters."""
        return {
            "accepted": self.accepted,
            "values": self.values,
            "reads": self.reads,
            "refused": dict(self.refused),
        }


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

    @property
    def may_wait(self) -> bool:
        """Whether a write can take as long as a device, a disk or a log needs to answer."""
        return bool(self._passages) or any(memory.waits for memory in self.memories.values())

    def ingest(self, body: bytes | bytearray | memoryview, grant: Grant, peer: str) -> Written:
        """Carries out JSON: one command, or an array of commands. Raises `Refused`."""
        try:
            return self._written(_decoded(body), grant, peer)
        except Refused as refused:
            self.refuse(refused, grant.name, peer)
            raise

    def write(self, commands: Sequence[Mapping[str, object]], grant: Grant, peer: str) -> Written:
        """Carries out commands atomically, each with memory, area, address and values.

        Raises `Refused`.
        """
        try:
            return self._written(list(commands), grant, peer)
        except Refused as refused:
            self.refuse(refused, grant.name, peer)
            raise

    def read(
        self, memory: str, area: str, address: int, count: int, grant: Grant, peer: str
    ) -> list[int]:
        """Reads `count` values atomically. Raises `Refused`."""
        try:
            target = self._granted(memory, area, address, grant)
            try:
                values = target.read(area, address, count)  # type: ignore[arg-type]
            except (_core.OutOfRange, ValueError):  # A count below 1 is a `ValueError`.
                raise self._out_of_range(memory, area, address, count) from None
            except OSError as error:
                where = _where(None, memory, area, address)
                raise Refused(unreadable(error), str(error), **where) from None
        except Refused as refused:
            self.note(refused, grant.name, peer)
            raise
        with self._lock:
            self._counts.reads += 1
        return values

    def follow(
        self, memory: str, ranges: Sequence[tuple[str, int, int]], grant: Grant, peer: str
    ) -> Follower:
        """Returns a follower of ranges: area, address and count. Raises `Refused`."""
        try:
            for area, address, count in ranges:
                target = self._granted(memory, area, address, grant)
                try:
                    _core.Follower(target, [(area, address, count)])  # type: ignore[list-item]
                except (_core.OutOfRange, ValueError):  # A count below 1 is a `ValueError`.
                    raise self._out_of_range(memory, area, address, count) from None
            follower = _core.Follower(self.memories[memory], ranges)  # type: ignore[arg-type]
        except Refused as refused:
            self.note(refused, grant.name, peer)
            raise
        with self._lock:
            self._counts.reads += 1
        return follower

    def refuse(
        self, refused: Refused, who: str, peer: str, *, throttle: logs.Throttle | None = None
    ) -> None:
        """Counts, logs and audits a refused write. Adapters call it for writes they refuse.

        `throttle` limits the lines in the log, in place of the limit for all refusals.

        A write without a valid token has no line of its own: everybody can send any number of them.
        """
        by_nobody = refused.reason == "unauthorized"
        self._note(refused, who, peer, observed=by_nobody, throttle=throttle)
        if self._audit is not None and not refused.is_recorded and not by_nobody:
            self._audit.write(
                listener=self.name,
                peer=peer,
                source=who,
                function="write",
                **refused.where,
                outcome=refused.reason,
            )

    def note(self, refused: Refused, who: str, peer: str) -> None:
        """Logs and counts a refusal without a line of its own in the audit log, as of a read."""
        self._note(refused, who, peer, observed=True)

    def _note(
        self,
        refused: Refused,
        who: str,
        peer: str,
        *,
        observed: bool,
        throttle: logs.Throttle | None = None,
    ) -> None:
        fields = {
            "adapter": self.name,
            "peer": peer,
            "source": who,
            **refused.where,
            "reason": refused.reason,
        }
        kind = (self.name, refused.reason)
        logs.count(
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

    def _written(self, document: object, grant: Grant, peer: str) -> Written:
        if isinstance(document, list):
            if not document:
                raise Refused("malformed", "the batch is empty")
            batch = document
        else:
            batch = [document]
        single = batch is not document
        recording = None
        if self._audit is not None:
            recording = Recording(self._audit, partial(self._lines, batch, grant, peer))
        try:
            # Commands are checked one by one: native code stops at the first refused command.
            values, sequence = _core.write_across(
                (
                    self._checked(command, grant, None if single else index)  # type: ignore[misc]
                    for index, command in enumerate(batch)
                ),
                None if recording is None else recording.begin,
            )
            if recording is not None:
                recording.done(sequence)
        except Unrecorded:
            raise _unrecorded(batch[0] if single else None) from None
        except _core.BatchRefused as refused:
            command = batch[refused.command]
            device = None
            if single and refused.reason == "mirrored" and command["area"] in grant.areas:
                device = self._device(command)
            if device is None:
                error = self._refused(command, refused, grant, None if single else refused.command)
                if refused.reason == "not_confirmed" and recording is not None:
                    recording.not_confirmed()
                    error.is_recorded = True
                raise error from None
            values = self._pass(command, device, grant, peer)
        with self._lock:
            self._counts.accepted += 1
            self._counts.values += values
        return Written(len(batch), values, batch[0]["memory"] if single else None)

    def _lines(
        self,
        batch: Sequence[Mapping[str, Any]],
        grant: Grant,
        peer: str,
        outcome: Mapping[str, object],
    ) -> Iterator[dict[str, object]]:
        return ({**self._line(command, grant, peer), **outcome} for command in batch)

    def _line(self, command: Mapping[str, Any], grant: Grant, peer: str) -> dict[str, object]:
        return {
            "listener": self.name,
            "peer": peer,
            "source": grant.name,
            "function": "write",
            "memory": command["memory"],
            "area": command["area"],
            "address": command["address"],
            "values": [int(item) for item in _values(command)],
        }

    def _device(self, command: Mapping[str, Any]) -> str | None:
        """The device that takes a write, if its range is written through to one."""
        passage = self._passages.get(command["memory"])
        count = len(_values(command))
        return passage and passage.device_of(command["area"], command["address"], count)

    def _pass(self, command: Mapping[str, Any], device: str, grant: Grant, peer: str) -> int:
        """Writes to a device. Returns the number of values. Raises `Refused`."""
        memory, area, address = command["memory"], command["area"], command["address"]
        where = _where(None, memory, area, address)
        values = [int(value) for value in _values(command)]
        if self._audit is not None:
            try:
                self._audit.require()
            except Unrecorded:
                raise _unrecorded(command) from None
        try:
            code = self._passages[memory].write(area, address, values)
        except ValueError as error:
            raise Refused("out_of_range", f"{error}, in one write to {device}", **where) from None
        if code == 0:
            if self._audit is not None:
                lines = self._lines([command], grant, peer, {"outcome": "done"})
                self._audit.write_all(lines, done=True)
            return len(values)
        name = EXCEPTIONS.get(code, "unknown")
        detail = f"{device} did not take the write: exception {code:02X} ({name})"
        raise Refused("device_refused", detail, **where)

    def _checked(self, command: object, grant: Grant, index: int | None) -> Write:
        """Checks a command, except its range and its values, which native code checks."""
        if not isinstance(command, dict):
            raise _malformed(index, f"is {_shown(command)}, not an object")
        keys = command.keys()
        if keys != _KEYS and keys != _BOOLS_KEYS:
            raise _malformed(index, _keys_wrong(command))
        memory, area, address = command["memory"], command["area"], command["address"]
        if type(memory) is not str or type(area) is not str or type(address) is not int:
            raise _malformed(index, _type_wrong(command))
        restores = bool(grant.while_sealed) and self._restores(memory, area, grant)
        if restores:
            target = self.memories[memory]
        else:
            target = self._granted(memory, area, address, grant, index)
        if not grant.writes:
            where = _where(index, memory, area, address)
            raise Refused("not_granted", f"{grant.name} may not write", **where)
        if "bools" in command and area not in BIT_AREAS:
            where = _where(index, memory, area, address)
            raise _malformed(index, f"bools are only for bits; {area} has registers", where)
        values = _values(command)
        if type(values) is not list:
            where = _where(index, memory, area, address)
            raise _malformed(index, f"values are {_shown(values)}, not an array", where)
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
        of, where = _of(index), _where(index, memory, area, address)
        if target is None:
            raise Refused("unknown_memory", f"{of}no memory {_shown(memory)}", **where)
        if memory not in grant.memories:
            detail = f"memory {memory} is not granted to {grant.name}"
        elif area not in AREAS:
            detail = f"area is {_shown(area)}, allowed: {', '.join(AREAS)}"
            raise Refused("invalid_area", f"{of}{detail}", **where)
        else:
            detail = f"area {area} is not granted to {grant.name}"
        raise Refused("not_granted", f"{of}{detail}", **where)

    def _refused(
        self,
        command: Mapping[str, Any],
        refused: _core.BatchRefused,
        grant: Grant,
        index: int | None,
    ) -> Refused:
        """Converts a refusal of native code. Raises it again if no command can cause it."""
        memory, area, address = command["memory"], command["area"], command["address"]
        values, where = _values(command), _where(index, memory, area, address)
        match refused.reason:
            case "empty":
                return _malformed(index, "values are empty", where)
            case "out_of_range":
                return self._out_of_range(memory, area, address, len(values), index)
            case "mirrored":
                found = f"{_of(index)}{len(values)} from address {_shown(address)} of {area}"
                detail = f"{found} overlap a range that mirrors a device"
                return Refused("mirrored", detail, **where)
            case "unsealed":
                return Refused("not_granted", f"{_of(index)}{_not_sealed(command, grant)}", **where)
            case "stale":
                detail = f"{_of(index)}a range mirrors a device, and its values are too old"
                return Refused("stale", detail, **where)
            case "not_one_step":
                detail = f"{_of(index)}{memory} and the memories before it are not kept together"
                return Refused("not_one_step", f"{detail}, so no step writes all of them", **where)
            case "not_stored":
                return Refused("not_stored", KEEPING["not_stored"], **where)
            case "log_unavailable":
                return Refused("log_unavailable", KEEPING["log_unavailable"], **where)
            case "not_confirmed":
                return Refused("not_confirmed", KEEPING["not_confirmed"], **where)
            case "invalid_value" | "invalid_type" if refused.index is not None:
                shown = _shown(values[refused.index])
                wrong = "outside" if refused.reason == "invalid_value" else "not"
                allowed = f"{wrong} 0..65535"
                if area in BIT_AREAS:
                    allowed = "not 0, 1, false or true"
                detail = f"{_of(index)}values[{refused.index}] is {shown}, {allowed}"
                return Refused("invalid_value", detail, index=refused.index, value=shown, **where)
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
        found = f"{_of(index)}{count} from address {_shown(address)} of {area}"
        where = _where(index, memory, area, address)
        return Refused("out_of_range", f"{found}, {allowed}", **where)


def unreadable(error: OSError) -> str:
    """The reason why a memory can't be read."""
    return "stale" if isinstance(error, _core.Stale) else "log_unavailable"


def _decoded(body: bytes | bytearray | memoryview) -> object:
    try:
        return msgspec.json.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise Refused("malformed", f"not JSON: {error}") from None


def _keys_wrong(command: Mapping[str, object]) -> str:
    unknown = [key for key in command if key not in _KEYS | _BOOLS_KEYS]
    if unknown:
        return f"has the unknown key {_shown(unknown[0])}"
    if "values" in command and "bools" in command:
        return "has both values and bools, allowed: only one"
    missing = [key for key in ("memory", "area", "address", "values") if key not in command]
    return f"lacks {missing[0]}"


def _type_wrong(command: Mapping[str, object]) -> str:
    """Describes the first of memory, area and address that has the wrong type."""
    for key in ("memory", "area"):
        if type(command[key]) is not str:
            return f"{key} is {_shown(command[key])}, not text"
    return f"address is {_shown(command['address'])}, not an integer"


def _values(command: Mapping[str, Any]) -> Any:
    return command["values"] if "values" in command else command["bools"]


def _of(index: int | None) -> str:
    return "" if index is None else f"commands[{index}]: "


def _where(index: int | None, memory: str, area: str, address: int) -> dict[str, Any]:
    """Returns the target of a command for logs, with limited lengths."""
    return {
        **({} if index is None else {"command": index}),
        "memory": memory[:MAX_SHOWN],
        "area": area[:MAX_SHOWN],
        "address": address if -(2**63) < address < 2**63 else _shown(address),
    }


def _not_sealed(command: Mapping[str, Any], grant: Grant) -> str:
    memory, area = command["memory"], command["area"]
    if area in grant.areas:
        return f"{memory} is not sealed, which another command of the batch requires of all"
    return f"area {area} is granted to {grant.name} only while {memory} is sealed"


def _unrecorded(command: Mapping[str, Any] | None) -> Refused:
    """A refusal of one command, or of a batch."""
    where = {}
    if command is not None:
        where = _where(None, command["memory"], command["area"], command["address"])
    detail = "the audit log can't be written, and no write is carried out without a record"
    return Refused("unrecorded", detail, **where)


def _malformed(index: int | None, detail: str, where: Mapping[str, Any] | None = None) -> Refused:
    if where is None:
        where = {} if index is None else {"command": index}
    return Refused("malformed", f"{_of(index)}{detail}", **where)


def _shown(value: object) -> str:
    """Formats an untrusted value for logs: as JSON, cut to a limited length."""
    if isinstance(value, dict | list):
        return "an object" if isinstance(value, dict) else "an array"
    text = msgspec.json.encode(value, enc_hook=repr).decode()
    return clip(text, MAX_SHOWN)

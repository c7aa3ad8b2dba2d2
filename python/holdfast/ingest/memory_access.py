"""The door that data comes in by: commands, checked, then written as one step.

Every adapter has a door of its own, which knows what its sources may touch. All of a batch is
checked before memory is touched, and all of it is written as one step, also over several memories.
A door counts and audits; it knows nothing of HTTP or MQTT.
"""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from holdfast import _core, logs
from holdfast.protocol import MAX_WORD
from holdfast.types import AREAS, BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from holdfast._core import Memory
    from holdfast.ingest.audit import Audit

MAX_SHOWN = 40

_KEYS = {"memory", "area", "address", "values"}
_BOOLS_KEYS = {"memory", "area", "address", "bools"}

Write: TypeAlias = "tuple[Memory, str, int, list[Any]]"


class Refused(Exception):
    """A command that is not carried out; nothing has changed.

    `reason` is one word for programs, `detail` a sentence for people. `command` is the place of the
    command in a batch, `index` the place of the value in the command. `memory`, `area`, `address`
    and `value` are what the command says, as far as it was understood.
    """

    def __init__(self, reason: str, detail: str, **where: Any) -> None:
        super().__init__(detail)
        self.reason = reason
        self.detail = detail
        self.where = where

    def answer(self) -> dict[str, object]:
        """What the source is told."""
        places: dict[str, object] = {
            key: self.where[key] for key in ("command", "index") if key in self.where
        }
        return {"status": "rejected", "reason": self.reason, **places, "detail": self.detail}


@dataclass(frozen=True)
class Grant:
    """What a source may do: to which memories and areas, and whether it may write."""

    name: str
    """Whom it is given to, for logs."""
    memories: Collection[str]
    areas: Collection[str]
    writes: bool = True


@dataclass(frozen=True)
class Written:
    """What was written: one command, or a batch."""

    commands: int
    values: int
    memory: str | None
    """The memory, when it was one command outside of any batch."""

    def answer(self) -> dict[str, object]:
        """What the source is told."""
        if self.memory is not None:
            return {"status": "accepted", "memory": self.memory, "written": self.values}
        return {"status": "accepted", "commands": self.commands, "written": self.values}


@dataclass
class Counts:
    """What became of the messages that came to the memory access."""

    accepted: int = 0
    values: int = 0
    reads: int = 0
    refused: Counter[str] = field(default_factory=Counter)

    def snapshot(self) -> dict[str, object]:
        """The numbers so far."""
        return {
            "accepted": self.accepted,
            "values": self.values,
            "reads": self.reads,
            "refused": dict(self.refused),
        }


class MemoryAccess:
    """Writes and reads memories on behalf of one adapter."""

    def __init__(
        self, name: str, memories: Mapping[str, Memory], audit: Audit | None = None
    ) -> None:
        self.name = name
        self.memories = memories
        self._addresses = {memory: entry.areas for memory, entry in memories.items()}
        self._audit = audit
        self._counts = Counts()
        self._lock = threading.Lock()

    def ingest(self, body: bytes | bytearray | memoryview, grant: Grant, peer: str) -> Written:
        """Carries out the JSON of one command, or of an array of them. Raises `Refused`."""
        try:
            return self._written(_decoded(body), grant, peer)
        except Refused as refused:
            self.refuse(refused, grant.name, peer)
            raise

    def write(self, commands: Sequence[Mapping[str, object]], grant: Grant, peer: str) -> Written:
        """Carries out commands, each with memory, area, address and values, as one step.

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
        """`count` values of one moment. Raises `Refused`."""
        where = _place(memory, area, address)
        try:
            target = self._granted(memory, area, grant, where)
            self._check_range(memory, area, address, count, where)
        except Refused as refused:
            self.note(refused, grant.name, peer)
            raise
        with self._lock:
            self._counts.reads += 1
        return target.read(area, address, count)  # type: ignore[arg-type]

    def refuse(self, refused: Refused, who: str, peer: str) -> None:
        """Counts, logs and audits a write that is refused, also one that never came in here."""
        self.note(refused, who, peer)
        if self._audit is not None:
            self._audit.write(
                listener=self.name,
                peer=peer,
                source=who,
                function="write",
                **refused.where,
                outcome=refused.reason,
            )

    def note(self, refused: Refused, who: str, peer: str) -> None:
        """Counts and logs a refusal; what is no write is not audited."""
        with self._lock:
            self._counts.refused[refused.reason] += 1
        logs.refused(
            "ingest_refused",
            kind=(self.name, refused.reason),
            adapter=self.name,
            peer=peer,
            source=who,
            **refused.where,
            reason=refused.reason,
        )

    def counts(self) -> dict[str, object]:
        """What became of all that came."""
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
        writes = [
            self._checked(command, grant, {} if single else {"command": index})
            for index, command in enumerate(batch)
        ]
        try:
            _core.write_across(writes)  # type: ignore[arg-type]
        except (ValueError, TypeError, _core.OutOfRange):
            for index, (command, write) in enumerate(zip(batch, writes, strict=True)):
                _explain(command, write, {} if single else {"command": index})
            raise
        values = sum(len(write[3]) for write in writes)
        with self._lock:
            self._counts.accepted += 1
            self._counts.values += values
        if self._audit is not None:
            for command, (_, area, address, items) in zip(batch, writes, strict=True):
                self._audit.write(
                    listener=self.name,
                    peer=peer,
                    source=grant.name,
                    function="write",
                    memory=command["memory"],
                    area=area,
                    address=address,
                    values=[int(item) for item in items],
                    outcome="done",
                )
        return Written(len(batch), values, batch[0]["memory"] if single else None)

    def _checked(self, command: object, grant: Grant, where: dict[str, Any]) -> Write:
        """All of a command but its values, which the memory checks."""
        if not isinstance(command, dict):
            raise _malformed(where, f"{_of(where)}is {_shown(command)}, not an object")
        keys = command.keys()
        if keys != _KEYS and keys != _BOOLS_KEYS:
            raise _malformed(where, f"{_of(where)}{_keys_wrong(command)}")
        memory, area, address = command["memory"], command["area"], command["address"]
        values = command["values"] if "values" in command else command["bools"]
        for key, kind in (("memory", str), ("area", str), ("address", int)):
            if type(command[key]) is not kind:
                words = "text" if kind is str else "an integer"
                found = f"{key} is {_shown(command[key])}, not {words}"
                raise _malformed(where, f"{_of(where)}{found}")
        where |= _place(memory, area, address)
        target = self._granted(memory, area, grant, where)
        if not grant.writes:
            raise Refused("not_granted", f"{grant.name} may not write", **where)
        if "bools" in command and area not in BIT_AREAS:
            raise _malformed(where, f"{_of(where)}bools are for bits, {area} has registers")
        if type(values) is not list or not values:
            found = "empty" if values == [] else f"{_shown(values)}, not an array"
            raise _malformed(where, f"{_of(where)}values are {found}")
        self._check_range(memory, area, address, len(values), where)
        return target, area, address, values

    def _granted(self, memory: str, area: str, grant: Grant, where: dict[str, Any]) -> Memory:
        target = self.memories.get(memory)
        if target is None:
            raise Refused("unknown_memory", f"{_of(where)}no memory {_shown(memory)}", **where)
        if memory not in grant.memories:
            detail = f"{_of(where)}memory {memory} is not granted to {grant.name}"
            raise Refused("not_granted", detail, **where)
        if area not in AREAS:
            allowed = ", ".join(AREAS)
            detail = f"{_of(where)}area is {_shown(area)}, allowed are {allowed}"
            raise Refused("invalid_area", detail, **where)
        if area not in grant.areas:
            detail = f"{_of(where)}area {area} is not granted to {grant.name}"
            raise Refused("not_granted", detail, **where)
        return target

    def _check_range(
        self, memory: str, area: str, address: int, count: int, where: dict[str, Any]
    ) -> None:
        addresses = self._addresses[memory].get(area)  # type: ignore[call-overload]
        if addresses is not None and address in addresses:
            if 1 <= count <= addresses.stop - address:
                return
            allowed = f"allowed are 1 to {addresses.stop - address}"
        elif addresses is not None:
            allowed = f"allowed are addresses {addresses.start} to {addresses.stop - 1}"
        else:
            allowed = f"but {memory} has no {area}"
        found = f"{_of(where)}{count} from address {_shown(address)} of {area}"
        raise Refused("out_of_range", f"{found}, {allowed}", **where)


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
        return "has values and bools, allowed is one of both"
    missing = [key for key in ("memory", "area", "address", "values") if key not in command]
    return f"lacks {missing[0]}"


def _explain(command: Mapping[str, object], write: Write, where: dict[str, Any]) -> None:
    """Raises `Refused` for the first value of a write that can't be, if there is one."""
    _, area, address, values = write
    bits = area in BIT_AREAS
    most, allowed = (1, "0, 1, false or true") if bits else (MAX_WORD, f"0..{MAX_WORD}")
    for index, value in enumerate(values):
        if bits and type(value) is bool:
            continue
        if type(value) is int and 0 <= value <= most:
            continue
        outside = f"outside {allowed}" if not bits and type(value) is int else f"not {allowed}"
        detail = f"{_of(where)}values[{index}] is {_shown(value)}, {outside}"
        where |= {"memory": command["memory"], "area": area, "address": address}
        raise Refused("invalid_value", detail, index=index, value=_shown(value), **where)


def _of(where: Mapping[str, Any]) -> str:
    return f"commands[{where['command']}]: " if "command" in where else ""


def _place(memory: str, area: str, address: int) -> dict[str, Any]:
    """What a command aims at, for logs: no longer than a log can take."""
    return {
        "memory": memory[:MAX_SHOWN],
        "area": area[:MAX_SHOWN],
        "address": address if -(2**63) < address < 2**63 else _shown(address),
    }


def _malformed(where: Mapping[str, Any], detail: str) -> Refused:
    return Refused("malformed", detail, **where)


def _shown(value: object) -> str:
    """A value as JSON, cut short: it comes from outside, and goes into logs."""
    if isinstance(value, dict | list):
        return "an object" if isinstance(value, dict) else "an array"
    text = msgspec.json.encode(value).decode()
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}…"

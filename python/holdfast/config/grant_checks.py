"""Checks grants to writers other than Modbus: their names exist, and they have an effect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from holdfast.config.lenient import entries
from holdfast.config.scalars import is_name
from holdfast.config.unique import refuse_repeats
from holdfast.config.words import show
from holdfast.runtime.text import guess, listing

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from holdfast.config.listeners import RawRuleConfig
    from holdfast.config.memories import Seal
    from holdfast.config.model import Config
    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath
    from holdfast.types import Area


@dataclass
class GrantChecks:
    """Checks names of memories and areas, on data that is not validated."""

    report: Report
    names: Sequence[str]
    """Names of the memories, empty if they are not known."""

    def grant(self, path: KeyPath, grant: dict[Any, Any]) -> None:
        """Checks the `memories` and `areas` of a grant."""
        self.memories((*path, "memories"), grant.get("memories"))
        self.areas((*path, "areas"), grant.get("areas"))
        self._while_sealed((*path, "while_sealed"), grant)

    def _while_sealed(self, path: KeyPath, grant: dict[Any, Any]) -> None:
        self.areas(path, grant.get("while_sealed"))
        for index, area in enumerate(entries(grant.get("while_sealed"))):
            if area in entries(grant.get("areas")):
                message = f"found {show(area)}, allowed: an area that is not in areas"
                self.report.add((*path, index), message)
        if "while_sealed" in grant and grant.get("access") == "read-only":
            message = "found with access: read-only, allowed: only with read-write"
            self.report.add(path, message, of_key=True)

    def memories(self, path: KeyPath, names: object) -> None:
        """Checks a list of memories."""
        for index, name in enumerate(entries(names)):
            self.memory((*path, index), name)
        refuse_repeats(path, entries(names), self.report)

    def areas(self, path: KeyPath, areas: object) -> None:
        """Checks a list of areas."""
        refuse_repeats(path, entries(areas), self.report)

    def memory(self, path: KeyPath, name: object) -> None:
        """Checks the name of one memory."""
        if self.names and is_name(name) and name not in self.names:
            allowed = f"allowed: {listing(self.names)}{guess(name, self.names)}"
            self.report.add(path, f"found {show(name)}, {allowed}")


class WriterGrant(NamedTuple):
    """What one writer may access; `path` is its place in the file."""

    path: KeyPath
    memories: Sequence[str]
    areas: Sequence[Area]
    writes: bool
    while_sealed: Sequence[Area] = ()


def grants(config: Config) -> Iterator[WriterGrant]:
    """All grants except those of Modbus clients."""
    for name, listener in config.listeners.items():
        path: KeyPath = ("listeners", name, "rules")
        rules: Sequence[RawRuleConfig] = ()
        if listener.type == "raw-ingest":
            rules = listener.rules
        if listener.type == "modbus-tcp" and listener.raw_ingest is not None:
            path, rules = ("listeners", name, "raw_ingest", "rules"), listener.raw_ingest.rules
        for index, rule in enumerate(rules):
            memories = (*rule.units.values(), *rule.memories)
            yield WriterGrant((*path, index), memories, rule.areas, writes=True)
    if config.rest is not None and config.rest.tokens != "none":
        for index, token in enumerate(config.rest.tokens):
            writes = token.access == "read-write"
            path = ("rest", "tokens", index)
            sealed = token.while_sealed or ()
            yield WriterGrant(path, token.memories, token.areas, writes, sealed)
    if config.mqtt is not None:
        for index, topic in enumerate(config.mqtt.subscriptions):
            path = ("mqtt", "subscriptions", index)
            sealed = topic.while_sealed or ()
            yield WriterGrant(path, topic.memories, topic.areas, True, sealed)
        for index, mapped in enumerate(config.mapped().values()):
            path = ("mqtt", "map", index)
            yield WriterGrant(path, [mapped.memory], [mapped.tag.area], writes=True)
    for name, adapter in config.adapters.items():
        writes = adapter.access == "read-write"
        yield WriterGrant(("adapters", name), adapter.memories, adapter.areas, writes)


def doubt_grants(config: Config, report: Report) -> None:
    """Warns about areas that no memory of a grant has, and about seals that nothing can open."""
    for grant in grants(config):
        there = {area for name in grant.memories for area in config.memories[name].areas()}
        for index, area in enumerate(grant.areas):
            if area not in there:
                message = f"{area} has no effect: {_have(grant.memories)} no such area"
                report.doubt((*grant.path, "areas", index), message)
        _doubt_while_sealed(config, grant, report)
    if config.rest is not None and config.rest.tokens == "none":
        return  # Every REST client may write everything, including the gate bits.
    for name, memory in config.memories.items():
        seal = memory.seal
        if seal is not None and not (
            _reads_into(config, name, seal)
            or any(
                grant.writes
                and name in grant.memories
                and seal.area in (*grant.areas, *grant.while_sealed)
                for grant in grants(config)
            )
        ):
            writers = "raw-ingest rule, token, subscription, adapter or device"
            message = f"can never be opened: no {writers} may write {seal.area} of {name}"
            report.doubt(("memories", name, "seal"), message)


def _doubt_while_sealed(config: Config, grant: WriterGrant, report: Report) -> None:
    sealed = [config.memories[name] for name in grant.memories if config.memories[name].seal]
    for index, area in enumerate(grant.while_sealed):
        if not any(area in memory.areas() for memory in sealed):
            message = f"{area} has no effect: none of its memories with a seal has this area"
            report.doubt((*grant.path, "while_sealed", index), message)


def _reads_into(config: Config, memory: str, gate: Seal) -> bool:
    """Whether a read of a device can set the gate bit of a memory."""
    return any(
        read.into is not None
        and (read.into.memory, read.into.area) == (memory, gate.area)
        and 0 <= gate.address - read.into.address < read.count
        for device in config.devices.values()
        if device.enabled
        for read in device.reads
    )


def _have(memories: Sequence[str]) -> str:
    names = list(dict.fromkeys(memories))
    return f"{names[0]} has" if len(names) == 1 else f"{listing(names)} have"

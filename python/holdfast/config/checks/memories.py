"""Checks memories, and grants to writers other than Modbus: names exist, and have an effect."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from holdfast.config import initial_values
from holdfast.config.checks.common import (
    Owners,
    check_name,
    given,
    items,
    refuse_repeats,
    until_invalid,
)
from holdfast.config.models.base import INVALID
from holdfast.config.models.listeners import RawRuleConfig
from holdfast.config.models.services import AdapterConfig
from holdfast.config.text.messages import show
from holdfast.config.text.problems import ConfigError
from holdfast.config.values.topics import overlap
from holdfast.runtime.text import extent, listing
from holdfast.types import AREAS, BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from holdfast.config.checks.common import Scope
    from holdfast.config.models.memories import MemoryConfig, Seal, Span
    from holdfast.config.models.root import Config
    from holdfast.config.models.services import SubscriptionConfig, TokenConfig
    from holdfast.config.text.report import Report
    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.types import Area

    SealedGrant: TypeAlias = SubscriptionConfig | TokenConfig
    Grant: TypeAlias = RawRuleConfig | AdapterConfig | SealedGrant


def check_memories(scope: Scope) -> None:
    """Reports problems, and reads the files with initial values."""
    with until_invalid():
        ids = Owners(scope.report, "id")
        for path, memory in items(("memories",), scope.config.memories):
            if not layout(memory):
                words = f"no area, allowed: at least one of {listing(AREAS)}"
                scope.report.add_key(path, words)
            with until_invalid():
                _check_fifo(scope, (*path, "fifo"), memory)
            with until_invalid():
                _check_initial(scope, path, memory)
            with until_invalid():
                if memory.id is not None:
                    ids.claim((*path, "id"), memory.id, str(memory.id), path)
        _check_files(scope)


def layout(memory: MemoryConfig) -> dict[Area, range | None]:
    """The addresses of the existing areas; `None` if they are invalid."""
    return {area: _addresses(memory, area) for area in AREAS if area in memory.model_fields_set}


def _addresses(memory: MemoryConfig, area: Area) -> range | None:
    with until_invalid():
        span: Span | None = getattr(memory, area)
        return None if span is None else span.addresses
    return None


def area_of(scope: Scope, path: KeyPath, name: str, area: Area) -> range | None:
    """The addresses of an area of a memory, `None` if the memory or area is not valid.

    Reports an area that the memory does not have, at the key `area` of `path`.
    """
    memory = scope.config.memories.get(name)
    if memory is None or memory is INVALID:
        return None
    if area in memory.model_fields_set:
        return _addresses(memory, area)
    areas = list(layout(memory))
    allowed = f"allowed: {listing(areas)}" if areas else "and it has no other area"
    message = f"found {show(area)}, an area that {name} does not have, {allowed}"
    scope.report.add((*path, "area"), message)
    return None


def _check_fifo(scope: Scope, path: KeyPath, memory: MemoryConfig) -> None:
    refuse_repeats(path, memory.fifo, scope.report)
    there = layout(memory).get("holding_registers", range(0))
    for where, address in items(path, memory.fifo):
        if there is not None and not (address in there and address + 1 in there):
            allowed = f"those of a count and a register after it, of {extent(there)}"
            allowed = allowed if len(there) > 1 else "none: the memory has no holding_registers"
            scope.report.add(where, f"found {address}, allowed: {allowed}")


def _gate(
    scope: Scope, path: KeyPath, seal: Seal, areas: dict[Area, range | None]
) -> initial_values.Cell | None:
    """The gate bit of a seal, if it can be one. Reports why not."""
    if seal.area not in areas:
        there = [area for area in BIT_AREAS if area in areas]
        allowed = f"allowed: {listing(there)}" if there else "and it has no area of bits"
        message = f"found {show(seal.area)}, an area that this memory does not have, {allowed}"
        scope.report.add((*path, "area"), message)
        return None
    addresses = areas[seal.area]
    if addresses is None:
        return None
    if seal.address not in addresses:
        allowed = f"allowed in {seal.area}: {extent(addresses)}"
        scope.report.add((*path, "address"), f"found {seal.address}, {allowed}")
        return None
    return seal.area, seal.address


def _check_initial(scope: Scope, path: KeyPath, memory: MemoryConfig) -> None:
    areas, gate = layout(memory), None
    with until_invalid():
        if memory.seal is not None:
            gate = _gate(scope, (*path, "seal"), memory.seal, areas)
    if memory.initial is None:
        return
    report, path = scope.report, (*path, "initial")
    file = report.raw(path)
    if memory.initial.suffix.lower() not in initial_values.KINDS:
        allowed = listing(initial_values.KINDS)
        report.add(path, f"found {show(file)}, allowed: a file with one of {allowed}")
        return
    shown = str(Path(report.document.file).parent / file)
    places: dict[str, range | None] = {area: areas[area] for area in areas}
    with until_invalid():
        places |= {f"file:{number}": range(records) for number, records in memory.files.items()}
    try:
        content = initial_values.read(memory.initial, shown, places)
    except ConfigError as error:
        report.add(path, f"found {show(file)}, which {error.problems[0].message}")
        return
    runs, problems = initial_values.parse(content, shown, places)
    if gate is not None:
        taken = initial_values.sealed(runs, gate)
        if taken != runs:
            taken_as = "taken as 0: the memory starts sealed"
            report.warn(path, f"{file} has 1 in the gate bit of the seal, {taken_as}")
        runs = taken
    memory.with_initial_values(runs)
    report.elsewhere += problems


def _check_files(scope: Scope) -> None:
    """Memories in one file are written together, so they have the same sync."""
    first: dict[Path, tuple[KeyPath, MemoryConfig]] = {}
    for path, memory in items(("memories",), scope.config.memories):
        with until_invalid():
            if memory.keep is None:
                continue
            owner, other = first.setdefault(memory.keep.file, (path, memory))
            if other.keep is not None and other.keep.sync != memory.keep.sync:
                allowed = f"{other.keep.sync:g}, as {owner[-1]} has for the file"
                message = f"found {memory.keep.sync:g}, allowed: {allowed}"
                scope.report.add((*path, "keep", "sync"), message)


def check_grant(scope: Scope, path: KeyPath, grant: Grant) -> None:
    """Checks the `memories` and `areas` of a grant, and the areas while a memory is sealed."""
    with until_invalid():
        for where, name in items((*path, "memories"), grant.memories):
            check_memory(scope, where, name)
        refuse_repeats((*path, "memories"), grant.memories, scope.report)
    with until_invalid():
        refuse_repeats((*path, "areas"), grant.areas, scope.report)
    if not isinstance(grant, RawRuleConfig | AdapterConfig):
        _check_while_sealed(scope, path, grant)


def _check_while_sealed(scope: Scope, path: KeyPath, grant: SealedGrant) -> None:
    with until_invalid():
        where = (*path, "while_sealed")
        refuse_repeats(where, grant.while_sealed, scope.report)
        for each, area in items(where, grant.while_sealed or ()):
            if area in grant.areas:
                scope.report.add(each, f"found {show(area)}, allowed: an area that is not in areas")
    with until_invalid():
        if given(grant, "while_sealed") and getattr(grant, "access", "") == "read-only":
            message = "found with access: read-only, allowed: only with read-write"
            scope.report.add_key(where, message)


def check_memory(scope: Scope, path: KeyPath, name: str) -> None:
    """Reports a memory that does not exist."""
    if memories := scope.config.memories:
        check_name(path, name, memories, "memories", scope.report)


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
        for index, mapped in enumerate(config.mqtt_tags().values()):
            path = ("mqtt", "map", index)
            yield WriterGrant(path, [mapped.memory], [mapped.tag.area], writes=True)
    for name, adapter in config.adapters.items():
        writes = adapter.access == "read-write"
        yield WriterGrant(("adapters", name), adapter.memories, adapter.areas, writes)


def warn_of_grants(scope: Scope) -> None:
    """Warns about areas that no memory of a grant has, and about seals that nothing can open."""
    config, report = scope.config, scope.report
    for grant in grants(config):
        there = {area for name in grant.memories for area in config.memories[name].areas()}
        for index, area in enumerate(grant.areas):
            if area not in there:
                message = f"{area} has no effect: {_have(grant.memories)} no such area"
                report.warn((*grant.path, "areas", index), message)
        _warn_of_while_sealed(config, grant, report)
    _warn_of_passed(config, report)
    _warn_of_late_messages(config, report)
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
            report.warn(("memories", name, "seal"), message)


def _warn_of_while_sealed(config: Config, grant: WriterGrant, report: Report) -> None:
    sealed = [config.memories[name] for name in grant.memories if config.memories[name].seal]
    for index, area in enumerate(grant.while_sealed):
        if not any(area in memory.areas() for memory in sealed):
            message = f"{area} has no effect: none of its memories with a seal has this area"
            report.warn((*grant.path, "while_sealed", index), message)


def _warn_of_late_messages(config: Config, report: Report) -> None:
    """Warns about messages that a broker keeps for a node, while other nodes write the memory."""
    if config.mqtt is None:
        return
    shared = {
        name
        for name, memory in config.memories.items()
        if memory.replicate is not None and config.logs[memory.replicate.log].embedded is None
    }
    topics: list[tuple[KeyPath, int, Sequence[str]]] = [
        (("mqtt", "subscriptions", index), topic.qos, topic.memories)
        for index, topic in enumerate(config.mqtt.subscriptions)
    ]
    topics += [
        (("mqtt", "map", index), topic.qos, (topic.memory,))
        for index, topic in enumerate(config.mqtt.map)
    ]
    for path, qos, memories in topics:
        if qos and (names := [name for name in memories if name in shared]):
            message = (
                f"found {qos}: messages that the broker keeps while this node is away are written "
                f"to {listing(names)} afterwards, over newer values of other nodes; with qos 0, it "
                "keeps none"
            )
            report.warn((*path, "qos"), message)


def _warn_of_passed(config: Config, report: Report) -> None:
    """Warns about messages of MQTT for ranges that are written through to devices: commands that
    a broker keeps are late, those that two filters match may come twice, and plain values are
    refused.
    """
    if config.mqtt is None:
        return
    passed = [
        (name, into, range(into.address, into.address + read.count))
        for name, device in config.devices.items()
        for read, into in device.passed
    ]
    subscriptions = config.mqtt.subscriptions
    for index, topic in enumerate(subscriptions):
        names = dict.fromkeys(
            name
            for name, into, _ in passed
            if into.memory in topic.memories and into.area in topic.areas
        )
        if names and topic.qos:
            message = (
                f"found {topic.qos}: commands that the broker keeps while there is no connection "
                f"are sent to {listing(names)} afterwards, however old; with qos 0, it keeps none"
            )
            report.warn(("mqtt", "subscriptions", index, "qos"), message)
        # The first filter that matches decides what a message may write.
        for later in range(index + 1, len(subscriptions) if names else 0):
            if overlap(topic.topic, subscriptions[later].topic):
                message = (
                    f"found {show(subscriptions[later].topic)}, which overlaps "
                    f"{show(topic.topic)}: a broker may deliver a message once for each of them, "
                    f"and its command is then sent to {listing(names)} twice"
                )
                report.warn(("mqtt", "subscriptions", later, "topic"), message)
    for index, (memory, tag) in enumerate(config.mqtt_tags().values()):
        for name, into, addresses in passed:
            is_there = (into.memory, into.area) == (memory, tag.area)
            if is_there and tag.address < addresses.stop and addresses.start < tag.end:
                message = f"has no effect: its range mirrors {name}, which is not sent plain values"
                report.warn(("mqtt", "map", index), message)
                break


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

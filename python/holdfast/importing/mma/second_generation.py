"""Imports the second generation: listeners contain memories, each with its own policy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast.config.values.scalars import RESERVED
from holdfast.importing.key_reader import Section, section
from holdfast.importing.mma import function_rights as functions
from holdfast.importing.mma.address_filters import ALL, read_networks
from holdfast.importing.mma.draft import ADMISSION, Reader
from holdfast.importing.mma.memories import check_gate, read_areas, read_id
from holdfast.importing.mma.policies import Policy, merged, unserved
from holdfast.importing.names import unique_names
from holdfast.protocol import LAST_ADDRESS, MAX_UNIT

if TYPE_CHECKING:
    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.importing.mma.address_filters import Peers
    from holdfast.net.addresses import Network

TOP_REASONS = {
    "replicator": "for the units in this file, use: holdfast import replicator",
    "debug": "log.level sets what is logged",
    "device_identity": "set the values under identity",
    "notify": "no notifications; programs read with Modbus or REST",
    "rbe": "no report by exception; programs read with Modbus or REST",
    "access_events": "the log has refused peers",
    "persistence": "set keep for the memories; what was stored is not taken over",
    "memory": "each listener has its own memories in this generation: listeners[].memory",
}
_MEMORY_REASONS = {
    "fc43": "set the values under identity, which applies to the whole appliance",
    "port": "a memory belongs to the listener that contains it",
    "notify": TOP_REASONS["notify"],
    "rbe": TOP_REASONS["rbe"],
    "persistence": TOP_REASONS["persistence"],
}
BUSY = 6


@dataclass
class _Memory:
    """One memory of a listener; `unit` is `None` if it is not valid."""

    section: Section
    unit: int | None
    name: str = ""


class SecondGeneration(Reader):
    """Reads `listeners` into a draft."""

    def read(self, root: Section) -> None:
        """Reads all sections."""
        self.rules_have_ids = False
        listeners = root.sections("listeners", required=True)
        wanted = [
            (one.at("id"), one.name("id", required=True) or f"listener-{number}")
            for number, one in enumerate(listeners, 1)
        ]
        names = unique_names(self.desk, wanted, RESERVED)
        memories = [self._memories(one) for one in listeners]
        self._name(list(zip(names, memories, strict=True)))
        for name, listener, own in zip(names, listeners, memories, strict=True):
            self._listener(name, listener, own)
        if listeners:
            self._note_changes(root.at("listeners"))

    def _note_changes(self, path: KeyPath) -> None:
        message = "a function that is not allowed returns 0x01, an unmapped unit id 0x0B"
        closed = "a peer that neither rules nor raw_ingest name is disconnected at once"
        self.desk.check(path, f"{message}; {closed}")
        if self.rules_have_ids:
            self.desk.left_out(path, "the ids of policy rules: rules have no names")

    def _memories(self, listener: Section) -> list[_Memory]:
        read = []
        first: dict[int, KeyPath] = {}
        for memory in listener.sections("memory"):
            unit = memory.integer("unit_id", 0, MAX_UNIT, required=True, what="a unit id")
            if unit is not None and unit in first:
                other = self.desk.document.spell(first[unit])
                message = f"found {unit}, which is the unit id of {other}, allowed: a different one"
                memory.problem("unit_id", message)
            elif unit is not None:
                first[unit] = memory.path
            read.append(_Memory(memory, unit))
        return read

    def _name(self, listeners: list[tuple[str, list[_Memory]]]) -> None:
        """Names all memories. Default: the listener's name and the unit id."""
        every = [(listener, memory) for listener, own in listeners for memory in own]
        wanted = []
        for listener, memory in every:
            name = memory.section.name("name") or f"{listener}-{memory.unit}"
            wanted.append((memory.section.at("name"), name))
        for (_, memory), name in zip(every, unique_names(self.desk, wanted), strict=True):
            memory.name = name

    def _listener(self, name: str, listener: Section, memories: list[_Memory]) -> None:
        bind = self.binds.at(listener, "listen", required=True)
        listener.close()
        policies = [self._memory(memory) for memory in memories]
        known = [policy for policy in policies if policy is not None]
        admitted = ALL if self.admitted is None else self.admitted
        rules = merged(known, admitted)
        raw = self._raw_ingest(listener, memories, admitted)
        common = {"bind": str(bind), **ADMISSION, "idle_timeout": 0}
        if not raw:
            message = "the listener is left out: nobody may read or write its memories"
            self.desk.left_out(listener.path, message)
            return
        if not rules:
            message = "no policy allows a function for its areas, so only Raw Ingest is served"
            self.desk.changed(listener.path, message)
            self.draft.listeners[name] = {"type": "raw-ingest", **common, **raw}
            return
        for policy in unserved(known, rules):
            message = f"no rule serves unit {policy.unit}: it allows no function for its areas"
            self.desk.check(listener.path, message)
        made = {"type": "modbus-tcp", **common, "rules": rules, "raw_ingest": raw}
        self.draft.listeners[name] = made

    def _raw_ingest(
        self, listener: Section, memories: list[_Memory], admitted: Peers
    ) -> dict[str, Any]:
        """What Raw Ingest packets to the port of a listener may write; empty if nobody may.

        The source applied no policy to packets, and answered each packet of a connection.
        """
        units = {one.unit: one.name for one in memories if one.unit is not None}
        areas = self.draft.grant(list(units.values()))["areas"]
        if not units or not admitted or not areas:
            return {}
        message = "every address may write all areas of all its units by Raw Ingest, as it ran:"
        text = f"{message} policies are for Modbus only. List only the senders in the sources of"
        self.desk.check(listener.path, f"{text} raw_ingest, or remove raw_ingest")
        rule = {"sources": admitted.written(), "units": units, "areas": areas}
        compat = {"packets": "many", "after_refusal": "continue"}
        return {"compat": compat, "rules": [rule]}

    def _memory(self, memory: _Memory) -> Policy | None:
        one = memory.section
        areas = read_areas(one, "count")
        found: dict[str, Any] = {**read_id(memory.name), **areas}
        self.draft.memories[memory.name] = found
        seal = self._seal(one, memory.name, areas)
        if seal is not None:
            found["seal"] = seal
            self.draft.seals[memory.name] = one.at("state_sealing")
        rules = self._policy(one)
        one.close(_MEMORY_REASONS)
        if memory.unit is None or rules is None:
            return None
        return Policy(memory.unit, memory.name, functions.touching(areas), tuple(rules))

    def _seal(self, one: Section, name: str, areas: dict[str, Any]) -> dict[str, Any] | None:
        sealing = one.mapping("state_sealing")
        if sealing is None:
            return None
        enabled = sealing.flag("enabled") is not False
        sealing.word("area", ["coil"], required=enabled, any_case=True)
        address = sealing.integer("address", 0, LAST_ADDRESS, required=enabled)
        exception = sealing.integer("exception", 1, 255)
        sealing.close()
        if not enabled:
            self.desk.left_out(sealing.path, "not enabled")
            return None
        if exception not in (None, BUSY):
            sealing.left_out("exception", f"a sealed memory always returns 0x{BUSY:02X}")
        path = sealing.at("address")
        if address is None or not check_gate(self.desk, path, name, areas, "coils", address):
            return None
        message = "sealed whenever the coil is 0; Modbus can't write that coil (0x02)"
        self.desk.check(sealing.path, message)
        return {"area": "coils", "address": address, "mode": "level"}

    def _policy(self, one: Section) -> list[tuple[tuple[Network, ...], frozenset[int]]] | None:
        policy = one.mapping("policy")
        entries = [] if policy is None else policy.entries("rules") or []
        if policy is not None:
            policy.close()
        if not entries:
            message = "no policy, so all peers are refused; add its unit id to a rule to serve it"
            self.desk.check(one.path, message)
            return None
        found = [section(self.desk, path, value) for path, value in entries]
        return [self._rule(rule) for rule in found if rule is not None]

    def _rule(self, rule: Section) -> tuple[tuple[Network, ...], frozenset[int]]:
        self.rules_have_ids |= rule.get("id") is not None
        networks = tuple(read_networks(rule, "source_ip", required=True))
        if rule.get("source_ip") == []:
            self.desk.left_out(rule.path, "source_ip is empty: the rule matches nobody")
        allowed = functions.allowed_by(rule, self.choices)
        rule.close()
        return networks, allowed

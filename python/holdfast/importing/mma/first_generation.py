"""Imports the first generation: named memories, one map of unit ids, a policy for each port."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from holdfast.config.text.messages import show
from holdfast.config.values.scalars import MAX_CONNECTIONS
from holdfast.importing.key_reader import Section, section
from holdfast.importing.mma import function_rights as functions
from holdfast.importing.mma.address_filters import ALL, read_filter
from holdfast.importing.mma.draft import ADMISSION, Reader
from holdfast.importing.mma.memories import check_gate, read_areas, read_id
from holdfast.importing.names import unique_names
from holdfast.protocol import LAST_ADDRESS, MAX_UNIT, WRITING_CODES
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import listing

if TYPE_CHECKING:
    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.config.values.ip_addresses import Bind

DEFAULT_CONNECTIONS = 32


class FirstGeneration(Reader):
    """Reads `memory`, `routing` and `ports` into a draft."""

    def read(self, root: Section) -> None:
        """Reads all sections."""
        self.names: dict[str, str] = {}
        self.units: dict[int, str] = {}
        self.served: set[int] = set()
        memory = root.mapping("memory", required=True)
        if memory is not None:
            self._memories(memory)
        routing = root.mapping("routing", required=True)
        if routing is not None:
            self._routing(routing)
        ports = root.mapping("ports")
        if ports is not None:
            self._ports(ports)
        if routing is not None:
            for unit in self.units.keys() - self.served:
                self.desk.left_out(routing.at("unit_id_map", unit), "no port serves this unit id")

    def _memories(self, memory: Section) -> None:
        memories = memory.mapping("memories", required=True)
        if memories is None:
            return
        wanted = [(memories.at(key), str(key)) for key in memories.data]
        for index, (path, text) in enumerate(wanted):
            if text in (earlier for _, earlier in wanted[:index]):
                self.desk.problem_of_key(path, f"duplicate name {text}, as text and as a number")
        self.names = {
            text: name
            for (_, text), name in zip(wanted, unique_names(self.desk, wanted), strict=True)
        }
        for_all = self._gate(memory)
        if for_all is not None:
            ran, meant = "it had no effect", "it seals every memory without a seal of its own"
            self.choices.note(self.desk, memory.at("state_sealing"), ran=ran, meant=meant)
            for_all = for_all if self.choices.as_meant else None
        for key in memories.data:
            one = memories.mapping(key)
            if one is None:
                memories.problem(key, "found nothing, allowed: a mapping")
                continue
            self._memory(one, str(key), for_all)
        memory.close()

    def _memory(self, one: Section, text: str, for_all: tuple[KeyPath, int] | None) -> None:
        name = self.names[text]
        areas = {
            area: self._area(one.at(area, "start"), extent)
            for area, extent in read_areas(one, "size").items()
        }
        found: dict[str, Any] = {**read_id(text), **areas}
        gate = self._gate(one) if "state_sealing" in one.data else for_all
        if gate is not None:
            path, address = gate
            if check_gate(self.desk, path, name, areas, "discrete_inputs", address):
                found["seal"] = {"area": "discrete_inputs", "address": address, "mode": "once"}
                self.draft.seals[name] = path
        one.close({"default": "there is no default memory: an unmapped unit id has no memory"})
        self.draft.memories[name] = found

    def _area(self, start: KeyPath, extent: Any) -> Any:
        """An area, from 0 or from its start; `read_areas` returns an integer if both are equal."""
        if isinstance(extent, int):
            return extent
        ran, meant = "addresses start at 0", f"addresses start at {extent['start']}"
        self.choices.note(self.desk, start, ran=ran, meant=meant)
        return extent if self.choices.as_meant else extent["size"]

    def _gate(self, parent: Section) -> tuple[KeyPath, int] | None:
        """The path and address of the gate bit, if `state_sealing` exists and is enabled."""
        sealing = parent.mapping("state_sealing")
        if sealing is None:
            return None
        enabled = sealing.flag("enable")
        gate = sealing.mapping("gate", required=bool(enabled))
        sealing.close()
        if not enabled:
            self.desk.left_out(sealing.path, "not enabled")
        if gate is None:
            return None
        gate.word("area", ["discrete_inputs"], required=bool(enabled))
        address = gate.integer("address", 0, LAST_ADDRESS, required=bool(enabled))
        gate.close()
        return (gate.at("address"), address) if enabled and address is not None else None

    def _routing(self, routing: Section) -> None:
        units = routing.mapping("unit_id_map", required=True)
        routing.close()
        for unit in units.data if units else ():
            path = routing.at("unit_id_map", unit)
            name = self._known(path, units.get(unit)) if units else None
            if type(unit) is not int or not 0 <= unit <= MAX_UNIT:
                message = f"found {show(unit)}, allowed: a unit id from 0 to {MAX_UNIT}"
                self.desk.problem_of_key(path, message)
            elif name is not None:
                self.units[unit] = name

    def _known(self, path: KeyPath, value: object) -> str | None:
        """The new name of a memory of the source."""
        text = str(value) if type(value) is int else value
        if isinstance(text, str) and text in self.names:
            return self.names[text]
        close = suggestion(text, self.names) if isinstance(text, str) else ""
        known = listing(self.names) or "a memory"
        self.desk.problem(path, f"found {show(value)}, allowed: {known}{close}")
        return None

    def _ports(self, ports: Section) -> None:
        if ports.data:
            message = "a function that is not allowed now returns 0x01, an unmapped unit id 0x0B"
            self.desk.check(ports.path, f"{message}; both returned 0x02 before")
        for key in ports.data:
            bind = self.binds.read(ports.at(key), key, of_key=True)
            policy = section(self.desk, ports.at(key), ports.get(key))
            listener = None if policy is None else self._port(policy, str(bind))
            if bind is not None and listener is not None:
                self.draft.listeners[self._free_name(bind)] = listener

    def _free_name(self, bind: Bind) -> str:
        """`port-502`; with the address in the name if two addresses have the same port."""
        name = f"port-{bind.port}"
        if name not in self.draft.listeners:
            return name
        return re.sub("[^A-Za-z0-9.-]", "_", f"{name}-{bind.host}")

    def _port(self, policy: Section, bind: str) -> dict[str, Any] | None:
        sources = self._sources(policy)
        units = self._units(policy)
        rights = self._rights(policy)
        most = self._max_connections(policy)
        policy.close()
        if sources is None or not units or rights is None:
            return None
        rule = {"sources": sources, "units": units, **rights}
        limits = {"max_connections": most, **ADMISSION, "idle_timeout": 0}
        return {"type": "modbus-tcp", "bind": bind, **limits, "rules": [rule]}

    def _sources(self, policy: Section) -> list[str] | None:
        own = read_filter(policy)
        if own is None and self.admitted is None:
            message = "no ip_filter: sources are all addresses; list only networks that need it"
            self.desk.check(policy.path, message)
        peers = (ALL if own is None else own) & (ALL if self.admitted is None else self.admitted)
        if not peers:
            self.desk.left_out(policy.path, "the port is left out: its ip_filter admits nobody")
            return None
        return peers.written()

    def _units(self, policy: Section) -> dict[int, str]:
        allowed = self._unit_ids(policy)
        memories = self._memory_names(policy)
        if allowed is None or memories is None:
            return {}
        units = {
            unit: name for unit, name in self.units.items() if unit in allowed and name in memories
        }
        if not units:
            message = "the port is left out: it allows no unit id with a memory that it allows"
            self.desk.left_out(policy.path, message)
        self.served |= units.keys()
        return units

    def _unit_ids(self, policy: Section) -> set[int] | None:
        if policy.get("unit_ids") == "all":
            return set(self.units)
        entries = _list_or_all(policy, "unit_ids", "unit ids")
        if entries is None:
            return None
        found: set[int] = set()
        for path, unit in entries:
            if type(unit) is not int or not 0 <= unit <= MAX_UNIT:
                message = f"found {show(unit)}, allowed: a unit id from 0 to {MAX_UNIT}"
                self.desk.problem(path, message)
            elif unit not in self.units:
                message = f"unit id {unit} is not in routing.unit_id_map, so it was not served"
                self.desk.left_out(path, message)
            else:
                found.add(unit)
        return found

    def _memory_names(self, policy: Section) -> set[str] | None:
        if policy.get("memories") == "all":
            return set(self.names.values())
        entries = _list_or_all(policy, "memories", "names of memories")
        if entries is None:
            return None
        found = (self._known(path, value) for path, value in entries)
        return {name for name in found if name is not None}

    def _rights(self, policy: Section) -> dict[str, Any] | None:
        access = policy.word("access", ["read-only", "read-write"], required=True)
        codes = policy.mapping("function_codes")
        allow = deny = None
        if codes is not None:
            allow, deny = (
                functions.read_codes(codes, "allow"),
                functions.read_codes(codes, "deny"),
            )
            listed = bool(codes.get("allow"))
            codes.close()
            if listed and allow is not None:
                return self._only(codes, access, allow, deny or [])
        if access is None:
            return None
        return {"access": access, **self._denied(codes, access, deny or [])}

    def _only(
        self, codes: Section, access: str | None, allow: list[int], deny: list[int]
    ) -> dict[str, Any] | None:
        """The rights with a list of allowed functions."""
        path = codes.at("allow")
        if both := [code for code in allow if code in deny]:
            message = f"without {functions.spelled(both)}: also denied, and denied wins"
            self.desk.changed(path, message)
        left = [code for code in allow if code not in deny]
        writing = [code for code in left if code in WRITING_CODES]
        if access == "read-only" and writing:
            message = f"without {functions.spelled(writing)}: it writes, and access is read-only"
            self.desk.changed(path, message)
            left = [code for code in left if code not in writing]
        if not left:
            self.desk.left_out(path, "the port is left out: it allows no function")
            return None
        return None if access is None else {"access": access, "functions": left}

    def _denied(self, codes: Section | None, access: str, deny: list[int]) -> dict[str, Any]:
        """The rights with only a list of denied functions."""
        if codes is None or not deny:
            return {}
        more = functions.with_same_effect(deny) if access == "read-write" else []
        if more:
            message = f"also denies {functions.spelled(more)}, with the same effect as denied ones"
            codes.changed("deny", f"{message}; the source had none of them")
        return {"deny": [*deny, *more]}

    def _max_connections(self, policy: Section) -> int:
        most = policy.integer("max_connections", -(2**31), 2**31 - 1)
        if most is None:
            return DEFAULT_CONNECTIONS
        allowed = DEFAULT_CONNECTIONS if most < 1 else min(most, MAX_CONNECTIONS)
        if allowed != most:
            integer = f"an integer from 1 to {MAX_CONNECTIONS}"
            policy.changed("max_connections", f"set to {allowed}, found {most}, allowed: {integer}")
        return allowed


def _list_or_all(policy: Section, key: str, what: str) -> list[tuple[KeyPath, Any]] | None:
    """The entries of a list that is an alternative to `all`; a problem if it is empty."""
    value = policy.get(key)
    if isinstance(value, list) and value:
        return policy.entries(key)
    found = "missing" if value is None else f"found {show(value)}"
    message = f"{found}, allowed: all or a list of {what}"
    (policy.problem_of_key if value is None else policy.problem)(key, message)
    return None

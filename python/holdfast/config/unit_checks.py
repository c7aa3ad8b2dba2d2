"""Checks units with rights of their own: they can only have fewer than their rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast.config.initial import extent
from holdfast.config.lenient import entries, integer
from holdfast.config.memory_checks import area_of
from holdfast.config.range_checks import check_ranges
from holdfast.config.unique import refuse_repeats
from holdfast.config.words import show
from holdfast.protocol import CODES, MAX_CODE, OTHER_READS, WRITING_CODES
from holdfast.runtime.text import either, listing
from holdfast.types import AREAS, WRITABLE_AREAS

if TYPE_CHECKING:
    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath


@dataclass
class RightsCheck:
    """Checks `access`, `functions` and `deny` at one place: of a rule, or of one of its units."""

    path: KeyPath
    rights: dict[Any, Any]
    access: object
    """The access that applies there."""
    routed: bool
    """Whether requests can go to devices, which have more functions."""
    report: Report

    def check(self) -> None:
        """Reports what is wrong."""
        for key in ("functions", "deny"):
            self._codes((*self.path, key), entries(self.rights.get(key)))
            refuse_repeats((*self.path, key), entries(self.rights.get(key)), self.report)
        if "functions" in self.rights and "deny" in self.rights:
            message = "found together with functions, allowed: only one of them"
            self.report.add((*self.path, "deny"), message, of_key=True)
        if self.access == "read-only":
            self._writes()

    def _codes(self, path: KeyPath, codes: list[Any]) -> None:
        """Reports function codes that nothing there can have."""
        known = range(1, MAX_CODE + 1) if self.routed else CODES
        words = f"a function code from 1 to {MAX_CODE}" if self.routed else either(CODES)
        for index, code in enumerate(codes):
            if type(code) is not int or code not in known:
                self.report.settle((*path, index), f"found {show(code)}, allowed: {words}")

    def _writes(self) -> None:
        for index, code in enumerate(entries(self.rights.get("functions"))):
            if integer(code, 0, 255) in WRITING_CODES:
                message = f"function {code} has no effect: it writes, and access is read-only"
                self.report.doubt((*self.path, "functions", index), message)
            elif integer(code, 1, MAX_CODE) and code not in (*CODES, *OTHER_READS):
                message = f"function {code} has no effect: it may write, and access is read-only"
                self.report.doubt((*self.path, "functions", index), message)


@dataclass
class UnitCheck:
    """Checks a unit with rights of its own."""

    path: KeyPath
    unit: dict[Any, Any]
    rule: dict[Any, Any]
    memories: dict[Any, Any]
    """The memories, as in the file and not validated."""
    report: Report

    def check(self) -> None:
        """Reports what is wrong."""
        access = self.unit.get("access", self.rule.get("access"))
        routed = "memory" not in self.unit
        RightsCheck(self.path, self.unit, access, routed, self.report).check()
        if self.rule.get("access") == "read-only" and self.unit.get("access") == "read-write":
            message = "found read-write, allowed: read-only, the access of the rule"
            self.report.add((*self.path, "access"), message)
        self._functions()
        if not routed:
            self._ranges("read", AREAS)
            self._ranges("write", WRITABLE_AREAS)
        if access == "read-only" and self.unit.get("write"):
            message = "has no effect: access is read-only"
            self.report.doubt((*self.path, "write"), message)

    def _functions(self) -> None:
        """Reports functions that the rule does not allow."""
        allowed, denied = self.rule.get("functions"), entries(self.rule.get("deny"))
        for index, code in enumerate(entries(self.unit.get("functions"))):
            path = (*self.path, "functions", index)
            if self.report.is_settled(path):
                continue
            if code in denied:
                message = f"found {code}, which the rule denies"
                self.report.add(path, f"{message}, allowed: functions that the rule allows")
            elif isinstance(allowed, list) and code not in allowed:
                message = f"found {code}, allowed: {listing(allowed)}, the functions of the rule"
                self.report.add(path, message)
        for index, code in enumerate(entries(self.unit.get("deny"))):
            if code in denied or (isinstance(allowed, list) and code not in allowed):
                message = f"{code} has no effect: the rule does not allow it either"
                self.report.doubt((*self.path, "deny", index), message)

    def _ranges(self, key: str, areas: tuple[str, ...]) -> None:
        memory = self.unit["memory"]
        for path, area, span in check_ranges((*self.path, key), self.unit.get(key), self.report):
            if area not in AREAS:
                continue
            if area not in areas:
                message = f"found {area}, which Modbus clients can't write"
                self.report.add((*path, "area"), f"{message}, allowed: {either(areas)}")
                continue
            there = area_of(self.memories, path, memory, area, self.report)
            if there is not None and (span[0] not in there or span[-1] not in there):
                allowed = f"allowed in {area} of {memory}: {extent(there)}"
                self.report.add((*path, "start"), f"found {extent(span)}, {allowed}")

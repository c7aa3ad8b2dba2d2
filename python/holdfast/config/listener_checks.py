"""What the keys of the listeners must keep together: sockets, limits, rules and memories."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from holdfast.config.addresses import Bind, Network, covers, parse_bind, parse_source
from holdfast.config.model import ModbusTcpListener
from holdfast.config.tolerance import entries, integer, mapping, parsed
from holdfast.config.values import WRITES
from holdfast.config.words import guess, listing, show

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.config.problems import Report
    from holdfast.config.source import KeyPath

_MOST = ModbusTcpListener.model_fields["max_connections"].default


@dataclass
class ListenerChecks:
    """Checks the listeners of one file; `skip` are those that are refused already."""

    report: Report
    skip: Sequence[KeyPath]
    memories: list[str] | None
    """Names of the memories, `None` when they can't be told."""

    def check(self, listeners: object) -> None:
        """Reports what is wrong."""
        binds: list[tuple[KeyPath, Bind]] = []
        for name, listener in mapping(listeners).items():
            path: KeyPath = ("listeners", name)
            if path in self.skip or not isinstance(listener, dict):
                continue
            bind = parsed(parse_bind, listener.get("bind"))
            if bind is not None:
                binds.append(((*path, "bind"), bind))
            self._limits(path, listener)
            self._rules((*path, "rules"), entries(listener.get("rules")))
        self._sockets(binds)

    def _sockets(self, binds: list[tuple[KeyPath, Bind]]) -> None:
        for index, (path, bind) in enumerate(binds):
            for other_path, other in binds[:index]:
                if bind.overlaps(other):
                    line = self.report.line(other_path)
                    of = f"{other} of listeners.{other_path[1]} in line {line}"
                    message = f"found {str(bind)!r}, which overlaps {of}"
                    self.report.add(path, f"{message}, allowed: an address and port of its own")

    def _limits(self, path: KeyPath, listener: dict[Any, Any]) -> None:
        most = integer(listener.get("max_connections", _MOST), 1, 65535)
        of_source = integer(listener.get("max_connections_per_source"), 1, 65535)
        if most is not None and of_source is not None and of_source > most:
            message = f"{of_source} has no effect: max_connections is {most}"
            self.report.doubt((*path, "max_connections_per_source"), message)

    def _rules(self, path: KeyPath, rules: list[Any]) -> None:
        earlier: list[tuple[KeyPath, list[Network]]] = []
        for index, rule in enumerate(rules):
            if not isinstance(rule, dict):
                continue
            here = (*path, index)
            RuleCheck(here, rule, self.report).check(self.memories)
            written = entries(rule.get("sources"))
            sources = [parsed(parse_source, text) for text in written]
            known = [source for source in sources if source is not None]
            if known and len(known) == len(written):
                self._shadow(here, known, earlier)
            earlier.append((here, known))

    def _shadow(
        self, path: KeyPath, sources: list[Network], earlier: list[tuple[KeyPath, list[Network]]]
    ) -> None:
        before = [network for _, networks in earlier for network in networks]
        if not all(covers(before, source) for source in sources):
            return
        taking = [
            f"rules[{rule[-1]}] in line {self.report.line(rule)}"
            for rule, networks in earlier
            if any(covers(networks, s) or any(covers([s], n) for n in networks) for s in sources)
        ]
        message = f"never matches: all its sources belong to {' and '.join(taking)}"
        self.report.doubt(path, message)


@dataclass
class RuleCheck:
    """Checks one rule."""

    path: KeyPath
    rule: dict[Any, Any]
    report: Report
    _lists: tuple[str, str] = field(default=("functions", "deny"), init=False)

    def check(self, memories: list[str] | None) -> None:
        """Reports what is wrong."""
        if memories is not None:
            self._units(memories)
        for key in self._lists:
            self._twice(key)
        if all(key in self.rule for key in self._lists):
            message = "found beside functions, allowed: one of both"
            self.report.add((*self.path, "deny"), message, of_key=True)
        if self.rule.get("access") == "read-only":
            self._writes()

    def _units(self, memories: list[str]) -> None:
        for unit, name in mapping(self.rule.get("units")).items():
            if isinstance(name, str) and name not in memories:
                close = guess(name, memories)
                message = f"found {show(name)}, allowed: {listing(memories)}{close}"
                self.report.add((*self.path, "units", unit), message)

    def _twice(self, key: str) -> None:
        codes = [integer(code, 0, 255) for code in entries(self.rule.get(key))]
        for index, code in enumerate(codes):
            if code is not None and code in codes[:index]:
                self.report.add((*self.path, key, index), f"found {code} again, allowed: once")

    def _writes(self) -> None:
        for index, code in enumerate(entries(self.rule.get("functions"))):
            if integer(code, 0, 255) in WRITES:
                message = f"{code} has no effect: it writes, and access is read-only"
                self.report.doubt((*self.path, "functions", index), message)

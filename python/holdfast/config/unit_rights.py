"""The rights that rules give, unit by unit.

For each unit id, the first rule that names the peer and the unit decides. The configuration is
valid here: a unit never has more rights than its rule.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.config.models.listeners import RouteConfig, UnitMemoryConfig
from holdfast.config.values.unit_keys import unit_ids
from holdfast.net.addresses import holds
from holdfast.protocol import (
    CODES,
    GET_COMM_EVENT_LOG,
    OPTIONAL_CODES,
    READ_EXCEPTION_STATUS,
    WRITING_CODES,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from holdfast.config.models.devices import RangeConfig
    from holdfast.config.models.listeners import (
        ExceptionStatusConfig,
        RuleConfig,
        SerialRuleConfig,
    )
    from holdfast.config.models.memories import MemoryConfig
    from holdfast.net.addresses import Address
    from holdfast.types import Access, Area

    AnyRule: TypeAlias = RuleConfig | SerialRuleConfig

Codes: TypeAlias = tuple[int, ...]


@dataclass(frozen=True)
class UnitRights:
    """What a rule allows for one unit id."""

    memory: str | None
    """The memory, `None` for a route."""
    route: str | None
    """The device or link that requests are passed on to, `None` for a memory."""
    access: Access
    functions: Codes | None
    """The allowed function codes, `None` for all that `deny` does not exclude."""
    deny: Codes | None
    read: tuple[RangeConfig, ...] | None = None
    """The ranges that may be read, `None` for everything."""
    write: tuple[RangeConfig, ...] | None = None
    """The ranges that may be written, `None` for everything."""
    exception_status: ExceptionStatusConfig | None = None
    """The bits that function 7 reads."""

    @property
    def has_ranges(self) -> bool:
        """Whether some addresses may not be read or written."""
        return self.read is not None or self.write is not None

    def codes(self, memories: Mapping[str, MemoryConfig], *, event_log: bool) -> list[int]:
        """All function codes that are allowed, on a listener with or without an event log."""
        if self.memory is None:
            known = {*CODES, *(self.functions or ())}
        else:
            known = set(CODES) - OPTIONAL_CODES | memories[self.memory].functions
            known |= {READ_EXCEPTION_STATUS} if self.exception_status else set()
            known |= {GET_COMM_EVENT_LOG} if event_log else set()
        return [code for code in sorted(known) if self.allows(code)]

    def allows(self, code: int) -> bool:
        """Whether a function code that the unit knows is allowed."""
        named = self.functions is None or code in self.functions
        if not named or code in (self.deny or ()):
            return False
        return self.access == "read-write" or code in _READING


_READING = frozenset(CODES).difference(WRITING_CODES)


def unit_rights(rule: AnyRule) -> Iterator[tuple[int, UnitRights]]:
    """The rights for each unit id of a rule; ranges of unit ids are taken apart."""
    for key, target in rule.units.items():
        rights = _rights(rule, target)
        for unit in unit_ids(key):
            yield unit, rights


def together(rules: Iterable[AnyRule]) -> dict[int, UnitRights]:
    """The rights by several rules: for each unit id, by the first one that names it."""
    found: dict[int, UnitRights] = {}
    for rule in rules:
        for unit, rights in unit_rights(rule):
            found.setdefault(unit, rights)
    return found


def matching(rules: Iterable[Any], address: Address, role: str | None = None) -> list[Any]:
    """The rules that match a peer, in order; `role` is `None` without TLS."""
    return [
        rule
        for rule in rules
        if holds(rule.sources, address)
        and (role is None or rule.roles is None or role in rule.roles)
    ]


def items(ranges: tuple[RangeConfig, ...]) -> list[tuple[Area, int, int]]:
    """Ranges as areas, first addresses and counts."""
    return [(each.area, each.addresses.start, len(each.addresses)) for each in ranges]


def _rights(rule: AnyRule, target: str | UnitMemoryConfig | RouteConfig) -> UnitRights:
    if isinstance(target, str):
        return UnitRights(target, None, rule.access, rule.functions, rule.deny)
    functions, deny = narrowed(rule.functions, rule.deny, target.functions, target.deny)
    access = target.access or rule.access
    if isinstance(target, RouteConfig):
        return UnitRights(None, target.route, access, functions, deny)
    own = target.read, target.write, target.exception_status
    return UnitRights(target.memory, None, access, functions, deny, *own)


def narrowed(
    functions: Codes | None, deny: Codes | None, own: Codes | None, own_deny: Codes | None
) -> tuple[Codes | None, Codes | None]:
    """The allowed and the denied functions of a unit, with those of its rule.

    At least one of the two is `None`. `own` replaces `functions`, of which a valid configuration
    has a subset there.
    """
    denied = tuple(dict.fromkeys((*(deny or ()), *(own_deny or ()))))
    allowed = functions if own is None else own
    if allowed is None:
        return None, denied or None
    return tuple(code for code in allowed if code not in denied), None

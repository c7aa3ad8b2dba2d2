"""What a peer may do, listener by listener and unit by unit: for `holdfast check --as`."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

from holdfast.cli.showing import ranges_shown, styled, table, words
from holdfast.config import (
    ModbusAsciiListener,
    ModbusRtuListener,
    ModbusTcpListener,
    RawIngestListener,
)
from holdfast.config.listeners import DATAGRAM_TYPES, RawIngestConfig, tls_of
from holdfast.config.rights import matching, together

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from holdfast.config import Config, Listener, RangeConfig, RawRuleConfig
    from holdfast.config.rights import UnitRights
    from holdfast.net.addresses import Address

HEAD = ("unit", "to", "access", "functions", "reads", "writes")
EVERYTHING = "everything"
NOTHING = "nothing"


@dataclass(frozen=True)
class Peer:
    """A peer: its address, and the role in its certificate, for TLS."""

    address: Address
    role: str


def as_text(config: Config, peer: Peer) -> str:
    """What the peer may do, for people."""
    lines: list[str] = []
    for name, listener in config.listeners.items():
        place = f"{listener.type}  {_place(listener)}"
        lines += [*([""] if lines else []), f"{styled(name, bold=True)}  {place}"]
        lines += [f"  {line}" for line in _told(listener, peer)]
    return "\n".join(lines or ["no listeners"])


def as_data(config: Config, peer: Peer) -> dict[str, Any]:
    """What the peer may do, for programs."""
    listeners = {name: _data(listener, peer) for name, listener in config.listeners.items()}
    return {"address": str(peer.address), "role": peer.role, "listeners": listeners}


def _place(listener: Listener) -> str:
    """Where the listener listens."""
    if isinstance(listener, ModbusRtuListener | ModbusAsciiListener):
        return str(listener.serial.device)
    return str(listener.bind)


def _rights(listener: Listener, peer: Peer) -> tuple[str, dict[int, UnitRights]]:
    """What a Modbus listener does with the peer, and the rights of the peer by unit id."""
    assert not isinstance(listener, RawIngestListener), "its rules have no rights of units"
    if isinstance(listener, ModbusRtuListener | ModbusAsciiListener):
        return "no_addresses", {}
    if not matching(listener.rules, peer.address):
        if _packet_rule(listener, peer) is not None:
            return "only_packets", {}
        return "unanswered" if listener.type in DATAGRAM_TYPES else "disconnected", {}
    role = peer.role if listener.type == "modbus-tls" else None
    rules = matching(listener.rules, peer.address, role)
    return ("served", together(rules)) if rules else ("no_rights", {})


def _packet_rule(listener: Listener, peer: Peer) -> RawRuleConfig | None:
    """The rule for Raw Ingest packets of the peer."""
    taker = listener.raw_ingest if isinstance(listener, ModbusTcpListener) else listener
    if not isinstance(taker, RawIngestListener | RawIngestConfig):
        return None
    role = None if tls_of(listener) is None else peer.role
    return next(iter(matching(taker.rules, peer.address, role)), None)


def _without_packets(listener: RawIngestListener, peer: Peer) -> str:
    """What a Raw Ingest listener does with a sender without a rule."""
    return "no_packets" if matching(listener.rules, peer.address) else "disconnected"


def _told(listener: Listener, peer: Peer) -> list[str]:
    packets = _packet_rule(listener, peer)
    if isinstance(listener, RawIngestListener):
        if packets is None:
            return [_outcomes(peer)[_without_packets(listener, peer)]]
        return _raw_told(packets)
    outcome, rights = _rights(listener, peer)
    told = [_outcomes(peer)[outcome]] if outcome != "served" else []
    told += table(HEAD, [_row(units, each) for units, each in _joined(rights)]) if rights else []
    return told if packets is None else [*told, "Raw Ingest packets:", *_raw_told(packets)]


def _outcomes(peer: Peer) -> dict[str, str]:
    role = f"the role {peer.role!r}" if peer.role else "a certificate without a role"
    return {
        "no_addresses": "a serial line has no addresses",
        "disconnected": f"no rule names {peer.address}: it is disconnected at once",
        "unanswered": f"no rule names {peer.address}: it gets no reply",
        "only_packets": f"no rule names {peer.address}: every request gets exception 01",
        "no_rights": f"no rule names {peer.address} with {role}: every request gets exception 01",
        "no_packets": f"no rule names {peer.address} with {role}: every packet is refused",
    }


def _joined(rights: dict[int, UnitRights]) -> Iterator[tuple[str, UnitRights]]:
    """The rights of adjacent units with the same rights, together."""
    numbered = enumerate(sorted(rights.items()))
    for (_, each), run in groupby(numbered, key=lambda one: (one[1][0] - one[0], one[1][1])):
        units = [unit for _, (unit, _) in run]
        yield runs(units), each


def _row(units: str, rights: UnitRights) -> tuple[str, ...]:
    to = f"memory {rights.memory}" if rights.route is None else f"route {rights.route}"
    writes = NOTHING if rights.access == "read-only" else _limits(rights.write)
    codes = runs(rights.codes()) or "none"
    return units, to, rights.access, codes, _limits(rights.read), writes


def _limits(ranges: Sequence[RangeConfig] | None) -> str:
    return EVERYTHING if ranges is None else ranges_shown(ranges)


def _raw_told(rule: RawRuleConfig) -> list[str]:
    areas = ", ".join(map(words, rule.areas))
    rows = [(str(unit), f"memory {name}", areas) for unit, name in rule.units.items()]
    rows += [("", f"memory {name}", areas) for name in rule.memories]
    return table(("unit", "to", "writes"), rows)


def runs(numbers: Iterable[int]) -> str:
    """Sorted numbers as text: `1-6, 8, 11`."""
    found: list[list[int]] = []
    for number in numbers:
        if found and number == found[-1][-1] + 1:
            found[-1][1:] = [number]
        else:
            found.append([number])
    return ", ".join("-".join(map(str, run)) for run in found)


def _data(listener: Listener, peer: Peer) -> dict[str, Any]:
    where = {"type": listener.type, "at": _place(listener)}
    rule = _packet_rule(listener, peer)
    packets = [] if rule is None else _packets_data(rule)
    if isinstance(listener, RawIngestListener):
        outcome = _without_packets(listener, peer) if rule is None else "served"
        return {**where, "outcome": outcome, "units": packets}
    outcome, rights = _rights(listener, peer)
    units = [_unit_data(unit, each) for unit, each in sorted(rights.items())]
    found = {**where, "outcome": outcome, "units": units}
    return {**found, "packets": packets} if packets else found


def _packets_data(rule: RawRuleConfig) -> list[dict[str, Any]]:
    areas = list(rule.areas)
    units = [{"unit": unit, "memory": name, "areas": areas} for unit, name in rule.units.items()]
    return [*units, *({"memory": name, "areas": areas} for name in rule.memories)]


def _unit_data(unit: int, rights: UnitRights) -> dict[str, Any]:
    to = {"memory": rights.memory} if rights.route is None else {"route": rights.route}
    return {
        "unit": unit,
        **to,
        "access": rights.access,
        "functions": rights.codes(),
        "read": _ranges_data(rights.read),
        "write": _ranges_data(rights.write),
    }


def _ranges_data(ranges: Sequence[RangeConfig] | None) -> list[dict[str, Any]] | None:
    if ranges is None:
        return None
    return [
        {"area": each.area, "start": each.addresses[0], "end": each.addresses[-1]}
        for each in ranges
    ]

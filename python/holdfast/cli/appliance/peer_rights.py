"""The rights of a peer by listener and unit, for `holdfast check --as`."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

from holdfast.cli.terminal_text import number_ranges, ranges_shown, styled, table, words
from holdfast.config.models.listeners import (
    ModbusTcpListener,
    RawIngestConfig,
    RawIngestListener,
    SerialListener,
    UdpListener,
    tls_of,
)
from holdfast.config.unit_rights import matching, together

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from holdfast.config import Config
    from holdfast.config.models.devices import RangeConfig
    from holdfast.config.models.listeners import Listener, RawRuleConfig
    from holdfast.config.unit_rights import UnitRights
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
    """The rights of the peer as text."""
    lines: list[str] = []
    for name, listener in config.listeners.items():
        place = f"{listener.type}  {_place(listener)}"
        lines += [*([""] if lines else []), f"{styled(name, bold=True)}  {place}"]
        lines += [f"  {line}" for line in _rights_lines(config, listener, peer)]
    return "\n".join(lines or ["no listeners"])


def as_data(config: Config, peer: Peer) -> dict[str, Any]:
    """The rights of the peer for JSON."""
    listeners = {name: _data(config, listener, peer) for name, listener in config.listeners.items()}
    return {"address": str(peer.address), "role": peer.role, "listeners": listeners}


def _place(listener: Listener) -> str:
    """The address or serial line of the listener."""
    if isinstance(listener, SerialListener):
        return str(listener.serial.device)
    return str(listener.bind)


def _rights(listener: Listener, peer: Peer) -> tuple[str, dict[int, UnitRights]]:
    """What a Modbus listener does with the peer, and the rights of the peer by unit id."""
    assert not isinstance(listener, RawIngestListener), "its rules have no rights of units"
    if isinstance(listener, SerialListener):
        return "no_addresses", {}
    if not matching(listener.rules, peer.address):
        if _packet_rule(listener, peer) is not None:
            return "only_packets", {}
        return "unanswered" if isinstance(listener, UdpListener) else "disconnected", {}
    role = peer.role if listener.type == "modbus-tls" else None
    rules = matching(listener.rules, peer.address, role)
    return ("served", together(rules)) if rules else ("no_rights", {})


def _packet_rule(listener: Listener, peer: Peer) -> RawRuleConfig | None:
    """The rule for Raw Ingest packets of the peer."""
    receiver = listener.raw_ingest if isinstance(listener, ModbusTcpListener) else listener
    if not isinstance(receiver, RawIngestListener | RawIngestConfig):
        return None
    role = None if tls_of(listener) is None else peer.role
    return next(iter(matching(receiver.rules, peer.address, role)), None)


def _without_packets(listener: RawIngestListener, peer: Peer) -> str:
    """What a Raw Ingest listener does with a sender without a rule."""
    return "no_packets" if matching(listener.rules, peer.address) else "disconnected"


def _rights_lines(config: Config, listener: Listener, peer: Peer) -> list[str]:
    packets = _packet_rule(listener, peer)
    if isinstance(listener, RawIngestListener):
        if packets is None:
            return [_outcomes(peer)[_without_packets(listener, peer)]]
        return _packet_lines(packets)
    outcome, rights = _rights(listener, peer)
    lines = [_outcomes(peer)[outcome]] if outcome != "served" else []
    rows = [_row(config, units, each, listener.event_log) for units, each in _joined(rights)]
    lines += table(HEAD, rows) if rows else []
    return lines if packets is None else [*lines, "Raw Ingest packets:", *_packet_lines(packets)]


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
        yield number_ranges(units), each


def _row(config: Config, units: str, rights: UnitRights, event_log: bool) -> tuple[str, ...]:
    to = f"memory {rights.memory}" if rights.route is None else f"route {rights.route}"
    writes = NOTHING if rights.access == "read-only" else _limits(rights.write)
    codes = number_ranges(rights.codes(config.memories, event_log=event_log))
    return units, to, rights.access, codes, _limits(rights.read), writes


def _limits(ranges: Sequence[RangeConfig] | None) -> str:
    return EVERYTHING if ranges is None else ranges_shown(ranges)


def _packet_lines(rule: RawRuleConfig) -> list[str]:
    areas = ", ".join(map(words, rule.areas))
    rows = [(str(unit), f"memory {name}", areas) for unit, name in rule.units.items()]
    rows += [("", f"memory {name}", areas) for name in rule.memories]
    return table(("unit", "to", "writes"), rows)


def _data(config: Config, listener: Listener, peer: Peer) -> dict[str, Any]:
    where = {"type": listener.type, "at": _place(listener)}
    rule = _packet_rule(listener, peer)
    packets = [] if rule is None else _packets_data(rule)
    if isinstance(listener, RawIngestListener):
        outcome = _without_packets(listener, peer) if rule is None else "served"
        return {**where, "outcome": outcome, "units": packets}
    outcome, rights = _rights(listener, peer)
    units = [
        _unit_data(config, unit, each, listener.event_log) for unit, each in sorted(rights.items())
    ]
    found = {**where, "outcome": outcome, "units": units}
    return {**found, "packets": packets} if packets else found


def _packets_data(rule: RawRuleConfig) -> list[dict[str, Any]]:
    areas = list(rule.areas)
    units = [{"unit": unit, "memory": name, "areas": areas} for unit, name in rule.units.items()]
    return [*units, *({"memory": name, "areas": areas} for name in rule.memories)]


def _unit_data(config: Config, unit: int, rights: UnitRights, event_log: bool) -> dict[str, Any]:
    to = {"memory": rights.memory} if rights.route is None else {"route": rights.route}
    return {
        "unit": unit,
        **to,
        "access": rights.access,
        "functions": rights.codes(config.memories, event_log=event_log),
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

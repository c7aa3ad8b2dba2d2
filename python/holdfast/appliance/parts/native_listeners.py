"""Creates the native listeners and the identity of a configuration. Nothing is started here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, assert_never, cast

from holdfast import _core
from holdfast.config.models.listeners import (
    ModbusAsciiListener,
    ModbusAsciiOverTcpListener,
    ModbusRtuListener,
    ModbusRtuOverTcpListener,
    ModbusRtuOverUdpListener,
    ModbusTcpListener,
    ModbusTlsListener,
    ModbusUdpListener,
    RawIngestListener,
    SecureRawRuleConfig,
)
from holdfast.config.unit_rights import items, together, unit_rights
from holdfast.server import Identity
from holdfast.server.options import RAW_INGEST_DEFAULTS, STREAM_DEFAULTS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from holdfast._core import Memory
    from holdfast.appliance.parts.native_links import Links
    from holdfast.config import Config
    from holdfast.config.models.listeners import (
        Listener,
        RawCompatConfig,
        RawRuleConfig,
        RuleConfig,
        SerialRuleConfig,
    )
    from holdfast.config.models.root import IdentityConfig
    from holdfast.config.models.server_tls import ServerTlsConfig
    from holdfast.config.unit_rights import UnitRights
    from holdfast.server.options import (
        DatagramOptions,
        RawIngestOptions,
        SerialOptions,
        StreamOptions,
    )
    from holdfast.types import BitArea, Framing, NarrowedRights

_FRAMINGS: dict[str, Framing] = {
    "modbus-tcp": "mbap",
    "modbus-tls": "mbap",
    "modbus-rtu-over-tcp": "rtu",
    "modbus-ascii-over-tcp": "ascii",
}
"""The framings of listeners for connections."""


def identity(settings: IdentityConfig) -> Identity:
    """Returns the device identification that Modbus clients read."""
    given = {key: value for key, value in settings if value is not None}
    return Identity(private_objects=given.pop("objects"), **given)


def listener(
    name: str,
    config: Config,
    memories: Mapping[str, Memory],
    links: Links,
) -> _core.Listener:
    """Creates the native listener of that name."""
    settings: Listener = config.listeners[name]
    match settings:
        case (
            ModbusTcpListener()
            | ModbusTlsListener()
            | ModbusRtuOverTcpListener()
            | ModbusAsciiOverTcpListener()
        ):
            secure = settings if isinstance(settings, ModbusTlsListener) else None
            stream = (
                STREAM_DEFAULTS
                | dict(settings)
                | {
                    "framing": _FRAMINGS[settings.type],
                    "tls": None if secure is None else server_tls(secure.tls),
                    "raw_ingest": _shared_port(name, settings, config, memories),
                }
            )
            if secure is not None:
                stream["max_handshakes"] = secure.max_handshakes
            rules = [_rule(rule, config, memories, links) for rule in settings.rules]
            return _core.Listener(name, str(settings.bind), rules, cast("StreamOptions", stream))
        case ModbusUdpListener() | ModbusRtuOverUdpListener():
            framing = "mbap" if isinstance(settings, ModbusUdpListener) else "rtu"
            datagrams = dict(settings) | {"framing": framing}
            rules = [_rule(rule, config, memories, links) for rule in settings.rules]
            return _core.Listener.udp(
                name, str(settings.bind), rules, cast("DatagramOptions", datagrams)
            )
        case ModbusRtuListener() | ModbusAsciiListener():
            # Defaults for what a mode lacks: ASCII has no silence, RTU always has 8 data bits.
            mode = "rtu" if isinstance(settings, ModbusRtuListener) else "ascii"
            line = {"silence": None, "data_bits": 8} | dict(settings) | dict(settings.serial)
            line |= {"mode": mode}
            rule = _serial_rule(settings.rules, config, memories, links)
            return _core.Listener.serial(
                name, settings.serial.device, rule, cast("SerialOptions", line)
            )
        case RawIngestListener():
            tls = None if settings.tls is None else server_tls(settings.tls)
            packets = dict(settings) | _compat(settings.compat)
            packets |= {"tls": tls, "max_handshakes": settings.max_handshakes}
            return _raw_ingest(name, settings, settings.rules, packets, config, memories)
        case _:
            assert_never(settings)


def _shared_port(
    name: str, settings: Listener, config: Config, memories: Mapping[str, Memory]
) -> _core.Listener | None:
    """Raw ingest packets on the port of a Modbus listener."""
    if not isinstance(settings, ModbusTcpListener) or settings.raw_ingest is None:
        return None
    shared = settings.raw_ingest
    packets = {
        "format": shared.format,
        "request_timeout": settings.request_timeout,
        "idle_timeout": settings.idle_timeout,
    } | _compat(shared.compat)
    return _raw_ingest(name, settings, shared.rules, packets, config, memories)


def _raw_ingest(
    name: str,
    settings: ModbusTcpListener | RawIngestListener,
    rules: Iterable[RawRuleConfig],
    packets: dict[str, Any],
    config: Config,
    memories: Mapping[str, Memory],
) -> _core.Listener:
    return _core.Listener.raw_ingest(
        name,
        str(settings.bind),
        [_raw_rule(rule, config, memories) for rule in rules],
        cast("RawIngestOptions", RAW_INGEST_DEFAULTS | packets),
    )


def _compat(settings: RawCompatConfig | None) -> dict[str, Any]:
    """The keys that are set: all others have the defaults of the protocol."""
    return {key: value for key, value in settings or () if value is not None}


def server_tls(settings: ServerTlsConfig) -> _core.ServerTls:
    """Loads the certificates of a listener. Raises `ValueError` for an unusable file."""
    from holdfast.net.certificates.own import key_for_core

    others = (settings.cert_file, settings.ca_file, settings.crl_file)
    return _core.ServerTls(
        cert_file=settings.cert_file,
        key_file=settings.key_file,
        ca_file=settings.ca_file,
        crl_file=settings.crl_file,
        decrypted_key=key_for_core(settings.key_file, settings.key_passphrase_file, *others),
    )


def _rule(
    rule: RuleConfig, config: Config, memories: Mapping[str, Memory], links: Links
) -> _core.Rule:
    units = dict(unit_rights(rule))
    own = {
        unit: rights
        for unit, rights in units.items()
        if (rights.access, rights.functions, rights.deny)
        != (rule.access, rule.functions, rule.deny)
        or rights.has_ranges
    }
    return _core.Rule(
        _targets(units, memories, links),
        sources=[str(source) for source in rule.sources],
        access=rule.access,
        functions=rule.functions,
        deny=rule.deny,
        roles=getattr(rule, "roles", None),
        narrowed={unit: _narrowed(rights) for unit, rights in own.items()},
        exception_status=_exception_status(units),
        fifo=_fifo(config, units),
    )


def _serial_rule(
    rules: Sequence[SerialRuleConfig],
    config: Config,
    memories: Mapping[str, Memory],
    links: Links,
) -> _core.Rule:
    """The rule of a serial line, which is that of all rules together."""
    units = together(rules)
    return _core.Rule(
        _targets(units, memories, links),
        access=rules[0].access,  # Not used: `narrowed` has all units.
        narrowed={unit: _narrowed(rights) for unit, rights in units.items()},
        exception_status=_exception_status(units),
        fifo=_fifo(config, units),
    )


def _targets(
    units: Mapping[int, UnitRights], memories: Mapping[str, Memory], links: Links
) -> dict[int, Memory | _core.Route | _core.Passage]:
    found: dict[int, Memory | _core.Route | _core.Passage] = {}
    for unit, rights in units.items():
        if rights.memory is None:
            assert rights.route is not None, "a unit has a memory or a route"
            found[unit] = links.routes[rights.route]
        else:
            found[unit] = links.passages.get(rights.memory, memories[rights.memory])
    return found


def _narrowed(rights: UnitRights) -> NarrowedRights:
    read = None if rights.read is None else items(rights.read)
    write = None if rights.write is None else items(rights.write)
    functions = None if rights.functions is None else list(rights.functions)
    deny = None if rights.deny is None else list(rights.deny)
    return rights.access, functions, deny, (read, write)


def _exception_status(units: Mapping[int, UnitRights]) -> dict[int, tuple[BitArea, int]]:
    given = {unit: rights.exception_status for unit, rights in units.items()}
    return {unit: (bits.area, bits.address) for unit, bits in given.items() if bits is not None}


def _fifo(config: Config, units: Mapping[int, UnitRights]) -> dict[int, tuple[int, ...]]:
    of = {unit: config.memories[each.memory].fifo for unit, each in units.items() if each.memory}
    return {unit: addresses for unit, addresses in of.items() if addresses}


def _raw_rule(rule: RawRuleConfig, config: Config, memories: Mapping[str, Memory]) -> _core.RawRule:
    ids = ((config.memories[name].id, name) for name in rule.memories)
    named = {memory_id: memories[name] for memory_id, name in ids if memory_id is not None}
    units = {unit: memories[name] for unit, name in rule.units.items()}
    roles = rule.roles if isinstance(rule, SecureRawRuleConfig) else None
    return _core.RawRule(
        units or named,
        sources=[str(source) for source in rule.sources],
        areas=list(rule.areas),
        roles=None if roles is None else list(roles),
    )

"""From a configuration to the native parts: memories, rules, listeners, identity.

It converts, and starts nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, assert_never

from holdfast import _core
from holdfast.config import (
    ModbusAsciiListener,
    ModbusRtuListener,
    ModbusRtuOverTcpListener,
    ModbusTcpListener,
    ModbusUdpListener,
    RawIngestListener,
)
from holdfast.identity import Identity

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast._core import Memory
    from holdfast.config import (
        Config,
        IdentityConfig,
        Listener,
        MemoryConfig,
        RawRuleConfig,
        RuleConfig,
        SerialRuleConfig,
    )


def memory(settings: MemoryConfig) -> Memory:
    """The memory that a configuration describes, with its initial values."""
    seal = settings.seal
    made = _core.Memory(
        **{area: (span.start, span.size) for area, span in settings.areas().items()},
        seal=None if seal is None else (seal.area, seal.address, seal.mode),
    )
    writes = [(run.area, run.address, run.values) for run in settings.initial_values]
    if writes:
        made.write_many(writes)
    return made


def identity(settings: IdentityConfig) -> Identity:
    """What the appliance says of itself."""
    return Identity(
        vendor_name=settings.vendor_name,
        product_code=settings.product_code,
        revision=settings.revision,
        vendor_url=settings.vendor_url or "",
        product_name=settings.product_name or "",
        model_name=settings.model_name or "",
        user_application_name=settings.user_application_name or "",
        unit_names=settings.unit_names,
        private_objects=settings.objects,
    )


def listener(name: str, config: Config, memories: Mapping[str, Memory]) -> _core.Listener:
    """The native listener of that name."""
    settings: Listener = config.listeners[name]
    match settings:
        case ModbusTcpListener() | ModbusRtuOverTcpListener():
            return _core.Listener(
                name,
                str(settings.bind),
                [_rule(rule, memories) for rule in settings.rules],
                framing="mbap" if settings.type == "modbus-tcp" else "rtu",
                max_connections=settings.max_connections,
                max_connections_per_source=settings.max_connections_per_source,
                when_full=settings.when_full,
                idle_timeout=settings.idle_timeout,
                request_timeout=settings.request_timeout,
            )
        case ModbusUdpListener():
            rules = [_rule(rule, memories) for rule in settings.rules]
            return _core.Listener.udp(name, str(settings.bind), rules)
        case ModbusRtuListener() | ModbusAsciiListener():
            line = settings.serial
            return _core.Listener.serial(
                name,
                line.device,
                _rule(settings.rules[0], memories),
                mode="rtu" if settings.type == "modbus-rtu" else "ascii",
                baud=line.baud,
                parity=line.parity,
                stop_bits=line.stop_bits,
                data_bits=line.data_bits,
                silence=settings.serial.silence if settings.type == "modbus-rtu" else None,
            )
        case RawIngestListener():
            return _core.Listener.raw_ingest(
                name,
                str(settings.bind),
                [_raw_rule(rule, config, memories) for rule in settings.rules],
                format=settings.format,
                crc=settings.crc or "required",
                max_connections=settings.max_connections,
                max_connections_per_source=settings.max_connections_per_source,
                request_timeout=settings.request_timeout,
            )
        case _:
            assert_never(settings)


def _rule(rule: RuleConfig | SerialRuleConfig, memories: Mapping[str, Memory]) -> _core.Rule:
    return _core.Rule(
        {unit: memories[name] for unit, name in rule.units.items()},
        sources=[str(source) for source in getattr(rule, "sources", ())],
        access=rule.access,
        functions=rule.functions,
        deny=rule.deny,
    )


def _raw_rule(rule: RawRuleConfig, config: Config, memories: Mapping[str, Memory]) -> _core.RawRule:
    ids = ((config.memories[name].id, name) for name in rule.memories)
    named = {memory_id: memories[name] for memory_id, name in ids if memory_id is not None}
    units = {unit: memories[name] for unit, name in rule.units.items()}
    return _core.RawRule(
        units or named, sources=[str(source) for source in rule.sources], areas=list(rule.areas)
    )

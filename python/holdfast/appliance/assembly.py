"""Converts a configuration to native objects and to the settings of gateway and scanner.

The native objects are memories, rules, listeners, devices and the identity. Nothing is started
here. Gateway and scanner are imported only if they are configured.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, assert_never

from holdfast import _core
from holdfast.client.endpoint import endpoint, receiver_endpoint
from holdfast.config import (
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
from holdfast.config.listeners import STRICT
from holdfast.config.rights import items, together, unit_rights
from holdfast.config.route_checks import routed
from holdfast.config.scalars import MAX_TIME
from holdfast.net.tls import NO_FILES
from holdfast.polling.reader import Reader
from holdfast.server import Identity
from holdfast.tags import TagList
from holdfast.tools import planning
from holdfast.types import AREAS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from holdfast._core import Memory
    from holdfast.client.url import Target
    from holdfast.config import (
        Config,
        DestinationConfig,
        GatewayConfig,
        HttpsConfig,
        IdentityConfig,
        Listener,
        MemoryConfig,
        NatsConfig,
        RawRuleConfig,
        RuleConfig,
        SerialRuleConfig,
        ServerTlsConfig,
    )
    from holdfast.config.devices import BlockConfig, ForwardConfig, StatusConfig
    from holdfast.config.rights import UnitRights
    from holdfast.config.services import NatsServersConfig
    from holdfast.config.tags import ProfileConfig
    from holdfast.gateway import Settings as GatewaySettings
    from holdfast.net.tls import Tls
    from holdfast.scanner import Servers
    from holdfast.scanner import Settings as ScannerSettings
    from holdfast.types import Area, Forward, NarrowedRights, StatusBlock
    from holdfast.web.https import Https

_HANDSHAKES = 256
"""The limit on handshakes of listeners without TLS, which have none."""

_FRAMINGS: dict[str, Literal["mbap", "rtu", "ascii"]] = {
    "modbus-tcp": "mbap",
    "modbus-tls": "mbap",
    "modbus-rtu-over-tcp": "rtu",
    "modbus-ascii-over-tcp": "ascii",
}
"""The framings of listeners for connections."""

SPREAD = 10.0
"""Seconds over which the first polls of devices are spread; at most the polling interval."""


def memory(settings: MemoryConfig) -> Memory:
    """Creates the memory that the settings describe, with all values 0."""
    seal = settings.seal
    return _core.Memory(
        **{area: (span.start, span.size) for area, span in settings.areas().items()},
        seal=None if seal is None else (seal.area, seal.address, seal.mode),
    )


def fill(made: Memory, settings: MemoryConfig) -> None:
    """Writes the initial values."""
    writes = [(run.area, run.address, run.values) for run in settings.initial_values]
    if writes:
        made.write_many(writes)


def identity(settings: IdentityConfig) -> Identity:
    """Returns the device identification that Modbus clients read."""
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


@dataclass(frozen=True)
class Links:
    """What listeners pass requests on to."""

    links: dict[str, _core.Link] = field(default_factory=dict)
    """By name; a link without a name of its own has that of the first device behind it."""
    routes: dict[str, _core.Route] = field(default_factory=dict)
    """By the name of the link or device."""
    passages: dict[str, _core.Passage] = field(default_factory=dict)
    """By the name of the memory."""


def links(config: Config, memories: Mapping[str, Memory], poller: _core.Poller) -> Links:
    """Creates all links, routes and passages. Raises `OSError` for unusable files.

    The first use of an address decides the settings of its connection, so links come first, and
    polled devices later.
    """
    made = Links()
    for name, settings in config.links.items():
        link = poller.link(
            name,
            _endpoint(f"links.{name}.url", settings.target),
            in_flight=None if settings.in_flight == "auto" else settings.in_flight,
            queue=settings.queue,
            coalesce=settings.coalesce,
            cache=settings.cache,
            preferred=list(settings.priority),
            retry=settings.retry.pauses,
        )
        made.links[name] = link
        made.routes[name] = link.route(name, timeout=settings.timeout)
    for name in routed(config):
        if name not in config.devices:
            continue
        device = config.devices[name]
        link = poller.link(
            name,
            _endpoint(f"devices.{name}.url", device.target),
            in_flight=None if device.in_flight == "auto" else device.in_flight,
            retry=device.retry.pauses,
        )
        made.links.setdefault(link.name, link)
        made.routes[name] = link.route(name, unit=device.unit, timeout=device.timeout)
    passed: dict[str, list[tuple[Area, int, int, str, int, bool]]] = {}
    for name, device in config.devices.items():
        for read, into in device.passed:
            ranges = passed.setdefault(into.memory, [])
            ranges.append((into.area, into.address, read.count, name, read.address, device.emulate))
    for name, ranges in passed.items():
        made.passages[name] = poller.passage(memories[name], ranges)
    return made


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
            rtu = settings if isinstance(settings, ModbusRtuOverTcpListener) else None
            secure = settings if isinstance(settings, ModbusTlsListener) else None
            return _core.Listener(
                name,
                str(settings.bind),
                [_rule(rule, memories, links) for rule in settings.rules],
                framing=_FRAMINGS[settings.type],
                max_connections=settings.max_connections,
                max_connections_per_source=settings.max_connections_per_source,
                when_full=settings.when_full,
                idle_timeout=settings.idle_timeout,
                request_timeout=settings.request_timeout,
                frame_timeout=None if rtu is None else rtu.frame_timeout,
                listen_only=settings.listen_only,
                tls=None if secure is None else server_tls(secure.tls),
                max_handshakes=_HANDSHAKES if secure is None else secure.max_handshakes,
                raw_ingest=_shared_port(name, settings, config, memories),
            )
        case ModbusUdpListener() | ModbusRtuOverUdpListener():
            rules = [_rule(rule, memories, links) for rule in settings.rules]
            return _core.Listener.udp(
                name,
                str(settings.bind),
                rules,
                framing="mbap" if isinstance(settings, ModbusUdpListener) else "rtu",
                listen_only=settings.listen_only,
            )
        case ModbusRtuListener() | ModbusAsciiListener():
            line = settings.serial
            return _core.Listener.serial(
                name,
                line.device,
                _serial_rule(settings.rules, memories, links),
                mode="rtu" if settings.type == "modbus-rtu" else "ascii",
                baud=line.baud,
                parity=line.parity,
                stop_bits=line.stop_bits,
                data_bits=line.data_bits,
                silence=settings.serial.silence if settings.type == "modbus-rtu" else None,
                rs485=line.rs485,
            )
        case RawIngestListener():
            compat = settings.compat or STRICT
            return _core.Listener.raw_ingest(
                name,
                str(settings.bind),
                [_raw_rule(rule, config, memories) for rule in settings.rules],
                format=settings.format,
                crc=compat.crc or "required",
                flags=compat.flags or "strict",
                max_connections=settings.max_connections,
                max_connections_per_source=settings.max_connections_per_source,
                when_full=settings.when_full,
                request_timeout=settings.request_timeout,
                packets=compat.packets or "one",
                idle_timeout=settings.idle_timeout or MAX_TIME,
                after_refusal=compat.after_refusal or "close",
                tls=None if settings.tls is None else server_tls(settings.tls),
                max_handshakes=settings.max_handshakes or _HANDSHAKES,
            )
        case _:
            assert_never(settings)


def _shared_port(
    name: str, settings: Listener, config: Config, memories: Mapping[str, Memory]
) -> _core.Listener | None:
    """Raw ingest packets on the port of a Modbus listener."""
    if not isinstance(settings, ModbusTcpListener) or settings.raw_ingest is None:
        return None
    part = settings.raw_ingest
    compat = part.compat or STRICT
    return _core.Listener.raw_ingest(
        name,
        str(settings.bind),
        [_raw_rule(rule, config, memories) for rule in part.rules],
        format=part.format,
        crc=compat.crc or "required",
        flags=compat.flags or "strict",
        request_timeout=settings.request_timeout,
        packets=compat.packets or "one",
        idle_timeout=settings.idle_timeout or MAX_TIME,
        after_refusal=compat.after_refusal or "close",
    )


def server_tls(settings: ServerTlsConfig) -> _core.ServerTls:
    """Loads the certificates of a listener. Raises `ValueError` for an unusable file."""
    from holdfast.certificates.own import key_for_core

    others = (settings.cert_file, settings.ca_file, settings.crl_file)
    return _core.ServerTls(
        cert_file=settings.cert_file,
        key_file=settings.key_file,
        ca_file=settings.ca_file,
        crl_file=settings.crl_file,
        expired_crl=settings.expired_crl,
        key=key_for_core(settings.key_file, settings.key_passphrase_file, *others),
    )


def device(
    name: str,
    config: Config,
    memories: Mapping[str, Memory],
    report: _core.Results | None,
    fence: _core.Fence | None = None,
) -> _core.PolledDevice:
    """Creates the native poller's device of that name. Raises `OSError` for unusable files.

    `report` takes the polls of devices with tags. With a `fence`, it is polled while that is open.
    """
    settings = config.devices[name]
    fields = Reader(name, config.tags(name)).fields
    status = settings.status
    assert settings.interval is not None, "a device that is polled has an interval"
    return _core.PolledDevice(
        name,
        _endpoint(f"devices.{name}.url", settings.target),
        unit=settings.unit,
        interval=settings.interval,
        timeout=settings.timeout,
        reads=[
            (read.area, read.address, read.count, _place(read.into, memories))
            for read in settings.reads
        ],
        forward=[
            (_receiver(f"devices.{name}.forward[{index}].url", each), _forward(name, each))
            for index, each in enumerate(settings.forward)
        ],
        status=None if status is None else (memories[status.memory], _block(name, status)),
        start_within=min(settings.interval, SPREAD),
        in_flight=None if settings.in_flight == "auto" else settings.in_flight,
        retry=settings.retry.pauses,
        measured=settings.cost is not None and settings.cost.measured,
        report=report if fields else None,
        fields=fields,
        fence=fence,
        **planning.rules(settings),
    )


def _forward(device: str, settings: ForwardConfig) -> Forward:
    """The packets for a receiver, as the native poller has them."""
    status = settings.status
    return (
        settings.format,
        settings.crc or "required",
        settings.target,
        settings.timeout,
        [(area, getattr(settings.offsets, area)) for area in AREAS],
        None if status is None else (settings.status_target, _block(device, status)),
    )


def _block(device: str, settings: BlockConfig) -> StatusBlock:
    """The status block of a device, as the native poller has it."""
    name = device if settings.name is None else settings.name
    return settings.area, settings.slot, name, settings.keep_last_error


def tell_disabled(name: str, status: StatusConfig, memories: Mapping[str, Memory]) -> None:
    """Writes the status block of a device that is not polled."""
    _core.tell_disabled(memories[status.memory], _block(name, status))


def gateway(
    settings: GatewayConfig, profiles: Mapping[str, ProfileConfig] | None = None
) -> GatewaySettings:
    """Returns the settings of the gateway."""
    from holdfast.gateway import GatewayLimits, Settings

    tokens = () if settings.tokens == "none" else settings.tokens
    return Settings(
        settings.allow,
        writes=settings.access == "read-write",
        tokens=tuple((token.name, bytes.fromhex(token.sha256)) for token in tokens),
        sources=settings.sources,
        limits=GatewayLimits(in_flight=settings.in_flight),
        profiles=_tag_lists(profiles),
        hosts=frozenset(settings.hosts),
        compat=settings.compat,
        tls=gateway_tls(settings),
    )


def gateway_tls(settings: GatewayConfig) -> Tls:
    """Returns the certificates that the gateway uses for TLS devices."""
    return NO_FILES if settings.device_tls is None else settings.device_tls.files


def https(settings: HttpsConfig) -> Https:
    """Loads the certificates of an HTTP service. Raises `ValueError` for an unusable file."""
    from holdfast.web.https import Https, HttpsFiles

    return Https(
        HttpsFiles(
            settings.cert_file,
            settings.key_file,
            settings.key_passphrase_file,
            settings.client_ca_file,
            settings.crl_file,
            settings.expired_crl,
            settings.review,
            settings.roles,
        )
    )


def nats_servers(settings: NatsServersConfig) -> Servers:
    """Returns NATS servers and credentials."""
    from holdfast.scanner import Servers

    return Servers(
        settings.servers,
        settings.username,
        settings.password_file,
        settings.token_file,
        settings.credentials_file,
        NO_FILES if settings.tls is None else settings.tls.files,
    )


def scanner(
    settings: NatsConfig, profiles: Mapping[str, ProfileConfig] | None = None
) -> ScannerSettings:
    """Returns the settings of the scanner."""
    from holdfast.scanner import Defaults, FleetSettings, Ping, ScannerLimits, Settings

    fleet = settings.fleet
    limits = ScannerLimits(devices=settings.limits.devices, tags=settings.limits.tags)
    trust = NO_FILES if settings.device_tls is None else settings.device_tls.files
    given = settings.defaults
    return Settings(
        nats_servers(settings),
        settings.prefix,
        settings.devices,
        limits,
        trust,
        defaults=Defaults(given.timeout, given.publish, given.deadband, given.scan_rate),
        writes=settings.writes,
        strict=settings.strict,
        ping=Ping(settings.ping.interval, settings.ping.outstanding),
        publish_logs=settings.publish_logs,
        keep_subscriptions=settings.keep_subscriptions,
        dialect=settings.dialect,
        profiles=_tag_lists(profiles),
        fleet=None if fleet is None else FleetSettings(fleet.name, fleet.node, fleet.partitions),
    )


def _tag_lists(profiles: Mapping[str, ProfileConfig] | None) -> Mapping[str, TagList]:
    return {name: profile.tag_list for name, profile in (profiles or {}).items()}


def _endpoint(key: str, target: Target) -> _core.Endpoint:
    """The native endpoint of the URL at this key. Raises `OSError` for unusable files."""
    try:
        return endpoint(target)
    except (OSError, ValueError) as error:
        raise OSError(f"{key}: {error}") from error


def _receiver(key: str, settings: ForwardConfig) -> _core.Endpoint:
    """The native endpoint of a receiver. Raises `OSError` for unusable files."""
    try:
        return receiver_endpoint(settings.receiver)
    except (OSError, ValueError) as error:
        raise OSError(f"{key}: {error}") from error


def _place(
    into: DestinationConfig | None, memories: Mapping[str, Memory]
) -> tuple[Memory, Area, int] | None:
    return None if into is None else (memories[into.memory], into.area, into.address)


def _rule(rule: RuleConfig, memories: Mapping[str, Memory], links: Links) -> _core.Rule:
    own = {
        unit: rights
        for unit, rights in unit_rights(rule)
        if (rights.access, rights.functions, rights.deny)
        != (rule.access, rule.functions, rule.deny)
        or rights.has_ranges
    }
    return _core.Rule(
        _targets(dict(unit_rights(rule)), memories, links),
        sources=[str(source) for source in rule.sources],
        access=rule.access,
        functions=rule.functions,
        deny=rule.deny,
        roles=getattr(rule, "roles", None),
        narrowed={unit: _narrowed(rights) for unit, rights in own.items()},
    )


def _serial_rule(
    rules: Sequence[SerialRuleConfig], memories: Mapping[str, Memory], links: Links
) -> _core.Rule:
    """The rule of a serial line, which is that of all rules together."""
    units = together(rules)
    return _core.Rule(
        _targets(units, memories, links),
        sources=[],
        access=rules[0].access,
        narrowed={unit: _narrowed(rights) for unit, rights in units.items()},
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

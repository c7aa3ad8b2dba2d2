"""Checks rules between keys of the services: REST, MQTT, scanner, gateway, adapters, audit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.checks.common import (
    Owners,
    check_name,
    given,
    items,
    until_invalid,
)
from holdfast.config.checks.memories import check_grant, check_memory, layout
from holdfast.config.checks.nats import check_dialect_of, check_nats
from holdfast.config.checks.tls import check_client_tls, check_files, check_https
from holdfast.config.models.base import INVALID, InvalidValue
from holdfast.config.models.listeners import ModbusTcpListener, UnitMemoryConfig
from holdfast.config.models.services import HTTP_SERVICES
from holdfast.config.text.messages import show
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import either, extent, listing
from holdfast.tags import Tag, TagError
from holdfast.tags.scale import RegisterScale
from holdfast.values.orders import DEFAULT_ORDER

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from holdfast.config.checks.common import Scope
    from holdfast.config.models.devices import DeviceConfig
    from holdfast.config.models.root import Config
    from holdfast.config.models.services import (
        AuditConfig,
        BrokerConfig,
        GatewayConfig,
        MappingConfig,
        MqttConfig,
        NatsConfig,
        RestConfig,
    )
    from holdfast.config.text.report import Report
    from holdfast.config.text.yaml_document import KeyPath


_USERS_OF_MEMORIES = ("rest", "mqtt", "adapters")
_USERS_OF_NONE = ("nats", "gateway", "links", "devices")
_INSTEAD_OF_LISTENERS = ("rest", "mqtt", "nats", "gateway", "devices")


def check_services(scope: Scope) -> None:
    """Reports what is wrong."""
    config, report = scope.config, scope.report
    _check_served(scope)
    checks: dict[str, Callable[[Scope, Any], None]] = {
        "rest": _check_rest,
        "mqtt": _check_mqtt,
        "nats": _check_scanner,
        "gateway": _check_gateway,
        "audit": _check_audit,
    }
    for name, check in checks.items():
        with until_invalid():
            if getattr(config, name) is not None:
                check(scope, getattr(config, name))
    with until_invalid():
        for path, adapter in items(("adapters",), config.adapters):
            check_grant(scope, path, adapter)
    for name in HTTP_SERVICES:
        with until_invalid():
            service = getattr(config, name)
            if service is not None:
                check_https((name, "tls"), service.tls, report)


def _check_served(scope: Scope) -> None:
    """Reports a missing server, and missing memories if a section uses them."""
    config, data = scope.config, scope.report.document.data
    used = any(data.get(key, {}) != {} for key in _USERS_OF_MEMORIES) or _uses_memories(config)
    if data.get("memories", {}) == {} and (used or not given(config, *_USERS_OF_NONE)):
        none = "nats, gateway, routes and devices that are forwarded or have tags"
        _add_empty(scope, "memories", f"when only {none} are configured")
    if data.get("listeners", {}) == {} and not given(config, *_INSTEAD_OF_LISTENERS):
        _add_empty(scope, "listeners", f"with {either(_INSTEAD_OF_LISTENERS)}")


def _add_empty(scope: Scope, key: str, unless: str) -> None:
    found = "found an empty mapping" if given(scope.config, key) else "missing"
    message = f"{found}, allowed: a mapping with at least one entry (optional {unless})"
    scope.report.add_key((key,), message)


def _uses_memories(config: Config) -> bool:
    """Whether a listener or a device needs a memory: all do that only route or forward."""
    try:
        rules: list[Any] = [rule for each in config.listeners.values() for rule in each.rules]
        for each in config.listeners.values():
            if isinstance(each, ModbusTcpListener) and each.raw_ingest is not None:
                rules += each.raw_ingest.rules
        stored = any(
            isinstance(target, str | UnitMemoryConfig)
            for rule in rules
            for target in dict(rule.units).values() or [""]
        )
        return stored or any(_is_stored(device) for device in config.devices.values())
    except InvalidValue:
        return True


def _is_stored(device: DeviceConfig) -> bool:
    """Whether a memory has values or the status of a device."""
    stored = given(device, "status") or any(given(read, "into") for read in device.reads)
    return bool(stored) or bool(given(device, "reads") and not device.forward)


def _check_rest(scope: Scope, rest: RestConfig) -> None:
    with until_invalid():
        _check_tokens(scope, "rest", rest)
    with until_invalid():
        if rest.tokens != "none":
            for path, token in items(("rest", "tokens"), rest.tokens):
                check_grant(scope, path, token)


def _check_gateway(scope: Scope, gateway: GatewayConfig) -> None:
    with until_invalid():
        _check_tokens(scope, "gateway", gateway)
    with until_invalid():
        check_client_tls(("gateway", "device_tls"), gateway.device_tls, scope.report)
    if gateway.tokens != "none":
        return
    for path, network in items(("gateway", "sources"), gateway.sources):
        if not network.is_loopback:
            allowed = "allowed with tokens none: loopback addresses, as in 127.0.0.0/8"
            scope.report.add(path, f"found {show(scope.report.raw(path))}, {allowed}")


def _check_tokens(scope: Scope, section: str, settings: RestConfig | GatewayConfig) -> None:
    """Tokens have unique names and hashes; `none` requires a loopback address."""
    tokens, report = settings.tokens, scope.report
    if tokens == "none":
        if not settings.bind.address.is_loopback:
            allowed = "allowed: none only on a loopback address"
            report.add((section, "tokens"), f"found 'none' with bind {settings.bind}, {allowed}")
        return
    if given(settings, "hosts"):
        report.warn((section, "hosts"), "has no effect with tokens")
    names, hashes = Owners(report, "name"), Owners(report, "sha256")
    for path, token in items((section, "tokens"), tokens):
        with until_invalid():
            names.claim((*path, "name"), token.name, show(token.name), path)
        with until_invalid():
            hashes.claim((*path, "sha256"), token.sha256, "a hash", path)


def _check_mqtt(scope: Scope, mqtt: MqttConfig) -> None:
    check_broker(("mqtt",), mqtt, scope.report)
    topics = Owners(scope.report, "topic")
    with until_invalid():
        for path, subscription in items(("mqtt", "subscriptions"), mqtt.subscriptions):
            check_grant(scope, path, subscription)
            with until_invalid():
                topic = subscription.topic
                topics.claim((*path, "topic"), topic, show(topic), path)
    with until_invalid():
        check_map(scope, mqtt.map)
        if not mqtt.subscriptions and not mqtt.map:
            found = "found an empty list" if given(mqtt, "subscriptions") else "missing"
            message = f"{found}, allowed: a list with at least one entry (optional with map)"
            scope.report.add_key(("mqtt", "subscriptions"), message)


def _check_scanner(scope: Scope, nats: NatsConfig) -> None:
    check_nats(("nats",), nats, scope.report)
    check_dialect_of(("nats",), nats, scope.report)
    with until_invalid():
        check_client_tls(("nats", "device_tls"), nats.device_tls, scope.report)
    if nats.defaults.deadband and nats.defaults.publish != "change":
        message = "found without publish: change, allowed: only with it"
        scope.report.add_key(("nats", "defaults", "deadband"), message)


def _check_audit(scope: Scope, audit: AuditConfig) -> None:
    if given(audit, "file"):
        return
    report = scope.report
    if not given(audit, "syslog") and audit.__dict__.get("journald") is not True:
        message = "missing, allowed: text (optional with syslog or journald: true)"
        report.add(("audit", "file"), message)
    if audit.__dict__.get("fail") == "closed":
        report.add(("audit", "fail"), "found 'closed' without file, allowed: only with it")
    for key in given(audit, "max_bytes", "keep"):
        report.add_key(("audit", key), "found without file, allowed: only with it")


def check_broker(path: KeyPath, settings: BrokerConfig, report: Report) -> None:
    """Reports what is wrong in user, password and TLS."""
    if given(settings, "password_file") and not given(settings, "username"):
        report.add_key((*path, "password_file"), "found without username, allowed: both or neither")
    check_files(path, settings, ("password_file",), report)
    with until_invalid():
        if given(settings, "tls") and not settings.broker.secure:
            message = "found with a url that begins with mqtt://, allowed: only with mqtts://"
            report.add_key((*path, "tls"), message)
    with until_invalid():
        check_client_tls((*path, "tls"), settings.tls, report)


def check_map(scope: Scope, entries: Sequence[MappingConfig]) -> None:
    """Reports what is wrong in topics of plain values."""
    topics = Owners(scope.report, "topic")
    for path, entry in items(("mqtt", "map"), entries):
        with until_invalid():
            check_memory(scope, (*path, "memory"), entry.memory)
        with until_invalid():
            topics.claim((*path, "topic"), entry.topic, show(entry.topic), path)
        with until_invalid():
            found = _tag(scope, path, entry)
            if found is not None:
                _check_place(scope, path, entry, found)


def _tag(scope: Scope, path: KeyPath, entry: MappingConfig) -> Tag | None:
    """The tag of an entry, if there is a valid one."""
    report = scope.report
    if given(entry, "tag"):
        for key in given(entry, "profile", "name"):
            report.add_key((*path, key), "found together with tag, allowed: only one of them")
        if entry.tag is None:
            return None
        try:
            return entry.tag.tag("tag", DEFAULT_ORDER)
        except (TagError, InvalidValue):
            for error in entry.tag.flaws("tag", DEFAULT_ORDER):
                report.add((*path, "tag", error.key), str(error))
            return None
    for key in ("profile", "name"):
        if not given(entry, key):
            message = "missing, allowed: tag, or profile and name"
            report.add_key((*path, "tag" if key == "profile" else key), message)
            return None
    assert entry.profile is not None, "given"
    assert entry.name is not None, "given"
    profiles = scope.config.profiles
    if not check_name((*path, "profile"), entry.profile, profiles, "profiles", report):
        return None
    profile = profiles[entry.profile]
    if entry.name not in profile.tags:
        words = f"allowed: {listing(profile.tags)}{suggestion(entry.name, profile.tags)}"
        report.add((*path, "name"), f"found {show(entry.name)}, {words}")
        return None
    if INVALID in profile.tags.values():
        return None
    try:
        return profile.tag_list[entry.name]
    except TagError:
        return None  # Reported with the profile.


def _check_place(scope: Scope, path: KeyPath, entry: MappingConfig, tag: Tag) -> None:
    """A tag must fit its memory, and a message must be able to write it alone."""
    report, own = scope.report, entry.tag is not None
    at: KeyPath = (*path, "tag" if own else "name")
    if tag.of_type.base == "bit":
        message = f"found the type {tag.type}, allowed: types of whole registers, and bool"
        report.add((*at, "type") if own else at, message)
    if isinstance(tag.scale, RegisterScale):
        message = f"the scale is the {tag.scale}, allowed: a number, for what a topic writes"
        report.add((*at, "scale") if own else at, message)
    memory = scope.config.memories.get(entry.memory, INVALID)
    if memory is INVALID:
        return  # Reported by the model, or as unknown.
    areas = layout(memory)
    if tag.area not in areas:
        report.add(at, f"found {tag.area}, which the memory {entry.memory} does not have")
        return
    addresses = areas[tag.area]
    if addresses is not None and not (tag.address in addresses and tag.end - 1 in addresses):
        found = f"found {tag.area} {tag.address} to {tag.end - 1}"
        report.add(at, f"{found}, allowed: addresses {extent(addresses)}")

"""Checks rules between keys of listeners: limits, rights that rules give, and memories."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.allowed_words import allowed
from holdfast.config.checks.common import given, items, refuse_repeats, until_invalid
from holdfast.config.checks.memories import check_grant, check_memory
from holdfast.config.checks.rule_order import warn_of_order
from holdfast.config.checks.tls import check_server_tls
from holdfast.config.checks.units import (
    check_names,
    check_rights,
    check_unit,
    check_units,
    warn_of_missing,
    warn_of_rights,
    warn_of_unit,
)
from holdfast.config.models.base import INVALID
from holdfast.config.models.connection_limits import ConnectionLimits
from holdfast.config.models.listeners import (
    ModbusTcpListener,
    RawIngestConfig,
    RawIngestListener,
    RawRuleConfig,
    RouteConfig,
    SecureRawRuleConfig,
    TlsRuleConfig,
    tls_of,
)
from holdfast.config.text.messages import show

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.config.checks.common import Scope
    from holdfast.config.models.listeners import Listener, Target
    from holdfast.config.models.services import GatewayConfig, RestConfig
    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.config.values.unit_keys import UnitKey


_OTHER = {"v1": "crc", "crc": "v1"}
_NAMING = {"v1": "units", "crc": "memories"}
"""The key with which a raw ingest rule names memories, by packet format."""


def check_listeners(scope: Scope) -> None:
    """Reports what is wrong."""
    check_names(scope)
    with until_invalid():
        for path, listener in items(("listeners",), scope.config.listeners):
            with until_invalid():
                if isinstance(listener, RawIngestListener):
                    _check_without_tls(scope, path, listener)
                    _check_raw(scope, path, listener)
                else:
                    _check_rules(scope, path, listener)
            with until_invalid():
                if isinstance(listener, ModbusTcpListener) and listener.raw_ingest is not None:
                    _check_raw(scope, (*path, "raw_ingest"), listener.raw_ingest)
            with until_invalid():
                tls = tls_of(listener)
                if tls is not None:
                    check_server_tls((*path, "tls"), tls, scope.report)


def warn_of_listeners(scope: Scope) -> None:
    """Warns about settings of valid listeners that have no effect."""
    for name, listener in scope.config.listeners.items():
        path: KeyPath = ("listeners", name)
        if isinstance(listener, ConnectionLimits):
            warn_of_source_limit(scope, path, listener)
        if isinstance(listener, ModbusTcpListener) and listener.raw_ingest is not None:
            packets = items((*path, "raw_ingest", "rules"), listener.raw_ingest.rules)
            warn_of_order(packets, scope.report)
        rules: Sequence[Any] = listener.rules
        for where, rule in items((*path, "rules"), rules):
            if not isinstance(listener, RawIngestListener):
                warn_of_rights(scope, where, rule, rule.access)
                warn_of_missing(scope, where, rule, event_log=listener.event_log)
                for each, unit in items((*where, "units"), rule.units):
                    if not isinstance(unit, str):
                        warn_of_unit(scope, each, unit, rule)
        warn_of_order(items((*path, "rules"), rules), scope.report)


def warn_of_source_limit(
    scope: Scope, path: KeyPath, settings: ConnectionLimits | RestConfig | GatewayConfig
) -> None:
    """Warns about a limit for one source that is above the limit for all."""
    most, of_source = settings.max_connections, settings.max_connections_per_source
    if of_source is not None and of_source > most:
        message = f"{of_source} has no effect: max_connections is {most}"
        scope.report.warn((*path, "max_connections_per_source"), message)


def _check_rules(scope: Scope, path: KeyPath, listener: Listener) -> None:
    rules: Sequence[Any] = listener.rules
    for where, rule in items((*path, "rules"), rules):
        units: dict[UnitKey, Target] = {}
        with until_invalid():
            units = rule.units
        check_units(scope, (*where, "units"), units)
        routed = any(isinstance(target, RouteConfig) for target in units.values())
        check_rights(scope, where, rule, routed=routed)
        with until_invalid():
            if isinstance(rule, TlsRuleConfig):
                refuse_repeats((*where, "roles"), rule.roles, scope.report)
        for each, unit in items((*where, "units"), units):
            if not isinstance(unit, str):
                check_unit(scope, each, unit, rule)


def _check_without_tls(scope: Scope, path: KeyPath, listener: RawIngestListener) -> None:
    """Reports keys of a raw ingest listener that belong to TLS."""
    if given(listener, "tls"):
        return
    places: list[tuple[KeyPath, str]] = []
    with until_invalid():
        for where, rule in items((*path, "rules"), listener.rules):
            places += [(where, key) for key in given(rule, "roles")]
    for where, key in places:
        scope.report.add_key((*where, key), "found without tls, allowed: only with it")


def _check_raw(scope: Scope, path: KeyPath, part: RawIngestListener | RawIngestConfig) -> None:
    with until_invalid():
        if part.compat is not None:
            for key in given(part.compat, "crc", "flags"):
                if part.format == "v1":
                    message = "found with format v1, allowed: only with format crc"
                    scope.report.add_final((*path, "compat", key), message, of_key=True)
            if given(part.compat, "after_refusal") and not given(part.compat, "packets"):
                message = "found without packets: many, allowed: only with it"
                scope.report.add_final((*path, "compat", "after_refusal"), message, of_key=True)
    rules: Sequence[RawRuleConfig] = part.rules
    for where, rule in items((*path, "rules"), rules):
        _check_raw_rule(scope, where, rule)
        with until_invalid():
            if isinstance(rule, SecureRawRuleConfig):
                refuse_repeats((*where, "roles"), rule.roles, scope.report)
        with until_invalid():
            _check_format(scope, where, rule, part.format)


def _check_raw_rule(scope: Scope, path: KeyPath, rule: RawRuleConfig) -> None:
    with until_invalid():
        for where, name in items((*path, "units"), rule.units):
            check_memory(scope, where, name)
    check_grant(scope, path, rule)


def _check_format(scope: Scope, path: KeyPath, rule: RawRuleConfig, form: str) -> None:
    """A rule names memories in the way of its packet format."""
    needed, other = _NAMING[form], _NAMING[_OTHER[form]]
    if not given(rule, needed):
        words = allowed((*path, needed), scope.report.document.data)
        scope.report.add_key((*path, needed), f"missing with format {form}, allowed: {words}")
    if given(rule, other):
        scope.report.add_key((*path, other), f"found with format {form}, allowed: {needed}")
    if form == "crc":
        for where, name in items((*path, "memories"), rule.memories):
            memory = scope.config.memories.get(name, INVALID)
            if memory is not INVALID and not given(memory, "id"):
                message = f"found {show(name)}, which has no id, allowed: a memory with an id"
                scope.report.add(where, message)

"""The configuration of an appliance: one YAML file, checked as a whole before anything starts.

Call `load`. It returns a valid `Config`, or raises a `ConfigError` with every problem of the file.
This package never starts anything and never opens a socket. It uses only the constants of the
native core.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.runtime.lazy_names import imported_on_use

if TYPE_CHECKING:
    from holdfast.config.initial_values import InitialRun
    from holdfast.config.loader import load
    from holdfast.config.models.devices import (
        DestinationConfig,
        DeviceConfig,
        RangeConfig,
        ReadConfig,
    )
    from holdfast.config.models.links import LinkConfig
    from holdfast.config.models.listeners import (
        Listener,
        ModbusAsciiListener,
        ModbusAsciiOverTcpListener,
        ModbusRtuListener,
        ModbusRtuOverTcpListener,
        ModbusRtuOverUdpListener,
        ModbusTcpListener,
        ModbusTlsListener,
        ModbusUdpListener,
        RawIngestListener,
        RawRuleConfig,
        RouteConfig,
        RtuSerialConfig,
        RuleConfig,
        SecureRawRuleConfig,
        SerialRuleConfig,
        UnitMemoryConfig,
        tls_of,
    )
    from holdfast.config.models.memories import MemoryConfig, Seal, Span
    from holdfast.config.models.root import Config, IdentityConfig, MappedTag
    from holdfast.config.models.server_tls import HttpsConfig, ServerTlsConfig
    from holdfast.config.models.services import (
        HTTP_SERVICES,
        AdapterConfig,
        AuditConfig,
        BrokerConfig,
        ClientTlsConfig,
        GatewayConfig,
        MappingConfig,
        MetricsConfig,
        MqttConfig,
        NatsConfig,
        RestConfig,
        SubscriptionConfig,
        TokenConfig,
    )
    from holdfast.config.schema import json_schema
    from holdfast.config.text.problems import ConfigError, Problem
else:
    _NAMES = {
        "initial_values": ("InitialRun",),
        "loader": ("load",),
        "models.devices": ("DestinationConfig", "DeviceConfig", "RangeConfig", "ReadConfig"),
        "models.links": ("LinkConfig",),
        "models.listeners": (
            "Listener",
            "ModbusAsciiListener",
            "ModbusAsciiOverTcpListener",
            "ModbusRtuListener",
            "ModbusRtuOverTcpListener",
            "ModbusRtuOverUdpListener",
            "ModbusTcpListener",
            "ModbusTlsListener",
            "ModbusUdpListener",
            "RawIngestListener",
            "RawRuleConfig",
            "RouteConfig",
            "RtuSerialConfig",
            "RuleConfig",
            "SecureRawRuleConfig",
            "SerialRuleConfig",
            "UnitMemoryConfig",
            "tls_of",
        ),
        "models.memories": ("MemoryConfig", "Seal", "Span"),
        "models.root": ("Config", "IdentityConfig", "MappedTag"),
        "models.server_tls": ("HttpsConfig", "ServerTlsConfig"),
        "models.services": (
            "HTTP_SERVICES",
            "AdapterConfig",
            "AuditConfig",
            "BrokerConfig",
            "ClientTlsConfig",
            "GatewayConfig",
            "MappingConfig",
            "MetricsConfig",
            "MqttConfig",
            "NatsConfig",
            "RestConfig",
            "SubscriptionConfig",
            "TokenConfig",
        ),
        "schema": ("json_schema",),
        "text.problems": ("ConfigError", "Problem"),
    }
    __getattr__ = imported_on_use(
        __name__, {name: f"{__name__}.{home}" for home, names in _NAMES.items() for name in names}
    )

__all__ = [
    "HTTP_SERVICES",
    "AdapterConfig",
    "AuditConfig",
    "BrokerConfig",
    "ClientTlsConfig",
    "Config",
    "ConfigError",
    "DestinationConfig",
    "DeviceConfig",
    "GatewayConfig",
    "HttpsConfig",
    "IdentityConfig",
    "InitialRun",
    "LinkConfig",
    "Listener",
    "MappedTag",
    "MappingConfig",
    "MemoryConfig",
    "MetricsConfig",
    "ModbusAsciiListener",
    "ModbusAsciiOverTcpListener",
    "ModbusRtuListener",
    "ModbusRtuOverTcpListener",
    "ModbusRtuOverUdpListener",
    "ModbusTcpListener",
    "ModbusTlsListener",
    "ModbusUdpListener",
    "MqttConfig",
    "NatsConfig",
    "Problem",
    "RangeConfig",
    "RawIngestListener",
    "RawRuleConfig",
    "ReadConfig",
    "RestConfig",
    "RouteConfig",
    "RtuSerialConfig",
    "RuleConfig",
    "Seal",
    "SecureRawRuleConfig",
    "SerialRuleConfig",
    "ServerTlsConfig",
    "Span",
    "SubscriptionConfig",
    "TokenConfig",
    "UnitMemoryConfig",
    "json_schema",
    "load",
    "tls_of",
]

"""The configuration of an appliance: one YAML file, checked as a whole before anything starts.

Call `load`. It returns a valid `Config`, or raises a `ConfigError` with every problem of the file.
This package never starts anything and never opens a socket. It uses only the constants of the
native core.
"""

from __future__ import annotations

from holdfast.config.devices import (
    CostConfig,
    DestinationConfig,
    DeviceConfig,
    ForwardConfig,
    RangeConfig,
    ReadConfig,
    StatusConfig,
)
from holdfast.config.initial import InitialRun
from holdfast.config.ip_addresses import Bind
from holdfast.config.links import LinkConfig
from holdfast.config.listeners import (
    AsciiSerialConfig,
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
    SerialConfig,
    SerialRuleConfig,
    TlsRuleConfig,
    UnitMemoryConfig,
    tls_of,
)
from holdfast.config.load import load
from holdfast.config.memories import MemoryConfig, Seal, Span
from holdfast.config.model import Config, IdentityConfig, LogConfig, MappedTag
from holdfast.config.problems import ConfigError, Problem
from holdfast.config.schema import json_schema
from holdfast.config.server_tls import HttpsConfig, ServerTlsConfig
from holdfast.config.services import (
    HTTP_SERVICES,
    AdapterConfig,
    AuditConfig,
    BrokerConfig,
    ClientTlsConfig,
    GatewayConfig,
    GatewayTokenConfig,
    MappingConfig,
    MetricsConfig,
    MqttConfig,
    NatsConfig,
    NatsDefaultsConfig,
    NatsLimitsConfig,
    NatsPingConfig,
    RestConfig,
    SubscriptionConfig,
    SyslogConfig,
    TokenConfig,
)
from holdfast.net.addresses import Network

__all__ = [
    "HTTP_SERVICES",
    "AdapterConfig",
    "AsciiSerialConfig",
    "AuditConfig",
    "Bind",
    "BrokerConfig",
    "ClientTlsConfig",
    "Config",
    "ConfigError",
    "CostConfig",
    "DestinationConfig",
    "DeviceConfig",
    "ForwardConfig",
    "GatewayConfig",
    "GatewayTokenConfig",
    "HttpsConfig",
    "IdentityConfig",
    "InitialRun",
    "LinkConfig",
    "Listener",
    "LogConfig",
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
    "NatsDefaultsConfig",
    "NatsLimitsConfig",
    "NatsPingConfig",
    "Network",
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
    "SerialConfig",
    "SerialRuleConfig",
    "ServerTlsConfig",
    "Span",
    "StatusConfig",
    "SubscriptionConfig",
    "SyslogConfig",
    "TlsRuleConfig",
    "TokenConfig",
    "UnitMemoryConfig",
    "json_schema",
    "load",
    "tls_of",
]

"""Models of the services: REST, MQTT, the scanner, the gateway, adapters, metrics and audit."""

from __future__ import annotations

from math import isfinite
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

from pydantic import AfterValidator, Discriminator, Field, Strict, Tag

from holdfast.config.models.base import Model
from holdfast.config.models.connection_limits import per_source
from holdfast.config.models.server_tls import HttpsConfig
from holdfast.config.models.tags import TagConfig
from holdfast.config.text.raw_access import entries
from holdfast.config.values.scalars import (
    MILLISECONDS,
    SECONDS,
    Areas,
    BindAddress,
    BrokerUrl,
    Connections,
    Duration,
    EgressEntry,
    FilePath,
    FleetMember,
    FleetName,
    HostName,
    MemoryNames,
    MqttText,
    MqttVersion,
    Name,
    NatsUrl,
    NotNull,
    OptionName,
    PollableEntry,
    QualityOfService,
    Sources,
    SubjectPrefix,
    SyslogUrl,
    TokenHash,
    TokenName,
    TopicFilter,
    TopicName,
    seconds,
    whole_number,
)
from holdfast.config.values.scanner_settings import (
    DEFAULT_MAX_DEVICES,
    DEFAULT_MAX_TAGS,
    DIALECT,
    MAX_DEADBAND,
    MAX_PARTITIONS,
    MAX_PING_INTERVAL,
    MAX_PINGS,
    MAX_SCAN_RATE,
    MAX_TIMEOUT,
    MIN_PING_INTERVAL,
    MIN_SCAN_RATE,
    MIN_TIMEOUT,
    PARTITIONS,
    PREFIX,
    SCAN_RATE,
    TIMEOUT,
    Dialect,
    Publish,
    Writes,
)
from holdfast.config.values.urls import Broker, parse_broker
from holdfast.net.addresses import LOOPBACK
from holdfast.net.nats.ping_defaults import PING_INTERVAL_S, PINGS_OUTSTANDING
from holdfast.net.tls import NO_FILES, Tls
from holdfast.types import Access


class GatewayTokenConfig(Model):
    """A secret token that gives access to the gateway."""

    name: TokenName
    """The name of the token in logs; unique."""
    sha256: TokenHash
    """The SHA-256 of the token, 64 hexadecimal digits; the token itself is not in the file."""


class TokenConfig(GatewayTokenConfig):
    """A secret token that gives access to REST, and what it can access."""

    memories: MemoryNames
    """The memories it can access."""
    areas: Areas
    """The areas it can access."""
    access: Access
    """Whether it may write."""
    while_sealed: Annotated[Areas | None, NotNull()] = None
    """Areas that it may also write, but not read, while their memory is sealed. Default: none."""
    manage: bool = False
    """Whether it may list and end the connections of listeners."""


def _form(tokens: object) -> str:
    return "word" if isinstance(tokens, str) else "list"


Token = TypeVar("Token", bound=GatewayTokenConfig)
Tokens: TypeAlias = Annotated[
    Annotated[tuple[Token, ...], Strict(False), Field(min_length=1), Tag("list")]
    | Annotated[Literal["none"], Tag("word")],
    Discriminator(_form),
]


class RestConfig(Model):
    """The REST interface: JSON in and out over HTTP."""

    bind: BindAddress
    """Where to listen: an IP address and a port."""
    sources: Sources
    """Networks and addresses of the clients, IPv4 or IPv6."""
    tokens: Tokens[TokenConfig]
    """The tokens. none: everyone can read and write all memories, but nobody can list or end
    sessions; only on a loopback address."""
    max_body: Annotated[int, Field(ge=1024, le=2**30)] = 8 * 2**20
    """Maximum number of bytes in the body of a request."""
    max_connections: Connections = 128
    """Maximum number of open connections."""
    max_connections_per_source: Connections | None = Field(default_factory=per_source)
    """Maximum number of open connections from one address; null: unlimited. Default: half of
    max_connections, but at least 16."""
    when_full: Literal["refuse", "evict"] = "evict"
    """At the limit: refuse closes the new connection, evict the connection idle longest."""
    request_timeout: Duration = 10.0
    """Seconds from the first byte of a request to its last."""
    tls: Annotated[HttpsConfig | None, NotNull()] = None
    """Certificates for HTTPS. Default: HTTP."""
    hosts: Annotated[tuple[HostName, ...], Strict(False)] = ()
    """With tokens none: the names under which REST may be reached."""


class ClientTlsConfig(Model):
    """Certificates for TLS connections to servers or devices."""

    ca_file: Annotated[FilePath | None, NotNull()] = None
    """Trusted certificates, in PEM. Default: the system's authorities."""
    cert_file: Annotated[FilePath | None, NotNull()] = None
    """The client certificate, in PEM; requires key_file."""
    key_file: Annotated[FilePath | None, NotNull()] = None
    """The key of the client certificate, in PEM."""

    @property
    def files(self) -> Tls:
        """The files."""
        return Tls.of(self.ca_file, self.cert_file, self.key_file)


class SubscriptionConfig(Model):
    """Topics to subscribe to, and what their messages may write."""

    topic: TopicFilter
    """The topic filter; `+` matches one level, a final `#` all following levels."""
    qos: QualityOfService = 0
    """The requested quality of service."""
    memories: MemoryNames
    """The memories that messages may write."""
    areas: Areas
    """The areas that messages may write."""
    while_sealed: Annotated[Areas | None, NotNull()] = None
    """Areas that messages may also write while their memory is sealed. Default: none."""


class BrokerConfig(Model):
    """A connection to an MQTT broker."""

    url: BrokerUrl
    """The broker: mqtt://host:port, or mqtts:// for TLS. Default port: 1883 or 8883."""
    username: Annotated[MqttText | None, NotNull()] = None
    """The user name for the broker."""
    password_file: Annotated[FilePath | None, NotNull()] = None
    """A file that contains the password; requires username."""
    version: MqttVersion = "5"
    """The version of MQTT."""
    keep_alive: Annotated[int, Field(ge=1, le=65535, json_schema_extra=SECONDS)] = 60
    """Seconds without a message after which the client sends a ping."""
    tls: Annotated[ClientTlsConfig | None, NotNull()] = None
    """Certificates; requires mqtts://."""

    @property
    def broker(self) -> Broker:
        """The parts of the URL."""
        return parse_broker(self.url)

    @property
    def host(self) -> str:
        """The broker's name or address, without brackets."""
        return self.broker.host

    @property
    def port(self) -> int:
        """The broker's TCP port."""
        return self.broker.port

    @property
    def tls_files(self) -> Tls | None:
        """The files for TLS; `None` without TLS."""
        if not self.broker.secure:
            return None
        return NO_FILES if self.tls is None else self.tls.files


class MappingConfig(Model):
    """A topic whose messages are the values of one tag."""

    topic: TopicName
    """The topic, without wildcards."""
    qos: QualityOfService = 1
    """The requested quality of service."""
    memory: Name
    """The memory that is written."""
    tag: Annotated[TagConfig | None, NotNull()] = None
    """The area, the address and the type of the values."""
    profile: Annotated[Name | None, NotNull()] = None
    """The profile that has the tag, instead of tag."""
    name: Annotated[Name | None, NotNull()] = None
    """The name of the tag in the profile."""


class MqttConfig(BrokerConfig):
    """The MQTT client: receives JSON commands and plain values from topics of a broker."""

    client_id: MqttText
    """The client identifier; unique among the clients of the broker."""
    subscriptions: Annotated[tuple[SubscriptionConfig, ...], Strict(False)] = ()
    """The topics of JSON commands; optional with map."""
    map: Annotated[tuple[MappingConfig, ...], Strict(False)] = ()
    """The topics of plain values, such as 21.5."""


class NatsLimitsConfig(Model):
    """Limits on what subscribers of the scanner can request."""

    devices: Annotated[int, Field(ge=1)] = DEFAULT_MAX_DEVICES
    """Maximum number of devices polled at once."""
    tags: Annotated[int, Field(ge=1)] = DEFAULT_MAX_TAGS
    """Maximum number of tags of all devices."""


class NatsDefaultsConfig(Model):
    """The values for keys that a subscribe request leaves out."""

    timeout: Annotated[
        int, Field(ge=MIN_TIMEOUT, le=MAX_TIMEOUT, json_schema_extra=MILLISECONDS)
    ] = TIMEOUT
    """Milliseconds for a Modbus request and its reply."""
    publish: Publish = "scan"
    """Whether every value is published, or only changes."""
    deadband: Annotated[float, Field(ge=0, le=MAX_DEADBAND), whole_number] = 0.0
    """With publish: change, the change of a number must be greater than this."""
    scan_rate: Annotated[
        int, Field(ge=MIN_SCAN_RATE, le=MAX_SCAN_RATE, json_schema_extra=MILLISECONDS)
    ] = SCAN_RATE
    """The scan interval in milliseconds."""


class NatsPingConfig(Model):
    """How a NATS server that does not answer is detected."""

    interval: Annotated[float, seconds(MIN_PING_INTERVAL, MAX_PING_INTERVAL), whole_number] = (
        PING_INTERVAL_S
    )
    """Seconds between pings to the server."""
    outstanding: Annotated[int, Field(ge=1, le=MAX_PINGS)] = PINGS_OUTSTANDING
    """Pings without an answer after which the scanner reconnects."""


class NatsServersConfig(Model):
    """NATS servers, and the credentials for them."""

    servers: Annotated[tuple[NatsUrl, ...], Strict(False), Field(min_length=1)]
    """The NATS servers: nats://host:port or tls://host:port. Default port: 4222."""
    username: Annotated[MqttText | None, NotNull()] = None
    """The user name for the server."""
    password_file: Annotated[FilePath | None, NotNull()] = None
    """A file that contains the password; requires username."""
    token_file: Annotated[FilePath | None, NotNull()] = None
    """A file that contains a token, instead of a user name."""
    credentials_file: Annotated[FilePath | None, NotNull()] = None
    """A file that contains a JWT and the seed of its key, instead of a user name."""
    tls: Annotated[ClientTlsConfig | None, NotNull()] = None
    """Certificates for the NATS servers; requires tls://."""


class NatsFleetConfig(Model):
    """The fleet of scanners that share the devices."""

    name: FleetName
    """The name of the fleet."""
    node: FleetMember
    """The name of this scanner in the fleet; unique."""
    partitions: Annotated[int, Field(ge=1, le=MAX_PARTITIONS)] = PARTITIONS
    """Parts of the devices that one scanner has; 20 times the number of scanners or more."""


class NatsConfig(NatsServersConfig):
    """The scanner: polls devices for NATS subscribers."""

    devices: Annotated[tuple[PollableEntry, ...], Strict(False), Field(min_length=1)]
    """Devices that subscribers may poll and write to: networks, addresses, serial devices."""
    device_tls: Annotated[ClientTlsConfig | None, NotNull()] = None
    """Certificates for TLS connections to devices."""
    prefix: SubjectPrefix = PREFIX
    """The first part of all subjects."""
    dialect: Dialect = DIALECT
    """The programs it serves: those of tentacle-modbus, or of tentacle-next."""
    defaults: NatsDefaultsConfig = Field(default_factory=NatsDefaultsConfig)
    """What subscribe requests leave out."""
    writes: Writes = "tags"
    """Tags that may be written: all not declared read-only, those declared writable, or none."""
    strict: bool = False
    """Whether requests with unknown keys or inexact values are refused, instead of adjusted."""
    ping: NatsPingConfig = Field(default_factory=NatsPingConfig)
    """Pings that detect a NATS server that does not answer."""
    publish_logs: bool = True
    """Whether the scanner's log is also published on service.logs.modbus.PREFIX."""
    keep_subscriptions: bool = True
    """Whether subscriptions are kept in JetStream, and restored after a restart."""
    limits: NatsLimitsConfig = Field(default_factory=NatsLimitsConfig)
    """Limits on what subscribers can request."""
    fleet: Annotated[NatsFleetConfig | None, NotNull()] = None
    """The fleet of scanners that share the devices. Default: none."""


Compat: TypeAlias = Literal["port-of-call"]
"""A program in whose form the gateway takes requests and sends errors."""


class GatewayConfig(Model):
    """The gateway: access to devices over HTTP, with a web console."""

    bind: BindAddress
    """Where to listen: an IP address and a port."""
    sources: Sources
    """Networks and addresses of the clients, IPv4 or IPv6."""
    allow: Annotated[tuple[EgressEntry, ...], Strict(False), Field(min_length=1)]
    """Devices that it may connect to: NETWORK[:PORTS]. Default ports: 502, with TLS also 802."""
    access: Access
    """Whether it may write to devices."""
    tokens: Tokens[GatewayTokenConfig]
    """The tokens. none: everyone has access; only on loopback addresses."""
    tls: Annotated[HttpsConfig | None, NotNull()] = None
    """Certificates for HTTPS. Default: HTTP."""
    device_tls: Annotated[ClientTlsConfig | None, NotNull()] = None
    """Certificates for TLS connections to devices."""
    in_flight: Annotated[int, Field(ge=1, le=64)] = 1
    """Maximum number of requests in flight to one device."""
    max_connections: Connections = 128
    """Maximum number of open connections of clients."""
    max_connections_per_source: Connections | None = Field(default_factory=per_source)
    """Maximum number of open connections from one address; null: unlimited. Default: half of
    max_connections, but at least 16."""
    hosts: Annotated[tuple[HostName, ...], Strict(False)] = ()
    """With tokens none: the names under which the gateway may be reached."""
    compat: Annotated[Compat | None, NotNull()] = None
    """The program whose requests it accepts, and whose errors it sends. Default: none."""


def _finite(value: Any) -> Any:
    """Refuses what JSON can't have, anywhere in the value of an option."""
    if isinstance(value, float) and not isfinite(value):
        raise ValueError(f"found {value}, allowed: finite numbers")
    for each in value.values() if isinstance(value, dict) else entries(value):
        _finite(each)
    return value


class AdapterConfig(Model):
    """A third-party adapter, and what it can access."""

    type: Name
    """The entry point of the adapter, in the group holdfast.adapters."""
    memories: MemoryNames
    """The memories it can access."""
    areas: Areas
    """The areas it can access."""
    access: Access
    """Whether it may write."""
    options: dict[OptionName, Annotated[Any, AfterValidator(_finite)]] = Field(default={})
    """The adapter's own settings."""


class MetricsConfig(Model):
    """Metrics in the Prometheus text format."""

    values: bool = False
    """Whether the values of tags are metrics too."""

    bind: BindAddress
    """Where to listen: an IP address and a port."""
    sources: Sources = LOOPBACK
    """Networks and addresses of the clients, IPv4 or IPv6."""
    tls: Annotated[HttpsConfig | None, NotNull()] = None
    """Certificates for HTTPS. Default: HTTP."""
    hosts: Annotated[tuple[HostName, ...], Strict(False)] = ()
    """The names under which the metrics may be reached."""


class AuditConfig(Model):
    """A log that records every write, one line each: a file, syslog, the journal."""

    own_files = ("file",)

    file: Annotated[FilePath | None, NotNull()] = None
    """The file, in an existing folder; optional with syslog or journald."""
    fail: Literal["open", "closed"] = "open"
    """Whether writes that can't be recorded in the file are carried out (open) or refused
    (closed)."""
    syslog: Annotated[SyslogUrl | None, NotNull()] = None
    """A syslog receiver of copies of all lines: udp://host:port, tcp://host:port or
    unix:///path."""
    journald: bool = False
    """Whether the journal of systemd receives copies of all lines."""
    max_bytes: Annotated[int, Field(ge=65536)] = 100 * 2**20
    """The size in bytes at which the file is rotated."""
    keep: Annotated[int, Field(ge=1, le=1000)] = 10
    """How many rotated files to keep."""


HTTP_SERVICES = ("rest", "gateway", "metrics")
"""The sections of services over HTTP, each with `bind`, `sources` and `tls`."""

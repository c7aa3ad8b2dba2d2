"""What an appliance offers or uses beside its listeners: REST, MQTT, the scanner, the gateway,
adapters, metrics, audit.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias, TypeVar

from pydantic import Discriminator, Field, Strict, Tag

from holdfast.config.base import Model
from holdfast.config.broker import Broker, parse_broker
from holdfast.config.scalars import (
    Areas,
    BindAddress,
    BrokerUrl,
    Connections,
    Duration,
    EgressEntry,
    FilePath,
    MemoryNames,
    MqttText,
    MqttVersion,
    Name,
    NatsUrl,
    NotNull,
    OptionName,
    PollableEntry,
    QualityOfService,
    Sha256,
    Sources,
    SubjectPrefix,
    TopicFilter,
)
from holdfast.config.scanning import MAX_DEVICES, MAX_TAGS, PREFIX
from holdfast.net.addresses import LOOPBACK
from holdfast.net.tls import Tls
from holdfast.types import Access


class GatewayTokenConfig(Model):
    """One who may use the gateway, by a secret token."""

    name: Name
    """What the logs call it; no two tokens share one."""
    sha256: Sha256
    """The SHA-256 of the token, 64 hexadecimal digits; the token itself is not in the file."""


class TokenConfig(GatewayTokenConfig):
    """One who may use REST, by a secret token, and what for."""

    memories: MemoryNames
    """The memories it reaches."""
    areas: Areas
    """The areas it reaches."""
    access: Access
    """Whether it may write."""


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
    """Who may do what; `none` lets everyone do everything, on a loopback address only."""
    max_body: Annotated[int, Field(ge=1024, le=2**30)] = 8 * 2**20
    """The most bytes of the body of a request."""
    max_connections: Connections = 64
    """Connections that are open at once."""
    request_timeout: Duration = 10.0
    """Seconds from the first byte of a request to its last."""


class ClientTlsConfig(Model):
    """Certificates for TLS with a broker or with devices; the system's authorities without any."""

    ca_file: Annotated[FilePath | None, NotNull()] = None
    """The certificates that are trusted, in PEM: of authorities, or of devices themselves."""
    cert_file: Annotated[FilePath | None, NotNull()] = None
    """The certificate that is shown to the other side, in PEM; together with key_file."""
    key_file: Annotated[FilePath | None, NotNull()] = None
    """The key of that certificate, in PEM."""

    @property
    def files(self) -> Tls:
        """The files."""
        return Tls.of(self.ca_file, self.cert_file, self.key_file)


class SubscriptionConfig(Model):
    """Topics to listen to, and what their messages may write."""

    topic: TopicFilter
    """The topic filter; `+` stands for one level, a last `#` for all that follow."""
    qos: QualityOfService = 0
    """The quality of service that is asked for."""
    memories: MemoryNames
    """The memories that messages may write."""
    areas: Areas
    """The areas that messages may write."""


class MqttConfig(Model):
    """The MQTT client: takes JSON commands from the topics of a broker."""

    url: BrokerUrl
    """The broker: mqtt://host:port, or mqtts:// for TLS; the port is 1883 or 8883 if left out."""
    username: Annotated[MqttText | None, NotNull()] = None
    """The user name that is told to the broker."""
    password_file: Annotated[FilePath | None, NotNull()] = None
    """A file that holds the password; beside username only."""
    client_id: MqttText
    """The name of this client, which no other client of the broker has."""
    version: MqttVersion = "5"
    """The version of MQTT."""
    keep_alive: Annotated[int, Field(ge=1, le=65535)] = 60
    """Seconds without a message after which the connection is tested."""
    tls: Annotated[ClientTlsConfig | None, NotNull()] = None
    """Certificates; beside mqtts:// only."""
    subscriptions: Annotated[tuple[SubscriptionConfig, ...], Strict(False), Field(min_length=1)]
    """The topics to listen to."""

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
    def secure(self) -> bool:
        """Whether TLS is spoken."""
        return self.broker.secure


class NatsLimitsConfig(Model):
    """What subscribers of the scanner may ask for at most."""

    devices: Annotated[int, Field(ge=1)] = MAX_DEVICES
    """Devices that are polled at once."""
    tags: Annotated[int, Field(ge=1)] = MAX_TAGS
    """Tags of all devices."""


class NatsConfig(Model):
    """The scanner: polls devices for whoever subscribes over NATS."""

    servers: Annotated[tuple[NatsUrl, ...], Strict(False), Field(min_length=1)]
    """The NATS servers: nats://host:port, or tls://host:port; the port is 4222 if left out."""
    devices: Annotated[tuple[PollableEntry, ...], Strict(False), Field(min_length=1)]
    """Whom subscribers may have polled and written to: networks, addresses, serial devices."""
    username: Annotated[MqttText | None, NotNull()] = None
    """The user name that is told to the server."""
    password_file: Annotated[FilePath | None, NotNull()] = None
    """A file that holds the password; beside username only."""
    token_file: Annotated[FilePath | None, NotNull()] = None
    """A file that holds a token, in the place of a user."""
    credentials_file: Annotated[FilePath | None, NotNull()] = None
    """A file with a JWT and the seed of its key, in the place of a user."""
    tls: Annotated[ClientTlsConfig | None, NotNull()] = None
    """Certificates; beside tls:// only."""
    device_tls: Annotated[ClientTlsConfig | None, NotNull()] = None
    """Certificates for devices that are subscribed to with TLS."""
    prefix: SubjectPrefix = PREFIX
    """The first part of all subjects."""
    limits: NatsLimitsConfig = Field(default_factory=NatsLimitsConfig)
    """What subscribers may ask for at most."""


class GatewayConfig(Model):
    """The gateway: Modbus devices over HTTP, and a console for a browser."""

    bind: BindAddress
    """Where to listen: an IP address and a port."""
    sources: Sources
    """Networks and addresses of the clients, IPv4 or IPv6."""
    allow: Annotated[tuple[EgressEntry, ...], Strict(False), Field(min_length=1)]
    """Whom it may connect to: networks, addresses and ports; without, 502, and 802 with TLS."""
    access: Access
    """Whether it may write to devices."""
    tokens: Tokens[GatewayTokenConfig]
    """Who may use it; `none` lets everyone, from this machine only."""
    tls: Annotated[ClientTlsConfig | None, NotNull()] = None
    """Certificates for devices that are talked to with TLS."""
    in_flight: Annotated[int, Field(ge=1, le=64)] = 1
    """Requests on their way to one device at once."""


class AdapterConfig(Model):
    """A third-party adapter, and what it may reach."""

    type: Name
    """The entry point of the adapter, in the group holdfast.adapters."""
    memories: MemoryNames
    """The memories it reaches."""
    areas: Areas
    """The areas it reaches."""
    access: Access
    """Whether it may write."""
    options: dict[OptionName, Any] = Field(default={})
    """What the adapter itself wants to know, as it is written."""


class MetricsConfig(Model):
    """Counters and gauges, as Prometheus text."""

    bind: BindAddress
    """Where to listen: an IP address and a port."""
    sources: Sources = LOOPBACK
    """Networks and addresses of the readers, IPv4 or IPv6."""


class AuditConfig(Model):
    """A file that records every change, line by line."""

    file: FilePath
    """The file, in a folder that is there."""
    max_bytes: Annotated[int, Field(ge=65536)] = 100 * 2**20
    """Bytes after which the file is put aside and a new one begun."""
    keep: Annotated[int, Field(ge=1, le=1000)] = 10
    """Files put aside that are kept."""

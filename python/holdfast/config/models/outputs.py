"""Models of outputs: where the values of tags are published."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import BeforeValidator, Field, Strict

from holdfast.config.models.base import Model, types_of
from holdfast.config.models.services import BrokerConfig, ClientTlsConfig, NatsServersConfig
from holdfast.config.values.mqtt_output_topics import TopicNames
from holdfast.config.values.scalars import (
    Duration,
    FilePath,
    HttpUrl,
    Measurement,
    MqttText,
    MqttVersion,
    Name,
    NotNull,
    PointTag,
    SparkplugId,
    SubjectPrefix,
    TopicName,
    TopicTemplate,
    integral,
)
from holdfast.config.values.scanner_settings import DIALECT, PREFIX, Dialect
from holdfast.config.values.urls import HttpTarget, parse_http

MAX_VALUES = 1_000_000
MEASUREMENT = "modbus"


class BufferConfig(Model):
    """What an output keeps while it can't send."""

    own_files = ("file",)

    values: Annotated[int, Field(ge=1000, le=10_000_000)] = MAX_VALUES
    """The newest values that are kept in memory."""
    file: Annotated[FilePath | None, NotNull()] = None
    """A file for what can't be sent, in an existing folder; it survives a restart."""
    max_bytes: Annotated[int, Field(ge=2**20, le=2**50)] = 2**30
    """The size in bytes at which the oldest values in the file are dropped."""


class OutputConfig(Model):
    """What all outputs have."""

    publish: Literal["change", "scan"] = "change"
    """change: values that differ from the last by more than their deadband; scan: all."""
    heartbeat: Annotated[Duration | None, NotNull()] = None
    """Seconds after which an unchanged value is published again. Default: never."""
    devices: Annotated[
        Annotated[tuple[Name, ...], Strict(False), Field(min_length=1)] | None, NotNull()
    ] = None
    """The devices whose tags are published. Default: all."""
    buffer: BufferConfig = Field(default_factory=BufferConfig)
    """What is kept while the receiver can't be reached."""

    @property
    def is_line_protocol(self) -> bool:
        """Whether values are published as line protocol, which has none for a missing one."""
        return False


class InfluxConfig(OutputConfig):
    """Line protocol over HTTP: InfluxDB, and others that accept it."""

    type: Literal["influx"]
    """The type of the output."""
    url: HttpUrl
    """http://host:port for the v2 write API of InfluxDB; other receivers with their path."""
    org: Annotated[str | None, NotNull()] = None
    """The organization."""
    bucket: Annotated[str | None, NotNull()] = None
    """The bucket; required if the URL has no path."""
    token_file: Annotated[FilePath | None, NotNull()] = None
    """A file that contains the token."""
    username: Annotated[str | None, NotNull()] = None
    """A user name, instead of a token."""
    password_file: Annotated[FilePath | None, NotNull()] = None
    """A file that contains the password of the user."""
    measurement: Measurement = MEASUREMENT
    """The measurement of all points; each device is a tag, each tag of it a field."""
    tags: dict[Name, PointTag] = Field(default={})
    """More tags of all points, such as the site."""
    gzip: bool = True
    """Whether requests are compressed."""
    timeout: Duration = 5.0
    """Seconds for a request and its answer."""
    tls: Annotated[ClientTlsConfig | None, NotNull()] = None
    """Certificates; requires https://."""

    @property
    def is_line_protocol(self) -> bool:
        """Always."""
        return True

    @property
    def target(self) -> HttpTarget:
        """The parts of the URL."""
        return parse_http(self.url)


class FileConfig(OutputConfig):
    """A file: lines of text, or an SQLite database."""

    own_files = ("file",)

    type: Literal["file"]
    """The type of the output."""
    file: FilePath
    """The file, in an existing folder."""
    format: Literal["csv", "jsonl", "influx", "sqlite"]
    """csv, JSON Lines, line protocol, or an SQLite database with the table readings."""
    max_bytes: Annotated[int, Field(ge=65536)] = 100 * 2**20
    """The size in bytes at which a file of text is rotated, or the oldest rows of a database are
    removed."""
    keep: Annotated[int, Field(ge=0, le=1000)] = 10
    """How many rotated files of text to keep."""

    @property
    def is_line_protocol(self) -> bool:
        """Only one of its formats is."""
        return self.format == "influx"


class NatsOutputConfig(NatsServersConfig, OutputConfig):
    """NATS: the messages that the scanner publishes for subscribers."""

    type: Literal["nats"]
    """The type of the output."""
    prefix: SubjectPrefix = PREFIX
    """The first part of all subjects."""
    dialect: Dialect = DIALECT
    """The programs that read the messages: those of tentacle-modbus, or of tentacle-next."""


class MqttOutputConfig(OutputConfig, BrokerConfig):
    """Topics of an MQTT broker, and commands from there."""

    type: Literal["mqtt"]
    """The type of the output."""
    client_id: Annotated[MqttText | None, NotNull()] = None
    """The client identifier. Default: holdfast, the name of the output, that of the host, and a
    digest of a status that is not the default."""
    topic: Annotated[TopicTemplate | None, NotNull()] = None
    """The topics of values. Default: plant/{device}/{tag}, with payload: device plant/{device}."""
    payload: Literal["plain", "json", "device"] = "plain"
    """plain: text; json: an object with value, time and unit; device: one object for each poll."""
    retain: bool = True
    """Whether the broker keeps the last message of each topic for new subscribers."""
    qos: Annotated[Literal[0, 1], BeforeValidator(integral)] = 1
    """The quality of service. 0: a message may be lost with the connection."""
    status: Annotated[TopicName | None, NotNull()] = None
    """The topic that is online or offline. Default: the begin of topic, then holdfast/status."""
    writes: bool = False
    """Whether messages to the set topics of writable tags are written to their devices."""
    discovery: Annotated[Literal["homeassistant"] | None, NotNull()] = None
    """Whose discovery messages are published. Default: none."""
    discovery_prefix: TopicName = "homeassistant"
    """The begin of the topics of Home Assistant."""

    @property
    def topics(self) -> TopicNames:
        """The names of all topics."""
        return TopicNames(self.topic, self.status, whole_device=self.payload == "device")


class SparkplugConfig(OutputConfig, BrokerConfig):
    """A Sparkplug B edge node, whose devices are those that are polled."""

    type: Literal["sparkplug"]
    """The type of the output."""
    group: SparkplugId
    """The group of the edge node."""
    edge_node: SparkplugId
    """The edge node; unique in its group."""
    primary_host: Annotated[SparkplugId | None, NotNull()] = None
    """The host without which nothing is published: values wait until it is online."""
    version: MqttVersion = "3.1.1"
    client_id: Annotated[MqttText | None, NotNull()] = None
    """The client identifier. Default: holdfast, the name of the output, that of the host, and a
    digest of group and edge_node."""
    datatypes: Literal["births", "always"] = "births"
    """Which messages have the types of metrics. always: DDATA too, for readers without a state."""
    writes: bool = False
    """Whether commands for writable tags are written to their devices."""


Output: TypeAlias = (
    InfluxConfig | MqttOutputConfig | SparkplugConfig | FileConfig | NatsOutputConfig
)
OUTPUT_TYPES = types_of(Output)
"""All values of `type`."""

"""The model of a whole configuration: frozen, and strict about its own values.

Memories, listeners, devices and services have their own files. Rules between two places of the file
are in the checks, not in the models, so one error never hides another. Editors show the docstrings
of the keys, by way of the JSON Schema.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from pydantic import BeforeValidator, Field, PrivateAttr

from holdfast.config.models.base import Model
from holdfast.config.models.devices import DeviceConfig
from holdfast.config.models.links import LinkConfig
from holdfast.config.models.listeners import Listener
from holdfast.config.models.logs import SharedLogConfig
from holdfast.config.models.memories import MemoryConfig
from holdfast.config.models.outputs import Output
from holdfast.config.models.services import (
    AdapterConfig,
    AuditConfig,
    GatewayConfig,
    MappingConfig,
    MetricsConfig,
    MqttConfig,
    NatsConfig,
    RestConfig,
)
from holdfast.config.models.tags import ProfileConfig
from holdfast.config.values.scalars import (
    NAME_KEYS,
    OBJECT_KEYS,
    UNIT_KEYS,
    UNRESERVED_KEYS,
    Name,
    NotNull,
    ObjectId,
    Text,
    UnitId,
    UnreservedName,
)
from holdfast.config.values.template_schema import with_templates
from holdfast.events import FORMAT, LEVEL, Format, Level
from holdfast.server.identity import Identity
from holdfast.tags import Tag, TagList
from holdfast.values.orders import DEFAULT_ORDER

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from holdfast.config.text.problems import Problem


class IdentityConfig(Model):
    """The answers to functions 17 and 43/14."""

    vendor_name: Text = Identity.vendor_name
    """Object 0, VendorName."""
    product_code: Text = Identity.product_code
    """Object 1, ProductCode."""
    revision: Text = Field(default_factory=lambda: Identity.revision)
    """Object 2, MajorMinorRevision. Default: the version of Holdfast."""
    vendor_url: Annotated[Text | None, NotNull()] = None
    """Object 3, VendorUrl."""
    product_name: Annotated[Text | None, NotNull()] = None
    """Object 4, ProductName."""
    model_name: Annotated[Text | None, NotNull()] = None
    """Object 5, ModelName."""
    user_application_name: Annotated[Text | None, NotNull()] = None
    """Object 6, UserApplicationName."""
    unit_names: dict[UnitId, Text] = Field(default={}, json_schema_extra=UNIT_KEYS)
    """Names of single units, by unit id: the server id of function 17, and object 6."""
    objects: dict[ObjectId, Text] = Field(default={}, json_schema_extra=OBJECT_KEYS)
    """Private objects by id, 128 to 255."""


class MappedTag(NamedTuple):
    """A tag in a memory."""

    memory: str
    tag: Tag


class LogConfig(Model):
    """Log level and log format."""

    level: Level = LEVEL
    """The lowest level that is logged."""
    format: Format = FORMAT
    """text: lines for people. json: one JSON object per line, for programs. ecs: the same in the
    names of the Elastic Common Schema, for a SIEM."""


def _unchanged(value: object) -> object:
    """Does nothing: its user only tells the JSON Schema about lists, which the loader replaces."""
    return value


Profiles = Annotated[
    dict[Name, ProfileConfig],
    BeforeValidator(_unchanged, json_schema_input_type=dict[Name, ProfileConfig] | list[str]),
]


class Config(Model):
    """The configuration of a Holdfast appliance."""

    memories: dict[Name, MemoryConfig] = Field(default={}, json_schema_extra=NAME_KEYS)
    """The memories, by name; optional when only nats, gateway, routes and
    devices that are forwarded or have tags are configured."""
    logs: dict[Name, SharedLogConfig] = Field(default={}, json_schema_extra=NAME_KEYS)
    """Logs of writes that several appliances share, by name."""
    identity: IdentityConfig = Field(default_factory=IdentityConfig)
    """The identification of the appliance."""
    listeners: dict[UnreservedName, Annotated[Listener, Field(discriminator="type")]] = Field(
        default={}, json_schema_extra=UNRESERVED_KEYS
    )
    """The servers, by name; optional with rest, mqtt, nats, gateway or a device."""
    profiles: Profiles = Field(default={}, json_schema_extra=NAME_KEYS)
    """The tags of kinds of devices, by name; or a list of files with one profile each."""
    devices: dict[Name, DeviceConfig] = Field(default={}, json_schema_extra=with_templates)
    """Devices to poll, or to pass requests on to, by name."""
    links: dict[Name, LinkConfig] = Field(default={}, json_schema_extra=NAME_KEYS)
    """Connections and serial lines to pass requests on to, by name."""
    rest: Annotated[RestConfig | None, NotNull()] = None
    """The REST interface."""
    mqtt: Annotated[MqttConfig | None, NotNull()] = None
    """The MQTT client."""
    nats: Annotated[NatsConfig | None, NotNull()] = None
    """The scanner, which polls devices for NATS subscribers."""
    gateway: Annotated[GatewayConfig | None, NotNull()] = None
    """The gateway, which gives access to devices over HTTP and has a web console."""
    outputs: dict[UnreservedName, Annotated[Output, Field(discriminator="type")]] = Field(
        default={}, json_schema_extra=UNRESERVED_KEYS
    )
    """Where the values of tags are published, by name."""
    adapters: dict[UnreservedName, AdapterConfig] = Field(
        default={}, json_schema_extra=UNRESERVED_KEYS
    )
    """Third-party adapters, by name."""
    metrics: Annotated[MetricsConfig | None, NotNull()] = None
    """Metrics for Prometheus."""
    audit: Annotated[AuditConfig | None, NotNull()] = None
    """The log of every write."""
    log: LogConfig = Field(default_factory=LogConfig)
    """The log of the program."""
    reload: Literal["on-request", "on-change"] = "on-request"
    """When the configuration is reread. on-request: at a signal or a command; on-change: also when
    another file was renamed into the place of this one, or of one that it names."""
    workers: Annotated[int, Field(ge=1, le=64)] = 1
    """Threads that serve connections."""

    _warnings: tuple[Problem, ...] = PrivateAttr(default=())
    _sha256: str | None = PrivateAttr(default=None)
    _profile_files: tuple[Path, ...] = PrivateAttr(default=())

    def tags(self, device: str) -> TagList:
        """The tags of a device: those of its profile, and its own besides or in place of them."""
        settings = self.devices[device]
        profile = None if settings.profile is None else self.profiles[settings.profile]
        tags = TagList() if profile is None else profile.tag_list
        if not settings.tags:
            return tags
        order = DEFAULT_ORDER if profile is None else profile.order
        own = {name: tag.tag(name, order) for name, tag in settings.tags.items()}
        return TagList({**{tag.name: tag for tag in tags}, **own}.values())

    def mqtt_tags(self) -> dict[str, MappedTag]:
        """The tags that MQTT messages with a plain value write, by topic."""
        entries = () if self.mqtt is None else self.mqtt.map
        return {entry.topic: MappedTag(entry.memory, self._mapped(entry)) for entry in entries}

    def _mapped(self, entry: MappingConfig) -> Tag:
        if entry.tag is not None:
            return entry.tag.tag(entry.topic, DEFAULT_ORDER)
        assert entry.profile is not None, "checked before"
        assert entry.name is not None, "checked before"
        return self.profiles[entry.profile].tag_list[entry.name]

    @property
    def profile_files(self) -> tuple[Path, ...]:
        """The files that profiles were read from."""
        return self._profile_files

    def set_profile_files(self, files: Iterable[Path]) -> None:
        """Sets the files that profiles were read from."""
        self._profile_files = tuple(files)

    @property
    def warnings(self) -> tuple[Problem, ...]:
        """Valid settings without effect, such as a rule that never matches."""
        return self._warnings

    def set_warnings(self, warnings: Iterable[Problem]) -> None:
        """Sets the warnings."""
        self._warnings = tuple(warnings)

    @property
    def sha256(self) -> str | None:
        """The SHA-256 of the file that this configuration was loaded from, if it was."""
        return self._sha256

    def set_sha256(self, sha256: str) -> None:
        """Sets the SHA-256 of the file."""
        self._sha256 = sha256

    def __eq__(self, other: object) -> bool:
        """Whether all settings are equal; warnings and file are not compared."""
        return isinstance(other, Config) and dict(self) == dict(other)

    def dump(self) -> str:
        """The effective configuration as YAML, with all defaults. `load` reads an equal one."""
        from holdfast.config.dump import to_yaml

        return to_yaml(self.effective())

    def effective(self) -> dict[str, Any]:
        """The effective configuration as plain data, for YAML and JSON."""
        from holdfast.config import dump

        return dump.effective(self.model_dump())

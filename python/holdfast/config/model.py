"""What a configuration holds, as frozen models: each checks its own values, strictly.

This is the whole and its small parts; memories, listeners and services have files of their own. A
rule that two places of the file must keep together is in no model but in the checks, so that one
mistake never hides another. The descriptions are what editors show, by way of the JSON Schema.
"""

from __future__ import annotations

import importlib.metadata
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, PrivateAttr

from holdfast.config import dump
from holdfast.config.base import Model
from holdfast.config.devices import DeviceConfig
from holdfast.config.listeners import Listener
from holdfast.config.memories import MemoryConfig
from holdfast.config.scalars import (
    ADAPTER_KEYS,
    NAME_KEYS,
    OBJECT_KEYS,
    UNIT_KEYS,
    AdapterName,
    Name,
    NotNull,
    ObjectId,
    Text,
    UnitId,
)
from holdfast.config.services import (
    AdapterConfig,
    AuditConfig,
    GatewayConfig,
    MetricsConfig,
    MqttConfig,
    NatsConfig,
    RestConfig,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.config.problems import Problem


def installed_version() -> str:
    """The version of this package, `0` when it is not installed."""
    try:
        return importlib.metadata.version("holdfast")
    except importlib.metadata.PackageNotFoundError:
        return "0"


class IdentityConfig(Model):
    """What functions 17 and 43/14 answer."""

    vendor_name: Text = "Holdfast"
    """Object 0, VendorName."""
    product_code: Text = "HF"
    """Object 1, ProductCode."""
    revision: Text = Field(default_factory=installed_version)
    """Object 2, MajorMinorRevision; the version of Holdfast when it is left out."""
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


class LogConfig(Model):
    """What is logged, and how."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    """The least important messages that are logged."""
    format: Literal["text", "json"] = "text"
    """Lines for people, or JSON objects for programs."""


class Config(Model):
    """The configuration of a Holdfast appliance."""

    memories: dict[Name, MemoryConfig] = Field(default={}, json_schema_extra=NAME_KEYS)
    """The memories, by name; at least one, unless nothing but nats and gateway is served."""
    identity: IdentityConfig = Field(default_factory=IdentityConfig)
    """What the appliance says of itself."""
    listeners: dict[Name, Annotated[Listener, Field(discriminator="type")]] = Field(
        default={}, json_schema_extra=NAME_KEYS
    )
    """The servers, by name; at least one, unless there is rest, mqtt, nats, gateway or a device."""
    devices: dict[Name, DeviceConfig] = Field(default={}, json_schema_extra=NAME_KEYS)
    """Devices that are polled, by name."""
    rest: Annotated[RestConfig | None, NotNull()] = None
    """The REST interface."""
    mqtt: Annotated[MqttConfig | None, NotNull()] = None
    """The MQTT client."""
    nats: Annotated[NatsConfig | None, NotNull()] = None
    """The scanner, which polls devices for subscribers over NATS."""
    gateway: Annotated[GatewayConfig | None, NotNull()] = None
    """The gateway, which serves devices over HTTP, with a console."""
    adapters: dict[AdapterName, AdapterConfig] = Field(default={}, json_schema_extra=ADAPTER_KEYS)
    """Third-party adapters, by name."""
    metrics: Annotated[MetricsConfig | None, NotNull()] = None
    """Counters and gauges for Prometheus."""
    audit: Annotated[AuditConfig | None, NotNull()] = None
    """The record of all changes."""
    log: LogConfig = Field(default_factory=LogConfig)
    """What is told to those who run it."""
    workers: Annotated[int, Field(ge=1, le=64)] = 1
    """Threads that serve connections."""

    _warnings: tuple[Problem, ...] = PrivateAttr(default=())

    @property
    def warnings(self) -> tuple[Problem, ...]:
        """What is right but has no effect, such as a rule that never matches."""
        return self._warnings

    def with_warnings(self, warnings: Iterable[Problem]) -> Self:
        """This configuration, with these warnings."""
        self._warnings = tuple(warnings)
        return self

    def __eq__(self, other: object) -> bool:
        """Whether both say the same; the places that their warnings name are no part of it."""
        return isinstance(other, Config) and dict(self) == dict(other)

    def dump(self) -> str:
        """The effective configuration as YAML, all defaults filled in; it loads as an equal one."""
        return dump.to_yaml(self.effective())

    def effective(self) -> dict[str, Any]:
        """The effective configuration as plain data, as `dump` and JSON show it."""
        return dump.effective(self.model_dump())

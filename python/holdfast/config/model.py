"""What a configuration holds, as frozen models: each checks its own values, strictly.

A rule that two places of the file must keep together is not here but in the checks, so that one
mistake never hides another. The descriptions are what editors show, by way of the JSON Schema.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    Strict,
    ValidationInfo,
)

from holdfast.config import dump
from holdfast.config.initial import InitialRun
from holdfast.config.values import (
    AREAS,
    NAME_KEYS,
    OBJECT_KEYS,
    UNIT_KEYS,
    Area,
    BindAddress,
    BitArea,
    Codes,
    Duration,
    DurationOrZero,
    Name,
    NotNull,
    ObjectId,
    Source,
    Text,
    UnitId,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.config.problems import Problem

Size = Annotated[int, Field(ge=1, le=65536)]
Register = Annotated[int, Field(ge=0, le=65535)]


def installed_version() -> str:
    """The version of this package, `0` when it is not installed."""
    try:
        return importlib.metadata.version("holdfast")
    except importlib.metadata.PackageNotFoundError:
        return "0"


class _Model(BaseModel):
    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True
    )


class Span(_Model):
    """The addresses of an area: start to start + size - 1."""

    start: Register = 0
    """The first address."""
    size: Size
    """How many addresses there are; start + size is at most 65536."""

    @property
    def addresses(self) -> range:
        """The addresses, as a range."""
        return range(self.start, self.start + self.size)


def _long_form(value: object) -> object:
    return {"size": value} if type(value) is int else value


Extent = Annotated[
    Span | None, BeforeValidator(_long_form, json_schema_input_type=Size | Span), NotNull()
]


class Seal(_Model):
    """The gate of a sealed memory: Modbus is answered with exception 06 while it is sealed."""

    area: BitArea
    """The area of the gate bit."""
    address: Register
    """The address of the gate bit, inside its area."""
    mode: Literal["once", "level"] = "once"
    """`once`: the bit opens the memory for good. `level`: it is sealed whenever the bit is 0."""


def _in_folder(value: object, info: ValidationInfo) -> object:
    if isinstance(value, str) and value and "\0" not in value:
        return (info.context or {}).get("folder", Path()) / value
    return value


class MemoryConfig(_Model):
    """Four areas of bits and registers. An area that is left out does not exist."""

    id: Annotated[Register | None, NotNull()] = None
    """The MemoryID of the raw ingest format with CRC; no two memories share one."""
    coils: Extent = None
    """Coils, read and written by Modbus: a size, or start and size."""
    discrete_inputs: Extent = None
    """Discrete inputs, read by Modbus: a size, or start and size."""
    holding_registers: Extent = None
    """Holding registers, read and written by Modbus: a size, or start and size."""
    input_registers: Extent = None
    """Input registers, read by Modbus: a size, or start and size."""
    seal: Annotated[Seal | None, NotNull()] = None
    """Starts the memory sealed, until its gate bit is 1."""
    initial: Annotated[
        Path | None, BeforeValidator(_in_folder, json_schema_input_type=str), NotNull()
    ] = None
    """Initial values: a .csv file of area,address,value lines or a .yaml file, beside this one."""

    _initial_values: tuple[InitialRun, ...] = PrivateAttr(default=())

    def model_post_init(self, context: object, /) -> None:
        """Takes the initial values that were read for this memory's file."""
        if self.initial is not None and isinstance(context, Mapping):
            self._initial_values = context["initial_values"].get(self.initial, ())

    @property
    def initial_values(self) -> tuple[InitialRun, ...]:
        """What the memory holds at first where it is not 0, as runs of neighbours."""
        return self._initial_values

    def areas(self) -> dict[Area, Span]:
        """The areas that exist."""
        spans = ((area, getattr(self, area)) for area in AREAS)
        return {area: span for area, span in spans if span is not None}


class IdentityConfig(_Model):
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


class RuleConfig(_Model):
    """What some peers may do."""

    sources: Annotated[tuple[Source, ...], Strict(False), Field(min_length=1)]
    """Networks and addresses of the peers, IPv4 or IPv6."""
    units: dict[UnitId, Name] = Field(min_length=1, json_schema_extra=UNIT_KEYS)
    """The memory behind each unit id."""
    access: Literal["read-only", "read-write"]
    """Whether these peers may write."""
    functions: Annotated[Annotated[Codes, Field(min_length=1)] | None, NotNull()] = None
    """The only function codes that are allowed."""
    deny: Annotated[Codes | None, NotNull()] = None
    """Function codes that are not allowed, the others are."""


class ModbusTcpListener(_Model):
    """A Modbus TCP server."""

    type: Literal["modbus-tcp"]
    """The protocol."""
    bind: BindAddress
    """Where to listen: an IP address and a port."""
    max_connections: Annotated[int, Field(ge=1, le=65535)] = 256
    """Connections that are open at once."""
    max_connections_per_source: Annotated[int, Field(ge=1, le=65535)] | None = None
    """Connections that are open at once from one address; null for no limit of its own."""
    when_full: Literal["refuse", "evict"] = "refuse"
    """What becomes of a connection too many: it is refused, or takes the place of the idlest."""
    idle_timeout: DurationOrZero = 300.0
    """Seconds without a request after which a connection is closed; 0 keeps it for ever."""
    request_timeout: Duration = 10.0
    """Seconds from the first byte of a request to its last."""
    rules: Annotated[tuple[RuleConfig, ...], Strict(False), Field(min_length=1)]
    """The first rule whose sources hold the peer settles what it may do."""


class LogConfig(_Model):
    """What is logged, and how."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    """The least important messages that are logged."""
    format: Literal["text", "json"] = "text"
    """Lines for people, or JSON objects for programs."""


class Config(_Model):
    """The configuration of a Holdfast appliance."""

    memories: dict[Name, MemoryConfig] = Field(min_length=1, json_schema_extra=NAME_KEYS)
    """The memories, by name."""
    identity: IdentityConfig = Field(default_factory=IdentityConfig)
    """What the appliance says of itself."""
    listeners: dict[Name, ModbusTcpListener] = Field(min_length=1, json_schema_extra=NAME_KEYS)
    """The servers, by name."""
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

    def dump(self) -> str:
        """The effective configuration as YAML, all defaults filled in; it loads as an equal one."""
        return dump.to_yaml(self.effective())

    def effective(self) -> dict[str, Any]:
        """The effective configuration as plain data, as `dump` and JSON show it."""
        return dump.effective(self.model_dump())

"""Models of memories: areas of bits and registers, the seal, and the initial values."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, PrivateAttr, Strict, model_validator

from holdfast.config.initial_values import InitialRun
from holdfast.config.models.base import Model
from holdfast.config.values.scalars import (
    FILE_KEYS,
    FileNumber,
    FilePath,
    Name,
    NotNull,
    seconds,
    whole_number,
)
from holdfast.protocol import (
    ADDRESSES,
    FILE_FUNCTIONS,
    LAST_ADDRESS,
    LAST_RECORD,
    READ_FIFO_QUEUE,
)
from holdfast.types import AREAS, Area, BitArea

Size = Annotated[int, Field(ge=1, le=ADDRESSES)]
Register = Annotated[int, Field(ge=0, le=LAST_ADDRESS)]
Records = Annotated[int, Field(ge=1, le=LAST_RECORD + 1)]


class Span(Model):
    """The addresses of an area: start to start + size - 1."""

    start: Register = 0
    """The first address."""
    size: Size
    """How many addresses there are; start + size is at most 65536."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.start + self.size > ADDRESSES:
            found = f"found start {self.start} and size {self.size}"
            raise ValueError(f"{found}, allowed: a sum up to {ADDRESSES}")
        return self

    @property
    def addresses(self) -> range:
        """The addresses, as a range."""
        return range(self.start, self.start + self.size)


def _long_form(value: object) -> object:
    return {"size": value} if type(value) is int else value


Extent = Annotated[
    Span | None, BeforeValidator(_long_form, json_schema_input_type=Size | Span), NotNull()
]


class Seal(Model):
    """The seal of a memory: Modbus clients receive exception 06 while it is sealed."""

    area: BitArea
    """The area of the gate bit."""
    address: Register
    """The address of the gate bit, inside its area."""
    mode: Literal["once", "level"] = "once"
    """once: stays open until a restart. level: sealed whenever the gate bit is 0."""


class KeepConfig(Model):
    """A file that keeps the contents of a memory over restarts."""

    own_files = ("file",)

    file: FilePath
    """The file, in an existing folder. Memories that are written together share one."""
    sync: Annotated[float, seconds(0, 3600), whole_number] = 1.0
    """0: every write is on the disk before its reply. Otherwise the seconds of writes that a crash
    or a power cut may cost; a clean stop loses nothing. With replicate, more than 0."""


class ReplicateConfig(Model):
    """The log that all writes to a memory go through."""

    log: Name
    """The log, a key of logs."""


class MemoryConfig(Model):
    """Four areas of bits and registers, and files. An omitted area does not exist."""

    id: Annotated[Register | None, NotNull()] = None
    """The memory id of raw ingest packets of format crc; unique."""
    coils: Extent = None
    """Coils, read and written by Modbus: a size, or start and size."""
    discrete_inputs: Extent = None
    """Discrete inputs, read by Modbus: a size, or start and size."""
    holding_registers: Extent = None
    """Holding registers, read and written by Modbus: a size, or start and size."""
    input_registers: Extent = None
    """Input registers, read by Modbus: a size, or start and size."""
    files: dict[FileNumber, Records] = Field(
        default={}, json_schema_extra=FILE_KEYS, exclude_if=lambda v: not v
    )
    """Files, read and written by functions 20 and 21: their numbers, and how many records of one
    register each has. Default: none; functions 20 and 21 are exception 01."""
    fifo: Annotated[tuple[Register, ...], Strict(False)] = Field(
        default=(), json_schema_extra={"uniqueItems": True}, exclude_if=lambda v: not v
    )
    """Holding registers at which function 24 reads a queue: the register counts those after it
    that belong to the queue, up to 31. Default: none; function 24 is exception 01."""
    seal: Annotated[Seal | None, NotNull()] = None
    """Seals the memory at the start, until its gate bit is 1."""
    initial: Annotated[FilePath | None, NotNull()] = None
    """A .csv file with lines of area,address,value, or a .yaml file, with initial values."""

    keep: Annotated[KeepConfig | None, NotNull()] = None
    """Keeps the contents over restarts; `initial` then applies only to the first start. With
    replicate, shows whether the servers have lost writes."""

    replicate: Annotated[ReplicateConfig | None, NotNull()] = None
    """Shares the contents with other appliances: all writes go through a log."""

    _initial_values: tuple[InitialRun, ...] = PrivateAttr(default=())

    @property
    def initial_values(self) -> tuple[InitialRun, ...]:
        """The initial values as runs; all other bits and registers start at 0."""
        return self._initial_values

    def with_initial_values(self, runs: tuple[InitialRun, ...]) -> None:
        """Takes the initial values from the file of the memory."""
        self._initial_values = runs

    def areas(self) -> dict[Area, Span]:
        """The areas that exist."""
        spans = ((area, getattr(self, area)) for area in AREAS)
        return {area: span for area, span in spans if span is not None}

    @property
    def functions(self) -> frozenset[int]:
        """The functions that the memory has because of its files and queues."""
        of_files = FILE_FUNCTIONS if self.files else frozenset[int]()
        return of_files | ({READ_FIFO_QUEUE} if self.fifo else frozenset())

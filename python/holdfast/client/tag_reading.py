"""Reads tags: neighbours in one request, and a refused block costs only its own tags."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from holdfast._core import RETRY_REFUSED_AFTER_S, plan_blocks
from holdfast.client.requests import carry_out, carry_out_async
from holdfast.errors import (
    ConnectFailed,
    ConnectionLost,
    InvalidResponse,
    ModbusError,
    ModbusException,
    RequestTimeout,
    TlsFailed,
)
from holdfast.protocol import GATEWAY_FAILURES, ILLEGAL_ADDRESS, ILLEGAL_VALUE, READ_LIMITS
from holdfast.tags.decoding import Decoder, Undecoded, decoder, packed
from holdfast.types import BIT_AREAS
from holdfast.values import ConversionError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Generator, Iterable, Sequence

    from holdfast.client import SyncClient
    from holdfast.tags import Tag
    from holdfast.types import Area

MAX_UNANSWERED = 3
"""Requests in a row without an answer that end a reading: a device that is off does not cost a
timeout for each block."""

RETRY_ONE_AFTER_S = 10
"""Seconds after a refusal, and between tries of what stays refused."""

ILLEGAL = (ILLEGAL_ADDRESS, ILLEGAL_VALUE)
"""Exceptions that depend on the request, not on the state of the device."""

Error: TypeAlias = ModbusError | ConversionError
Result = TypeVar("Result")
Steps: TypeAlias = "Generator[_Block, bytes, Result]"
Fetch: TypeAlias = "Callable[[Area, int, str], Awaitable[list[Any]]]"


@dataclass(frozen=True)
class Reading:
    """What was read of a tag."""

    tag: Tag
    value: Any = None
    """The value; `None` without one, also if the device says that it has none."""
    error: Error | None = None
    """Why nothing was read."""


@dataclass
class _Block:
    """One request, or several for an array that exceeds one. It has whole fields."""

    area: Area
    address: int
    count: int
    fields: list[_Field]
    decode: Decoder
    kind: str
    """The type to read it as: an array, whose elements are each from one request."""
    requested_in: int = 0
    """The number of the last reading that requested it; 0 is none."""
    answered: bool = True
    refused: ModbusException | None = None

    @property
    def rank(self) -> tuple[int, int]:
        """Blocks that answered come first, then new ones and those refused for longest, then those
        silent for longest.
        """
        if self.refused or not self.requested_in:
            return 1, self.requested_in
        return (0, 0) if self.answered else (2, self.requested_in)


@dataclass
class _Field:
    """A range of addresses, and the indexes of its tags."""

    area: Area
    address: int
    count: int
    tags: list[int] = field(default_factory=list)


class TagReader:
    """Reads tags, and remembers what the device refuses.

    Some time later, a reading tries again what has been refused for longest, and goes on to the
    next as long as it gets values. So what a device has again is soon read, and what it does not
    have costs few requests: some devices close the connection, or are silent, after a refusal.

    Gaps of up to `max_gap` registers or bits between tags are read with them.
    """

    def __init__(
        self,
        tags: Iterable[Tag],
        *,
        max_gap: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.tags = tuple(tags)
        self._max_gap = max_gap
        self._clock = clock
        self._number = 0
        self._readings: dict[int, Reading] = {}
        self._blocks: list[_Block] = []
        self._planned = 0.0
        self._retry_at = 0.0
        self._is_as_planned = False
        """Whether nothing has been refused, so that the blocks are still those of the plan."""

    @property
    def requests(self) -> list[tuple[Area, int, int]]:
        """The blocks of the next reading: area, address, count."""
        self._plan()
        return [(block.area, block.address, block.count) for block in self._blocks]

    def read(
        self, client: SyncClient, between: Callable[[], object] = lambda: None
    ) -> list[Reading]:
        """Reads all tags, in their order. `between` is called after every request.

        A device that does not answer three requests in a row is not asked any further.
        """

        def answer(block: _Block) -> bytes:
            try:
                return _joined(block, client.read(block.area, block.address, block.kind))
            finally:
                between()

        return carry_out(self._steps(), answer)

    async def read_with(self, fetch: Fetch) -> list[Reading]:
        """As `read`, but `fetch` returns what a client reads of area, address and type."""

        async def answer(block: _Block) -> bytes:
            return _joined(block, await fetch(block.area, block.address, block.kind))

        return await carry_out_async(self._steps(), answer)

    def _steps(self) -> Steps[list[Reading]]:
        """Reads all tags: yields what to request, and takes the bytes of the reply."""
        self._plan()
        self._number += 1
        self._readings = {}
        silent = 0
        retries_refused = self._clock() >= self._retry_at
        ended: ModbusError | None = None
        blocks: list[_Block] = []
        for block in sorted(self._blocks, key=lambda each: each.rank):
            is_retry = block.refused is not None
            failure = ended
            if is_retry and (silent or not retries_refused):
                failure = block.refused
            if failure is not None:
                self._fail(block, failure)
                blocks.append(block)
                continue
            replacements, error = yield from self._request(block)
            blocks += replacements
            if is_retry and block.refused is not None:
                retries_refused = False
                self._retry_at = self._clock() + RETRY_ONE_AFTER_S
            if error is None:
                silent = 0
                continue
            silent += 1
            if silent == MAX_UNANSWERED or isinstance(error, ConnectFailed | TlsFailed):
                ended = error
        self._blocks = sorted(blocks, key=lambda each: (each.area, each.address))
        return [self._readings[index] for index in range(len(self.tags))]

    def _plan(self) -> None:
        """Makes blocks of all tags, at first and some time after a refusal."""
        now = self._clock()
        if self._blocks and (self._is_as_planned or now - self._planned < RETRY_REFUSED_AFTER_S):
            return
        self._planned, self._is_as_planned = now, True
        self._retry_at = now + RETRY_ONE_AFTER_S
        fields: dict[tuple[Area, int, int], _Field] = {}
        for index, tag in enumerate(self.tags):
            place = tag.area, tag.span.start, len(tag.span)
            fields.setdefault(place, _Field(*place)).tags.append(index)
        short: list[_Field] = []
        long: list[_Field] = []
        for each in fields.values():
            (short if each.count <= READ_LIMITS[each.area] else long).append(each)
        planned = plan_blocks(
            [(each.area, each.address, each.count) for each in short], max_gap=self._max_gap
        )
        self._blocks = [self._block([short[at] for at in inside]) for _, _, _, inside, _ in planned]
        self._blocks += [self._block([each]) for each in long]

    def _block(self, fields: Sequence[_Field]) -> _Block:
        found = sorted(fields, key=lambda each: each.address)
        address = found[0].address
        count = max(each.address + each.count for each in found) - address
        tags = [self.tags[index] for each in found for index in each.tags]
        area, decode = found[0].area, decoder(tags, address, count)
        return _Block(area, address, count, found, decode, _kind(area, count, tags))

    def _request(self, block: _Block) -> Steps[tuple[list[_Block], ModbusError | None]]:
        """Reads a block. Returns the blocks that replace it, and the error of a silent device."""
        block.requested_in = self._number
        try:
            data = yield block
        except ModbusError as error:
            if isinstance(error, ModbusException) and (error.code in ILLEGAL or block.refused):
                self._is_as_planned = False
                if len(block.fields) > 1:
                    return (yield from self._bisect(block))
                block.refused = error
            self._fail(block, error)
            block.answered = not _is_silence(error)
            return [block], None if block.answered else error
        block.answered, block.refused = True, None
        self._decode(block, data)
        return [block], None

    def _bisect(self, block: _Block) -> Steps[tuple[list[_Block], ModbusError | None]]:
        """Reads the halves of a refused block; the second only if the device still answers."""
        middle = len(block.fields) // 2
        first, second = self._block(block.fields[:middle]), self._block(block.fields[middle:])
        blocks, error = yield from self._request(first)
        if error is not None:
            self._fail(second, error)
            return [*blocks, second], error
        others, error = yield from self._request(second)
        return blocks + others, error

    def _decode(self, block: _Block, data: bytes) -> None:
        indexes = [index for each in block.fields for index in each.tags]
        for index, raw in zip(indexes, block.decode(data), strict=True):
            tag = self.tags[index]
            if isinstance(raw, Undecoded):
                self._readings[index] = Reading(tag, error=ConversionError(raw.error))
            else:
                self._readings[index] = Reading(tag, tag.value(raw))

    def _fail(self, block: _Block, error: ModbusError) -> None:
        for each in block.fields:
            for index in each.tags:
                self._readings[index] = Reading(self.tags[index], error=error)


def _kind(area: Area, count: int, tags: Sequence[Tag]) -> str:
    """The type to read a block as: numbers of its tags are each from one request."""
    if area in BIT_AREAS:
        return f"bool[{count}]"
    size, most = 2 * count, 2 * READ_LIMITS[area]
    if size > most:
        # The block is one range, with arrays of its whole length.
        size = math.lcm(*(tag.of_type.width for tag in tags))
    if size > most:
        # Texts do not fit into a request together, and are cut.
        size = math.lcm(2, *(tag.of_type.width for tag in tags if tag.of_type.is_number))
    return f"bytes:{size}[{2 * count // size}]"


def _joined(block: _Block, read: list[Any]) -> bytes:
    """The bytes of a block, as in a Modbus reply."""
    return packed(read) if block.area in BIT_AREAS else b"".join(read)


def _is_silence(error: ModbusError) -> bool:
    """Whether the device did not answer, so that more requests would likely wait in vain."""
    if isinstance(error, ModbusException):
        return error.code in GATEWAY_FAILURES
    return isinstance(error, ConnectionLost | RequestTimeout | InvalidResponse)

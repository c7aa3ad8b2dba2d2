"""Finds the addresses of a device by reading, with few requests.

An address exists if a read that covers it succeeds, and does not exist if a read of it alone
returns exception 02. Other exceptions, timeouts and invalid replies are listed separately.

The fast search reads samples, then the range around each existing sample to both ends, in blocks
that double after a success and are halved after a failure. It reads every address of a range that
it reports; it misses a range without a sample. The exact search reads every address, in blocks
where addresses exist, one by one elsewhere.

If a block fails, but all its parts can be read, it was too large: blocks then stay smaller.
"""

from __future__ import annotations

import bisect
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, TypeAlias, TypeVar

from holdfast.errors import ConnectionLost, InvalidResponse, ModbusError, ModbusException
from holdfast.protocol import (
    ADDRESSES,
    BUSY,
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    LAST_ADDRESS,
    READ_LIMITS,
)
from holdfast.types import AREAS, BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.client import Client, SyncClient
    from holdfast.types import Area

STEP = 256
"""Distance between two samples."""

CLOSER = (1, 2, 4, 8, 16, 32, 64)
"""Distances after the end of a range at which to search for the next range."""

GIVE_UP = 5
"""Skip an area if this many samples across it fail in the same way, other than with 02."""

NO_ANSWER = 2
"""Stop after this many addresses without a reply if the device has never replied."""

SILENT_READS = 8
"""After this many reads without a reply, repeat a read that had one, to check the device."""

Failure: TypeAlias = int | Literal["timeout", "connection", "invalid"]
"""Why a read failed: an exception code, or a word."""

Outcome: TypeAlias = Failure | None
"""The result of a read; `None` is success."""

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Probe:
    """A read of an area."""

    area: Area
    address: int
    count: int


Steps: TypeAlias = Generator[Probe, Outcome, Result]


class DeviceSilent(ModbusError):
    """The device has stopped answering; the survey has the results so far."""


@dataclass
class AreaMap:
    """The results for an area."""

    area: Area
    ranges: list[range] = field(default_factory=list)
    """The existing addresses, sorted; ranges are never adjacent."""
    failures: dict[Failure, list[range]] = field(default_factory=dict)
    """The addresses that failed other than with exception 02, by failure."""
    requests: int = 0
    given_up: Failure | None = None
    """Why the rest of the area was skipped; `None` if it was not."""
    largest: int = 0
    """The largest number of addresses that one read returned."""

    @property
    def addresses(self) -> int:
        """How many addresses exist."""
        return sum(map(len, self.ranges))

    def found(self, first: int, count: int) -> None:
        """Records existing addresses."""
        _add(self.ranges, first, count)

    def failed(self, address: int, failure: Failure) -> None:
        """Records an address that could not be read, and why."""
        if failure != ILLEGAL_ADDRESS:
            _add(self.failures.setdefault(failure, []), address, 1)


class Survey:
    """A search for the addresses of a device. Run it with `run` or `run_sync`.

    Searches `areas` within `span`. With `exact`, reads every address; otherwise, reads samples at
    every `step` addresses and at common start addresses. One read is for at most `max_quantity`
    bits or registers, and never more than the standard allows.
    """

    def __init__(
        self,
        areas: Sequence[Area] = AREAS,
        *,
        exact: bool = False,
        max_quantity: int | None = None,
        step: int = STEP,
        span: range = range(ADDRESSES),
    ) -> None:
        if max_quantity is not None and max_quantity < 1:
            raise ValueError(f"max_quantity is {max_quantity}, allowed: 1 or more")
        if step < 1:
            raise ValueError(f"step is {step}, allowed: 1 or more")
        if span.step != 1 or not 0 <= span.start < span.stop <= ADDRESSES:
            raise ValueError(f"span is {span}, allowed: inside 0 to {LAST_ADDRESS}")
        self.span = span
        self.exact = exact
        self.areas = [AreaMap(area) for area in areas]
        self.at = 0
        """How many addresses of all areas are done."""
        self.texts: dict[Failure, str] = {}
        """The first error message of each failure."""
        self.max_quantity = max_quantity
        self._step = step
        self._answered: Probe | None = None
        self._unanswered = 0

    @property
    def total(self) -> int:
        """How many addresses of all areas to search."""
        return len(self.areas) * len(self.span)

    @property
    def requests(self) -> int:
        """How many requests were sent."""
        return sum(found.requests for found in self.areas)

    def steps(self) -> Steps[None]:
        """Yields the reads one by one; send the outcome of each."""
        for index, found in enumerate(self.areas):
            search = _Search(self, found, index * len(self.span))
            yield from search.exact() if self.exact else search.fast(self._samples())
            self.at = (index + 1) * len(self.span)

    def read(self, found: AreaMap, probe: Probe) -> Steps[Outcome]:
        """Runs a read; repeats it once if there was no reply or the device was busy."""
        outcome = yield probe
        found.requests += 1
        if outcome == BUSY or isinstance(outcome, str):
            outcome = yield probe
            found.requests += 1
        if not isinstance(outcome, str):
            self._answered, self._unanswered = probe, 0
        else:
            self._unanswered += 1
            if self._answered is None and self._unanswered == NO_ANSWER:
                raise DeviceSilent(f"no answer to {self.requests} reads")
            if self._unanswered % SILENT_READS == 0:
                yield from self._look_whether_it_is_there(found)
        if outcome is None:
            found.largest = max(found.largest, probe.count)
        return outcome

    def _look_whether_it_is_there(self, found: AreaMap) -> Steps[None]:
        assert self._answered is not None
        for _ in range(2):
            outcome = yield self._answered
            found.requests += 1
            if not isinstance(outcome, str):
                return
        raise DeviceSilent("the device stopped answering")

    def _samples(self) -> list[int]:
        """The addresses of samples: evenly spaced, and common start addresses."""
        thousands = range(1000, ADDRESSES, 1000)
        likely = {1, 10, 20, *range(0, 10000, 50), *thousands, *(each + 1 for each in thousands)}
        first, stop = self.span.start, self.span.stop
        spread = set(range(first, stop, self._step))
        return sorted(spread | {stop - 1} | {each for each in likely if first <= each < stop})


class _Search:
    """The search in one area; `base` is the progress of the survey before it."""

    def __init__(self, survey: Survey, found: AreaMap, base: int) -> None:
        limit = READ_LIMITS[found.area]
        self._survey = survey
        self._found = found
        self._limit = min(limit, survey.max_quantity or limit)
        self._first = survey.span.start
        self._stop = survey.span.stop
        self._base = base - self._first
        self._failures: dict[int, Failure] = {}
        """The failure of each address that was read alone and failed."""
        self._places: list[int] = []
        """The same addresses, sorted."""

    def exact(self) -> Steps[None]:
        """Reads every address: ranges in blocks, other addresses one by one."""
        at = self._first
        while at < self._stop:
            self._survey.at = self._base + at
            at = yield from self._follow(at, self._stop)
            if at == self._first and self._failures.get(at) == ILLEGAL_FUNCTION:
                self._found.given_up = ILLEGAL_FUNCTION
                return
            at += 1

    def fast(self, samples: Sequence[int]) -> Steps[None]:
        """Finds the ranges around samples, and ranges close after another range."""
        end = self._first
        for sample in samples:
            self._survey.at = self._base + max(sample, end)
            if sample < end or sample in self._failures:
                continue
            hit = yield from self._first_hit([sample])
            if sample == samples[0] and hit is None:
                self._found.given_up = yield from self._hopeless(samples)
                if self._found.given_up is not None:
                    return
            while hit is not None:
                yield from self._follow_back(hit - 1, self._floor(hit))
                end = yield from self._follow(hit + 1, self._stop)
                hit = yield from self._first_hit([end + far for far in CLOSER])

    def _hopeless(self, samples: Sequence[int]) -> Steps[Outcome]:
        """The failure of the whole area, if distant samples fail like the first; else `None`."""
        failure = self._failures[samples[0]]
        if failure in (ILLEGAL_ADDRESS, ILLEGAL_FUNCTION):
            return None if failure == ILLEGAL_ADDRESS else failure
        last = len(samples) - 1
        for index in {last * part // (GIVE_UP - 1) for part in range(1, GIVE_UP)}:
            yield from self._first_hit([samples[index]])
            if self._failures.get(samples[index]) != failure:
                return None
        return failure

    def _first_hit(self, addresses: Iterable[int]) -> Steps[int | None]:
        """The first existing address."""
        for address in addresses:
            if address >= self._stop or address in self._failures:
                continue
            if (yield from self._read(address, 1)) is None:
                return address
        return None

    def _floor(self, address: int) -> int:
        """The lowest address that can be in the same range as an existing address."""
        at = bisect.bisect(self._places, address)
        return self._places[at - 1] + 1 if at else self._first

    def _follow(self, at: int, stop: int) -> Steps[int]:
        """Reads from `at` up to `stop`. Returns the first address that fails, or `stop`."""
        pace = _Pace(self._limit, self._found)
        while at < stop:
            count = min(pace.count, stop - at)
            outcome = yield from self._read(at, count)
            if outcome is None:
                at += count
                self._survey.at = self._base + at
            elif count == 1:
                break
            self._limit = pace.changed(count, outcome)
        return at

    def _follow_back(self, at: int, floor: int) -> Steps[None]:
        """Reads from `at` down to the first address that fails, or to `floor`."""
        pace = _Pace(self._limit, self._found)
        while at >= floor:
            count = min(pace.count, at + 1 - floor)
            outcome = yield from self._read(at + 1 - count, count)
            if outcome is None:
                at -= count
            elif count == 1:
                break
            self._limit = pace.changed(count, outcome)

    def _read(self, address: int, count: int) -> Steps[Outcome]:
        """Reads, and records the result for the addresses."""
        outcome = yield from self._survey.read(self._found, Probe(self._found.area, address, count))
        if outcome is None:
            self._found.found(address, count)
        elif count == 1:
            self._failures[address] = outcome
            bisect.insort(self._places, address)
            self._found.failed(address, outcome)
        return outcome


class _Pace:
    """The size of the next read: doubled after a success, half of the rest after a failure.

    After a failure, the block should contain an address that can't be read. If it does not, the
    block was too large.
    """

    def __init__(self, limit: int, found: AreaMap) -> None:
        self.limit = limit
        self.count = 1
        self._found = found
        self._suspect: int | None = None
        """The number of next addresses of which at least one should be unreadable."""

    def changed(self, count: int, outcome: Outcome) -> int:
        """Adapts the size after a read. Returns the new limit."""
        if outcome is not None:
            self._suspect = count
            self.count = count // 2
        elif self._suspect is None:
            self.count = min(2 * count, self.limit)
        elif self._suspect > count:
            self._suspect -= count
            self.count = max(1, self._suspect // 2)
        else:
            self._suspect = None
            self.count = self.limit = min(self.limit, self._found.largest)
        return self.limit


def run_sync(
    survey: Survey, client: SyncClient, progress: Callable[[Survey], object] | None = None
) -> None:
    """Runs a survey; calls `progress` before every read. Raises `DeviceSilent`."""
    steps = survey.steps()
    try:
        probe = next(steps)
        while True:
            if progress is not None:
                progress(survey)
            try:
                client.read(probe.area, probe.address, _kind(probe))
            except ModbusError as error:
                probe = steps.send(_failure(error, survey))
            else:
                probe = steps.send(None)
    except StopIteration:
        pass


async def run(
    survey: Survey, client: Client, progress: Callable[[Survey], object] | None = None
) -> None:
    """Runs a survey; calls `progress` before every read. Raises `DeviceSilent`."""
    steps = survey.steps()
    try:
        probe = next(steps)
        while True:
            if progress is not None:
                progress(survey)
            try:
                await client.read(probe.area, probe.address, _kind(probe))
            except ModbusError as error:
                probe = steps.send(_failure(error, survey))
            else:
                probe = steps.send(None)
    except StopIteration:
        pass


def _kind(probe: Probe) -> str:
    return f"{'bool' if probe.area in BIT_AREAS else 'uint16'}[{probe.count}]"


def _failure(error: ModbusError, survey: Survey) -> Failure:
    """The failure of a read. Raises the error if the first connection already fails."""
    failure: Failure = "timeout"
    if isinstance(error, ModbusException):
        failure = error.code
    elif isinstance(error, InvalidResponse):
        failure = "invalid"
    elif isinstance(error, ConnectionLost):
        if survey.requests == 0:
            raise error
        failure = "connection"
    survey.texts.setdefault(failure, str(error))
    return failure


def _add(ranges: list[range], first: int, count: int) -> None:
    """Adds addresses to sorted ranges, and joins adjacent ranges."""
    stop = first + count
    begin = bisect.bisect_left(ranges, first, key=lambda each: each.stop)
    end = bisect.bisect_right(ranges, stop, key=lambda each: each.start)
    if begin < end:
        first, stop = min(first, ranges[begin].start), max(stop, ranges[end - 1].stop)
    ranges[begin:end] = [range(first, stop)]

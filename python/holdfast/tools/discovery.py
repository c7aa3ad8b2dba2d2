"""Which addresses a device has: found by reading, with few requests.

An address is there if a read that covers it succeeds, and outside if a read of it alone is answered
with exception 02. Everything else is told apart: other exceptions, silence, replies that are none.

Fast, a number of addresses are read as samples, and from each that is there the range around it is
followed to both ends, in blocks that double and are halved where a read fails. Every address of a
range that is found has been read; a range that holds no sample is missed. Exact, every address is
read, in blocks where they are, one by one where they are not.

A block that fails although all of it can be read in parts was too large: blocks stay smaller then.
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
"""Addresses between two samples."""

CLOSER = (1, 2, 4, 8, 16, 32, 64)
"""How far behind the end of a range the next one is looked for."""

GIVE_UP = 5
"""So many samples all over an area with one and the same failure, other than 02, are enough."""

NO_ANSWER = 2
"""So many addresses without a reply, when there has never been one, are enough of a device."""

SILENT_READS = 8
"""After so many reads without a reply, one that had a reply is repeated: is the device there?"""

Failure: TypeAlias = int | Literal["timeout", "connection", "invalid"]
"""Why a read failed: an exception code, or what else."""

Outcome: TypeAlias = Failure | None
"""How a read ended; `None` is well."""

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Probe:
    """A read of an area."""

    area: Area
    address: int
    count: int


Steps: TypeAlias = Generator[Probe, Outcome, Result]


class DeviceSilent(ModbusError):
    """The device has ceased to answer; what was found until then is in the survey."""


@dataclass
class AreaMap:
    """What is known of an area."""

    area: Area
    ranges: list[range] = field(default_factory=list)
    """The addresses that are there, in order; ranges do not touch."""
    failures: dict[Failure, list[range]] = field(default_factory=dict)
    """The addresses that failed otherwise than as outside, by how."""
    requests: int = 0
    given_up: Failure | None = None
    """Why the rest of the area was not looked at, if it wasn't."""
    largest: int = 0
    """The most addresses that one read returned."""

    @property
    def addresses(self) -> int:
        """How many addresses are there."""
        return sum(map(len, self.ranges))

    def found(self, first: int, count: int) -> None:
        """Notes that addresses are there."""
        _add(self.ranges, first, count)

    def failed(self, address: int, failure: Failure) -> None:
        """Notes that an address could not be read, and why."""
        if failure != ILLEGAL_ADDRESS:
            _add(self.failures.setdefault(failure, []), address, 1)


class Survey:
    """The search for the addresses of a device, to be carried out by `run` or `run_sync`.

    `areas` are looked at within `span`. `exact` reads every address; otherwise samples are read
    every `step` addresses, and where devices like to begin their ranges. No read is for more than
    `max_quantity` bits or registers, nor for more than the standard allows.
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
            raise ValueError(f"max_quantity is {max_quantity}, allowed are 1 and more")
        if step < 1:
            raise ValueError(f"step is {step}, allowed are 1 and more")
        if span.step != 1 or not 0 <= span.start < span.stop <= ADDRESSES:
            raise ValueError(f"span is {span}, allowed are 0 to {LAST_ADDRESS}")
        self.span = span
        self.exact = exact
        self.areas = [AreaMap(area) for area in areas]
        self.at = 0
        """How many addresses of all areas have been dealt with."""
        self.texts: dict[Failure, str] = {}
        """Failures in words, as the device or the connection told them first."""
        self.max_quantity = max_quantity
        self._step = step
        self._answered: Probe | None = None
        self._unanswered = 0

    @property
    def total(self) -> int:
        """How many addresses of all areas there are to deal with."""
        return len(self.areas) * len(self.span)

    @property
    def requests(self) -> int:
        """How many requests were sent."""
        return sum(found.requests for found in self.areas)

    def steps(self) -> Steps[None]:
        """The reads, one after the other; each is to be answered with how it ended."""
        for index, found in enumerate(self.areas):
            search = _Search(self, found, index * len(self.span))
            yield from search.exact() if self.exact else search.fast(self._samples())
            self.at = (index + 1) * len(self.span)

    def read(self, found: AreaMap, probe: Probe) -> Steps[Outcome]:
        """A read; again if it was lost or the device was busy."""
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
        raise DeviceSilent("the device has ceased to answer")

    def _samples(self) -> list[int]:
        """Addresses to look at: evenly spread, and where ranges like to begin."""
        thousands = range(1000, ADDRESSES, 1000)
        likely = {1, 10, 20, *range(0, 10000, 50), *thousands, *(each + 1 for each in thousands)}
        first, stop = self.span.start, self.span.stop
        spread = set(range(first, stop, self._step))
        return sorted(spread | {stop - 1} | {each for each in likely if first <= each < stop})


class _Search:
    """The search in one area; `base` is what of the survey lies before it."""

    def __init__(self, survey: Survey, found: AreaMap, base: int) -> None:
        limit = READ_LIMITS[found.area]
        self._survey = survey
        self._found = found
        self._limit = min(limit, survey.max_quantity or limit)
        self._first = survey.span.start
        self._stop = survey.span.stop
        self._base = base - self._first
        self._failures: dict[int, Failure] = {}
        """Addresses that were read alone and failed, and how."""
        self._places: list[int] = []
        """The same addresses in order."""

    def exact(self) -> Steps[None]:
        """Every address: follows ranges, and asks one by one where there are none."""
        at = self._first
        while at < self._stop:
            self._survey.at = self._base + at
            at = yield from self._follow(at, self._stop)
            if at == self._first and self._failures.get(at) == ILLEGAL_FUNCTION:
                self._found.given_up = ILLEGAL_FUNCTION
                return
            at += 1

    def fast(self, samples: Sequence[int]) -> Steps[None]:
        """The ranges around samples, and those close behind a range."""
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
        """Whether the area as a whole fails: as its first sample did, so do some others afar."""
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
        """The first address that is there, and was not found yet."""
        for address in addresses:
            if address >= self._stop or address in self._failures:
                continue
            if (yield from self._read(address, 1)) is None:
                return address
        return None

    def _floor(self, address: int) -> int:
        """The least address that may belong to the range of one that is there."""
        at = bisect.bisect(self._places, address)
        return self._places[at - 1] + 1 if at else self._first

    def _follow(self, at: int, stop: int) -> Steps[int]:
        """Reads from `at` up to `stop`; the first address that fails, or `stop`."""
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
        """Reads, and notes what that says of the addresses."""
        outcome = yield from self._survey.read(self._found, Probe(self._found.area, address, count))
        if outcome is None:
            self._found.found(address, count)
        elif count == 1:
            self._failures[address] = outcome
            bisect.insort(self._places, address)
            self._found.failed(address, outcome)
        return outcome


class _Pace:
    """How much to read next: twice as much after a success, half of what is left after a failure.

    A failure means that somewhere in that block is an address that can't be read. If there turns
    out to be none, the block was too large.
    """

    def __init__(self, limit: int, found: AreaMap) -> None:
        self.limit = limit
        self.count = 1
        self._found = found
        self._suspect: int | None = None
        """How many addresses ahead there must be one that can't be read."""

    def changed(self, count: int, outcome: Outcome) -> int:
        """Draws the conclusions from a read; the limit from now on."""
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
    """Carries a survey out; `progress` is called before every read. Raises `DeviceSilent`."""
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
    """Carries a survey out; `progress` is called before every read. Raises `DeviceSilent`."""
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
    """How a read failed. A device that can't be connected to at all is an error of its own."""
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
    """Adds addresses to ranges in order, which do not touch."""
    stop = first + count
    begin = bisect.bisect_left(ranges, first, key=lambda each: each.stop)
    end = bisect.bisect_right(ranges, stop, key=lambda each: each.start)
    if begin < end:
        first, stop = min(first, ranges[begin].start), max(stop, ranges[end - 1].stop)
    ranges[begin:end] = [range(first, stop)]

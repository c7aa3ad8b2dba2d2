"""Finds the addresses of a device by reading, with few requests.

An address exists if a read that covers it succeeds, and is absent if a read of it alone returns
exception 02. Other exceptions, timeouts and invalid replies are listed separately. About all other
addresses nothing is known: they were not asked.

The fast search reads samples (`sample_places`), then the range around each existing sample to both
ends, in blocks that double after a success and are halved after a failure. It reads every address
of a range that it reports; it misses a range without a sample. The exact search reads every
address, in blocks where addresses exist, one by one elsewhere.

If a block fails, but all its parts can be read, it was too large: blocks then stay smaller.
"""

from __future__ import annotations

import bisect
import time
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
"""Distance between two samples where nothing is usual."""

FIRST = 16
"""All of the first addresses are samples."""

NEAR, NEAR_STEP, FAR_STEP = 10_000, 10, 100
"""Samples are `NEAR_STEP` apart below `NEAR`, and `FAR_STEP` apart above."""

NUMBERED = (range(30_000, 31_000), range(40_000, 41_000))
"""Where devices have maps at the numbers of their manuals; samples are `NEAR_STEP` apart."""

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

State: TypeAlias = Literal["searched", "partly", "given_up", "not_asked"]

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Probe:
    """A read of an area."""

    area: Area
    address: int
    count: int


Steps: TypeAlias = Generator[Probe, Outcome, Result]


class Unfinished(ModbusError):
    """The survey ended early; it has the results so far."""


class DeviceSilent(Unfinished):
    """The device has stopped answering."""


class LimitReached(Unfinished):
    """The survey has sent as many requests as it may."""


@dataclass
class AreaMap:
    """The results for an area."""

    area: Area
    ranges: list[range] = field(default_factory=list)
    """The existing addresses, sorted; ranges are never adjacent."""
    absent: list[range] = field(default_factory=list)
    """The addresses that were read alone and returned exception 02, sorted."""
    failures: dict[Failure, list[range]] = field(default_factory=dict)
    """The addresses that failed other than with exception 02, by failure."""
    requests: int = 0
    reached: int | None = None
    """The address below which the area was searched; `None` before its search."""
    is_done: bool = False
    """Whether the search of the area is complete."""
    given_up: Failure | None = None
    """Why the rest of the area was skipped; `None` if it was not."""
    largest: int = 0
    """The largest number of addresses that one read returned."""

    @property
    def addresses(self) -> int:
        """How many addresses exist."""
        return sum(map(len, self.ranges))

    @property
    def asked(self) -> int:
        """How many addresses were read alone, or exist."""
        refused = [self.absent, *self.failures.values()]
        return self.addresses + sum(len(each) for ranges in refused for each in ranges)

    @property
    def state(self) -> State:
        """How far the search of the area came."""
        if self.reached is None or not self.requests:
            return "not_asked"
        if self.given_up is not None:
            return "given_up"
        return "searched" if self.is_done else "partly"

    def found(self, first: int, count: int) -> None:
        """Records existing addresses."""
        _add(self.ranges, first, count)

    def failed(self, address: int, failure: Failure) -> None:
        """Records an address that could not be read, and why."""
        absent = failure == ILLEGAL_ADDRESS
        _add(self.absent if absent else self.failures.setdefault(failure, []), address, 1)


class Survey:
    """A search for the addresses of a device. Run it with `run` or `run_sync`.

    Searches `areas` within `span`. With `exact`, reads every address; otherwise, reads samples at
    every `step` addresses and at usual start addresses; fewer of them if not `dense`. One read is
    for at most `max_quantity` bits or registers, and never more than the standard allows. Sends at
    most `max_requests`.
    """

    def __init__(
        self,
        areas: Sequence[Area] = AREAS,
        *,
        exact: bool = False,
        max_quantity: int | None = None,
        step: int = STEP,
        span: range = range(ADDRESSES),
        dense: bool = True,
        max_requests: int | None = None,
    ) -> None:
        if max_quantity is not None and max_quantity < 1:
            raise ValueError(f"max_quantity is {max_quantity}, allowed: 1 or more")
        if step < 1:
            raise ValueError(f"step is {step}, allowed: 1 or more")
        if max_requests is not None and max_requests < 1:
            raise ValueError(f"max_requests is {max_requests}, allowed: 1 or more")
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
        self.max_requests = max_requests
        self.samples = [] if exact else sample_places(span, step, dense=dense)
        """The addresses that a fast search reads in each area."""
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

    @property
    def is_done(self) -> bool:
        """Whether the search is complete."""
        return all(found.is_done for found in self.areas)

    @property
    def absent_costs(self) -> int:
        """How many requests the search takes on a device without any address."""
        return len(self.areas) * (len(self.span) if self.exact else len(self.samples))

    def steps(self) -> Steps[None]:
        """Yields the reads one by one; send the outcome of each."""
        for index, found in enumerate(self.areas):
            search = _Search(self, found, index * len(self.span))
            yield from search.exact() if self.exact else search.fast(self.samples)
            self.at = (index + 1) * len(self.span)
            found.reached = self.span.stop
            found.is_done = True

    def read(self, found: AreaMap, probe: Probe) -> Steps[Outcome]:
        """Runs a read; repeats it once if there was no reply or the device was busy."""
        outcome = yield from self._ask(found, probe)
        if outcome == BUSY or isinstance(outcome, str):
            outcome = yield from self._ask(found, probe)
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

    def _ask(self, found: AreaMap, probe: Probe) -> Steps[Outcome]:
        """Sends a request, if that is allowed."""
        if self.requests == self.max_requests:
            raise LimitReached(f"stopped after {self.requests} requests")
        outcome = yield probe
        found.requests += 1
        return outcome

    def _look_whether_it_is_there(self, found: AreaMap) -> Steps[None]:
        assert self._answered is not None
        for _ in range(2):
            outcome = yield from self._ask(found, self._answered)
            if not isinstance(outcome, str):
                return
        raise DeviceSilent("the device stopped answering")


def sample_places(span: range, step: int = STEP, *, dense: bool = True) -> list[int]:
    """The addresses of samples: usual start addresses, and every `step` addresses.

    Usual are the first 16, multiples of 10 and 100, the addresses after a multiple of 100 for maps
    that count from 1, and maps at the numbers of manuals (30001, 40001). Without `dense`, fewer.
    """
    near, far = (NEAR_STEP, FAR_STEP) if dense else (50, 1000)
    ones = range(1, NEAR, FAR_STEP if dense else 1000)
    usual = {*range(0, NEAR, near), *ones, *range(FIRST if dense else 2), 10, 20}
    usual.update(range(NEAR, ADDRESSES, far), range(NEAR + 1, ADDRESSES, 1000))
    if dense:
        for numbered in NUMBERED:
            usual.update(range(numbered.start, numbered.stop, NEAR_STEP))
            usual.update(range(numbered.start + 1, numbered.stop, FAR_STEP))
    spread = range(span.start, span.stop, step)
    return sorted({*spread, span.stop - 1, *(each for each in usual if each in span)})


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
            self._reached(at)
            at = yield from self._follow(at, self._stop)
            if at == self._first and self._failures.get(at) == ILLEGAL_FUNCTION:
                self._found.given_up = ILLEGAL_FUNCTION
                return
            at += 1

    def fast(self, samples: Sequence[int]) -> Steps[None]:
        """Finds the ranges around samples, and ranges close after another range."""
        end = self._first
        for sample in samples:
            self._reached(max(sample, end))
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

    def _reached(self, address: int) -> None:
        self._found.reached = address
        self._survey.at = self._base + address

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
                self._reached(at)
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
    survey: Survey,
    client: SyncClient,
    progress: Callable[[Survey], object] | None = None,
    *,
    delay: float = 0.0,
) -> None:
    """Runs a survey; calls `progress` before every read, and waits `delay` seconds between two.

    Raises `Unfinished`.
    """
    steps = survey.steps()
    try:
        probe = next(steps)
        while True:
            if progress is not None:
                progress(survey)
            if delay and survey.requests:
                time.sleep(delay)
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
    """Runs a survey; calls `progress` before every read. Raises `Unfinished`."""
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

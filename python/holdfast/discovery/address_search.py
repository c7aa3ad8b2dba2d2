"""Finds the addresses of a device by reading, with few requests.

An address exists if a read that covers it succeeds, and is absent if a read of it alone returns
exception 02. Other exceptions, timeouts and invalid replies are listed separately. About all other
addresses nothing is known: they were not asked.

The fast search reads samples (`sample_places`), and the range around each existing sample to both
ends, in blocks that double after a success and are halved after a failure. It reads every address
of a range that it reports; it misses a range without a sample. The exact search reads every
address, in blocks where addresses exist, one by one elsewhere.

Both begin where people look first: with the registers at `USUAL_STARTS`. Then come the other
registers, and then coils and discrete inputs in the same way.

If a block fails, but all its parts can be read, it was too large: blocks then stay smaller.

Some devices refuse to read a part of a value. If no register of an area can be read alone, two and
then four registers are read at some places; the exact search reads them at all samples, and at the
addresses after those. If such a read succeeds, the area is searched again in reads of that size; an
address is then absent if the read that begins there returns exception 02.
"""

from __future__ import annotations

import bisect
import time
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias, TypeVar

from holdfast.client.requests import REFUSALS, carry_out, carry_out_async
from holdfast.errors import ConnectionLost, InvalidResponse, ModbusError, ModbusException
from holdfast.protocol import (
    ADDRESSES,
    BUSY,
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    ILLEGAL_VALUE,
    LAST_ADDRESS,
    READ_LIMITS,
)
from holdfast.types import AREAS, BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from holdfast.types import Area

STEP = 256
"""Distance between two samples where nothing is usual."""

FIRST_ADDRESSES = 16
"""All of the first addresses are samples."""

NEAR, NEAR_STEP, FAR_STEP = 10_000, 10, 100
"""Samples are `NEAR_STEP` apart below `NEAR`, and `FAR_STEP` apart above.

Each of them costs a request where nothing exists, and no other read can replace it: a block that
contains an absent address is refused, whatever else it contains. `benches/address_search.py` shows
what fewer samples miss.
"""

SPARSE_NEAR_STEP, SPARSE_FAR_STEP = 50, 1000
"""The same for few samples."""

NUMBERED = (range(30_000, 31_000), range(40_000, 41_000))
"""Where devices have maps at the numbers of their manuals; samples are `NEAR_STEP` apart."""

USUAL_STARTS = (
    *(0, 1, 100, 200, 300, 500, 700, 1000, 1001, 2000, 3000, 4000, 5000, 6000),
    *(10_000, 11_000, 13_000, 30_000, 30_001, 31_000, 32_000, 33_000, 37_000),
    *(40_000, 40_001, 42_000, 43_000, 44_000, 50_000),
)
"""Where the register maps of devices begin: these samples are read first.

Counted in 144 published maps: the 103 templates of evcc with Modbus registers, 27 register files of
the nymea plugins, and 14 templates of the Modbus manager for Home Assistant. Maps with a register
in the hundred from 0: 40, 100: 21, 1000: 18, 200: 16, 5000: 14, 300, 500 and 33000: 9 each, 700: 8,
11000 and 30000: 7 each, 2000 and 43000: 6 each, 3000, 4000, 6000, 32000 and 40000: 5 each, 10000:
4, 13000, 31000, 37000 and 44000: 3 each. A part of a map begins exactly at 0 in 9 of them, at 1 and
1000 in 7 each. Maps that count from 1 have 1, 1001, 30001 and 40001. SunSpec begins at 40000, 50000
or 0. Other starts that are as frequent, such as 30513 and 30775, are those of a single vendor.
"""

VALUE_WIDTHS = (2, 4)
"""The numbers of registers to read together where none can be read alone."""

CLOSER = (1, 2, 4, 8, 16, 32, 64)
"""Distances after the end of a range at which to search for the next range."""

GIVE_UP = 5
"""Skip an area if this many samples across it fail in the same way, other than with 02."""

FIRST_READS = 4
"""Reads of which one must have a reply; else the device is silent."""

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


class Finding(NamedTuple):
    """A range that was found, and read to both ends."""

    area: Area
    addresses: range


class Unfinished(ModbusError):
    """The survey ended early; it has the results so far. `reason` is a word for programs."""

    reason = "failed"


class DeviceSilent(Unfinished):
    """The device has stopped answering."""

    reason = "timeout"


class LimitReached(Unfinished):
    """The survey has sent as many requests as it may."""


@dataclass
class AreaMap:
    """The results for an area."""

    area: Area
    limit: int
    """The most addresses that one read may be for, as far as is known."""
    width: int = 1
    """The addresses that are read together: a count of a read is a multiple of it."""
    ranges: list[range] = field(default_factory=list)
    """The existing addresses, sorted; ranges are never adjacent."""
    refused: dict[int, Failure] = field(default_factory=dict)
    """The addresses that were read alone and failed, and why."""
    requests: int = 0
    reached: int | None = None
    """The address below which the area was searched; `None` before its first read. The ranges at
    usual starts are found before, so addresses above can exist."""
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
    def absent(self) -> list[range]:
        """The addresses that were read alone and returned exception 02, sorted."""
        return self._refused_with(ILLEGAL_ADDRESS)

    @property
    def failures(self) -> dict[Failure, list[range]]:
        """The addresses that failed other than with exception 02, by failure."""
        others = dict.fromkeys(each for each in self.refused.values() if each != ILLEGAL_ADDRESS)
        return {failure: self._refused_with(failure) for failure in others}

    def _refused_with(self, failure: Failure) -> list[range]:
        found: list[range] = []
        for address in sorted(at for at, why in self.refused.items() if why == failure):
            add_addresses(found, address, 1)
        return found

    @property
    def asked(self) -> int:
        """How many addresses were read alone, or exist."""
        return self.addresses + len(self.refused)

    @property
    def state(self) -> State:
        """How far the search of the area came."""
        if self.reached is None or not self.requests:
            return "not_asked"
        if self.given_up is not None:
            return "given_up"
        return "searched" if self.is_done else "partly"

    def range_of(self, address: int) -> range | None:
        """The range that contains an address."""
        at = bisect.bisect_right(self.ranges, address, key=lambda each: each.start) - 1
        return self.ranges[at] if at >= 0 and address in self.ranges[at] else None

    def next_range(self, address: int) -> range | None:
        """The first range that begins behind an address."""
        at = bisect.bisect_right(self.ranges, address, key=lambda each: each.start)
        return self.ranges[at] if at < len(self.ranges) else None

    @property
    def takes_less(self) -> bool:
        """Whether reads may be for fewer addresses than the standard allows."""
        return self.limit < READ_LIMITS[self.area]

    def blocks(self, extent: range) -> Iterator[range]:
        """A range, in reads that are as large as one that succeeded."""
        step = max(1, self.largest)
        for first in range(extent.start, extent.stop, step):
            yield range(first, min(first + step, extent.stop))

    def done(self, span: range) -> int:
        """How many addresses of a span are done."""
        if self.is_done or self.given_up is not None:
            return len(span)
        return max(self.addresses, (self.reached or span.start) - span.start)


class Survey:
    """A search for the addresses of a device. Run it with `run` or `run_sync`.

    Searches `areas` within `span`. With `exact`, reads every address; otherwise, reads samples at
    every `step` addresses and at usual start addresses; fewer of them if not `dense`. One read is
    for at most `max_quantity` bits or registers, and never more than the standard allows. Sends at
    most `max_requests`. While it runs, `findings` and `areas` have what was found so far.
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
        limits = {"max_quantity": max_quantity, "step": step, "max_requests": max_requests}
        for name, limit in limits.items():
            if limit is not None and limit < 1:
                raise ValueError(f"{name} is {limit}, allowed: 1 or more")
        if span.step != 1 or not 0 <= span.start < span.stop <= ADDRESSES:
            raise ValueError(f"span is {span}, allowed: inside 0 to {LAST_ADDRESS}")
        self.span = span
        self.exact = exact
        self.areas = [
            AreaMap(area, min(READ_LIMITS[area], max_quantity or READ_LIMITS[area]))
            for area in areas
        ]
        self.findings: list[Finding] = []
        """The ranges in the order in which they were found. One that turns out to be longer follows
        again."""
        self.texts: dict[Failure, str] = {}
        """The first error message of each failure."""
        self.max_quantity = max_quantity
        self.max_requests = max_requests
        steps = (NEAR_STEP, FAR_STEP) if dense else (SPARSE_NEAR_STEP, SPARSE_FAR_STEP)
        self.distances = (min(steps[0], step), min(steps[1], step))
        """How far samples are apart, below `NEAR` and above."""
        self.samples = [] if exact else sample_places(span, step, dense=dense)
        """The addresses that a fast search reads in each area."""
        everywhere = span if exact else set(self.samples)
        self.starts = [each for each in USUAL_STARTS if each in everywhere]
        """The addresses that are read first in each area."""
        self._answered: Probe | None = None
        self._unanswered = 0

    @property
    def at(self) -> int:
        """How many addresses of all areas are done."""
        return sum(found.done(self.span) for found in self.areas)

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
    def order(self) -> list[AreaMap]:
        """The areas in the order of the search: registers before bits."""
        return sorted(self.areas, key=lambda found: found.area in BIT_AREAS)

    def not_searched_from(self, found: AreaMap) -> int | None:
        """From where only usual starts of an area were read; `None` after its search."""
        if found.is_done or found.given_up is not None:
            return None
        return self.span.start if found.reached is None else found.reached

    def unfinished(self) -> list[Finding]:
        """The ranges that are not among `findings`: the search ended before their ends."""
        known = set(self.findings)
        ranges = [Finding(found.area, each) for found in self.areas for each in found.ranges]
        return [each for each in ranges if each not in known]

    @property
    def absent_costs(self) -> int:
        """How many requests the search takes on a device without any address."""
        alone = len(self.areas) * (len(self.span) if self.exact else len(self.samples))
        return alone + sum(len(self.value_reads(found.area)) for found in self.areas)

    def value_reads(self, area: Area) -> list[Probe]:
        """The reads that show whether an area has values that can't be read in part."""
        if area in BIT_AREAS:
            return []
        if self.exact:
            # Values can begin at odd addresses, and most samples are even.
            samples = sample_places(self.span)
            more = [*samples, *(each + 1 for each in samples)]
        else:
            more = self.samples[:FIRST_ADDRESSES:2]
        places = dict.fromkeys((*self.starts, *more))
        return [
            Probe(area, place, width)
            for width in VALUE_WIDTHS
            for place in places
            if width <= (self.max_quantity or width) and place + width <= self.span.stop
        ]

    def steps(self) -> Steps[None]:
        """Yields the reads one by one; send the outcome of each."""
        every = [_Search(self, found) for found in self.order]
        yield from self._await_reply(every)
        bits = [search for search in every if search.area in BIT_AREAS]
        for searches in (every[: len(every) - len(bits)], bits):
            yield from self._in_order(searches)
            again = []
            for search in searches:
                if (yield from search.finds_values()):
                    again.append(search)
            yield from self._in_order(again)
            for search in searches:
                search.end()

    def _in_order(self, searches: Sequence[_Search]) -> Steps[None]:
        """Reads all samples: first the usual starts, then by address."""
        for start in self.starts:
            for search in searches:
                yield from search.sample(start)
        for sample in self.span if self.exact else self.samples:
            for search in searches:
                search.reached(sample)
                yield from search.sample(sample)

    def _await_reply(self, searches: Sequence[_Search]) -> Steps[None]:
        """Reads the first sample of each area in turn until the device replies.

        Some devices do not reply at all if they do not have an area.
        """
        samples = self.starts or self.samples or self.span
        for number in range(FIRST_READS):
            turn, which = divmod(number, len(searches))
            if (yield from searches[which].first(samples[min(turn, len(samples) - 1)])):
                return
        raise DeviceSilent(f"no answer to {self.requests} reads")

    def read(self, found: AreaMap, probe: Probe) -> Steps[Outcome]:
        """Runs a read; repeats it once if there was no reply or the device was busy."""
        outcome = yield from self.ask(found, probe)
        if outcome == BUSY or isinstance(outcome, str):
            outcome = yield from self.ask(found, probe)
        if isinstance(outcome, str):
            self._unanswered += 1
            if self._unanswered % SILENT_READS == 0:
                yield from self._look_whether_it_is_there(found)
        return outcome

    def ask(self, found: AreaMap, probe: Probe) -> Steps[Outcome]:
        """Sends a request, if that is allowed."""
        if self.requests == self.max_requests:
            raise LimitReached(f"stopped after {self.requests} requests")
        outcome = yield probe
        found.requests += 1
        if not isinstance(outcome, str):
            self._answered, self._unanswered = probe, 0
        return outcome

    def _look_whether_it_is_there(self, found: AreaMap) -> Steps[None]:
        assert self._answered is not None
        for _ in range(2):
            outcome = yield from self.ask(found, self._answered)
            if not isinstance(outcome, str):
                return
        raise DeviceSilent("the device stopped answering")


def sample_places(span: range, step: int = STEP, *, dense: bool = True) -> list[int]:
    """The addresses of samples: usual start addresses, and every `step` addresses.

    Usual are the first 16, multiples of 10 and 100, the addresses after a multiple of 100 for maps
    that count from 1, and maps at the numbers of manuals (30001, 40001). Without `dense`, fewer.
    """
    near, far = (NEAR_STEP, FAR_STEP) if dense else (SPARSE_NEAR_STEP, SPARSE_FAR_STEP)
    ones = range(1, NEAR, far)
    usual = {*range(0, NEAR, near), *ones, *range(FIRST_ADDRESSES if dense else 2), 10, 20}
    usual.update(range(NEAR, ADDRESSES, far), range(NEAR + 1, ADDRESSES, 1000))
    if dense:
        for numbered in NUMBERED:
            usual.update(range(numbered.start, numbered.stop, NEAR_STEP))
            usual.update(range(numbered.start + 1, numbered.stop, FAR_STEP))
    spread = range(span.start, span.stop, step)
    return sorted({*spread, span.stop - 1, *(each for each in usual if each in span)})


class _Search:
    """The search in one area."""

    def __init__(self, survey: Survey, found: AreaMap) -> None:
        self.area = found.area
        self._survey = survey
        self._found = found
        self._first = survey.span.start
        self._stop = survey.span.stop
        self._has_begun = False
        self._is_in_order = False
        """Whether the usual starts were read, so that the search is by address."""
        self._refused = found.refused
        self._places: list[int] = []
        """The addresses of `refused`, sorted."""

    def first(self, address: int) -> Steps[bool]:
        """Reads an address once. Returns whether the device is there.

        If there is no reply, the address is read again later.
        """
        found = self._found
        outcome = yield from self._survey.ask(found, Probe(found.area, address, 1))
        if isinstance(outcome, str) or outcome == BUSY:
            return outcome == BUSY
        self._record(address, 1, outcome)
        yield from self._after(address, address if outcome is None else None)
        return True

    def sample(self, address: int) -> Steps[None]:
        """Reads a sample, and the range around it."""
        found = self._found
        if found.given_up is not None or self._is_known(address):
            return
        yield from self._after(address, (yield from self._first_hit([address])))

    def finds_values(self) -> Steps[bool]:
        """Looks for values that can't be read in part, if no register could be read alone. Returns
        whether there are any: the search then begins again, and reads them whole."""
        found = self._found
        if found.ranges or {ILLEGAL_ADDRESS, ILLEGAL_VALUE}.isdisjoint(self._refused.values()):
            return False
        for probe in self._survey.value_reads(self.area):
            if (yield from self._survey.read(found, probe)) is None:
                found.width = probe.count
                found.limit -= found.limit % probe.count
                # That a register is refused alone does not show that it is absent.
                self._refused.clear()
                self._places.clear()
                self._is_in_order = False
                found.given_up, found.reached = None, self._first
                return True
        return False

    def reached(self, address: int) -> None:
        """Records that the area was searched below an address."""
        self._is_in_order = True
        if self._found.given_up is None:
            self._found.reached = max(self._found.reached or self._first, address)

    def end(self) -> None:
        """Records that the search is complete."""
        self._found.reached = self._stop
        self._found.is_done = True

    def _after(self, sample: int, hit: int | None) -> Steps[None]:
        """Reads the range around a hit; decides after the first sample whether to go on."""
        if not self._has_begun:
            self._has_begun = True
            self._found.reached = self._first
            if hit is None:
                self._found.given_up = yield from self._hopeless(sample)
        yield from self._around(hit)

    def _is_known(self, address: int) -> bool:
        return address in self._refused or self._found.range_of(address) is not None

    def _around(self, hit: int | None) -> Steps[None]:
        """Reads the range around a hit, and ranges close behind it."""
        while hit is not None:
            size = yield from self._follow_back(hit - 1, self._floor(hit))
            end = yield from self._follow(hit + self._found.width, size)
            whole = self._found.range_of(hit)
            assert whole is not None
            self._survey.findings.append(Finding(self._found.area, whole))
            if self._survey.exact:
                return
            hit = yield from self._first_hit([end + far for far in CLOSER])

    def _hopeless(self, sample: int) -> Steps[Outcome]:
        """The failure of the whole area, if distant samples fail like the first; else `None`."""
        failure = self._refused[sample]
        if failure == ILLEGAL_FUNCTION:
            return failure
        if self._survey.exact or failure == ILLEGAL_ADDRESS:
            return None
        samples = self._survey.samples
        last = len(samples) - 1
        for index in sorted({last * part // (GIVE_UP - 1) for part in range(1, GIVE_UP)}):
            hit = yield from self._first_hit([samples[index]])
            yield from self._around(hit)
            if self._refused.get(samples[index]) != failure:
                return None
        return failure

    def _first_hit(self, addresses: Iterable[int]) -> Steps[int | None]:
        """The first existing address that was not found before."""
        for address in addresses:
            is_known = self._found.range_of(address) is not None
            if is_known or address + self._found.width > self._stop:
                return None
            if address not in self._refused and (yield from self._read(address, 1)) is None:
                return address
        return None

    def _floor(self, address: int) -> int:
        """The lowest address that can be in the same range as an existing address.

        Values of that range begin a multiple of the width apart: a refused read between two such
        places does not show that an address is absent.
        """
        at = bisect.bisect(self._places, address)
        while at and (address - self._places[at - 1]) % self._found.width:
            at -= 1
        return self._places[at - 1] + 1 if at else self._first

    def _follow(self, at: int, size: int) -> Steps[int]:
        """Reads from `at` up to the first address that fails, and returns it; begins with blocks of
        that size. A range that was found before is not read again.
        """
        # The exact search reads every address: the hit was its block of 1.
        pace = _Pace(self._found, max(size, 2 if self._survey.exact else 1))
        following = self._found.range_of(at) or self._found.next_range(at)
        stop = self._stop if following is None else following.start
        while (left := (stop - at) // self._found.width) > 0:
            count = min(pace.count, left)
            if count == 1 and at in self._refused:
                return at
            outcome = yield from self._read(at, count)
            if outcome is None:
                at += count * self._found.width
                if self._is_in_order:
                    self.reached(at)
            elif count == 1:
                return at
            pace.changed(count, outcome)
        return at if following is None or at < stop else following.stop

    def _follow_back(self, at: int, floor: int) -> Steps[int]:
        """Reads from `at` down to the first address that fails, or to `floor`. Returns the size of
        the largest block that could be read."""
        pace = _Pace(self._found, 1)
        largest = 1
        while left := (at + 1 - floor) // self._found.width:
            count = min(pace.count, left)
            outcome = yield from self._read(at + 1 - count * self._found.width, count)
            if outcome is None:
                at -= count * self._found.width
                largest = max(largest, count)
            elif count == 1:
                break
            pace.changed(count, outcome)
        return largest

    def _read(self, address: int, count: int) -> Steps[Outcome]:
        """Reads `count` times the width, and records the result for the addresses."""
        probe = Probe(self.area, address, count * self._found.width)
        outcome = yield from self._survey.read(self._found, probe)
        self._record(address, count, outcome)
        return outcome

    def _record(self, address: int, count: int, outcome: Outcome) -> None:
        if outcome is None:
            registers = count * self._found.width
            self._found.largest = max(self._found.largest, registers)
            add_addresses(self._found.ranges, address, registers)
            self._forget_failures(address, registers)
        elif count == 1:
            self._refused[address] = outcome
            bisect.insort(self._places, address)

    def _forget_failures(self, address: int, count: int) -> None:
        """A device can refuse the second register of a value, and return both together."""
        first = bisect.bisect_left(self._places, address)
        while first < len(self._places) and self._places[first] < address + count:
            del self._refused[self._places.pop(first)]


class _Pace:
    """The size of the next read: doubled after a success, half of the rest after a failure.

    After a failure, the block should contain an address that can't be read. If it does not, the
    block was too large.
    """

    def __init__(self, found: AreaMap, count: int) -> None:
        self._found = found
        self.count = min(count, self._limit)
        self._suspect: int | None = None
        """The number of next addresses of which at least one should be unreadable."""

    @property
    def _limit(self) -> int:
        """The largest read, in multiples of the width."""
        return self._found.limit // self._found.width

    def changed(self, count: int, outcome: Outcome) -> None:
        """Adapts the size after a read, and the limit of the area."""
        if outcome is not None:
            self._suspect = count
            self.count = count // 2
        elif self._suspect is None:
            self.count = min(2 * count, self._limit)
        elif self._suspect > count:
            self._suspect -= count
            self.count = max(1, self._suspect // 2)
        else:
            self._suspect = None
            self._found.limit = min(self._found.limit, self._found.largest)
            self.count = self._limit


def run_sync(
    survey: Survey,
    read: Callable[[Area, int, str], object],
    progress: Callable[[Survey], object] | None = None,
    *,
    delay: float = 0.0,
) -> None:
    """Runs a survey; calls `progress` before every read, and waits `delay` seconds between two.

    `read` is that of a client: area, address and type. Raises `Unfinished`.
    """

    def answer(probe: Probe) -> Outcome:
        if progress is not None:
            progress(survey)
        if delay and survey.requests:
            time.sleep(delay)
        try:
            read(probe.area, probe.address, _kind(probe))
        except ModbusError as error:
            return _failure(error, survey)
        return None

    carry_out(survey.steps(), answer)


async def run(survey: Survey, read: Callable[[Area, int, str], Awaitable[object]]) -> None:
    """Runs a survey. Raises `Unfinished`."""

    async def answer(probe: Probe) -> Outcome:
        try:
            await read(probe.area, probe.address, _kind(probe))
        except ModbusError as error:
            return _failure(error, survey)
        return None

    await carry_out_async(survey.steps(), answer)


def read_in_parts(
    survey: Survey, read: Callable[[Area, int, str], list[int]], block: Probe, width: int
) -> Iterator[tuple[Probe, list[int] | ModbusError]]:
    """Reads a block that exists by the rules of a survey, which counts the requests; halves what
    the device refuses, because it may take less at once.

    Yields each part with its content, or with the error of what can't be halved: another one than
    the exceptions 02 and 03, or `width` addresses. Raises `Unfinished`.
    """
    content = _read_by_rules(survey, read, block)
    half = block.count // 2 // width * width
    if half and isinstance(content, ModbusException) and content.code in REFUSALS:
        area, middle = block.area, block.address + half
        yield from read_in_parts(survey, read, Probe(area, block.address, half), width)
        yield from read_in_parts(survey, read, Probe(area, middle, block.count - half), width)
    else:
        yield block, content


def _read_by_rules(
    survey: Survey, read: Callable[[Area, int, str], list[int]], block: Probe
) -> list[int] | ModbusError:
    results: list[list[int] | ModbusError] = []

    def answer(probe: Probe) -> Outcome:
        try:
            results.append(read(probe.area, probe.address, _kind(probe)))
        except ModbusError as error:
            results.append(error)
            return _failure(error, survey)
        return None

    found = next(each for each in survey.areas if each.area == block.area)
    carry_out(survey.read(found, block), answer)
    # A third read and those after it are of another block, to check the device.
    return results[:2][-1]


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


def add_addresses(ranges: list[range], first: int, count: int) -> None:
    """Adds addresses to sorted ranges, and joins adjacent ranges."""
    stop = first + count
    begin = bisect.bisect_left(ranges, first, key=lambda each: each.stop)
    end = bisect.bisect_right(ranges, stop, key=lambda each: each.start)
    if begin < end:
        first, stop = min(first, ranges[begin].start), max(stop, ranges[end - 1].stop)
    ranges[begin:end] = [range(first, stop)]

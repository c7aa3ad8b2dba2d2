"""What a survey finds, on model devices of every layout and on a real server."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import holdfast
from holdfast.discovery import address_search
from holdfast.discovery.address_search import DeviceSilent, Survey
from holdfast.protocol import READ_LIMITS
from holdfast.types import AREAS
from support import cli, wire
from support.cases import examples
from support.fake_device import FakeDevice, exception, registers

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from holdfast.discovery.address_search import AreaMap, Outcome, Probe
    from holdfast.types import Area
    from support.running import Serve

    Model = Callable[[Probe], Outcome]

HR: list[Area] = ["holding_registers"]
OUTSIDE = 2
VALUE_READS = 2 * 36
"""The most reads of two and four registers where none can be read alone."""


@st.composite
def layouts(draw: st.DrawFn, last: int = 2000, most: int = 8) -> list[range]:
    """Ranges in order that do not touch."""
    cuts = sorted(draw(st.sets(st.integers(0, last), max_size=2 * most)))
    return [range(*pair) for pair in zip(cuts[::2], cuts[1::2], strict=False)]


def device(present: Iterable[range], *, largest: int = 2000, too_large: int = 3) -> Model:
    """A device with these addresses, which reads at most so many at once."""
    addresses = [*present]

    def answer(probe: Probe) -> Outcome:
        if probe.count > largest:
            return too_large
        asked = range(probe.address, probe.address + probe.count)
        inside = any(asked[0] in each and asked[-1] in each for each in addresses)
        return None if inside else OUTSIDE

    return answer


def whole(
    present: Iterable[range], width: int, code: Outcome = OUTSIDE, *, first: int = 0
) -> Model:
    """A device with these addresses, which only reads whole values of so many registers. Values
    begin at `first` and multiples of the width from there."""
    truth = device(present)

    def answer(probe: Probe) -> Outcome:
        is_part = (probe.address - first) % width or probe.count % width
        return code if is_part else truth(probe)

    return answer


def carried_out(survey: Survey, model: Model) -> list[Probe]:
    """The reads of a survey, answered by a model."""
    steps = survey.steps()
    probes: list[Probe] = []
    try:
        probe = next(steps)
        while True:
            probes.append(probe)
            assert len(probes) < 1_000_000
            probe = steps.send(model(probe))
    except StopIteration:
        return probes


def mapped(model: Model, areas: Sequence[Area] = HR, **options: object) -> AreaMap:
    """The map of the first area."""
    survey = Survey(areas, **options)  # type: ignore[arg-type]
    probes = carried_out(survey, model)
    assert survey.requests == len(probes)
    assert survey.at == survey.total
    return survey.areas[0]


def follow_cost(present: Sequence[range], limit: int) -> int:
    """The most reads that following ranges may take, both ways, or a search for whole values."""
    if not present:
        return VALUE_READS
    halvings = math.ceil(math.log2(limit)) + 1
    return sum(len(each) // limit + 4 * halvings + 4 for each in present)


@given(
    layout=layouts(),
    area=st.sampled_from(AREAS),
    quantity=st.integers(1, 2000),
)
@settings(max_examples=examples(50))
def test_exact_finds_the_truth_with_few_reads(
    layout: list[range], area: Area, quantity: int
) -> None:
    span = range(2001)
    found = mapped(device(layout), [area], exact=True, max_quantity=quantity, span=span)
    assert found.ranges == layout
    assert found.failures == {}
    holes = len(span) - sum(map(len, layout))
    limit = min(quantity, READ_LIMITS[area])
    value_reads = 2 * 2 * len(address_search.sample_places(span))
    assert found.requests <= holes + (follow_cost(layout, limit) if layout else value_reads)


@given(
    layout=layouts(),
    largest=st.integers(1, 125),
    code=st.sampled_from([2, 3, 4, "timeout"]),
)
@settings(max_examples=examples(50))
def test_exact_finds_the_truth_on_a_device_that_reads_only_so_many_at_once(
    layout: list[range], largest: int, code: Outcome
) -> None:
    model = device(layout, largest=largest, too_large=code)  # type: ignore[arg-type]
    found = mapped(model, exact=True, span=range(2001))
    assert found.ranges == layout
    assert found.largest <= largest


def test_too_large_blocks_are_not_tried_for_ever() -> None:
    found = mapped(device([range(2000)], largest=100), exact=True, span=range(2000))
    assert found.ranges == [range(2000)]
    assert found.requests < 2000 // 64 + 30


@given(layout=layouts(last=65536), step=st.integers(1, 3000))
@settings(max_examples=examples(15))
def test_fast_finds_every_range_that_holds_a_sample_and_nothing_that_is_not_there(
    layout: list[range], step: int
) -> None:
    found = mapped(device(layout), step=step)
    sampled = [each for each in layout if -each.start % step < len(each)]
    assert [each for each in found.ranges if each in sampled] == sampled
    assert all(each in layout for each in found.ranges)


@pytest.mark.parametrize(
    "layout",
    [
        [range(50), range(1030, 1081), range(4001, 4061), range(30001, 30100)],
        [range(2000, 2003), range(9950, 9951), range(40001, 40002), range(65535, 65536)],
    ],
)
def test_fast_finds_ranges_where_devices_like_to_have_them(layout: list[range]) -> None:
    assert mapped(device(layout)).ranges == layout


@given(layout=layouts(last=65536))
@settings(max_examples=examples(15))
def test_fast_takes_few_reads(layout: list[range]) -> None:
    found = mapped(device(layout))
    assert found.requests <= 2200 + follow_cost(found.ranges, 125) + 8 * len(layout)


@pytest.mark.parametrize("exact", [False, True])
def test_everything_there_takes_hardly_more_reads_than_blocks(exact: bool) -> None:
    found = mapped(device([range(65536)]), exact=exact)
    assert found.ranges == [range(65536)]
    assert found.requests <= 65536 // 125 + 10


def test_registers_at_usual_starts_come_first_then_other_registers_then_bits() -> None:
    probes = carried_out(Survey(), device([]))
    registers, bits = ("holding_registers", "input_registers"), ("coils", "discrete_inputs")
    samples = address_search.sample_places(range(65536))
    others = [each for each in samples if each not in address_search.USUAL_STARTS]
    assert [(probe.area, probe.address) for probe in probes if probe.count == 1] == [
        (area, address)
        for areas in (registers, bits)
        for addresses in (address_search.USUAL_STARTS, others)
        for address in addresses
        for area in areas
    ]
    values = probes[2 * len(samples) : -2 * len(samples)]
    assert [(probe.area, probe.count) for probe in values] == [
        (area, width) for area in registers for width in (2, 4) for _ in range(VALUE_READS // 2)
    ]


def test_usual_starts_come_first_in_an_exact_search_too() -> None:
    probes = carried_out(Survey(HR, exact=True, span=range(90, 2001)), device([]))
    assert [probe.address for probe in probes[:9]] == [
        *(100, 200, 300, 500, 700, 1000, 1001, 2000),
        90,
    ]


SHORT_RANGES = [
    *((0, 2), (100, 4), (210, 3), (350, 2), (501, 2), (1000, 2), (2001, 4), (4096, 2), (5020, 2)),
    *((8000, 1), (12300, 2), (20000, 5), (30001, 6), (40001, 100), (40230, 4), (50000, 2)),
]


@pytest.mark.parametrize(
    ("layout", "largest", "by_address"),
    [
        ([range(first, first + count) for first, count in SHORT_RANGES], 2000, 2323),
        ([range(1000)], 2000, 2063),
        ([range(65536)], 2000, 532),
        ([range(500), range(1000, 1300), range(5000, 5700)], 64, 2064),
        ([range(40000, 40180)], 2000, 2164),
        ([], 2000, 2161 + VALUE_READS),
    ],
    ids=["sparse", "dense", "everything", "small blocks", "sunspec", "empty"],
)
def test_the_order_costs_no_more_reads_than_that_of_the_addresses(
    layout: list[range], largest: int, by_address: int
) -> None:
    found = mapped(device(layout, largest=largest))
    assert found.ranges == layout
    assert found.requests <= by_address


@pytest.mark.parametrize(
    ("layout", "largest", "dense", "sparse"),
    [
        (
            [range(first, first + count) for first, count in SHORT_RANGES],
            2000,
            (2323, 16),
            (704, 11),
        ),
        ([range(500), range(1000, 1300), range(5000, 5700)], 64, (2064, 3), (624, 3)),
        ([range(at, at + 1) for at in range(0, 400, 2)], 2000, (2508, 200), (971, 200)),
        ([range(65536)], 2000, (532, 1), (532, 1)),
        ([range(65536)], 32, (2059, 1), (2059, 1)),
        ([range(40000, 40180)], 2000, (2164, 1), (599, 1)),
        ([], 2000, (2161 + VALUE_READS, 0), (577 + 68, 0)),
    ],
    ids=["short", "small blocks", "single", "everything", "32 at once", "sunspec", "empty"],
)
def test_a_search_takes_its_requests_and_finds_its_ranges(
    layout: list[range], largest: int, dense: tuple[int, int], sparse: tuple[int, int]
) -> None:
    truth = device(layout, largest=largest)
    for expected, found in ((dense, mapped(truth)), (sparse, mapped(truth, dense=False))):
        assert (found.requests, len(found.ranges)) == expected
        assert all(each in layout for each in found.ranges)


def test_ranges_are_findings_before_the_search_goes_on() -> None:
    survey = Survey(["coils", "holding_registers", "input_registers"])
    truth = device([range(300, 320), range(40000, 40100)])
    seen: dict[Probe, list[tuple[str, int, int]]] = {}

    def model(probe: Probe) -> Outcome:
        seen.setdefault(probe, [(area, at.start, at.stop) for area, at in survey.findings])
        return truth(probe)

    carried_out(survey, model)
    registers: list[tuple[str, int, int]] = [
        ("holding_registers", 300, 320),
        ("input_registers", 300, 320),
        ("holding_registers", 40000, 40100),
        ("input_registers", 40000, 40100),
    ]
    assert next(known for probe, known in seen.items() if probe.address == 500) == registers[:2]
    assert next(known for probe, known in seen.items() if probe.area == "coils") == registers
    assert survey.unfinished() == []


def test_every_sample_between_two_ranges_is_read() -> None:
    layout = [range(100, 110), range(130, 133), range(174, 180)]
    assert mapped(device(layout)).ranges == layout


def test_a_range_around_a_usual_start_is_found_whole_and_once() -> None:
    survey = Survey(HR)
    carried_out(survey, device([range(2871, 3333)]))
    assert [finding.addresses for finding in survey.findings] == [range(2871, 3333)]


def test_an_address_that_is_refused_alone_but_not_in_a_block_is_no_longer_absent() -> None:
    truth = device([range(90, 201)])

    def model(probe: Probe) -> Outcome:
        return OUTSIDE if probe.address == 100 and probe.count == 1 else truth(probe)

    found = mapped(model)
    assert found.ranges == [range(90, 201)]
    assert not any(100 in each for each in found.absent)
    assert found.asked == len({*range(90, 201)} | {at for each in found.absent for at in each})


def test_a_sample_that_shows_that_an_area_is_not_hopeless_has_its_range_found() -> None:
    truth = device([range(65531, 65536)])
    found = mapped(lambda probe: None if truth(probe) is None else 4)
    assert found.ranges == [range(65531, 65536)]


def test_a_device_that_is_mute_where_it_has_no_area_is_searched() -> None:
    survey = Survey(span=range(200))
    truth = device([range(10)])
    carried_out(survey, lambda probe: truth(probe) if probe.area == "coils" else "timeout")
    assert {found.area: found.ranges for found in survey.areas} == {
        "coils": [range(10)],
        "discrete_inputs": [],
        "holding_registers": [],
        "input_registers": [],
    }
    assert survey.areas[2].given_up == "timeout"


def test_a_search_that_ends_early_says_where_it_did_not_look() -> None:
    survey = Survey(["coils", "holding_registers", "input_registers"], max_requests=80)
    with pytest.raises(address_search.LimitReached):
        carried_out(survey, device([]))
    # Two reads for each of the 29 starts, then by address, where 0 and 1 are known.
    assert [survey.not_searched_from(found) for found in survey.areas] == [0, 13, 12]
    assert [found.state for found in survey.areas] == ["not_asked", "partly", "partly"]
    survey = Survey(HR, max_requests=5)
    with pytest.raises(address_search.LimitReached):
        carried_out(survey, device([range(65536)]))
    assert [(finding.area, finding.addresses) for finding in survey.unfinished()] == [
        ("holding_registers", range(1 + 1 + 2 + 4 + 8))
    ]


def test_ranges_close_behind_each_other_are_found_without_samples() -> None:
    layout = [range(300, 310), range(312, 330), range(345, 350)]
    assert mapped(device(layout)).ranges == layout


def test_a_span_is_not_left() -> None:
    for exact in (False, True):
        survey = Survey(HR, exact=exact, span=range(50, 151))
        probes = carried_out(survey, device([range(1000)]))
        assert survey.areas[0].ranges == [range(50, 151)]
        assert min(probe.address for probe in probes) == 50
        assert max(probe.address + probe.count for probe in probes) == 151


@pytest.mark.parametrize("exact", [False, True])
def test_an_area_that_the_device_can_not_read_is_given_up_at_once(exact: bool) -> None:
    found = mapped(lambda _: 1, exact=exact)
    assert (found.ranges, found.given_up, found.requests) == ([], 1, 1)


@pytest.mark.parametrize("code", [4, 6, 11])
def test_an_area_that_fails_everywhere_is_given_up(code: int) -> None:
    found = mapped(lambda _: code)
    assert (found.given_up, len(found.failures[code])) == (code, address_search.GIVE_UP)


def test_failures_are_told_apart() -> None:
    special: dict[int, Outcome] = {20: 4, 21: 4, 22: 5, 23: "timeout", 24: "invalid"}

    def model(probe: Probe) -> Outcome:
        asked = range(probe.address, probe.address + probe.count)
        failing = [special[each] for each in asked if each in special]
        return failing[0] if failing else None if asked[-1] < 40 else OUTSIDE

    found = mapped(model, exact=True, span=range(100))
    assert found.ranges == [range(20), range(25, 40)]
    assert found.failures == {
        4: [range(20, 22)],
        5: [range(22, 23)],
        "timeout": [range(23, 24)],
        "invalid": [range(24, 25)],
    }


def test_a_reply_that_is_lost_once_does_no_harm() -> None:
    truth = device([range(10, 90)])
    asked: set[Probe] = set()

    def model(probe: Probe) -> Outcome:
        if probe in asked:
            return truth(probe)
        asked.add(probe)
        return "timeout"

    found = mapped(model, exact=True, span=range(100))
    assert (found.ranges, found.failures) == ([range(10, 90)], {})


@pytest.mark.parametrize("exact", [False, True], ids=["samples", "exact"])
@pytest.mark.parametrize("code", [2, 3])
@pytest.mark.parametrize("width", [2, 4])
@pytest.mark.parametrize("quantity", [None, 7])
def test_values_that_can_not_be_read_in_part_are_found(
    exact: bool, code: int, width: int, quantity: int | None
) -> None:
    layout = [range(40, 44), range(52, 60), range(1000, 1300)]
    span = range(33, 1297)
    survey = Survey(HR, exact=exact, span=span, max_quantity=quantity)
    probes = carried_out(survey, whole(layout, width, code))
    [found] = survey.areas
    assert found.ranges == [*layout[:2], range(1000, 1296)]
    assert found.asked == found.addresses + sum(
        len(each) for ranges in (found.absent, *found.failures.values()) for each in ranges
    )
    if exact:  # A value at the last address would leave the span.
        assert len(span) - found.asked == 1
    assert min(probe.address for probe in probes) == span.start
    assert max(probe.address + probe.count for probe in probes) == span.stop
    assert found.largest <= (quantity or 125)
    assert (found.state, survey.at) == ("searched", survey.total)


@pytest.mark.parametrize("exact", [False, True], ids=["samples", "exact"])
@pytest.mark.parametrize("width", [2, 4])
def test_values_at_odd_addresses_are_found_from_their_first(exact: bool, width: int) -> None:
    layout = [range(1, 61), range(953, 1101), range(2997, 3101)]
    survey = Survey(HR, exact=exact, span=range(4000))
    carried_out(survey, whole(layout, width, first=1))
    assert survey.areas[0].ranges == layout
    assert [finding.addresses for finding in survey.findings] == layout


@pytest.mark.parametrize("width", [2, 4])
@pytest.mark.parametrize("first", [51, 2999])
def test_exact_finds_values_away_from_usual_starts(first: int, width: int) -> None:
    layout = [range(first, first + 40)]
    model = whole(layout, width, first=first)
    assert mapped(model, exact=True, span=range(4000)).ranges == layout


def test_bits_are_only_read_alone_where_nothing_is_found() -> None:
    probes = carried_out(Survey(["coils"]), whole([range(8)], 2))
    assert {probe.count for probe in probes} == {1}


def test_a_search_for_whole_values_that_ends_early_says_where_it_did_not_look() -> None:
    survey = Survey(HR, max_requests=2161 + 60)
    with pytest.raises(address_search.LimitReached):
        carried_out(survey, whole([range(100, 120)], 2))
    [found] = survey.areas
    assert (found.state, found.ranges) == ("partly", [range(100, 120)])
    assert survey.not_searched_from(found) == 15


def test_a_device_that_never_answers_is_given_up() -> None:
    survey = Survey()
    with pytest.raises(DeviceSilent, match="no answer to 4 reads"):
        carried_out(survey, lambda _: "timeout")
    assert survey.requests == 4


def test_a_device_that_ceases_to_answer_is_given_up() -> None:
    survey = Survey(exact=True)

    def model(_: Probe) -> Outcome:
        return None if survey.requests < 20 else "timeout"

    with pytest.raises(DeviceSilent, match="stopped answering"):
        carried_out(survey, model)
    assert survey.order[0].addresses > 0
    assert survey.requests < 50


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"max_quantity": 0}, "max_quantity is 0"),
        ({"step": 0}, "step is 0"),
        ({"span": range(5, 5)}, "span is"),
        ({"span": range(65537)}, "span is"),
    ],
)
def test_what_can_not_be_is_refused(options: dict[str, object], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        Survey(**options)  # type: ignore[arg-type]


@given(
    starts=st.lists(st.integers(0, 1500), min_size=4, max_size=4),
    sizes=st.lists(st.integers(1, 500), min_size=4, max_size=4),
    exact=st.booleans(),
)
@settings(max_examples=examples(5))
def test_a_real_server_is_mapped(starts: list[int], sizes: list[int], exact: bool) -> None:
    extents = dict(zip(AREAS, zip(starts, sizes, strict=True), strict=True))
    memory = holdfast.Memory(**extents)  # type: ignore[arg-type]
    with (
        holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-only") as server,
        holdfast.SyncClient(cli.url(server)) as client,
    ):
        survey = Survey(exact=exact, span=range(2048), step=1)
        address_search.run_sync(survey, client.read)
    found = {each.area: each.ranges for each in survey.areas}
    assert found == {area: [extent] for area, extent in memory.areas.items()}


def test_both_clients_find_the_same(serve: Serve) -> None:
    server = serve({1: holdfast.Memory(coils=(5, 2100), input_registers=300)})
    with holdfast.SyncClient(cli.url(server)) as client:
        plain = Survey()
        seen: list[int] = []
        address_search.run_sync(plain, client.read, lambda survey: seen.append(survey.at))
    assert seen == sorted(seen)
    assert len(seen) == plain.requests

    async def run() -> Survey:
        async with holdfast.Client(cli.url(server)) as client:
            survey = Survey()
            await address_search.run(survey, client.read)
        return survey

    assert asyncio.run(run()).areas == plain.areas
    assert [each.ranges for each in plain.areas] == [[range(5, 2105)], [], [], [range(300)]]
    assert server.counters()["requests"][1] > 0


def test_what_comes_from_a_device_is_told_apart() -> None:
    def answers(pdu: bytes) -> bytes | None:
        address, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        bad = {3: None, 5: b"\x03\x01\x00", 6: b"", 7: exception(pdu, 4)}
        for each in range(address, address + count):
            if each in bad:
                return bad[each]
        return registers(pdu) if address + count <= 10 else exception(pdu, 2)

    def are_told_apart(timeout: float) -> bool:
        survey = Survey(HR, exact=True, span=range(12))
        with FakeDevice(answers) as model, holdfast.SyncClient(model.url, timeout=timeout) as plc:
            address_search.run_sync(survey, plc.read)
        [found] = survey.areas
        if found.failures["timeout"] != [range(3, 4)]:
            return False
        assert found.ranges == [range(3), range(4, 5), range(8, 10)]
        assert found.failures == {
            "timeout": [range(3, 4)],
            "invalid": [range(5, 6)],
            "connection": [range(6, 7)],
            4: [range(7, 8)],
        }
        return True

    wire.until_long_enough(are_told_apart, "all others are answered")


def test_a_device_that_is_not_there_is_an_error() -> None:
    with (
        holdfast.SyncClient("tcp://127.0.0.1:1") as client,
        pytest.raises(holdfast.ConnectionLost, match="can't connect"),
    ):
        address_search.run_sync(Survey(), client.read)

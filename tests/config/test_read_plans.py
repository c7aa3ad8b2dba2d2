"""Which requests read a set of fields: against a model that looks at single addresses, and against
the rules that others use.
"""

from __future__ import annotations

import itertools
import json
import math
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast._core import plan_blocks
from holdfast.appliance import Appliance
from holdfast.config import load, read_plans
from holdfast.types import AREAS, BIT_AREAS
from support import wire
from support.cases import examples
from support.cli import answer, done, usage_error
from support.polled import Fake, asked, data

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from holdfast.config.read_plans import Field, Preset
    from holdfast.types import Area

    Block = tuple[Area, int, int, list[int], int]
    Rules = dict[str, Any]

LIMITS = {"max_registers": st.integers(1, 125), "max_bits": st.integers(1, 2000)}
SMALL = {"max_registers": st.integers(4, 20), "max_bits": st.integers(4, 40)}
PRICES = st.sampled_from([0.0, 0.5, 1.0, 3.0, 10.0, 1000.0])


def most(area: Area, rules: Rules) -> int:
    limit: int = rules["max_bits"] if area in BIT_AREAS else rules["max_registers"]
    return limit


def planned(fields: Sequence[Field], rules: Rules, **more: Any) -> list[Block]:
    return plan_blocks(fields, **rules, **more)


@st.composite
def problems(draw: st.DrawFn, *, ranges: bool = True) -> tuple[list[Field], Rules]:
    """Fields close to each other, that can all be read, and limits."""
    rules: Rules = dict(draw(st.fixed_dictionaries(draw(st.sampled_from([LIMITS, SMALL])))))
    areas = st.sampled_from(draw(st.sampled_from([AREAS, AREAS[2:3]])))
    base = draw(st.sampled_from([0, 700, 65_336]))

    @st.composite
    def fields(draw: st.DrawFn) -> Field:
        area = draw(areas)
        count = draw(st.integers(1, min(4, most(area, rules))))
        return area, base + draw(st.integers(0, 200 - count)), count

    @st.composite
    def spans(draw: st.DrawFn) -> tuple[Area, int, int]:
        start = base + draw(st.integers(0, 199))
        return draw(areas), start, min(start + draw(st.integers(1, 60)), 65536)

    wanted = draw(st.lists(fields(), min_size=1, max_size=40))
    if ranges:
        rules["readable"] = draw(st.lists(spans(), max_size=3))
        rules["forbidden"] = draw(st.lists(spans(), max_size=3))
        wanted = [field for field in wanted if not (addresses([field]) & closed(rules))]
    return wanted, rules


def addresses(fields: Iterable[Field]) -> set[tuple[Area, int]]:
    return {(area, at) for area, first, count in fields for at in range(first, first + count)}


def closed(rules: Rules) -> set[tuple[Area, int]]:
    return {(area, at) for area, start, end in rules["forbidden"] for at in range(start, end)}


def requests(blocks: Sequence[Block]) -> list[Field]:
    return [(area, address, count) for area, address, count, _, _ in blocks]


def holes(fields: Sequence[Field], block: Block) -> list[tuple[int, int]]:
    """Runs of addresses that a block reads though none of its fields wants them."""
    area, address, count, inside, _ = block
    wanted = addresses(fields[index] for index in inside)
    runs: list[tuple[int, int]] = []
    for at in range(address, address + count):
        if (area, at) in wanted:
            continue
        if runs and runs[-1][1] == at:
            runs[-1] = (runs[-1][0], at + 1)
        else:
            runs.append((at, at + 1))
    return runs


def whole(fields: Sequence[Field]) -> Field:
    """The request that reads all of some fields."""
    first = min(address for _, address, _ in fields)
    return fields[0][0], first, max(address + count for _, address, count in fields) - first


def is_allowed(fields: Sequence[Field], request: Field, rules: Rules) -> bool:
    area, _, count = request
    own = addresses([request])
    runs = holes(fields, (*request, list(range(len(fields))), 0))
    readable = [(start, end) for of, start, end in rules["readable"] if of == area]
    inside = [
        not readable or any(low <= start and end <= high for low, high in readable)
        for start, end in runs
    ]
    return count <= most(area, rules) and not own & closed(rules) and all(inside)


def cost(blocks: Sequence[Field], request: float, register: float) -> float:
    return sum(
        request + register * (count / 16 if area in BIT_AREAS else count)
        for area, _, count in blocks
    )


def check(fields: Sequence[Field], rules: Rules, blocks: Sequence[Block]) -> None:
    """What every plan keeps."""
    assert sorted(index for block in blocks for index in block[3]) == list(range(len(fields)))
    for block in blocks:
        area, address, count, inside, unwanted = block
        assert 1 <= count <= most(area, rules)
        assert address + count <= 65536
        own = addresses([(area, address, count)])
        for index in inside:
            assert addresses([fields[index]]) <= own
        wanted = addresses(fields[index] for index in inside)
        assert {(area, address), (area, address + count - 1)} <= wanted
        assert unwanted == len(own - wanted)
        assert not own & closed(rules)
        readable = [(start, end) for of, start, end in rules["readable"] if of == area]
        for start, end in holes(fields, block):
            assert not readable or any(low <= start and end <= high for low, high in readable)
    assert requests(blocks) == sorted(requests(blocks), key=lambda r: (AREAS.index(r[0]), *r[1:]))


def max_insert(fields: Sequence[Field], rules: Rules, fill: int) -> int:
    """How many requests telegraf's max_insert makes of the fields: from the left, a new one begins
    where the hole is larger than `fill`, or the request would be longer than it may.
    """
    count = 0
    for area in AREAS:
        first = end = None
        ordered = sorted((f for f in fields if f[0] == area), key=lambda f: (f[1], -f[2]))
        for _, address, size in ordered:
            if first is None or end is None or address - end > fill:
                fits = False
            else:
                fits = max(end, address + size) - first <= most(area, rules)
            if not fits:
                count, first, end = count + 1, address, address
            end = max(end or 0, address + size)
    return count


@settings(max_examples=examples(60))
@given(problem=problems(), max_gap=st.integers(0, 60))
def test_a_plan_by_gap_reads_every_field_and_no_larger_hole(
    problem: tuple[list[Field], Rules], max_gap: int
) -> None:
    fields, rules = problem
    blocks = planned(fields, rules, max_gap=max_gap)
    check(fields, rules, blocks)
    assert all(end - start <= max_gap for block in blocks for start, end in holes(fields, block))


@settings(max_examples=examples(60))
@given(problem=problems(), request=PRICES, register=PRICES)
def test_a_plan_by_cost_reads_every_field(
    problem: tuple[list[Field], Rules], request: float, register: float
) -> None:
    fields, rules = problem
    check(fields, rules, planned(fields, rules, cost=(request, register)))


@settings(max_examples=examples(60))
@given(problem=problems(), request=PRICES, register=PRICES, max_gap=st.integers(0, 60))
def test_no_plan_is_cheaper_than_the_one_by_cost(
    problem: tuple[list[Field], Rules], request: float, register: float, max_gap: int
) -> None:
    fields, rules = problem
    best = cost(requests(planned(fields, rules, cost=(request, register))), request, register)
    by_gap = planned(fields, rules, max_gap=max_gap)
    assert best <= cost(requests(by_gap), request, register) + 1e-6
    assert best <= cost(fields, request, register) + 1e-6


@settings(max_examples=examples(60))
@given(problem=problems(), request=PRICES, register=PRICES)
def test_the_plan_by_cost_is_the_best_of_all_ways_to_cut(
    problem: tuple[list[Field], Rules], request: float, register: float
) -> None:
    fields, rules = [field for field in problem[0][:9] if field[0] == problem[0][0][0]], problem[1]
    ordered = sorted(fields)
    ways = []
    for cuts in itertools.product([False, True], repeat=max(len(ordered) - 1, 0)):
        blocks: list[list[Field]] = []
        for field, cut in zip(ordered, (True, *cuts), strict=False):
            if cut:
                blocks.append([])
            blocks[-1].append(field)
        joined = [whole(block) for block in blocks]
        if all(is_allowed(block, one, rules) for block, one in zip(blocks, joined, strict=True)):
            ways.append(cost(joined, request, register))
    found = cost(requests(planned(fields, rules, cost=(request, register))), request, register)
    assert found == pytest.approx(min(ways, default=0))


@settings(max_examples=examples(60))
@given(problem=problems(ranges=False), fill=st.integers(0, 125))
def test_a_plan_by_gap_needs_no_more_requests_than_max_insert(
    problem: tuple[list[Field], Rules], fill: int
) -> None:
    fields, rules = problem
    blocks = planned(fields, rules, max_gap=fill)
    assert len(blocks) <= max_insert(fields, rules, fill)


@settings(max_examples=examples(60))
@given(problem=problems(ranges=False), request=st.sampled_from([0.0, 1.0, 50.0]))
def test_where_registers_cost_nothing_no_rule_needs_fewer_requests(
    problem: tuple[list[Field], Rules], request: float
) -> None:
    fields, rules = problem
    blocks = planned(fields, rules, cost=(request, 0.0))
    assert len(blocks) <= max_insert(fields, rules, 2000)


@settings(max_examples=examples(60))
@given(problem=problems(ranges=False), request=st.just(0.0))
def test_where_requests_cost_nothing_no_hole_is_read(
    problem: tuple[list[Field], Rules], request: float
) -> None:
    fields, rules = problem
    blocks = planned(fields, rules, cost=(request, 1.0))
    assert not any(holes(fields, block) for block in blocks)


def test_the_price_of_a_request_decides() -> None:
    fields: list[Field] = [("coils", 0, 1), ("coils", 161, 1), ("holding_registers", 0, 1)]
    # 160 bits take the room of 10 registers.
    apart = plan_blocks(fields, cost=(9.9, 1.0))
    together = plan_blocks(fields, cost=(10.1, 1.0))
    assert (len(apart), len(together)) == (3, 2)


@pytest.mark.parametrize(
    ("field", "rules", "error"),
    [
        (("coils", 0, 0), {}, "count is 0"),
        (("holding_registers", 0, 126), {}, "126 items, one request reads at most 125"),
        (("holding_registers", 0, 9), {"max_registers": 8}, "9 items"),
        (("coils", 65535, 2), {}, "beyond address 65535"),
        (("coils", 5, 2), {"forbidden": [("coils", 6, 7)]}, "forbidden"),
        (("inputs", 0, 1), {}, "inputs"),
        (("coils", 0, 1), {"max_gap": -1}, "max_gap is -1"),
        (("coils", 0, 1), {"max_bits": 2001}, "max_bits is 2001"),
        (("coils", 0, 1), {"cost": (-1.0, 0.0)}, "cost is -1, 0, allowed: two numbers, 0 or more"),
        (("coils", 0, 1), {"cost": (math.nan, 0.0)}, "cost is NaN, 0, allowed: two numbers"),
        (("coils", 0, 1), {"cost": (1.0, 0.0), "max_gap": 0}, "max_gap and cost: give one"),
    ],
)
def test_what_can_not_be_read_is_an_error(field: Any, rules: Any, error: str) -> None:
    with pytest.raises(ValueError, match=error):
        plan_blocks([field], **rules)


# The plan explained.


HOLDING: tuple[Field, ...] = (
    ("holding_registers", 0, 10),
    ("holding_registers", 12, 4),
    ("holding_registers", 40, 1),
    ("holding_registers", 50, 2),
    ("holding_registers", 300, 200),
    ("coils", 3, 1),
)


def ends(rules: read_plans.Rules, reads: Sequence[Field] = HOLDING) -> list[str]:
    return [block.ends for block in read_plans.plan(reads, rules).blocks]


def test_every_block_says_why_it_ends() -> None:
    gaps: read_plans.Rules = {"max_gap": 5, "forbidden": [("holding_registers", 45, 46)]}
    assert ends(gaps) == [
        "another area",
        "gap: 24, max_gap is 5",
        "forbidden: 45",
        "gap: 248, max_gap is 5",
        "limit: 200 with the next read, allowed: 125",
        "nothing more to read",
    ]
    readable: read_plans.Rules = {"max_gap": 65535, "readable": [("holding_registers", 0, 20)]}
    assert ends(readable)[1:3] == ["not readable: 16 to 39", "not readable: 41 to 49"]
    assert ends({"cost": (1.0, 0.1)})[1] == "gap: 24, which costs more than a request"


def test_a_block_tells_its_reads_holes_and_cost() -> None:
    plan = read_plans.plan(HOLDING, {"cost": (3.0, 0.1)})
    block = plan.blocks[1]
    assert (block.address, block.count, block.reads) == (0, 52, (0, 1, 2, 3))
    assert block.holes == ((10, 2), (16, 24), (41, 9))
    assert block.cost == pytest.approx(8.2)
    assert plan.cost == pytest.approx(3 + 0.1 / 16 + 8.2 + 2 * 3 + 20)
    assert plan.unwanted == 35
    assert read_plans.plan(HOLDING, {"max_gap": 0}).cost is None


def test_a_long_read_is_in_several_blocks() -> None:
    plan = read_plans.plan([("input_registers", 5, 300)], {"max_registers": 100})
    assert [(b.address, b.count, b.reads) for b in plan.blocks] == [
        (5, 100, (0,)), (105, 100, (0,)), (205, 100, (0,)),
    ]  # fmt: skip


def test_a_forbidden_read_is_named() -> None:
    with pytest.raises(ValueError, match="coils 3 overlaps the forbidden range 1 to 8"):
        read_plans.plan(HOLDING, {"forbidden": [("coils", 1, 9)]})


@settings(max_examples=examples(60))
@given(problem=problems(ranges=False), fill=st.integers(0, 125))
def test_the_preset_max_insert_is_telegrafs(problem: tuple[list[Field], Rules], fill: int) -> None:
    fields, rules = problem
    limits: Any = rules
    assert read_plans.preset(fields, limits, "max_insert", fill) == max_insert(fields, rules, fill)


@pytest.mark.parametrize(
    ("reads", "preset", "fill", "requests"),
    [
        (HOLDING, "none", 0, 7),
        (HOLDING, "max_insert", 0, 7),
        (HOLDING, "max_insert", 2, 6),
        (HOLDING, "max_insert", 24, 4),
        # A register that two fields share is read twice by none.
        ([("coils", 0, 8), ("coils", 3, 1), ("coils", 8, 2)], "none", 0, 3),
        ([("coils", 0, 8), ("coils", 3, 1), ("coils", 8, 2)], "max_insert", 0, 1),
        ([("coils", 0, 8), ("coils", 8, 2)], "none", 0, 1),
    ],
)
def test_presets_count_the_requests_of_other_rules(
    reads: Sequence[Field], preset: Preset, fill: int, requests: int
) -> None:
    assert read_plans.preset(reads, {}, preset, fill) == requests


# The command.

CONFIGURATION = """\
memories: {plant: {holding_registers: 100}}
devices:
  meter:
    url: tcp://10.0.0.9
    unit: 7
    interval: 0.5
    reads:
      - area: input_registers
        address: 0
        count: 10
        into: {memory: plant, area: holding_registers, address: 0}
      - area: input_registers
        address: 14
        count: 2
        into: {memory: plant, area: holding_registers, address: 10}
      - area: input_registers
        address: 30
        count: 1
        into: {memory: plant, area: holding_registers, address: 12}
    max_gap: 4
  other:
    url: udp://10.0.0.10
    unit: 1
    interval: 60
    enabled: false
    reads: [{area: coils, address: 0, count: 2001}]
    forward: [{url: "raw://10.0.0.11:9000", unit: 1}]
"""


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "plant.yaml"
    path.write_text(CONFIGURATION)
    return str(path)


def test_the_plan_of_a_configuration(file: str) -> None:
    assert done("check", "plan", file) == [
        "meter: tcp://10.0.0.9 unit 7, every 0.5 s",
        "",
        "area             address  count  reads  gaps   why it ends",
        "input_registers        0     16  0, 1   10-13  gap: 14, max_gap is 4",
        "input_registers       30      1  2             nothing more to read",
        "",
        "2 requests, 4 extra addresses read",
        "",
        "other: udp://10.0.0.10 unit 1, not polled",
        "",
        "area   address  count  reads  gaps  why it ends",
        "coils        0   2000  0            limit: 2001 with the next read, allowed: 2000",
        "coils     2000      1  0            nothing more to read",
        "",
        "2 requests",
    ]


def test_the_plan_of_a_configuration_for_programs(file: str) -> None:
    told = answer(
        "check", "plan", file, "--device", "meter", "--preset", "max_insert", "--fill", "14"
    )
    [plan] = told["plans"]
    blocks = plan.pop("blocks")
    assert plan == {
        "device": "meter",
        "target": "tcp://10.0.0.9",
        "unit": 7,
        "enabled": True,
        "interval": 0.5,
        "requests": 2,
        "unwanted": 4,
        "cost_ms": None,
        "reads": [
            {"area": "input_registers", "address": 0, "count": 10},
            {"area": "input_registers", "address": 14, "count": 2},
            {"area": "input_registers", "address": 30, "count": 1},
        ],
        "compared": {"preset": "max_insert", "fill": 14, "requests": 1},
    }
    assert blocks[0] == {
        "area": "input_registers",
        "address": 0,
        "count": 16,
        "reads": [0, 1],
        "holes": [{"address": 10, "count": 4}],
        "cost_ms": None,
        "ends": "gap: 14, max_gap is 4",
    }


def test_the_plan_of_a_long_array_ends_where_an_element_ends(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    tags = "{flows: {area: input_registers, address: 0, type: 'uint32[100]'}}"
    file.write_text(f"devices:\n  a: {{url: tcp://10.0.0.5, interval: 1, tags: {tags}}}\n")
    counts = [124, 76], [100, 100]
    for options, expected in zip(([], ["--max-registers", "101"]), counts, strict=True):
        [plan] = answer("check", "plan", str(file), *options)["plans"]
        assert [block["count"] for block in plan["blocks"]] == expected


def test_options_take_the_place_of_what_a_configuration_says(file: str) -> None:
    assert done("check", "plan", file, "--device", "meter", "--max-gap", "14")[-1] == (
        "1 request, 18 extra addresses read"
    )
    priced = done("check", "plan", file, "--device", "meter", "--cost", "5ms:.5ms")
    assert priced[-1] == "2 requests, 4 extra addresses read, 18.5 ms"
    assert "  ms  why it ends" in priced[2]


READS = ("hr:0", "10", "holding:12-15", "coils:0x3")


def test_the_plan_of_reads() -> None:
    lines = done("check", "plan", "tcp://plc", *READS, "--max-gap", "2", "--preset", "none")
    assert lines[0] == "tcp://plc"
    assert lines[-2:] == ["2 requests, 2 extra addresses read", "none: 3 requests"]
    forbidden = done(
        "check", "plan", "tcp://plc", *READS, "--max-gap", "9", "--forbidden", "hr:10-10"
    )
    assert "forbidden: 10" in forbidden[4]
    plans = answer("check", "plan", "tcp://plc", *READS, "--readable", "hr:0-10", "--max-gap", "9")[
        "plans"
    ]
    assert plans[0]["blocks"][1]["ends"] == "not readable: 10 to 11"
    assert plans[0]["compared"] is None


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("tcp://plc",), "URL requires at least one ITEM, as in hr:100 20."),
        (("tcp://plc", *READS, "--device", "a"), "--device requires FILE."),
        (("tcp://plc", *READS, "--fill", "1"), "--fill requires --preset max_insert."),
        (("tcp://plc", *READS, "--preset", "none", "--fill", "1"), "--fill requires"),
        (("tcp://plc", *READS, "--max-gap", "1", "--cost", "1ms:1ms"), "can't be used together"),
        (("tcp://plc", "hr:0", "0"), "'hr:0': 0 addresses"),
        (("tcp://plc", "hr:65535", "2"), "the last address is 65535"),
        (("tcp://plc", "xx:0"), "'xx' is not an area"),
        (("tcp://plc", *READS, "--cost", "1"), "'1' is not REQUEST:REGISTER"),
        (("tcp://plc", *READS, "--forbidden", "hr:3-1"), "'hr:3-1' is not AREA:FIRST-LAST"),
        (
            ("tcp://plc", *READS, "--forbidden", "hr:9"),
            "holding_registers 0 to 9 overlaps the forbidden",
        ),
        (("http://plc", *READS), "is not the URL of a device"),
    ],
)
def test_wrong_usage_of_plan_is_told(words: tuple[str, ...], error: str) -> None:
    assert error in usage_error("check", "plan", *words)


def test_wrong_usage_of_plan_with_a_file_is_told(file: str, tmp_path: Path) -> None:
    assert "has no device 'metr', allowed: meter, other" in usage_error(
        "check", "plan", file, "--device", "metr"
    )
    assert "ITEM requires URL" in usage_error("check", "plan", file, *READS)
    empty = tmp_path / "empty.yaml"
    rest = {"bind": "127.0.0.1:1", "sources": ["127.0.0.1"], "tokens": "none"}
    empty.write_text(json.dumps({"memories": {"a": {"coils": 1}}, "rest": rest}))
    assert "has no devices." in usage_error("check", "plan", str(empty))


TAGGED = """\
profiles:
  meter:
    tags:
      power: {{area: input_registers, address: 0, type: float32}}
      energy:
        area: input_registers
        address: 20
        scale: {{from: {{area: input_registers, address: 22, type: int16}}, as: exponent}}
devices:
  meter:
    url: {url}
    interval: 0.02
    profile: meter
    max_gap: 2
    reads: [{{area: input_registers, address: 4, count: 3}}]
    forward: [{{url: "raw://127.0.0.1:9", unit: 1}}]
    tags:
      alarm: {{area: input_registers, address: 4, type: "bit:0"}}
      fault: {{area: input_registers, address: 4, type: "bit:1"}}
  doors:
    url: tcp://10.0.0.9
    interval: 60
    tags: {{{doors}}}
"""


@pytest.fixture
def tagged(tmp_path: Path) -> Path:
    path = tmp_path / "tagged.yaml"
    doors = ", ".join(f"d{at}: {{area: coils, address: {at}}}" for at in range(9))
    path.write_text(TAGGED.format(url="tcp://10.0.0.8", doors=doors))
    return path


def test_a_plan_names_reads_and_tags(tagged: Path) -> None:
    assert done("check", "plan", str(tagged)) == [
        "meter: tcp://10.0.0.8 unit 1, every 0.02 s",
        "",
        "area             address  count  reads                   gaps  why it ends",
        "input_registers        0      7  power, alarm, fault, 0  2-3   gap: 13, max_gap is 2",
        "input_registers       20      3  energy                        nothing more to read",
        "",
        "2 requests, 2 extra addresses read",
        "",
        "doors: tcp://10.0.0.9 unit 1, every 60 s",
        "",
        "area   address  count  reads                           gaps  why it ends",
        "coils        0      9  d0, d1, d2, d3, d4, d5, 3 more        nothing more to read",
        "",
        "1 request",
    ]
    [plan] = answer("check", "plan", str(tagged), "--device", "meter")["plans"]
    assert [read.get("tags") for read in plan["reads"]] == [
        None,
        ["power"],
        ["energy"],
        ["alarm", "fault"],
    ]
    assert [block["reads"] for block in plan["blocks"]] == [[1, 3, 0], [2]]


def test_the_plan_is_what_a_device_is_asked(tagged: Path) -> None:
    requests: list[tuple[int, int]] = []

    def answered(request: wire.Frame) -> bytes:
        requests.append(asked(request))
        return data(request)

    with Fake(answered) as fake:
        tagged.write_text(tagged.read_text().replace("tcp://10.0.0.8", fake.url))
        [plan] = answer("check", "plan", str(tagged), "--device", "meter")["plans"]
        with Appliance(load(tagged)):
            wire.until(lambda: len(requests) >= 4, "it was polled twice")
    places = [(block["address"], block["count"]) for block in plan["blocks"]]
    assert requests[:4] == places * 2

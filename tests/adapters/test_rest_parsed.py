"""Commands that the core parses: they have the effect that all other commands have."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import holdfast
from holdfast._core import ParsedWrites
from holdfast.events.audit import Audit, verify
from holdfast.ingest import Grant, MemoryAccess, Refused
from holdfast.types import AREAS
from support import web, wire
from support.audits import full, lines, writes
from support.cases import examples

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

SIZE = 16
GOOD = web.command("holding_registers", 3, [0, 1, 65535])
TEXT = json.dumps(GOOD)
PLAIN = [
    TEXT,
    f" \t\r\n{TEXT}\n ",
    json.dumps(GOOD, separators=(",", ":")),
    json.dumps(GOOD, indent=2),
    json.dumps(dict(reversed(GOOD.items()))),
    json.dumps(web.command("coils", 0, [1, 0, 1, 1, 0, 0, 0, 1, 1])),
    json.dumps(web.command("input_registers", SIZE - 1, [7])),
    json.dumps(web.command("holding_registers", 0, [5], "other")),
]
"""What the core parses."""

OTHERS = [
    "",
    "{}",
    "[]",
    f"[{TEXT}]",
    TEXT + "x",
    TEXT + TEXT,
    TEXT[:-1],
    TEXT.replace("3", "3.0"),
    TEXT.replace("3", "3e0"),
    TEXT.replace("3", "03"),
    TEXT.replace("3", "-0"),
    TEXT.replace("3", "-1"),
    TEXT.replace("3", "70000"),
    TEXT.replace("3", str(10**30)),
    TEXT.replace("3", "true"),
    TEXT.replace("1,", "01,"),
    TEXT.replace("1,", "1.5,"),
    TEXT.replace("1,", "1e1,"),
    TEXT.replace("1,", "1,,"),
    TEXT.replace("1,", "null,"),
    TEXT.replace("65535", "65536"),
    TEXT.replace("65535", "100000"),
    TEXT.replace("65535", "65535,"),
    TEXT.replace("plant_a", "plant\\u005fa"),
    TEXT.replace("plant_a", "plänt"),
    TEXT.replace("plant_a", "plant_b"),
    TEXT.replace("plant_a", "\x7f"),
    TEXT.replace("holding", "holding\\n"),
    TEXT.replace("holding_registers", "relays"),
    TEXT.replace("}", ', "unit": 1}'),
    TEXT.replace("}", ', "address": 4}'),
    TEXT.replace("}", ', "bools": [1]}'),
    TEXT.replace("values", "bools"),
    json.dumps({key: value for key, value in GOOD.items() if key != "area"}),
    json.dumps(web.command("coils", 0, [True, False])),
    json.dumps(web.command("coils", 0, [2])),
    json.dumps(web.command("coils", SIZE, [1])),
    json.dumps(web.command("holding_registers", 0, [])),
    json.dumps(web.command("holding_registers", SIZE - 1, [1, 2])),
    json.dumps(web.command("holding_registers", 0, [1] * 200)),
]


def memories() -> dict[str, holdfast.Memory]:
    sizes: dict[str, Any] = dict.fromkeys(AREAS, SIZE)
    return {
        "plant_a": holdfast.Memory(**sizes),
        "other": holdfast.Memory(holding_registers=SIZE),
    }


def content(of: dict[str, holdfast.Memory]) -> list[object]:
    return [memory.read(area, 0, SIZE) for memory in of.values() for area in memory.areas]


class Rig:
    """REST with an audit log, and the same without REST, for comparison."""

    def __init__(self, folder: Path) -> None:
        self.log = folder / "audit.log"
        self.memories, self.compared = memories(), memories()
        self.audit = Audit(self.log, max_bytes=10**7, keep=1, fail_closed=True)
        self.service = web.Service(self.memories, audit=self.audit, max_body=1024)
        self.other_log = folder / "other.log"
        self.other_audit = Audit(self.other_log, max_bytes=10**7, keep=1, fail_closed=True)
        self.general = MemoryAccess("rest", self.compared, self.other_audit)
        self.parsed = 0

    def expected(self, body: bytes) -> dict[str, object]:
        grant = Grant("anyone", frozenset(self.compared), frozenset(AREAS))
        try:
            return self.general.ingest(body, grant, "-").answer()
        except Refused as refused:
            return refused.answer()


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    made = Rig(tmp_path)
    real = MemoryAccess.begin_parsed

    def begin(self: MemoryAccess, writes: ParsedWrites, grant: Grant) -> Callable[[], Any]:
        finish = real(self, writes, grant)

        def counted() -> Any:
            found = finish()
            made.parsed += len(found)
            return found

        return counted

    monkeypatch.setattr(MemoryAccess, "begin_parsed", begin)
    with web.supervised(made.service.supervisor, made.service.listener):
        yield made
    made.audit.close()
    made.other_audit.close()


class Line:
    """A connection on which each request arrives at once. The first one makes its head known."""

    def __init__(self, rig: Rig) -> None:
        self.socket = socket.create_connection(rig.service.address, wire.DEADLINE)

    def send(self, body: bytes) -> None:
        self.socket.sendall(web.post(body))

    def answer(self) -> web.Answer:
        reply = http.client.HTTPResponse(self.socket)
        reply.begin()
        return web.Answer(reply.status, dict(reply.getheaders()), reply.read())

    def ask(self, body: bytes) -> web.Answer:
        self.send(body)
        return self.answer()

    def close(self) -> None:
        self.socket.close()


@pytest.fixture
def line(rig: Rig) -> Iterator[Line]:
    made = Line(rig)
    assert made.ask(TEXT.encode()).status == 200
    rig.expected(TEXT.encode())
    with contextlib.closing(made):
        yield made


def compare(rig: Rig, line: Line, body: bytes) -> None:
    answer, expected = line.ask(body), rig.expected(body)
    assert answer.json == expected
    assert (answer.status == 200) == (expected["status"] == "accepted")
    assert content(rig.memories) == content(rig.compared)


def recorded(file: Path) -> list[bytes]:
    """The lines as they are, without the time, the place in the chain, and the peer."""
    found = []
    for line in file.read_bytes().splitlines():
        _, peer, rest = line.partition(b',"peer":"')
        if peer:
            found.append(rest.partition(b'"')[2])
    return found


@pytest.mark.parametrize("body", [*PLAIN, *OTHERS])
def test_a_command_that_is_parsed_by_the_core_has_the_effect_of_others(
    rig: Rig, line: Line, body: str
) -> None:
    compare(rig, line, body.encode())
    assert rig.parsed == (body in PLAIN)
    assert recorded(rig.log) == recorded(rig.other_log)
    refused = rig.service.memory_access.counts(), rig.general.counts()
    assert refused[0] == refused[1]


@settings(max_examples=examples(100), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from(PLAIN),
    st.lists(st.tuples(st.floats(0, 1), st.sampled_from('{}[]",:. \\019-eaE\n'), st.booleans())),
)
def test_so_has_everything_that_looks_like_one(
    rig: Rig, line: Line, text: str, changes: list[tuple[float, str, bool]]
) -> None:
    for place, put, replaces in changes[:3]:
        at = int(place * len(text))
        text = text[:at] + put + text[at + replaces :]
    compare(rig, line, text.encode())
    assert recorded(rig.log) == recorded(rig.other_log)


def test_a_body_above_the_limit_is_refused(rig: Rig, line: Line) -> None:
    body = TEXT + " " * (1024 - len(TEXT))
    assert line.ask(body.encode()).status == 200
    assert (rig.parsed, line.ask(body.encode() + b" ").status) == (1, 413)


def test_names_are_recorded_as_json(tmp_path: Path) -> None:
    name = 'a "b" \\ \x1f ü'
    audit = Audit(tmp_path / "audit.log", max_bytes=10**6, keep=1)
    access = MemoryAccess(name, {name: holdfast.Memory(coils=8)}, audit)
    access.write([web.command("coils", 1, [1, 0], name)], Grant(name, (name,), AREAS), name)
    audit.close()
    given: dict[str, Any] = {
        "listener": name,
        "peer": name,
        "source": name,
        "function": "write",
        "memory": name,
    }
    given |= {"area": "coils", "address": 1, "values": [1, 0], "outcome": "done"}
    expected = json.dumps(given, ensure_ascii=False, separators=(",", ":"))
    assert (tmp_path / "audit.log").read_text().endswith(f",{expected[1:]}\n")


def test_a_request_with_another_head_is_not_parsed(rig: Rig, line: Line) -> None:
    other = web.post(TEXT.encode(), "X-New: 1")
    for parsed in (0, 1):
        line.socket.sendall(other)
        assert line.answer().status == 200
        assert rig.parsed == parsed


def test_a_long_head_is_not_remembered(rig: Rig, line: Line) -> None:
    for _ in range(3):
        line.socket.sendall(web.post(TEXT.encode(), f"X-New: {'1' * 2048}"))
        assert line.answer().status == 200
    assert rig.parsed == 0


def test_refused_requests_displace_no_head(rig: Rig, line: Line) -> None:
    """There is room for 64. Good ones may displace each other; all are answered."""
    for number in range(200):
        line.socket.sendall(web.head("GET", f"/none/{number}"))
        assert line.answer().status == 404
    assert line.ask(TEXT.encode()).status == 200
    assert rig.parsed == 1
    for number in range(200):
        line.socket.sendall(web.post(TEXT.encode(), f"X-New: {number}"))
        assert line.answer().status == 200
    assert [line.ask(TEXT.encode()).status for _ in range(2)] == [200, 200]


def test_no_write_of_a_batch_is_carried_out_without_its_record(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    with contextlib.ExitStack() as stack:
        lines_of = [stack.enter_context(contextlib.closing(Line(rig))) for _ in range(8)]
        for each in lines_of:
            assert each.ask(TEXT.encode()).status == 200
        before = content(rig.memories)
        make_room = full(monkeypatch)
        body = json.dumps(web.command("holding_registers", 0, [9])).encode()
        for each in lines_of:
            each.send(body)
        for each in lines_of:
            answer = each.answer()
            assert (answer.status, answer.json["reason"]) == (503, "unrecorded")
        assert content(rig.memories) == before
        assert rig.service.refusals() == {"unrecorded": 8}
        make_room()
        for each in lines_of:
            assert each.ask(body).status == 200
    found = [line["outcome"] for line in lines(rig.log) if line.get("address") == 0]
    assert found == [*["unrecorded"] * 8, *["done"] * 8]
    assert verify([rig.log]).error is None


def test_the_order_of_lines_is_the_order_of_writes(rig: Rig) -> None:
    """Also with commands that the core does not parse among them."""
    per_writer, writers = 60, 8

    def write(writer: int) -> None:
        with contextlib.closing(Line(rig)) as line:
            for number in range(per_writer):
                command = web.command("holding_registers", 0, [writer * per_writer + number])
                body: Any = [command] if number % 7 == 0 else command
                assert line.ask(json.dumps(body).encode()).status == 200

    with ThreadPoolExecutor(writers) as threads:
        list(threads.map(write, range(writers)))
    found = [line["values"][0] for line in writes(rig.log)]
    assert sorted(found) == list(range(writers * per_writer))
    for writer in range(writers):
        of_writer = [value for value in found if value // per_writer == writer]
        assert of_writer == sorted(of_writer)
    assert rig.memories["plant_a"].read("holding_registers", 0, 1) == found[-1:]
    assert rig.service.memory_access.counts()["accepted"] == writers * per_writer
    assert rig.parsed > writers * per_writer // 2
    findings = verify([rig.log])
    assert (findings.error, findings.gaps) == (None, False)


def test_a_range_that_is_mirrored_meanwhile_is_refused(
    rig: Rig, line: Line, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The core has checked the write before that."""
    memory, real = rig.memories["plant_a"], MemoryAccess.begin_parsed

    def begin(self: MemoryAccess, parsed: ParsedWrites, grant: Grant) -> Callable[[], Any]:
        memory.mirror([("holding_registers", 0, SIZE)])
        return real(self, parsed, grant)

    monkeypatch.setattr(MemoryAccess, "begin_parsed", begin)
    before = content(rig.memories)
    answer = line.ask(json.dumps(web.command("holding_registers", 0, [9])).encode())
    assert answer.json["reason"] == "mirrored"
    assert content(rig.memories) == before


@pytest.mark.parametrize("is_begun", [False, True])
def test_what_fails_takes_the_way_of_other_commands(
    rig: Rig,
    line: Line,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    is_begun: bool,
) -> None:
    def fails(*_: object) -> Any:
        raise RuntimeError("a fault")

    monkeypatch.setattr(MemoryAccess, "begin_parsed", (lambda *_: fails) if is_begun else fails)
    body = json.dumps(web.command("holding_registers", 0, [9])).encode()
    assert line.ask(body).status == 200
    assert rig.memories["plant_a"].read("holding_registers", 0, 1) == [9]
    assert [record.message for record in caplog.records].count("request_failed") == 1

"""Views: several ranges and tag lists in one stream, and the endpoints for tag lists."""

from __future__ import annotations

import json
import threading
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.gateway.endpoints import request_tags
from holdfast.tags import Tag, TagList
from support import gateways, web, wire
from support.fake_device import FakeDevice, exception, registers

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from support.event_streams import EventStream
    from support.gateways import Running

SOON = 0.01
"""Seconds from poll to poll."""
METER = """\
tags:
  voltage: {area: holding_registers, address: 0, type: uint16, scale: 0.1, unit: V}
  state: {area: holding_registers, address: 1, states: {0: off, 2: fault}}
  running: {area: coils, address: 3}
  setpoint: {area: holding_registers, address: 4, scale: 0.1, writable: true, min: 5, max: 30}
  alarm: {area: holding_registers, address: 5, type: "bit:3", order: BADC, writable: true}
"""
PROFILE = TagList([Tag("level", "input_registers", 2, "int16", unit="mm")])


@pytest.fixture
def gateway() -> Iterator[Running]:
    profiles = {"tank": PROFILE}
    with gateways.running(limits={"interval": SOON}, profiles=profiles) as started:
        yield started


def view(gateway: Running, port: int, *parts: Any, **body: Any) -> EventStream:
    usual = {"host": "127.0.0.1", "port": port, "interval": 10, "parts": parts}
    return gateway.stream("POST", "/watch/view", {**usual, **body})


def ranged(address: int, quantity: int = 1, function: int = 3, **more: Any) -> dict[str, Any]:
    return {"functionCode": function, "address": address, "quantity": quantity, **more}


def changed(stream: EventStream) -> Any:
    """The parts of the next event that has a change."""
    while not (parts := stream.next("change")["parts"]):
        pass
    return parts


def test_ranges_and_tag_lists_share_one_stream(
    gateway: Running, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [2304, 2, 0, 7])
    memory.write("input_registers", 2, [65535])
    parts = (ranged(2, 2, datatype="int16"), {"tags": METER}, {"profile": "tank"})
    stream = view(gateway, server.address[1], *parts)
    assert (stream.status, stream.kind) == (200, "text/event-stream")
    first = stream.next("view")
    assert first["stream"] is True
    registers, meter, tank = first["parts"]
    assert (registers["values"], registers["texts"], registers["errors"]) == (
        [0, 7],
        ["0", "7"],
        {},
    )
    assert meter["values"] == [230.4, 2, False, 0.0, False]
    assert meter["texts"] == ["230.4", "fault", "false", "0.0", "false"]
    assert [(tag["name"], tag["unit"]) for tag in meter["tags"][:2]] == [
        ("voltage", "V"),
        ("state", ""),
    ]
    assert meter["tags"][1]["states"] == {"0": "off", "2": "fault"}
    assert (tank["values"], tank["tags"][0]["unit"]) == ([-1], "mm")
    memory.write("holding_registers", 3, [8])
    assert changed(stream) == [{"part": 0, "values": [[1, 8]], "texts": [[1, "8"]]}]
    memory.write("holding_registers", 1, [0])
    assert changed(stream) == [{"part": 1, "values": [[1, 0]], "texts": [[1, "off"]]}]


def test_an_event_has_no_character_that_may_end_a_line(
    gateway: Running, server: holdfast.Server
) -> None:
    text = "A\x85B\u2028C\u2029D"
    tags = f"name,area,address,type,description\nlevel,ir,2,uint16,{text}\n"
    stream = view(gateway, server.address[1], {"tags": tags, "format": "csv"}, once=True)
    received = stream.reply.read().decode()
    _, data, _ = received.splitlines()
    described = json.loads(data.removeprefix("data: "))["parts"][0]["tags"]
    assert described[0]["description"] == text


def test_every_poll_has_an_event(gateway: Running, server: holdfast.Server) -> None:
    stream = view(gateway, server.address[1], ranged(0))
    first = stream.next("view")["time"]
    assert [stream.next("change")["parts"] for _ in range(3)] == [[], [], []]
    assert stream.next("change")["time"] >= first


def only(function: int, *, silent: bool = False) -> Callable[[bytes], bytes | None]:
    """A device with one function; others are refused, or not answered."""

    def answer(pdu: bytes) -> bytes | None:
        if pdu[0] == function:
            return registers(pdu, 5)
        return None if silent else exception(pdu, 1)

    return answer


def test_a_part_that_is_refused_costs_no_other_part(gateway: Running) -> None:
    with FakeDevice(only(3)) as device:
        stream = view(gateway, device.port, ranged(0, function=4), ranged(0))
        refused, there = stream.next("view")["parts"]
        assert refused["error"] == "Modbus exception: Illegal Function (code 0x1)"
        assert (refused["reason"], "values" in refused) == ("exception", False)
        assert (there["values"], "error" in there) == ([5], False)


def test_a_silent_part_is_asked_last(gateway: Running) -> None:
    with FakeDevice(only(3, silent=True)) as device:
        parts = (ranged(0, function=4), ranged(0))
        stream = view(gateway, device.port, *parts, timeout=50)
        assert stream.status == 500, "nothing was answered in the first poll"
        count = len(device.asked)
        # Long enough for the other part to be answered on a loaded machine.
        stream = view(gateway, device.port, *reversed(parts), timeout=1000)
        there, silent = stream.next("view")["parts"]
        assert (there["values"], silent["reason"]) == ([5], "timeout")
        stream.next("change")
        assert [pdu[0] for pdu in device.asked[count:]][:4] == [3, 4, 3, 4]


def test_a_part_that_fails_for_a_while_comes_back(gateway: Running) -> None:
    fails = iter([False, True, True])

    def answer(pdu: bytes) -> bytes:
        return exception(pdu, 6) if next(fails, False) else registers(pdu, 5)

    with FakeDevice(answer) as device:
        stream = view(gateway, device.port, ranged(0))
        assert stream.next("view")["parts"][0]["values"] == [5]
        error = "Modbus exception: Server Device Busy (code 0x6)"
        assert changed(stream) == [{"part": 0, "error": error, "reason": "exception", "code": 6}]
        assert changed(stream) == [{"part": 0, "error": None}]


def test_tags_without_a_value_say_why(gateway: Running) -> None:
    def answer(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        return exception(pdu, 2) if first <= 5 < first + count else registers(pdu, 0xFFFF)

    tags = """\
name,area,address,type
there,hr,4,uint16
absent,hr,5,uint16
digits,hr,6,bcd16
"""
    with FakeDevice(answer) as device:
        stream = view(gateway, device.port, {"tags": tags, "format": "csv"})
        [found] = stream.next("view")["parts"]
        assert found["values"] == [65535, None, None]
        assert found["errors"]["1"] == "Modbus exception: Illegal Data Address (code 0x2)"
        assert "digit" in found["errors"]["2"]


def test_a_number_of_a_long_array_is_from_one_request(gateway: Running) -> None:
    tags = "name,area,address,type\ncounters,hr,0,uint32[63]\n"
    with FakeDevice(lambda pdu: registers(pdu, 5)) as device:
        view(gateway, device.port, {"tags": tags, "format": "csv"}, once=True).next("view")
        assert [int.from_bytes(pdu[3:]) for pdu in device.asked] == [124, 2]


def test_a_scale_in_a_register_is_shown_and_not_written(
    gateway: Running, server: holdfast.Server, memory: holdfast.Memory
) -> None:
    tags = """\
name,area,address,type,order,scale,offset,unit,writable
power,hr,0,int16,,exponent sf,,W,yes
sf,hr,4,int16
"""
    memory.write("holding_registers", 0, [432, 0, 0, 0, 1])
    part = {"tags": tags, "format": "csv"}
    [event] = list(view(gateway, server.address[1], part, once=True))
    [found] = event.data["parts"]
    assert (found["values"], found["texts"]) == ([4320, 1], ["4320", "1"])
    assert found["tags"][0]["scale"] == {"from": "sf", "as": "exponent"}
    memory.write("holding_registers", 4, [0x8000])
    [event] = list(view(gateway, server.address[1], part, once=True))
    [found] = event.data["parts"]
    assert found["values"][0] is None
    assert "10^-32768" in found["errors"]["0"]
    answer = local(gateway, "/tags/value", {**part, "name": "power", "value": "4320"})
    assert "the scale is in holding_registers 4" in str(answer.json)


def test_a_view_ends_after_one_event_if_asked(gateway: Running, server: holdfast.Server) -> None:
    stream = view(gateway, server.address[1], ranged(0), {"tags": METER}, once=True, describe=False)
    [event] = list(stream)
    assert event.data["stream"] is False
    assert "tags" not in event.data["parts"][1]


def test_only_some_tags_are_read(gateway: Running, server: holdfast.Server) -> None:
    part = {"tags": METER, "only": ["state", "voltage"]}
    [found] = view(gateway, server.address[1], part, once=True).next("view")["parts"]
    assert [tag["name"] for tag in found["tags"]] == ["state", "voltage"]
    wrong = view(gateway, server.address[1], {"tags": METER, "only": ["stat"]})
    assert wrong.status == 400


def test_a_client_with_many_streams_gets_single_events(
    gateway: Running, server: holdfast.Server
) -> None:
    port = server.address[1]
    streams = [view(gateway, port, ranged(0), maxStreams=2) for _ in range(3)]
    begun = [stream.next("view")["stream"] for stream in streams]
    assert begun == [True, True, False]
    streams[0].close()
    while not view(gateway, port, ranged(0), maxStreams=2).next("view")["stream"]:
        pass


def test_a_full_gateway_answers_once(server: holdfast.Server) -> None:
    with gateways.running(limits={"interval": SOON, "streams": 1}) as gateway:
        held = view(gateway, server.address[1], ranged(0))
        held.next("view")
        second = view(gateway, server.address[1], ranged(0), maxStreams=4)
        assert second.next("view")["stream"] is False
        assert view(gateway, server.address[1], ranged(0)).status == 503


def test_a_map_leaves_a_connection_to_the_browser(
    gateway: Running, server: holdfast.Server
) -> None:
    held = view(gateway, server.address[1], ranged(0))
    held.next("view")
    body = {"host": "127.0.0.1", "port": server.address[1], "maxStreams": 1}
    answer = gateway.ask("/map", body)
    assert (answer.status, answer.json["error"]) == (
        503,
        "streams of this address: 1, which is maxStreams",
    )


@pytest.mark.parametrize(
    ("part", "says"),
    [
        ({}, "parts[1]: Missing required parameters: functionCode and address"),
        (7, "parts[1] is not an object"),
        ({"functionCode": 3, "address": 0, "quantity": 126}, "parts[1]: Quantity must be between"),
        ({"profile": "tanc"}, "parts[1]: no profile \"tanc\", allowed: tank; did you mean 'tank'?"),
        ({"tags": "x", "profile": "tank"}, "parts[1]: one of tags and profile is required"),
        ({"tags": "a: 1", "profiles": "b"}, 'parts[1]: "profiles" is not a parameter'),
        ({"tags": "tags:\n  a: {area: coil, address: 0}"}, "parts[1]: tags:2: tags.a.area"),
    ],
)
def test_wrong_parts_are_refused(
    gateway: Running, server: holdfast.Server, part: Any, says: str
) -> None:
    body = {"host": "127.0.0.1", "port": server.address[1], "parts": [ranged(0), part]}
    answer = gateway.ask("/watch/view", body)
    assert answer.status == 400
    assert says in answer.json["error"], answer.json["error"]


# Tag lists.


def local(gateway: Running, path: str, body: Any) -> Any:
    return gateway.client().ask("POST", f"/api/gateway{path}", body)


def test_profiles_are_listed(gateway: Running) -> None:
    answer = gateway.client().get("/api/gateway/profiles")
    assert answer.json == {"profiles": [{"name": "tank", "tags": 1}]}


def test_every_problem_of_a_list_is_told_with_its_line(gateway: Running) -> None:
    text = "name,area,address,type\na,hr,0,uint99\nb,hr,70000,uint16\n"
    answer = local(gateway, "/tags", {"tags": text, "format": "csv"})
    assert answer.status == 400
    first, second = answer.json["error"].split("\n")
    assert first.startswith("tags:2: tags.a.type: ")
    assert second.startswith("tags:3: tags.b.address: ")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("tags: {a: {area: coils, address: 0, type: 'bool[2000]'}}", None),
        ("{a: " * 3000, "nested too deeply"),
        ("[" * 30000, "nested too deeply"),
        ("a: &a [1,1,1,1,1,1,1,1]\nb: &b [*a,*a,*a,*a]\ntags: [*b,*b]", "tags"),
        ("just text", "allowed: a mapping"),
        ("\0", "U+0000"),
    ],
    ids=["array", "braces", "brackets", "aliases", "text", "nul"],
)
def test_hostile_lists_are_refused(gateway: Running, text: str, says: str | None) -> None:
    answer = local(gateway, "/tags", {"tags": text})
    assert answer.status == (200 if says is None else 400)
    assert says is None or says in answer.json["error"]


LONG = request_tags.SHORT_SIZE + 1


class Parser:
    """Parses tag lists in place of the gateway, once a test lets it."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self.resume = threading.Event()

    def __call__(self, text: str, is_csv: bool) -> TagList:  # noqa: ARG002
        self.begun.append(text)
        assert self.resume.wait(2 * wire.DEADLINE)
        return PROFILE


@pytest.fixture
def parser(monkeypatch: pytest.MonkeyPatch) -> Iterator[Parser]:
    parser = Parser()
    monkeypatch.setattr(request_tags, "_parsed", parser)
    yield parser
    parser.resume.set()


@pytest.fixture
def post(gateway: Running) -> Iterator[Callable[..., wire.Connection]]:
    """Sends a tag list from an address, which is then one of so many requests."""
    with ExitStack() as opened:

        def posted(text: str, source: str | None = None, *, pending: int) -> wire.Connection:
            body = json.dumps({"tags": text}).encode()
            more = "Content-Type: application/json", f"Content-Length: {len(body)}"
            connection = opened.enter_context(wire.Connection(gateway.address, source=source))
            connection.send(web.head("POST", "/api/gateway/tags", *more, "Connection: close"))
            connection.send(body)
            until_pending(gateway, pending)
            return connection

        yield posted


def until_pending(gateway: Running, count: int) -> None:
    active = gateway.gateway._app._active
    wire.until(lambda: active["requests"] == count, f"{count} requests")


def test_addresses_take_turns_with_their_lists(
    parser: Parser, post: Callable[..., wire.Connection]
) -> None:
    texts = [f"{name:<{LONG}}" for name in ("a1", "a2", "a3", "b1")]
    sources = None, None, None, "127.0.0.2"
    waiting = [
        post(text, source, pending=at)
        for at, (text, source) in enumerate(zip(texts, sources, strict=True), 1)
    ]
    parser.resume.set()
    for connection in waiting:
        [answer] = web.answers(connection.rest())
        assert answer.status == 200
    assert [text.strip() for text in parser.begun] == ["a1", "b1", "a2", "a3"]


def test_short_and_known_lists_do_not_wait_for_the_long_list_of_another_address(
    gateway: Running, post: Callable[..., wire.Connection], request: pytest.FixtureRequest
) -> None:
    known = {"tags": f"{'tags: {a: {area: coils, address: 0}}':<{LONG}}"}
    assert local(gateway, "/tags", known).status == 200
    parser = request.getfixturevalue("parser")
    post(f"{'long':<{LONG}}", "127.0.0.2", pending=1)
    wire.until(lambda: parser.begun, "the long list is being parsed")
    assert local(gateway, "/tags", known).status == 200
    post("short", pending=2)
    wire.until(lambda: parser.begun[1:] == ["short"], "the short list is being parsed")


def test_the_list_of_a_client_that_has_gone_is_not_parsed(
    gateway: Running, parser: Parser, post: Callable[..., wire.Connection]
) -> None:
    first = post("a", pending=1)
    post("b", "127.0.0.2", pending=2).close()
    until_pending(gateway, 1)
    last = post("c", "127.0.0.3", pending=2)
    parser.resume.set()
    for connection in (first, last):
        assert web.answers(connection.rest())[0].status == 200
    assert parser.begun == ["a", "c"]


def test_a_stop_does_not_wait_for_lists(parser: Parser) -> None:
    with gateways.running(limits={"ending": SOON}) as stopping:
        client = wire.Connection(stopping.address)
        body = b'{"tags": "a"}'
        more = "Content-Type: application/json", f"Content-Length: {len(body)}"
        client.send(web.head("POST", "/api/gateway/tags", *more) + body)
        wire.until(lambda: parser.begun, "it is being parsed")
        stopping.stop.set()
        with client:
            [answer] = web.answers(client.rest())
    assert answer.status == 503
    assert not parser.resume.is_set()


def test_lists_are_bounded(gateway: Running) -> None:
    def csv(lines: list[str]) -> str:
        return "\n".join(["name,area,address,type", *lines])

    many = csv([f"t{at},hr,{at},uint16" for at in range(2001)])
    answer = local(gateway, "/tags", {"tags": many, "format": "csv"})
    assert answer.json["error"] == "tags: found 2001 tags, allowed: up to 2000"
    long = csv([f"t{at},hr,0,uint16[200]" for at in range(101)])
    answer = local(gateway, "/tags", {"tags": long, "format": "csv"})
    assert answer.json["error"] == (
        "tags: found 20200 bits, registers and states, allowed: up to 20000"
    )


def test_aliases_do_not_multiply_what_a_list_takes(gateway: Running) -> None:
    states = ", ".join(f"{value}: s{value}" for value in range(1500))
    tags = [f"t{at}: {{area: holding_registers, address: {at}, states: *s}}" for at in range(1, 20)]
    first = f"t0: {{area: holding_registers, address: 0, states: &s {{{states}}}}}"
    text = "tags:\n  " + "\n  ".join([first, *tags])
    answer = local(gateway, "/tags", {"tags": text})
    assert answer.status == 400
    assert "values with aliases expanded, allowed: up to 20000" in answer.json["error"]


@pytest.mark.parametrize(
    ("name", "text", "form", "values", "shown"),
    [
        ("setpoint", "21.5", "registers", [215], "21.5"),
        ("alarm", "on", "mask", [0xF7FF, 0x0800], "true"),
        ("alarm", "0", "mask", [0xF7FF, 0], "false"),
    ],
)
def test_a_value_of_a_tag_is_encoded(
    gateway: Running, name: str, text: str, form: str, values: list[int], shown: str
) -> None:
    answer = local(gateway, "/tags/value", {"tags": METER, "name": name, "value": text})
    found = answer.json
    assert (found["form"], found["values"], found["text"]) == (form, values, shown)
    assert found["tag"]["name"] == name


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("setpoint", "21,5", "decimal comma, allowed: a decimal point, as in 21.5"),
        ("setpoint", "31", "31 is outside 5.0 to 30.0"),
        ("setpoint", "21.55", "between two values of the registers"),
        ("setpoint", "", "is not a number"),
        ("voltage", "230", "voltage can't be written: writable is not true in the tag list"),
        ("setpont", "1", "did you mean 'setpoint'?"),
    ],
)
def test_a_value_that_does_not_fit_is_refused(
    gateway: Running, name: str, text: str, says: str
) -> None:
    answer = local(gateway, "/tags/value", {"tags": METER, "name": name, "value": text})
    assert answer.status == 400
    assert says in answer.json["error"], answer.json["error"]


@pytest.mark.parametrize(
    ("datatype", "order", "given", "registers", "texts"),
    [
        ("uint16", "ABCD", [222], [222], ["222"]),
        ("int16", "ABCD", [-1], [0xFFFF], ["-1"]),
        ("float32", "CDAB", [222, 1e-7], [0, 0x435E, 0xBF95, 0x33D6], ["222", "1e-07"]),
        ("uint64", "ABCD", [2**64 - 1], [0xFFFF] * 4, ["18446744073709551615"]),
        ("bytes:3", "ABCD", ["0a0b0c"], [0x0A0B, 0x0C00], ["0a 0b 0c"]),
    ],
)
def test_the_registers_of_typed_values_are_told_before_a_write(
    gateway: Running,
    datatype: str,
    order: str,
    given: list[Any],
    registers: list[int],
    texts: list[str],
) -> None:
    asked = {"datatype": datatype, "byteOrder": order, "values": given}
    found = local(gateway, "/values", asked).json
    assert (found["values"], found["typedText"]) == (registers, texts)


@pytest.mark.parametrize(
    ("datatype", "given", "says"),
    [
        ("uint16", [70000], "values[0]:"),
        ("float32", [1, 1e39], "values[1]:"),
        ("float32", [0, 1e-50], "values[1]: 1e-50 is too small for float32, which would hold 0"),
        ("float64", [1] * 31, "124 registers, allowed: 123 in a request"),
        ("bit:3", [True], "use /api/modbus/write/mask"),
        ("uint17", [1], "uint17"),
    ],
)
def test_typed_values_that_can_not_be_written_are_refused_before_a_write(
    gateway: Running, datatype: str, given: list[Any], says: str
) -> None:
    answer = local(gateway, "/values", {"datatype": datatype, "values": given})
    assert answer.status == 400
    assert says in answer.json["error"], answer.json["error"]


LAMPS = """\
tags:
  lamps: {area: coils, address: 1, type: "bool[3]", writable: true}
"""


@pytest.mark.parametrize(
    ("text", "bits"),
    [
        ("[true,false,1]", [True, False, True]),
        ('["false","false","false"]', None),
        ("[false,false,false,true,true]", None),
        ("[true]", None),
        ("[]", None),
        ("[0.4,0,0]", None),
        ("[2,0,0]", None),
        ("[null,0,0]", None),
    ],
)
def test_bits_of_an_array_are_not_converted(
    gateway: Running, text: str, bits: list[bool] | None
) -> None:
    answer = local(gateway, "/tags/value", {"tags": LAMPS, "name": "lamps", "value": text})
    assert answer.status == (200 if bits else 400), answer.json
    assert answer.json.get("values") == bits

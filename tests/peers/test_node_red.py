"""The functions for Node-RED, run by node: a message goes in, a message or nothing comes out."""

from __future__ import annotations

import json
import subprocess
from typing import TYPE_CHECKING, Any

import pytest

from support.machine import tool
from support.paths import ROOT, VECTORS

if TYPE_CHECKING:
    from collections.abc import Callable

    Run = Callable[..., list[dict[str, Any]]]

FOLDER = ROOT / "examples" / "node-red"
CASES = json.loads((VECTORS / "raw_ingest.json").read_text())
SOURCES = {
    "packet": "raw-ingest-function.js",
    "one at a time": "one-at-a-time.js",
    "reply": "raw-ingest-reply.js",
}

# Runs a function's body for each message on standard input. In messages, {"hex": …} is a Buffer,
# {"now": …} sets the clock.
HARNESS = """
const source = require('fs').readFileSync(process.argv[1], 'utf8');
const body = new Function('msg', 'node', 'context', 'Date', source);
const stored = {};
const context = { get: (key) => stored[key], set: (key, value) => { stored[key] = value; } };
const plain = (msg) => msg && { ...msg,
    payload: Buffer.isBuffer(msg.payload) ? msg.payload.toString('hex') : msg.payload };
const messages = JSON.parse(require('fs').readFileSync(0, 'utf8'));
console.log(JSON.stringify(messages.map((msg) => {
    if (msg.payload && msg.payload.hex !== undefined) {
        msg.payload = Buffer.from(msg.payload.hex, 'hex');
    }
    if (msg.special) {
        msg.payload = { NaN: [NaN], infinite: [Infinity], hole: [1, , 3], big: [1n],
            string: '1', object: { 0: 1 }, nothing: null }[msg.special];
    }
    const clock = { now: () => msg.now || 0 };
    const told = { errors: [], warnings: [] };
    const node = {
        error: (text, about) => told.errors.push([text, about === msg]),
        warn: (text) => told.warnings.push(text),
    };
    const out = body(msg, node, context, clock);
    return { out: Array.isArray(out) ? out.map(plain) : plain(out), ...told };
})));
"""


@pytest.fixture
def run() -> Run:
    """Runs a function over messages; for each, what came out and which errors it told."""
    node = tool("node")

    def run_all(name: str, *messages: dict[str, Any]) -> list[dict[str, Any]]:
        result = subprocess.run(
            [node, "-e", HARNESS, str(FOLDER / SOURCES[name])],
            input=json.dumps(messages),
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert result.returncode == 0, result.stderr
        answers: list[dict[str, Any]] = json.loads(result.stdout)
        return answers

    return run_all


def target(name: str) -> dict[str, Any]:
    return {"unit": 1} if name == "v1" else {"memoryId": 1}


@pytest.mark.parametrize("name", ["v1", "crc"])
def test_packets_are_those_of_the_vectors(run: Run, name: str) -> None:
    messages, packets = [], []
    for case in CASES["accepted"]:
        packet = bytes.fromhex(case[name])
        payload = packet[10:] if name == "v1" else packet[12:-4]
        count = int.from_bytes(packet[8:10] if name == "v1" else packet[10:12], "big")
        where = {"area": case["area"], "address": case["address"], **target(name)}
        ready = {**where, "payload": {"hex": payload.hex()}}
        if case["area"] in ("coils", "discrete_inputs"):
            ready["count"] = count
            if "stray" not in case["name"]:
                values = case["values"]
                messages.append({**where, "payload": [bool(value) for value in values]})
                packets.append(packet)
        if "stray" not in case["name"]:
            messages.append({**where, "payload": case["values"]})
            packets.append(packet)
        messages.append(ready)
        packets.append(packet)

    answers = run("packet", *messages)
    assert [answer["errors"] for answer in answers] == [[]] * len(answers)
    assert [answer["out"]["payload"] for answer in answers] == [packet.hex() for packet in packets]


def test_a_packet_has_no_crc_where_none_is_expected(run: Run) -> None:
    message = {"area": "coils", "address": 0, "payload": [1], "memoryId": 1}
    with_crc, without = run("packet", {**message, "crc": "required"}, {**message, "crc": "none"})
    assert with_crc["out"]["payload"][:-8] == without["out"]["payload"]
    assert without["out"]["payload"] == "52490100010000010000000101"


def test_a_packet_has_up_to_65535_values(run: Run) -> None:
    message = {"area": "holding_registers", "address": 0, "unit": 1}
    most, too_many = run(
        "packet", {**message, "payload": [65535] * 65535}, {**message, "payload": [0] * 65536}
    )
    assert most["out"]["payload"] == "5249010300010000ffff" + "ffff" * 65535
    assert too_many["out"] is None


def test_a_message_keeps_what_else_it_holds(run: Run) -> None:
    message = {"area": "coils", "address": 0, "payload": [1], "unit": 1, "topic": "t"}
    assert run("packet", {**message, "rawIngest": 7})[0]["out"] == {
        **message,
        "payload": "5249010100010000000101",
    }


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"payload": [65536]}, "payload[0] is 65536, allowed: integers 0 to 65535"),
    ({"payload": [0, -1]}, "payload[1] is -1, allowed: integers 0 to 65535"),
    ({"payload": [1.5]}, "payload[0] is 1.5, allowed: integers 0 to 65535"),
    ({"payload": ["1"]}, "payload[0] is 1, allowed: integers 0 to 65535"),
    ({"payload": [True]}, "payload[0] is true, allowed: integers 0 to 65535"),
    ({"payload": [None]}, "payload[0] is null, allowed: integers 0 to 65535"),
    ({"payload": [[1]]}, "payload[0] is [1], allowed: integers 0 to 65535"),
    ({"special": "NaN"}, "payload[0] is NaN, allowed: integers 0 to 65535"),
    ({"special": "infinite"}, "payload[0] is Infinity, allowed: integers 0 to 65535"),
    ({"special": "hole"}, "payload[1] is missing, allowed: integers 0 to 65535"),
    ({"special": "big"}, "payload[0] is 1, allowed: integers 0 to 65535"),
    ({"special": "string"}, "payload is 1, allowed: an array and a Buffer"),
    ({"special": "object"}, 'payload is {"0":1}, allowed: an array and a Buffer'),
    ({"special": "nothing"}, "payload is null, allowed: an array and a Buffer"),
    ({"area": "coils", "payload": [2]}, "payload[0] is 2, allowed: 0, 1, false, true"),
    ({"area": "coils", "payload": ["1"]}, "payload[0] is 1, allowed: 0, 1, false, true"),
    ({"payload": []}, "the number of values is 0, allowed: 1 to 65535"),
    ({"payload": {"hex": "00"}}, "the number of values is 0.5, allowed: 1 to 65535"),
    ({"payload": {"hex": ""}}, "the number of values is 0, allowed: 1 to 65535"),
    ({"area": "coils", "payload": {"hex": "01"}}, "count is missing, allowed: 1 to 65535"),
    (
        {"area": "coils", "payload": {"hex": "01"}, "count": 9},
        "9 bits are 2 bytes, payload has 1",
    ),
    ({"area": "registers"}, "area is registers, allowed: coils, discrete_inputs"),
    ({"area": 3}, "area is 3, allowed: coils, discrete_inputs"),
    ({"address": 65536}, "address is 65536, allowed: 0 to 65535"),
    ({"address": "0"}, "address is 0, allowed: 0 to 65535"),
    ({"address": 65535}, "2 values from address 65535, the last address is 65535"),
    ({"unit": 65536}, "unit is 65536, allowed: 0 to 65535"),
    ({"unit": None}, "unit is null, allowed: 0 to 65535"),
    ({"memoryId": 1}, "give either unit (format v1) or memoryId (format crc)"),
    ({"crc": "none"}, "crc is none, allowed: 'required' or 'none' with memoryId"),
]


def test_what_can_not_be_is_refused_with_an_error(run: Run) -> None:
    right = {"area": "holding_registers", "address": 0, "payload": [1, 2], "unit": 1}
    cases = [({**right, **changes}, text) for changes, text in WRONG]
    lacking = {key: value for key, value in right.items() if key != "unit"}
    cases.append((lacking, "give either unit (format v1) or memoryId (format crc)"))
    answers = run("packet", *(message for message, _ in cases))
    for (_, text), answer in zip(cases, answers, strict=True):
        assert answer["out"] is None, text
        [[told, about_the_message]] = answer["errors"]
        assert told.startswith(f"Raw Ingest: {text}")
        assert about_the_message


def test_replies_are_told_apart(run: Run) -> None:
    replies = [{"payload": {"hex": reply}} for reply in ("00", "01", "02", "0000", "")]
    told = [
        (answer["out"][0], answer["out"][1], [text for text, _ in answer["errors"]])
        for answer in run("reply", *replies)
    ]
    strange = {"payload": "not a reply of Raw Ingest"}
    assert told == [
        ({"payload": "written"}, None, []),
        (None, {"payload": "refused"}, ["Raw Ingest: refused"]),
        *[(None, strange, ["Raw Ingest: not a reply of Raw Ingest"])] * 3,
    ]


def outcomes(answers: list[dict[str, Any]]) -> list[object]:
    """Which packet each message let out, if any."""
    return [answer["out"] and answer["out"]["payload"] for answer in answers]


def test_a_packet_waits_until_the_one_before_is_answered(run: Run) -> None:
    answers = run(
        "one at a time",
        {"payload": "a"},
        {"payload": "b"},
        {"payload": "c"},
        {"payload": "reply", "rawIngest": 1},
        {"payload": "reply", "rawIngest": 2},
        {"payload": "reply", "rawIngest": 3},
        {"payload": "d"},
    )
    assert outcomes(answers) == ["a", None, None, "b", "c", None, "d"]
    assert answers[-1]["out"]["rawIngest"] == 4


def test_a_packet_that_is_never_answered_does_not_hold_up_the_next_for_ever(run: Run) -> None:
    answers = run(
        "one at a time",
        {"payload": "a", "now": 1000},
        {"payload": "b", "now": 15999},
        {"payload": "c", "now": 16000},
        {"payload": "late reply to a", "rawIngest": 1, "now": 16001},
        {"payload": "reply to b", "rawIngest": 2, "now": 16002},
    )
    assert outcomes(answers) == ["a", None, "b", None, "c"]
    assert [len(answer["warnings"]) for answer in answers] == [0, 0, 1, 0, 0]


def test_only_so_many_packets_wait(run: Run) -> None:
    answers = run("one at a time", *({"payload": number} for number in range(102)))
    assert [len(answer["errors"]) for answer in answers] == [0] * 101 + [1]


def test_the_flow_holds_the_functions_as_they_are() -> None:
    flow = json.loads((FOLDER / "flow.json").read_text())
    functions = {node["name"]: node["func"] for node in flow if node["type"] == "function"}
    assert functions == {name: (FOLDER / file).read_text() for name, file in SOURCES.items()}


def test_the_flow_is_wired_and_takes_one_byte_as_the_reply() -> None:
    flow = {node["id"]: node for node in json.loads((FOLDER / "flow.json").read_text())}
    wired = [to for node in flow.values() for port in node.get("wires", []) for to in port]
    assert set(wired) < set(flow)
    [request] = [node for node in flow.values() if node["type"] == "tcp request"]
    assert (request["out"], request["splitc"], request["ret"]) == ("count", "1", "buffer")
    assert {node["z"] for node in flow.values() if node["type"] != "tab"} < set(flow)

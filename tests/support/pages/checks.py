"""The checks of blocks that no program runs: messages, log lines, tables, drawings of classes."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import re
import sqlite3
from dataclasses import asdict
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import jsonschema_rs
from ruamel.yaml import YAML

import holdfast
from holdfast.net.http import health as probes
from holdfast.outputs.text_file import COLUMNS
from holdfast.scanner.messages.schema import json_schema
from holdfast.values import encode
from support import wire
from support.log_events import logged
from support.pages import commands, comparing, configurations
from support.pages.blocks import Block, Command
from support.paths import ROOT

if TYPE_CHECKING:
    from support.pages.stage import Stage


def log_lines(block: Block, _: Stage) -> None:
    """Each line is a time, a level, an event that the code logs, and fields."""
    for line in block.text.splitlines():
        found = re.fullmatch(r'\S+Z (info|warning|error) (\w+)((?: \w+=(?:"[^"]*"|\S+))*)', line)
        assert found, f"no line of the log: {line}"
        assert found[2] in logged(), f"no event of the log: {found[2]}"


def audit_lines(block: Block, stage: Stage) -> None:
    """Each line has the keys of a line that an appliance of the stage wrote."""
    written = [json.loads(line) for line in stage.names["audit_log"].splitlines()]
    kinds = {tuple(line) for line in written}
    for line in map(json.loads, block.text.splitlines()):
        assert tuple(line) in kinds, f"no line has exactly the keys {list(line)}, but {kinds}"


SUBJECTS = {
    "subscribe": "SubscribeRequest",
    "unsubscribe": "UnsubscribeRequest",
    "status": "Status",
    "data": "Data",
    "variables": "VariablesRequest",
}
"""The definitions of the scanner's schema for the messages of a subject."""


def scanner_messages(block: Block, _: Stage) -> None:
    """Every message has the form of the scanner's schema."""
    messages = re.findall(
        r"^(?:modbus\.(\w+)\S* +)?(?:[^\s{\[]\S* +)?([\[{].*(?:\n  .*)*)$", block.text, re.MULTILINE
    )
    assert messages
    for subject, text in messages:
        message = json.loads(text)
        answers, kind = (message, "Variable") if isinstance(message, list) else ([message], "")
        kind = kind or ("Answer" if "success" in message else SUBJECTS[subject])
        document = json_schema() | {"$ref": f"#/$defs/{kind}"}
        for each in answers:
            jsonschema_rs.validate(document, each)


def gateway_events(block: Block, stage: Stage) -> None:
    """The events of a stream are those that the commands before have got."""
    told, found = _server_events(block.text), _server_events(stage.there(stage.output))
    for (event, data), (own, got) in zip(told, found, strict=True):
        assert event == own, f"the page has the event {event}, the program {own}"
        comparing.same_shape(got, data)


def _server_events(text: str) -> list[tuple[str, Any]]:
    text = re.sub(r"\{[^{}]*…[^{}]*\}", '"…"', text)
    found = re.findall(r"^event: (\w+)\ndata: (.*)$", text, re.MULTILINE)
    return [(event, json.loads(data)) for event, data in found]


def table(block: Block, stage: Stage) -> None:
    """CSV: initial values, a tag list, or what an output writes."""
    first, *rows = csv.reader(io.StringIO(block.text))
    if first[:3] == ["area", "address", "value"]:
        stage.file("plant_a.csv", block.text)
        memory = {**configurations.SPANS, "initial": "plant_a.csv"}
        configurations.check({"memories": {"plant_a": memory}}, stage)
    elif first[:2] == ["name", "area"]:
        assert len(holdfast.load_tags(stage.file("list.csv", block.text))) == len(rows)
    else:
        assert tuple(first) == COLUMNS
        assert {len(row) for row in rows} == {len(COLUMNS)}


def set_replies(block: Block, stage: Stage) -> None:
    """What a right and a wrong value for a set topic are answered."""
    for told, value in zip(comparing.documents(block.text), ("21.5", "31"), strict=True):
        # A loaded machine can let the output stand still for so long that it drops what waited.
        ask = f"mosquitto_rr -V 5 -W 20 -t plant/boiler/setpoint/set -e answers -m {value}"
        command = f"{ask} || {ask} || {ask}"
        [reply] = comparing.documents(commands.run(Command(block.place, command, ""), stage))
        comparing.same_shape(reply, told)


def sql(block: Block, stage: Stage) -> None:
    """The query of a `sqlite3` command finds rows in the database of the stage."""
    found = re.fullmatch(r'sqlite3 -cmd "[^"]*" (\S+) "(.*)"\n', block.text)
    assert found
    database = sqlite3.connect(stage.folder / found[1])

    def has_rows() -> bool:
        with contextlib.suppress(sqlite3.OperationalError):  # The table may not be there yet.
            return database.execute(found[2]).fetchone() is not None
        return False

    try:
        wire.until(has_rows, "there are rows")
    finally:
        database.close()


def drop_in(block: Block, _: Stage) -> None:
    """The settings are of kinds that the unit of the package has."""
    unit = (ROOT / "packaging/deb/debian/holdfast-modbus.holdfast.service").read_text()
    for name in re.findall(r"^(\w+)=", block.text, re.MULTILINE):
        assert f"\n{name}=" in unit, f"the unit has no {name}"


def windows_commands(block: Block, _: Stage) -> None:
    """The commands of holdfast can be parsed."""
    found = re.findall(r"^\S+\\holdfast (.*)$", block.text, re.MULTILINE)
    assert found
    for command in found:
        commands.parse(command.split())


def xml(block: Block, _: Stage) -> None:
    ElementTree.fromstring(block.text)


def in_file(name: str, block: Block, _: Stage) -> None:
    """The block is a part of a file of the examples."""
    assert block.text in (ROOT / name).read_text(), f"not in {name}"


def adapter(block: Block, _: Stage) -> None:
    """The adapter of the example; the appliance of the tests does not have it."""
    read = YAML(typ="safe").load
    example = read((ROOT / "examples" / "adapter" / "plant.yaml").read_text())
    assert read(block.text)["adapters"] == example["adapters"], "not that of examples/adapter"


def readiness(block: Block, stage: Stage) -> None:
    """The answer to a probe has the checks of an appliance, and the table above has each."""
    found = {name: asdict(check) for name, check in stage.names["ready"]().items()}
    comparing.same_shape({"ok": False, "checks": found}, json.loads(block.text))
    table = (ROOT / block.page).read_text()
    assert [name for name in found if f"\n| `{name}` | " not in table] == []


def kubernetes_probes(block: Block, _: Stage) -> None:
    """The probes ask the paths that are answered."""
    asked = YAML(typ="safe").load(block.text)
    found = {name: probe["httpGet"]["path"] for name, probe in asked.items()}
    live = {"startupProbe": probes.LIVE, "livenessProbe": probes.LIVE}
    assert found == {**live, "readinessProbe": probes.READY}


def scrape(block: Block, _: Stage) -> None:
    """Prometheus asks the address of the first block of the page."""
    [job] = YAML(typ="safe").load(block.text)["scrape_configs"]
    [target] = job["static_configs"][0]["targets"]
    assert f"bind: {target}" in (ROOT / block.page).read_text()


def errors(block: Block, _: Stage) -> None:
    """The tree of errors is that of the classes."""
    parents = [holdfast.ModbusError]
    for line in block.text.splitlines()[1:]:
        found = re.match(r"([│ ]*)[├└]── (\w+)", line)
        assert found, line
        depth = len(found[1]) // 4 + 1
        error = getattr(holdfast, found[2])
        assert error.__bases__[0] is parents[depth - 1], f"{found[2]} is not below it"
        parents[depth:] = [error]


def orders(block: Block, _: Stage) -> None:
    """Each row has the bytes of an order of 64 bits."""
    for order, shown in re.findall(r"^(\w+)  .*?(\[.*\])$", block.text, re.MULTILINE):
        registers = encode(0x0102030405060708, "uint64", order)
        packed = b"".join(register.to_bytes(2) for register in registers)
        assert bytes.fromhex(re.sub(r"[\[\]]", " ", shown)) == packed, order

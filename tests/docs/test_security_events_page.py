"""The page on security events: it has exactly the events of the code, as they are sent."""

from __future__ import annotations

import json
import logging
import re

import pytest
from ruamel.yaml import YAML

from holdfast.config import json_schema
from holdfast.events import ecs, ecs_categories, log_lines
from support.log_events import logged
from support.paths import DOCS

PAGE = (DOCS / "security-events.md").read_text()
EVENTS, OTHERS = PAGE.split("\n## Events\n")[1].split("\n## Other events\n")
ROWS = [
    [cell.strip() for cell in row.split(" | ")]
    for row in re.findall(r"^\| (`\w+`.*) \|$", EVENTS, re.MULTILINE)
]

TYPES = {
    "api": "access admin allowed change creation deletion denied end info start user",
    "authentication": "start end info",
    "configuration": "access change creation deletion info",
    "file": "access change creation deletion info",
    "host": "access change end info start",
    "network": "access allowed connection denied end info protocol start",
    "process": "access change end info start",
    "session": "start end info",
}
"""The types that ECS expects for a category."""


def names(cell: str) -> list[str]:
    return re.findall(r"`(\w+)`", cell)


def test_the_tables_have_every_security_event_and_what_it_is() -> None:
    told = {}
    for first, category, kind, outcome, *_ in ROWS:
        event, *reason = names(first)
        key = (event, *reason)
        assert key not in told
        told[key] = ecs_categories.Meaning(
            tuple(category.split(", ")),
            tuple(kind.split(", ")),
            outcome,
        )
    known = {(event,): meaning for event, meaning in ecs_categories.EVENTS.items()}
    assert told == known | dict(ecs_categories.BY_REASON)


def test_every_event_of_the_code_is_a_security_event_or_one_of_the_others() -> None:
    security, others = set(ecs_categories.EVENTS), set(names(OTHERS))
    assert len(others) > 20
    assert security & others == set()
    assert sorted(logged() - security - others) == []
    assert sorted((security | others) - logged()) == []


@pytest.mark.parametrize("event", ecs_categories.EVENTS)
def test_category_and_type_are_those_of_ecs(event: str) -> None:
    meaning = ecs_categories.EVENTS[event]
    expected = {kind for category in meaning.category for kind in TYPES[category].split()}
    assert set(meaning.type) <= expected


def test_the_fields_of_the_tables_are_explained() -> None:
    explained = set(re.findall(r"`([\w@*.]+)`", PAGE.split("\n## Fields\n")[1].split("\n## ")[0]))
    for *_, fields, _ in ROWS:
        for field in re.findall(r"`([\w.*]+)`", fields):
            below = field.removesuffix("*")
            parents = {f"{field[: match.start()]}.*" for match in re.finditer(r"\.", field)}
            is_part = below != field and any(each.startswith(below) for each in explained)
            assert field in explained or parents & explained or is_part, field


def test_the_example_is_what_is_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    [line] = re.findall(r"^```json\n(.*)\n```$", PAGE, re.MULTILINE)
    monkeypatch.setattr("socket.gethostname", lambda: "edge-7")
    monkeypatch.setattr("os.getpid", lambda: 812)
    monkeypatch.setattr(ecs, "_ports", {})
    ecs.note_port("scada", 502)
    record = logging.LogRecord("holdfast", logging.WARNING, "", 0, "refused_source", (), None)
    record.created = 1795241901.0045
    record.fields = {"listener": "scada", "peer": "10.0.0.9:51200"}
    made = log_lines.LineFormatter("ecs").format(record)
    assert json.loads(line) == json.loads(made)
    assert line == json.dumps(json.loads(made), separators=(",", ":"))


def test_the_configuration_of_filebeat_is_yaml() -> None:
    [text] = re.findall(r"^```yaml\n(filebeat.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    assert YAML(typ="safe").load(text)["filebeat.inputs"][0]["type"] == "filestream"
    formats = json_schema()["$defs"]["LogConfig"]["properties"]["format"]["enum"]
    assert formats == ["text", "json", "ecs"]

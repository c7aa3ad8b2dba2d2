"""The dashboard of Grafana: its form, the names in its queries, and their answers."""

from __future__ import annotations

import json
import re
import subprocess
from typing import TYPE_CHECKING, Any

import pytest

from support import promql, wire
from support.databases import Prometheus
from support.machine import tool
from support.paths import ROOT
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.promql import Labels

DASHBOARD: dict[str, Any] = json.loads(
    (ROOT / "monitoring" / "grafana-dashboard.json").read_text(encoding="utf-8")
)
PANELS: list[dict[str, Any]] = DASHBOARD["panels"]
TARGETS = [(panel["title"], each) for panel in PANELS for each in panel.get("targets", ())]
VARIABLES = {each["name"]: each for each in DASHBOARD["templating"]["list"]}
QUERIES = [
    *((title, target["expr"]) for title, target in TARGETS),
    *((each["name"], each["expr"]) for each in DASHBOARD["annotations"]["list"]),
]
SOURCE = {"type": "prometheus", "uid": "${datasource}"}
COLUMNS = 24


def with_values(query: str) -> str:
    """A query as Grafana sends it, with everything selected."""
    chosen = {"instance": ".*", "device": ".*", "__rate_interval": "60s"}
    return re.sub(r"\$(\w+)", lambda found: chosen[found[1]], query)


def test_queries_name_only_what_an_appliance_has(metrics: Labels) -> None:
    known = {**metrics, "ALERTS": {"alertname": set(), "alertstate": set()}}
    found = [
        f"{title}: {problem}"
        for title, query in QUERIES
        if "ALERTS{" not in query
        for problem in promql.problems(query, known)
    ]
    assert found == []


def test_legends_and_variables_name_only_labels_that_exist(metrics: Labels) -> None:
    found = [
        (title, label)
        for title, target in TARGETS
        for label in re.findall(r"\{\{(\w+)\}\}", target["legendFormat"])
        if label not in promql.labels(target["expr"], metrics)
    ]
    assert found == []
    for name in ("instance", "device"):
        asked = re.fullmatch(r"label_values\((.*), (\w+)\)", VARIABLES[name]["query"])
        assert asked
        assert list(promql.problems(asked[1], metrics)) == []
        assert asked[2] in promql.labels(asked[1], metrics)


def test_every_variable_that_is_used_is_declared() -> None:
    used = set(re.findall(r"\$\{?(\w+)", json.dumps(DASHBOARD)))
    assert used - {"__all", "__rate_interval"} == set(VARIABLES)


def test_the_source_of_all_data_is_the_one_that_is_chosen() -> None:
    parts = [panel for panel in PANELS if panel["type"] != "row"]
    parts += [target for _, target in TARGETS] + DASHBOARD["annotations"]["list"]
    parts += [each for each in VARIABLES.values() if each["type"] == "query"]
    assert [each for each in parts if each["datasource"] != SOURCE] == []


def test_panels_have_a_place_of_their_own_and_queries_a_name() -> None:
    assert len({panel["id"] for panel in PANELS}) == len(PANELS)
    taken: set[tuple[int, int]] = set()
    for panel in PANELS:
        at = panel["gridPos"]
        assert at["x"] + at["w"] <= COLUMNS
        cells = {(at["x"] + x, at["y"] + y) for x in range(at["w"]) for y in range(at["h"])}
        assert not cells & taken, panel["title"]
        taken |= cells
        names = [target["refId"] for target in panel.get("targets", ())]
        assert len(set(names)) == len(names)
        assert names or panel["type"] == "row"


def test_there_is_a_row_for_each_part() -> None:
    rows = [panel["title"] for panel in PANELS if panel["type"] == "row"]
    assert rows == [
        "Appliance",
        "Listeners",
        "Devices",
        "Routes",
        "Memories and logs",
        "Scanner and gateway",
        "Outputs",
        "Certificates",
    ]


def test_prometheus_can_parse_every_query(tmp_path: Path) -> None:
    rules = [
        {"record": f"query:{number}", "expr": with_values(query)}
        for number, (_, query) in enumerate(QUERIES)
    ]
    (tmp_path / "rules.yml").write_text(json.dumps({"groups": [{"name": "all", "rules": rules}]}))
    result = subprocess.run(
        [tool("promtool"), "check", "rules", "rules.yml"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=wire.DEADLINE,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.fixture
def prometheus(appliance: Appliance, metrics: Labels, tmp_path: Path) -> Iterator[Prometheus]:
    assert metrics, "everything has happened"

    class Scraping(Prometheus):
        target = endpoint(appliance, "metrics")

    made = Scraping(tmp_path)
    yield made
    made.kill()


def test_every_panel_has_data_of_an_appliance(prometheus: Prometheus) -> None:
    """Apart from queries that show only what has gone wrong."""
    waiting = {
        (title, query)
        for title, query in QUERIES
        if not query.endswith("> 0") and "ALERTS{" not in query
    }
    assert len(waiting) > len(QUERIES) / 2

    def are_answered() -> bool:
        while waiting:
            _, query = asked = next(iter(waiting))
            answer = json.loads(prometheus.get("/api/v1/query", query=with_values(query)))
            if not answer["data"]["result"]:
                return False
            waiting.discard(asked)
        return True

    try:
        wire.until(are_answered, "each query has an answer", 3 * wire.DEADLINE)
    except AssertionError:
        raise AssertionError(f"no data: {sorted(waiting)}") from None


def test_queries_of_what_has_gone_wrong_are_valid(prometheus: Prometheus) -> None:
    for _, query in QUERIES:
        answer = json.loads(prometheus.get("/api/v1/query", query=with_values(query)))
        assert answer["status"] == "success"

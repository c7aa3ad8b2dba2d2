"""The dashboard of Grafana: its form, the names in its queries, and their answers."""

from __future__ import annotations

import json
import re
import subprocess
from dataclasses import dataclass
from functools import cached_property
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


@dataclass(frozen=True)
class Dashboard:
    """A file for Grafana."""

    file: str

    @cached_property
    def content(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((MONITORING / self.file).read_text(encoding="utf-8"))
        return found

    @property
    def panels(self) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = self.content["panels"]
        return found

    @property
    def targets(self) -> list[tuple[str, dict[str, Any]]]:
        return [
            (panel["title"], each) for panel in self.panels for each in panel.get("targets", ())
        ]

    @property
    def annotations(self) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = self.content["annotations"]["list"]
        return found

    @property
    def variables(self) -> dict[str, dict[str, Any]]:
        return {each["name"]: each for each in self.content["templating"]["list"]}

    @property
    def queries(self) -> list[tuple[str, str]]:
        of_panels = [(title, target["expr"]) for title, target in self.targets]
        return [*of_panels, *((each["name"], each["expr"]) for each in self.annotations)]


MONITORING = ROOT / "monitoring"
OPERATION = Dashboard("grafana-dashboard.json")
VALUES = Dashboard("grafana-values.json")
BOTH = [OPERATION, VALUES]
each_dashboard = pytest.mark.parametrize("dashboard", BOTH, ids=lambda each: each.file)
QUERIES = [query for dashboard in BOTH for query in dashboard.queries]
SOURCE = {"type": "prometheus", "uid": "${datasource}"}
COLUMNS = 24


def with_values(query: str) -> str:
    """A query as Grafana sends it, with everything selected."""
    every = dict.fromkeys(("instance", "device", "tag", "unit"), ".*")
    chosen = {**every, "__rate_interval": "60s"}
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


@each_dashboard
def test_legends_and_variables_name_only_labels_that_exist(
    dashboard: Dashboard, metrics: Labels
) -> None:
    found = [
        (title, label)
        for title, target in dashboard.targets
        for label in re.findall(r"\{\{(\w+)\}\}", target["legendFormat"])
        if label not in promql.labels(target["expr"], metrics)
    ]
    assert found == []
    asking = [each for each in dashboard.variables.values() if each["type"] == "query"]
    assert [each["name"] for each in asking[:2]] == ["instance", "device"]
    for variable in asking:
        asked = re.fullmatch(r"label_values\((.*), (\w+)\)", variable["query"])
        assert asked
        assert list(promql.problems(asked[1], metrics)) == []
        assert asked[2] in promql.labels(asked[1], metrics)


@each_dashboard
def test_every_variable_that_is_used_is_declared(dashboard: Dashboard) -> None:
    used = set(re.findall(r"\$\{?(\w+)", json.dumps(dashboard.content)))
    assert used - {"__all", "__rate_interval"} == set(dashboard.variables)


@each_dashboard
def test_the_source_of_all_data_is_the_one_that_is_chosen(dashboard: Dashboard) -> None:
    parts = [panel for panel in dashboard.panels if panel["type"] != "row"]
    parts += [target for _, target in dashboard.targets] + dashboard.annotations
    parts += [each for each in dashboard.variables.values() if each["type"] == "query"]
    assert [each for each in parts if each["datasource"] != SOURCE] == []


@each_dashboard
def test_panels_have_a_place_of_their_own_and_queries_a_name(dashboard: Dashboard) -> None:
    assert len({panel["id"] for panel in dashboard.panels}) == len(dashboard.panels)
    taken: set[tuple[int, int]] = set()
    for panel in dashboard.panels:
        at = panel["gridPos"]
        assert at["x"] + at["w"] <= COLUMNS
        cells = {(at["x"] + x, at["y"] + y) for x in range(at["w"]) for y in range(at["h"])}
        assert not cells & taken, panel["title"]
        taken |= cells
        names = [target["refId"] for target in panel.get("targets", ())]
        assert len(set(names)) == len(names)
        assert names or panel["type"] == "row"


def test_there_is_a_row_for_each_part() -> None:
    rows = [panel["title"] for panel in OPERATION.panels if panel["type"] == "row"]
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


def test_the_dashboard_of_values_repeats_a_plot_for_each_unit() -> None:
    assert [panel["title"] for panel in VALUES.panels if panel.get("repeat") == "unit"] == ["$unit"]


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
    """Apart from queries that show only what has gone wrong, or tags without a unit."""
    waiting = {
        (title, query)
        for title, query in QUERIES
        if not query.endswith("> 0") and "ALERTS{" not in query and 'unit=""' not in query
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

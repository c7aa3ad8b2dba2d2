"""The alert rules: what they name exists, what they promise fires, and a real Prometheus agrees."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from typing import TYPE_CHECKING, Any

import pytest
from ruamel.yaml import YAML

from support import promql, wire
from support.databases import Prometheus
from support.machine import tool
from support.paths import DOCS, ROOT
from support.running import endpoint

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.promql import Labels

MONITORING = ROOT / "monitoring"
RULES: list[dict[str, Any]] = [
    rule
    for group in YAML(typ="safe").load((MONITORING / "alerts.yml").read_text())["groups"]
    for rule in group["rules"]
]
NAMES = [rule["alert"] for rule in RULES]


def promtool(*arguments: str, folder: Path = MONITORING) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [tool("promtool"), *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=5 * wire.DEADLINE,
        check=False,
    )


def test_rules_name_only_what_an_appliance_has(metrics: Labels) -> None:
    found = [
        f"{rule['alert']}: {problem}"
        for rule in RULES
        for problem in promql.problems(rule["expr"], metrics)
    ]
    assert found == []


def test_annotations_name_only_labels_that_an_alert_has(metrics: Labels) -> None:
    found = [
        (rule["alert"], label)
        for rule in RULES
        for text in rule["annotations"].values()
        for label in re.findall(r"\$labels\.(\w+)", text)
        if label not in promql.labels(rule["expr"], metrics)
    ]
    assert found == []


def test_each_alert_has_a_name_of_its_own_a_severity_and_an_action() -> None:
    assert len(set(NAMES)) == len(NAMES)
    for rule in RULES:
        assert rule["labels"]["severity"] in ("critical", "warning"), rule["alert"]
        assert list(rule["annotations"]) == ["summary", "action"], rule["alert"]


@pytest.mark.parametrize(
    ("query", "told"),
    [
        ("holdfast_redy == 0", "no metric holdfast_redy"),
        ('holdfast_ready{chek="logs"} == 0', "holdfast_ready has no label chek"),
        ('holdfast_ready{check=~"logs|loggs"}', "holdfast_ready has no check=loggs"),
        ("sum by (listener) (holdfast_ready)", "has the label listener"),
        ("1 == 1", "no metric in 1 == 1"),
    ],
)
def test_a_name_that_does_not_exist_is_found(metrics: Labels, query: str, told: str) -> None:
    [problem] = promql.problems(query, metrics)
    assert told in problem


def test_prometheus_accepts_the_rules_and_its_configuration() -> None:
    result = promtool("check", "config", "prometheus.yml")
    assert result.returncode == 0, result.stderr
    assert f"SUCCESS: {len(RULES)} rules found" in result.stdout


def test_alerts_fire_when_they_should_and_only_then() -> None:
    result = promtool("test", "rules", "alerts.test.yml")
    assert result.returncode == 0, result.stdout + result.stderr


def test_an_alert_that_never_fires_is_noticed(tmp_path: Path) -> None:
    """Without any alert, the tests miss each of them; no test of one depends on another."""
    shutil.copy(MONITORING / "alerts.test.yml", tmp_path)
    rules = (MONITORING / "alerts.yml").read_text()
    of_rule = r"(- alert: \w+\n +expr:).*?(?=\n +(?:for|labels):)"
    never, count = re.subn(of_rule, r"\1 absent(up) > 1", rules, flags=re.S)
    assert count == len(NAMES)
    (tmp_path / "alerts.yml").write_text(never)
    assert promtool("check", "rules", "alerts.yml", folder=tmp_path).returncode == 0
    result = promtool("test", "rules", "alerts.test.yml", folder=tmp_path)
    assert result.returncode == 1
    missed = re.findall(r"^ +(?:exp|Labels): ?\{.*", result.stdout + result.stderr, re.MULTILINE)
    assert set(re.findall(r'alertname="(\w+)"', "".join(missed))) == set(NAMES)


def test_a_real_prometheus_evaluates_the_rules_against_an_appliance(
    appliance: Appliance, tmp_path: Path
) -> None:
    """An alert of an appliance whose broker and receiver are away, and no rule has an error."""

    class WithRules(Prometheus):
        target = endpoint(appliance, "metrics")
        rules = MONITORING / "alerts.yml"

    prometheus = WithRules(tmp_path)

    def told(path: str) -> Any:
        return json.loads(prometheus.get(f"/api/v1/{path}"))["data"]

    def rules() -> list[dict[str, Any]]:
        return [rule for group in told("rules")["groups"] for rule in group["rules"]]

    def pending() -> set[tuple[str, ...]]:
        return {
            (alert["labels"]["alertname"], alert["labels"].get("adapter", ""))
            for alert in told("alerts")["alerts"]
        }

    try:
        expected = {("HoldfastAdapterDisconnected", "mqtt"), ("HoldfastForwardFailing", "")}
        wire.until(lambda: pending() >= expected, "the alerts are pending", 3 * wire.DEADLINE)
        wire.until(lambda: {rule["health"] for rule in rules()} == {"ok"}, "all were evaluated")
        assert sorted(rule["name"] for rule in rules()) == sorted(NAMES)
        wrong = {"HoldfastDown", "HoldfastThreadStalled"}
        wire.until(lambda: not {name for name, _ in pending()} & wrong, "no other is pending")
    finally:
        prometheus.kill()


def test_the_page_lists_every_metric(metrics: Labels) -> None:
    rows = [
        row.split("|")[1]
        for row in (DOCS / "metrics.md").read_text().splitlines()
        if row.startswith("| `")
    ]
    listed = [re.findall(r"`([\w…*]+)`", row) for row in rows]

    def is_listed(name: str) -> bool:
        return any(
            name == each
            or (each.startswith("…") and name.endswith(each[1:]) and _common(name, row[0]))
            or (each.endswith("*") and name.startswith(each[:-1]))
            for row in listed
            for each in row
        )

    assert sorted(name for name in metrics if not is_listed(name)) == []


def _common(name: str, first: str) -> bool:
    """Whether a name begins as the first one of its row."""
    return name.split("_")[:2] == first.split("_")[:2]


def test_the_page_lists_every_alert_with_its_severity() -> None:
    page = (DOCS / "monitoring.md").read_text()
    assert re.findall(r"^\| `(Holdfast\w+)` \| (\w+) \|", page, re.M) == [
        (rule["alert"], rule["labels"]["severity"]) for rule in RULES
    ]

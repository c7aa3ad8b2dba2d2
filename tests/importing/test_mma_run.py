"""An imported configuration does what the first generation of the appliance did.

`mma_run.json` has requests, and what the first generation answered to them with the configuration
`mma_run.yaml`. Where Holdfast answers otherwise, an exchange has this answer too, and the names of
the differences; `differences` explains each.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.config.dump import to_yaml
from holdfast.importing import read_mma
from support.exchanges import play
from support.paths import DOCS
from support.running import endpoint

if TYPE_CHECKING:
    from support.running import Run

HERE = Path(__file__).parent
RECORDED = json.loads((HERE / "mma_run.json").read_text())
DIFFERENCES: dict[str, str] = RECORDED["differences"]
SCENARIOS: list[dict[str, Any]] = RECORDED["scenarios"]
NAMES = {"raw": "raw-ingest", "rest": "rest"}
"""Listeners and services by their names in the recording; others are ports."""


@pytest.fixture
def addresses(run: Run) -> dict[str, tuple[str, int]]:
    """The addresses of the imported configuration, running on free ports."""
    imported = read_mma(HERE / "mma_run.yaml", keep_published_tokens=True).data
    imported["identity"] = {"vendor_name": "V", "product_code": "P", "revision": "1"}
    listeners = imported["listeners"]
    for settings in (*listeners.values(), imported["rest"]):
        settings["bind"] = "127.0.0.1:0"
    appliance = run(to_yaml(imported))
    named = {name.removeprefix("port-"): endpoint(appliance, name) for name in listeners}
    return named | {short: endpoint(appliance, name) for short, name in NAMES.items()}


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario["name"])
def test_the_answers_are_those_of_the_first_generation_but_for_known_differences(
    scenario: dict[str, Any], addresses: dict[str, tuple[str, int]]
) -> None:
    wrong = []
    for exchange in scenario["exchanges"]:
        found, expected = play(exchange, addresses), exchange.get("holdfast", exchange["mma"])
        if found != expected:
            wrong.append(f"{exchange['name']}: {found}, expected {expected}")
    assert not wrong


def test_each_difference_is_explained_and_occurs() -> None:
    exchanges = [each for scenario in SCENARIOS for each in scenario["exchanges"]]
    differing = [each for each in exchanges if "differs" in each]
    assert all(each["mma"] != each["holdfast"] for each in differing)
    assert {name for each in differing for name in each["differs"]} == DIFFERENCES.keys()


def test_each_difference_is_in_the_documentation() -> None:
    page = " ".join((DOCS / "moving-from-mma.md").read_text().split())
    assert [name for name, told in DIFFERENCES.items() if told not in page] == []

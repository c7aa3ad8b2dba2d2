"""The pages: links lead somewhere, and what is made from the program is what the program makes."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from holdfast.config import json_schema, load
from support.paths import ROOT

PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_to_a_file_leads_to_one(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#:]+)\)", page.read_text())
    lost = [target for target in targets if not (page.parent / target).exists()]
    assert lost == []


def test_the_schema_of_the_docs_is_that_of_the_program() -> None:
    kept = json.loads((ROOT / "docs" / "config.schema.json").read_text())
    assert kept == json.loads(json.dumps(json_schema())), "run `make docs`"


def test_the_example_configuration_binds_loopback_and_high_ports_only() -> None:
    config = load(ROOT / "examples" / "plant.yaml")
    assert config.rest is not None
    binds = [getattr(listener, "bind", None) for listener in config.listeners.values()]
    for bind in [*binds, config.rest.bind]:
        assert bind is not None
        assert bind.address.is_loopback
        assert bind.port > 1024

"""The pages: links lead somewhere, and what is made from the program is what the program makes."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from holdfast.config import ModbusTcpListener, json_schema, load

ROOT = Path(__file__).parent.parent
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
    for listener in load(ROOT / "examples" / "plant.yaml").listeners.values():
        assert isinstance(listener, ModbusTcpListener)
        assert listener.bind.address.is_loopback
        assert listener.bind.port > 1024

"""The pages: links lead somewhere, and what is made from the program is what the program makes."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from holdfast.config import json_schema, load
from support.paths import ROOT

PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]
PROTOCOL = ROOT / "crates" / "protocol" / "src"
TLS = ROOT / "crates" / "engine" / "src" / "tls"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_to_a_file_leads_to_one(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#:]+)\)", page.read_text())
    lost = [target for target in targets if not (page.parent / target).exists()]
    assert lost == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_to_a_heading_leads_to_one(page: Path) -> None:
    links = re.findall(r"\]\(([^)#:]*)#([^)]+)\)", page.read_text())
    lost = [
        (target, anchor)
        for target, anchor in links
        if anchor not in anchors(page.parent / target if target else page)
    ]
    assert lost == []


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", each.lower()).replace(" ", "-") for each in headings}


def test_the_table_of_maturity_names_tests_that_exist() -> None:
    table = (ROOT / "docs" / "compatibility.md").read_text().split("\n## Maturity\n")[1]
    named = set(re.findall(r"`(tests/[\w/]+)`", table))
    assert len(named) > 20
    assert [each for each in sorted(named) if not (ROOT / each).is_dir()] == []


NATS_CONFIGURATIONS = [
    *(ROOT / "docs").glob("*.md"),
    *(ROOT / "examples").rglob("*.conf"),
    *(ROOT / "packaging").rglob("*.conf"),
]


def test_every_example_of_a_nats_server_stores_writes_at_once() -> None:
    sections = [
        (file.relative_to(ROOT).as_posix(), section)
        for file in NATS_CONFIGURATIONS
        for section in re.findall(r"^jetstream \{.*?^\}", file.read_text(), re.M | re.S)
    ]
    assert {"docs/durability.md", "examples/replicated/nats.conf"} <= {name for name, _ in sections}
    without = [name for name, section in sections if "sync_interval: always" not in section]
    assert without == []


def reasons(source: Path) -> set[str]:
    """What the function `reason` of a Rust file returns."""
    body = source.read_text().split("fn reason(")[1].split("\n    }\n")[0]
    return set(re.findall(r'=> "(\w+)"', body))


def first_cells(page: str, heading: str) -> set[str]:
    """The words in the first columns of the tables of a section."""
    section = (ROOT / "docs" / page).read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (`.*?) \|", section, re.MULTILINE)
    return {word for row in rows for word in re.findall(r"`(\w+)`", row)}


def test_the_page_on_clients_has_every_reason_of_an_invalid_response() -> None:
    found = reasons(PROTOCOL / "client" / "mod.rs")
    assert len(found) > 5
    assert sorted((found | {"content"}) - first_cells("client.md", "Errors")) == []


def test_the_page_on_tls_has_every_reason_of_a_failure() -> None:
    found = reasons(TLS / "failure.rs")
    section = (ROOT / "docs" / "modbus-tls.md").read_text()
    told = section.split("\n## Which certificates are trusted\n")[1].split("\n## ")[0]
    assert len(found) > 20
    assert sorted(reason for reason in found if f"`{reason}`" not in told) == []


def test_the_page_on_conformance_has_every_requirement_of_security() -> None:
    page = (ROOT / "docs" / "conformance.md").read_text()
    section = page.split("\n## Modbus/TCP Security\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (R-.*)\|$", section, re.MULTILINE)
    numbers = [int(each) for row in rows for each in re.findall(r"R-(\d\d)", row.split("|")[0])]
    assert sorted(numbers) == [each for each in range(1, 68) if each not in (9, 15)]


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

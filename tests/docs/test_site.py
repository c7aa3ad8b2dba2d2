"""The documentation site: its navigation has every page, and it needs no network."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest
from playwright.sync_api import expect

import holdfast
from support.gateway_pages import browsing
from support.machine import missing
from support.paths import DOCS, ROOT

if TYPE_CHECKING:
    from pathlib import Path

    from playwright.sync_api import Request

INDEX = (DOCS / "index.md").read_text()


def test_the_navigation_has_every_page_once() -> None:
    listed = re.findall(r"^\* \[[^]]+\]\(([^)]+)\)", INDEX, re.MULTILINE)
    pages = [path.name for path in DOCS.iterdir() if path.suffix in (".md", ".rst")]
    assert sorted([*listed, "index.md"]) == sorted(pages), "list each page in docs/index.md"


def test_the_navigation_is_ordered_by_kind_of_page() -> None:
    headings = re.findall(r"^## (.+)$", INDEX, re.MULTILINE)
    assert headings == ["Tutorials", "How-to guides", "Reference", "Explanation"]


@pytest.fixture
def site() -> Path:
    """The folder of the built site."""
    if not (ROOT / "site" / "index.html").exists():
        missing("the site, which `make site` builds,")
    return ROOT / "site"


def test_the_page_of_the_api_has_every_public_name(site: Path) -> None:
    page = (site / "api.html").read_text()
    names = set(re.findall(r'id="(?:module-)?holdfast\.([A-Za-z_]+)"', page))
    assert names == set(holdfast.__all__) - {"__version__"}
    assert "ERROR" not in page


def test_the_site_is_read_and_searched_without_a_server(site: Path) -> None:
    elsewhere = []

    def note(request: Request) -> None:
        if not request.url.startswith(("file:", "data:")):
            elsewhere.append(request.url)

    with browsing() as browser:
        page = browser.new_page()
        page.on("request", note)
        page.goto((site / "index.html").as_uri())
        page.get_by_role("link", name="Audit log", exact=True).first.click()
        expect(page.get_by_role("heading", name="Audit log")).to_be_visible()
        page.get_by_role("textbox", name="Search").fill("max_connections_per_source")
        page.keyboard.press("Enter")
        result = page.locator("#search-results").get_by_role("link", name="Configuration").first
        expect(result).to_be_visible()
    assert elsewhere == []

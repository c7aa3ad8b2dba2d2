"""The documentation site, which `make site` builds."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from pygments.lexers.special import TextLexer

import holdfast

if TYPE_CHECKING:
    from sphinx.application import Sphinx

project = "Holdfast"
release = version = holdfast.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc"]
html_theme = "furo"
html_title = f"Holdfast {release}"
html_copy_source = False
html_show_copyright = False
default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
myst_heading_anchors = 6


def navigation(_app: Sphinx, page: str, source: list[str]) -> None:
    """Makes the navigation from the lists of index.md, by heading."""
    if page != "index":
        return
    for part in source[0].split("\n## ")[1:]:
        heading, _, section = part.partition("\n")
        if pages := re.findall(r"^\* \[[^]]+\]\(([\w-]+)\.\w+\)", section, re.MULTILINE):
            source[0] += "\n```{toctree}\n:hidden:\n:caption: " + heading + "\n\n"
            source[0] += "\n".join(pages) + "\n```\n"


def outside(_app: Sphinx, _page: str, source: list[str]) -> None:
    """Makes downloads of linked files outside this folder. A linked folder is only text."""

    def replaced(link: re.Match[str]) -> str:
        text, path = link.groups()
        return text if Path(__file__).parent.joinpath(path).is_dir() else f"[{text}](path:{path})"

    source[0] = re.sub(r"\[([^]]+)\]\((\.\./[^)]+)\)", replaced, source[0])


def setup(app: Sphinx) -> None:
    """Registers the functions above."""
    app.add_lexer("csv", TextLexer)
    app.connect("source-read", navigation)
    app.connect("source-read", outside)

"""Renders an OpenAPI document as an HTML page without scripts or external resources."""

from __future__ import annotations

import base64
import hashlib
import json
import shlex
from html import escape
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

KIND = b"text/html; charset=utf-8"

_STYLE = """
:root { color-scheme: light dark; --line: #d5d8dc; --soft: #f4f5f7; --ink: #16181d;
  --dim: #565c66; --paper: #fff; --good: #0a6b3d; --bad: #a52a1f; --link: #0b57a4 }
@media (prefers-color-scheme: dark) { :root { --line: #363b43; --soft: #1d2026; --ink: #e7e9ec;
  --dim: #a3a9b3; --paper: #121419; --good: #6fd39f; --bad: #ff9a8f; --link: #8cc0ff } }
* { box-sizing: border-box }
body { margin: 0 auto; max-width: 56rem; padding: 1.5rem 1rem 4rem; color: var(--ink);
  background: var(--paper); font: 1rem/1.5 system-ui, sans-serif; overflow-wrap: break-word }
h1 { font-size: 1.6rem; margin: 0 }
h2 { font-size: 1.1rem; margin: 0; font-family: ui-monospace, monospace }
h3 { font-size: .85rem; margin: 1.1rem 0 .3rem; color: var(--dim) }
a { color: var(--link) }
nav ul { padding: 0; list-style: none }
section { border-top: 1px solid var(--line); margin-top: 1.75rem; padding-top: 1.25rem }
p { margin: .4rem 0; max-width: 44rem }
pre { background: var(--soft); border: 1px solid var(--line); border-radius: 6px; margin: .3rem 0;
  padding: .6rem .75rem; font-size: .85rem; white-space: pre-wrap }
code, pre { font-family: ui-monospace, monospace; overflow-wrap: anywhere }
table { border-collapse: collapse; width: 100%; font-size: .9rem }
th, td { border-bottom: 1px solid var(--line); padding: .35rem .6rem .35rem 0; text-align: left;
  vertical-align: top }
td:first-child { white-space: nowrap }
th { color: var(--dim); font-weight: 600 }
.good { color: var(--good) } .bad { color: var(--bad) } .dim { color: var(--dim) }
"""

_DIGEST = base64.b64encode(hashlib.sha256(_STYLE.encode()).digest())
POLICY = (
    b"default-src 'none'; style-src 'sha256-" + _DIGEST + b"'; base-uri 'none'; "
    b"form-action 'none'; frame-ancestors 'none'"
)
"""The Content-Security-Policy of the page: it allows only the page's own style."""


def render(document: Mapping[str, Any], server: str) -> bytes:
    """Renders the page of a document. The example commands use `server` as base URL."""
    info = document["info"]
    operations = [
        (path, method, operation)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]
    links = "".join(
        f'<li><a href="#{operation["operationId"]}"><code>{method.upper()} {escape(path)}</code>'
        f"</a> {escape(operation['summary'])}</li>"
        for path, method, operation in operations
    )
    sections = "".join(_section(document, server, *entry) for entry in operations)
    page = f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(info["title"])}</title>
<style>{_STYLE}</style>
</head>
<body>
<header>
<h1>{escape(info["title"])} <span class="dim">{escape(info["version"])}</span></h1>
<p>{escape(info["summary"])} {_marked(info["description"])}</p>
<p><a href="/openapi.json">openapi.json</a></p>
</header>
<nav><ul>{links}</ul></nav>
<main>{sections}{_schemas(document)}</main>
</body>
</html>
"""
    return page.encode()


def _section(
    document: Mapping[str, Any], server: str, path: str, method: str, operation: Mapping[str, Any]
) -> str:
    parts = [
        f'<section id="{operation["operationId"]}">',
        f"<h2>{method.upper()} {escape(path)}</h2>",
        f"<p>{escape(operation['summary'])}.</p>",
    ]
    if "description" in operation:
        parts.append(f"<p>{_marked(operation['description'])}</p>")
    secured = bool(operation["security"])
    if secured:
        parts.append('<p class="dim">Requires a token.</p>')
    parameters = operation.get("parameters", [])
    if parameters:
        rows = [
            (f"<code>{entry['name']}</code>", escape(entry["description"]), _range(document, entry))
            for entry in parameters
        ]
        parts.append("<h3>Parameters</h3>" + _table(("name", "description", "allowed"), rows))
    for title, command in _examples(server, path, operation, secured):
        parts.append(f"<h3>{escape(title)}</h3><pre>{escape(command)}</pre>")
    parts.append("<h3>Responses</h3>")
    rows = [
        _row(document, status, answer) for status, answer in sorted(operation["responses"].items())
    ]
    parts.append(_table(("status", "description", "body"), rows))
    return "".join([*parts, "</section>"])


def _examples(
    server: str, path: str, operation: Mapping[str, Any], secured: bool
) -> Iterable[tuple[str, str]]:
    """Yields the title and the command line of each example."""
    token = ' -H "Authorization: Bearer $TOKEN"' if secured else ""
    if "requestBody" in operation:
        for example in operation["requestBody"]["content"]["application/json"]["examples"].values():
            body = shlex.quote(json.dumps(example["value"]))
            head = f"curl {server}{path}{token} -H 'Content-Type: application/json'"
            yield example["summary"], f"{head} -d {body}"
        return
    query = urlencode(
        {entry["name"]: entry["example"] for entry in operation.get("parameters", [])}, doseq=True
    )
    yield "Example", f"curl '{server}{path}{'?' if query else ''}{query}'{token}"


def _row(
    document: Mapping[str, Any], status: str, answer: Mapping[str, Any]
) -> tuple[str, str, str]:
    whole = _resolved(document, answer)
    [(kind, content)] = whole["content"].items()
    body = f"<code>{escape(kind)}</code>"
    if "example" in content:
        body = f"<code>{escape(json.dumps(content['example'], ensure_ascii=False))}</code>"
    tone = "good" if status.startswith("2") else "bad"
    return f'<b class="{tone}">{status}</b>', _marked(whole["description"]), body


def _range(document: Mapping[str, Any], parameter: Mapping[str, Any]) -> str:
    schema = _resolved(document, parameter["schema"])
    if "enum" in schema:
        return ", ".join(f"<code>{escape(str(word))}</code>" for word in schema["enum"])
    if "minimum" in schema:
        return f"{schema['minimum']} to {schema['maximum']}"
    return "text"


def _schemas(document: Mapping[str, Any]) -> str:
    entries = "".join(
        f"<h3>{escape(name)}</h3><pre>{escape(json.dumps(schema, indent=1))}</pre>"
        for name, schema in document["components"]["schemas"].items()
    )
    return f'<section id="schemas"><h2>Schemas</h2>{entries}</section>'


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    cells = "".join(f"<th>{word}</th>" for word in head)
    lines = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{cells}</tr></thead><tbody>{lines}</tbody></table>"


def _marked(text: str) -> str:
    """Escapes text for HTML, and marks words in backticks as code."""
    parts = escape(text).split("`")
    return "".join(
        f"<code>{part}</code>" if place % 2 else part for place, part in enumerate(parts)
    )


def _resolved(document: Mapping[str, Any], entry: Mapping[str, Any]) -> Mapping[str, Any]:
    """Resolves a reference; other entries are unchanged."""
    if "$ref" not in entry:
        return entry
    found: Any = document
    for part in entry["$ref"].removeprefix("#/").split("/"):
        found = found[part]
    return dict(found)

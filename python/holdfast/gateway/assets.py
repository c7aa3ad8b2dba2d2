"""The static files of the console at `/`. They need no build step.

The limits of the standard and the types of values have placeholders, so that the page repeats none.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holdfast.net.addresses import LAST_PORT
from holdfast.protocol import (
    LAST_ADDRESS,
    MAX_UNIT,
    MAX_WORD,
    PORT,
    READ_FUNCTIONS,
    READ_REGISTERS,
    WRITE_LIMITS,
)
from holdfast.values.numeric import limits
from holdfast.values.types import FIXED

if TYPE_CHECKING:
    from holdfast.net.http.requests import Headers

FOLDER = Path(__file__).parent / "console"

KINDS = {
    ".html": b"text/html; charset=utf-8",
    ".css": b"text/css; charset=utf-8",
    ".js": b"text/javascript; charset=utf-8",
    ".svg": b"image/svg+xml",
    ".txt": b"text/plain; charset=utf-8",
}

FILES = {
    "/": FOLDER / "index.html",
    **{
        f"/console/{file.relative_to(FOLDER).as_posix()}": file
        for file in sorted(FOLDER.rglob("*"))
        if file.suffix in KINDS and file.name != "index.html"
    },
}
"""The files by URL path. Only these are served."""

WITH_PLACEHOLDERS = ("index.html", "standard.js")
"""The files with placeholders such as `$PORT`."""

HEADERS: Headers = [
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        b"connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
]


@functools.cache
def read(path: str) -> tuple[bytes, bytes]:
    """Returns the content type and the content of a file."""
    file = FILES[path]
    content = file.read_bytes()
    if file.name in WITH_PLACEHOLDERS:
        for name, value in _placeholders().items():
            content = content.replace(f"${name}".encode(), json.dumps(value).encode())
    return KINDS[file.suffix], content


def _placeholders() -> dict[str, Any]:
    areas = {
        area: {
            "title": area.replace("_", " ").capitalize(),
            "code": function.code,
            "most": function.most_read,
            "mostWritten": WRITE_LIMITS.get(area),
        }
        for area, function in READ_FUNCTIONS.items()
    }
    types = {name: {"width": size // 2, "ends": _ends(name)} for name, size in FIXED.items()}
    return {
        "STANDARD": {
            "AREAS": areas,
            "LAST_ADDRESS": LAST_ADDRESS,
            "MAX_WORD": MAX_WORD,
            "TYPES": types,
        },
        "LAST_ADDRESS": LAST_ADDRESS,
        "LAST_PORT": LAST_PORT,
        "MAX_UNIT": MAX_UNIT,
        "PORT": PORT,
        "READ_REGISTERS": READ_REGISTERS,
    }


def _ends(name: str) -> tuple[float | str, ...]:
    """The least and the greatest number. Integers are text: JavaScript rounds large ones."""
    if name == "bool":
        return ()
    least, most = limits(name)
    return (least, most) if isinstance(least, float) else (str(least), str(most))

"""The static files of the console at `/`. They need no build step."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holdfast.web.requests import Headers

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
    return KINDS[file.suffix], file.read_bytes()

"""Writes the effective configuration as readable YAML that `load` accepts.

The functions take plain data, not models.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import lru_cache
from math import isfinite, isnan
from pathlib import Path
from typing import Any

from holdfast.config.text.yaml_document import scalar

WIDTH = 100
"""What is longer on one line has a line for each entry."""
INDENT = 2

NULL_IS_SAID = frozenset({"max_connections_per_source"})
"""Keys whose `None` is written as null; other keys without a value are omitted."""

OF_ADAPTER = ("adapters", "options")
"""The section and the key whose values belong to someone else: a null in them is data."""

PLAIN = re.compile(r"[A-Za-z0-9_./]([A-Za-z0-9_./+%@-]|:(?=[^ ])| (?=[^ ]))*", re.ASCII)
"""Text that is safe without quotes anywhere in YAML; all other text is quoted."""

ESCAPED = re.compile("[\x7f-\x9f\u2028\u2029\ud800-\udfff\ufeff\ufffe\uffff]")
"""What JSON leaves as it is between quotes, and YAML does not allow or may take as a line break."""


def effective(model: dict[Any, Any], path: tuple[object, ...] = ()) -> dict[Any, Any]:
    """The data of a model for YAML and JSON, without keys that have no value.

    `path` are the keys that lead to it.
    """
    section, data_of_others = OF_ADAPTER
    as_written = {data_of_others} if path[:1] == (section,) and len(path) == 2 else ()
    return {
        key: value if key in as_written else _plain(value, path, key)
        for key, value in model.items()
        if value is not None or key in NULL_IS_SAID
    }


def _plain(value: object, path: tuple[object, ...], key: object) -> object:
    if isinstance(value, dict):
        return effective(value, (*path, key))
    if isinstance(value, list | tuple):
        return [_plain(item, path, key) for item in value]
    return str(value) if isinstance(value, Path) else value


def to_yaml(data: dict[str, Any]) -> str:
    """The YAML text of a mapping; small, deeply nested values are on one line."""
    lines = (line for key, value in data.items() for line in _entry(f"{_text(key)}:", value, 0))
    return "".join(f"{line}\n" for line in lines)


def on_one_line(value: object) -> str:
    """The YAML text of a value on one line: `{area: coils, address: 3}`."""
    if isinstance(value, dict):
        pairs = (f"{_text(key)}: {on_one_line(each)}" for key, each in value.items())
        return f"{{{', '.join(pairs)}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(on_one_line, value))}]"
    return _text(value)


def _entry(start: str, value: object, depth: int) -> Iterator[str]:
    """The lines of a value after `start`, which is its key and a colon, or the dash of a list."""
    if not isinstance(value, dict | list) or not value:
        yield f"{start} {on_one_line(value)}"
        return
    inside = value.values() if isinstance(value, dict) else value
    if depth > 0 and not any(isinstance(item, dict | list) for item in inside):
        line = f"{start} {on_one_line(value)}"
        if len(line) + INDENT * depth <= WIDTH:
            yield line
            return
    starts = [f"{_text(key)}:" for key in value] if isinstance(value, dict) else ["-"] * len(value)
    entries = zip(starts, inside, strict=True)
    lines = (line for each in entries for line in _entry(*each, depth + 1))
    # The first key of a mapping follows the dash.
    yield f"- {next(lines)}" if start == "-" else start
    for line in lines:
        yield f"{' ' * INDENT}{line}"


def _text(value: object) -> str:
    """The YAML text of a scalar."""
    if isinstance(value, str):
        return _quoted_if_needed(value)
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and not isfinite(value):
        return ".nan" if isnan(value) else ".inf" if value > 0 else "-.inf"
    return str(value)


@lru_cache(4096)
def _quoted_if_needed(text: str) -> str:
    if PLAIN.fullmatch(text) and scalar(text) == text:
        return text
    quoted = json.dumps(text, ensure_ascii=False)
    return ESCAPED.sub(lambda found: f"\\u{ord(found[0]):04X}", quoted)

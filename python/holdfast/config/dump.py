"""Writes the effective configuration as readable YAML that `load` accepts.

The functions take plain data, not models.
"""

from __future__ import annotations

import io
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.representer import RoundTripRepresenter
from ruamel.yaml.scalarstring import DoubleQuotedScalarString

from holdfast.config.text.source import scalar

NULL_IS_SAID = frozenset({"max_connections_per_source"})
"""Keys whose `None` is written as null; other keys without a value are omitted."""

AS_WRITTEN = frozenset({"options"})
"""Keys whose values belong to someone else, such as an adapter: a null in them is data."""

PLAIN = re.compile(r"[A-Za-z0-9_./]([A-Za-z0-9_./+%@-]|:(?=[^ ])| (?=[^ ]))*", re.ASCII)
"""Text that is safe without quotes anywhere in YAML; all other text is quoted."""


def effective(model: dict[Any, Any]) -> dict[Any, Any]:
    """The data of a model for YAML and JSON, without keys that have no value."""
    return {
        key: value if key in AS_WRITTEN else _plain(value)
        for key, value in model.items()
        if value is not None or key in NULL_IS_SAID
    }


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return effective(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def to_yaml(data: dict[str, Any]) -> str:
    """The YAML text of a mapping; small, deeply nested values are on one line."""
    yaml = YAML()
    yaml.Representer = _Representer
    yaml.width = 100
    yaml.indent(mapping=2, sequence=4, offset=2)
    out = io.StringIO()
    yaml.dump({key: _styled(value, depth=1) for key, value in data.items()}, out)
    return out.getvalue()


def on_one_line(data: dict[str, Any]) -> str:
    """The YAML text of a mapping on one line: `{area: coils, address: 3}`."""
    yaml = YAML()
    yaml.Representer = _Representer
    yaml.width = sys.maxsize
    out = io.StringIO()
    yaml.dump(_flowing(data), out)
    return out.getvalue().strip()


def _flowing(value: object) -> object:
    if isinstance(value, dict):
        mapping = CommentedMap((_styled(k, 0), _flowing(v)) for k, v in value.items())
        mapping.fa.set_flow_style()
        return mapping
    if isinstance(value, list):
        items = CommentedSeq(map(_flowing, value))
        items.fa.set_flow_style()
        return items
    return _styled(value, 0)


class _Representer(RoundTripRepresenter):
    def represent_null(self, data: None) -> ScalarNode:  # noqa: ARG002
        return self.represent_scalar("tag:yaml.org,2002:null", "null")


_Representer.add_representer(type(None), _Representer.represent_null)


def _styled(value: object, depth: int) -> object:
    if isinstance(value, str):
        plain = PLAIN.fullmatch(value) is not None and scalar(value) == value
        return value if plain else DoubleQuotedScalarString(value)
    if isinstance(value, dict):
        mapping = CommentedMap((_styled(k, 0), _styled(v, depth + 1)) for k, v in value.items())
        return _on_one_line(mapping, value.values(), depth)
    if isinstance(value, list):
        return _on_one_line(CommentedSeq(_styled(v, depth + 1) for v in value), value, depth)
    return value


def _on_one_line(
    node: CommentedMap | CommentedSeq, items: Iterable[object], depth: int
) -> CommentedMap | CommentedSeq:
    if depth > 1 and not any(isinstance(item, dict | list) for item in items):
        node.fa.set_flow_style()
    return node

"""Describes the values that a key of the configuration allows.

The descriptions come from the JSON Schema, so messages and editors agree.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.config.text.raw_access import entries, mapping
from holdfast.runtime.text import either, listing

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.config.text.yaml_document import Key, KeyPath

Node: TypeAlias = dict[str, Any]


def allowed(path: KeyPath, data: object) -> str:
    """Describes the values that are allowed at `path` of `data`."""
    nodes = _at(path, data)
    return either([_words(node) for node in nodes]) if nodes else "nothing"


def known_keys(path: KeyPath, data: object) -> list[str]:
    """The keys that are allowed in the mapping at `path` of `data`."""
    keys = [
        key
        for node in _at(path, data)
        for kind in _kinds(_resolved(node), _value(path, data)) or [node]
        for key in _resolved(kind).get("properties", {})
    ]
    return list(dict.fromkeys(keys))


def _schema() -> Node:
    # A valid configuration needs none of this.
    from holdfast.config.schema import cached

    return cached()


def _at(path: KeyPath, data: object) -> list[Node]:
    nodes = [_schema()]
    for index, part in enumerate(path):
        value = _value(path[:index], data)
        nodes = [child for node in nodes for child in _children(node, part, value)]
    return nodes


def _value(path: KeyPath, data: object) -> object:
    for part in path:
        inside: dict[Any, Any] = dict(enumerate(entries(data))) or mapping(data)
        data = inside.get(part)
    return data


def _children(node: Node, part: Key, value: object) -> Iterator[Node]:
    node = _resolved(node)
    for kind in _kinds(node, value):
        yield from _children(kind, part, value)
    if part in node.get("properties", {}):
        yield node["properties"][part]
    yield from node.get("patternProperties", {}).values()
    for inside, unlike in (("additionalProperties", list), ("items", dict)):
        if isinstance(node.get(inside), dict) and not isinstance(value, unlike):
            yield node[inside]


def _kinds(node: Node, value: object) -> list[Node]:
    """The alternatives of a node; only those that the value's discriminator or keys select."""
    kinds: list[Node] = [*node.get("anyOf", ()), *node.get("oneOf", ())]
    if "discriminator" in node:
        named = mapping(value).get(node["discriminator"]["propertyName"])
        refs = node["discriminator"]["mapping"]
        return [{"$ref": refs[named]}] if isinstance(named, str) and named in refs else kinds
    keys = mapping(value).keys()
    fitting = [kind for kind in kinds if keys & _resolved(kind).get("required", ())]
    return fitting[:1] or kinds


def _resolved(node: Node) -> Node:
    if "else" in node:
        node = node["else"]  # Devices; those with `for` have been expanded.
    if "$ref" not in node:
        return node
    target: Node = _schema()["$defs"][node["$ref"].rpartition("/")[2]]
    return target


def _words(node: Node) -> str:
    node = _resolved(node)
    if "discriminator" in node:
        return f"a mapping with the type {either(node['discriminator']['mapping'])}"
    kinds = _kinds(node, None)
    if kinds:
        return either([_words(kind) for kind in kinds])
    if "enum" in node:
        return either(node["enum"])
    if "const" in node:
        return str(node["const"])
    return _WORDS[node["type"]](node)


def _range(kind: str, node: Node) -> str:
    if "minimum" not in node:
        return kind
    unit = f" {node['$comment']}" if "$comment" in node else ""
    if "maximum" not in node:
        return f"{kind} of at least {node['minimum']}{unit}"
    return f"{kind} from {node['minimum']} to {node['maximum']}{unit}"


def _text(node: Node) -> str:
    examples = node.get("examples", ())
    return f"text, as in {either(examples)}" if examples else "text"


def _list(node: Node) -> str:
    return "a list with at least one entry" if "minItems" in node else "a list"


def _mapping(node: Node) -> str:
    if "properties" in node:
        return f"a mapping with the keys {listing(node['properties'])}"
    return "a mapping with at least one entry" if "minProperties" in node else "a mapping"


_WORDS: dict[str, Callable[[Node], str]] = {
    "integer": lambda node: _range("an integer", node),
    "number": lambda node: _range("a number", node),
    "string": _text,
    "array": _list,
    "object": _mapping,
    "boolean": lambda _: "true or false",
    "null": lambda _: "null",
}

"""What is allowed at a place of the configuration, in words.

It is read from the JSON Schema, so that messages and editors say the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.config.schema import cached
from holdfast.config.words import choice, listing

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.config.source import Key, KeyPath

Node: TypeAlias = dict[str, Any]


def allowed(path: KeyPath) -> str:
    """What the value at `path` can be."""
    nodes = _at(path)
    return _words(nodes[0]) if nodes else "nothing"


def known_keys(path: KeyPath) -> list[str]:
    """The keys that the mapping at `path` can have."""
    return [key for node in _at(path) for key in _resolved(node).get("properties", {})]


def _at(path: KeyPath) -> list[Node]:
    nodes = [cached()]
    for part in path:
        nodes = [child for node in nodes for child in _children(node, part)]
    return nodes


def _children(node: Node, part: Key) -> Iterator[Node]:
    node = _resolved(node)
    for kind in node.get("anyOf", ()):
        yield from _children(kind, part)
    if part in node.get("properties", {}):
        yield node["properties"][part]
    yield from node.get("patternProperties", {}).values()
    for inside in ("additionalProperties", "items"):
        if isinstance(node.get(inside), dict):
            yield node[inside]


def _resolved(node: Node) -> Node:
    if "$ref" not in node:
        return node
    target: Node = cached()["$defs"][node["$ref"].rpartition("/")[2]]
    return target


def _words(node: Node) -> str:
    node = _resolved(node)
    if "anyOf" in node:
        return choice([_words(kind) for kind in node["anyOf"]])
    if "enum" in node:
        return choice(node["enum"])
    if "const" in node:
        return str(node["const"])
    return _WORDS[node["type"]](node)


def _range(kind: str, node: Node) -> str:
    return f"{kind} from {node['minimum']} to {node['maximum']}"


def _text(node: Node) -> str:
    examples = node.get("examples", ())
    return f"text, as in {choice(examples)}" if examples else "text"


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
    "null": lambda _: "null",
}

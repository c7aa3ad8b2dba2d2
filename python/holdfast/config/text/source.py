"""Parses YAML 1.2 text into plain data, with the place of every key and value.

Values have the types of the core schema: null, booleans, integers, floats, text, lists and
mappings, whatever a `%YAML` line says. Keys are text or integers, and are unique. This module does
not know what the keys mean.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, ComposerError
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode, SequenceNode
from ruamel.yaml.parser import Parser
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.scanner import Scanner

from holdfast.config.text.messages import show
from holdfast.config.text.problems import ConfigError, Problem
from holdfast.runtime import bounded_files

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from ruamel.yaml.nodes import Node

Key: TypeAlias = str | int
KeyPath: TypeAlias = tuple[Key, ...]

MAX_BYTES = 1 << 20
"""The size limit of a file. It has room for 6,800 devices, which take about 7 s and 160 MB."""

MAX_WRITTEN = 300_000
"""Maximum number of keys and values in one file, as written. Each takes about 25 us and 1 KB."""

MAX_VALUES = 1_000_000
"""Maximum number of values in one file, with aliases expanded."""

_TAG = "tag:yaml.org,2002:"
_WORDS: Final[dict[str, bool | None]] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
_INTEGER = re.compile(r"[-+]?[0-9]{1,400}|0o[0-7]{1,400}|0x[0-9a-fA-F]{1,400}", re.ASCII)
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", re.ASCII)
_SPECIAL = re.compile(r"(?P<inf>[-+]?\.(inf|Inf|INF))|\.(nan|NaN|NAN)")


@dataclass(frozen=True, slots=True)
class Place:
    """A line and a column, both from 1."""

    line: int
    column: int


class _Kind(Enum):
    """What a value is, which decides how its place and its entries are named."""

    MAPPING = "mapping"
    LIST = "list"
    SCALAR = "scalar"
    EMPTY = "empty"
    """No value after a key: its place is that of the key, as the parser puts it anywhere."""


@dataclass(slots=True)
class _Spot:
    """The place of one value, and of the values inside it, by key or by index."""

    place: Place
    children: dict[Key, tuple[Place, _Spot]] = field(default_factory=dict)
    kind: _Kind = _Kind.MAPPING
    values: int = 1


_NO_CHILDREN: Final[dict[Key, tuple[Place, _Spot]]] = {}


@dataclass(frozen=True)
class Document:
    """The data of one file; `root` has the place of each value."""

    file: str
    data: Any
    root: _Spot

    def place(self, path: KeyPath, *, of_key: bool = False) -> Place:
        """The place of a scalar value; for a list or mapping, the place of its key.

        For a path that does not exist, the place of its last existing key.
        """
        spot, found = self.root, self.root.place
        for part in path:
            if part not in spot.children:
                return found
            key_place, spot = spot.children[part]
            found = spot.place if spot.kind is _Kind.SCALAR and not of_key else key_place
        return found

    def holds(self, path: KeyPath) -> bool:
        """Whether there is a value at `path`."""
        spot = self.root
        for part in path:
            if part not in spot.children:
                return False
            spot = spot.children[part][1]
        return True

    def inside(self, *keys: Key) -> Document:
        """A document that has this one at the path of these keys."""
        data, root = self.data, self.root
        for key in reversed(keys):
            data, root = {key: data}, _Spot(root.place, {key: (root.place, root)})
        return Document(self.file, data, root)

    def spell(self, path: KeyPath) -> str:
        """The path as text: `rules[0].units.1`."""
        text, spot = "", self.root
        for part in path:
            word = str(part) if re.fullmatch(r"[\w-]+", str(part)) else repr(part)
            dot = "." if text else ""
            text += f"[{part}]" if spot.kind is _Kind.LIST else f"{dot}{word}"
            spot = spot.children[part][1] if part in spot.children else _Spot(spot.place)
        return text


def table(file: str, data: Any, lines: Mapping[KeyPath, int]) -> Document:
    """A document from a table; `lines` has the line of each mapping that is one row."""

    def spot(value: Any, path: KeyPath, line: int) -> _Spot:
        line = lines.get(path, line)
        inside = dict(enumerate(value)) if isinstance(value, list) else value
        kind = _Kind.LIST if isinstance(value, list) else _Kind.MAPPING
        made = _Spot(Place(line, 1), kind=kind if isinstance(inside, dict) else _Kind.SCALAR)
        if isinstance(inside, dict):
            for key, each in inside.items():
                child = spot(each, (*path, key), line)
                made.children[key] = (child.place, child)
        return made

    return Document(file, data, spot(data, (), 1))


def read_text(path: Path, file: str, form: str = "YAML", max_bytes: int = MAX_BYTES) -> str:
    """Reads a file; messages call it `file`. Raises `ConfigError`."""
    return decoded(read_bytes(path, file, max_bytes), file, form)


def _error(file: str, message: str, line: int | None = None) -> ConfigError:
    """The error of a file that can't be used as a whole."""
    return ConfigError(file, [Problem(file, line, None, "", message)])


def decoded(data: bytes, file: str, form: str = "YAML") -> str:
    """Decodes the content of a file, which has to be of the `form`. Raises `ConfigError`."""
    if b"\0" in data:
        raise _error(file, f"a binary file, allowed: {form} in UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise _error(file, f"not UTF-8, allowed: {form} in UTF-8", line) from None


def read_bytes(path: Path, file: str, max_bytes: int = MAX_BYTES) -> bytes:
    """Reads a file without decoding it. Raises `ConfigError`."""
    try:
        return bounded_files.read(path, max_bytes, named_pipe=True)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise _error(file, f"can't be read: {reason}") from None


def parse(text: str, file: str) -> tuple[Document, list[Problem]]:
    """Returns the document and its problems. Raises `ConfigError` if the YAML is not valid."""
    try:
        reader = _Reader()
        data, spot = reader.value(_compose(text), ())
    except ReaderError as error:
        line = text[: error.position].count("\n") + 1
        message = f"the character U+{error.character:04X} is not allowed in YAML"
        raise _error(file, message, line) from None
    except MarkedYAMLError as error:
        raise ConfigError(file, [_syntax(error, file)]) from None
    except YAMLError as error:
        raise _error(file, f"not YAML: {error}") from None
    except _TooMany:
        raise _error(file, f"more than {MAX_WRITTEN} keys and values, the limit") from None
    except RecursionError:
        raise _error(file, "not a configuration: nested too deeply") from None
    if spot.values > MAX_VALUES:
        message = f"found {spot.values} values with aliases expanded, allowed: up to {MAX_VALUES}"
        raise ConfigError(file, [Problem(file, 1, 1, "", message)])
    document = Document(file, data, spot)
    return document, [
        Problem(file, place.line, place.column, document.spell(path), message)
        for place, path, message in reader.mistakes
    ]


class _TooMany(Exception):
    """A file has too many keys and values."""


class _Scanner(Scanner):
    """Looks once whether the next token is complete, not at each check: saves a fifth."""

    _next: object = None

    def check_token(self, *choices: type) -> bool:
        if not self.tokens or self.tokens[0] is not self._next:
            while self.need_more_tokens():
                self.fetch_more_tokens()
            self._next = self.tokens[0] if self.tokens else None
        return bool(self.tokens) and (not choices or isinstance(self._next, choices))


class _Parser(Parser):
    """Keeps its scanner and resolver, which are properties of properties."""

    scanner = cached_property(lambda parser: parser.loader.scanner)
    resolver = cached_property(lambda parser: parser.loader.resolver)


class _Composer(Composer):
    """Stops at a file with too many keys and values."""

    parser = cached_property(lambda composer: composer.loader.parser)
    resolver = cached_property(lambda composer: composer.loader.resolver)

    def __init__(self, loader: Any = None) -> None:
        super().__init__(loader)
        self._left = MAX_WRITTEN

    def compose_node(self, parent: Node | None, index: object) -> Node | None:
        self._left -= 1
        if self._left < 0:
            raise _TooMany
        node: Node | None = super().compose_node(parent, index)
        return node


def _compose(text: str) -> Node | None:
    yaml = YAML(typ="safe", pure=True)
    yaml.Scanner, yaml.Parser, yaml.Composer = _Scanner, _Parser, _Composer
    yaml.composer.warn_double_anchors = False
    node: Node | None = yaml.compose(text)
    return node


PLAIN_REASONS = {
    "found character '\\t' that cannot start any token": "a tab indents this line, allowed: spaces",
    "expected <block end>, but found '<block mapping start>'": (
        "indented unlike the keys above it, allowed: keys of one mapping begin in the same column"
    ),
    "expected <block end>, but found '-'": (
        "indented unlike the entries above it, allowed: those of a list begin in the same column"
    ),
    "mapping values are not allowed here": (
        "a `:` where no key can be: indented further than the keys above it, or a text with `: `, "
        "which needs quotes"
    ),
}
"""What errors of the YAML parser mean that come from indentation, in words of those who write."""


def _syntax(error: MarkedYAMLError, file: str) -> Problem:
    mark = error.problem_mark or error.context_mark
    line, column = (mark.line + 1, mark.column + 1) if mark else (None, None)
    reason = error.problem or error.context or "invalid syntax"
    start = error.context_mark
    if reason in PLAIN_REASONS:
        reason = PLAIN_REASONS[reason]
    elif error.context and isinstance(error, ComposerError):  # Two documents: one sentence.
        reason = f"{error.context}, {reason}"
    elif error.context and start and mark and start.line != mark.line:
        reason += f", {error.context} that starts in line {start.line + 1}"
    return Problem(file, line, column, "", f"not YAML: {reason}")


class _Reader:
    """Converts nodes into data. A node that several aliases name is converted once."""

    def __init__(self) -> None:
        self.mistakes: list[tuple[Place, KeyPath, str]] = []
        self._done: dict[int, tuple[Any, _Spot]] = {}
        self._open: set[int] = set()

    def value(self, node: Node | None, path: KeyPath) -> tuple[Any, _Spot]:
        if node is None:
            return None, _Spot(Place(1, 1), kind=_Kind.SCALAR)
        if id(node) in self._open:
            self._add(node, path, "an alias inside its own anchor is not allowed")
            return None, _Spot(_place(node), kind=_Kind.SCALAR)
        if id(node) not in self._done:
            self._open.add(id(node))
            self._done[id(node)] = self._read(node, path)
            self._open.discard(id(node))
        return self._done[id(node)]

    def _read(self, node: Node, path: KeyPath) -> tuple[Any, _Spot]:
        kind = str(node.tag).removeprefix(_TAG)
        if isinstance(node, MappingNode) and kind == "map":
            return self._mapping(node, path)
        if isinstance(node, SequenceNode) and kind == "seq":
            return self._list(node, path)
        empty = isinstance(node, ScalarNode) and node.style is None and node.value == ""
        spot = _Spot(_place(node), _NO_CHILDREN, _Kind.EMPTY if empty else _Kind.SCALAR)
        if isinstance(node, ScalarNode):
            try:
                return scalar(node.value, kind), spot
            except ValueError as error:
                self._add(node, path, str(error))
                return None, spot
        self._add(node, path, f"the tag {node.tag!r} is not allowed")
        return None, spot

    def _list(self, node: SequenceNode, path: KeyPath) -> tuple[Any, _Spot]:
        spot = _Spot(_place(node), kind=_Kind.LIST)
        data = []
        for index, item in enumerate(node.value):
            value, child = self.value(item, (*path, index))
            data.append(value)
            spot.children[index] = (_place(item), child)
            spot.values += child.values
        return data, spot

    def _mapping(self, node: MappingNode, path: KeyPath) -> tuple[Any, _Spot]:
        spot = _Spot(_place(node))
        data: dict[Key, Any] = {}
        for key_node, value_node in node.value:
            key = self._key(key_node, path)
            if key is None:
                continue
            if key in data:
                first = spot.children[key][0].line
                name = str(key) if isinstance(key, int) else show(key)
                self._add(key_node, path, f"{name} is given twice, first in line {first}")
                continue
            data[key], child = self.value(value_node, (*path, key))
            spot.children[key] = (_place(key_node), child)
            spot.values += child.values
        return data, spot

    def _key(self, node: Node, path: KeyPath) -> Key | None:
        key = self._read(node, path)[0] if isinstance(node, ScalarNode) else ()
        if isinstance(node, ScalarNode) and node.value == "null":
            return "null"  # No mapping has a key that is nothing, but tags have one of that name.
        if isinstance(key, str) or type(key) is int:
            return key
        found = (
            f"the key {node.value}" if isinstance(node, ScalarNode) else "a list or mapping as key"
        )
        self._add(
            node, path, f"found {found}, allowed: text or an integer; quote it to make it text"
        )
        return None

    def _add(self, node: Node, path: KeyPath, message: str) -> None:
        self.mistakes.append((_place(node), path, message))


def scalar(text: str, kind: str = "") -> str | int | float | bool | None:
    """The value of a scalar, by the core schema; with `kind` `str` it is always text.

    Raises `ValueError` for a tag that is not allowed.
    """
    if kind == "str":
        return text
    if kind not in ("", "null", "bool", "int", "float", "timestamp", "merge", "value"):
        raise ValueError(f"the tag {kind!r} is not allowed")
    if text in _WORDS:
        return _WORDS[text]
    if _INTEGER.fullmatch(text):
        return int(text, 10 if text[:2] not in ("0o", "0x") else 0)
    if _FLOAT.fullmatch(text):
        return float(text)
    if special := _SPECIAL.fullmatch(text):
        return float(text.replace(".", "")) if special["inf"] else float("nan")
    return text


def _place(node: Node) -> Place:
    return Place(node.start_mark.line + 1, node.start_mark.column + 1)

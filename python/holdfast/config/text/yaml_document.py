"""Parses YAML 1.2 text into plain data, with the place of every key and value.

Values have the types of the core schema: null, booleans, integers, floats, text, lists and
mappings, whatever a `%YAML` line says. Keys are text or integers, and are unique. This module does
not know what the keys mean.
"""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from holdfast._core import yaml_events
from holdfast.config.text.messages import show
from holdfast.config.text.problems import ConfigError, ConfigNotAnswered, Problem
from holdfast.runtime import bounded_files

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from pathlib import Path

    from holdfast.types import YamlEvent

Key: TypeAlias = str | int
KeyPath: TypeAlias = tuple[Key, ...]
Resolve: TypeAlias = "Callable[[str, str, str], Any]"
"""Returns the value of a scalar by its tag, its text and its file, or an `Included`. Raises
`ValueError`."""

MAX_BYTES = 1 << 20
"""The size limit of a file. It has room for 6,300 devices, which take about 2 s and 80 MB."""

MAX_WRITTEN = 300_000
"""Maximum number of keys and values in one file, as written. Each takes about 6 us and 0.6 KB."""

MAX_VALUES = 1_000_000
"""Maximum number of values in one file, with aliases expanded."""

_MAX_DEPTH = 10
"""Maximum number of files inside each other."""

_MAX_MISTAKES = 3
"""Maximum number of mistakes of an anchor that each alias has: they grow with each level."""

_TAG = "tag:yaml.org,2002:"
_WORDS: Final[dict[str, bool | None]] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
_INTEGER = re.compile(r"[-+]?[0-9]{1,400}|0o[0-7]{1,400}|0x[0-9a-fA-F]{1,400}", re.ASCII)
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", re.ASCII)
_NOT_ALLOWED = re.compile("[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that YAML does not allow (5.1), which the parser of the core lets pass."""
_SPECIAL = re.compile(r"(?P<inf>[-+]?\.(inf|Inf|INF))|\.(nan|NaN|NAN)")


@dataclass(frozen=True, slots=True)
class Included:
    """The text of another file, whose value is that of a scalar."""

    file: str
    text: str


@dataclass(frozen=True, slots=True)
class Place:
    """A line and a column of a file, both from 1."""

    file: str
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
    is_text: bool = False
    """Whether a scalar is text whatever it holds: in quotes, in a block, or with the tag `str`."""


_NO_CHILDREN: Final[dict[Key, tuple[Place, _Spot]]] = {}


@dataclass(frozen=True)
class Document:
    """The data of one file, with that of files inside it; `root` has the place of each value."""

    file: str
    data: Any
    root: _Spot
    repeated: tuple[tuple[KeyPath, int], ...] = ()
    """The keys that were given before in their mapping, and in which line."""
    mistaken: tuple[KeyPath, ...] = ()
    """The paths of its problems, in their order."""

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
        return self._spot(path) is not None

    def is_text(self, path: KeyPath) -> bool:
        """Whether there is a scalar at `path` that is text whatever it holds, as with quotes."""
        spot = self._spot(path)
        return spot is not None and spot.is_text

    def _spot(self, path: KeyPath) -> _Spot | None:
        spot = self.root
        for part in path:
            if part not in spot.children:
                return None
            spot = spot.children[part][1]
        return spot

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
        made = _Spot(Place(file, line, 1), kind=kind if isinstance(inside, dict) else _Kind.SCALAR)
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


def decoded(
    data: bytes, file: str, form: str = "YAML", *, may_have_nul: bool = False, line: int = 1
) -> str:
    """Decodes the content of a file, which has to be of the `form`. Raises `ConfigError`.

    `line` is the number of its first line.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise _error(file, f"a file in UTF-16, allowed: {form} in UTF-8; save it as UTF-8")
    if b"\0" in data and not may_have_nul:
        raise _error(file, f"a binary file, allowed: {form} in UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line += error.object[: error.start].count(b"\n")
        raise _error(file, f"not UTF-8, allowed: {form} in UTF-8", line) from None


def require_allowed(text: str, file: str, form: str = "YAML") -> None:
    """Refuses control characters, as of a binary file. Raises `ConfigError`."""
    if found := _NOT_ALLOWED.search(text):
        line = text[: found.start()].count("\n") + 1
        raise _error(file, f"the character U+{ord(found[0]):04X} is not allowed in {form}", line)


def read_bytes(
    path: Path, file: str, max_bytes: int = MAX_BYTES, *, named_pipe: bool = True
) -> bytes:
    """Reads a file without decoding it. Raises `ConfigError`."""
    try:
        return bounded_files.read(path, max_bytes, named_pipe=named_pipe)
    except bounded_files.NotAnswered as error:
        raise ConfigNotAnswered.of(error) from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise _error(file, f"can't be read: {reason}") from None


def parse(
    text: str,
    file: str,
    resolve: Resolve | None = None,
    *,
    merges: bool = False,
    max_values: int = MAX_VALUES,
    room: int = 0,
) -> tuple[Document, list[Problem]]:
    """Returns the document and its problems. Raises `ConfigError` if the YAML is not valid.

    For files of other programs: `resolve` gives scalars with a tag of their own a value, which must
    be a scalar, or that of another file. With `merges`, the key `<<` adds the keys of other
    mappings that are not there, and the last of equal keys counts. `max_values` counts values with
    aliases expanded. `room` is a number of keys and values that is allowed in any case.
    """
    max_written, max_values = max(MAX_WRITTEN, room), max(max_values, room)
    try:
        reader = _Reader(text, file, resolve, merges=merges, max_written=max_written)
    except _TooMany:
        raise _error(file, f"more than {max_written} keys and values, the limit") from None
    except RecursionError:
        raise _error(file, "not a configuration: nested too deeply") from None
    data, spot = reader.document
    if spot.values > max_values:
        message = f"found {spot.values} values with aliases expanded, allowed: up to {max_values}"
        raise ConfigError(file, [Problem(file, 1, 1, "", message)])
    mistaken = tuple(path for _, path, _ in reader.mistakes)
    document = Document(file, data, spot, tuple(filter(None, reader.repeated)), mistaken)
    return document, [
        Problem(place.file, place.line, place.column, document.spell(path), message)
        for place, path, message in reader.mistakes
    ]


class _TooMany(Exception):
    """A file has too many keys and values."""


def _events(text: str, file: str, max_written: int) -> Iterable[YamlEvent]:
    require_allowed(text, file)
    # Text without a value has no events, from either parser.
    if events := yaml_events(text, max_written):
        return events
    from holdfast.config.text import slow_yaml  # Few files need it, and its library takes 30 ms.

    return slow_yaml.events(text, file)


class _Reader:
    """Makes data of the text of one document."""

    def __init__(
        self,
        text: str,
        file: str,
        resolve: Resolve | None,
        *,
        merges: bool,
        max_written: int,
    ) -> None:
        self._files: tuple[str, ...] = (file,)
        """The files inside each other whose events are read; the last one is the innermost."""
        self._resolve = resolve
        self._merges = merges
        self._mistakes_of: dict[int | str, list[tuple[Place, str]]] = {}
        """The first mistakes inside an anchor, which are also those of its aliases: only a part of
        a file of another program may be read."""
        self.mistakes: list[tuple[Place, KeyPath, str]] = []
        self.repeated: list[tuple[KeyPath, int] | None] = []
        """The keys that were given before, `None` inside a value that does not count."""
        self._events = iter(_events(text, file, max_written))
        self._left = max_written
        self._anchors: dict[int | str, tuple[Any, _Spot] | None] = {}
        """What an anchor names, `None` while its value is being read."""
        self.document: Final = self._document(())

    def _document(self, path: KeyPath) -> tuple[Any, _Spot]:
        first = next(self._events, None)
        if first is None:
            return None, _Spot(Place(self._files[-1], 1, 1), kind=_Kind.SCALAR)
        value = self._value(first, path)
        next(self._events, None)  # Raises what follows the document and is not allowed there.
        return value

    def _value(self, event: YamlEvent, path: KeyPath) -> tuple[Any, _Spot]:
        self._left -= 1
        if self._left < 0:
            raise _TooMany
        what, _, _, anchor, _, _ = event
        if what == "alias":
            assert anchor is not None, "each alias names an anchor"
            return self._aliased(event, anchor, path)
        if anchor is None:
            return self._new_value(event, path)
        self._anchors[anchor] = None
        known = len(self.mistakes)
        value = self._anchors[anchor] = self._new_value(event, path)
        if self._resolve is not None:
            first = self.mistakes[known : known + _MAX_MISTAKES]
            self._mistakes_of[anchor] = [(place, message) for place, _, message in first]
        return value

    def _aliased(self, event: YamlEvent, anchor: int | str, path: KeyPath) -> tuple[Any, _Spot]:
        value = self._anchors[anchor]
        if value is not None:
            for place, message in self._mistakes_of.get(anchor, ()):
                is_here = place.file == self._files[-1]
                self.mistakes.append((self._place(event) if is_here else place, path, message))
            return value
        return self._refused(event, path, "an alias inside its own anchor is not allowed")

    def _new_value(self, event: YamlEvent, path: KeyPath) -> tuple[Any, _Spot]:
        what, _, _, _, tag, text = event
        if text is not None:
            kind = "" if tag is None and what == "plain" else (tag or "!").removeprefix(_TAG)
            try:
                data: Any
                if kind == "!":
                    data = text
                elif kind.startswith("!") and self._resolve is not None:
                    data = self._resolve(kind, text, self._files[-1])
                else:
                    data = scalar(text, kind)
            except ValueError as error:
                return self._refused(event, path, str(error))
            if isinstance(data, Included):
                return self._included(event, path, data)
            empty = text == "" and what == "plain"
            form = _Kind.EMPTY if empty else _Kind.SCALAR
            is_text = kind in ("!", "str")
            return data, _Spot(self._place(event), _NO_CHILDREN, form, is_text=is_text)
        value = self._list(event, path) if what == "list" else self._mapping(event, path)
        if tag in (None, "!", f"{_TAG}seq" if what == "list" else f"{_TAG}map"):
            return value
        return self._refused(event, path, f"the tag {tag!r} is not allowed")

    def _included(self, event: YamlEvent, path: KeyPath, included: Included) -> tuple[Any, _Spot]:
        outside = self._files, self._events, self._anchors, self._mistakes_of
        if included.file in self._files or len(self._files) == _MAX_DEPTH:
            allowed = f"allowed: up to {_MAX_DEPTH} files inside each other, none inside itself"
            return self._refused(event, path, f"found {included.file}, {allowed}")
        here, known = self._place(event), len(self.mistakes)
        self._files, self._anchors, self._mistakes_of = (*self._files, included.file), {}, {}
        try:
            self._events = iter(_events(included.text, included.file, self._left))
            return self._document(path)
        except ConfigNotAnswered:
            raise
        except ConfigError as error:
            del self.mistakes[known:]
            for each in error.problems:
                place = Place(each.file, each.line or 1, each.column or 1)
                self.mistakes.append((place, path, each.message))
            return None, _Spot(here, kind=_Kind.SCALAR)
        finally:
            self._files, self._events, self._anchors, self._mistakes_of = outside

    def _list(self, start: YamlEvent, path: KeyPath) -> tuple[Any, _Spot]:
        spot = _Spot(self._place(start), kind=_Kind.LIST)
        data: list[Any] = []
        for event in self._until_end():
            value, child = self._value(event, (*path, len(data)))
            spot.children[len(data)] = (self._place(event), child)
            spot.values += child.values
            data.append(value)
        return data, spot

    def _mapping(self, start: YamlEvent, path: KeyPath) -> tuple[Any, _Spot]:
        spot = _Spot(self._place(start))
        data: dict[Key, Any] = {}
        merged: list[tuple[YamlEvent, Any, _Spot]] = []
        repeated_in: dict[Key, slice] = {}  # The part of `repeated` that is inside a value.
        for event in self._until_end():
            key = self._key(event, path)
            if key == "<<" and self._merges:
                merged.append((event, *self._value(next(self._events), (*path, key))))
                continue
            if key == "<<" and event[0] == "plain":
                message = "found a merge key, allowed: the keys themselves"
                self._add(event, (*path, key), message)
                key = None
            elif key in data and self._merges:
                if (replaced := repeated_in.pop(key, None)) is not None:
                    self.repeated[replaced] = [None] * (replaced.stop - replaced.start)
                self.repeated.append(((*path, key), spot.children[key][0].line))
            elif key in data:
                first = spot.children[key][0].line
                name = str(key) if isinstance(key, int) else show(key)
                self._add(event, path, f"{name} is given twice, first in line {first}")
                key = None
            known, before = len(self.mistakes), len(self.repeated)
            value, child = self._value(next(self._events), path if key is None else (*path, key))
            if key is None:
                del self.mistakes[known:], self.repeated[before:]
                continue
            if len(self.repeated) > before:
                repeated_in[key] = slice(before, len(self.repeated))
            data[key] = value
            spot.children[key] = (self._place(event), child)
            spot.values += child.values
        for event, value, child in reversed(merged):
            if isinstance(value, dict | list):
                self._merge(data, spot, value, child)
            elif value is not None:
                self._add(event, (*path, "<<"), f"found {show(value)}, allowed: a mapping")
        return data, spot

    def _merge(self, data: dict[Key, Any], spot: _Spot, value: Any, child: _Spot) -> None:
        """Adds the keys of a mapping, or of a list of them, that are not there."""
        spot.values += child.values
        if isinstance(value, list):
            for index, each in enumerate(value):
                self._merge(data, spot, each, child.children[index][1])
        elif isinstance(value, dict):
            for key in [key for key in value if key not in data]:
                data[key], spot.children[key] = value[key], child.children[key]

    def _until_end(self) -> Iterator[YamlEvent]:
        """The events of a list, or of the keys of a mapping, until it ends."""
        while (event := next(self._events))[0] != "end":
            yield event

    def _key(self, event: YamlEvent, path: KeyPath) -> Key | None:
        known = len(self.mistakes)
        key, spot = self._value(event, path)
        if event[-1] == "null":
            return "null"  # No mapping has a key that is nothing, but tags have one of that name.
        if isinstance(key, str) or type(key) is int:
            return key
        if spot.kind in (_Kind.MAPPING, _Kind.LIST):
            del self.mistakes[known:]
            found = "a list or mapping as key"
        else:
            found = f"the key {event[-1]}" if event[-1] else "an empty key"
        allowed = "text or an integer; quote it to make it text"
        self._add(event, path, f"found {found}, allowed: {allowed}")
        return None

    def _refused(self, event: YamlEvent, path: KeyPath, message: str) -> tuple[None, _Spot]:
        self._add(event, path, message)
        return None, _Spot(self._place(event), kind=_Kind.SCALAR)

    def _add(self, event: YamlEvent, path: KeyPath, message: str) -> None:
        self.mistakes.append((self._place(event), path, message))

    def _place(self, event: YamlEvent) -> Place:
        return Place(self._files[-1], event[1], event[2])


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

"""A strict parser of line protocol, written from its specification."""

from __future__ import annotations

from typing import Any, NamedTuple


class Point(NamedTuple):
    """One line."""

    measurement: str
    tags: dict[str, str]
    fields: dict[str, Any]
    time: int


def parsed(data: bytes) -> list[Point]:
    """Parses lines. Raises `ValueError` for anything that is not allowed."""
    text = data.decode()
    points, at = [], 0
    while at < len(text):
        point, at = _point(text, at)
        points.append(point)
    return points


def _point(text: str, at: int) -> tuple[Point, int]:
    measurement, at = _name(text, at, ", ", ", ")
    tags: dict[str, str] = {}
    while text[at] == ",":
        key, at = _name(text, at + 1, "=", ",= ")
        value, at = _name(text, at + 1, ", ", ",= ")
        _put(tags, key, value)
    fields: dict[str, Any] = {}
    while True:
        key, at = _name(text, at + 1, "=", ",= ")
        value, at = _value(text, at + 1)
        _put(fields, key, value)
        if text[at] == " ":
            break
        if text[at] != ",":
            raise ValueError(f"found {text[at]!r} after a field")
    end = text.index("\n", at)
    return Point(measurement, tags, fields, int(text[at + 1 : end])), end + 1


def _put(into: dict[str, Any], key: str, value: Any) -> None:
    if key in into or not key:
        raise ValueError(f"the key {key!r} is empty or comes twice")
    into[key] = value


def _name(text: str, at: int, ends: str, special: str) -> tuple[str, int]:
    found = ""
    while text[at] not in ends:
        if text[at] == "\n":
            raise ValueError("a line ends in a name")
        if text[at] == "\\" and text[at + 1] in special:
            at += 1
        elif text[at] in special:
            raise ValueError(f"found {text[at]!r} in a name")
        found += text[at]
        at += 1
    return found, at


def _value(text: str, at: int) -> tuple[Any, int]:
    if text[at] == '"':
        return _quoted(text, at + 1)
    end = at
    while text[end] not in ", \n":
        end += 1
    word = text[at:end]
    if word in ("true", "false"):
        return word == "true", end
    if word.endswith("i"):
        number = int(word[:-1])
        if not -(2**63) <= number < 2**63:
            raise ValueError(f"{word} does not fit 64 bits")
        return number, end
    return float(word), end


def _quoted(text: str, at: int) -> tuple[str, int]:
    found = ""
    while text[at] != '"':
        if text[at] in "\n\r\f":
            raise ValueError(f"found {text[at]!r} in a text")
        if text[at] == "\\" and text[at + 1] in '"\\':
            at += 1
        found += text[at]
        at += 1
    return found, at + 1

"""The parser of YAML for text that the core refuses: it says in words what is wrong.

It also accepts a `}` left of the key that it belongs to, which many write, and nests deeper.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    DocumentStartEvent,
    MappingEndEvent,
    MappingStartEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
)
from ruamel.yaml.scanner import Scanner

from holdfast.config.text.messages import PATH_QUOTES, foreign_space
from holdfast.config.text.problems import ConfigError, Problem

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.types import YamlEvent

MAX_KEY_LENGTH = 1024
"""Characters of a key without `?`, by YAML."""

_QUOTES = "text that begins with [, { or a quote needs quotes around the whole, as in '[::1]:502'"

_FORBIDDEN_START = re.compile("found character '([%@`])' that cannot start any token")

_TAB = "found character '\\t' that cannot start any token"

PLAIN_REASONS = {
    _TAB: "a tab indents this line, allowed: spaces",
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
    "expected <block end>, but found '<scalar>'": f"more text after the end of a value: {_QUOTES}",
}
"""What errors of the YAML parser mean that come from indentation and brackets, in words of those
who write."""

IN_BRACKETS = {
    f"expected ',' or '{end}', but got '{found}'": f"a comma is missing, or {_QUOTES}"
    for end in "}]"
    for found in (":", "<scalar>")
}
"""The same for errors in the line of the bracket; in another line, it was probably not closed."""


def _syntax(error: MarkedYAMLError, file: str) -> Problem:
    mark = error.problem_mark or error.context_mark
    line, column = (mark.line + 1, mark.column + 1) if mark else (None, None)
    reason = error.problem or error.context or "invalid syntax"
    start = error.context_mark
    if reason == _TAB and mark and mark.buffer[mark.pointer - mark.column : mark.pointer].strip():
        # It is YAML, but both parsers refuse it.
        return Problem(file, line, column, "", "a tab before a value, allowed: spaces")
    if mark and (blank := _foreign_space(error)) is not None:
        line, reason = blank
        column = None
    elif (character := _FORBIDDEN_START.fullmatch(reason)) is not None:
        begin = f"text that begins with {character[1]} needs quotes around the whole"
        reason = f"{begin}, as in unit: '{character[1]}'"
    elif reason in PLAIN_REASONS:
        reason = PLAIN_REASONS[reason]
    elif error.context and start and mark and start.line != mark.line:
        reason += f", {error.context} that starts in line {start.line + 1}"
    else:
        reason = IN_BRACKETS.get(reason, reason)
    if reason.startswith(("found unknown escape", "expected escape")):
        reason += f"; in double quotes, \\ begins an escape: {PATH_QUOTES}"
    return Problem(file, line, column, "", f"not YAML: {reason}")


def _foreign_space(error: MarkedYAMLError) -> tuple[int, str] | None:
    """The line and the reason of an error that is due to a space which YAML does not know."""
    context, mark = error.context or "", error.problem_mark
    if "quoted" in context:
        return None
    first = last = mark.line
    if context == "while scanning a simple key":
        first = last = error.context_mark.line
    elif error.problem == "mapping values are not allowed here":
        first -= 1  # Where a text of several lines may begin, but none in quotes.
    for number, line in list(enumerate(mark.buffer.splitlines(), 1))[max(first, 0) : last + 1]:
        code = line.partition("#")[0]
        for part in (code, code.partition(":")[2]):
            if (blank := foreign_space(part)) is not None:
                return number, f"found {blank}, allowed: spaces"
    return None


def events(text: str, file: str) -> Iterator[YamlEvent]:
    """The events of the only document of a text. Raises `ConfigError`."""
    try:
        yield from _events(text)
    except MarkedYAMLError as error:
        raise ConfigError(file, [_syntax(error, file)]) from None
    except YAMLError as error:
        raise ConfigError(file, [Problem(file, None, None, "", f"not YAML: {error}")]) from None


class _Scanner(Scanner):
    """Looks at the first place where a key may begin, not at all of them: they are in order.

    Otherwise, reading nested brackets takes time by the square of their depth.
    """

    def next_possible_simple_key(self) -> Any:
        return next((key.token_number for key in self.possible_simple_keys.values()), None)

    def stale_possible_simple_keys(self) -> None:
        keys = self.possible_simple_keys
        while keys:
            level, key = next(iter(keys.items()))
            if key.line == self.reader.line and self.reader.index - key.index <= MAX_KEY_LENGTH:
                return
            if key.required:
                super().stale_possible_simple_keys()  # Raises.
            del keys[level]


def _events(text: str) -> Iterator[YamlEvent]:
    documents = 0
    anchors: set[str | None] = {None}
    yaml = YAML(typ="safe", pure=True)
    yaml.Scanner = _Scanner
    for event in yaml.parse(text):
        mark = event.start_mark
        at = mark.line + 1, mark.column + 1
        anchor = getattr(event, "anchor", None)
        if isinstance(event, AliasEvent) and anchor not in anchors:
            found = f"found undefined alias {anchor!r}"
            raise MarkedYAMLError(problem=found, problem_mark=mark)
        anchors.add(anchor)
        match event:
            case ScalarEvent():
                yield (
                    "plain" if event.style is None else "quoted",
                    *at,
                    anchor,
                    event.tag,
                    event.value,
                )
            case SequenceStartEvent():
                yield "list", *at, anchor, event.tag, None
            case MappingStartEvent():
                yield "mapping", *at, anchor, event.tag, None
            case SequenceEndEvent() | MappingEndEvent():
                yield "end", *at, None, None, None
            case AliasEvent():
                yield "alias", *at, anchor, None, None
            case DocumentStartEvent() if documents:
                found = "expected a single document in the stream, but found another document"
                raise MarkedYAMLError(problem=found, problem_mark=mark)
            case DocumentStartEvent():
                documents += 1

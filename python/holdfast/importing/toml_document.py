"""Reads TOML with the lines of its keys, which the standard library does not tell."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

from holdfast.config.text import yaml_document
from holdfast.config.text.problems import ConfigError, Problem

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.config.text.yaml_document import Document, KeyPath

VARIABLE = re.compile(r"\$(?:\{([A-Za-z_]\w*)[^}]*\}|([A-Za-z_]\w*))")
"""An environment variable in a text."""

_TOKEN = re.compile(
    r"""(?P<blank>[ \t\r]+|\#[^\n]*)
    |(?P<text>\"{3}(?:\\.|[^\\])*?\"{3,5}|'{3}.*?'{3,5}|"(?:\\.|[^"\\\n])*"|'[^'\n]*')
    |(?P<mark>[][{}=,.\n])
    |(?P<word>[^][\s{}=,."'\#]+)""",
    re.VERBOSE | re.DOTALL,
)


def document(path: Path | str) -> Document:
    """The content of a TOML file, with the lines of its keys. Raises `ConfigError`."""
    file = str(path)
    text = yaml_document.read_text(Path(path), file, "TOML")
    try:
        return yaml_document.table(file, tomllib.loads(text), _Lines(text).read())
    except ValueError as error:
        raise _syntax_error(file, text, str(error)) from None
    except RecursionError:
        raise _syntax_error(file, text, "nested too deeply") from None


def _syntax_error(file: str, text: str, message: str) -> ConfigError:
    found = re.fullmatch(r"(.*) \(at (?:line (\d+), column (\d+)|end of document)\)", message)
    line = int(found[2] or text.count("\n") + 1) if found else 1
    column = int(found[3]) if found and found[3] else None
    message = f"not TOML: {found[1] if found else message}"
    if VARIABLE.search(" ".join(text.splitlines()[line - 1 : line])):
        message += "; replace environment variables by their values"
    return ConfigError(file, [Problem(file, line, column, "", message)])


class _Lines:
    """Finds the lines of keys, tables and entries in text that is valid TOML."""

    def __init__(self, text: str) -> None:
        self._tokens: list[tuple[str, int]] = []
        line = 1
        for match in _TOKEN.finditer(text):
            if match.lastgroup != "blank":
                self._tokens.append((match[0], line))
            line += match[0].count("\n")
        self._tokens.append(("\n", line))
        self._next = 0
        self._lines: dict[KeyPath, int] = {}
        self._counts: dict[KeyPath, int] = {}
        """The tables so far of each array of tables."""

    def read(self) -> Mapping[KeyPath, int]:
        """The lines by path."""
        table: KeyPath = ()
        while self._next < len(self._tokens):
            token, line = self._tokens[self._next]
            if token == "[":
                table = self._header()
                self._lines.setdefault(table, line)
            elif token != "\n":
                self._pair(table)
                continue
            self._next += 1
        return self._lines

    def _take(self) -> tuple[str, int]:
        self._next += 1
        return self._tokens[self._next - 1]

    def _keys(self, end: str) -> list[str]:
        keys = []
        while (token := self._take()[0]) != end:
            if token != ".":
                keys.append(token[1:-1] if token[0] in "\"'" else token)
        return keys

    def _header(self) -> KeyPath:
        """The path of a table, with the index in each array of tables."""
        self._next += 1
        is_array = self._tokens[self._next][0] == "["
        self._next += is_array
        keys, line = self._keys("]"), self._tokens[self._next - 1][1]
        path: KeyPath = ()
        for number, key in enumerate(keys, 1):
            path = (*path, key)
            self._lines.setdefault(path, line)
            if is_array and number == len(keys):
                self._counts[path] = self._counts.get(path, 0) + 1
            if path in self._counts:
                path = (*path, self._counts[path] - 1)
        return path

    def _pair(self, table: KeyPath) -> None:
        line = self._tokens[self._next][1]
        path = table
        for key in self._keys("="):
            path = (*path, key)
            self._lines.setdefault(path, line)
        self._value(path)

    def _value(self, path: KeyPath) -> None:
        token, _ = self._take()
        if token == "[":
            self._list(path)
        elif token == "{":
            while self._tokens[self._next][0] != "}":
                if self._tokens[self._next][0] in (",", "\n"):
                    self._next += 1
                else:
                    self._pair(path)
            self._next += 1
        else:
            while self._tokens[self._next][0] not in (",", "]", "}", "\n"):
                self._next += 1

    def _list(self, path: KeyPath) -> None:
        index = 0
        while (found := self._tokens[self._next])[0] != "]":
            if found[0] in (",", "\n"):
                self._next += 1
                continue
            self._lines[(*path, index)] = found[1]
            self._value((*path, index))
            index += 1
        self._next += 1

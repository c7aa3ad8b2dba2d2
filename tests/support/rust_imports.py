"""Reads the imports of Rust crates: `use` items, and paths in the code.

Comments, strings and tests are ignored. A module's re-export of its submodules is not an import: a
path through it leads to the file that defines the name.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from support.imports import Import

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

STANDARD = {"std", "core", "alloc"}

TOKEN = re.compile(
    r"""
      (?P<skip> \s+ | //[^\n]* | b?r(?P<hashes>\#*)".*?"(?P=hashes) | [bc]?"(?:\\.|[^"\\])*"
        | b?'(?:\\(?:x..|u\{[^}]*\}|.)|[^\\'])' | '\w+ | \d\w* )
    | (?P<comment> /\*)
    | (?P<token> (?:r\#)?[^\W\d]\w* | :: | . )
    """,
    re.VERBOSE | re.DOTALL,
)
IDENT = re.compile(r"[^\W\d]\w*")


@dataclass(frozen=True)
class Token:
    """A word, `::`, or another character, and its line."""

    text: str
    line: int


@dataclass(frozen=True)
class WrittenPath:
    """A path in the source, with the depth of nested modules inside its file."""

    segments: tuple[str, ...]
    line: int
    depth: int
    is_use: bool = False
    is_export: bool = False


@dataclass
class Module:
    """One file: its submodules, its paths, and the names from `use` items."""

    name: str
    file: Path
    parts: list[str] = field(default_factory=list)
    paths: list[WrittenPath] = field(default_factory=list)
    names: dict[str, WrittenPath] = field(default_factory=dict)


def dependencies(crate: Path) -> set[str]:
    """Returns the dependencies in a crate's manifest, as the code names them."""
    manifest = tomllib.loads((crate / "Cargo.toml").read_text(encoding="utf-8"))
    tables = [manifest, *manifest.get("target", {}).values()]
    return {name.replace("-", "_") for table in tables for name in table.get("dependencies", {})}


def crate_name(crate: Path) -> str:
    """Returns the name of a crate, as the code of other crates names it."""
    manifest = tomllib.loads((crate / "Cargo.toml").read_text(encoding="utf-8"))
    return str(manifest["package"]["name"]).replace("-", "_")


def rust_imports(modules: Iterable[Module], crates: Iterable[Path], root: Path) -> list[Import]:
    """Returns all imports in the modules of crates, except the standard library.

    Paths are relative to `root`.
    """
    house = {module.name: module for module in modules}
    outside = {crate_name(crate): dependencies(crate) | STANDARD for crate in crates}
    resolver = _Resolver(house, outside)
    found: dict[tuple[Path, int, str], Import] = {}
    for module in house.values():
        for path in module.paths:
            absolute = resolver.absolute(module, path)
            target = resolver.target(absolute) if absolute else None
            if absolute is None or target is None or target in STANDARD:
                continue
            if target == module.name or (path.is_export and target.startswith(module.name + "::")):
                continue
            one = Import(
                module.name, module.file.relative_to(root), path.line, "::".join(absolute), target
            )
            found.setdefault((one.file, one.line, one.name), one)
    return list(found.values())


def modules(crate: Path) -> list[Module]:
    """Reads every file of a crate, except test files."""
    found = []
    waiting = [Module(crate_name(crate), crate / "src" / "lib.rs")]
    while waiting:
        module = waiting.pop()
        text = module.file.read_text(encoding="utf-8")
        _Reader(module, _without_tests(list(tokens(text)))).read()
        found.append(module)
        folder = crate.joinpath("src", *module.name.split("::")[1:])
        for part in module.parts:
            files = [folder / f"{part}.rs", folder / part / "mod.rs"]
            file = next(file for file in files if file.exists())
            waiting.append(Module(f"{module.name}::{part}", file))
    return sorted(found, key=lambda module: module.name)


def tokens(text: str) -> Iterator[Token]:
    """Returns the tokens of a source, without comments, strings, numbers and lifetimes."""
    at, line = 0, 1
    while at < len(text):
        match = TOKEN.match(text, at)
        assert match is not None
        end = _comment_end(text, at) if match["comment"] else match.end()
        if match["token"]:
            yield Token(match["token"].removeprefix("r#"), line)
        line += text.count("\n", at, end)
        at = end


def _comment_end(text: str, at: int) -> int:
    depth = 0
    for match in re.compile(r"/\*|\*/").finditer(text, at):
        depth += 1 if match[0] == "/*" else -1
        if depth == 0:
            return match.end()
    return len(text)


def _without_tests(source: list[Token]) -> list[Token]:
    """Returns the tokens without attributes and without items that are only for tests."""
    kept = []
    at = 0
    while at < len(source):
        if source[at].text == "#" and source[at + 1].text in ("[", "!"):
            start = at + 1 + (source[at + 1].text == "!")
            end = _closing(source, start)
            words = [token.text for token in source[start:end]]
            at = end + 1
            if words[1:2] == ["cfg"] and "test" in words and "not" not in words:
                at = _item_end(source, at)
        else:
            kept.append(source[at])
            at += 1
    return kept


def _item_end(source: list[Token], at: int) -> int:
    while source[at].text not in (";", "{"):
        at = _closing(source, at) + 1 if source[at].text in ("(", "[") else at + 1
    return at + 1 if source[at].text == ";" else _closing(source, at) + 1


def _closing(source: list[Token], at: int) -> int:
    """Returns the position of the closing bracket."""
    depth = 0
    for index in range(at, len(source)):
        depth += (source[index].text in "([{") - (source[index].text in ")]}")
        if depth == 0:
            return index
    raise ValueError(f"line {source[at].line}: {source[at].text!r} is never closed")


class _Reader:
    """Reads the tokens of a file in one pass."""

    def __init__(self, module: Module, source: list[Token]) -> None:
        self.module = module
        self.source = source
        self.at = 0
        self.inner: list[int] = []

    def text(self, ahead: int = 0) -> str:
        place = self.at + ahead
        return self.source[place].text if place < len(self.source) else ""

    def read(self) -> None:
        braces = 0
        exported = False
        while self.at < len(self.source):
            text = self.text()
            braces += (text == "{") - (text == "}")
            if self.inner and braces < self.inner[-1]:
                self.inner.pop()
            if text == "mod" and self.text(2) == ";":
                self.module.parts.append(self.text(1))
                self.at += 2
            elif text == "mod" and self.text(2) == "{":
                self.inner.append(braces + 1)
                self.at += 2
            elif text == "pub":
                exported = True
                self.at += 1
                if self.text() == "(":
                    self.at = _closing(self.source, self.at) + 1
                continue
            elif text == "use" and self.text(1) != "<":
                self.at += 1
                self._use((), exported)
            elif IDENT.fullmatch(text):
                self._inline()
            else:
                self.at += 1
            exported = False

    def _inline(self) -> None:
        line = self.source[self.at].line
        before = self.source[self.at - 1].text if self.at else ""
        segments = [self.text()]
        self.at += 1
        while self.text() == "::" and IDENT.fullmatch(self.text(1)):
            segments.append(self.text(1))
            self.at += 2
        if before not in ("$", "::") and (len(segments) > 1 or self.text() == "::"):
            self.module.paths.append(WrittenPath(tuple(segments), line, len(self.inner)))

    def _use(self, start: tuple[str, ...], exported: bool) -> None:
        """Reads one tree of a `use` item, up to the next `;`, `,` or `}`."""
        segments = list(start)
        line = self.source[self.at].line
        if self.text() == "::":
            self.at += 1
        while IDENT.fullmatch(self.text()) and self.text() != "as":
            segments.append(self.text())
            self.at += 1
            if self.text() == "::":
                self.at += 1
        if self.text() == "{":
            self.at += 1
            while self.text() != "}":
                self._use(tuple(segments), exported)
                self.at += self.text() == ","
            self.at += 1
            return
        if self.text() == "*":
            self.at += 1
            self._keep([*segments, "*"], None, line, exported)
            return
        if len(segments) > 1 and segments[-1] == "self":
            segments.pop()
        name = segments[-1]
        if self.text() == "as":
            name = self.text(1)
            self.at += 2
        self._keep(segments, name, line, exported)

    def _keep(self, segments: list[str], name: str | None, line: int, exported: bool) -> None:
        path = WrittenPath(tuple(segments), line, len(self.inner), True, exported)
        self.module.paths.append(path)
        if name is not None and name != "_":
            self.module.names.setdefault(name, path)


class _Resolver:
    """Finds the file that defines the name of a path."""

    def __init__(self, house: dict[str, Module], outside: dict[str, set[str]]) -> None:
        self.house = house
        self.outside = outside

    def absolute(self, module: Module, path: WrittenPath) -> tuple[str, ...] | None:
        """Returns the path from the root of a crate; `None` for names local to their file."""
        here = module.name.split("::")
        first, *rest = path.segments
        if first == "crate":
            return (here[0], *rest)
        if first in ("self", "super"):
            start, climb = list(path.segments), path.depth
            while start and start[0] in ("self", "super"):
                climb -= start.pop(0) == "super"
            return (*here[: len(here) + min(climb, 0)], *start)
        if "::".join([*here, first]) in self.house:
            return (*here, *path.segments)
        if first in self.outside[here[0]]:
            return path.segments
        known = module.names.get(first)
        if path.is_use or known is None or known.segments == path.segments:
            return None
        start_of_known = self.absolute(module, known)
        return (*start_of_known, *rest) if start_of_known else None

    def target(self, path: tuple[str, ...], seen: frozenset[object] = frozenset()) -> str | None:
        """Returns the project's module, or the library, that defines the name of a path.

        Returns `None` if the path only names a module, as the start of other paths.
        """
        if path[0] not in self.outside:
            return path[0]
        at = path[0]
        for index, segment in enumerate(path[1:], start=1):
            if f"{at}::{segment}" in self.house:
                at = f"{at}::{segment}"
                continue
            known = self.house[at].names.get(segment)
            if known is None or (at, segment) in seen:
                return at
            start = self.absolute(self.house[at], known)
            if start is None:
                return at
            return self.target((*start, *path[index + 1 :]), seen | {(at, segment)})
        return None

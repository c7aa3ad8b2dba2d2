"""Imports configurations of the Modbus Memory Appliance, of both generations.

The first has `memory`, `routing` and `ports`, the second nests memories in `listeners`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from holdfast.config import source
from holdfast.config.dump import to_yaml
from holdfast.config.problems import ConfigError
from holdfast.config.words import show
from holdfast.importing.binds import Binds
from holdfast.importing.choices import Choices
from holdfast.importing.draft import Draft
from holdfast.importing.filters import read_filter
from holdfast.importing.mma_adapters import Adapters
from holdfast.importing.mma_first import FirstGeneration
from holdfast.importing.mma_second import TOP_REASONS, SecondGeneration
from holdfast.importing.notes import Desk, Note
from holdfast.importing.sections import Section

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.config.problems import Problem

Generation: TypeAlias = Literal[1, 2]
ORDINALS: dict[Generation, str] = {1: "first", 2: "second"}

_SECRET = re.compile(r"(token|password|broker)[\"']?\s*:")
_FIRST = ("memory", "routing", "ports")
_SECOND = "listeners"


@dataclass(frozen=True)
class Imported:
    """A Holdfast configuration, with notes on the conversion."""

    file: str
    generation: Generation
    data: dict[str, Any]
    notes: tuple[Note, ...]

    def to_yaml(self) -> str:
        """The configuration as YAML, with the notes as comments above it."""
        name = ORDINALS[self.generation]
        lines = [
            "Made by `holdfast import mma` from a configuration of the Modbus Memory Appliance,"
        ]
        lines.append(f"{name} generation: {self.file}")
        if self.notes:
            lines += ["Left out, changed or to be checked:", *map(str, self.notes)]
        comments = "".join(f"# {' '.join(line.splitlines())}\n" for line in lines)
        body = "".join(f"{line.rstrip()}\n" for line in to_yaml(self.data).splitlines())
        return f"{comments}\n{body}"


class NotImportable(ConfigError):
    """The source can't be imported; `notes` has the notes until then."""

    def __init__(self, file: str, problems: Iterable[Problem], notes: tuple[Note, ...]) -> None:
        super().__init__(file, problems)
        self.notes = notes


def read_mma(
    path: Path | str, *, as_meant: bool = False, keep_published_tokens: bool = False
) -> Imported:
    """Converts a configuration of either generation.

    The source ignores some keys. By default, the result does what it did; with `as_meant`, these
    keys have an effect. Tokens that its documentation publishes are left out, unless
    `keep_published_tokens` is set.

    Raises `ConfigError` with every problem that prevents the import.
    """
    file = str(path)
    text = source.read_text(Path(path), file)
    try:
        document, found = source.parse(text, file)
    except ConfigError as error:
        raise ConfigError(file, _without_secrets(text, error.problems)) from None
    problems = _without_secrets(text, found)
    desk = Desk(document)
    generation = _generation(desk)
    draft = Draft()
    if generation is not None:
        _read(desk, draft, generation, Choices(as_meant, keep_published_tokens))
        if not (draft.listeners or draft.rest or draft.mqtt or desk.report.problems):
            desk.problem((), "nothing to serve, allowed: at least one listener, REST or MQTT")
    problems += desk.report.problems
    if problems or generation is None:
        raise NotImportable(file, problems, desk.notes)
    return Imported(file, generation, draft.data(), desk.notes)


def _without_secrets(text: str, problems: Iterable[Problem]) -> list[Problem]:
    """Hides what a YAML error quotes from a line that may contain a secret."""
    lines = text.splitlines()
    hidden = "not YAML (line hidden, as it may contain a secret), allowed: text in quotes"
    return [
        replace(problem, message=hidden)
        if problem.line and _SECRET.search(" ".join(lines[problem.line - 1 : problem.line]))
        else problem
        for problem in problems
    ]


def _generation(desk: Desk) -> Generation | None:
    data = desk.document.data
    if not isinstance(data, dict):
        found = "an empty file" if data is None else show(data)
        desk.problem((), f"found {found}, allowed: a mapping")
        return None
    if _SECOND in data:
        return 2
    if any(key in data for key in _FIRST):
        return 1
    allowed = "memory, routing and ports (first generation) or listeners (second)"
    desk.problem((), f"found none of the keys of a generation, allowed: {allowed}")
    return None


def _read(desk: Desk, draft: Draft, generation: Generation, choices: Choices) -> None:
    root = Section(desk, (), desk.document.data)
    admitted = read_filter(root)
    if admitted is not None:
        ran, meant = "it had no effect", "only the addresses that it allows have access"
        choices.note(desk, root.at("ip_filter"), ran=ran, meant=meant)
        admitted = admitted if choices.as_meant else None
    binds = Binds(desk, choices)
    if generation == 1:
        FirstGeneration(desk, draft, binds, admitted, choices).read(root)
    else:
        SecondGeneration(desk, draft, binds, admitted).read(root)
    Adapters(desk, draft, binds, admitted, choices).read(root)
    root.close(TOP_REASONS if generation == 2 else None)

"""Compares what programs print with the pages: the shape, not the numbers."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from support.pages.blocks import Block
    from support.pages.stage import Stage


def alike(shown: str, told: str) -> None:
    """Checks that an output has the lines of the page, with other numbers and states.

    `…` on a line of its own in the page stands for any lines.
    """
    found, expected = masked(shown), masked(told)
    some = "…" in expected
    expected.discard("…")
    different = [f"  page:    {line}" for line in sorted(expected - found)]
    if not some:
        different += [f"  program: {line}" for line in sorted(found - expected)]
    assert not different, "\n".join(["the page and the program differ:", *different])


def masked(text: str) -> set[str]:
    """The lines, without numbers, states and widths."""
    # A digest, a secret.
    text = re.sub(r"\b[0-9a-f]{64}\b|(?<![\w-])[\w-]{43}(?![\w-])", "#", text)
    text = re.sub(r"\b(?=[0-9]*[A-F])(?=[A-F]*[0-9])[0-9A-F]{4}\b", "#", text)
    text = re.sub(r"[+-]?\d[\d.:TZ-]*(?:e[+-]\d+)?|\btrue\b|\bfalse\b", "#", text)
    text = re.sub(r"\b(off|heating|fault) \(#\)", "STATE", text)
    text = re.sub(r'"states": \{.*?\}', "", text)
    return {" ".join(line.split()) for line in text.splitlines()} - {""}


def same_shape(found: Any, told: Any, at: str = "$") -> None:
    """Checks that JSON has the keys and types of the page, and its texts."""
    if told == "…":
        return
    assert type(found) is type(told), f"{at}: the program has {found!r}, the page {told!r}"
    if isinstance(told, dict):
        assert list(found) == list(told), f"{at}: the program has the keys {list(found)}"
        for key in told:
            same_shape(found[key], told[key], f"{at}.{key}")
    elif isinstance(told, list):
        assert len(found) == len(told), f"{at}: the program has {len(found)} items"
        for number, (one, other) in enumerate(zip(found, told, strict=True)):
            same_shape(one, other, f"{at}[{number}]")
    elif isinstance(told, str):
        assert masked(found) == masked(told), f"{at}: the program has {found!r}, the page {told!r}"


def reply(block: Block, stage: Stage) -> None:
    """Compares JSON of the page with the output of the commands before it."""
    told, found = documents(block.text), documents(stage.there(stage.output))
    assert len(found) >= len(told), f"the commands before print {stage.output!r}"
    for one, other in zip(found[-len(told) :], told, strict=True):
        same_shape(one, other)


def documents(text: str) -> list[Any]:
    """The JSON documents of a text, which is nothing else."""
    found = []
    at = 0
    while rest := text[at:].lstrip():
        at = len(text) - len(rest)
        document, end = json.JSONDecoder().raw_decode(rest)
        found.append(document)
        at += end
    return found

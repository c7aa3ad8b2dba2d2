"""Which functions a rule of the source allows, and the keys of a rule that allow the same here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.text.messages import show
from holdfast.protocol import (
    FUNCTIONS,
    OPTIONAL_CODES,
    WRITING_CODES,
)
from holdfast.runtime.text import listing

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.importing.key_reader import Section
    from holdfast.importing.notes import Choices

SOURCE = frozenset({1, 2, 3, 4, 5, 6, 15, 16})
"""Functions that the source supports; it refuses all others."""

_SERVED = [each for each in FUNCTIONS if each.code not in OPTIONAL_CODES]
"""What a listener serves without settings that no source has."""

ALL = frozenset(each.code for each in _SERVED)
WRITING = frozenset(WRITING_CODES)
READING = ALL - WRITING
WRITING_ONLY = SOURCE & WRITING
"""Functions that only write: without 23, and without 22, whose result reveals bits."""

OTHERS = frozenset(each.code for each in _SERVED if each.area is None)
"""Functions that access no area."""

_ALLOW = {"ro": READING, "rw": ALL, "wo": WRITING_ONLY}
_MEANT = {
    "ro": "its peers may read",
    "rw": "its peers may read and write",
    "wo": "its peers may write",
}

_CLOSE = {22: {6, 16}, 23: {3, 6, 16}}
"""Functions with the effect of others: a peer that is denied those must not have these."""


def read_codes(section: Section, key: str) -> list[int] | None:
    """The supported codes of a list, without duplicates; `None` without a list."""
    entries = section.entries(key)
    if entries is None:
        return None
    codes: dict[int, None] = {}
    for path, code in entries:
        if type(code) is not int or not 0 <= code <= 255:
            message = f"found {show(code)}, allowed: a function code from 0 to 255"
            section.desk.problem(path, message)
        elif code not in ALL:
            message = f"function {code} is not supported, so it is always refused"
            section.desk.left_out(path, message)
        else:
            codes[code] = None
    return list(codes)


def allowed_by(rule: Section, choices: Choices) -> frozenset[int]:
    """What `allow_fc` and `allow` of a rule of the second generation allow."""
    codes = read_codes(rule, "allow_fc")
    if rule.get("allow") is not None:
        meant = _allow(rule, codes, choices)
        return meant if choices.as_meant else frozenset(codes or ())
    if codes is None:
        rule.desk.check(rule.path, "neither allow_fc nor allow: the rule allows nothing")
    return frozenset(codes or ())


def _allow(rule: Section, codes: list[int] | None, choices: Choices) -> frozenset[int]:
    """What `allow` was meant to allow. The source did not read it, in none of its versions."""
    path = rule.at("allow")
    if not choices.as_meant:
        nothing = "the rule allowed no function, and refused its peers"
        ran = f"it had no effect: {nothing if codes is None else 'allow_fc decided'}"
        meant = _MEANT.get(str(rule.get("allow")), "an error: it is not ro, rw or wo")
        choices.note(rule.desk, path, ran=ran, meant=meant)
        return frozenset()
    word = rule.word("allow", list(_ALLOW))
    if codes is not None:
        message = "found together with allow_fc, allowed: only one of them"
        rule.problem_of_key("allow", message)
    if word is None:
        return frozenset()
    ran = "it had no effect: the rule allowed no function, and refused its peers"
    choices.note(rule.desk, path, ran=ran, meant=_MEANT[word])
    if word == "wo":
        message = f"only functions {spelled(_ALLOW[word])}, which write; 22 and 23"
        text = f"{message} also read. A rule has no other way to forbid reading"
        rule.changed("allow", text)
    return _ALLOW[word]


def touching(areas: Iterable[str]) -> frozenset[int]:
    """The functions that read or write these areas."""
    wanted = set(areas)
    return frozenset(each.code for each in FUNCTIONS if each.area in wanted)


def with_same_effect(denied: Iterable[int]) -> list[int]:
    """Functions that must be denied too, because they have the effect of a denied function."""
    codes = set(denied)
    return [code for code, like in _CLOSE.items() if like & codes and code not in codes]


def rights(allowed: frozenset[int]) -> dict[str, Any]:
    """`access`, and `functions` if necessary, of a rule that allows exactly these functions."""
    access = "read-write" if allowed & WRITING else "read-only"
    if allowed in (ALL, READING):
        return {"access": access}
    return {"access": access, "functions": sorted(allowed)}


def spelled(codes: Iterable[int]) -> str:
    """Codes as text for a message."""
    return listing(sorted(codes)) or "none"

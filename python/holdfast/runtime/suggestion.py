"""Which known word is suggested for an unknown one."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

MIN_LIKENESS = 0.6
"""How alike a suggested word must be, as `difflib` measures it: 1 for the same word."""

HIGH_LIKENESS = 0.8
"""For guesses that do harm if they are wrong: of a type, or what kind of file it is."""

MAX_COMPARED = 256
"""Nothing is suggested for longer words: to compare one of a megabyte takes seconds."""


def suggestion(word: object, known: Iterable[object]) -> str:
    """`; did you mean 'x'?` if a known word is close, in any case, else ""."""
    words, text = list(map(str, known)), str(word)
    if len(text) > MAX_COMPARED:
        return ""
    same = [each for each in words if _plain(each) == _plain(text)]
    close = same or alike(text, words) or alike(text.lower(), words)
    return f"; did you mean {close[0]!r}?" if close else ""


def alike(
    word: str, known: Iterable[str], least: float = MIN_LIKENESS, *, most: int = 1
) -> list[str]:
    """The known words that are most like a word, the best first."""
    # Imported here, for a fast start: only wrong words need it.
    import difflib

    return difflib.get_close_matches(word, known, most, least)


def _plain(word: str) -> str:
    """A word without what people write in several ways."""
    return word.casefold().replace("_", "-")

"""The text of configurations: its two parsers agree, and what is written reads back the same."""

from __future__ import annotations

import re
import sys
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast._core import yaml_events
from holdfast.config import ConfigError
from holdfast.config.dump import to_yaml
from holdfast.config.text import slow_yaml, yaml_document
from holdfast.config.text.yaml_document import parse
from support.paths import DOCS, EXAMPLES

if TYPE_CHECKING:
    from types import FrameType

FILES = sorted(EXAMPLES.rglob("*.yaml"))
BLOCKS = [
    pytest.param(block, id=f"{page.stem}-{number}")
    for page in sorted(DOCS.glob("*.md"))
    for number, block in enumerate(re.findall(r"```yaml\n(.*?)```", page.read_text(), re.DOTALL))
]
SCALARS = (
    st.text()
    | st.sampled_from(["null", "1", "1e3", "on", "0x1F", "- a", "a: b", "#", ".inf", "~"])
    | st.integers()
    | st.floats(allow_nan=False)
    | st.booleans()
    | st.none()
)
KEYS = st.text() | st.integers()
VALUES = st.recursive(SCALARS, lambda v: st.lists(v) | st.dictionaries(KEYS, v), max_leaves=20)


def places(text: str) -> list[tuple[object, ...]]:
    """The data of a text, and the place of each value but those that are nothing."""
    document, problems = parse(text, "file")
    found: list[tuple[object, ...]] = [(document.data, problems)]

    def walk(data: Any, path: tuple[Any, ...]) -> None:
        if data is not None:
            found.append((path, document.place(path), document.place(path, of_key=True)))
        if isinstance(data, list | dict):
            inside = enumerate(data) if isinstance(data, list) else data.items()
            for key, each in inside:
                walk(each, (*path, key))

    walk(document.data, ())
    return found


@pytest.mark.parametrize("text", [*(file.read_text() for file in FILES), *BLOCKS])
def test_both_parsers_find_the_same(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert yaml_events(text, yaml_document.MAX_WRITTEN) is not None
    fast = places(text)
    monkeypatch.setattr(yaml_document, "yaml_events", lambda _text, _most: None)
    assert places(text) == fast


def test_a_brace_may_be_left_of_its_key() -> None:
    text = "memories:\n  plant: {coils: 8,\n}\n"
    assert yaml_events(text, yaml_document.MAX_WRITTEN) is None
    assert parse(text, "file")[0].data == {"memories": {"plant": {"coils": 8}}}


def steps(text: str) -> int:
    """The lines that run to read text with the slow parser."""
    count = 0

    def trace(_: FrameType, event: str, __: object) -> Any:
        nonlocal count
        count += event == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        with suppress(ConfigError):
            deque(slow_yaml.events(text, "f"), 0)
    finally:
        sys.settrace(before)
    return count


def test_the_work_for_brackets_grows_as_their_number() -> None:
    steps("[" * 10)
    assert steps("[" * 800) < 3 * steps("[" * 400)


@pytest.mark.parametrize("character", ["\x07", "\x7f", "\x9f", "\ufffe"])
def test_control_characters_are_refused(character: str) -> None:
    with pytest.raises(ConfigError, match=rf"file:2: the character U\+{ord(character):04X} is not"):
        parse(f"a: 1\nb: x{character}\n", "file")


@given(st.dictionaries(KEYS, VALUES, min_size=1))
def test_what_is_written_reads_back_the_same(data: dict[Any, Any]) -> None:
    document, problems = parse(to_yaml(data), "file")
    assert (document.data, problems) == (data, [])

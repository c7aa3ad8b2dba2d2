"""Whatever the text of a configuration is: it is loaded, or every problem has its place."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hypothesis import example, given, settings
from hypothesis import strategies as st

from holdfast.config import load
from holdfast.config.text.problems import ConfigError
from support.cases import examples
from support.paths import EXAMPLES

if TYPE_CHECKING:
    import pytest

TEXTS = [path.read_text(encoding="utf-8") for path in sorted(EXAMPLES.glob("*.yaml"))]
PIECES = ["&a ", "*a", "<<: ", "!!int ", "{", "}", "[", "]", "- ", ": ", "? ", "|", "#", "\t", "\0"]


@st.composite
def changed(draw: st.DrawFn) -> bytes:
    """An example with a few lines and pieces changed."""
    lines = draw(st.sampled_from(TEXTS)).splitlines()
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(lines) - 1))
        place = draw(st.integers(0, len(lines[at])))
        piece = draw(st.sampled_from(PIECES) | st.text(max_size=4) | st.integers().map(str))
        match draw(st.sampled_from(["insert", "replace", "repeat", "remove"])):
            case "insert":
                lines[at] = lines[at][:place] + piece + lines[at][place:]
            case "replace":
                lines[at] = lines[at][:place] + piece
            case "repeat":
                lines.insert(draw(st.integers(0, len(lines))), lines[at])
            case _:
                lines[at] = ""
    return "\n".join(lines).encode("utf-8", "surrogatepass")


@settings(max_examples=examples(40))
@example(b"[" * 10_000)
@example(b"a: &a [*a]")
@example(b"\xff\xfe")
@given(changed() | st.binary(max_size=80))
def test_a_text_is_loaded_or_its_problems_have_places(
    tmp_path_factory: pytest.TempPathFactory, text: bytes
) -> None:
    path = tmp_path_factory.mktemp("any") / "plant.yaml"
    path.write_bytes(text)
    found: ConfigError | None = None
    try:
        load(path)
    except ConfigError as error:
        found = error
    if found is None:
        return
    assert found.problems
    lines = text.count(b"\n") + text.count(b"\r") + 1
    for problem in found.problems:
        assert problem.message
        assert problem.line is None or 1 <= problem.line <= lines

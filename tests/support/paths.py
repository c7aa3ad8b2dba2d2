"""The paths of the project's files."""

from __future__ import annotations

from pathlib import Path

TESTS = Path(__file__).parents[1]
ROOT = TESTS.parent
DATA = TESTS / "data"
VECTORS = TESTS / "vectors"
DOCS = ROOT / "docs"
EXAMPLES = ROOT / "examples"

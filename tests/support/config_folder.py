"""A folder with a configuration, and the errors and warnings of loading it."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from holdfast.config import Config, ConfigError, load

if TYPE_CHECKING:
    from pathlib import Path


class Folder:
    """A folder with a configuration and the files that it names."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def problems(self, text: str | bytes, **files: str) -> list[str]:
        """Returns the errors, without the path of the folder."""
        for name, content in files.items():
            (self.path / name.replace("_", ".")).write_text(content, encoding="utf-8")
        raw = text if isinstance(text, bytes) else text.encode()
        (self.path / "p.yaml").write_bytes(raw)
        with pytest.raises(ConfigError) as caught:
            load(self.path / "p.yaml")
        return [str(problem).replace(f"{self.path}/", "") for problem in caught.value.problems]

    def config(self, text: str) -> Config:
        """Loads a valid configuration."""
        (self.path / "p.yaml").write_text(text, encoding="utf-8")
        return load(self.path / "p.yaml")

    def warnings(self, text: str) -> list[str]:
        """Returns the warnings of a valid configuration."""
        warnings = self.config(text).warnings
        return [str(warning).replace(f"{self.path}/", "") for warning in warnings]


def written(data: object) -> str:
    """Formats data as YAML on one line, with quoted text."""
    if isinstance(data, dict):
        return "{" + ", ".join(f"{written(k)}: {written(v)}" for k, v in data.items()) + "}"
    if isinstance(data, list):
        return "[" + ", ".join(written(item) for item in data) + "]"
    return json.dumps(data, ensure_ascii=False)

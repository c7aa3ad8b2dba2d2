"""Which files the import opens for `!include` and `!secret`: those in the folder, or below it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holdfast.config.text import yaml_document
from holdfast.config.text.problems import ConfigError, ConfigNotAnswered
from holdfast.importing.imported import Source
from holdfast.importing.key_reader import Secret

if TYPE_CHECKING:
    from holdfast.importing.notes import Desk

_MAX_INCLUDES = 300
"""Maximum number of files that are read because others name them, each time counted."""

_MAX_INCLUDED_BYTES = 4 << 20
"""Maximum size of these files together, each time counted: comments and empty lines take time and
memory, too.
"""

_INSIDE = "a file in the folder of the imported one, or below it"


class IncludedFiles:
    """Gives tags of YAML a value: `!secret`, and `!include` of a file below its folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = _real(folder)
        self._secrets: dict[Path, Desk | None] = {}
        self._includes_left = _MAX_INCLUDES
        self._bytes_left = _MAX_INCLUDED_BYTES

    def resolve(self, kind: str, text: str, file: str) -> Any:
        """The value of a tag in `file`, of this kind and with this text. Raises `ValueError`."""
        if kind == "!include":
            return self._included(text, Path(file).parent)
        if kind == "!secret":
            return self._secret(text, _real(Path(file).parent))
        allowed = "what it stands for"
        if kind.startswith("!include_dir_"):
            allowed = "!include of each file; a file with hubs can be imported by itself"
        raise ValueError(f"found {kind} {text}, allowed: {allowed}")

    def _included(self, text: str, folder: Path) -> yaml_document.Included:
        path = folder / text
        self._includes_left -= 1
        if self._includes_left < 0:
            raise ValueError(
                f"found !include {text}, allowed: {_MAX_INCLUDES} of them in all files"
            )
        if not _real(path).is_relative_to(self._folder):
            raise ValueError(f"found !include {text}, allowed: {_INSIDE}")
        try:
            content = yaml_document.read_bytes(path, str(path), named_pipe=False)
            decoded = yaml_document.decoded(content, str(path))
        except ConfigNotAnswered:
            raise  # Each further file of a mount that is gone takes as long.
        except ConfigError as error:
            raise ValueError(f"found !include {text}, but {error}") from None
        self._bytes_left -= len(content)
        if self._bytes_left < 0:
            allowed = f"{_MAX_INCLUDED_BYTES} bytes in all files that are included"
            raise ValueError(f"found !include {text}, allowed: {allowed}")
        return yaml_document.Included(str(path), decoded)

    def _secret(self, name: str, folder: Path) -> Any:
        """The value in the nearest file with secrets, from the folder up, as in the source."""
        for each in (folder, *folder.parents):
            if not each.is_relative_to(self._folder):
                break
            if each not in self._secrets:
                self._secrets[each] = self._secrets_in(each / "secrets.yaml")
            desk = self._secrets[each]
            if desk is not None and desk.document.holds((name,)):
                return _secret_of(desk, name)
        missing = "which is not in secrets.yaml beside the imported file"
        raise ValueError(f"found the secret {name}, {missing}, allowed: its value")

    def _secrets_in(self, file: Path) -> Desk | None:
        if not file.is_file():
            return None
        if not _real(file).is_relative_to(self._folder):
            raise ValueError(f"found a secret, but {file} is a link, allowed: {_INSIDE}")
        try:
            return Source(file, lambda kind, text, _: yaml_document.scalar(text, kind)).desk
        except ConfigNotAnswered:
            raise
        except ConfigError:
            raise ValueError(f"found a secret, but {file} is not YAML that can be read") from None


def _real(path: Path) -> Path:
    """The path without links: only what is in the folder is read."""
    return Path(os.path.realpath(path))


def _secret_of(desk: Desk, name: str) -> Any:
    """The value of a secret that a file has; messages never show it."""
    found = desk.report.raw((name,))
    if found is None or isinstance(found, dict | list):
        raise ValueError(f"found the secret {name} without a value, allowed: text or a number")
    if desk.document.spell((name,)) in {problem.key for problem in desk.report.problems}:
        base = "which the source read as octal or binary"
        raise ValueError(f"found the secret {name}, {base}, allowed: a number without a 0 in front")
    return Secret(found) if isinstance(found, str) else found

"""Reads profiles that a configuration names by their files."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from holdfast.config.checks.common import unreadable
from holdfast.config.text.messages import show
from holdfast.config.text.problems import ConfigError
from holdfast.config.text.raw_access import entries, mapping
from holdfast.config.values.scalars import NAME_FORM, check_file_path, is_name
from holdfast.runtime.text import either

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.text.report import Report
    from holdfast.config.text.yaml_document import KeyPath

_ANY = {"tags": {"any": {"area": "coils", "address": 0}}}
"""In place of a profile that could not be read, so that its users are checked all the same."""


@dataclass
class ProfileFiles:
    """The profile files of one configuration, relative to `folder`."""

    folder: Path
    report: Report
    files: list[Path] = field(default_factory=list)

    def read(self) -> None:
        """Replaces a list of files in the document by the profiles in them."""
        document = self.report.document
        data = mapping(document.data)
        given = data.get("profiles")
        profiles: dict[Any, Any] = {}
        if isinstance(given, list):
            for index, file in enumerate(entries(given)):
                self._read(("profiles", index), file, profiles)
        elif any(isinstance(each, str) for each in mapping(given).values()):
            for name, profile in mapping(given).items():
                self._add(name, profile, profiles)
        else:
            return
        self.report.document = replace(document, data={**data, "profiles": profiles})

    def _add(self, name: Any, profile: object, profiles: dict[Any, Any]) -> None:
        """Adds an entry of a mapping, which has no files."""
        if isinstance(profile, str):
            message = "allowed: a mapping with the keys order, tags; files are a list"
            self.report.add(
                ("profiles", name), f"found {show(profile)}, {message}: profiles: [heater.yaml]"
            )
        profiles[name] = _ANY if isinstance(profile, str) else profile

    def _read(self, path: KeyPath, file: object, profiles: dict[str, Any]) -> None:
        from holdfast.config.tag_files.read import KINDS, load_profile

        if not isinstance(file, str) or not file.lower().endswith(KINDS):
            self.report.add(path, f"found {show(file)}, allowed: a file {either(KINDS)}")
            return
        try:
            check_file_path(file)
        except ValueError as error:
            self.report.add(path, str(error))
            return
        where = self.folder / file
        if not is_name(where.stem):
            message = f"found {show(file)}, which names the profile {show(where.stem)}"
            self.report.add(path, f"{message}, allowed: {NAME_FORM}")
            return
        if where.stem in profiles:
            message = f"found {show(file)}, a second file for the profile {where.stem}"
            self.report.add(path, f"{message}, allowed: one")
            return
        if reason := unreadable(where):
            self.report.add(path, f"found {show(file)}, which can't be read: {reason}")
            profiles[where.stem] = _ANY
            return
        self.files.append(where)
        try:
            profiles[where.stem] = load_profile(where, file).model_dump(exclude_unset=True)
        except ConfigError as error:
            self.report.elsewhere += error.problems
            profiles[where.stem] = _ANY

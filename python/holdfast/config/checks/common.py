"""What the checks of all sections share: their scope, unique values, ranges and files."""

from __future__ import annotations

import errno
import os
import stat
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from holdfast.config.models.base import INVALID, InvalidValue
from holdfast.config.text.messages import show
from holdfast.runtime import bounded_files
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import listing

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from holdfast.config.models.base import Model
    from holdfast.config.models.root import Config
    from holdfast.config.text.report import Report
    from holdfast.config.text.yaml_document import KeyPath

T = TypeVar("T")

until_invalid = partial(suppress, InvalidValue)
"""The context of one check: it ends at the first value that is invalid, which the model reports."""


@dataclass(frozen=True)
class Scope:
    """The configuration that is checked, and where its problems go."""

    config: Config
    """The valid part of the file."""
    folder: Path
    """The folder that files are relative to."""
    report: Report
    _names: dict[str, dict[str, None]] = field(default_factory=dict, init=False)

    def names(self, section: str) -> Collection[str]:
        """The valid names in a section; none if the section is invalid."""
        if section not in self._names:
            given = self.config.__dict__.get(section, {})
            self._names[section] = {name: None for name in given if isinstance(name, str)}
        return self._names[section]


def items(path: KeyPath, entries: Mapping[Any, T] | Sequence[T]) -> Iterator[tuple[KeyPath, T]]:
    """The valid entries of a list or mapping, with their paths."""
    keyed: Iterable[tuple[Any, T]] = (
        entries.items() if isinstance(entries, dict) else enumerate(entries)
    )
    for key, entry in keyed:
        if entry is not INVALID:
            yield (*path, key), entry


def given(model: Model, *keys: str) -> list[str]:
    """Those of the keys that are written in the file."""
    return [key for key in keys if key in model.model_fields_set]


def refuse_repeats(path: KeyPath, values: Iterable[object] | None, report: Report) -> None:
    """Reports every text or integer that repeats an earlier entry of the list."""
    seen: set[str | int] = set()
    for index, value in enumerate(values or ()):
        if not isinstance(value, str) and type(value) is not int:
            continue
        if value in seen:
            report.add((*path, index), f"found {show(value)} again, allowed: once")
        seen.add(value)


def check_name(path: KeyPath, name: str, known: Iterable[str], what: str, report: Report) -> bool:
    """Reports a name that is not one of the known ones, which messages call `what`."""
    names = list(known)
    if name in names:
        return True
    if name in map(str, names):
        return False  # A name without quotes, which has been reported.
    words = listing(names) or f"none, there are no {what}"
    report.add(path, f"found {show(name)}, allowed: {words}{suggestion(name, names)}")
    return False


@dataclass
class Owners:
    """The first owner of each value, for values that must be unique."""

    report: Report
    what: str
    """What the value is, as messages call it."""
    first: dict[object, KeyPath] = field(default_factory=dict)

    def claim(
        self,
        path: KeyPath,
        value: object,
        shown: str,
        owner: KeyPath,
        allowed: str = "a different one",
    ) -> None:
        """Reports `value` at `path` if another owner has it; messages call it `shown`."""
        if value not in self.first:
            self.first[value] = owner
            return
        of = self.report.named(self.first[value])
        self.report.add(
            path, f"found {shown}, which is the {self.what} of {of}, allowed: {allowed}"
        )


def unreadable(path: Path) -> str:
    """Why a file can't be read, or "" if it can. Does not open it: it may contain a secret."""
    try:
        mode = bounded_files.call(path, path.stat).st_mode
        may_read = bounded_files.call(path, os.access, path, os.R_OK)
    except OSError as error:
        return error.strerror or str(error)
    if stat.S_ISDIR(mode):
        return os.strerror(errno.EISDIR)
    return bounded_files.unstored(path, mode) or ("" if may_read else os.strerror(errno.EACCES))


NO_FOLDER = "whose folder does not exist"


def unplaceable(file: Path, *, may_be_device: bool = False) -> str:
    """Why a file can't be written in its folder, or "" if it can."""
    try:
        if not bounded_files.call(file, file.parent.is_dir):
            return NO_FOLDER
        mode = bounded_files.call(file, file.stat).st_mode
    except FileNotFoundError:
        return ""
    except bounded_files.NotAnswered:
        raise
    except OSError as error:
        return f"which can't be used: {error.strerror}"
    if stat.S_ISDIR(mode):
        return "which is a folder"
    kind = "" if may_be_device and stat.S_ISCHR(mode) else bounded_files.special(file, mode)
    return kind and f"which is {kind}"


def check_readable(
    path: KeyPath, file: Path | None, report: Report, *, shown: str | None = None
) -> None:
    """Reports a file that can't be read. `shown` replaces its name in the message."""
    reason = "" if file is None else unreadable(file)
    if reason:
        found = shown or show(report.raw(path))
        report.add(path, f"found {found}, which can't be read: {reason}")

"""Checks the files that Holdfast writes: each has a folder, and nothing else uses it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from holdfast.config.checks.common import NO_FOLDER, Owners, items, unplaceable, until_invalid
from holdfast.config.fingerprint import files_of
from holdfast.config.models.outputs import FileConfig
from holdfast.config.text.messages import show
from holdfast.runtime import bounded_files

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.config.checks.common import Scope
    from holdfast.config.models.root import Config
    from holdfast.config.text.yaml_document import KeyPath


def check_written_files(scope: Scope) -> None:
    """Reports what is wrong."""
    report, owners = scope.report, Owners(scope.report, "file")
    written = list(_written(scope.config))
    read = _read(scope) if written else set()
    shared: dict[tuple[str, str], Path] = {}
    for path, file, users in written:
        shown = show(report.raw(path))
        if reason := unplaceable(file, may_be_device=path[0] == "audit"):
            # Outputs try again: a disk that is not mounted yet must not keep memories down.
            waits = path[0] == "outputs" and reason == NO_FOLDER
            note = report.warn if waits else report.add
            note(path, f"found {shown}, {reason}, allowed: a file in an existing folder")
        elif (place := _place(file)) in read:
            report.add(path, f"found {shown}, which the configuration reads, allowed: another file")
        elif not users or (spelled := shared.setdefault((users, place), file)) is file:
            owners.claim(path, place, shown, path[:-1])
        elif spelled != file:
            owners.claim(
                path, place, shown, path[:-1], "the same text, to share it, or another file"
            )


def _read(scope: Scope) -> set[str]:
    """The places of the files that are read: the configuration, and those that it names."""
    itself = scope.folder / Path(scope.report.document.file).name
    read = {_place(itself)}
    with until_invalid():
        read |= {_place(file) for file in files_of(itself, scope.config)}
    return read


def _written(config: Config) -> Iterator[tuple[KeyPath, Path, str]]:
    """The valid files that are written, with their paths, and who may share one, if anybody."""
    found: list[tuple[KeyPath, Path | None, str]] = []
    with until_invalid():
        if config.audit is not None:
            found.append((("audit", "file"), config.audit.file, ""))
    with until_invalid():
        for path, output in items(("outputs",), config.outputs):
            with until_invalid():
                if isinstance(output, FileConfig):
                    users = "databases" if output.format == "sqlite" else ""
                    found.append(((*path, "file"), output.file, users))
            with until_invalid():
                found.append(((*path, "buffer", "file"), output.buffer.file, ""))
    with until_invalid():
        for path, memory in items(("memories",), config.memories):
            with until_invalid():
                if memory.keep is not None:
                    found.append(((*path, "keep", "file"), memory.keep.file, "memories"))
    return ((path, file, users) for path, file, users in found if file is not None)


def _place(file: Path) -> str:
    """The same text for all names of a file, but for hard links."""
    return os.path.normcase(bounded_files.call(file, os.path.realpath, file))

"""Checks that the files of a configuration are readable."""

from __future__ import annotations

import errno
import os
import stat
from typing import TYPE_CHECKING

from holdfast import bounded_files
from holdfast.config.words import show

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath


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


def check_readable(
    path: KeyPath, file: object, folder: Path, report: Report, *, shown: str | None = None
) -> None:
    """Reports a file, relative to `folder`, that can't be read. Ignores values that name no file.

    `shown` replaces the name of the file in the message.
    """
    if isinstance(file, str) and file and "\0" not in file:
        reason = unreadable(folder / file)
        if reason:
            report.add(path, f"found {shown or show(file)}, which can't be read: {reason}")

"""That files which a configuration names can be read."""

from __future__ import annotations

import errno
import os
import stat
from typing import TYPE_CHECKING, Any

from holdfast.config.words import show

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.problems import Report
    from holdfast.config.source import KeyPath


def check_readable(path: KeyPath, owner: dict[Any, Any], folder: Path, report: Report) -> None:
    """Reports the file that `owner` names at the last key of `path` when it can't be read.

    It is relative to `folder`.
    """
    file = owner.get(path[-1])
    if isinstance(file, str) and file and "\0" not in file:
        reason = _unreadable(folder / file)
        if reason:
            report.add(path, f"found {show(file)}, which can't be read: {reason}")


def _unreadable(path: Path) -> str:
    """Why a file can't be read, nothing when it can; it is not opened, as it may hold a secret."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        return error.strerror or str(error)
    if stat.S_ISDIR(mode):
        return os.strerror(errno.EISDIR)
    return "" if os.access(path, os.R_OK) else os.strerror(errno.EACCES)

"""The limit on open files, as every connection is an open file."""

from __future__ import annotations

import logging

from holdfast import logs

OTHER_FILES = 128
"""Open files that are not connections: listeners, metrics requests, the interpreter's files."""


def allow_open_files(connections: int) -> None:
    """Raises the limit on open files for `connections`; logs if the system does not allow it."""
    try:
        import resource
    except ImportError:  # Windows has no such limit.
        return
    needed = connections + OTHER_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return
    allowed = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
    except (ValueError, OSError):  # The system has a lower limit that it does not report.
        allowed = soft
    if allowed < needed:
        logs.write(logging.WARNING, "too_few_open_files", needed=needed, allowed=allowed)

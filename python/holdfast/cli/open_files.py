"""Open files: each connection is one, and the system says how many a process may have."""

from __future__ import annotations

import logging

from holdfast import logs

OTHER_FILES = 128
"""Open files beside the connections: listeners, readers of metrics, the interpreter's own."""


def allow_open_files(connections: int) -> None:
    """Lets this process hold so many connections; logs where the system does not let it."""
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
    except (ValueError, OSError):  # The system has another limit, which it does not tell.
        allowed = soft
    if allowed < needed:
        logs.write(logging.WARNING, "too_few_open_files", needed=needed, allowed=allowed)

"""The processor time of threads."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def cpu_time(number: int | None) -> float | None:
    """Returns the processor time of a thread of this process; `None` where it is not known."""
    if sys.platform != "linux":
        return None
    try:
        stat = Path(f"/proc/self/task/{number}/stat").read_text()
    except OSError:  # The thread has ended.
        return None
    # Behind the name in parentheses: the state, and 10 fields before utime and stime.
    user, system = stat.rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")

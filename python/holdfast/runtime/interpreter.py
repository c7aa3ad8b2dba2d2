"""What a process that serves asks of its Python interpreter."""

from __future__ import annotations

import gc
import sys

SWITCH_INTERVAL_S = 0.05
"""How long a thread may hold the interpreter lock while others wait for it. Each switch wakes a
thread, which the scheduler may run before the threads that serve Modbus."""


COLLECT_AFTER = 10_000
"""New objects after which the interpreter looks for garbage: by default 700, which a few requests
have."""


def yield_interpreter() -> None:
    """Makes this process switch threads of the interpreter less often, in favor of native ones."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)


def spare_what_stays() -> None:
    """Takes all present objects out of the garbage collections that follow, and has fewer of these.

    Modules and configuration stay to the end. A collection that looks at all of them takes 20 to
    30 ms, in which nothing in Python is answered.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(COLLECT_AFTER)

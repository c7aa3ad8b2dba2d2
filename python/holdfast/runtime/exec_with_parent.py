"""Becomes another program: `exec_with_parent.py DESCRIPTOR PARENT PROGRAM ARGUMENTS…`.

Run by an interpreter of its own, before the program takes its place. The process id is written to
the file DESCRIPTOR, whose lock the program keeps; -1 is no file. On Linux the program ends with the
thread that has started it. A function that runs between fork and exec could arrange that too, but
not in a process with threads.
"""

from __future__ import annotations

import os
import signal
import sys

DIE_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux."""


def main() -> None:
    """Never returns."""
    if sys.platform == "win32":
        raise AssertionError("only called on other systems")
    descriptor, parent = map(int, sys.argv[1:3])
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(DIE_WITH_PARENT, signal.SIGTERM)
    if os.getppid() != parent:
        sys.exit("the process that wanted it has ended")
    if descriptor >= 0:
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, b"%d\n" % os.getpid(), 0)
    os.execv(sys.argv[3], sys.argv[3:])


if __name__ == "__main__":
    main()

"""The lock of a file: one process at a time writes an audit log, an output or a NATS store."""

from __future__ import annotations

import os
import sys

POSITION = 2**31 - 2
"""The byte that is locked on Windows. A locked byte can't be read by others: it has to be one that
lines hardly ever reach, and `msvcrt` can't lock any behind it."""

if sys.platform == "win32":
    import msvcrt

    def lock(descriptor: int) -> bool:
        """Locks a file until it is closed. Returns whether that was possible."""
        before = os.lseek(descriptor, 0, os.SEEK_CUR)
        os.lseek(descriptor, POSITION, os.SEEK_SET)
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except PermissionError:
            return False
        except OSError:
            return True  # The file system has no locks.
        finally:
            os.lseek(descriptor, before, os.SEEK_SET)
        return True

else:
    import fcntl

    def lock(descriptor: int) -> bool:
        """Locks a file until it is closed. Returns whether that was possible."""
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            return True  # The file system has no locks.
        return True

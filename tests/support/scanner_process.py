"""A scanner as a process, also with settings that are no options of `holdfast scan`."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.scanner.settings import Settings

SCAN = """
import asyncio, pickle, sys
from holdfast.events import log_lines
from holdfast.scanner.fleet.agreement import FleetRefused
from holdfast.scanner.service import Scanner

async def scan():
    await Scanner(pickle.loads(bytes.fromhex(sys.argv[1]))).run()

log_lines.configure("info", "text")
try:
    asyncio.run(scan())
except FleetRefused as refused:
    sys.exit(str(refused))
"""


def begin_scanner(settings: Settings, log: Path) -> subprocess.Popen[bytes]:
    """Starts a scanner. Its log is appended to a file."""
    command = [sys.executable, "-c", SCAN, pickle.dumps(settings).hex()]
    with log.open("ab") as file:
        return subprocess.Popen(command, stdout=file, stderr=file)


def freeze(process: subprocess.Popen[bytes]) -> None:
    """Stops a process, until SIGCONT."""
    process.send_signal(signal.SIGSTOP)
    # Its threads run on until the system has stopped them all.
    os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)

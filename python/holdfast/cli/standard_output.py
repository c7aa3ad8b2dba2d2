"""Standard output that can't take what a command prints: another encoding, a full disk, a reader
that is gone.
"""

from __future__ import annotations

import errno
import io
import os
import sys

import click

_UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EPIPE)


def prepare() -> None:
    """Lets text from outside pass that the encoding of standard output does not have."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def is_unwritable(error: OSError) -> bool:
    """Whether this error is that of standard output, not of a file."""
    return error.errno in _UNWRITABLE and error.filename is None


def leave() -> None:
    """Drops what is not printed: Python would fail again at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)


def announce(text: str) -> None:
    """Prints what a service says at its start. A service runs, whoever reads that."""
    try:
        click.echo(text)
    except OSError as error:
        if not is_unwritable(error):
            raise
        leave()

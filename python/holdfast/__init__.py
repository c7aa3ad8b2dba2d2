"""Holdfast: a Modbus memory that many writers fill and many readers read.

The public names of the library. Everything else is the command line's (`holdfast.cli`), the
configuration's (`holdfast.config`) or native (`holdfast._core`, which these names come from).
"""

from __future__ import annotations

from holdfast._core import Memory, OutOfRange, Rule, __version__
from holdfast.server import Server

__all__ = ["Memory", "OutOfRange", "Rule", "Server", "__version__"]

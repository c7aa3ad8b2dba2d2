"""Writes the operations of `SyncClient` from those of `Client`: the same text without asyncio."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

CLIENT = Path(__file__).parents[1] / "python/holdfast/client"
SOURCE = CLIENT / "async_operations.py"
TARGET = CLIENT / "sync_operations.py"

REPLACEMENTS = (
    (
        r"`sync_operations.py` is made from this file: change this one, then run `make format`.",
        "Made from `async_operations.py`: change that one, then run `make format`.",
    ),
    (r"import Awaitable, ", "import "),
    (r"from \S+ import AsyncTransport\b", "from holdfast.client.fork import BlockingConnection"),
    (r"\bAsyncTransport\b", "BlockingConnection"),
    (r"\basync def ", "def "),
    (r"\bawait ", ""),
    (r"\bAwaitable\[(\w+)\]", r"\1"),
    (r"\bAsyncOperations\b", "SyncOperations"),
    (r"\bcarry_out_async\b", "carry_out"),
)


def blocking_operations() -> str:
    """The text of the file with the blocking operations."""
    text = SOURCE.read_text(encoding="utf-8")
    for pattern, replacement in REPLACEMENTS:
        text = re.sub(pattern, replacement, text)
    command = [sys.executable, "-m", "ruff", "format", "--stdin-filename", str(TARGET), "-"]
    return subprocess.run(
        command, input=text, capture_output=True, check=True, encoding="utf-8"
    ).stdout


if __name__ == "__main__":
    TARGET.write_text(blocking_operations(), encoding="utf-8")

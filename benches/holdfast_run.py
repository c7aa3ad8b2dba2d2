"""Runs `holdfast run` in the event loop of the first argument, with the file in the second."""

from __future__ import annotations

import sys

import event_loops

loop, file = sys.argv[1:]
event_loops.use(loop)

from holdfast.cli import main  # noqa: E402

main(["run", file], prog_name="holdfast")

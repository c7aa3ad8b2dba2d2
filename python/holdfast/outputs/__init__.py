"""Outputs: the values of tags to brokers, databases and files.

Each output has a thread and a buffer of its own: one that stalls delays neither a poll nor another
output. An output is a `Receiver`; `OutputSender` does the rest: what is sent, again after an
outage, and in which order.
"""

from __future__ import annotations

from holdfast.outputs.buffer import Buffer
from holdfast.outputs.changes import Changes
from holdfast.outputs.sender import OutputSender, Receiver, Refused, log_unsent

__all__ = ["Buffer", "Changes", "OutputSender", "Receiver", "Refused", "log_unsent"]

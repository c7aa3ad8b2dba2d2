"""Outputs: the values of tags to brokers, databases and files.

Each output has a thread and a buffer of its own: one that stalls delays neither a poll nor another
output. An output is a `Receiver`; `OutputSender` does the rest: what is sent, again after an
outage, and in which order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.runtime.lazy_names import imported_on_use

if TYPE_CHECKING:
    from holdfast.outputs.buffer import Buffer
    from holdfast.outputs.changes import Changes
    from holdfast.outputs.sender import OutputSender, Receiver, Refused, log_unsent
else:
    _SENDER = ("OutputSender", "Receiver", "Refused", "log_unsent")
    __getattr__ = imported_on_use(
        __name__,
        {
            "Buffer": "holdfast.outputs.buffer",
            "Changes": "holdfast.outputs.changes",
            **dict.fromkeys(_SENDER, "holdfast.outputs.sender"),
        },
    )

__all__ = ["Buffer", "Changes", "OutputSender", "Receiver", "Refused", "log_unsent"]

"""Polling: the values of tags, from the native poller.

`Poller` is the library's. The appliance has a native poller of its own and uses the same `Reader`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.runtime.lazy_names import imported_on_use

if TYPE_CHECKING:
    from holdfast.polling.poller import Poller, WriteFailed
    from holdfast.polling.readings import Batch, DevicePoll, Reading
else:
    _READINGS = ("Batch", "DevicePoll", "Reading")
    __getattr__ = imported_on_use(
        __name__,
        {
            **dict.fromkeys(("Poller", "WriteFailed"), "holdfast.polling.poller"),
            **dict.fromkeys(_READINGS, "holdfast.polling.readings"),
            "faults": "holdfast.polling.faults",
        },
    )

__all__ = ["Batch", "DevicePoll", "Poller", "Reading", "WriteFailed"]

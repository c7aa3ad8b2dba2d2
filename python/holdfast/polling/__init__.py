"""Polling: the values of tags, from the native poller.

`Poller` is the library's. The appliance has a native poller of its own and uses the same `Reader`.
"""

from __future__ import annotations

from holdfast.polling.poller import Poller, WriteFailed
from holdfast.polling.readings import Batch, DevicePoll, Reading

__all__ = ["Batch", "DevicePoll", "Poller", "Reading", "WriteFailed"]

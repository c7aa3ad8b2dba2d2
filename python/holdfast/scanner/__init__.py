"""The scanner: polls Modbus devices for whoever subscribes over NATS, and publishes what they say.

It has no configuration of devices: a device is connected to when somebody wants tags of it, and let
go with the last who does. Nothing is kept over a restart.

The rooms, from the outside in: `service` wires all; `broker`, `receiving`, `outbox` and `wire` talk
to NATS, `polling` and `commands` to devices; `registry` knows who wants what; `groups`, `decoding`
and `publishing` make messages of what was read. The last four do no I/O.
"""

from __future__ import annotations

from holdfast.scanner.broker import Servers
from holdfast.scanner.limits import ScannerLimits
from holdfast.scanner.service import Scanner, Settings

__all__ = ["Scanner", "ScannerLimits", "Servers", "Settings"]

"""The scanner: polls Modbus devices for subscribers on NATS, and publishes the values.

It has no configuration of devices. It connects to a device at the first subscription to its tags,
and disconnects after the last one ends. It keeps subscriptions over a restart in JetStream only.

The modules: `service` connects the parts. `broker`, `receiving`, `outbox` and `wire` communicate
with NATS, `polling` and `commands` with devices. `registry` holds the subscriptions. `groups`,
`decoding` and `publishing` convert values to messages. `registry` and these three do no I/O.
`adjusting` reads inexact requests; `tentacle` has the rules of the first generation of programs.
`keeping` and `kept` store subscriptions, and restore them. `expiring` ends those that are not
renewed. `write_access` says at the start what may be written.

`fleet` shares devices with other scanners.

For the programs of tentacle-next: `watching` follows buckets, `configured` carries out the
subscriptions in one, `enabling` pauses polling, `tentacle_next` reads messages of another form.
"""

from __future__ import annotations

from holdfast.scanner.broker import Ping, Servers
from holdfast.scanner.fleet.terms import FleetRefused, FleetSettings
from holdfast.scanner.limits import ScannerLimits
from holdfast.scanner.rules import Defaults
from holdfast.scanner.service import Scanner, Settings

__all__ = [
    "Defaults",
    "FleetRefused",
    "FleetSettings",
    "Ping",
    "Scanner",
    "ScannerLimits",
    "Servers",
    "Settings",
]

"""The network: addresses, allow lists, names, certificates and TLS files, an HTTP server, MQTT and
NATS clients, and a NATS server of one's own.

`addresses` defines addresses and networks, `allow_list` decides which of them a service may connect
to, `resolver` finds the addresses of a name. All services use these; they differ in the default
allow list and in the wording of a refusal.

This package must never read a configuration.
"""

from __future__ import annotations

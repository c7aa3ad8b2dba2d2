"""Addresses, allow lists and name resolution for outgoing connections, and their TLS settings.

`addresses` defines addresses and networks, `allow_list` decides which of them a service may connect
to, `resolver` finds the addresses of a name. All services use these; they differ in the default
allow list and in the wording of a refusal.

This package must never read a configuration, and never connect.
"""

from __future__ import annotations

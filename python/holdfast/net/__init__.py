"""Addresses, allow lists and name resolution: whom this process may connect to, and where that is.

`addresses` says what an address is, `allow_list` which of them may be connected to, `resolver`
which a name has. Every service judges by these; what differs is what a service allows by default,
and how it words a refusal.

This room must never read a configuration, and never connect.
"""

from __future__ import annotations

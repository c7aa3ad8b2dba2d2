"""Who has subscribed to what: devices, tags, rates, limits and health. Does no I/O."""

from __future__ import annotations

from holdfast.scanner.subscriptions.groups import Group, grouped
from holdfast.scanner.subscriptions.key import SubscriptionKey
from holdfast.scanner.subscriptions.registry import Registry
from holdfast.scanner.subscriptions.tag import AREA_OF_CODE, Tag
from holdfast.scanner.subscriptions.ttl import SubscriptionTtls

__all__ = [
    "AREA_OF_CODE",
    "Group",
    "Registry",
    "SubscriptionKey",
    "SubscriptionTtls",
    "Tag",
    "grouped",
]

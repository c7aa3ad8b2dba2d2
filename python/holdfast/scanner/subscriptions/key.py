"""What identifies a subscription. Does no I/O."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SubscriptionKey:
    """A subscription: a subscriber of a device. Also stands for what is stored of it."""

    device: str
    subscriber: str | None = None
    """`None` for the status of the device, which is stored beside its subscriptions."""

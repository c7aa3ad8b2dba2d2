"""What identifies a subscription."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holdfast.scanner.messages.types import SubscribeRequest, UnsubscribeRequest


@dataclass(frozen=True)
class SubscriptionKey:
    """A subscription: a subscriber of a device. Also stands for what is stored of it."""

    device: str
    subscriber: str | None = None
    """`None` for the status of the device, which is stored beside its subscriptions."""

    @staticmethod
    def of(request: SubscribeRequest | UnsubscribeRequest) -> SubscriptionKey:
        """Returns the subscription of a request."""
        return SubscriptionKey(request.device_id, request.subscriber_id)

    @property
    def fields(self) -> dict[str, str | None]:
        """What log lines have of the subscription."""
        return {"device": self.device, "subscriber": self.subscriber}

"""What identifies a subscription."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from holdfast.scanner.messages.types import UnsubscribeRequest

if TYPE_CHECKING:
    from holdfast.scanner.messages.types import SubscriptionRequest


@dataclass(frozen=True)
class SubscriptionKey:
    """A subscription: a subscriber of a device. Also stands for what is stored of it."""

    device: str
    subscriber: str | None = None
    """`None` for the status of the device, which is stored beside its subscriptions."""

    @staticmethod
    def of(request: SubscriptionRequest) -> SubscriptionKey:
        """Returns the subscription of a request."""
        return SubscriptionKey(request.device_id, request.subscriber_id)

    def removal(self, ids: list[str] | None = None) -> UnsubscribeRequest:
        """Returns the request that removes tags; without `ids`, all of them."""
        assert self.subscriber is not None
        return UnsubscribeRequest(self.device, self.subscriber, ids)

    @property
    def fields(self) -> dict[str, str | None]:
        """What log lines have of the subscription."""
        return {"device": self.device, "subscriber": self.subscriber}

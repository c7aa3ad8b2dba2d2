"""The parts of a running scanner that tests look into. No other test names them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.scanner.fleet.placement import FleetPlacement
from holdfast.scanner.jetstream.restore import StoredSubscriptions

if TYPE_CHECKING:
    from holdfast.net.nats.connection import NatsConnection
    from holdfast.net.nats.tolerant_client import SafeClient
    from holdfast.scanner.fleet.member import FleetMember
    from holdfast.scanner.jetstream.store import EntryStore
    from holdfast.scanner.polling.allowed_devices import AllowedDevices
    from holdfast.scanner.polling.poller import Polling
    from holdfast.scanner.presence import Presence
    from holdfast.scanner.service import Scanner
    from holdfast.scanner.subscriptions.registry import Registry
    from holdfast.scanner.subscriptions.ttl import SubscriptionTtls


def broker_of(scanner: Scanner) -> NatsConnection:
    """Returns its connection to NATS."""
    return scanner._broker


def client_of(scanner: Scanner) -> SafeClient:
    """Returns its client, which is connected."""
    client = scanner._broker.client
    assert client is not None, "it is connected"
    return client


def registry_of(scanner: Scanner) -> Registry:
    """Returns its subscriptions."""
    return scanner._registry


def ttls_of(scanner: Scanner) -> SubscriptionTtls:
    """Returns when its subscriptions end."""
    return scanner._devices.ttls


def polling_of(scanner: Scanner) -> Polling:
    """Returns what polls its devices."""
    return scanner._polling


def presence_of(scanner: Scanner) -> Presence:
    """Returns what announces it."""
    return scanner._presence


def allowed_of(scanner: Scanner) -> AllowedDevices:
    """Returns the devices that it may use."""
    return scanner._allowed


def store_of(scanner: Scanner) -> EntryStore:
    """Returns what stores its subscriptions."""
    assert isinstance(scanner._placement, StoredSubscriptions), "it stores them"
    return scanner._placement._store


def member_of(scanner: Scanner) -> FleetMember:
    """Returns it as a node of its fleet."""
    assert isinstance(scanner._placement, FleetPlacement), "it is a node"
    return scanner._placement

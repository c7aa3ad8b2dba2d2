"""The MQTT adapter: stays connected to one broker and reconnects after any failure."""

from __future__ import annotations

import contextlib
import logging
import time
from functools import partial
from typing import TYPE_CHECKING

from holdfast.adapters.mqtt.connection import BrokerConnection
from holdfast.adapters.mqtt.inbox import Filters, Inbox
from holdfast.adapters.mqtt.plain_values import PlainValue
from holdfast.adapters.mqtt.response_topics import Answers
from holdfast.adapters.mqtt.sessions import session_of
from holdfast.adapters.mqtt.subscriptions import Subscriptions
from holdfast.events import log_lines
from holdfast.net.addresses import joined
from holdfast.net.mqtt.client import ClientId
from holdfast.net.mqtt.dial import CONNACK_TIMEOUT_S
from holdfast.net.mqtt.waiter import Ended, Waiter
from holdfast.net.secure_channel import failure_text
from holdfast.runtime.backoff import Backoff
from holdfast.runtime.text import quote

if TYPE_CHECKING:
    from collections.abc import Mapping, Set

    from paho.mqtt.client import Client, DisconnectFlags
    from paho.mqtt.properties import Properties
    from paho.mqtt.reasoncodes import ReasonCode

    from holdfast.config.models.root import MappedTag
    from holdfast.config.models.services import MqttConfig
    from holdfast.ingest import MemoryAccess
    from holdfast.runtime.stop import Stop

ENDED = "the broker ended the connection"
CLOSED = "the broker closed the connection"
LOST = "the connection was lost"
_MAY_FOLLOW_A_REPLY = (CLOSED, LOST, f"{ENDED}: Not authorized")
"""Ends that a reply on a topic which the broker forbids can have."""

LOG_INTERVAL_S = 600.0
"""Seconds before a failure to connect with the same reason is logged again."""

_CHECK_INTERVAL_S = 1.0
"""Seconds between checks of the keep-alive."""

FIRST_PAUSE_S = 1.0
MAX_PAUSE_S = 10.0
"""Seconds between attempts to connect. Each failure doubles the pause, up to the maximum."""

RESET_BACKOFF_AFTER_S = 10.0
"""After a connection of at least this many seconds, the pauses start from the first again."""


class Mqtt:
    """Receives messages from a broker and passes them to the memory access."""

    def __init__(
        self,
        settings: MqttConfig,
        memory_access: MemoryAccess,
        mapped: Mapping[str, MappedTag] | None = None,
        restored: Set[str] = frozenset(),
        *,
        first_pause: float = FIRST_PAUSE_S,
        max_pause: float = MAX_PAUSE_S,
    ) -> None:
        """`mapped` are the tags of topics with plain values, `restored` the memories that had their
        contents before the process began. For the pauses, see `Backoff`.
        """
        self._settings = settings
        self._pauses = first_pause, max_pause
        self._broker = joined(settings.host, settings.port)
        filters = Filters(settings.subscriptions)
        values = {topic: PlainValue(topic, each) for topic, each in (mapped or {}).items()}
        self._inbox = Inbox(memory_access, filters, values, self._broker)
        self._answers = Answers(filters, values)
        session = session_of(self._broker, settings.client_id)
        self._subscriptions = Subscriptions(settings, mapped or {}, session.known, restored)
        self._unreleased = session.unreleased
        self._client_id = ClientId(settings.client_id)
        self._failures = _Failures(self._broker)
        self._connected_at: float | None = None
        self._connects = 0
        self._ending: str | None = None
        self._last_error: str | None = None

    def run(self, stop: Stop) -> None:
        """Stays connected until `stop` is set; reconnects when the connection ends."""
        backoff = Backoff(*self._pauses, jitter=True, proven_s=RESET_BACKOFF_AFTER_S)
        limit = log_lines.own_limit(self._inbox.bad_values)
        with limit, Waiter(stop) as waiter, contextlib.suppress(Ended):
            while not stop.wait(backoff.failed(self._connection(waiter))):
                pass

    def status(self) -> dict[str, object]:
        """Returns the state of the connection, the broker, and the granted subscriptions."""
        return {
            "connected": self._connected_at is not None,
            "broker": self._broker,
            "version": self._settings.version,
            "topics": self._subscriptions.status(),
            "last_error": self._last_error,
            "received": self._inbox.received,
            "reconnects": max(0, self._connects - 1),
            "answers": self._answers.sent,
            "answers_dropped": self._answers.dropped,
        }

    def _connection(self, waiter: Waiter) -> float:
        """Runs one connection to its end. Returns the seconds that it was connected."""
        self._ending = None
        link: BrokerConnection | None = None
        try:
            link = self._link(waiter)
            link.open()
            self._serve(link, waiter)
        except Ended:
            self._ending = "stopped"
            if link is not None:
                link.disconnect()
            raise
        except (OSError, ValueError) as error:
            self._ending = failure_text(error)
        except Exception as error:  # Nothing that a broker sends may end the adapter.
            log_lines.problem("mqtt_failed", broker=self._broker)
            self._ending = type(error).__name__
        finally:
            if link is not None:
                link.close()
            held = self._ended(link)
        return held

    def _link(self, waiter: Waiter) -> BrokerConnection:
        link = BrokerConnection(
            self._settings, waiter, self._unreleased, self._inbox, self._answers.send
        )
        link.on_accepted = partial(self._accepted, link)
        link.on_subscribe = self._on_subscribe
        link.on_disconnect = self._on_disconnect
        return link

    def _serve(self, link: BrokerConnection, waiter: Waiter) -> None:
        """Reads and writes until the connection ends."""
        welcome = time.monotonic() + CONNACK_TIMEOUT_S
        tick = min(_CHECK_INTERVAL_S, self._settings.keep_alive / 2)
        while link.is_open:
            if self._connected_at is None and time.monotonic() > welcome:
                raise TimeoutError(f"the broker did not answer within {CONNACK_TIMEOUT_S:g} s")
            pending = link.pending
            readable, writable = waiter.wait(
                link.connection.connection,
                read=link.may_read,
                write=link.connection.unsent > 0,
                seconds=0.0 if pending else tick,
            )
            if writable:
                link.connection.flush()
            if readable or pending:
                link.read_more()
            link.loop_misc()
        self._ending = link.end_reason or self._ending

    def _ended(self, link: BrokerConnection | None) -> float:
        """Logs the end of a connection or attempt. Returns the seconds that it was connected."""
        began, self._connected_at = self._connected_at, None
        reason = self._ending or CLOSED
        self._subscriptions.ended()
        if reason != "stopped":
            if began is not None and link is not None:
                topic = link.topic_answered_just_now if reason in _MAY_FOLLOW_A_REPLY else None
                reason = self._client_id.explained(reason, link)
                if topic is not None:
                    reason += f", soon after a reply to {quote(topic)}"
            self._last_error = reason
        if began is not None:
            level = logging.INFO if reason == "stopped" else logging.WARNING
            log_lines.write(level, "mqtt_disconnected", broker=self._broker, reason=reason)
            return time.monotonic() - began
        if reason != "stopped":
            self._failures.tell(reason)
        return 0.0

    def _accepted(self, link: BrokerConnection, is_resumed: bool) -> None:
        self._failures.forget()
        if not is_resumed:
            self._unreleased.clear()
        log_lines.write(
            logging.INFO,
            "mqtt_connected",
            broker=self._broker,
            version=self._settings.version,
            session="resumed" if is_resumed else "new",
        )
        self._subscriptions.begin(link, is_resumed=is_resumed)
        self._connects += 1
        self._connected_at = time.monotonic()

    def _on_subscribe(
        self,
        _link: Client,
        _data: object,
        identifier: int,
        reasons: list[ReasonCode],
        _properties: Properties | None,
    ) -> None:
        refused = self._subscriptions.answered(identifier, reasons)
        if refused is None:
            return
        reason = str(reasons[0])
        self._last_error = f"subscription {refused} refused: {reason}"
        log_lines.write(
            logging.ERROR,
            "mqtt_subscription_refused",
            broker=self._broker,
            topic=refused,
            reason=reason,
        )

    def _on_disconnect(
        self,
        _link: Client,
        _data: object,
        flags: DisconnectFlags,
        reason: ReasonCode,
        _properties: Properties | None,
    ) -> None:
        if self._ending is not None:
            return
        if flags.is_disconnect_packet_from_server:
            self._ending = f"{ENDED}: {reason}"
        elif reason.getName() == "Unspecified error":
            self._ending = LOST
        else:
            self._ending = str(reason)


class _Failures:
    """Logs failed attempts, with a limit on repeats of the same reason."""

    def __init__(self, broker: str) -> None:
        self._broker = broker
        self._reason: str | None = None
        self._logged = 0.0
        self._attempts = 0

    def tell(self, reason: str) -> None:
        """Records a failed attempt."""
        self._attempts += 1
        now = time.monotonic()
        if reason == self._reason and now - self._logged < LOG_INTERVAL_S:
            return
        self._reason, self._logged = reason, now
        log_lines.write(
            logging.WARNING,
            "mqtt_connect_failed",
            broker=self._broker,
            reason=reason,
            attempts=self._attempts,
        )

    def forget(self) -> None:
        """Records a successful attempt."""
        self._reason, self._attempts = None, 0

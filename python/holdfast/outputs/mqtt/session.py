"""A connection to a broker with a thread of its own, from connecting to its end."""

from __future__ import annotations

import contextlib
import ssl
import threading
import time
from enum import Enum
from typing import TYPE_CHECKING

from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from holdfast.events import log_lines
from holdfast.net.mqtt.dial import CONNACK_TIMEOUT_S
from holdfast.net.mqtt.waiter import Ended, Waiter
from holdfast.net.secure_channel import failure_text
from holdfast.outputs import sender
from holdfast.outputs.mqtt.connection import Connection
from holdfast.outputs.mqtt.delivery import Delivery, Message, unpacked_topic
from holdfast.runtime.standstill import MAX_LOOK_INTERVAL_S, Standstill
from holdfast.runtime.stop import Stop

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from paho.mqtt.client import Client, DisconnectFlags
    from paho.mqtt.properties import Properties

    from holdfast.config.models.services import BrokerConfig
    from holdfast.net.mqtt.client import ClientId
    from holdfast.net.mqtt.packets import Publish

CONFIRM_TIMEOUT_S = 10.0
"""Seconds without any confirmation after which the connection is given up."""

STOP_CHECK_INTERVAL_S = 0.2
"""Seconds of one wait, between which a stop is noticed."""

STOP_TIMEOUT_S = 1.0
"""Seconds for what is published at the end."""


class Ending(Enum):
    """How a connection is ended by this side."""

    DISCONNECT = "with DISCONNECT"
    WITH_WILL = "with DISCONNECT, and the broker publishes the will"
    CUT = "without DISCONNECT, so that the broker publishes the will"


class Session:
    """A connection. Raises `OSError` if it can't be opened. Methods are thread-safe."""

    def __init__(
        self,
        settings: BrokerConfig,
        client_id: ClientId,
        will: Message | None,
        on_command: Callable[[Publish], None],
        on_refused: Callable[[Message, str], None],
        stop: Stop,
        *,
        qos: int,
        will_qos: int | None = None,
        takes_commands: bool,
        confirms_by_ping: bool = False,
    ) -> None:
        """`qos` is of all messages, and of the will unless it has its own. For `on_refused` and
        `confirms_by_ping`, see `Connection`.

        With `takes_commands`, messages are commands. If this process stood still, the connection
        ends, and the broker drops the commands that waited: they are too late.
        """
        self._standstill = Standstill("output") if takes_commands else None
        self._on_command, self._on_refused = on_command, on_refused
        self._settings, self._qos, self._confirms_by_ping = settings, qos, confirms_by_ping
        self._will_qos = qos if will_qos is None else will_qos
        self._ending = Ending.DISCONNECT
        self._stop, self._end = stop, Stop()
        self._lock = threading.Lock()
        self._news = threading.Condition(self._lock)
        self._new: list[Delivery] = []
        self._topics: list[tuple[Sequence[str], bool]] = []
        self._end_reason: str | None = None
        self._is_over = False
        self._client_id = client_id
        self._waiter = Waiter(self._end)
        try:
            self._connection = self._opened(client_id.text, will)
        except BaseException:
            self._waiter.close()
            raise
        self._thread = threading.Thread(
            target=self._serve, name=f"{threading.current_thread().name}-link", daemon=True
        )
        self._thread.start()

    @property
    def error(self) -> str | None:
        """Why the connection is over; `None` if it is not."""
        return self._end_reason if self._is_over else None

    def publish(self, messages: Sequence[Message]) -> Delivery:
        """Publishes messages after those before."""
        delivery = Delivery(messages)
        with self._lock:
            self._new.append(delivery)
        self._waiter.wake()
        return delivery

    def subscribe(self, topics: Sequence[str], *, retained: bool) -> None:
        """Subscribes to topics."""
        with self._lock:
            self._topics.append((topics, retained))
        self._waiter.wake()

    def wait(self, delivery: Delivery) -> None:
        """Waits until the broker has confirmed all messages. Raises `OSError`.

        After a stop, it waits only a short time, even if the broker goes on to confirm messages:
        what is left must be stored before the output is given up.
        """
        confirmed, since = delivery.confirmed, time.monotonic()
        with self._news:
            while not delivery.is_done:
                if self._is_over:
                    raise ConnectionError(self.error)
                self._news.wait(STOP_CHECK_INTERVAL_S)
                now = time.monotonic()
                if delivery.confirmed != confirmed:
                    confirmed, since = delivery.confirmed, now
                limit = STOP_TIMEOUT_S if self._stop.is_set() else CONFIRM_TIMEOUT_S
                if now > min(since + limit, self._stop.at + sender.STOP_TIMEOUT_S):
                    raise TimeoutError("the broker did not confirm all messages in time")

    def close(self, last: Sequence[Message] = (), *, with_will: bool = False) -> None:
        """Publishes the last messages, and ends the connection.

        `with_will`: the broker publishes the will too. MQTT 3.1.1 has no way to ask for it. Without
        last messages, or if they were not confirmed, the connection is cut: the broker then
        publishes the will instead of them.
        """
        if with_will and self._settings.version == "5":
            self._ending = Ending.WITH_WILL
        elif not last:
            self._ending = Ending.CUT
        if last and not self._is_over:
            delivery = self.publish(last)
            with self._news:
                self._news.wait_for(lambda: delivery.is_done or self._is_over, STOP_TIMEOUT_S)
            if not delivery.is_done and self._ending is Ending.DISCONNECT:
                self._ending = Ending.CUT
        self._end.set()
        self._thread.join()

    def _opened(self, client_id: str, will: Message | None) -> Connection:
        """Connects, and waits for the broker's consent. A stop interrupts it."""
        with Waiter(self._stop) as waiter, contextlib.ExitStack() as undo:
            connection = Connection(
                self._settings,
                client_id,
                waiter,
                self._take,
                self._on_refused,
                qos=self._qos,
                takes_commands=self._standstill is not None,
                confirms_by_ping=self._confirms_by_ping,
            )
            undo.callback(connection.close)
            connection.on_disconnect = self._on_disconnect
            if will is not None:
                topic = unpacked_topic(will.topic)
                connection.will_set(topic, will.payload, self._will_qos, will.retain)
            try:
                connection.open()
                end = time.monotonic() + CONNACK_TIMEOUT_S
                while not connection.is_accepted and connection.is_open:
                    if time.monotonic() > end:
                        raise TimeoutError(
                            f"the broker did not answer within {CONNACK_TIMEOUT_S:g} s"
                        )
                    self._step(connection, waiter)
                if not connection.is_accepted:
                    reason = self._end_reason or connection.end_reason
                    raise ConnectionError(reason or "the broker closed the connection")
            except Ended:
                raise ConnectionError("stopped") from None
            except ssl.SSLError as error:  # That of a certificate is also a ValueError.
                raise ConnectionError(failure_text(error)) from error
            except ValueError as error:
                raise ConnectionError(f"the broker sent a malformed packet: {error}") from error
            undo.pop_all()
        return connection

    def _serve(self) -> None:
        """Serves the connection to its end."""
        connection = self._connection
        try:
            while connection.is_open:
                with self._lock:
                    new, self._new = self._new, []
                    topics, self._topics = self._topics, []
                for some, retained in topics:
                    connection.ask_for(some, retained=retained)
                for delivery in new:
                    connection.publish_all(delivery)
                if connection.send_more():
                    self._notify()
                self._step(connection, self._waiter)
        except Ended:
            if self._ending is Ending.WITH_WILL:
                packet, reason = PacketTypes.DISCONNECT, "Disconnect with will message"
                connection.disconnect(ReasonCode(packet, reason))
            elif self._ending is Ending.DISCONNECT:
                connection.disconnect()
        except (OSError, ValueError) as error:
            self._end_reason = failure_text(error)
        except Exception as error:  # Nothing that a broker sends may end the output.
            log_lines.problem("mqtt_failed", broker=self._settings.url)
            self._end_reason = type(error).__name__
        finally:
            connection.close()
            reason = connection.end_reason or self._end_reason or "the connection was lost"
            self._end_reason = self._client_id.explained(reason, connection)
            self._waiter.close()
            with self._news:
                self._is_over = True
                self._news.notify_all()

    def _step(self, connection: Connection, waiter: Waiter) -> None:
        """Waits once, then reads and writes."""
        open_socket = connection.connection
        pending = open_socket.error is not None
        readable, writable = waiter.wait(
            open_socket.connection,
            read=True,
            write=open_socket.unsent > 0,
            seconds=0.0 if pending else min(MAX_LOOK_INTERVAL_S, self._settings.keep_alive / 2),
        )
        self._check()
        if writable:
            open_socket.flush()
        if (readable or pending) and connection.read_more():
            self._notify()
        connection.ping_if_due()

    def _take(self, message: Publish) -> None:
        self._check()
        self._on_command(message)

    def _check(self) -> None:
        """Raises `ConnectionError` after a standstill."""
        if self._standstill is not None:
            self._standstill.look()
            if self._standstill.lasted:
                seconds = self._standstill.lasted
                raise ConnectionError(f"this output stood still for {seconds:.0f} s")

    def _notify(self) -> None:
        with self._news:
            self._news.notify_all()

    def _on_disconnect(
        self,
        _connection: Client,
        _data: object,
        flags: DisconnectFlags,
        reason: ReasonCode,
        _properties: Properties | None,
    ) -> None:
        if self._end_reason is None and flags.is_disconnect_packet_from_server:
            self._end_reason = f"the broker ended the connection: {reason}"

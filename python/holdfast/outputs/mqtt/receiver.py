"""What outputs to brokers have in common: one session, which begins anew after a failure."""

from __future__ import annotations

import hashlib
import socket
from abc import abstractmethod
from typing import TYPE_CHECKING

from holdfast.events import log_lines
from holdfast.net.addresses import joined
from holdfast.net.mqtt.client import ClientId
from holdfast.outputs.mqtt.delivery import unpacked_topic
from holdfast.outputs.sender import Receiver

if TYPE_CHECKING:
    from holdfast.config.models.outputs import MqttOutputConfig, SparkplugConfig
    from holdfast.outputs.mqtt.delivery import Delivery, Message
    from holdfast.outputs.mqtt.session import Session
    from holdfast.runtime.stop import Stop


MAX_PORTABLE_ID = 23
"""Characters of a client id that each broker of MQTT 3.1.1 must take."""

DIGEST_LENGTH = 6


def default_client_id(name: str, own: str) -> str:
    """A client id that stays the same over restarts.

    Appliances of one machine may have outputs of the same name: `own` tells them apart. It does not
    make an id too long for a broker that takes no long ones.
    """
    plain = f"holdfast-{name}-{socket.gethostname()}"
    if not own:
        return plain
    digest = hashlib.sha256(f"{plain} {own}".encode()).hexdigest()[:DIGEST_LENGTH]
    room = MAX_PORTABLE_ID - len(digest) - 1 if len(plain) <= MAX_PORTABLE_ID else None
    return f"{plain[:room]}-{digest}"


class BrokerReceiver(Receiver):
    """A receiver with a session. Connects when it is asked to send, and after an idle second."""

    def __init__(
        self, name: str, settings: MqttOutputConfig | SparkplugConfig, own: str = ""
    ) -> None:
        """`own`: what only this output has at the broker, if that is configured."""
        self._name, self._version = name, settings.version
        self._client_id = ClientId(settings.client_id or default_client_id(name, own))
        self._broker = joined(settings.host, settings.port)
        self._stop: Stop | None = None
        self._session: Session | None = None
        self._revision = -1
        """The revision of the tags that were published."""
        self._connects = self._not_accepted = 0

    def use_stop(self, stop: Stop) -> None:
        """Takes the stop that ends all waiting. Called before all else."""
        self._stop = stop

    def status(self) -> dict[str, object]:
        """The broker and the connection."""
        return {
            "broker": self._broker,
            "client_id": self._client_id.text,
            "version": self._version,
            "reconnects": max(0, self._connects - 1),
            "not_accepted": self._not_accepted,
        }

    @abstractmethod
    def _open(self, stop: Stop) -> Session:
        """Opens a session. Raises `OSError`."""

    @abstractmethod
    def _greet(self, session: Session) -> None:
        """Begins a new session with what the broker must have or know first."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Ends the session, if there is one."""

    def _connected(self) -> Session:
        """The session; a new one if there is none. Raises `OSError`."""
        if self._session is not None and (error := self._session.error) is not None:
            self._disconnect()
            raise ConnectionError(error)
        if self._session is None:
            assert self._stop is not None, "use_stop comes first"
            self._session = self._open(self._stop)
            self._connects += 1
            self._greet(self._session)
        return self._session

    def _wait(self, session: Session, delivery: Delivery) -> None:
        """Waits until the broker must have all messages. Raises `OSError`."""
        try:
            session.wait(delivery)
        except OSError:
            self._disconnect()
            raise

    def _on_refused(self, message: Message, reason: str) -> None:
        """Reports any message, not only one of values. Called by the thread of the connection."""
        self._not_accepted += 1
        log_lines.refused(
            "output_not_accepted",
            kind=self._name,
            output=self._name,
            topic=unpacked_topic(message.topic),
            reason=reason,
        )

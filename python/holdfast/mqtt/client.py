"""One connection to a broker: paho's client, opened by `dial`.

Methods that begin with an underscore override methods of paho.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, LogLevel, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from holdfast.config import BrokerConfig


class BrokerClient(Client):
    """One connection, from dialing to its end. A reconnect creates a new object."""

    def __init__(
        self,
        settings: BrokerConfig,
        client_id: str,
        password: bytes | None,
        dial: Callable[[], socket.socket],
        *,
        session_expiry: int,
    ) -> None:
        """`session_expiry`: seconds that the broker keeps the session after the connection, as far
        as MQTT 3.1.1 can express it; 0 for a new session in each connection.
        """
        self._settings = settings
        self._five = settings.version == "5"
        self._expiry = session_expiry
        super().__init__(
            CallbackAPIVersion.VERSION2,
            client_id=client_id,
            clean_session=None if self._five else not session_expiry,
            protocol=MQTTProtocolVersion.MQTTv5 if self._five else MQTTProtocolVersion.MQTTv311,
            reconnect_on_failure=False,
        )
        self._dial = dial
        self.trouble: str | None = None
        """The last error that paho logged."""
        self.on_log = self._note
        self.username_pw_set(settings.username, password)  # type: ignore[arg-type]

    def open(self, **limits: int) -> None:
        """Dials and sends CONNECT with these properties. Raises the exceptions of `dial`."""
        settings = self._settings
        if not self._five:
            self.connect(settings.host, settings.port, settings.keep_alive)
            return
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.SessionExpiryInterval = self._expiry
        for name, limit in limits.items():
            setattr(properties, name, limit)
        self.connect(
            settings.host,
            settings.port,
            settings.keep_alive,
            clean_start=not self._expiry,
            properties=properties,
        )

    @property
    def unsent(self) -> int:
        """The number of unsent packets."""
        return len(self._out_packet)

    def close(self) -> None:
        """Closes the socket, if it is open."""
        self._sock_close()

    def _note(self, _client: Client, _data: object, level: int, text: str) -> None:
        if level == LogLevel.MQTT_LOG_ERR or "malformed" in text:
            self.trouble = text

    def _create_socket(self) -> Any:
        return self._dial()

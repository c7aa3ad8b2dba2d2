"""One connection to a broker: paho's client, with a socket that carries packets.

paho gets the packets that `pass_on` gives to it, and sends its own. All others are read from the
socket and put into it by the derived classes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, LogLevel, MQTTErrorCode, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from holdfast.net.mqtt.packets import head

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.net.mqtt.stream import BrokerSocket


class BrokerSettings(Protocol):
    """What a connection needs to know of a broker."""

    @property
    def host(self) -> str:
        """Its name or address."""

    @property
    def port(self) -> int:
        """Its TCP port."""

    @property
    def version(self) -> str:
        """The version of MQTT: "3.1.1" or "5"."""

    @property
    def username(self) -> str | None:
        """The name that it knows this client by."""

    @property
    def keep_alive(self) -> int:
        """The seconds after which it gives up a silent client."""


class BrokerClient(Client):
    """One connection, from dialing to its end. A reconnect creates a new object."""

    def __init__(
        self,
        settings: BrokerSettings,
        client_id: str,
        password: bytes | None,
        dial: Callable[[], BrokerSocket],
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
        self._connection: BrokerSocket | None = None
        self.trouble: str | None = None
        """Why the connection ends, or the last error that paho logged."""
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
    def connection(self) -> BrokerSocket:
        """The socket; `open` makes it."""
        assert self._connection is not None, "it was opened"
        return self._connection

    @property
    def is_open(self) -> bool:
        """Whether the connection has begun and has not ended."""
        return self._connection is not None and self._connection.is_open

    def pass_on(self, first: int, body: bytes | bytearray) -> MQTTErrorCode:
        """Passes a packet to paho, which closes the connection after an error."""
        self.connection.for_paho += head(first, len(body)) + body
        return self.notice()

    def notice(self) -> MQTTErrorCode:
        """Lets paho read, and send what its callbacks have published."""
        code = self.loop_read()
        if self.want_write() and self.is_open:
            self.loop_write()
        return code

    def end(self, reason: str) -> None:
        """Closes the connection without DISCONNECT, and notes why."""
        self.trouble = reason
        self.close()

    def close(self) -> None:
        """Closes the connection without DISCONNECT, if it is open."""
        if self._connection is not None:
            self._connection.close()

    def _note(self, _client: Client, _data: object, level: int, text: str) -> None:
        if level == LogLevel.MQTT_LOG_ERR or "malformed" in text:
            self.trouble = text

    def _create_socket(self) -> BrokerSocket:
        self._connection = self._dial()
        return self._connection

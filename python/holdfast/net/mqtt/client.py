"""One connection to a broker: paho's client, with a socket that carries packets.

paho gets the packets that `pass_on` gives to it, and sends its own. All others are read from the
socket and put into it by the derived classes.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Protocol

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, LogLevel, MQTTErrorCode, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from holdfast.net.mqtt import MAX_TEXT
from holdfast.net.mqtt.dial import dial
from holdfast.net.mqtt.packets import head
from holdfast.net.secret_file import read_bytes

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from paho.mqtt.client import ConnectFlags
    from paho.mqtt.reasoncodes import ReasonCode

    from holdfast.net.mqtt.broker_socket import BrokerSocket
    from holdfast.net.mqtt.waiter import Waiter
    from holdfast.net.tls import Tls


EARLY_CUT_S = 30.0
"""A connection that lasts less was cut early. Clients wait less before they connect again."""

MAX_EARLY_CUTS = 2
"""Early cuts in a row that a broker or a network may make, as when it is restarted."""


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
    def password_file(self) -> Path | None:
        """The file of the password."""

    @property
    def tls_files(self) -> Tls | None:
        """The files for TLS; `None` without TLS."""

    @property
    def keep_alive(self) -> int:
        """The seconds after which it gives up a silent client."""


class BrokerClient(Client):
    """One connection, from dialing to its end. A reconnect creates a new object."""

    def __init__(
        self,
        settings: BrokerSettings,
        client_id: str,
        waiter: Waiter,
        *,
        session_expiry: int,
    ) -> None:
        """`session_expiry`: seconds that the broker keeps the session after the connection, as far
        as MQTT 3.1.1 can express it; 0 for a new session in each connection.

        Raises `OSError` for an unusable file of the password.
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
        self._waiter = waiter
        self._connection: BrokerSocket | None = None
        self.end_reason: str | None = None
        """Why the connection ends, or the last error that paho logged."""
        self.is_accepted = False
        """Whether the broker has accepted the connection."""
        self._accepted_at = 0.0
        self.on_accepted: Callable[[bool], None] | None = None
        """Called then, with whether the broker resumes a session."""
        self.on_connect = self._connected
        self.on_log = self._note
        password = _password(settings.password_file)
        self.username_pw_set(settings.username, password)  # type: ignore[arg-type]

    def open(self) -> None:
        """Dials and sends CONNECT. Raises the exceptions of `dial`.

        Does not tell the broker the largest packet: Mosquitto 2.0 counts each message that it then
        does not send as one on its way, until it sends none.
        """
        settings, more = self._settings, dict[str, Any]()
        if self._five:
            properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
            properties.SessionExpiryInterval = self._expiry
            more = {"clean_start": not self._expiry, "properties": properties}
        self.connect(settings.host, settings.port, settings.keep_alive, **more)

    @property
    def connection(self) -> BrokerSocket:
        """The socket; `open` makes it."""
        assert self._connection is not None, "it was opened"
        return self._connection

    @property
    def is_open(self) -> bool:
        """Whether the connection has begun and has not ended."""
        return self._connection is not None and self._connection.is_open

    @property
    def was_cut_early(self) -> bool:
        """Whether the connection has been cut without a reason, soon after it was accepted."""
        if not self.is_accepted or self._connection is None or self._connection.error is None:
            return False
        return time.monotonic() < self._accepted_at + EARLY_CUT_S

    def accepted(self, properties: Properties | None) -> None:
        """Applies the limits from the broker's CONNACK."""
        raise NotImplementedError

    def pass_on(self, first: int, body: bytes | bytearray) -> MQTTErrorCode:
        """Passes a packet to paho, which closes the connection after an error."""
        self.connection.paho_buffer += head(first, len(body)) + body
        return self.notice()

    def notice(self) -> MQTTErrorCode:
        """Lets paho read, and send what its callbacks have published."""
        code = self.loop_read()
        if self.want_write() and self.is_open:
            self.loop_write()
        return code

    def end(self, reason: str) -> None:
        """Closes the connection without DISCONNECT, and notes why."""
        self.end_reason = reason
        self.close()

    def close(self) -> None:
        """Closes the connection without DISCONNECT, if it is open."""
        if self._connection is not None:
            self._connection.close()

    def _connected(
        self,
        _client: Client,
        _data: object,
        flags: ConnectFlags,
        reason: ReasonCode,
        properties: Properties | None,
    ) -> None:
        """Handles CONNACK."""
        if self.is_accepted:
            self.end("the broker sent a second CONNACK")
            return
        if reason.is_failure:
            self.end_reason = f"the broker refused the connection: {reason}"
            return
        self.on_log = None
        self.accepted(properties)
        self.is_accepted, self._accepted_at = True, time.monotonic()
        if self.on_accepted is not None:
            self.on_accepted(flags.session_present)

    def _note(self, _client: Client, _data: object, level: int, text: str) -> None:
        if level == LogLevel.MQTT_LOG_ERR or "malformed" in text:
            self.end_reason = text

    def _create_socket(self) -> BrokerSocket:
        settings = self._settings
        self._connection = dial(settings.host, settings.port, settings.tls_files, self._waiter)
        return self._connection


class ClientId:
    """A client id, which notices when another client seems to have it too.

    The broker then ends the connection of one when the other connects. Most brokers give no reason.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        self._early_cuts = 0

    def explained(self, reason: str, connection: BrokerClient) -> str:
        """Why an accepted connection is over. Called once for each, at its end."""
        self._early_cuts = self._early_cuts + 1 if connection.was_cut_early else 0
        if self._early_cuts <= MAX_EARLY_CUTS:
            return reason
        return f"{reason}; perhaps another client has client_id {self.text}"


def _password(file: Path | None) -> bytes | None:
    """The password in a file, which may be any bytes.

    Read at each attempt to connect, so that a new password needs no restart. Raises `OSError` for
    an unusable file.
    """
    if file is None:
        return None
    content = read_bytes(file)
    newline = b"\r\n" if content.endswith(b"\r\n") else b"\n"
    password = content.removesuffix(newline)
    if len(password) > MAX_TEXT:
        raise OSError(f"{file} holds more than {MAX_TEXT} bytes")
    return password

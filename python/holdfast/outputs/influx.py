"""Sends line protocol over HTTP (InfluxDB v2 write API, and others that accept it)."""

from __future__ import annotations

import base64
import contextlib
import gzip
import http.client
import json
import re
import socket
import ssl
import threading
import time
from typing import TYPE_CHECKING
from urllib.parse import urlencode

from holdfast.client.tcp_connect import connected_sync, remaining_s
from holdfast.net.addresses import joined
from holdfast.net.secret_file import read_secret
from holdfast.net.tls import NO_FILES, https_context
from holdfast.outputs.line_protocol import lines
from holdfast.outputs.sender import MAX_READINGS, Receiver, Refused, soon_after, time_left
from holdfast.runtime.stop import Stop

if TYPE_CHECKING:
    from holdfast.config.models.outputs import InfluxConfig
    from holdfast.polling import Reading

CONNECT_TIMEOUT_S = 3.0
"""Seconds to look up the name and connect, at most."""

MAX_RESPONSE_BYTES = 65_536
"""The bytes of an answer that are read."""

MAX_SHOWN_CHARS = 200
"""The characters of an error message of the receiver that are shown."""

MIN_SECRET_CHARS = 4
"""The characters of a password or token that is not shown, at least."""

TOO_LARGE = 413

UNWANTED = (400, TOO_LARGE, 422)
"""Answers to a request that would be refused each time. All others are tried again: a token or a
bucket can be put right."""

MAX_TOO_LARGE = 10
"""How many single values of one call of `send` are found too large, before it gives up all others:
a receiver that takes no request of any size must not get a request for each value.
"""


class Influx(Receiver):
    """One connection, kept open between requests."""

    def __init__(self, settings: InfluxConfig) -> None:
        self._settings = settings
        self._target = settings.target
        self._connection: http.client.HTTPConnection | None = None
        self._is_late = False
        self._stop = Stop()
        self._most = MAX_READINGS
        """The readings of a request, at most. Less than the receiver takes after one that was too
        large."""
        self._secrets: list[str] = []
        """What no message may repeat, of the last request."""
        self._path = self._target.path
        if self._path in ("", "/"):
            query = {"org": settings.org, "bucket": settings.bucket, "precision": "ns"}
            given = {key: value for key, value in query.items() if value is not None}
            self._path = f"/api/v2/write?{urlencode(given)}"

    def use_stop(self, stop: Stop) -> None:
        """Ends a request that waits for its answer soon after the stop. Called before all else."""
        self._stop = stop
        soon_after(stop, self._interrupt)

    def send(self, readings: list[Reading]) -> None:
        """Sends all values but those without a value. If a request is too large, in parts.

        Raises `Refused` for those that the receiver does not take.
        """
        rest, reason, too_large = readings, "", 0
        refused: list[Reading] = []
        while rest:
            part = rest[: self._most]
            status, message = self._sent(part)
            if status == TOO_LARGE and len(part) > 1:
                self._most = len(part) // 2
                continue
            rest = rest[len(part) :]
            if status in UNWANTED:
                refused, reason = refused + part, message
                too_large += status == TOO_LARGE
                if too_large == MAX_TOO_LARGE:
                    refused, rest = refused + rest, []
            else:
                self._most = min(2 * self._most, MAX_READINGS)
        if refused:
            raise Refused(reason, refused)

    def _sent(self, readings: list[Reading]) -> tuple[int, str]:
        """Sends one request. Returns its status, and what says so. Raises `OSError` for a status
        that is neither good nor `UNWANTED`.
        """
        body = lines(readings, self._settings.measurement, self._settings.tags)
        if not body:
            return 204, ""
        status, answer = self._answer(body)
        text = answer.decode("utf-8", "replace").strip()
        # Some receivers, and proxies before them, repeat the headers that they got, in part or with
        # escaped characters. A shorter secret is also a part of words.
        if whole := [each for each in self._secrets if len(each) >= MIN_SECRET_CHARS]:
            begun = [re.escape(each[:8]) + r"[^\s\"']*" for each in whole]
            text = re.sub("|".join([*map(re.escape, whole), *begun]), "***", text)
        text = text[:MAX_SHOWN_CHARS]
        message = f"{self._at}: HTTP {status}{': ' if text else ''}{text}"
        if 200 <= status < 300 or status in UNWANTED:
            return status, message
        raise OSError(message)

    def idle(self) -> bool:
        """Connects: also without a value, it shows whether the receiver can be reached."""
        if self._connection is not None and self._is_over(self._connection.sock):
            self.close()
        self._connected()
        return True

    def close(self) -> None:
        """Closes the connection."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def status(self) -> dict[str, object]:
        """Where values go."""
        return {"url": self._at}

    @property
    def _at(self) -> str:
        return joined(self._target.host, self._target.port)

    def _answer(self, body: bytes) -> tuple[int, bytes]:
        """Sends a request. A connection that was closed while it was idle is opened again."""
        headers = {"Content-Type": "text/plain; charset=utf-8", **self._authorization()}
        if self._settings.gzip:
            # A time beyond 2106 has no room in the header.
            body, headers["Content-Encoding"] = gzip.compress(body, 1, mtime=0), "gzip"
        is_fresh = self._connection is None
        try:
            return self._request(body, headers)
        except (http.client.RemoteDisconnected, ConnectionError):
            self.close()
            if is_fresh:
                raise
        return self._request(body, headers)

    def _request(self, body: bytes, headers: dict[str, str]) -> tuple[int, bytes]:
        connection = self._connected()
        # A receiver that sends a byte now and then does not exceed the timeout of the socket.
        self._is_late = False
        timer = threading.Timer(self._settings.timeout, self._time_out)
        timer.daemon = True
        timer.start()
        try:
            connection.request("POST", self._path, body, headers)
            answer = connection.getresponse()
            text = answer.read(MAX_RESPONSE_BYTES)
            # Without a socket, `http.client` would open one with the timeout for connecting.
            if not answer.isclosed() or connection.sock is None:
                self.close()
        except (http.client.HTTPException, OSError) as error:
            self.close()
            if self._is_late or isinstance(error, TimeoutError):
                late = f"{self._at}: no answer within {self._settings.timeout:g} s"
                raise TimeoutError(late) from error
            if isinstance(error, OSError):
                raise
            raise OSError(f"{self._at}: not HTTP: {error or type(error).__name__}") from error
        finally:
            timer.cancel()
        return answer.status, text

    def _time_out(self) -> None:
        """Called by another thread, if a request takes too long."""
        self._is_late = True
        self._interrupt()

    def _interrupt(self) -> None:
        """Called by another thread: what waits for the socket gets an error."""
        connection = self._connection
        if connection is not None and connection.sock is not None:
            with contextlib.suppress(OSError):
                connection.sock.shutdown(socket.SHUT_RDWR)

    def _connected(self) -> http.client.HTTPConnection:
        """The connection; a new one if there is none."""
        if self._connection is None:
            self._check_stop()
            seconds = min(CONNECT_TIMEOUT_S, self._settings.timeout, time_left(self._stop))
            try:
                self._connection = self._opened(time.monotonic() + seconds)
            except TimeoutError as error:
                message = f"no connection to {self._at} within {seconds:.1f} s"
                raise TimeoutError(message) from error
            self._connection.sock.settimeout(self._settings.timeout)
            try:
                self._check_stop()  # Before, `_interrupt` had nothing to end.
            except OSError:
                self.close()
                raise
        return self._connection

    def _check_stop(self) -> None:
        """Raises `OSError` if the time after a stop is over."""
        if not time_left(self._stop):
            raise OSError("stopped")

    def _is_over(self, connection: socket.socket) -> bool:
        """Whether the receiver has closed a connection, or sends what nobody has asked for."""
        connection.settimeout(0)
        try:
            connection.recv(1)
        except (BlockingIOError, ssl.SSLWantReadError):
            return False
        except OSError:
            return True
        finally:
            connection.settimeout(self._settings.timeout)
        return True

    def _opened(self, deadline: float) -> http.client.HTTPConnection:
        """A connection. `http.client` would wait for a name server as long as the system does, and
        for each address anew.
        """
        host, port, secure, _ = self._target
        if not secure:
            plain = http.client.HTTPConnection(host, port)
            plain.sock = connected_sync(host, port, deadline)
            return plain
        tls = NO_FILES if self._settings.tls is None else self._settings.tls.files
        context = https_context(tls)
        connection = http.client.HTTPSConnection(host, port, context=context)
        sock = connected_sync(host, port, deadline)
        try:
            sock.settimeout(remaining_s(deadline))
            connection.sock = context.wrap_socket(sock, server_hostname=connection.host)
        except BaseException:
            sock.close()
            raise
        return connection

    def _authorization(self) -> dict[str, str]:
        """The credentials, read each time, so that a new token needs no restart."""
        settings = self._settings
        if settings.token_file is not None:
            token = read_secret(settings.token_file).strip()
            if not (token.isascii() and token.isprintable()):
                raise OSError(f"{settings.token_file} is not one line of printable ASCII")
            self._secrets = [token]
            return {"Authorization": f"Token {token}"}
        if settings.username is not None and settings.password_file is not None:
            password = read_secret(settings.password_file).strip()
            pair = base64.b64encode(f"{settings.username}:{password}".encode()).decode()
            self._secrets = [pair, password, json.dumps(password)[1:-1]]
            return {"Authorization": f"Basic {pair}"}
        return {}

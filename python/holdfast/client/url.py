"""Parses the URLs of devices, and of receivers of Raw Ingest packets."""

from __future__ import annotations

import os
import re
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, TypeAlias, get_args
from urllib.parse import parse_qsl, unquote, urlsplit

from holdfast.client.serial_settings import Mode, SerialTarget, stop_bits
from holdfast.client.tolerance import STRICT, Tolerance
from holdfast.net.addresses import address_in, joined
from holdfast.net.hosts import host_and_port
from holdfast.net.tls import NO_FILES
from holdfast.net.tls import Tls as Tls
from holdfast.protocol import MAX_UNIT, usual_port
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import listing
from holdfast.types import SERIAL_FRAMES, TRANSPORTS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from pathlib import Path

    from holdfast.types import Transport

SERIAL_SCHEMES: tuple[Mode, ...] = get_args(Mode)
SCHEMES = (*TRANSPORTS, *SERIAL_SCHEMES)

MAX_SILENCE_S = 10.0
"""Seconds."""

SECURE = ("tls", "raw+tls")
"""The schemes with TLS: of devices, and of receivers of Raw Ingest packets."""

IN_FLIGHT: tuple[Transport, ...] = ("tcp", "tls")
"""The transports that allow several requests in flight."""

SERIAL_FORMS = "rtu:///dev/ttyUSB0?baud=19200&parity=even, ascii:///dev/ttyUSB0"
"""Examples of serial lines in messages."""


def _form(transport: Transport) -> str:
    """An example of the URL of a device."""
    tls = "?ca=ca.pem" if transport == "tls" else ""
    return f"{transport}://host:{usual_port(transport)}{tls}"


FORMS = ", ".join([*map(_form, TRANSPORTS), SERIAL_FORMS])
"""Examples of all schemes in messages."""

MAX_PAUSE_S = 60
MAX_RETRIES = 10
MAX_CLOSE_AFTER = 65_535


@dataclass(frozen=True)
class NetworkTarget:
    """A device or gateway at a network address."""

    transport: Transport
    host: str
    port: int
    tls: Tls = NO_FILES
    """Of transport `tls`."""
    tolerance: Tolerance = STRICT

    def __str__(self) -> str:
        return f"{self.transport}://{joined(self.host, self.port)}"


Target: TypeAlias = NetworkTarget | SerialTarget


def connection_of(target: Target) -> str:
    """The same text for all spellings of a network address; TLS and TCP count as one.

    A serial line has the name of its URL.
    """
    if isinstance(target, SerialTarget):
        return f"serial:{target.device}"
    found = address_in(target.host)
    host = target.host.lower() if found is None else str(found)
    transport = "tcp" if target.transport == "tls" else target.transport
    return f"{transport}://{joined(host, target.port)}"


def shared_connection(target: Target) -> tuple[str, str]:
    """The connection that polled devices share. TLS and plain TCP at one address are two.

    A serial line has the name of its URL: a link of `/dev/serial` may name another one later.
    """
    if isinstance(target, SerialTarget):
        return "", target.device
    return target.transport, connection_of(target)


def physical_connection(target: Target) -> tuple[str, str]:
    """`shared_connection`, but a serial line has the real path of its device."""
    scheme, place = shared_connection(target)
    return scheme, os.path.realpath(place) if isinstance(target, SerialTarget) else place


def other_name(target: Target, connections: Iterable[tuple[str, str]]) -> str | None:
    """The other name that one of these shared connections has for the serial line of a target."""
    if not isinstance(target, SerialTarget):
        return None
    line = os.path.realpath(target.device)
    names = (name for scheme, name in connections if not scheme and name != target.device)
    return next((name for name in names if os.path.realpath(name) == line), None)


def shared_options(target: Target) -> dict[str, Any]:
    """The options of a URL that all devices at a connection or line have from its first user."""
    line = target.settings if isinstance(target, SerialTarget) else {}
    return line | asdict(target.tolerance)


def parse(url: str) -> Target:
    """Parses the URL of a device. Raises `ValueError` that says what is allowed."""
    if not isinstance(url, str):
        raise TypeError(f"{url!r} is not the URL of a device, allowed: {FORMS}")
    try:
        parts = urlsplit(_clean(url))
    except ValueError as error:
        raise ValueError(f"{_shown(url)}: {error}, allowed: {FORMS}") from None
    scheme = parts.scheme
    if parts.fragment or parts.username is not None:
        raise ValueError(f"{_shown(url)} has a user or a fragment, allowed: {FORMS}")
    if scheme in TRANSPORTS:
        if not parts.netloc or parts.path not in ("", "/"):
            raise ValueError(f"{_shown(url)} is not the address of a device, allowed: {FORMS}")
        host, port = _location(url, parts.netloc)
        port = usual_port(scheme) if port is None else port
        options = options_of(url, scheme, parts.query)
        tolerance = _pop_fields(Tolerance, options)
        try:
            tls = Tls(**options)
        except ValueError as error:
            raise ValueError(f"{url!r}: {error}") from None
        return NetworkTarget(scheme, host, port, tls, tolerance)
    if scheme in SERIAL_SCHEMES:
        return _serial(url, scheme, parts.netloc + parts.path, parts.query)
    near = suggestion(scheme, SCHEMES) if scheme else ""
    raise ValueError(f"{_shown(url)} is not the URL of a device, allowed: {FORMS}{near}")


def _shown(url: str) -> str:
    """A URL for messages, without its user, options and fragment, which may be secrets."""
    return repr(re.split("[?#]", re.sub("//.*@", "//***@", url, flags=re.DOTALL), maxsplit=1)[0])


def _clean(url: str) -> str:
    """A URL without what `urlsplit` would drop in silence. Raises `ValueError`."""
    if url != url.strip() or re.search(r"[\t\r\n]", url):
        raise ValueError("blanks around it or a control character")
    return url


def _location(url: str, netloc: str) -> tuple[str, int | None]:
    """The host and the port of a URL. Raises `ValueError`."""
    try:
        return host_and_port(netloc)
    except ValueError as error:
        hint = "; options begin with '?'" if re.search("[&;,=]", netloc) else ""
        raise ValueError(f"{_shown(url)}: {error}{hint}") from None


def in_folder(url: str, folder: Path) -> str:
    """The URL, with paths of files resolved relative to this folder."""
    target = parse(url)
    if not isinstance(target, NetworkTarget) or target.transport != "tls":
        return url
    return with_tls_in_folder(url, target.tls, folder)


def with_tls_in_folder(url: str, tls: Tls, folder: Path) -> str:
    """A URL with these TLS files, whose paths are resolved relative to this folder."""
    resolved = tls.in_folder(folder)
    if resolved == tls:
        return url
    location, _, query = url.partition("?")
    others = [each for each in query.split("&") if unquote(each.partition("=")[0]) not in TLS_KEYS]
    return f"{location}?{'&'.join([resolved.query, *others])}"


@dataclass(frozen=True)
class _Option:
    """A key of the query: its allowed values, as text, and its parser."""

    allowed: str
    read: Callable[[str], Any]
    schemes: tuple[str, ...] = SERIAL_SCHEMES


def _one_of(*words: str, read: Callable[[str], Any] = str) -> _Option:
    def word(text: str) -> Any:
        if text not in words:
            raise ValueError(text)
        return read(text)

    return _Option(", ".join(words), word)


def _baud(text: str) -> int:
    if not re.fullmatch("[0-9]{2,7}", text) or not 50 <= int(text) <= 4_000_000:
        raise ValueError(text)
    return int(text)


def _seconds(text: str) -> float:
    seconds = _pause(text)
    if not 0 < seconds <= MAX_SILENCE_S:
        raise ValueError(text)
    return seconds


def _pause(text: str) -> float:
    if not re.fullmatch(r"[0-9]*\.?[0-9]+", text) or not float(text) <= MAX_PAUSE_S:
        raise ValueError(text)
    return float(text)


def _up_to(most: int) -> Callable[[str], int]:
    def number(text: str) -> int:
        if not re.fullmatch("[0-9]{1,9}", text) or int(text) > most:
            raise ValueError(text)
        return int(text)

    return number


def _unit(text: str) -> int | str:
    return text if text == "any" else _up_to(MAX_UNIT)(text)


def _echo(text: str) -> bool | str:
    return text if text == "auto" else _up_to(1)(text) == 1


def _text(text: str) -> str:
    if not text or "\0" in text:
        raise ValueError(text)
    return text


_FLAG = replace(_one_of("0", "1", read=lambda text: text == "1"), schemes=SCHEMES)

OPTIONS: Mapping[str, _Option] = {
    "baud": _Option("50 to 4000000", _baud),
    "parity": _one_of("none", "even", "odd"),
    "stop_bits": _one_of("1", "2", read=int),
    "data_bits": _one_of("7", "8", read=int),
    "silence": _Option("seconds, up to 10", _seconds, ("rtu",)),
    "rs485": _one_of("rts", "rts-low"),
    "accept_unit": _Option(f"any, 0 to {MAX_UNIT}", _unit, SCHEMES),
    "pad": _FLAG,
    "echo": _Option("0, 1, auto", _echo, (*SERIAL_FRAMES, *SERIAL_SCHEMES)),
    "pause": _Option(f"seconds, up to {MAX_PAUSE_S}", _pause, SCHEMES),
    "pause_after_connect": _Option(f"seconds, up to {MAX_PAUSE_S}", _pause, SCHEMES),
    "retries": _Option(f"0 to {MAX_RETRIES}", _up_to(MAX_RETRIES), SCHEMES),
    "retry_busy": _FLAG,
    "close_after": _Option(f"0 to {MAX_CLOSE_AFTER}", _up_to(MAX_CLOSE_AFTER), SCHEMES),
    "reconnect": _Option(f"seconds, up to {MAX_PAUSE_S}", _pause, SCHEMES),
    "write_multiple": _FLAG,
    **dict.fromkeys(
        ("ca", "cert", "key", "key_passphrase_file"), _Option("paths of files", _text, SECURE)
    ),
    "name": _Option("host names and IP addresses", _text, SECURE),
}


TLS_KEYS = tuple(name for name, each in OPTIONS.items() if each.schemes == SECURE)


def _pop_fields(kind: type[Any], options: dict[str, Any]) -> Any:
    """A dataclass of the keys that are its fields, which are taken out."""
    return kind(
        **{each.name: options.pop(each.name) for each in fields(kind) if each.name in options}
    )


_UNIT_HINT = "; the unit id of a device is not part of its URL: set it with unit, or --unit"


def options_of(url: str, scheme: str, query: str) -> dict[str, Any]:
    """Parses a query with the options of a scheme."""
    options: dict[str, Any] = {}
    # `+` is a literal in a URL; `parse_qsl` would read it as a space, as in HTML forms.
    for key, text in parse_qsl(query.replace("+", "%2B"), keep_blank_values=True):
        option = OPTIONS.get(key)
        if option is None or scheme not in option.schemes:
            known = [name for name, each in OPTIONS.items() if scheme in each.schemes]
            hint = _UNIT_HINT if key == "unit" and scheme in SCHEMES else ""
            words = f"{listing(known)}{suggestion(key, known)}{hint}"
            raise ValueError(f"{_shown(url)}: unknown option {key!r}, allowed: {words}")
        if key in options:
            raise ValueError(f"{_shown(url)}: option {key!r} is given twice")
        try:
            options[key] = option.read(text)
        except ValueError:
            raise ValueError(
                f"{_shown(url)}: {key} is {text!r}, allowed: {option.allowed}"
            ) from None
    return options


def _serial(url: str, mode: Mode, path: str, query: str) -> SerialTarget:
    device = unquote(path)
    if port := re.fullmatch(r"/?((?i:COM)[0-9]+|\\\\\.\\.+)", device):
        device = port[1]  # Ports of Windows have no leading slash.
    if device in ("", "/"):
        raise ValueError(f"{_shown(url)} has no device, allowed: {FORMS}")
    if not port and not device.startswith("/"):
        raise ValueError(
            f"{_shown(url)} is not a serial line, allowed: three slashes, as in "
            f"{mode}:///dev/ttyUSB0, or {mode}://COM3; {mode.upper()} frames over TCP are "
            f"{mode}+tcp://host:502"
        )
    options = options_of(url, mode, query)
    if mode == "rtu" and options.get("data_bits", 8) != 8:
        raise ValueError(f"{url!r}: data_bits is 7, allowed with rtu: 8")
    options.setdefault("data_bits", 8 if mode == "rtu" else 7)
    options.setdefault("stop_bits", stop_bits(options.get("parity", SerialTarget.parity)))
    tolerance = _pop_fields(Tolerance, options)
    return SerialTarget(mode, device, tolerance=tolerance, **options)


RECEIVER_TIMEOUT_S = 5.0
"""Seconds to send a packet: for connection, packet and reply together."""

RECEIVER_FORM = "raw://10.0.2.9:9000 or raw+tls://10.0.2.9:9000?ca=ca.pem"


@dataclass(frozen=True)
class Receiver:
    """A receiver of Raw Ingest packets."""

    host: str
    port: int
    tls: Tls | None = None
    """`None` for plain TCP."""

    def __str__(self) -> str:
        scheme = "raw" if self.tls is None else "raw+tls"
        return f"{scheme}://{joined(self.host, self.port)}"


def parse_receiver(url: str) -> Receiver:
    """Parses `raw://host:port` and `raw+tls://host:port`. Raises `ValueError` for anything else."""
    wrong = f"found {_shown(url)}, allowed: {RECEIVER_FORM}"
    try:
        parts = urlsplit(_clean(url))
    except ValueError:
        raise ValueError(wrong) from None
    bare = url.partition("?")[0] == f"{parts.scheme}://{parts.netloc}"
    if parts.scheme not in ("raw", "raw+tls") or not bare or "@" in parts.netloc:
        raise ValueError(wrong)
    host, port = _location(url, parts.netloc)
    if port is None:
        raise ValueError(wrong)
    options = options_of(url, parts.scheme, parts.query)
    if parts.scheme == "raw":
        return Receiver(host, port)
    try:
        return Receiver(host, port, Tls(**options))
    except ValueError as error:
        raise ValueError(f"{url!r}: {error}") from None


def receiver_in_folder(url: str, folder: Path) -> str:
    """The URL, with paths of files resolved relative to this folder."""
    tls = parse_receiver(url).tls
    return url if tls is None else with_tls_in_folder(url, tls, folder)

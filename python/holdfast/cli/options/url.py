"""The argument `URL`: a device."""

from __future__ import annotations

import re
from pathlib import Path

import click

from holdfast.client.url import FORMS, parse
from holdfast.net.addresses import address_in, bracketed

SERIAL_DEVICE = re.compile(r"(/.+|COM[0-9]+|\\\\\.\\.+)")
HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?(:[0-9]{1,5})?")
ADDRESS_6 = re.compile(r"[0-9a-fA-F:.]*:[0-9a-fA-F.]*:[0-9a-fA-F:.]*")
FILES = (".yaml", ".yml", ".json", ".csv")
"""How names of files end that are no hosts."""


def is_url(text: str) -> bool:
    """Whether an argument is a URL or an IP address, not a file."""
    return "://" in text or (_is_address(text) and not Path(text).exists())


def is_serial_device(text: str) -> bool:
    """Whether an argument is the device of a serial line."""
    return SERIAL_DEVICE.fullmatch(text) is not None and not text.lower().endswith(FILES)


def checked_url(text: str) -> str:
    """Checks the URL of a device; a host without a scheme is one over TCP.

    Raises `click.BadParameter`.
    """
    url = text if "://" in text else _url_of(text)
    try:
        parse(url)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error
    return url


def _url_of(text: str) -> str:
    """The URL of a host without a scheme. Raises `click.BadParameter` for other text."""
    if is_serial_device(text):
        raise click.BadParameter(
            f"{text!r} is a serial line: type rtu://{text}?baud=19200&parity=even, with its "
            f"settings. 'holdfast find {text}' finds them."
        )
    name, _, port = text.partition(":")
    is_host = HOST.fullmatch(text) is not None and not text.lower().endswith(FILES)
    if _is_address(text) or (is_host and ("." in name or port or name == "localhost")):
        return f"tcp://{bracketed(text) if ADDRESS_6.fullmatch(text) else text}"
    hint = f"; for a host of that name, type tcp://{text}" if is_host else ""
    raise click.BadParameter(f"{text!r} is not the URL of a device, allowed: {FORMS}{hint}.")


def _is_address(text: str) -> bool:
    """Whether text is an IP address, with or without a port."""
    host, port = text, "0"
    if ":" in text and not ADDRESS_6.fullmatch(text):
        host, _, port = text.rpartition(":")
    return address_in(host) is not None and re.fullmatch("[0-9]{1,5}", port) is not None


url_argument = click.argument("url", type=checked_url, metavar="URL")

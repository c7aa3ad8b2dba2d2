"""The words for why TLS failed: one list, of the core."""

from __future__ import annotations

import errno
import os
import socket
import ssl

from holdfast import _core
from holdfast.net.secure_channel import TlsRefused, failure_text
from support.paths import DOCS


def test_the_page_explains_every_word_of_the_core() -> None:
    page = (DOCS / "modbus-tls.md").read_text(encoding="utf-8")
    assert [word for word in _core.TLS_REASONS if f"`{word}`" not in page] == []


def test_the_text_of_a_failure_begins_with_its_word() -> None:
    assert failure_text(TlsRefused("expired", "it expired")) == "expired: it expired"
    assert failure_text(ConnectionError("refused")) == "refused"
    refused = OSError(errno.ECONNREFUSED, "Connect call failed ('127.0.0.1', 1)")
    assert failure_text(refused) == os.strerror(errno.ECONNREFUSED)
    assert failure_text(ssl.SSLError(1, "[SSL] wrong version")) == "[SSL] wrong version"
    assert failure_text(socket.gaierror(-2, "no such name")) == "no such name"
    assert failure_text(FileNotFoundError(2, "No such file", "ca.pem")).endswith("'ca.pem'")
    assert failure_text(TimeoutError()) == "TimeoutError"

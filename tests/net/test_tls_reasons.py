"""The words for why TLS failed: one list, of the core."""

from __future__ import annotations

from holdfast import _core
from holdfast.net.secure_channel import TlsRefused, failure_text
from support.paths import DOCS


def test_the_page_explains_every_word_of_the_core() -> None:
    page = (DOCS / "modbus-tls.md").read_text(encoding="utf-8")
    assert [word for word in _core.TLS_REASONS if f"`{word}`" not in page] == []


def test_the_text_of_a_failure_begins_with_its_word() -> None:
    assert failure_text(TlsRefused("expired", "it expired")) == "expired: it expired"
    assert failure_text(ConnectionError("refused")) == "refused"
    assert failure_text(TimeoutError()) == "TimeoutError"

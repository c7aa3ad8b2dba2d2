"""Values and lists in messages."""

from __future__ import annotations

import ctypes
import errno
import sys

import pytest

from holdfast.runtime.text import (
    all_of,
    clip,
    either,
    listing,
    os_error_text,
    quote,
)


def test_a_long_text_is_cut() -> None:
    assert clip("a" * 40) == "a" * 40
    assert clip("a" * 41) == "a" * 40 + "…"
    assert clip("abc", 2) == "ab…"


def test_a_quoted_text_is_cut_and_has_no_control_characters() -> None:
    assert quote("pump\x1b[2J\n") == r"'pump\x1b[2J\n'"
    assert quote("a" * 1000) == f"'{'a' * 40}'…"


def test_lists_are_as_in_a_sentence() -> None:
    assert [either("a"), either("ab"), either("abc")] == ["a", "a or b", "a, b or c"]
    assert [all_of([5]), all_of([5, 6]), all_of([5, 6, 15])] == ["5", "5 and 6", "5, 6 and 15"]
    assert either(["a", "b", "a"]) == "a or b"
    assert listing([1, 2, 3]) == "1, 2, 3"


def test_an_error_of_windows_has_the_text_of_its_own_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert os_error_text(OSError(errno.ECONNREFUSED, "[Errno 111] …")) == "Connection refused"
    assert os_error_text(OSError("closed")) == "closed"
    refused = OSError(errno.EINVAL, "The remote computer refused the network connection")
    refused.winerror = 1225  # type: ignore[attr-defined]
    texts = {1225: "The remote computer refused the network connection."}
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(ctypes, "FormatError", texts.get, raising=False)
    assert os_error_text(refused) == texts[1225]

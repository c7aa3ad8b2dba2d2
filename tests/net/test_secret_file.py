"""Files that contain a password or a token."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from holdfast.net.mqtt.client import _password
from holdfast.net.secret_file import read_secret

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("end", ["", "\n", "\r\n"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_a_secret_has_neither_a_line_end_nor_a_byte_order_mark(
    tmp_path: Path, encoding: str, end: str
) -> None:
    file = tmp_path / "secret"
    file.write_bytes(f"geheim ü{end}".encode(encoding))
    assert read_secret(file) == "geheim ü"
    assert _password(file) == "geheim ü".encode()


def test_a_secret_of_another_encoding_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "secret"
    file.write_bytes("geheim ü".encode("cp1252"))
    with pytest.raises(OSError, match="secret is not UTF-8 text"):
        read_secret(file)

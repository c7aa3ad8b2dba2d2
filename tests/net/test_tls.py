"""Files of TLS: what goes together, and what they come to."""

from __future__ import annotations

from pathlib import Path

import pytest

from holdfast.client.url import in_folder, parse
from holdfast.net.tls import NO_FILES, Tls, alone


def test_a_certificate_and_its_key_go_together() -> None:
    assert alone(cert=True, key=False) == ("cert", "key")
    assert alone(cert=False, key=True) == ("key", "cert")
    assert alone(cert=True, key=True) is None
    assert alone(cert=False, key=False) is None


@pytest.mark.parametrize(("files", "given"), [({"cert": "c"}, "cert"), ({"key": "k"}, "key")])
def test_one_without_the_other_can_not_be(files: dict[str, str], given: str) -> None:
    other = {"cert": "key", "key": "cert"}[given]
    message = f"{given} without {other}: give both, or neither"
    with pytest.raises(ValueError, match=f"^{message}$"):
        Tls(**files)
    with pytest.raises(ValueError, match=message):
        parse(f"tls://plc?{given}=file.pem")


def test_files_may_be_paths() -> None:
    made = Tls.of(Path("ca.pem"), Path("own.pem"), "own.key")
    assert made == Tls("ca.pem", "own.pem", "own.key")
    assert list(made.files()) == [("ca", "ca.pem"), ("cert", "own.pem"), ("key", "own.key")]
    assert Tls.of(None) == NO_FILES


def test_files_are_relative_to_a_folder(tmp_path: Path) -> None:
    made = Tls("ca.pem", "/etc/own.pem", "keys/own.key", "plc.local").in_folder(tmp_path)
    absolute = (str(tmp_path / "ca.pem"), "/etc/own.pem", str(tmp_path / "keys/own.key"))
    assert made == Tls(*absolute, "plc.local")
    assert parse(in_folder("tls://plc?ca=ca.pem", tmp_path)) == parse(
        f"tls://plc?ca={tmp_path / 'ca.pem'}"
    )

"""Malformed files: certificates, revocation lists and keys with altered bytes."""

from __future__ import annotations

import base64
import contextlib
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from holdfast.net.certificates import authority, expiry, inspection, parser, pem
from holdfast.net.http.https import Https, HttpsFiles
from holdfast.runtime.bounded_files import MAX_CERTIFICATES_BYTES
from support.cases import examples

if TYPE_CHECKING:
    from pathlib import Path

PLANT = authority.Authority.create("plant")
OWNER = authority.new_key("p256")
GOOD = {
    "CERTIFICATE": authority.pem(PLANT.issue_client("panel", "operator", OWNER, 9)),
    "X509 CRL": authority.list_pem(PLANT.revocation_list(None, [7])),
    "PRIVATE KEY": parser.key_pem(OWNER),
}


@st.composite
def altered(draw: st.DrawFn) -> bytes:
    label = draw(st.sampled_from(sorted(GOOD)))
    body = bytearray(base64.b64decode(b"".join(GOOD[label].splitlines()[1:-1])))
    for at in draw(st.lists(st.integers(0, len(body) - 1), min_size=1, max_size=4)):
        body[at] = draw(st.integers(0, 255))
    encoded = base64.encodebytes(body[: draw(st.just(len(body)) | st.integers(1, len(body)))])
    return f"-----BEGIN {label}-----\n{encoded.decode()}-----END {label}-----\n".encode()


@pytest.mark.filterwarnings("ignore")  # cryptography warns of some certificates.
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=examples(300))
@given(text=altered())
def test_a_file_is_either_usable_or_named_as_unusable(tmp_path: Path, text: bytes) -> None:
    file = tmp_path / "some.pem"
    file.write_bytes(text)
    for use in (
        inspection.describe,
        expiry.of_certificates,
        expiry.of_revocation_lists,
        expiry.missing_name_warning,
        lambda file: Https(HttpsFiles(file, file)),
    ):
        with contextlib.suppress(pem.UnusableFile):
            use(file)


def test_large_files_are_not_read(tmp_path: Path) -> None:
    file = tmp_path / "large.pem"
    file.write_bytes(b" " * (MAX_CERTIFICATES_BYTES + 1))
    with pytest.raises(pem.UnusableFile, match="more than 4194304 bytes"):
        parser.certificates(file)

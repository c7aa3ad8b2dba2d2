"""The certificate of a server, and the key that belongs to it."""

from __future__ import annotations

import base64
import binascii
from typing import TYPE_CHECKING

from holdfast.net.certificates.pem import (
    CERTIFICATE,
    LOCKED,
    UnusableFile,
    blocks,
    content,
    is_locked,
    missing_block,
    passphrase,
)
from holdfast.runtime import extras
from holdfast.runtime.bounded_files import require_stored

if TYPE_CHECKING:
    from holdfast.net.certificates.pem import File

REVIEW_S = 3600.0
"""Seconds until a server judges the certificates of open connections again."""


def key_for_core(
    key_file: File, passphrase_file: File | None, *others: File | None
) -> bytes | None:
    """Returns the key of a server if it is encrypted, without encryption; otherwise `None`.

    The core reads the files itself, these and `others`: raises `UnusableFile` for one that could
    block it.
    """
    try:
        require_stored(key_file, *others)
    except OSError as error:
        raise UnusableFile(error.filename, error.strerror or str(error)) from error
    return unlocked(key_file, passphrase_file)


def own_der(cert_file: File) -> bytes:
    """Returns the first certificate of a file in DER. Raises `UnusableFile`."""
    text = content(cert_file)
    found = next((block for label, block in blocks(text) if label == CERTIFICATE), None)
    if found is None:
        raise UnusableFile(cert_file, missing_block(text, "certificate"))
    try:
        # Between the BEGIN and the END line.
        return base64.b64decode(b"".join(found.split(b"-----")[2].split()), validate=True)
    except binascii.Error as error:
        raise UnusableFile(cert_file, f"a certificate can't be read: {error}") from error


def unlocked(file: File, passphrase_file: File | None) -> bytes | None:
    """Returns an encrypted key in PEM, without encryption.

    `None` if the key is not encrypted and no passphrase file is given. Raises `UnusableFile`.
    """
    if passphrase_file is None:
        try:
            text = content(file)
        except UnusableFile:  # The core reads the file next, and reports the error.
            return None
        if is_locked(text):
            raise UnusableFile(file, LOCKED)
        return None
    reason = extras.missing("certs")
    if reason is not None:
        raise UnusableFile(file, f"a key with a passphrase {reason}")
    from holdfast.net.certificates import parser

    return parser.key_pem(parser.key(file, passphrase(passphrase_file)))

"""PEM files with certificates, keys and revocation lists: their blocks. `parser` parses these."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, TypeAlias

from holdfast.runtime import bounded_files
from holdfast.runtime.bounded_files import MAX_CERTIFICATES_BYTES

if TYPE_CHECKING:
    from os import PathLike

    File: TypeAlias = str | PathLike[str]

LOCKED = "the key is encrypted, and no passphrase is given"

CERTIFICATE = "CERTIFICATE"
REVOCATION_LIST = "X509 CRL"
"""The labels of blocks."""

_BLOCK = re.compile(rb"-----BEGIN ([A-Z0-9 ]+)-----.*?-----END \1-----", re.DOTALL)


class UnusableFile(ValueError):
    """An unusable file. The message names the file, what was found and what is allowed."""

    def __init__(self, file: File, flaw: str) -> None:
        super().__init__(f"{file}: {flaw}")

    @classmethod
    def of(cls, error: ValueError) -> UnusableFile:
        """Creates one from an error of the core, whose message has the same form."""
        return cls.__new__(cls, str(error))


def content(file: File) -> bytes:
    """Returns the content of a file. Raises `UnusableFile`."""
    try:
        return bounded_files.read(file, MAX_CERTIFICATES_BYTES)
    except bounded_files.TooLarge as error:
        raise UnusableFile(
            file, f"more than {MAX_CERTIFICATES_BYTES} bytes, allowed: PEM"
        ) from error
    except OSError as error:
        raise UnusableFile(file, error.strerror or str(error)) from error


def blocks(text: bytes) -> list[tuple[str, bytes]]:
    """Returns the PEM blocks of a text, each with its label."""
    return [(found[1].decode(), found[0]) for found in _BLOCK.finditer(text)]


def passphrase(file: File) -> bytes:
    """Returns the passphrase in a file: its only line. Raises `UnusableFile`."""
    lines = content(file).splitlines()
    if len(lines) != 1 or not lines[0]:
        raise UnusableFile(file, f"found {len(lines)} lines, allowed: one line, the passphrase")
    return lines[0]


def is_key(label: str) -> bool:
    """Returns whether a block with this label is a key, of any kind."""
    return label.endswith("PRIVATE KEY")


def is_locked(text: bytes) -> bool:
    """Returns whether a key in PEM is encrypted, in PKCS#8 or in the older form of OpenSSL."""
    return b"ENCRYPTED" in text


def missing_block(text: bytes, what: str) -> str:
    """What is wrong with a file that has no such block."""
    found = "DER" if text[:1] == b"\x30" else f"no {what}"
    return f"found {found}, allowed: a {what} in PEM"

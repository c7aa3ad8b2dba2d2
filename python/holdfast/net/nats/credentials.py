"""NATS credentials: a file with a JWT and a seed, as `nsc` creates it.

The client signs a nonce from the server with the seed. The seed itself is never sent or logged, and
never appears in an error.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
from typing import TYPE_CHECKING

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from holdfast.runtime.bounded_files import MAX_SECRETS_BYTES, read

if TYPE_CHECKING:
    from pathlib import Path

SEED = 18 << 3
"""The first five bits of a seed. They make its text begin with S."""

USER = 20 << 3
KINDS = {
    14 << 3: "an operator",
    0: "an account",
    USER: "a user",
    13 << 3: "a server",
    2 << 3: "a cluster",
}
"""The owner of a key by its prefix byte. The texts begin with O, A, U, N and C."""

SEED_LENGTH = 36
"""Two prefix bytes, 32 bytes of the seed, two bytes of the checksum."""


class Credentials:
    """A file with the JWT and the seed of a user. It is read again for each connection."""

    def __init__(self, file: Path) -> None:
        """Raises `OSError` if the file can't be used."""
        self._file = file
        self._read()

    def sign(self, nonce: str) -> bytes:
        """Returns the base64 signature of a nonce. Raises `OSError` if the file can't be used."""
        key = self._read()
        return base64.b64encode(key.sign(nonce.encode()))

    def jwt(self) -> bytes:
        """Returns the JWT that was last read from the file."""
        return self._jwt

    def _read(self) -> Ed25519PrivateKey:
        text = read(self._file, MAX_SECRETS_BYTES)
        try:
            jwt = _block(text, "NATS USER JWT")
            key = _key(_block(text, "USER NKEY SEED"))
            if _subject(jwt) != _public(key):
                raise ValueError("the seed and the JWT are of different users")
        except ValueError as error:
            raise OSError(f"{self._file}: {error}") from None
        self._jwt = jwt
        return key


def _block(text: bytes, name: str) -> bytes:
    """Returns the text between the lines BEGIN and END of a name. Raises `ValueError`."""
    found = re.search(rf"-{{3,}}BEGIN {name}-+\s+([!-~]+)\s+-{{3,}}END {name}-".encode(), text)
    if found is None:
        raise ValueError(f"block {name} is missing; a NATS credentials file has one")
    return found[1]


def _key(seed: bytes) -> Ed25519PrivateKey:
    """Returns the signing key of a user's seed. Raises `ValueError`."""
    try:
        found = base64.b32decode(seed + b"=" * (-len(seed) % 8))
    except binascii.Error:
        found = b""
    sound = len(found) == SEED_LENGTH and found[0] & 0xF8 == SEED
    if not sound or found[-2:] != _checksum(found[:-2]):
        raise ValueError("the seed is malformed")
    kind = (found[0] & 7) << 5 | found[1] >> 3
    if kind != USER:
        owner = KINDS.get(kind, "something else")
        raise ValueError(f"the seed belongs to {owner}, allowed: the seed of {KINDS[USER]}")
    return Ed25519PrivateKey.from_private_bytes(found[2:-2])


def _public(key: Ed25519PrivateKey) -> str:
    """Returns the public key of a user in the encoding of NATS."""
    named = bytes([USER]) + key.public_key().public_bytes_raw()
    return base64.b32encode(named + _checksum(named)).rstrip(b"=").decode()


def _checksum(data: bytes) -> bytes:
    return binascii.crc_hqx(data, 0).to_bytes(2, "little")


def _subject(jwt: bytes) -> object:
    """Returns the subject of a JWT. Raises `ValueError`."""
    try:
        _, claims, _ = jwt.split(b".")
        return json.loads(base64.urlsafe_b64decode(claims + b"=" * (-len(claims) % 4)))["sub"]
    except (ValueError, KeyError, TypeError):
        raise ValueError("the JWT is malformed") from None

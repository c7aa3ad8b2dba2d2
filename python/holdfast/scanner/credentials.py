"""Who we are at NATS by a JWT and a seed, as `nsc` writes them into one file.

The server sends a text that is signed with the seed. The seed itself is never sent, logged or told
in an error.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
from typing import TYPE_CHECKING

from nacl.signing import SigningKey

if TYPE_CHECKING:
    from pathlib import Path

SEED = 18 << 3
"""The first five bits of a seed, by which its text begins with S."""

USER = 20 << 3
KINDS = {
    14 << 3: "an operator",
    0: "an account",
    USER: "a user",
    13 << 3: "a server",
    2 << 3: "a cluster",
}
"""Whose a key is, by the byte that says so: texts begin with O, A, U, N and C."""

SEED_LENGTH = 36
"""Two bytes that say what it is, 32 of the seed, two of the checksum."""


class Credentials:
    """A file with the JWT and the seed of a user; it is read anew for each connection."""

    def __init__(self, file: Path) -> None:
        """Raises `OSError` if the file can't be used."""
        self._file = file
        self._read()

    def sign(self, nonce: str) -> bytes:
        """The signature as base64. Raises `OSError` if the file can't be used."""
        key = self._read()
        return base64.b64encode(key.sign(nonce.encode()).signature)

    def jwt(self) -> bytes:
        """The JWT that was in the file when it was last read."""
        return self._jwt

    def _read(self) -> SigningKey:
        text = self._file.read_bytes()
        try:
            jwt = _block(text, "NATS USER JWT")
            key = _key(_block(text, "USER NKEY SEED"))
            if _subject(jwt) != _public(key):
                raise ValueError("the seed does not belong to the JWT")
        except ValueError as error:
            raise OSError(f"{self._file}: {error}") from None
        self._jwt = jwt
        return key


def _block(text: bytes, name: str) -> bytes:
    """What is between the lines BEGIN and END of a name. Raises `ValueError`."""
    found = re.search(rf"-{{3,}}BEGIN {name}-+\s+([!-~]+)\s+-{{3,}}END {name}-".encode(), text)
    if found is None:
        raise ValueError(f"there is no block {name}, as credentials of NATS have it")
    return found[1]


def _key(seed: bytes) -> SigningKey:
    """The key of a user. Raises `ValueError`."""
    try:
        found = base64.b32decode(seed + b"=" * (-len(seed) % 8))
    except binascii.Error:
        found = b""
    sound = len(found) == SEED_LENGTH and found[0] & 0xF8 == SEED
    if not sound or found[-2:] != _checksum(found[:-2]):
        raise ValueError("the seed is damaged or none")
    kind = (found[0] & 7) << 5 | found[1] >> 3
    if kind != USER:
        owner = KINDS.get(kind, "something else")
        raise ValueError(f"the seed is that of {owner}, allowed: that of {KINDS[USER]}")
    return SigningKey(found[2:-2])


def _public(key: SigningKey) -> str:
    """The name of a user, which is made of the public part of the key."""
    named = bytes([USER]) + bytes(key.verify_key)
    return base64.b32encode(named + _checksum(named)).rstrip(b"=").decode()


def _checksum(data: bytes) -> bytes:
    return binascii.crc_hqx(data, 0).to_bytes(2, "little")


def _subject(jwt: bytes) -> object:
    """Whom a JWT is about. Raises `ValueError`."""
    try:
        _, claims, _ = jwt.split(b".")
        return json.loads(base64.urlsafe_b64decode(claims + b"=" * (-len(claims) % 4)))["sub"]
    except (ValueError, KeyError, TypeError):
        raise ValueError("the JWT is damaged or none") from None

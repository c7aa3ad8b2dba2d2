"""NATS operators, accounts and users, with keys and JWTs in the formats of `nsc`."""

from __future__ import annotations

import base64
import binascii
import json
import time
from typing import TYPE_CHECKING, Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

if TYPE_CHECKING:
    from pathlib import Path

SEED, OPERATOR, ACCOUNT, USER = 18 << 3, 14 << 3, 0, 20 << 3

CREDENTIALS = """-----BEGIN NATS USER JWT-----
{jwt}
------END NATS USER JWT------

************************* IMPORTANT *************************
NKEY Seed printed below can be used to sign and prove identity.

-----BEGIN USER NKEY SEED-----
{seed}
------END USER NKEY SEED------
"""


class Key:
    """The key of an operator, an account or a user."""

    def __init__(self, kind: int) -> None:
        self._key = Ed25519PrivateKey.generate()
        self.name = _text(bytes([kind]) + self._key.public_key().public_bytes_raw())
        self.seed = _text(
            bytes([SEED | kind >> 5, (kind & 31) << 3]) + self._key.private_bytes_raw()
        )

    def sign(self, text: str) -> bytes:
        return self._key.sign(text.encode())

    def jwt(self, subject: Key, type: str, claims: dict[str, Any], **more: Any) -> str:
        """Signs a JWT about another key."""
        nats = {"type": type, "version": 2, **claims}
        now = int(time.time())
        body = {"iss": self.name, "sub": subject.name, "iat": now, "nats": nats, **more}
        head = {"typ": "JWT", "alg": "ed25519-nkey"}
        text = f"{_base64(json.dumps(head).encode())}.{_base64(json.dumps(body).encode())}"
        return f"{text}.{_base64(self.sign(text))}"


class User:
    """A user of an account. `more` are additional claims, such as `exp`."""

    def __init__(
        self, account: Key, permissions: dict[str, Any] | None = None, **more: Any
    ) -> None:
        self.key = Key(USER)
        claims = {"subs": -1, "data": -1, "payload": -1, **(permissions or {})}
        self.jwt = account.jwt(self.key, "user", claims, **more)

    @property
    def options(self) -> dict[str, Any]:
        """Returns options for `Client.connect`."""
        return {
            "signature_cb": lambda nonce: base64.b64encode(self.key.sign(nonce)),
            "user_jwt_cb": self.jwt.encode,
        }

    def write(self, file: Path) -> Path:
        """Writes the credentials to a file and returns it."""
        return written(file, self.jwt, self.key.seed)


class Operator:
    """An operator with its accounts, and the configuration of a server that trusts it."""

    def __init__(self) -> None:
        self._key = Key(OPERATOR)
        self._accounts: dict[str, str] = {}
        self._system = self.account()
        self.plant = self.account()
        """An account without JetStream."""

    def account(self, **limits: int) -> Key:
        """Creates an account. Servers configured afterwards know it."""
        account = Key(ACCOUNT)
        unlimited = dict.fromkeys(("subs", "conn", "data", "payload", "imports", "exports"), -1)
        claims = {"limits": {**unlimited, "wildcards": True, **limits}}
        self._accounts[account.name] = self._key.jwt(account, "account", claims)
        return account

    def configure(self, file: Path) -> Path:
        """Writes the server's configuration to a file and returns it."""
        accounts = "\n".join(f"  {name}: {jwt}" for name, jwt in self._accounts.items())
        file.write_text(
            f"operator: {self._key.jwt(self._key, 'operator', {})}\n"
            f"system_account: {self._system.name}\n"
            f"resolver: MEMORY\nresolver_preload: {{\n{accounts}\n}}\n"
        )
        return file


def written(file: Path, jwt: str, seed: str) -> Path:
    """Writes credentials to a file and returns it."""
    file.write_text(CREDENTIALS.format(jwt=jwt, seed=seed))
    return file


def _text(data: bytes) -> str:
    checksum = binascii.crc_hqx(data, 0).to_bytes(2, "little")
    return base64.b32encode(data + checksum).rstrip(b"=").decode()


def _base64(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()

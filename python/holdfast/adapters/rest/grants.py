"""What the tokens of REST grant: memories, areas, writes, and managing the appliance.

Which operations need a token, or one that may manage, is in the table of `operations`. Whether a
command is within its grant, the memory access checks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.ingest import Grant
from holdfast.net.http.requests import BadRequest
from holdfast.types import AREAS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.config.models.services import RestConfig

ANYONE = "anyone"
"""The name of the client when no tokens are configured."""


class Grants:
    """The grants of a configuration, by the names of tokens."""

    def __init__(self, settings: RestConfig, memories: Iterable[str]) -> None:
        tokens = () if settings.tokens == "none" else settings.tokens
        self.secrets = [(token.name, bytes.fromhex(token.sha256)) for token in tokens]
        """The SHA-256 hash of each token; without any, everyone is `ANYONE`."""
        self._managers = {token.name for token in tokens if token.manage}
        self._grants = {
            token.name: Grant(
                token.name,
                frozenset(token.memories),
                frozenset(token.areas),
                token.access == "read-write",
                frozenset(token.while_sealed or ()),
            )
            for token in tokens
        }
        if not tokens:
            self._grants[ANYONE] = Grant(ANYONE, frozenset(memories), frozenset(AREAS))

    def of(self, who: str) -> Grant:
        """What a client is granted."""
        return self._grants[who]

    def check_writer(self, who: str) -> None:
        """Raises `BadRequest` for a client that may not write."""
        if not self._grants[who].writes:
            raise BadRequest("not_granted", f"{who} may not write")

    def check_manager(self, who: str) -> None:
        """Raises `BadRequest` for a client that may not manage the appliance."""
        if who not in self._managers:
            detail = f"{who} may not manage sessions, allowed: tokens with manage: true"
            raise BadRequest("not_granted", detail)

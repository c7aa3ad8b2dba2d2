"""Whose request it is: the token in `Authorization: Bearer TOKEN` (RFC 6750).

Which operations need none is in the table of each service: `Operation.is_public`.
"""

from __future__ import annotations

import hashlib
import hmac
from typing import TYPE_CHECKING

from holdfast.net.http.requests import BadRequest

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.net.http.requests import Request


def owner(request: Request, tokens: Iterable[tuple[str, bytes]]) -> str:
    """Returns the name of the request's token. Raises `BadRequest` if there is none.

    `tokens` are names and SHA-256 hashes.
    """
    found = request.values(b"authorization")
    if len(found) != 1:
        detail = "more than one Authorization header" if found else "no Authorization header"
        raise BadRequest("unauthorized", f"{detail}, required: Authorization: Bearer TOKEN")
    scheme, _, secret = found[0].partition(b" ")
    if scheme.lower() != b"bearer":
        raise BadRequest("unauthorized", "Authorization is not of the form Bearer TOKEN")
    secret = secret.strip()
    if not secret:  # Whatever the hashes are, an unset variable is nobody's token.
        raise BadRequest("unauthorized", "the token is empty")
    digest = hashlib.sha256(secret).digest()
    name = None
    for each, known in tokens:  # Compares all of them, so the time reveals nothing.
        if hmac.compare_digest(known, digest):
            name = each
    if name is None:
        raise BadRequest("unauthorized", "unknown token")
    return name

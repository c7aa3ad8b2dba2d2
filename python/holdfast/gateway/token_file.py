"""The token file of the gateway: names and SHA-256 hashes, one token per line."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, TypeAlias

from holdfast.config.values.scalars import TOKEN_NAME_FORM, is_token_name, parse_token_hash
from holdfast.net.secret_file import read_bytes

if TYPE_CHECKING:
    from pathlib import Path

Token: TypeAlias = tuple[str, bytes]
"""A name and a SHA-256."""

FORM = "NAME SHA256 or SHA256, as `holdfast token --line` prints it"

_HASH = re.compile("[0-9a-fA-F]{64}")


class WrongTokens(Exception):
    """The token file is invalid. The message has the line number, never the line."""


def load(file: Path) -> list[Token]:
    """Reads a token file; `#` starts a comment. Raises `OSError` and `WrongTokens`."""
    try:
        lines = read_bytes(file).decode().splitlines()
    except UnicodeDecodeError:
        raise WrongTokens(f"{file}: not UTF-8") from None
    tokens: list[Token] = []
    for number, line in enumerate(lines, start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            token = _token(words, number)
        except ValueError as error:
            raise WrongTokens(f"{file}:{number}: {error}") from None
        for name, digest in tokens:
            if name == token[0] or digest == token[1]:
                raise WrongTokens(f"{file}:{number}: duplicate name or token")
        tokens.append(token)
    if not tokens:
        raise WrongTokens(f"{file}: no token, allowed: lines {FORM}")
    return tokens


def _token(words: list[str], number: int) -> Token:
    *names, digest = words
    if len(names) > 1 or not _HASH.fullmatch(digest):
        raise ValueError(f"no token, allowed: {FORM}")
    name = names[0] if names else f"token-{number}"
    if not is_token_name(name):
        raise ValueError(f"the name of a token is {TOKEN_NAME_FORM}")
    return name, bytes.fromhex(parse_token_hash(digest))

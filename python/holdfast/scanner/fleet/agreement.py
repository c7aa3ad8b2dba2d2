"""What all nodes of a fleet have in common."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import TYPE_CHECKING, Self

import msgspec

from holdfast.config.values.scanner_settings import written_pollable

if TYPE_CHECKING:
    from holdfast.scanner.settings import FleetSettings, Settings
    from holdfast.tags import TagList

PROTOCOL = 2
"""The version of the buckets and messages that nodes share."""


class FleetRefused(Exception):
    """The node can't be a part of the fleet with these settings."""


def digest(terms: bytes) -> str:
    """What a node shows of its terms."""
    return hashlib.blake2b(terms, digest_size=8).hexdigest()


def _tags_digest(profile: TagList) -> str:
    # Each process has its own order of the texts in a set.
    plain = [(replace(tag, null=frozenset()), sorted(map(repr, tag.null))) for tag in profile]
    return digest(repr(plain).encode())


class Terms(msgspec.Struct, frozen=True, kw_only=True):
    """The settings that all nodes have in common: any of them answers any request."""

    protocol: int
    partitions: int
    prefix: str
    allow: list[str]
    writes: str
    strict: bool
    defaults: str
    limits: str
    profiles: str
    """With a digest of the tags of each: subscriptions contain only its name, so nodes with other
    tags would write to other registers."""

    @classmethod
    def of(cls, settings: Settings, fleet: FleetSettings) -> Self:
        """The terms of a node with these settings."""
        return cls(
            protocol=PROTOCOL,
            partitions=fleet.partitions,
            prefix=settings.prefix,
            allow=sorted(map(written_pollable, settings.allow)),
            writes=settings.writes,
            strict=settings.strict,
            defaults=str(settings.defaults),
            limits=str(settings.limits),
            profiles=",".join(
                f"{name} (tags {_tags_digest(profile)})"
                for name, profile in sorted(settings.profiles.items())
            ),
        )

    def encoded(self) -> bytes:
        """How they are stored."""
        return msgspec.json.encode(self)

    def difference(self, other: Terms) -> str | None:
        """The first setting in which the other terms differ, with both values."""
        for key in self.__struct_fields__:
            own, theirs = getattr(self, key), getattr(other, key)
            if key == "profiles":
                own, theirs = _others(own, theirs), _others(theirs, own)
            if own != theirs:
                return f"{key} is {own}, and {theirs} in the fleet"
        return None


def _others(profiles: str, known: str) -> str:
    """The profiles that are not known in the same form."""
    return ",".join(sorted({*profiles.split(",")} - {*known.split(",")})) or "no others"

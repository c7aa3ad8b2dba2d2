"""The files that settings name, and digests of settings with the contents of these files."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holdfast.config.models.base import Model
from holdfast.runtime import bounded_files

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.config.models.root import Config
    from holdfast.net.tls import Tls


MAX_BYTES = 8 << 20
"""The size limit of a file. Only initial values of a memory with `files` can be larger."""


def files_of(file: Path, config: Config) -> list[Path]:
    """A configuration, and the files that it names."""
    return list(dict.fromkeys([file, *config.profile_files, *_files(config)]))


def fingerprint(*settings: object) -> str:
    """A digest of settings and of the files that they name. An unreadable file counts as empty."""
    digest = hashlib.sha256()
    for each in settings:
        plain = each.model_dump() if isinstance(each, Model) else each
        digest.update(repr(plain).encode())
        for file in _files(each):
            try:
                content = bounded_files.read(file, MAX_BYTES)
            except OSError:
                content = b""
            digest.update(hashlib.sha256(content).digest())
    return digest.hexdigest()


def tls_of_url(settings: Model) -> Tls | None:
    """The TLS files in the URL of a device, a link or a receiver; `None` for other settings."""
    # The `target` of a receiver is the unit id of its packets.
    url = getattr(settings, "receiver", None) or getattr(settings, "target", None)
    tls: Tls | None = getattr(url, "tls", None)
    return tls


def _files(value: Any) -> Iterator[Path]:
    """The files that settings name: as a path, or in the URL of a device or receiver."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, Model):
        if (tls := tls_of_url(value)) is not None:
            yield from (Path(file) for _, file in tls.files())
        for name in type(value).model_fields:
            if name not in value.own_files:
                yield from _files(getattr(value, name))
    elif isinstance(value, dict):
        for each in value.values():
            yield from _files(each)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _files(each)

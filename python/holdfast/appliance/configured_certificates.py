"""The certificates that a configuration names: when they expire, and doubts about them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, TypeAlias

from holdfast.client.url import NetworkTarget
from holdfast.config import HTTP_SERVICES, tls_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from holdfast.client.url import Target
    from holdfast.config import ClientTlsConfig, Config
    from holdfast.config.source import KeyPath
    from holdfast.net.tls import Tls

    Kind: TypeAlias = Literal["server", "certificates", "revocation lists"]

CLIENTS = (("mqtt", "tls"), ("nats", "tls"), ("nats", "device_tls"), ("gateway", "device_tls"))
"""The keys with certificates of clients."""


@dataclass(frozen=True)
class Expiries:
    """The earliest expiry in each configured file, in seconds of Unix time."""

    certificates: Mapping[str, float] = field(default_factory=dict)
    revocation_lists: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Named:
    """A file, and the key of the configuration that names it."""

    place: KeyPath
    file: str
    kind: Kind
    by_core: bool = False
    """Whether the core also reads it, and warns when it is not valid."""


def expiries(config: Config) -> Expiries:
    """Reads when the configured certificates and revocation lists expire."""
    made: dict[Kind, dict[str, float]] = {"certificates": {}, "revocation lists": {}}
    for each in _named(config):
        from holdfast.certificates import expiry

        lists = each.kind == "revocation lists"
        dates = (expiry.of_revocation_lists if lists else expiry.of_certificates)(each.file)
        if dates:
            kind: Kind = "revocation lists" if lists else "certificates"
            made[kind][each.file] = min(one.ends.timestamp() for one in dates)
    return Expiries(made["certificates"], made["revocation lists"])


def doubts(config: Config) -> list[tuple[KeyPath, str]]:
    """Returns what is doubtful about the certificates: each key and a warning."""
    found: dict[str, tuple[KeyPath, str]] = {}
    for each in _named(config):
        from holdfast.certificates import expiry
        from holdfast.certificates.own import nameless

        lists = each.kind == "revocation lists"
        dates = (expiry.of_revocation_lists if lists else expiry.of_certificates)(each.file)
        now = expiry.now()
        texts = [one.doubt(now) for one in dates if one.is_valid(now) or not each.by_core]
        if each.kind == "server":
            texts.append(nameless(each.file))
        for text in texts:
            if text is not None:
                told = f"{each.file}: {text}"
                found.setdefault(told, (each.place, told))
    return list(found.values())


def _named(config: Config) -> Iterator[_Named]:
    for name, listener in config.listeners.items():
        tls = tls_of(listener)
        if tls is not None:
            place: KeyPath = ("listeners", name, "tls")
            yield from _of_server(place, tls.cert_file, tls.crl_file, "ca_file", tls.ca_file)
    for name in HTTP_SERVICES:
        service = getattr(config, name)
        if service is not None and service.tls is not None:
            of = service.tls
            yield from _of_server(
                (name, "tls"), of.cert_file, of.crl_file, "client_ca_file", of.client_ca_file
            )
    for section, part in CLIENTS:
        client: ClientTlsConfig | None = getattr(getattr(config, section), part, None)
        for key in ("ca_file", "cert_file"):
            file: Path | None = getattr(client, key, None)
            if file is not None:
                yield _Named((section, part, key), str(file), "certificates")
    for name, device in config.devices.items():
        yield from _of_url(("devices", name, "url"), device.target)
        for index, forward in enumerate(device.forward):
            yield from _of_client(("devices", name, "forward", index, "url"), forward.receiver.tls)
    for name, link in config.links.items():
        yield from _of_url(("links", name, "url"), link.target)


def _of_server(
    place: KeyPath, cert_file: Path, crl_file: Path | None, ca_key: str, ca_file: Path | None
) -> Iterator[_Named]:
    yield _Named((*place, "cert_file"), str(cert_file), "server", by_core=True)
    if ca_file is not None:
        yield _Named((*place, ca_key), str(ca_file), "certificates", by_core=True)
    if crl_file is not None:
        yield _Named((*place, "crl_file"), str(crl_file), "revocation lists", by_core=True)


def _of_url(place: KeyPath, target: Target) -> Iterator[_Named]:
    if isinstance(target, NetworkTarget):
        yield from _of_client(place, target.tls)


def _of_client(place: KeyPath, tls: Tls | None) -> Iterator[_Named]:
    for file in () if tls is None else (tls.ca, tls.cert):
        if file is not None:
            yield _Named(place, file, "certificates")

"""The certificates that a configuration names: warnings, and when they expire."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from holdfast.appliance.parts.part import Part
from holdfast.config.fingerprint import tls_of_url
from holdfast.config.models.base import Model
from holdfast.config.models.server_tls import HttpsConfig, ServerTlsConfig
from holdfast.events import log_lines
from holdfast.net.certificates import EXPIRY_NOTICE
from holdfast.runtime import extras

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from holdfast.appliance.parts.part import Plan
    from holdfast.config import Config
    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.net.certificates.expiry import Expiry

Kind: TypeAlias = Literal["server", "certificates", "revocation_lists"]

Expiries: TypeAlias = "dict[str, dict[str, float]]"
"""The earliest expiry in each configured file, in seconds of Unix time, by the kind of files."""

REPEAT_S = 24 * 3600.0
"""A certificate is logged again after this time."""

KINDS: dict[str, Kind] = {
    "cert_file": "certificates",
    "ca_file": "certificates",
    "client_ca_file": "certificates",
    "crl_file": "revocation_lists",
}
"""The keys of files that expire, with the kind of their files; a `cert_file` of a TLS server is of
the kind `server`."""


@dataclass(frozen=True)
class _Named:
    """A file, and the key of the configuration that names it."""

    place: KeyPath
    file: str
    kind: Kind
    by_core: bool = False
    """Whether the core also reads it, and warns when it is not valid."""


class CertificateExpiry(Part):
    """The expiries of all configured files. Each is logged once a day."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self._expiries: Expiries = {}
        self._logged: dict[tuple[str, str, str], float] = {}

    def prepare(self, plan: Plan) -> Callable[[], None]:
        """Reads the files of the configuration."""
        found = expiries(plan.config)

        def adopt() -> None:
            self._expiries = found

        return adopt

    def tick(self) -> None:
        """Logs what is due."""
        self.log_due(self._expiries, time.time())

    def stats(self) -> Mapping[str, Any]:
        """When each file expires, in seconds of Unix time."""
        return self._expiries

    def log_due(self, expiries: Expiries, now: float) -> None:
        """Logs what is due at a Unix time."""
        for kinds, ends in expiries.items():
            kind = kinds.removesuffix("s").replace("_", " ")
            for file, end in ends.items():
                if end - now > EXPIRY_NOTICE.total_seconds():
                    continue
                event = "certificate_expired" if end <= now else "certificate_expires"
                logged = self._logged.get((event, kind, file))
                # The clock may have been set back.
                if logged is not None and 0 <= now - logged < REPEAT_S:
                    continue
                self._logged[event, kind, file] = now
                level = logging.ERROR if end <= now else logging.WARNING
                expires = log_lines.timestamp(end)
                log_lines.write(level, event, kind=kind, file=file, expires=expires)


def expiries(config: Config) -> Expiries:
    """Reads when the configured certificates and revocation lists expire."""
    found: Expiries = {"certificates": {}, "revocation_lists": {}}
    for each in _named(config):
        if dates := _dates(each):
            kind = "certificates" if each.kind == "server" else each.kind
            found[kind][each.file] = min(one.ends.timestamp() for one in dates)
    return found


def warnings(config: Config) -> list[tuple[KeyPath, str]]:
    """Returns warnings about the certificates, each with its key."""
    found: dict[str, tuple[KeyPath, str]] = {}
    reason = extras.missing("certs")
    for each in _named(config):
        if reason is not None:
            return [(each.place, f"checking the dates of certificates {reason}")]
        from holdfast.net.certificates import expiry

        now = expiry.now()
        texts = [one.warning(now) for one in _dates(each) if one.is_valid(now) or not each.by_core]
        if each.kind == "server":
            texts.append(expiry.missing_name_warning(each.file))
        for text in texts:
            if text is not None:
                warning = f"{each.file}: {text}"
                found.setdefault(warning, (each.place, warning))
    return list(found.values())


def _dates(named: _Named) -> list[Expiry]:
    if extras.missing("certs") is not None:
        return []
    from holdfast.net.certificates import expiry

    if named.kind == "revocation_lists":
        return expiry.of_revocation_lists(named.file)
    return expiry.of_certificates(named.file)


def _named(settings: object, place: KeyPath = ()) -> Iterator[_Named]:
    """The files that expire: in all sections of the configuration, and in URLs."""
    if isinstance(settings, Model):
        if (tls := tls_of_url(settings)) is not None:
            for file in (tls.ca, tls.cert):
                if file is not None:
                    yield _Named((*place, "url"), file, "certificates")
        is_server = isinstance(settings, ServerTlsConfig | HttpsConfig)
        for key in type(settings).model_fields:
            value = getattr(settings, key)
            if key not in KINDS:
                yield from _named(value, (*place, key))
            elif value is not None:
                kind = "server" if is_server and key == "cert_file" else KINDS[key]
                yield _Named((*place, key), str(value), kind, by_core=is_server)
    elif isinstance(settings, dict):
        for key, value in settings.items():
            yield from _named(value, (*place, key))
    elif isinstance(settings, list | tuple):
        for index, value in enumerate(settings):
            yield from _named(value, (*place, index))

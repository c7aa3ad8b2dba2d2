"""Creates CAs and certificates with openssl."""

from __future__ import annotations

import os
import subprocess
from typing import TYPE_CHECKING, NamedTuple

from support.machine import tool

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

ROLE = "1.3.6.1.4.1.50316.802.1"
"""The extension for a role (Modbus/TCP Security)."""

PAST = ("20200101000000Z", "20200201000000Z")
FUTURE = ("20900101000000Z", "20910101000000Z")

CONFIGURATION = """\
[ca]
default_ca = this
[this]
database = {folder}/{name}.index
new_certs_dir = {folder}
rand_serial = yes
unique_subject = no
default_md = sha256
default_days = 90
default_crl_days = 90
policy = names
{lists}[names]
commonName = supplied
[list]
authorityKeyIdentifier = keyid
"""


LISTS = {
    "authority key identifier": "crl_extensions = list\n",
    "CRL number": "crlnumber = {folder}/{name}.number\n",
}
"""What adds each extension to revocation lists. Without any, OpenSSL writes lists of version 1."""


class Issued(NamedTuple):
    """The files of a certificate and its key."""

    certificate: Path
    key: Path


def named(role: str, kind: str = "UTF8String") -> str:
    """Returns the extension with a role."""
    return f"{ROLE}=ASN1:{kind}:{role}"


class Certificates:
    """A CA, and certificates that it issues."""

    def __init__(
        self, folder: Path, name: str = "authority", lists_have: Iterable[str] = LISTS
    ) -> None:
        self._folder = folder
        self._name = name
        self.ca = folder / f"{name}.pem"
        self.key = folder / f"{name}.key"
        (folder / f"{name}.index").touch()
        self._configuration = folder / f"{name}.cnf"
        self.configure_lists(lists_have)
        (folder / f"{name}.number").write_text("01\n")
        openssl(
            *("req", "-x509", *_new_key("P-256"), "-nodes"),
            *("-keyout", self.key, "-out", self.ca, "-days", "90", "-subj", f"/CN={name}"),
            *("-addext", "keyUsage=critical,keyCertSign,cRLSign"),
        )

    def configure_lists(self, have: Iterable[str]) -> None:
        """Sets which extensions of `LISTS` its lists have from now on."""
        of = {"folder": self._folder, "name": self._name}
        lists = "".join(LISTS[each].format(**of) for each in have)
        self._configuration.write_text(CONFIGURATION.format(**of, lists=lists))

    def issue(
        self,
        name: str,
        alternative: str,
        *options: str,
        extensions: Sequence[str] = (),
        dates: tuple[str, str] | None = None,
        curve: str = "P-256",
    ) -> Issued:
        """Issues a certificate and its key; `alternative` is such as `IP:127.0.0.1`."""
        certificate, key, request, file = (
            self._folder / f"{self._name}-{name}.{end}" for end in ("pem", "key", "csr", "ext")
        )
        more = (f"subjectAltName={alternative}", "authorityKeyIdentifier=keyid", *extensions)
        file.write_text("\n".join([*more, ""]))
        openssl(
            *("req", *_new_key(curve)),
            *(options or ("-nodes",)),
            *("-keyout", key, "-out", request, "-subj", f"/CN={name}"),
        )
        self._ca(
            *("-batch", "-notext", "-in", request, "-out", certificate, "-extfile", file),
            *_from_to(dates),
        )
        return Issued(certificate, key)

    def revoke(
        self,
        *issued: Issued,
        dates: tuple[str, str] | None = None,
        reason: str | None = None,
    ) -> Path:
        """Revokes these certificates. Returns the list of all revoked certificates."""
        revoked = self._folder / f"{self._name}.crl"
        why = () if reason is None else ("-crl_reason", reason)
        for each in issued:
            self._ca("-revoke", each.certificate, *why)
        of = () if dates is None else ("-crl_lastupdate", dates[0], "-crl_nextupdate", dates[1])
        self._ca("-gencrl", "-out", revoked, *of)
        return revoked

    def _ca(self, *arguments: str | Path) -> None:
        who = ("-config", self._configuration, "-cert", self.ca, "-keyfile", self.key)
        openssl("ca", *who, *arguments)


def self_signed(
    folder: Path, name: str, *extensions: str, dates: tuple[str, str] | None = None
) -> Issued:
    """Creates a self-signed certificate."""
    issued = Issued(folder / f"{name}.pem", folder / f"{name}.key")
    configuration, request, file = (folder / f"{name}.{end}" for end in ("cnf", "csr", "ext"))
    (folder / f"{name}.index").touch()
    configuration.write_text(CONFIGURATION.format(folder=folder, name=name, lists=""))
    file.write_text("\n".join(["basicConstraints=CA:FALSE", *extensions, ""]))
    openssl(
        *("req", *_new_key("P-256"), "-nodes", "-subj", f"/CN={name}"),
        *("-keyout", issued.key, "-out", request),
    )
    openssl(
        *("ca", "-batch", "-notext", "-selfsign", "-config", configuration),
        *("-keyfile", issued.key, "-in", request, "-extfile", file, "-out", issued.certificate),
        *_from_to(dates),
    )
    return issued


def _from_to(dates: tuple[str, str] | None) -> tuple[str, ...]:
    return () if dates is None else ("-startdate", dates[0], "-enddate", dates[1])


def _new_key(curve: str) -> tuple[str, ...]:
    return ("-newkey", "ec", "-pkeyopt", f"ec_paramgen_curve:{curve}")


def openssl(*arguments: str | Path) -> None:
    subprocess.run(
        [tool("openssl"), *map(str, arguments)],
        check=True,
        capture_output=True,
        env=os.environ | {"RANDFILE": os.devnull},
    )

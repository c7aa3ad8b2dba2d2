"""Certificates of every kind, created with openssl, and the expected answer for each.

`docs/modbus-tls.md` explains the answers. All clients and listeners give the same ones.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from support.certificates import FUTURE, PAST, Issued, openssl

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

ACCEPTED = "accepted"
"""A client accepts the device's certificate. Other answers are reasons of a failure."""

SERVED = "served"
"""A listener accepts the client's certificate. Other answers are the `reason` of `tls_failed`."""

NAME = "subjectAltName=IP:127.0.0.1"
CA = "basicConstraints=critical,CA:TRUE"
NO_CA = "basicConstraints=CA:FALSE"
SIGNS = "keyUsage=critical,keyCertSign,cRLSign"

_PSS = ("RSA-PSS", "-pkeyopt", "rsa_keygen_bits:2048", "-pkeyopt")
_PSS_HASH = ("rsa_pss_keygen_md:{0}", "-pkeyopt", "rsa_pss_keygen_mgf1_md:{0}")
KEYS = {
    "P-256": ("EC", "-pkeyopt", "ec_paramgen_curve:P-256"),
    "P-384": ("EC", "-pkeyopt", "ec_paramgen_curve:P-384"),
    "P-521": ("EC", "-pkeyopt", "ec_paramgen_curve:P-521"),
    "Ed25519": ("ED25519",),
    "RSA": ("RSA", "-pkeyopt", "rsa_keygen_bits:2048"),
    "RSA 1024": ("RSA", "-pkeyopt", "rsa_keygen_bits:1024"),
    "RSA-PSS": ("RSA-PSS", "-pkeyopt", "rsa_keygen_bits:2048"),
}
for _hash, _salt in (("sha256", 32), ("sha384", 48), ("sha512", 64)):
    _named = (*_PSS, *(part.format(_hash) for part in _PSS_HASH))
    KEYS[f"RSA-PSS {_hash}"] = (*_named, "-pkeyopt", f"rsa_pss_keygen_saltlen:{_salt}")
    KEYS[f"RSA-PSS {_hash}, any salt"] = _named
"""Arguments of `openssl genpkey` for each kind of key."""

OWN_KEYS = [kind for kind in KEYS if kind != "RSA 1024"]
"""Kinds of keys that Holdfast itself may use."""

SALT_OF_HASH = ("-sigopt", "rsa_pss_saltlen:digest")
SALT_OF_KEY = ("-sigopt", "rsa_pss_saltlen:max")
WITH_PSS = ("-sigopt", "rsa_padding_mode:pss")


class Shown(NamedTuple):
    """The certificate chain of a peer, its own first, and the CAs that the other side trusts."""

    chain: Path
    key: Path
    trusted: Path


Show = Callable[["Mint"], Shown]


class Mint:
    """Creates certificates in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._made = 0

    @functools.cached_property
    def authority(self) -> Issued:
        return self.root()

    @functools.cached_property
    def stranger(self) -> Issued:
        return self.root(name="stranger")

    def root(self, *, extensions: Sequence[str] = (CA, SIGNS), **more: Any) -> Issued:
        return self.make(**{"name": "authority", "extensions": extensions, **more})

    def intermediate(
        self, *, by: Issued | None = None, extensions: Sequence[str] = (CA, SIGNS), **more: Any
    ) -> Issued:
        return self.make(by=by or self.authority, name="between", extensions=extensions, **more)

    def signed(
        self,
        *extensions: str,
        by: Issued | None = None,
        above: Sequence[Issued] = (),
        trusts: Sequence[Issued] | None = None,
        listed: bool = False,
        **more: Any,
    ) -> Shown:
        """Issues a certificate signed by `by`, default the CA; the signer is trusted."""
        by = by or self.authority
        leaf = self.make(by=by, extensions=_whole(extensions), **more)
        trusted = [by] if trusts is None else list(trusts)
        return self.shown([leaf, *above], [leaf] if listed else trusted)

    def own(self, *extensions: str, listed: bool = True, **more: Any) -> Shown:
        """Creates a self-signed certificate; trusts it if `listed`, otherwise the CA."""
        leaf = self.make(extensions=_whole(extensions), **more)
        return self.shown([leaf], [leaf if listed else self.authority])

    def shown(self, chain: Sequence[Issued], trusted: Sequence[Issued]) -> Shown:
        files = self._file("chain"), self._file("trusted")
        for file, listed in zip(files, (chain, trusted), strict=True):
            file.write_bytes(b"".join(each.certificate.read_bytes() for each in listed))
        return Shown(files[0], chain[0].key, files[1])

    def make(
        self,
        *,
        extensions: Sequence[str],
        by: Issued | None = None,
        name: str = "plc",
        key: str = "P-256",
        digest: str = "sha256",
        options: Sequence[str] = (),
        dates: tuple[str, str] | None = None,
    ) -> Issued:
        """Creates a certificate; without `by` it is self-signed."""
        issued = Issued(self._file("pem"), self._key(key))
        request = self._file("csr")
        openssl("req", "-new", "-key", issued.key, "-out", request, "-subj", f"/CN={name}")
        signer = ("-signkey", issued.key)
        if by is not None:
            signer = ("-CA", by.certificate, "-CAkey", by.key, "-set_serial", str(self._made))  # type: ignore[assignment]
        written = ("-in", request, "-out", issued.certificate, *self._extended(extensions))
        if dates is None:
            openssl("x509", "-req", *signer, "-days", "90", f"-{digest}", *options, *written)
        else:
            self._dated(issued, by, dates, written)
        return issued

    def _extended(self, extensions: Sequence[str]) -> tuple[str | Path, ...]:
        """Without extensions, openssl creates a version 1 certificate."""
        if not extensions:
            return ()
        file = self._file("ext")
        file.write_text("\n".join([*extensions, ""]))
        return "-extfile", file

    def _dated(
        self,
        issued: Issued,
        by: Issued | None,
        dates: tuple[str, str],
        written: tuple[str | Path, ...],
    ) -> None:
        configuration, index = self._file("cnf"), self._file("index")
        index.touch()
        configuration.write_text(
            f"[ca]\ndefault_ca=this\n[this]\ndatabase={index}\nnew_certs_dir={self._folder}\n"
            "rand_serial=yes\ndefault_md=sha256\npolicy=names\n[names]\ncommonName=supplied\n"
        )
        signer = ("-selfsign", "-keyfile", issued.key)
        if by is not None:
            signer = ("-cert", by.certificate, "-keyfile", by.key)  # type: ignore[assignment]
        valid = ("-startdate", dates[0], "-enddate", dates[1])
        openssl("ca", "-batch", "-notext", "-config", configuration, *signer, *valid, *written)

    def _key(self, kind: str) -> Path:
        """Creates a key. RSA keys are slow to create, so there is one of each kind."""
        file = self._folder / f"{kind}.key" if kind.startswith("RSA") else self._file("key")
        if not file.exists():
            algorithm, *options = KEYS[kind]
            openssl("genpkey", "-algorithm", algorithm, *options, "-out", file)
        return file

    def _file(self, end: str) -> Path:
        self._made += 1
        return self._folder / f"{self._made}.{end}"


def _whole(extensions: Sequence[str]) -> list[str]:
    """Adds the default name and CA flag, unless the extensions set them."""
    said = {extension.partition("=")[0] for extension in extensions}
    defaults = [default for default in (NAME, NO_CA) if default.partition("=")[0] not in said]
    return [*defaults, *(extension for extension in extensions if extension.partition("=")[2])]


@dataclass(frozen=True)
class Case:
    """A certificate, and the expected answers for a device and for a client that presents it."""

    name: str
    show: Show
    device: str = ACCEPTED
    client: str = SERVED

    def __str__(self) -> str:
        return self.name


def made(case: Case, mint: Mint, shown: dict[str, Shown]) -> Shown:
    """Creates a certificate, or takes it from those that were made before."""
    if case.name not in shown:
        shown[case.name] = case.show(mint)
    return shown[case.name]


def signed(*extensions: str, **more: Any) -> Show:
    return lambda mint: mint.signed(*extensions, **more)


def signed_by(*, options: Sequence[str] = (), **authority: Any) -> Show:
    return lambda mint: mint.signed(by=mint.root(**authority), options=options)


def own(*extensions: str, **more: Any) -> Show:
    return lambda mint: mint.own(*extensions, **more)


def below(*, sent: bool = True, **intermediate: Any) -> Show:
    """Issues a certificate below an intermediate CA."""
    return lambda mint: _through(mint, sent=sent, **intermediate)


def _through(mint: Mint, *, sent: bool = True, **intermediate: Any) -> Shown:
    between = mint.intermediate(**intermediate)
    root = intermediate.get("by", mint.authority)
    return mint.signed(by=between, above=[between] if sent else [], trusts=[root])


def _short_path(mint: Mint) -> Shown:
    return _through(mint, by=mint.root(extensions=(f"{CA},pathlen:0", SIGNS)))


def _other_names(mint: Mint) -> Shown:
    constraint = "nameConstraints=critical,permitted;IP:10.0.0.0/255.0.0.0"
    return mint.signed(by=mint.root(extensions=(CA, SIGNS, constraint)))


def _signed_by_device(mint: Mint, *extensions: str) -> Shown:
    device = mint.make(name="other", extensions=_whole(extensions))
    return mint.signed(by=device)


def _twin(mint: Mint) -> Shown:
    one, two = (mint.make(extensions=_whole([])) for _ in range(2))
    return mint.shown([one], [two])


def _impostor(mint: Mint) -> Shown:
    """Issues a certificate signed by another CA of the same name."""
    return mint.signed(by=mint.root(), trusts=[mint.root()])


def _wrong_order(mint: Mint) -> Shown:
    first = mint.intermediate()
    second = mint.make(by=first, name="second", extensions=(CA, SIGNS))
    return mint.signed(by=second, above=[first, second], trusts=[mint.authority])


UNSUPPORTED = ("unsupported_certificate",) * 2
UNKNOWN = ("unknown_issuer",) * 2
IS_CA = ("ca_as_end_entity",) * 2
NO_AUTHORITY = ("issuer_not_authority",) * 2
CONSTRAINED = ("constraint_violated",) * 2
UNNAMED = ("wrong_name", SERVED)
NOT_TO_SIGN = {"client": "wrong_key_usage"}


def _below_stranger(mint: Mint) -> Shown:
    return mint.signed(by=mint.stranger, trusts=[mint.authority])


def _listed_of_stranger(mint: Mint) -> Shown:
    return mint.signed(by=mint.stranger, listed=True)


def _below_listed_intermediate(mint: Mint) -> Shown:
    return mint.signed(by=mint.intermediate())


def _version_1(mint: Mint) -> Shown:
    return mint.shown([mint.make(by=mint.authority, extensions=())], [mint.authority])


CASES = [
    # Keys
    *(Case(f"{kind} key", signed(key=kind)) for kind in KEYS if kind != "RSA 1024"),
    Case("RSA key of 1024 bits", signed(key="RSA 1024"), *UNSUPPORTED),
    # Signatures
    Case("signed by P-384", signed_by(key="P-384")),
    Case("signed by P-521", signed_by(key="P-521")),
    Case("signed by Ed25519", signed_by(key="Ed25519")),
    Case("signed by RSA", signed_by(key="RSA")),
    Case(
        "signed by RSA with PSS",
        signed_by(key="RSA", options=(*WITH_PSS, *SALT_OF_HASH)),
    ),
    Case("signed by RSA-PSS", signed_by(key="RSA-PSS", options=SALT_OF_HASH)),
    Case("signed by RSA-PSS sha256", signed_by(key="RSA-PSS sha256")),
    Case(
        "signed by RSA-PSS with the longest salt",
        signed_by(key="RSA-PSS", options=SALT_OF_KEY),
        *UNSUPPORTED,
    ),
    Case("signed with SHA-512 by P-256", signed(digest="sha512")),
    Case("signed with SHA-1", signed(digest="sha1"), *UNSUPPORTED),
    # Self-signed
    Case("own", own()),
    Case("own, CA:TRUE", own(CA)),
    Case("own, CA:TRUE and keyCertSign", own(CA, SIGNS)),
    Case("own, CA:TRUE without keyCertSign", own(CA, "keyUsage=digitalSignature")),
    Case("own, without basicConstraints", own("basicConstraints=")),
    Case("own, P-521", own(key="P-521")),
    Case("own, RSA-PSS", own(key="RSA-PSS")),
    Case("own, SHA-1", own(key="RSA", digest="sha1")),
    Case("own, expired", own(dates=PAST), "expired", "expired"),
    Case("own, CA:TRUE, expired", own(CA, dates=PAST), "expired", "expired"),
    Case("own, for another name", own("subjectAltName=DNS:other"), *UNNAMED),
    Case(
        "own, for servers",
        own("extendedKeyUsage=serverAuth"),
        client="wrong_purpose",
    ),
    Case(
        "own, for clients",
        own("extendedKeyUsage=clientAuth"),
        device="wrong_purpose",
    ),
    Case("own, not listed", own(listed=False), *UNKNOWN),
    Case("own, CA:TRUE, not listed", own(CA, listed=False), *IS_CA),
    Case("own, its twin listed", _twin, *UNKNOWN),
    # Signed, unusual
    Case("CA:TRUE", signed(CA), *IS_CA),
    Case("CA:TRUE without keyCertSign", signed(CA, "keyUsage=digitalSignature"), *IS_CA),
    Case("CA:TRUE, listed", signed(CA, listed=True)),
    Case("of an unknown authority", _below_stranger, *UNKNOWN),
    Case("of an unknown authority, listed", _listed_of_stranger),
    Case("of an impostor", _impostor, "bad_signature", "bad_signature"),
    Case("keyUsage digitalSignature", signed("keyUsage=critical,digitalSignature")),
    Case("keyUsage nonRepudiation", signed("keyUsage=critical,nonRepudiation"), **NOT_TO_SIGN),
    Case(
        "keyUsage keyEncipherment",
        signed("keyUsage=critical,keyEncipherment", key="RSA"),
        **NOT_TO_SIGN,
    ),
    Case("keyUsage keyCertSign", signed("keyUsage=critical,keyCertSign"), **NOT_TO_SIGN),
    Case("keyUsage keyEncipherment, listed", own("keyUsage=critical,keyEncipherment", key="RSA")),
    Case("for servers", signed("extendedKeyUsage=serverAuth"), client="wrong_purpose"),
    Case("for clients", signed("extendedKeyUsage=clientAuth"), device="wrong_purpose"),
    Case("for both", signed("extendedKeyUsage=critical,serverAuth,clientAuth")),
    Case("for any purpose", signed("extendedKeyUsage=anyExtendedKeyUsage")),
    Case(
        "for signing code", signed("extendedKeyUsage=codeSigning"), "wrong_purpose", "wrong_purpose"
    ),
    Case("expired", signed(dates=PAST), "expired", "expired"),
    Case("not yet valid", signed(dates=FUTURE), "not_yet_valid", "not_yet_valid"),
    Case("for another name", signed("subjectAltName=DNS:other,IP:127.0.0.2"), *UNNAMED),
    Case("with a common name alone", signed("subjectAltName=", name="127.0.0.1"), *UNNAMED),
    Case(
        "with an unknown critical extension",
        signed("1.3.6.1.4.1.50316.802.9=critical,DER:0500"),
        "unsupported_extension",
        "unsupported_extension",
    ),
    Case("of X.509 version 1", _version_1, *UNSUPPORTED),
    # Chains
    Case("below an intermediate", below()),
    Case("below an intermediate that is listed", _below_listed_intermediate),
    Case("below two, in the wrong order", _wrong_order),
    Case("below an intermediate that is not sent", below(sent=False), *UNKNOWN),
    Case("below CA:FALSE", below(extensions=[NO_CA]), *NO_AUTHORITY),
    Case(
        "below CA:TRUE without keyCertSign",
        below(extensions=[CA, "keyUsage=critical,digitalSignature"]),
        *NO_AUTHORITY,
    ),
    Case("below an expired intermediate", below(dates=PAST), "issuer_expired", "issuer_expired"),
    Case("below an expired authority", signed_by(dates=PAST), "issuer_expired", "issuer_expired"),
    Case("below too many", _short_path, *CONSTRAINED),
    Case("outside the names of its authority", _other_names, *CONSTRAINED),
    Case("signed by a listed device", _signed_by_device, *UNKNOWN),
    Case(
        "signed by a listed device, CA:TRUE without keyCertSign",
        lambda mint: _signed_by_device(mint, CA, "keyUsage=critical,digitalSignature"),
        *UNKNOWN,
    ),
]

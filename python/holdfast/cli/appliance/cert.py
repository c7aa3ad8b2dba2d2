"""`holdfast cert`: makes, revokes and shows certificates."""

from __future__ import annotations

import functools
import re
import sys
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from holdfast.cli import SuggestingGroup
from holdfast.cli.exit_codes import ExitCode, fail
from holdfast.cli.options.option import (
    EXISTING_FILE,
    Command,
    choice,
    file_option,
    flag,
    json_option,
    number_option,
    option,
    option_group,
)
from holdfast.cli.terminal_text import plain, print_json
from holdfast.net.certificates import authority as making
from holdfast.net.certificates import inspection
from holdfast.net.certificates.parser import certificates, key_pem
from holdfast.net.certificates.pem import UnusableFile, content, is_locked, passphrase
from holdfast.runtime import whole_files
from holdfast.runtime.text import file_error_text

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from holdfast.net.certificates.authority import Authority, KeyKind
    from holdfast.net.certificates.inspection import Described
    from holdfast.net.certificates.parser import PrivateKey

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", re.ASCII)
"""A name of files. Names with other characters could lead out of the folder."""

CRL = "crl.pem"
RESERVED = ("ca", "crl")
"""Names of the files of the authority and of its revocation list."""
FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)


@dataclass(frozen=True)
class AuthorityFiles:
    """The values of the options for the files of the authority."""

    folder: Path
    ca_file: Path | None
    ca_key_file: Path | None
    ca_passphrase_file: Path | None

    def load(self) -> Authority:
        """The authority. Asks for the passphrase of its key, if it has one."""
        ca_file = self.ca_file or self.folder / "ca.pem"
        key_file = self.ca_key_file or ca_file.with_suffix(".key")
        secret = None
        if self.ca_passphrase_file is not None:
            secret = passphrase(self.ca_passphrase_file)
        elif is_locked(content(key_file)):
            secret = _prompt("Passphrase of the authority's key")
        return making.Authority.load(ca_file, key_file, secret)


@dataclass(frozen=True)
class NewKey:
    """The values of the options for a new key and its certificate."""

    days: int
    key_type: KeyKind
    asked: bool
    passphrase_file: Path | None

    def secret(self) -> bytes | None:
        """The passphrase of the new key, if it is to be encrypted."""
        if self.asked and self.passphrase_file is not None:
            raise click.UsageError("--passphrase and --passphrase-file can't be used together.")
        if self.passphrase_file is not None:
            return passphrase(self.passphrase_file)
        return _prompt("Passphrase of the new key", again=True) if self.asked else None


@click.group(cls=SuggestingGroup, epilog='Example: holdfast cert ca "Plant authority"')
def cert() -> None:
    """Make certificates for TLS, revoke them, and show what is in a file.

    `cert ca` makes an authority: the files ca.pem and ca.key. `cert server` and `cert client` make
    certificates that it signs. Keep ca.key on the machine that issues certificates.

    Exit codes: 0 done, 1 the file of `cert show` fails a requirement, 2 wrong usage or unusable
    files. Files are never overwritten, except the revocation list.
    """


_FOLDER = option("--folder", "FOLDER", "Folder of the files.", FOLDER, ".")
_CA = "The authority's certificate.  [default: ca.pem in the folder]"
_CA_KEY = "The authority's key.  [default: as --ca, with .key]"
_SECRET = "File that contains the passphrase of the authority's key.  [default: a prompt]"
_SAN = "DNS name or IP address that clients connect to; repeatable."
_AUTHORITY = option_group(
    _FOLDER,
    file_option("--ca ca_file", _CA, EXISTING_FILE),
    file_option("--ca-key ca_key_file", _CA_KEY, EXISTING_FILE),
    file_option("--ca-passphrase-file", _SECRET, EXISTING_FILE),
    into=("files", AuthorityFiles),
)


def _days(default: int, help: str) -> Callable[[Command], Command]:
    return number_option("--days", help, 1, 36500, default)


def _new_key(days: int) -> Callable[[Command], Command]:
    return option_group(
        _days(days, "Validity of the certificate."),
        choice("--key-type", "Kind of the key.", making.KEY_KINDS, "p256"),
        flag("--passphrase asked", "Encrypt the key; prompts for a passphrase."),
        file_option("--passphrase-file", "Encrypt it with the passphrase here.", EXISTING_FILE),
        into=("new", NewKey),
    )


_LIST = option_group(
    file_option("--crl crl_file", "The revocation list.  [default: crl.pem in the folder]"),
    _days(making.CRL_DAYS, "Time until the next list is due."),
)


def _reporting(command: Command) -> Command:
    """Turns errors about files into a message and exit code 2."""

    @functools.wraps(command)
    def reported(*args: Any, **given: Any) -> Any:
        try:
            return command(*args, **given)
        except (UnusableFile, making.Refused, FileExistsError) as error:
            fail(error, ExitCode.WRONG, reason="file")
        except OSError as error:
            fail(file_error_text(error), ExitCode.WRONG, reason="file")

    return reported  # type: ignore[return-value]


@cert.command(epilog='Example: holdfast cert ca "Plant authority"')
@click.argument("name")
@_FOLDER
@_new_key(making.CA_DAYS)
@_reporting
def ca(name: str, folder: Path, new: NewKey) -> None:
    """Make an authority: ca.pem and ca.key.

    NAME is its name in certificates. Whoever has ca.key can issue certificates with any role.
    """
    secret = new.secret()
    made = making.Authority.create(name, new.key_type, new.days)
    _write(folder, "ca", making.pem(*made.chain), key_pem(made.key, secret))


@cert.command(epilog="Example: holdfast cert server plc-1 --san 10.0.0.5 --san plc-1.plant.example")
@click.argument("name")
@option("--san names", "NAME|ADDRESS", _SAN, multiple=True, required=True)
@_AUTHORITY
@_new_key(making.LEAF_DAYS)
@_reporting
def server(name: str, names: tuple[str, ...], files: AuthorityFiles, new: NewKey) -> None:
    """Make the certificate of a server: NAME.pem and NAME.key.

    NAME.pem also has the certificates of the authority, as MB-TCP-Security requires.
    """
    _check_name(name)
    alternative = [making.alternative_name(each) for each in names]
    _issue(name, files, new, lambda ca, key: ca.issue_server(name, alternative, key, new.days))


@cert.command(epilog="Example: holdfast cert client panel-7 --role operator")
@click.argument("name")
@option("--role", "ROLE", "Role in the certificate, for the rules of listeners.")
@_AUTHORITY
@_new_key(making.LEAF_DAYS)
@_reporting
def client(name: str, role: str | None, files: AuthorityFiles, new: NewKey) -> None:
    """Make the certificate of a client: NAME.pem and NAME.key.

    The role is the one of MB-TCP-Security. Without --role, the certificate has the null role, ""
    in rules.
    """
    _check_name(name)
    _issue(name, files, new, lambda ca, key: ca.issue_client(name, role, key, new.days))


@cert.command(epilog="Example: holdfast cert revoke panel-7.pem")
@click.argument("revoked", nargs=-1, required=True, type=EXISTING_FILE, metavar="CERTIFICATE...")
@_AUTHORITY
@_LIST
@_reporting
def revoke(
    revoked: tuple[Path, ...], files: AuthorityFiles, crl_file: Path | None, days: int
) -> None:
    """Add certificates to the revocation list of their authority: crl.pem.

    The first certificate of each file is revoked. Entries stay in the list: do not lose it.
    """
    authority = files.load()
    serials: list[int] = []
    for file in revoked:
        own = certificates(file)[0]
        if not making.has_signed(authority.certificate, own):
            raise UnusableFile(file, "the authority has not issued this certificate")
        serials.append(own.serial_number)
    _write_list(authority, crl_file or files.folder / CRL, days, serials)


@cert.command(epilog="Example: holdfast cert crl --days 90")
@_AUTHORITY
@_LIST
@_reporting
def crl(files: AuthorityFiles, crl_file: Path | None, days: int) -> None:
    """Make or renew the revocation list of the authority: crl.pem, with the same entries."""
    _write_list(files.load(), crl_file or files.folder / CRL, days, [])


@cert.command(epilog="Example: holdfast cert show panel-7.pem")
@click.argument("file", type=EXISTING_FILE)
@file_option("--passphrase-file", "File with the passphrase of the key in FILE.", EXISTING_FILE)
@json_option
@_reporting
def show(file: Path, passphrase_file: Path | None, as_json: bool) -> None:
    """Show the certificates, keys and revocation lists in a PEM file.

    Names the requirements of MB-TCP-Security that a certificate fails, by number, and exits with 1
    if there are any. Never prints a key.
    """
    secret = None if passphrase_file is None else passphrase(passphrase_file)
    described = inspection.describe(file, secret)
    if as_json:
        flaws = [flaw for each in described for flaw in each.flaws]
        wrong = {"reason": "flaws", "detail": "; ".join(flaws)} if flaws else {}
        rows = [asdict(each) for each in described]
        head = {"ok": not flaws, "target": str(file)}
        print_json({**head, **wrong, "found": rows}, indent=2)
    else:
        click.echo(_as_text(described))
    if any(each.flaws for each in described):
        sys.exit(ExitCode.FAILED)


def _issue(
    name: str, of: AuthorityFiles, new: NewKey, sign: Callable[[Authority, PrivateKey], Any]
) -> None:
    """Makes a key and its certificate, and writes both."""
    authority = of.load()
    secret, key = new.secret(), making.new_key(new.key_type)
    made = sign(authority, key)
    _write(of.folder, name, making.pem(made, *authority.chain), key_pem(key, secret))


def _prompt(what: str, *, again: bool = False) -> bytes:
    if not sys.stdin.isatty():
        message = f"{what}: there is no terminal to ask on; use a file with the passphrase"
        fail(message, ExitCode.WRONG)
    text: str = click.prompt(what, hide_input=True, confirmation_prompt=again, err=True)
    return text.encode()


def _check_name(name: str) -> None:
    if not NAME.fullmatch(name) or name.lower() in RESERVED:
        form = "1 to 64 letters, digits, `_`, `.` and `-`, and neither `ca` nor `crl`"
        raise click.BadParameter(f"found {name!r}, allowed: {form}", param_hint="'NAME'")


def _write(folder: Path, name: str, chain: bytes, key: bytes) -> None:
    certificate_file, key_file = folder / f"{name}.pem", folder / f"{name}.key"
    whole_files.write_new(
        {key_file: (key, whole_files.SECRET), certificate_file: (chain, whole_files.PUBLIC)}
    )
    click.echo(f"Written: {certificate_file} and {key_file}.")


def _write_list(authority: Authority, file: Path, days: int, serials: list[int]) -> None:
    before = making.read_revocation_list(file) if file.exists() else None
    made = authority.revocation_list(before, serials, days)
    whole_files.replace(file, making.list_pem(made))
    count = len(made)
    noun = "1 certificate is" if count == 1 else f"{count} certificates are"
    click.echo(f"Written: {file}; {noun} revoked.")


LABELS = {
    "not_before": "valid from",
    "not_after": "valid to",
    "this_update": "made",
    "next_update": "next list due",
    "public_key_sha256": "public key sha256",
    "fits_certificate": "fits certificate",
}
DATES = ("not_before", "not_after", "this_update", "next_update")


def _as_text(described: Sequence[Described]) -> str:
    """Returns the lines of `holdfast cert show`."""
    parts = []
    for each in described:
        shown = {key: value for key, value in each.fields.items() if key != "authority"}
        labels = {key: LABELS.get(key, key) for key in shown}
        width = max(map(len, labels.values()))
        lines = [each.kind]
        lines += [f"  {labels[key]:{width}}  {_shown(key, shown[key])}" for key in shown]
        lines += [f"  fails: {plain(flaw)}" for flaw in each.flaws]
        lines += [f"  note: {plain(text)}" for text in each.advice]
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def _shown(key: str, value: Any) -> str:
    if key in DATES and value is not None:
        return f"{datetime.fromisoformat(value):%Y-%m-%d %H:%M} UTC"
    if key == "revoked":
        return "\n    ".join(["", *map(_revoked, value)]) if value else "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return plain(", ".join(map(str, value)))
    return "none" if value is None else plain(str(value))


def _revoked(entry: dict[str, str]) -> str:
    date = f"{datetime.fromisoformat(entry['date']):%Y-%m-%d %H:%M} UTC"
    return f"{entry['serial']}  {date}  {entry['reason']}"

"""`holdfast cert`: makes, revokes and shows certificates."""

from __future__ import annotations

import functools
import json
import re
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from holdfast.certificates import authority as making
from holdfast.certificates import files, inspection
from holdfast.certificates.pem import UnusableFile, certificates, content, is_locked, passphrase
from holdfast.cli.cert_text import as_text
from holdfast.cli.configuration import WRONG
from holdfast.cli.suggesting import SuggestingGroup

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.certificates.authority import Authority, KeyKind, Reason

FAILED = 1
Command = TypeVar("Command", bound="Callable[..., Any]")
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", re.ASCII)
"""A name of files. Names with other characters could lead out of the folder."""

REASONS = {
    reason.value: reason
    for reason in making.Reason
    if reason.value not in ("certificateHold", "removeFromCRL")
}
FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)


@click.group(cls=SuggestingGroup, epilog='Example: holdfast cert ca "Plant authority"')
def cert() -> None:
    """Make certificates for TLS, revoke them, and show what is in a file.

    `cert ca` makes an authority: the files ca.pem and ca.key. `cert server` and `cert client` make
    certificates that it signs. Keep ca.key on the machine that issues certificates.

    Exit codes: 0 done, 1 the file of `cert show` fails a requirement, 2 wrong usage or unusable
    files. Files are never overwritten, except the revocation list.
    """


def _options(*options: Callable[[Command], Command]) -> Callable[[Command], Command]:
    def added(command: Command) -> Command:
        for option in reversed(options):
            command = option(command)
        return command

    return added


_FOLDER = click.option(
    "--folder",
    type=FOLDER,
    default=Path(),
    metavar="FOLDER",
    help="Folder of the files.  [default: the current folder]",
)
_AUTHORITY = _options(
    _FOLDER,
    click.option(
        "--ca",
        "ca_file",
        type=FILE,
        metavar="FILE",
        help="The authority's certificate.  [default: ca.pem in the folder]",
    ),
    click.option(
        "--ca-key",
        "ca_key_file",
        type=FILE,
        metavar="FILE",
        help="The authority's key.  [default: as --ca, with .key]",
    ),
    click.option(
        "--ca-passphrase-file",
        type=FILE,
        metavar="FILE",
        help="File that contains the passphrase of the authority's key.  [default: a prompt]",
    ),
)


def _new_key(days: int) -> Callable[[Command], Command]:
    return _options(
        click.option(
            "--days",
            type=click.IntRange(1, 36500),
            default=days,
            show_default=True,
            help="Validity of the certificate.",
        ),
        click.option(
            "--key-type",
            type=click.Choice(making.KEY_KINDS),
            default="p256",
            show_default=True,
            help="Kind of the key.",
        ),
        click.option(
            "--passphrase", "asked", is_flag=True, help="Encrypt the key; prompts for a passphrase."
        ),
        click.option(
            "--passphrase-file",
            type=FILE,
            metavar="FILE",
            help="Encrypt the key with the passphrase in this file.",
        ),
    )


_LIST = _options(
    click.option(
        "--crl",
        "crl_file",
        type=click.Path(dir_okay=False, path_type=Path),
        metavar="FILE",
        help="The revocation list.  [default: crl.pem in the folder]",
    ),
    click.option(
        "--days",
        type=click.IntRange(1, 36500),
        default=making.CRL_DAYS,
        show_default=True,
        help="Time until the next list is due.",
    ),
)


def _reporting(command: Command) -> Command:
    """Turns errors about files into a message and exit code 2."""

    @functools.wraps(command)
    def reported(*args: Any, **given: Any) -> Any:
        try:
            return command(*args, **given)
        except (UnusableFile, making.Refused) as error:
            _stop(str(error))
        except FileExistsError as error:
            _stop(str(error))
        except OSError as error:
            _stop(f"{error.filename}: {error.strerror}" if error.strerror else str(error))

    return reported  # type: ignore[return-value]


@cert.command(epilog='Example: holdfast cert ca "Plant authority"')
@click.argument("name")
@_FOLDER
@_new_key(making.CA_DAYS)
@_reporting
def ca(
    name: str,
    folder: Path,
    days: int,
    key_type: KeyKind,
    asked: bool,
    passphrase_file: Path | None,
) -> None:
    """Make an authority: ca.pem and ca.key.

    NAME is its name in certificates. Whoever has ca.key can issue certificates with any role.
    """
    secret = _new_secret(asked, passphrase_file)
    made = making.Authority.create(name, key_type, days)
    _write(folder, "ca", making.pem(*made.chain), making.key_pem(made.key, secret))


@cert.command(epilog="Example: holdfast cert server plc-1 --san 10.0.0.5 --san plc-1.plant.example")
@click.argument("name")
@click.option(
    "--san",
    "names",
    multiple=True,
    required=True,
    metavar="NAME|ADDRESS",
    help="DNS name or IP address that clients connect to; repeatable.",
)
@click.option("--common-name", metavar="TEXT", help="Name in the certificate.  [default: NAME]")
@_AUTHORITY
@_new_key(making.LEAF_DAYS)
@_reporting
def server(
    name: str,
    names: tuple[str, ...],
    common_name: str | None,
    folder: Path,
    ca_file: Path | None,
    ca_key_file: Path | None,
    ca_passphrase_file: Path | None,
    days: int,
    key_type: KeyKind,
    asked: bool,
    passphrase_file: Path | None,
) -> None:
    """Make the certificate of a server: NAME.pem and NAME.key.

    NAME.pem also has the certificates of the authority, as MB-TCP-Security requires.
    """
    _check_name(name)
    alternative = [making.alternative_name(each) for each in names]
    authority = _authority(folder, ca_file, ca_key_file, ca_passphrase_file)
    secret, key = _new_secret(asked, passphrase_file), making.new_key(key_type)
    made = authority.issue_server(common_name or name, alternative, key, days)
    _write(folder, name, making.pem(made, *authority.chain), making.key_pem(key, secret))


@cert.command(epilog="Example: holdfast cert client panel-7 --role operator")
@click.argument("name")
@click.option("--role", metavar="ROLE", help="Role in the certificate, for the rules of listeners.")
@click.option("--common-name", metavar="TEXT", help="Name in the certificate.  [default: NAME]")
@_AUTHORITY
@_new_key(making.LEAF_DAYS)
@_reporting
def client(
    name: str,
    role: str | None,
    common_name: str | None,
    folder: Path,
    ca_file: Path | None,
    ca_key_file: Path | None,
    ca_passphrase_file: Path | None,
    days: int,
    key_type: KeyKind,
    asked: bool,
    passphrase_file: Path | None,
) -> None:
    """Make the certificate of a client: NAME.pem and NAME.key.

    The role is the one of MB-TCP-Security. Without --role, the certificate has the null role, ""
    in rules.
    """
    _check_name(name)
    authority = _authority(folder, ca_file, ca_key_file, ca_passphrase_file)
    secret, key = _new_secret(asked, passphrase_file), making.new_key(key_type)
    made = authority.issue_client(common_name or name, role, key, days)
    _write(folder, name, making.pem(made, *authority.chain), making.key_pem(key, secret))


@cert.command(epilog="Example: holdfast cert revoke panel-7.pem --reason keyCompromise")
@click.argument("revoked", nargs=-1, required=True, type=FILE, metavar="CERTIFICATE...")
@click.option(
    "--reason",
    type=click.Choice(sorted(REASONS)),
    default="unspecified",
    show_default=True,
    help="Why, for readers of the list.",
)
@_AUTHORITY
@_LIST
@_reporting
def revoke(
    revoked: tuple[Path, ...],
    reason: str,
    folder: Path,
    ca_file: Path | None,
    ca_key_file: Path | None,
    ca_passphrase_file: Path | None,
    crl_file: Path | None,
    days: int,
) -> None:
    """Add certificates to the revocation list of their authority: crl.pem.

    The first certificate of each file is revoked. Entries stay in the list: do not lose it.
    """
    authority = _authority(folder, ca_file, ca_key_file, ca_passphrase_file)
    entries: list[tuple[int, Reason]] = []
    for file in revoked:
        own = certificates(file)[0]
        if not authority.issued(own):
            raise UnusableFile(file, "the authority has not issued this certificate")
        entries.append((own.serial_number, REASONS[reason]))
    _write_list(authority, crl_file or folder / "crl.pem", entries, days)


@cert.command(epilog="Example: holdfast cert crl --days 90")
@_AUTHORITY
@_LIST
@_reporting
def crl(
    folder: Path,
    ca_file: Path | None,
    ca_key_file: Path | None,
    ca_passphrase_file: Path | None,
    crl_file: Path | None,
    days: int,
) -> None:
    """Make or renew the revocation list of the authority: crl.pem, with the same entries."""
    authority = _authority(folder, ca_file, ca_key_file, ca_passphrase_file)
    _write_list(authority, crl_file or folder / "crl.pem", [], days)


@cert.command(epilog="Example: holdfast cert show panel-7.pem")
@click.argument("file", type=FILE)
@click.option(
    "--passphrase-file",
    type=FILE,
    metavar="FILE",
    help="File that contains the passphrase of the key in FILE.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object for programs.")
@_reporting
def show(file: Path, passphrase_file: Path | None, as_json: bool) -> None:
    """Show the certificates, keys and revocation lists in a PEM file.

    Names the requirements of MB-TCP-Security that a certificate fails, by number, and exits with 1
    if there is one. Never prints a key.
    """
    secret = None if passphrase_file is None else passphrase(passphrase_file)
    described = inspection.describe(file, secret)
    if as_json:
        click.echo(json.dumps([asdict(each) for each in described], indent=2))
    else:
        click.echo(as_text(described))
    if any(each.flaws for each in described):
        sys.exit(FAILED)


def _authority(
    folder: Path, ca_file: Path | None, key_file: Path | None, passphrase_file: Path | None
) -> Authority:
    ca_file = ca_file or folder / "ca.pem"
    key_file = key_file or ca_file.with_suffix(".key")
    if passphrase_file is not None:
        secret: bytes | None = passphrase(passphrase_file)
    elif is_locked(content(key_file)):
        secret = _asked("Passphrase of the authority's key")
    else:
        secret = None
    return making.Authority.load(ca_file, key_file, secret)


def _new_secret(asked: bool, file: Path | None) -> bytes | None:
    if asked and file is not None:
        raise click.UsageError("--passphrase and --passphrase-file can't be used together.")
    if file is not None:
        return passphrase(file)
    return _asked("Passphrase of the new key", again=True) if asked else None


def _asked(what: str, *, again: bool = False) -> bytes:
    if not sys.stdin.isatty():
        _stop(f"{what}: there is no terminal to ask on; use a file with the passphrase")
    text: str = click.prompt(what, hide_input=True, confirmation_prompt=again, err=True)
    return text.encode()


def _check_name(name: str) -> None:
    if not NAME.fullmatch(name) or name == "ca":
        form = "1 to 64 letters, digits, `_`, `.` and `-`, and not `ca`"
        raise click.BadParameter(f"found {name!r}, allowed: {form}", param_hint="'NAME'")


def _write(folder: Path, name: str, chain: bytes, key: bytes) -> None:
    certificate_file, key_file = folder / f"{name}.pem", folder / f"{name}.key"
    files.write_new(
        {key_file: (key, files.SECRET), certificate_file: (chain, files.PUBLIC)},
    )
    click.echo(f"Written: {certificate_file} and {key_file}.")


def _write_list(
    authority: Authority, file: Path, entries: list[tuple[int, Reason]], days: int
) -> None:
    before = making.read_revocation_list(file) if file.exists() else None
    made = authority.revocation_list(before, entries, days)
    files.replace(file, making.list_pem(made))
    count = len(made)
    noun = "1 certificate is" if count == 1 else f"{count} certificates are"
    click.echo(f"Written: {file}; {noun} revoked.")


def _stop(message: str) -> NoReturn:
    click.echo(f"holdfast: {message}", err=True)
    sys.exit(WRONG)

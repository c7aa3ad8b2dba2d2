"""`holdfast write` with tags: NAME=VALUE, checked by the tag list."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, NoReturn

import click

from holdfast.cli import device_errors, terminal_text
from holdfast.cli.exit_codes import ExitCode
from holdfast.cli.options import device
from holdfast.cli.options.plc_addresses import modicon_hint
from holdfast.cli.tags.read import value_shown
from holdfast.cli.terminal_text import print_json
from holdfast.client.tag_writing import prepared
from holdfast.errors import ModbusError
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import listing

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.cli.tags.selection import TaggedDevice
    from holdfast.client import SyncClient
    from holdfast.client.tag_writing import TagWrite


def write_tags(
    of: TaggedDevice, words: Sequence[str], *, verify: bool, dry_run: bool, as_json: bool
) -> None:
    """Checks all values, then writes them in their order, until the first error."""
    texts = _texts(words)
    if dry_run:
        writes = _prepared(of, texts, None)
        pdus = device.sent_pdus(of.url, [write.request for write in writes])
        if as_json:
            print_json({"ok": True, "target": of.url, "unit": of.unit, "pdus": pdus})
        else:
            click.echo("\n".join(pdus))
        return
    with device.connect(of.url, of.unit, of.timeout, only_writes=not verify) as client:
        try:
            writes = _prepared(of, texts, client)
        except ModbusError as error:
            fields = {"target": of.url, "unit": of.unit, "written": [], "maybe_written": False}
            device_errors.fail(error, of.url, fields)
        for at, write in enumerate(writes):
            try:
                write.send(client)
            except (ModbusError, KeyboardInterrupt) as found:
                _fail(of, writes, at, device_errors.of_write(found), as_json)
            if not as_json:
                done = f"Written: {_text(write)}"
                try:
                    click.echo(done)
                except OSError:
                    click.echo(done, err=True)
                    _print_not_written(writes[at + 1 :])
                    raise
        differing = _differing(of, client, writes, as_json) if verify else {}
    if as_json:
        verified = {"verified": not differing} if verify else {}
        names = [write.tag.name for write in writes]
        answer = {"ok": not differing, "target": of.url, "unit": of.unit, "written": names}
        wrong = [f"{name}: read back {now}" for name, now in differing.items()]
        try:
            print_json({**answer, **verified, **device_errors.differs(wrong)})
        except OSError:
            click.echo(f"Written: {', '.join(names)}", err=True)
            raise
    elif verify and not differing:
        click.echo("Read back alike.")
    if differing:
        if not as_json:
            for name, now in differing.items():
                click.echo(f"holdfast: {name}: read back {now}", err=True)
        sys.exit(ExitCode.FAILED)


def _texts(words: Sequence[str]) -> list[tuple[str, str]]:
    """Names and values."""
    texts = [(name, text) for name, sign, text in (word.partition("=") for word in words) if sign]
    if len(texts) < len(words):
        wrong = next(word for word in words if "=" not in word)
        if wrong.startswith("-"):
            raise click.NoSuchOption(wrong)
        raise click.UsageError(f"{wrong!r} is not NAME=VALUE, as in setpoint=21.5.")
    if not texts:
        raise click.UsageError("Missing argument 'NAME=VALUE...'.")
    return texts


def _prepared(
    of: TaggedDevice, texts: Sequence[tuple[str, str]], client: SyncClient | None
) -> list[TagWrite]:
    try:
        return prepared(of.tags, texts, client)
    except KeyError as error:
        [name] = error.args
        writable = [tag.name for tag in of.tags if tag.writable]
        known = listing(writable) or "none, no tag is writable"
        raise click.UsageError(
            f"No tag has the name {name!r}, allowed: {known}{suggestion(name, writable)}"
        ) from None
    except ValueError as error:
        raise click.UsageError(str(error)) from None


def _text(write: TagWrite) -> str:
    tag = write.tag
    unit = f" {tag.unit}" if tag.unit else ""
    return terminal_text.plain(f"{tag.name} = {value_shown(tag, tag.value(write.raw))}{unit}")


def _differing(
    of: TaggedDevice, client: SyncClient, writes: Sequence[TagWrite], as_json: bool
) -> dict[str, str]:
    """The values that were read back and differ, by name."""
    try:
        found = {write.tag.name: (write, write.read_back(client)) for write in writes}
    except (ModbusError, KeyboardInterrupt) as ended:
        error = device_errors.of_write(ended)
        names = [write.tag.name for write in writes]
        fields = {"target": of.url, "unit": of.unit, "written": names, "maybe_written": False}
        if not as_json:
            click.echo("Could not be read back.", err=True)
        device_errors.fail(error, of.url, fields)
    return {
        name: value_shown(write.tag, now)
        for name, (write, (is_alike, now)) in found.items()
        if not is_alike
    }


def _fail(
    of: TaggedDevice, writes: Sequence[TagWrite], at: int, error: ModbusError, as_json: bool
) -> NoReturn:
    """Prints which tag failed, and which ones were written and not sent."""
    names = [write.tag.name for write in writes]
    maybe = device_errors.maybe_written(error)
    if as_json:
        fields = {
            "target": of.url,
            "unit": of.unit,
            "written": names[:at],
            "failed": names[at],
            "not_written": names[at + 1 :],
            "maybe_written": maybe,
        }
        device_errors.fail(error, of.url, fields)
    click.echo(f"holdfast: {of.url}: {names[at]}: {error}", err=True)
    if maybe:
        click.echo(f"hint: {names[at]} was possibly written", err=True)
    device_errors.hint(error, of.url, modicon_hint(writes[at].tag), is_write=True)
    _print_not_written(writes[at + 1 :])
    sys.exit(ExitCode.FAILED)


def _print_not_written(writes: Sequence[TagWrite]) -> None:
    if writes:
        names = ", ".join(write.tag.name for write in writes)
        click.echo(f"Not written: {names}", err=True)

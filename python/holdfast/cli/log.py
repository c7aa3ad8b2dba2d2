"""`holdfast log`: backups of the logs that appliances share, and the servers that keep them."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from holdfast import log_backup
from holdfast.appliance import assembly, embedded
from holdfast.cli.configuration import load_or_exit
from holdfast.cli.logs_of import chosen_log
from holdfast.cli.suggesting import SuggestingGroup
from holdfast.nats_server import ServerUnusable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.config.logs import SharedLogConfig
    from holdfast.scanner import Servers

FILE = click.Path(path_type=Path)


@click.group(cls=SuggestingGroup, epilog="Example: holdfast log backup plant.yaml site-backup")
def log() -> None:
    """Back up, restore and replicate the logs that appliances share.

    The server of a log with `embedded` is started if no appliance runs it. Exit codes: 0 done, 1
    failed, and the reason is printed, 2 wrong usage.
    """


def _of_log(command: Callable[..., Any]) -> Callable[..., Any]:
    return click.option("--log", "name", metavar="NAME", help="Required if there are several.")(
        command
    )


@log.command(epilog="Example: holdfast log backup plant.yaml site-backup")
@click.argument("file", type=FILE)
@click.argument("folder", type=FILE)
@_of_log
def backup(file: Path, folder: Path, name: str | None) -> None:
    """Write the log of the configuration FILE to the new FOLDER.

    Nodes may run. What is written after the backup is not in it.
    """
    with _servers(file, name) as (found, _, servers):
        messages = log_backup.back_up(servers, found, folder)
    click.echo(f"Backed up: log {found}, {messages} messages.")


@log.command(epilog="Example: holdfast log restore plant.yaml site-backup")
@click.argument("file", type=FILE)
@click.argument("folder", type=FILE)
@_of_log
def restore(file: Path, folder: Path, name: str | None) -> None:
    """Put the backup FOLDER on the servers of the configuration FILE, which don't have the log.

    The log has as many `replicas` as FILE says. No node of it may run.
    """
    with _servers(file, name) as (found, settings, servers):
        messages = log_backup.restore(servers, found, settings.replicas, folder)
    click.echo(f"Restored: log {found}, {messages} messages, {settings.replicas} replicas.")


@log.command(epilog="Example: holdfast log replicas plant.yaml")
@click.argument("file", type=FILE)
@_of_log
def replicas(file: Path, name: str | None) -> None:
    """Have the log kept by as many servers as `replicas` in FILE says. Nodes may run."""
    with _servers(file, name) as (found, settings, servers):
        changed = log_backup.set_replicas(servers, found, settings.replicas)
    for stream, (before, now) in changed.items():
        click.echo(f"{stream}: {before} -> {now}" if before != now else f"{stream}: {now}")


@contextmanager
def _servers(file: Path, name: str | None) -> Iterator[tuple[str, SharedLogConfig, Servers]]:
    """The log of that name, its settings and servers. Exits with 1 if they can't be used."""
    config = load_or_exit(file)
    found = chosen_log(config, name)
    settings = config.logs[found]
    try:
        with embedded.running(found, settings):
            yield found, settings, assembly.nats_servers(settings)
    except (ServerUnusable, log_backup.BackupFailed) as error:
        _fail(f"logs.{found}: {error}")


def _fail(message: str) -> NoReturn:
    click.echo(f"holdfast: {message}", err=True)
    sys.exit(1)

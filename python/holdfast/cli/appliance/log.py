"""`holdfast log`: status, replay, backup, restore and replicas of shared logs."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast.appliance.client_credentials import nats_servers
from holdfast.appliance.parts import log_servers
from holdfast.cli import SuggestingGroup
from holdfast.cli.appliance.log_replay import replay
from holdfast.cli.appliance.log_status import log_status
from holdfast.cli.configuration import load_or_exit
from holdfast.cli.exit_codes import fail
from holdfast.cli.options.logs import chosen_log, log_option
from holdfast.cli.options.option import config_argument
from holdfast.cli.signals import stops_as_ctrl_c
from holdfast.net.nats_server import ServerUnusable
from holdfast.replication import backup as log_backup

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.config.models.logs import SharedLogConfig
    from holdfast.net.nats.connection import Servers

FOLDER = click.Path(path_type=Path)


@click.group(cls=SuggestingGroup, epilog="Example: holdfast log backup plant.yaml site-backup")
def log() -> None:
    """Show, replay, back up, restore and replicate the logs that appliances share.

    The server of a log with `embedded` is started if no appliance runs it. Exit codes: 0 done, 1
    failed, and the reason is printed, 2 wrong usage.
    """


log.add_command(log_status)
log.add_command(replay)


@log.command(epilog="Example: holdfast log backup plant.yaml site-backup")
@config_argument
@click.argument("folder", type=FOLDER)
@log_option
def backup(file: Path, folder: Path, name: str | None) -> None:
    """Write the log of the configuration FILE to the new FOLDER.

    Nodes may run. What is written after the backup is not in it.
    """
    with _open_log(file, name) as (log_name, _, servers):
        messages = log_backup.back_up(servers, log_name, folder)
    click.echo(f"Backed up: log {log_name}, {messages} messages.")


@log.command(epilog="Example: holdfast log restore plant.yaml site-backup")
@config_argument
@click.argument("folder", type=FOLDER)
@log_option
def restore(file: Path, folder: Path, name: str | None) -> None:
    """Restore the backup FOLDER to the servers of FILE, which must not have the log yet.

    The log gets the `replicas` of FILE. No node of it may run.
    """
    with _open_log(file, name) as (log_name, settings, servers):
        messages = log_backup.restore(servers, log_name, settings.replicas, folder)
    click.echo(f"Restored: log {log_name}, {messages} messages, {settings.replicas} replicas.")


@log.command(epilog="Example: holdfast log replicas plant.yaml")
@config_argument
@log_option
def replicas(file: Path, name: str | None) -> None:
    """Set the number of servers that store the log to `replicas` in FILE. Nodes may run."""
    with _open_log(file, name) as (log_name, settings, servers):
        changed = log_backup.set_replicas(servers, log_name, settings.replicas)
    for stream, (before, now) in changed.items():
        click.echo(f"{stream}: {before} -> {now}" if before != now else f"{stream}: {now}")


@contextmanager
def _open_log(file: Path, name: str | None) -> Iterator[tuple[str, SharedLogConfig, Servers]]:
    """Yields the name of the log, its settings and its servers.

    Exits with 1 if they can't be used, or if the body raises `BackupFailed`.
    """
    config = load_or_exit(file)
    log_name = chosen_log(config, name)
    settings = config.logs[log_name]
    try:
        with stops_as_ctrl_c(), log_servers.running(log_name, settings):
            yield log_name, settings, nats_servers(settings)
    except (ServerUnusable, log_backup.BackupFailed) as error:
        fail(f"logs.{log_name}: {error}")

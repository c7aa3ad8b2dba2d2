"""`holdfast service`: an appliance as a service of Windows."""

from __future__ import annotations

import os
import re
import sys
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from holdfast.appliance.windows_service.log_file import LogFile
from holdfast.cli import SuggestingGroup
from holdfast.cli.configuration import load_or_exit
from holdfast.cli.exit_codes import fail
from holdfast.cli.options.option import config_argument, option, option_group
from holdfast.cli.services.run import serve
from holdfast.runtime import extras

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.appliance.windows_service.control import ServiceControl
    from holdfast.appliance.windows_service.installation import InstalledService


@click.group(cls=SuggestingGroup, epilog="Example: holdfast service install C:\\plant\\plant.yaml")
def service() -> None:
    """Run an appliance as a service of Windows.

    Requires Windows, and the extra windows of Holdfast. On Linux, use systemd.
    """


_NAME = "Name of the service. Default: holdfast-NAME for the configuration NAME.yaml."
_of_service = option_group(config_argument, option("--name name_of", "NAME", _NAME))


@service.command(epilog="Example: holdfast service install C:\\plant\\plant.yaml")
@_of_service
def install(file: Path, name_of: str | None) -> None:
    """Check the configuration FILE, and install a service that runs it from the next boot on."""
    load_or_exit(file)
    with _installed(file, name_of) as installed:
        installed.install(file.resolve())
        click.echo(f"Installed: {installed.name}, with the account NT SERVICE\\{installed.name}")
        click.echo(f"Log: {_log(installed.name)}")


def _add(name: str, help: str, told: str) -> None:
    """Adds a command that calls the method of that name, and prints what it did."""

    @service.command(
        name, help=help, epilog=f"Example: holdfast service {name} C:\\plant\\plant.yaml"
    )
    @_of_service
    def command(file: Path, name_of: str | None) -> None:
        with _installed(file, name_of) as installed:
            getattr(installed, name)()
            click.echo(told.format(installed.name, _log(installed.name)))


_add("remove", "Stop the service of FILE, and remove it. Its files remain.", "Removed: {0}")
_add("start", "Start the service of FILE, and wait until it serves.", "Started: {0}")
_add("stop", "Stop the service of FILE, and wait until it has ended.", "Stopped: {0}")
_add("reload", "Have the service of FILE reread it. The log has the result.", "Requested: see {1}")


@service.command(hidden=True)
@_of_service
def host(file: Path, name_of: str | None) -> None:
    """Answer the service control manager of Windows, which runs this command."""
    named = name_of or _default_name(file)
    with _unavailable():
        from holdfast.appliance.windows_service.host import answer
    log = _log(named)
    output = LogFile(log)
    with redirect_stdout(output), redirect_stderr(output):
        answer(named, str(log), partial(_serve, file))


def _serve(file: Path, control: ServiceControl) -> None:
    config = load_or_exit(file, shows_warnings=False)
    serve(
        config,
        lambda _: f"{file} is served.",
        file=file,
        control=control,
    )


@contextmanager
def _installed(file: Path, name: str | None) -> Iterator[InstalledService]:
    """The service of a configuration. An error is one line, and exit code 1."""
    with _unavailable():
        from holdfast.appliance.windows_service.installation import InstalledService, ServiceError
    try:
        yield InstalledService(name or _default_name(file))
    except ServiceError as error:
        fail(error)


@contextmanager
def _unavailable() -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        reason = (
            f"service {extras.missing('windows') or error}"
            if sys.platform == "win32"
            else "services of Windows exist only there. On Linux, use systemd"
        )
        fail(reason)


def _default_name(file: Path) -> str:
    """A name for the service. Windows allows no slashes in it."""
    return "holdfast-" + re.sub(r"[^A-Za-z0-9_.-]+", "-", file.stem)


def _log(name: str) -> Path:
    folder = os.environ.get("PROGRAMDATA", "C:\\ProgramData")
    return Path(folder) / "Holdfast" / f"{name}.log"

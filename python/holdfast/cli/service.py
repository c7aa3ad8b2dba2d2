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

from holdfast.cli.configuration import load_or_exit
from holdfast.cli.run import serve
from holdfast.cli.suggesting import SuggestingGroup
from holdfast.windows_service.log_file import LogFile

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from holdfast.windows_service.control import ServiceControl
    from holdfast.windows_service.installed import InstalledService


@click.group(cls=SuggestingGroup, epilog="Example: holdfast service install C:\\plant\\plant.yaml")
def service() -> None:
    """Run an appliance as a service of Windows.

    Requires Windows, and the package pywin32: pip install pywin32. On Linux, use systemd.
    """


def _of_service(command: Callable[..., None]) -> Callable[..., None]:
    file = click.argument("file", type=click.Path(path_type=Path))
    name = click.option(
        "--name",
        help="Name of the service. Default: holdfast-NAME for the configuration NAME.yaml.",
    )
    return file(name(command))


@service.command(epilog="Example: holdfast service install C:\\plant\\plant.yaml")
@_of_service
def install(file: Path, name: str | None) -> None:
    """Check the configuration FILE, and install a service that runs it from the next boot on."""
    load_or_exit(file)
    with _installed(file, name) as installed:
        installed.install(file.resolve())
        click.echo(f"Installed: {installed.name}, with the account NT SERVICE\\{installed.name}")
        click.echo(f"Log: {_log(installed.name)}")


@service.command(epilog="Example: holdfast service remove C:\\plant\\plant.yaml")
@_of_service
def remove(file: Path, name: str | None) -> None:
    """Stop the service of FILE, and remove it. Its files remain."""
    with _installed(file, name) as installed:
        installed.remove()
        click.echo(f"Removed: {installed.name}")


@service.command(epilog="Example: holdfast service start C:\\plant\\plant.yaml")
@_of_service
def start(file: Path, name: str | None) -> None:
    """Start the service of FILE, and wait until it serves."""
    with _installed(file, name) as installed:
        installed.start()
        click.echo(f"Started: {installed.name}")


@service.command(epilog="Example: holdfast service stop C:\\plant\\plant.yaml")
@_of_service
def stop(file: Path, name: str | None) -> None:
    """Stop the service of FILE, and wait until it has ended."""
    with _installed(file, name) as installed:
        installed.stop()
        click.echo(f"Stopped: {installed.name}")


@service.command(epilog="Example: holdfast service reload C:\\plant\\plant.yaml")
@_of_service
def reload(file: Path, name: str | None) -> None:
    """Have the service of FILE reread it. The log has the result."""
    with _installed(file, name) as installed:
        installed.reload()
        click.echo(f"Requested: see {_log(installed.name)}")


@service.command(hidden=True)
@_of_service
def host(file: Path, name: str | None) -> None:
    """Answer the service control manager of Windows, which runs this command."""
    named = name or _default_name(file)
    with _unavailable():
        from holdfast.windows_service.host import answer
    log = _log(named)
    output = LogFile(log)
    with redirect_stdout(output), redirect_stderr(output):
        answer(named, str(log), partial(_serve, file))


def _serve(file: Path, control: ServiceControl) -> None:
    config = load_or_exit(file)
    serve(
        config,
        lambda _: f"{file} is served.",
        named=str(file),
        file=file,
        control=control,
    )


@contextmanager
def _installed(file: Path, name: str | None) -> Iterator[InstalledService]:
    """The service of a configuration. An error is one line, and exit code 1."""
    with _unavailable():
        from holdfast.windows_service.installed import InstalledService, ServiceError
    try:
        yield InstalledService(name or _default_name(file))
    except ServiceError as error:
        click.echo(f"holdfast: {error}", err=True)
        sys.exit(1)


@contextmanager
def _unavailable() -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        reason = (
            f"{error}: pip install pywin32"
            if sys.platform == "win32"
            else "services of Windows exist only there. On Linux, use systemd"
        )
        click.echo(f"holdfast: {reason}", err=True)
        sys.exit(1)


def _default_name(file: Path) -> str:
    """A name for the service. Windows allows no slashes in it."""
    return "holdfast-" + re.sub(r"[^A-Za-z0-9_.-]+", "-", file.stem)


def _log(name: str) -> Path:
    folder = os.environ.get("PROGRAMDATA", "C:\\ProgramData")
    return Path(folder) / "Holdfast" / f"{name}.log"

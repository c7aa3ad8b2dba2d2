"""`holdfast` as people and programs call it, in this process."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from click.testing import CliRunner

from holdfast.cli import main

if TYPE_CHECKING:
    from click.testing import Result

    import holdfast


def url(server: holdfast.Server) -> str:
    host, port = server.address
    return f"tcp://{host}:{port}"


def invoke(*arguments: str) -> Result:
    """The result of a command; an error that is none of the program's is raised."""
    result = CliRunner().invoke(main, list(arguments), prog_name="holdfast")
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def done(*arguments: str) -> list[str]:
    """The lines that a command prints, which must succeed and complain of nothing."""
    result = invoke(*arguments)
    assert (result.exit_code, result.stderr) == (0, "")
    return result.stdout.splitlines()


def answer(*arguments: str, code: int = 0) -> Any:
    """The JSON that a command prints."""
    result = invoke(*arguments, "--json")
    assert (result.exit_code, result.stderr) == (code, "")
    return json.loads(result.stdout)


def failure(*arguments: str) -> list[str]:
    """The lines on standard error of a command that fails."""
    result = invoke(*arguments)
    assert result.exit_code == 1
    return result.stderr.splitlines()


def usage_error(*arguments: str) -> str:
    """The last line of what wrong usage is answered with."""
    result = invoke(*arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("Usage: holdfast ")
    return result.stderr.splitlines()[-1]

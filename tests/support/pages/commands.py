"""Parses and runs the commands of the pages, and compares what they print."""

from __future__ import annotations

import os
import re
import subprocess
import threading
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import click

from holdfast.cli import main
from support import wire
from support.cli import invoke
from support.machine import missing, tool
from support.pages import blocks
from support.pages.comparing import alike
from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from support.pages.blocks import Block, Command
    from support.pages.stage import Stage

SERVING = {"run", "proxy", "simulate", "scan", "gateway"}
"""The commands that serve until they are stopped: the blocks below use them."""

PORT_OPTIONS = {
    "gateway": ("--bind", "127.0.0.1:8090"),
    "scan": ("--nats", "nats://127.0.0.1:4222"),
    "simulate": ("--bind", "127.0.0.1:5020"),
}
"""The options for another port than the default one, which the pages show."""


COMPARED: dict[str, Callable[[str], str]] = {
    "describe": lambda text: re.sub(r"^(?:(?:co|di|hr|ir)_|Byte order).*\n", "", text, flags=re.M),
    "describe guess": lambda text: "\n".join(
        re.findall(r"^ *[01]\.\d\d +(\d.*?[A-D]{4})", text, re.M)[:1]
    ),
    "bench": lambda text: re.sub(r"^under .*\n", "", text, flags=re.M).replace(" ms", " µs"),
}
"""What is compared of an output: the best guess; no histogram; nothing that depends on samples."""


def parse(arguments: list[str]) -> None:
    """Parses a whole command line of `holdfast`. Raises `click.UsageError` if it is wrong."""
    invoked = click.Command.invoke

    def invoke_groups(command: click.Command, context: click.Context) -> Any:
        return invoked(command, context) if isinstance(command, click.Group) else None

    with patch.object(click.Command, "invoke", invoke_groups):
        main.main(arguments, "holdfast", standalone_mode=False)


def parsed(command: Command) -> None:
    """Checks the arguments of each `holdfast` and each `make` of a command."""
    for program, *arguments in command.programs:
        if program.rpartition("/")[2] == "holdfast":
            try:
                parse(arguments)
            except click.UsageError as error:
                raise AssertionError(error.format_message()) from None
        elif program == "make":
            made(arguments)


def made(arguments: list[str]) -> None:
    """Checks that a target and its settings are of the Makefile, and the options of a benchmark."""
    target, *settings = arguments
    makefile = (ROOT / "Makefile").read_text()
    assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
    given = dict(each.split("=", 1) for each in settings)
    assert [name for name in given if f"$({name})" not in makefile] == []
    benchmark = ROOT / "benches" / f"{given.pop('NAME', 'server')}.py"
    assert benchmark.exists(), benchmark
    options = [word for word in given.pop("BENCH", "").split() if word.startswith("--")]
    texts = benchmark.read_text() + (ROOT / "benches" / "common.py").read_text()
    assert [option for option in options if f'"{option}"' not in texts] == []


def run_all(block: Block, stage: Stage, left_out: Callable[[Command], bool]) -> None:
    """Runs the commands of a block, and compares what they print; all are parsed before.

    A block of `sh` with other programs than `holdfast` is one script. A command without output in
    the page must succeed.
    """
    stage.output = ""
    found = blocks.commands(block)
    failures: list[str] = []
    for command in found:
        with _at(command, failures):
            parsed(command)
    if failures:
        raise AssertionError("\n".join(failures))
    chosen = [command for command in found if not left_out(command)]
    for name in {program for command in chosen for program, *_ in command.programs}:
        _needs(name, stage)
    if block.language == "sh" and len(chosen) > 1 and not all(map(_is_holdfast, chosen)):
        chosen = [replace(chosen[0], text="\n".join(["set -e", *(each.text for each in chosen)]))]
    for command in chosen:
        with _at(command, failures):
            stage.output += run(command, stage)
    if failures:
        raise AssertionError("\n".join(failures))


def _needs(name: str, stage: Stage) -> None:
    """Skips the test if the shell does not know a program."""
    if re.fullmatch(r"[\w.+-]+", name) and name != "holdfast":
        asked = [tool("sh"), "-c", 'command -v "$1"', "sh", name]
        if subprocess.run(asked, env=stage.environment, stdout=subprocess.DEVNULL).returncode:
            missing(f"the program {name}")


@contextmanager
def _at(command: Command, failures: list[str]) -> Iterator[None]:
    try:
        yield
    except AssertionError as error:
        failures.append(f"{command.place}: {command.text}\n{error}")


def _is_own(command: Command) -> bool:
    """Whether it is `holdfast` alone, which needs no shell."""
    return (
        len(command.programs) == 1
        and _is_holdfast(command)
        and not re.search(r"[<>$*]", command.text)
    )


def _is_holdfast(command: Command) -> bool:
    return {program.rpartition("/")[2] for program, *_ in command.programs} == {"holdfast"}


def run(command: Command, stage: Stage) -> str:
    """Runs a command, and checks its output if the page shows one. Returns it."""
    here = replace(command, text=stage.here(command.text))
    if _is_own(command):
        [(_, *arguments)] = here.programs
        with patch.dict(os.environ, here.environment):
            if arguments[0] in SERVING:
                return served(here, arguments, stage)
            result = invoke(*arguments)
        shown, code = result.output, result.exit_code
    elif STREAM.search(here.text):
        shown, code = streamed(here.text, stage), 0
    else:
        done = subprocess.run(
            [tool("sh"), "-c", here.text],
            env=stage.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=4 * wire.DEADLINE,
        )
        shown, code = done.stdout, done.returncode
    shown = stage.there(shown)
    if command.output:
        words = here.programs[-1][1:3]
        compared = COMPARED.get(" ".join(word for word in words if word.isalpha()), str)
        alike(compared(shown), compared(command.output))
    else:
        assert code == 0, f"exit code {code}: {shown}"
    return shown


STREAM = re.compile(r"curl -s?N ")


def streamed(text: str, stage: Stage) -> str:
    """Runs a command that prints events without end, until it has printed two."""
    process = subprocess.Popen(
        [tool("sh"), "-c", f"exec {text}"],
        env=stage.environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    timer = threading.Timer(4 * wire.DEADLINE, process.kill)
    timer.start()
    shown = ""
    try:
        assert process.stdout is not None
        for line in process.stdout:
            shown += line
            if shown.count("data: ") == 2:
                break
    finally:
        timer.cancel()
        process.kill()
        process.communicate()
    return shown


def served(command: Command, arguments: list[str], stage: Stage) -> str:
    """Starts a command that serves, and compares its greeting."""
    option, default = PORT_OPTIONS.get(arguments[0], ("", ""))
    if option and option not in arguments:
        place = stage.here(default)
        if place in stage.served:  # As if the first one had been ended.
            place = "127.0.0.1:0"
        stage.served.add(place)
        arguments = [*arguments, option, place]
    shown = stage.there(stage.serve(*arguments).greeting)
    if command.output:
        greeting = command.output.split("Ctrl-C stops it.")[0]
        alike(shown.split("Ctrl-C stops it.")[0], greeting)
    return shown

"""Names of commands and options of earlier versions, which are still accepted with a hint."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

OLD_NAMES = {
    "map": "describe map",
    "guess": "describe guess",
    "identify": "describe identify",
    "plan": "check plan",
    "schema": "check --schema",
    "replicas": "log status",
    "replay": "log replay",
    "completion": "--completion",
}
"""Names of commands: scripts have them."""

_COUNT = {"--count": "{}"}
_READS = {"--reads": "--times {}"}
_LOG = {"--json-log": "--log-format json"}
_DEVICE_FILES = {f"--tls-{file}": f"--device-{file} {{}}" for file in ("ca", "cert", "key")}
OLD_OPTIONS: Mapping[str, Mapping[str, str]] = {
    "bench": {
        "--seconds": "--duration {}",
        "--area": "{}",
        "--address": "{}",
        **_COUNT,
    },
    "check plan": {"--read": "{range}"},
    "describe": _READS,
    "describe guess": _READS | _COUNT,
    "gateway": {
        "--hosts": "--host {}",
        "--sources": "--source {}",
        "--token-file": "--tokens {}",
        "--writes": "--access read-write",
        **_DEVICE_FILES,
        **_LOG,
    },
    "log replay": {"--port": "--bind :{}"},
    "proxy": {"--listen": "--bind {}", "--read-only": "--access read-only", **_LOG},
    "read": {"--count": "--times {}"},
    "scan": {"--scan-rate": "--every {}ms"},
    "simulate": {"--port": "--bind :{}"},
    "watch": {"--count": "--times {}"},
}
"""For each command, what its old options are now; `{}` is the value, `{range}` FIRST-LAST of it."""

GONE = {
    "--modicon": "type the number alone, as in 40001 or 4x0001, or 00001 for a coil",
    "--stdin": "create an entry, and set its sha256: printf %s SECRET | sha256sum",
}
"""Options that no command has any more, and what to do instead."""


def _range(text: str) -> str:
    """AREA:FIRST-LAST of AREA:ADDRESS:COUNT."""
    area, _, rest = text.partition(":")
    address, _, count = rest.partition(":")
    if not (address.isdecimal() and (count or "1").isdecimal()):
        return text
    return f"{area}:{address}-{int(address) + int(count or 1) - 1}"


def hint(old: str, new: str) -> None:
    """Prints what an old spelling is now, on standard error."""
    click.echo(f"hint: {old!r} is now {new!r}", err=True)


def renewed(command: str, args: Sequence[str], *, silent: bool) -> list[str]:
    """The arguments of a command, with its options as they are named now."""
    old = OLD_OPTIONS.get(command, {})
    found: list[str] = []
    items: list[str] = []
    left = list(args)
    while left:
        word = left.pop(0)
        name, sign, value = word.partition("=")
        if word == "--":
            return [*found, word, *left, *items]
        if name in GONE and not silent:
            click.get_current_context().fail(f"There is no {name} any more: {GONE[name]}")
        new = old.get(name)
        if new is None:
            found.append(word)
            continue
        given = [name]
        if "{" in new:
            if not sign and not left:  # The parser says that the value is missing.
                found.append(new.split()[0])
                continue
            value = value if sign else left.pop(0)
            given.append(value)
        words = [each.format(value, range=_range(value)) for each in new.split()]
        if not silent:
            hint(" ".join(given), " ".join(words))
        # What is an argument now comes after the URL, wherever the old option was.
        (found if words[0].startswith("-") else items).extend(words)
    return [*found, *items]

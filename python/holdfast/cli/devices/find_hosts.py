"""`holdfast find NETWORK`: hosts that answer Modbus TCP."""

from __future__ import annotations

import asyncio
import sys
from collections import Counter
from typing import TYPE_CHECKING

import click

from holdfast.cli import terminal_text
from holdfast.cli.device_errors import hint_at_late_replies, hint_at_silence
from holdfast.cli.devices.search_report import INTERRUPTED, NOTHING, Report, ended_to_json
from holdfast.cli.exit_codes import ExitCode
from holdfast.discovery import device_search
from holdfast.discovery.device_search import Host

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.discovery.device_search import State
    from holdfast.net.addresses import Network

MAX_CONCURRENT_HOSTS = 64
"""Hosts at a time."""

MAX_ADDRESSES = 1024
"""The most addresses without `--large`, and with it."""
MAX_ADDRESSES_LARGE = 65_536

LISTED_STATES = ("modbus", "open")
"""The states of hosts that are listed; others are counted."""


def check_size(networks: Sequence[Network], *, large: bool) -> None:
    """Raises `click.UsageError` if the networks have too many addresses."""
    count = device_search.size(networks)
    most = MAX_ADDRESSES_LARGE if large else MAX_ADDRESSES
    if count > most:
        raise click.UsageError(
            f"{count} addresses, allowed: {most}"
            + ("." if large else "; --large allows more. Name a smaller network, or several.")
        )


def find_hosts(
    target: str,
    networks: Sequence[Network],
    port: int,
    units: Sequence[int],
    timeout: float,
    rate: float,
    as_json: bool,
) -> None:
    """Finds hosts, prints them, and exits with 1 if there are none."""
    urls = [Host(str(each), port, "silent").url for each in device_search.addresses(networks)]
    total = len(urls)
    if sys.stderr.isatty():
        click.echo(
            f"{terminal_text.counted(total, 'address')}, port {port}, at most {rate:g} connections "
            f"a second. Ctrl-C stops.",
            err=True,
        )
    report = Report({"target": target, "port": port})
    row = f"{{:{max(map(len, urls))}}}  {{:>4}}  {{:7}}  {{}}"
    found: list[Host] = []
    listed: list[Host] = []

    async def look() -> None:
        seen = device_search.hosts(
            networks,
            port=port,
            timeout=timeout,
            rate=rate,
            concurrency=min(MAX_CONCURRENT_HOSTS, total),
            units=units,
        )
        with report.progress("Finding", total, lambda: f"{_answering(found)} found"):
            async for host in seen:
                found.append(host)
                if host.state in LISTED_STATES:
                    listed.append(host)
                    _print(host, report, row, is_first=len(listed) == 1)
                report.advance(len(found))

    interrupted = False
    try:
        asyncio.run(look())
    except KeyboardInterrupt:
        interrupted = True
    counts = Counter(host.state for host in found)
    report.text(*([""] if listed else []), _counted(counts, total, total - len(found)))
    report.end(
        {
            **ended_to_json(INTERRUPTED if interrupted else None if counts["modbus"] else NOTHING),
            "complete": not interrupted,
            "counts": {
                **{state: counts[state] for state in ("modbus", "open", "refused", "silent")},
                "asked": len(found),
                "not_asked": total - len(found),
            },
        }
    )
    if interrupted and not as_json:
        click.echo("holdfast: interrupted", err=True)
    latest = max((host.longest_late for host in found), default=0.0)
    hint_at_late_replies(latest, timeout)
    mute = [host for host in listed if host.is_mute]
    if mute and not interrupted and not counts["modbus"]:
        hint_at_silence(mute[0].url, mute, latest)
    if interrupted or not counts["modbus"]:
        sys.exit(ExitCode.FAILED)


def _print(host: Host, report: Report, row: str, *, is_first: bool) -> None:
    unit = "" if host.unit is None else str(host.unit)
    answer = host.detail if host.state == "modbus" else f"no Modbus: {host.detail}"
    identity = terminal_text.plain(str(host.identity))
    head = terminal_text.styled(row.format("url", "unit", "answer", "identification"), bold=True)
    line = row.format(host.url, unit, answer, identity).rstrip()
    report.text(*([head] if is_first else []), line)
    report.entry(_host(host))


def _answering(found: Iterable[Host]) -> int:
    return sum(host.state == "modbus" for host in found)


def _host(host: Host) -> dict[str, object]:
    return {
        "host": host.address,
        "url": host.url,
        "modbus": host.state == "modbus",
        "unit": host.unit,
        "detail": host.detail,
        "identification": dict(host.identity.objects),
    }


def _counted(counts: Counter[State], total: int, left: int) -> str:
    return (
        f"{terminal_text.counted(total, 'address')}: {counts['modbus']} answer Modbus, "
        f"{counts['open']} accept connections but do not answer Modbus, "
        f"{counts['refused']} refuse them, {counts['silent']} do not respond"
        + (f", {left} were not asked" if left else "")
    )

"""`holdfast find NETWORK`: hosts that answer Modbus TCP."""

from __future__ import annotations

import asyncio
import sys
from collections import Counter
from typing import TYPE_CHECKING

import click

from holdfast.cli import device, showing
from holdfast.cli.report import Report
from holdfast.config.ip_addresses import parse_source
from holdfast.tools import finding
from holdfast.tools.finding import Host

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.net.addresses import Network
    from holdfast.tools.finding import State

CONCURRENCY = 64
"""Hosts at a time."""

SHOWN = ("modbus", "open")
"""The states of hosts that are listed; others are counted."""


def find_hosts(
    networks: Sequence[Network],
    port: int,
    units: Sequence[int],
    timeout: float,
    rate: float,
    as_json: bool,
) -> None:
    """Finds hosts, prints them, and exits with 1 if there are none."""
    urls = [Host(str(each), port, "silent").url for each in finding.addresses(networks)]
    total = len(urls)
    if sys.stderr.isatty():
        click.echo(
            f"{showing.counted(total, 'address')}, port {port}, at most {rate:g} connections a "
            f"second. Ctrl-C stops.",
            err=True,
        )
    report = Report({"port": port} if as_json else None)
    hosts = HostReport(report, max(map(len, urls)))
    found: list[Host] = []

    async def look() -> None:
        seen = finding.hosts(
            networks,
            port=port,
            timeout=timeout,
            rate=rate,
            concurrency=min(CONCURRENCY, total),
            units=units,
        )
        with report.progress("Finding", total, lambda: f"{_answering(found)} found"):
            async for host in seen:
                found.append(host)
                hosts.add(host)
                report.advance(len(found))

    interrupted = False
    try:
        asyncio.run(look())
    except KeyboardInterrupt:
        interrupted = True
    found.sort(key=lambda host: parse_source(host.address))
    counts = Counter(host.state for host in found)
    report.text(*([""] if hosts.printed else []), _counted(counts, total, total - len(found)))
    report.end(
        {
            "ok": not interrupted and counts["modbus"] > 0,
            "complete": not interrupted,
            "asked": len(found),
            "not_asked": total - len(found),
            "counts": {state: counts[state] for state in ("modbus", "open", "refused", "silent")},
            "hosts": [_host(host) for host in found if host.state in SHOWN],
        }
    )
    if interrupted and not as_json:
        click.echo("holdfast: interrupted", err=True)
    device.tell_late(max((host.longest_late for host in found), default=0.0), timeout)
    if interrupted or not counts["modbus"]:
        sys.exit(device.FAILED)


class HostReport:
    """The table of the hosts that are found, as they come."""

    def __init__(self, report: Report, width: int) -> None:
        self.printed = 0
        self._report = report
        self._row = f"{{:{width}}}  {{:>4}}  {{:7}}  {{}}"

    def add(self, host: Host) -> None:
        """Prints a host, if it answers or has the port open."""
        if host.state not in SHOWN:
            return
        if self.printed == 0:
            head = self._row.format("url", "unit", "answer", "identification")
            self._report.text(showing.styled(head, bold=True))
        self.printed += 1
        unit = "" if host.unit is None else str(host.unit)
        answer = host.detail if host.state == "modbus" else f"no Modbus: {host.detail}"
        identity = showing.plain(str(host.identity))
        self._report.text(self._row.format(host.url, unit, answer, identity).rstrip())
        self._report.entry(_host(host))


def _answering(found: Iterable[Host]) -> int:
    return sum(host.state == "modbus" for host in found)


def _host(host: Host) -> dict[str, object]:
    return {
        "address": host.address,
        "url": host.url,
        "modbus": host.state == "modbus",
        "unit": host.unit,
        "detail": host.detail,
        "identification": dict(host.identity.objects),
    }


def _counted(counts: Counter[State], total: int, left: int) -> str:
    return (
        f"{showing.counted(total, 'address')}: {counts['modbus']} answer Modbus, "
        f"{counts['open']} accept connections but do not answer Modbus, "
        f"{counts['refused']} refuse them, {counts['silent']} do not respond"
        + (f", {left} were not asked" if left else "")
    )

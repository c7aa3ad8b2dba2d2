"""`holdfast find NETWORK`: hosts that answer Modbus TCP."""

from __future__ import annotations

import asyncio
import json
import sys
from collections import Counter
from typing import TYPE_CHECKING

import click

from holdfast.cli import device, showing
from holdfast.cli.progress import bar
from holdfast.config.ip_addresses import parse_source
from holdfast.tools import finding

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.net.addresses import Network
    from holdfast.tools.finding import Host, State

CONCURRENCY = 64
"""Hosts at a time."""


def find_hosts(
    networks: Sequence[Network],
    port: int,
    units: Sequence[int],
    timeout: float,
    rate: float,
    as_json: bool,
) -> None:
    """Finds hosts, prints them, and exits with 1 if there are none."""
    total = sum(1 for _ in finding.addresses(networks))
    if sys.stderr.isatty():
        click.echo(
            f"{showing.counted(total, 'address')}, port {port}, at most {rate:g} connections a "
            f"second. Ctrl-C stops.",
            err=True,
        )
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
        with bar("Finding", total, lambda: f"{_answering(found)} found") as advance:
            async for host in seen:
                found.append(host)
                if advance:
                    advance(len(found))

    interrupted = False
    try:
        asyncio.run(look())
    except KeyboardInterrupt:
        interrupted = True
    found.sort(key=lambda host: parse_source(host.address))
    counts = Counter(host.state for host in found)
    if as_json:
        told = {
            "ok": not interrupted and counts["modbus"] > 0,
            "complete": not interrupted,
            "port": port,
            "asked": len(found),
            "not_asked": total - len(found),
            "counts": {state: counts[state] for state in ("modbus", "open", "refused", "silent")},
            "hosts": [_host(host) for host in found if host.state in ("modbus", "open")],
        }
        click.echo(json.dumps(told, indent=2))
    else:
        click.echo("\n".join(_hosts(found, counts, total)))
        if interrupted:
            click.echo("holdfast: interrupted", err=True)
    if interrupted or not counts["modbus"]:
        sys.exit(device.FAILED)


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


def _hosts(found: Sequence[Host], counts: Counter[State], total: int) -> list[str]:
    rows = [
        (
            host.url,
            "" if host.unit is None else str(host.unit),
            host.detail if host.state == "modbus" else f"no Modbus: {host.detail}",
            showing.plain(str(host.identity)),
        )
        for host in found
        if host.state in ("modbus", "open")
    ]
    lines = showing.table(("url", "unit", "answer", "identification"), rows, "<>") if rows else []
    left = total - len(found)
    return [
        *lines,
        *([""] if lines else []),
        f"{showing.counted(total, 'address')}: {counts['modbus']} answer Modbus, "
        f"{counts['open']} accept connections but do not answer Modbus, "
        f"{counts['refused']} refuse them, {counts['silent']} do not respond"
        + (f", {left} were not asked" if left else ""),
    ]

"""Compares Raw Ingest, with one connection per packet, with a loop that does not parse packets.

The servers share one core, the load has the other. The bare loop accepts a connection, reads the
known size of a packet, answers one byte and closes. Each packet has its own connection; the latency
is the time from the start of connecting to the reply.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass, field

import common
from common import Result, Server

from holdfast import raw_ingest

REGISTERS = (3, 125, 5000)
IN_FLIGHT = (1, 16)
FORMATS = ("v1", "crc")
CONFIGURATION = """
memories:
  plant: {id: 1, holding_registers: 5000}
listeners:
  v1:
    type: raw-ingest
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.1], units: {1: plant}, areas: [holding_registers]}]
  crc:
    type: raw-ingest
    format: crc
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.1], memories: [plant], areas: [holding_registers]}]
  modbus:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.1], units: {1: plant}, access: read-only}]
"""


@dataclass
class Scenario:
    """The results for one kind of packet and one number of packets in flight."""

    format: str
    registers: int
    in_flight: int
    rounds: list[dict[str, Result]] = field(default_factory=list)


def main() -> None:
    """Prints a line for each scenario, and writes all results to the file of `--json`."""
    options = common.parsed(common.parser(__doc__, seconds=1, rounds=7))
    print(
        "\npacket      in    holdfast     bare  p99 us, each  cpu us, each   load's core  "
        "holdfast against bare (min to max)\n"
        "        flight  packets/s                                                        "
        "packets a second      cpu a packet"
    )
    scenarios = []
    with common.appliance(CONFIGURATION, options.core, listeners=3) as holdfast:
        for form in FORMATS:
            for registers in REGISTERS:
                packet = encoded(form, registers)
                check(holdfast, form, registers, packet)
                limit = common.bench("bare-once", "--packet-len", len(packet))
                with common.started("bare", limit, options.core) as bare:
                    for in_flight in IN_FLIGHT:
                        scenario = Scenario(form, registers, in_flight)
                        measure(scenario, packet, holdfast, bare, options)
                        show(scenario)
                        scenarios.append(scenario)
    if options.json:
        options.json.write_text(json.dumps([asdict(one) for one in scenarios], indent=1))


def encoded(form: str, registers: int) -> bytes:
    values = [(7 * address + registers) % 65536 for address in range(registers)]
    if form == "v1":
        return raw_ingest.encode("holding_registers", 0, values, unit=1)
    return raw_ingest.encode("holding_registers", 0, values, memory_id=1)


def check(holdfast: Server, form: str, registers: int, packet: bytes) -> None:
    """Sends one packet, and checks over Modbus that it was written."""
    host, _, port = holdfast.addresses[form].rpartition(":")
    raw_ingest.send_packet_sync(host, int(port), packet)
    quantity = min(registers, 125)
    header = 10 if form == "v1" else 12
    written = common.ask(holdfast.addresses["modbus"], quantity)[9:]
    if written != packet[header : header + 2 * quantity]:
        raise RuntimeError("the memory does not hold what was sent")


def measure(
    scenario: Scenario, packet: bytes, holdfast: Server, bare: Server, options: argparse.Namespace
) -> None:
    """Measures both servers once per round."""
    servers = {
        "holdfast": (holdfast, holdfast.addresses[scenario.format]),
        "bare": (bare, bare.address),
    }
    for index in range(options.rounds):
        results = {}
        for name in common.turns(list(servers), index):
            server, address = servers[name]
            command = common.bench(
                "load-once",
                *("--address", address),
                *("--packet", packet.hex()),
                *("--in-flight", scenario.in_flight),
            )
            results[name] = common.load(command, options.seconds, options.other, server)
        scenario.rounds.append(results)


def show(scenario: Scenario) -> None:
    """Prints one line. A `load's core` near 100 % means that the load limits the result."""
    rounds, keys = scenario.rounds, ("rate", "p99", "server_us", "busy")
    rate, p99, cpu, busy = common.medians(rounds, "holdfast", *keys)
    bare_rate, bare_p99, bare_cpu, bare_busy = common.medians(rounds, "bare", *keys)
    packet = f"{scenario.format} {scenario.registers}"
    print(
        f"{packet:9} {scenario.in_flight:4}  {rate:10,.0f} {bare_rate:8,.0f}"
        f"  {p99:6.0f} {bare_p99:6.0f}  {cpu:5.1f} {bare_cpu:5.1f}  {busy:6.0%} {bare_busy:5.0%}"
        f"   {common.ratio(rounds, 'holdfast', 'bare')}"
        f"  {common.ratio(rounds, 'holdfast', 'bare', 'server_us')}"
    )
    sys.stdout.flush()


if __name__ == "__main__":
    main()

"""The Modbus Memory Appliance, first generation (Go): `HOLDFAST_ORIGINAL_MMA1`.

The command gets no arguments: the program reads `config.yaml` in its folder. It listens on all
addresses. No package registry has it under the path of its module.

The inputs are the recorded ones of `tests/importing/mma_run.json`, whose differences are
explained there, so this also shows that the record is right; then its restore of a sealed memory
over MQTT.
"""

from __future__ import annotations

import json
import re
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from holdfast.appliance import Appliance
from holdfast.config import load
from holdfast.config.dump import to_yaml
from peers.originals.comparison import Difference, Original, Reason, is_open
from support import wire
from support.brokers import Mosquitto
from support.exchanges import play
from support.imported import imported
from support.paths import TESTS
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

    from peers.originals.comparison import Answers, Command, Launch

    Addresses = Mapping[str, tuple[str, int]]
    Started = AbstractContextManager[Addresses]

PAGE = "moving-from-mma.md"
CONFIGURATION = (TESTS / "importing" / "mma_run.yaml").read_text()
RECORDED = json.loads((TESTS / "importing" / "mma_run.json").read_text())
SCENARIOS: list[dict[str, Any]] = RECORDED["scenarios"]
NAMES = {"15025": "raw", "15026": "rest"}
"""Ports of the configuration by their names in the record; others are named by their number."""

SEALED = """\
memory:
  memories:
    plant:
      default: true
      coils: {start: 0, size: 8}
      discrete_inputs: {start: 0, size: 8}
      holding_registers: {start: 0, size: 8}
      input_registers: {start: 0, size: 8}
      state_sealing: {enable: true, gate: {area: discrete_inputs, address: 7}}
routing:
  unit_id_map: {1: plant}
ports:
  15021: {unit_ids: all, memories: all, access: read-write}
mqtt: {enabled: true, broker: "tcp://BROKER", client_id: mma, topic: mma/ingest}
"""
READS = {"coils": 1, "discrete_inputs": 2, "holding_registers": 3, "input_registers": 4}


def recorded_differences() -> Iterator[Difference]:
    """Returns the rows of the record, each with the first of its reasons."""
    for scenario in SCENARIOS:
        for name, exchange in _named(scenario):
            if "differs" in exchange:
                words = RECORDED["differences"][exchange["differs"][0]]
                reason = Reason(words, PAGE, words)
                yield Difference(name, exchange["mma"], exchange["holdfast"], reason)


def _named(scenario: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Returns the exchanges of a scenario by names that occur once."""
    for number, exchange in enumerate(scenario["exchanges"], 1):
        yield f"{scenario['name']}, {number}: {exchange['name']}", exchange


def theirs(command: Command, folder: Path) -> Answers:
    @contextmanager
    def started(text: str) -> Iterator[Addresses]:
        named = sorted(set(re.findall(r"\b150\d\d\b", text)))

        def configure(ports: Sequence[int]) -> Launch:
            changed = dict(zip(named, ports, strict=True))
            changed_text = re.sub(r"\b150\d\d\b", lambda found: str(changed[found[0]]), text)
            (folder / "config.yaml").write_text(changed_text)
            return (), {}

        with command.serving(folder, len(named), configure) as ports:
            found = zip(named, ports, strict=True)
            yield {NAMES.get(port, port): ("127.0.0.1", free) for port, free in found}

    return answers(started, folder)


def ours(folder: Path) -> Answers:
    @contextmanager
    def started(text: str) -> Iterator[Addresses]:
        data = imported(text, folder, keep_published_tokens=True)
        data["identity"] = {"vendor_name": "V", "product_code": "P", "revision": "1"}
        (folder / "holdfast.yaml").write_text(to_yaml(data))
        with Appliance(load(folder / "holdfast.yaml")) as appliance:
            names = {name.removeprefix("port-"): name for name in data["listeners"]}
            names = {short.removesuffix("-ingest"): name for short, name in names.items()}
            names |= {"rest": "rest"} if "rest" in data else {}
            yield {short: endpoint(appliance, name) for short, name in names.items()}

    return answers(started, folder)


def answers(started: Callable[[str], Started], folder: Path) -> Answers:
    """Plays all scenarios, each with a program of its own. None: the program has ended."""
    found: Answers = {}
    for scenario in SCENARIOS:
        with ExitStack() as running:
            addresses = running.enter_context(started(CONFIGURATION))
            for name, exchange in _named(scenario):
                found[name] = play(exchange, addresses)
                if found[name] == "" and exchange["mma"] is None and _is_gone(addresses):
                    found[name] = None
                    running.close()
                    addresses = running.enter_context(started(CONFIGURATION))
    return found | restored(started, folder)


def _is_gone(addresses: Addresses) -> bool:
    """Tells whether a program that closed a connection has ended, which may take a moment."""
    try:
        wire.until(lambda: not is_open(addresses["15021"][1]), "it ends", 1)
    except AssertionError:
        return False
    return True


def restored(started: Callable[[str], Started], folder: Path) -> Answers:
    """Restores a sealed memory over MQTT, opens it, and reads it back over Modbus."""
    broker = Mosquitto(folder)
    try:
        text = SEALED.replace("BROKER", f"127.0.0.1:{broker.port}")
        with started(text) as addresses, wire.Connection(addresses["15021"]) as client:
            wire.until(lambda: "SUBSCRIBE" in broker.log, "it has subscribed")
            sealed = client.ask(bytes.fromhex("0300000001"))
            for area, value in RESTORED.items():
                _publish(broker, area, 0, value)
            _publish(broker, "discrete_inputs", 7, {"bools": [1]})
            wire.until(lambda: _read(client, "coils")[0] < 0x80, "the memory is open")
            found = {f"restore: {area}": _read(client, area).hex() for area in READS}
            # What follows is refused for coils and holding registers.
            for area, value in REFUSED.items():
                _publish(broker, area, 4, value)
            _publish(broker, "input_registers", 7, {"values": [1]})
            wire.until(lambda: _read(client, "input_registers")[-1] == 1, "the last one is there")
            found |= {f"after the restore: {area}": _read(client, area).hex() for area in READS}
            return {"restore: before": sealed.hex(), **found}
    finally:
        broker.kill()


RESTORED: dict[str, dict[str, list[int]]] = {
    "coils": {"bools": [1, 0, 1]},
    "discrete_inputs": {"bools": [1, 1]},
    "holding_registers": {"values": [100, 200, 300]},
    "input_registers": {"values": [7]},
}
REFUSED: dict[str, dict[str, list[int]]] = {
    "coils": {"bools": [1]},
    "holding_registers": {"values": [9]},
}


def _publish(broker: Mosquitto, area: str, address: int, value: dict[str, list[int]]) -> None:
    command = {"memory": "plant", "area": area, "address": address, **value}
    broker.publish("mma/ingest", json.dumps(command))


def _read(client: wire.Connection, area: str) -> bytes:
    return client.ask(bytes([READS[area], 0, 0, 0, 8]))


ORIGINAL = Original(
    name="MMA, first generation",
    variable="HOLDFAST_ORIGINAL_MMA1",
    differences=(
        *recorded_differences(),
        Difference(
            "restore: before",
            "8301",
            "8306",
            Reason("busy is temporary", PAGE, RECORDED["differences"]["sealed"]),
        ),
    ),
    theirs=theirs,
    ours=ours,
)

"""Real databases take what outputs send, and what Prometheus scrapes."""

from __future__ import annotations

import json
import subprocess
import urllib.request
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.appliance import Appliance
from holdfast.config import load
from support import wire
from support.databases import InfluxDb, Prometheus, VictoriaMetrics
from support.machine import tool
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.running import Serve

TAGS = {
    "count": {"area": "holding_registers", "address": 0},
    "voltage": {"area": "holding_registers", "address": 2, "type": "float32", "unit": "V"},
    "energy": {"area": "holding_registers", "address": 4, "type": "uint64", "unit": "Wh"},
    "on": {"area": "coils", "address": 0},
    "label": {"area": "holding_registers", "address": 8, "type": "string:8"},
}
LABEL = [0x610A, 0x2262, 0x222C, 0x633D]
"""The text `a "b",c=` with a newline in place of the blank."""


@pytest.fixture
def memory() -> holdfast.Memory:
    made = holdfast.Memory(holding_registers=20, coils=8)
    made.write("holding_registers", 2, holdfast.values.encode(230.1, "float32"))
    made.write("holding_registers", 4, holdfast.values.encode(2**63, "uint64"))
    made.write("holding_registers", 8, LABEL)
    return made


@pytest.fixture
def device(memory: holdfast.Memory, serve: Serve) -> dict[str, Any]:
    port = serve({1: memory}).address[1]
    return {"url": f"tcp://127.0.0.1:{port}", "interval": 0.05, "tags": TAGS}


def appliance(folder: Path, device: dict[str, Any], **more: Any) -> Appliance:
    file = folder / "appliance.yaml"
    file.write_text(json.dumps({"devices": {"m": device}, **more}))
    return Appliance(load(file))


@pytest.fixture
def influx(tmp_path: Path) -> Iterator[InfluxDb]:
    database = InfluxDb(tmp_path)
    database.post("/query", q="CREATE DATABASE plant")
    yield database
    database.kill()


@pytest.fixture
def victoria(tmp_path: Path) -> Iterator[VictoriaMetrics]:
    database = VictoriaMetrics(tmp_path)
    yield database
    database.kill()


def test_influxdb_has_every_value_in_its_kind(
    tmp_path: Path, device: dict[str, Any], influx: InfluxDb, memory: holdfast.Memory
) -> None:
    output = {"type": "influx", "url": f"{influx.url}/write?db=plant", "tags": {"site": "n"}}
    with appliance(tmp_path, device, outputs={"db": output}):
        for number in range(1, 21):
            memory.write("holding_registers", 0, [number])
            wire.until(_has(influx, number), "the value is there")
    kinds = {row["fieldKey"]: row["fieldType"] for row in influx.rows("SHOW FIELD KEYS")}
    assert kinds == {
        "count": "integer",
        "voltage": "float",
        "energy": "float",
        "on": "boolean",
        "label": "string",
    }
    counts = [row["count"] for row in influx.rows("SELECT count FROM modbus")]
    assert counts[-20:] == list(range(1, 21))
    [last] = influx.rows('SELECT last("voltage") AS v FROM modbus GROUP BY device, site')
    assert (last["device"], last["site"], last["v"]) == ("m", "n", 230.1)
    [text] = influx.rows('SELECT last("label") AS v FROM modbus')
    assert text["v"] == r'a\n"b",c='
    [energy] = influx.rows('SELECT last("energy") AS v FROM modbus')
    assert float(energy["v"]) == float(2**63)


def _has(influx: InfluxDb, number: int) -> Any:
    return lambda: influx.rows(f"SELECT count FROM modbus WHERE count = {number}")


def test_nothing_is_lost_while_influxdb_is_away(
    tmp_path: Path, device: dict[str, Any], influx: InfluxDb, memory: holdfast.Memory
) -> None:
    output = {"type": "influx", "url": f"{influx.url}/write?db=plant"}
    table = {"type": "file", "file": "all.jsonl", "format": "jsonl"}
    output["buffer"] = {"file": "kept.db"}  # type: ignore[assignment]
    with appliance(tmp_path, device, outputs={"db": output, "table": table}) as running:
        memory.write("holding_registers", 0, [1])
        wire.until(_has(influx, 1), "the first value is there")
        influx.kill()
        for number in range(2, 30):
            memory.write("holding_registers", 0, [number])
            wire.until(lambda: _counts(tmp_path)[-1] == number, "it was polled")  # noqa: B023
        status = running.diagnostics.adapter("output/db")
        assert status is not None
        wire.until(lambda: not _connected(running), "the outage is noticed")
        influx.start()
        wire.until(lambda: _connected(running), "it is back", 3 * wire.DEADLINE)
        wire.until(_has(influx, 29), "the last value is there")
    counts = [row["count"] for row in influx.rows("SELECT count FROM modbus ORDER BY time")]
    assert counts == _counts(tmp_path)


def _connected(running: Appliance) -> bool:
    status = running.diagnostics.adapter("output/db")
    return status is not None and bool(status["connected"])


def _counts(folder: Path) -> list[int]:
    rows = [json.loads(line) for line in (folder / "all.jsonl").read_text().splitlines()]
    return [row["value"] for row in rows if row["tag"] == "count"]


def test_victoriametrics_takes_the_same_lines(
    tmp_path: Path, device: dict[str, Any], victoria: VictoriaMetrics, memory: holdfast.Memory
) -> None:
    output = {"type": "influx", "url": f"{victoria.url}/write", "publish": "change"}
    with appliance(tmp_path, device, outputs={"db": output}):
        for number in range(1, 6):
            memory.write("holding_registers", 0, [number])
            wire.until(
                lambda: victoria.values("modbus_count")[-1:] == [number],  # noqa: B023
                "the value is there",
            )
    assert victoria.values("modbus_count")[-5:] == [1, 2, 3, 4, 5]
    assert victoria.values("modbus_voltage") == [230.1]
    assert victoria.values("modbus_on") == [0]


def test_prometheus_scrapes_values_and_promtool_finds_no_fault(
    tmp_path: Path, device: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    metrics = {"bind": "127.0.0.1:0", "values": True}
    with appliance(tmp_path, device, metrics=metrics) as running:
        host, port = endpoint(running, "metrics")
        monkeypatch.setattr(Prometheus, "target", (host, port))
        prometheus = Prometheus(tmp_path)
        try:
            expected = {
                ("m", "count"): 0.0,
                ("m", "voltage"): 230.1,
                ("m", "energy"): float(2**63),
                ("m", "on"): 0.0,
            }
            wire.until(
                lambda: prometheus.samples("holdfast_tag_value") == expected,
                "all values are scraped",
                3 * wire.DEADLINE,
            )
            assert set(prometheus.samples("holdfast_tag_age_seconds < 60")) == set(expected)
        finally:
            prometheus.kill()
        with urllib.request.urlopen(f"http://{host}:{port}/metrics") as answer:
            text = answer.read()
    checked = subprocess.run(
        [tool("promtool"), "check", "metrics"], input=text, capture_output=True
    )
    assert (checked.returncode, checked.stdout, checked.stderr) == (0, b"", b"")

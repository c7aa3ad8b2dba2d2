"""Appliances that share memories through a log in NATS JetStream."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import re
import shutil
import signal
import socket
import threading
from contextlib import ExitStack
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import nats
import pytest

import holdfast
from holdfast import _core
from holdfast.appliance import Appliance
from holdfast.appliance.parts.shared_logs import LogNotJoined
from holdfast.appliance.reload import ReloadRefused
from holdfast.cli.appliance import log_replay
from holdfast.config import load
from support import audits, event_streams, web, wire
from support.brokers import NatsServer, free_port
from support.cli import ServingCommand, done, early_lines, invoke, usage_error
from support.config_folder import Folder, written
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from holdfast.config import Config

Settings = dict[str, Any]

SHORT = {"write_timeout": 0.3}
"""For tests in which nothing is confirmed."""


@pytest.fixture
def server(tmp_path: Path) -> Iterator[NatsServer]:
    (tmp_path / "server").mkdir()
    server = NatsServer(tmp_path / "server")
    yield server
    server.kill()


def config(
    folder: Path,
    servers: list[str],
    name: str = "a",
    devices: Settings | None = None,
    **memory: Any,
) -> Config:
    """A node. `audit` is a file name, `log` has settings of the log, `memory` of the memory.

    Unless the test is about the timeout of writes, a loaded machine has the time to confirm them.
    """
    audit, log = memory.pop("audit", None), memory.pop("log", {})
    metrics = {"metrics": {"bind": "127.0.0.1:0"}} if memory.pop("metrics", False) else {}
    plant = {"holding_registers": 100, "coils": 16, "replicate": {"log": "site"}} | memory
    rules = [{"sources": ["127.0.0.0/8"], "units": {1: "plant"}, "access": "read-write"}]
    parts = {
        "devices": devices or {},
        "memories": {"plant": plant, "alone": {"holding_registers": 10}},
        "logs": {"site": {"servers": servers, "node": name, "write_timeout": 10} | log},
        "listeners": {"scada": {"type": "modbus-tcp", "bind": "127.0.0.1:0", "rules": rules}},
        "rest": {"bind": "127.0.0.1:0", "sources": ["127.0.0.0/8"], "tokens": "none"},
    } | ({} if audit is None else {"audit": {"file": audit}})
    parts |= metrics
    file = folder / f"{name}.yaml"
    file.write_text(written(parts))
    return load(file)


@pytest.fixture
def node(tmp_path: Path, server: NatsServer) -> Iterator[Callable[..., Appliance]]:
    with ExitStack() as running:

        def start(name: str, **memory: Any) -> Appliance:
            settings = config(tmp_path, [server.url], name, **memory)
            return running.enter_context(Appliance(settings))

        yield start


def ask(appliance: Appliance, pdu: str) -> str:
    with wire.Connection(endpoint(appliance, "scada")) as connection:
        return connection.ask(bytes.fromhex(pdu)).hex()


def register(appliance: Appliance, address: int = 3) -> int:
    return appliance.memories["plant"].read("holding_registers", address, 1)[0]


def test_a_write_to_one_node_is_read_from_all(node: Callable[..., Appliance]) -> None:
    one, two = node("a"), node("b")
    assert ask(one, "060003002a") == "060003002a"
    assert ask(one, "0300030001") == "0302002a"
    wire.until(lambda: register(two) == 42, "the other node has it")
    assert ask(two, "16000300f0000f") == "16000300f0000f"
    assert ask(two, "0300030001") == "0302002f"
    wire.until(lambda: register(one) == 0x2F, "the first node has it")


def test_a_batch_that_is_too_large_for_the_log_is_refused_for_good(
    node: Callable[..., Appliance],
) -> None:
    one = node("a", holding_registers=65_536)
    command = web.command("holding_registers", 0, [1] * 65_536, memory="plant")
    with contextlib.closing(web.Client(endpoint(one, "rest"))) as client:
        assert client.ingest([command] * 7).status == 200
        refused = client.ingest([command] * 8)
    assert (refused.status, refused.json["reason"]) == (413, "too_large")
    sizes = re.fullmatch(
        r"the step has (\d+) bytes, the log takes at most (\d+); nothing has changed",
        refused.json["detail"],
    )
    assert sizes is not None
    assert 2**21 > int(sizes[1]) > 2**20 > int(sizes[2])


def test_files_and_queues_are_those_of_all_nodes(node: Callable[..., Appliance]) -> None:
    one, two = (node(name, files={4: 300, 7: 2}, fifo=[3]) for name in "ab")
    both = "1514" + "06000400070002aaaabbbb" + "0600070001" + "0001cccc"
    assert ask(one, both) == both
    assert ask(one, both.replace("0600070001", "0600070002")) == "9502"
    assert ask(one, "0600030001") == "0600030001"
    wire.until(lambda: register(two) == 1, "the other node has it")
    read = "140e" + "06000400070002" + "06000700010001"
    for each in (one, two):
        assert ask(each, read) == "140a" + "0506aaaabbbb" + "0306cccc"
        assert ask(each, "180003") == "180004" + "00010000"


def ingest(appliance: Appliance, *commands: tuple[str, int]) -> int:
    """Writes by REST: a register of each memory. Returns the HTTP status."""
    batch = [
        {"memory": memory, "area": "holding_registers", "address": 5, "values": [value]}
        for memory, value in commands
    ]
    client = web.Client(endpoint(appliance, "rest"))
    try:
        return client.ingest(batch if len(batch) > 1 else batch[0]).status
    finally:
        client.close()


def test_the_audit_log_names_the_sequence_of_each_write(
    node: Callable[..., Appliance], tmp_path: Path, server: NatsServer
) -> None:
    one = node("a", audit="a.log")
    assert ask(one, "0600030001") == "0600030001"
    assert ask(one, "16000300f0000f") == "16000300f0000f"
    assert ingest(one, ("plant", 7)) == ingest(one, ("alone", 8)) == 200
    assert ingest(one, ("plant", 9), ("plant", 10)) == 200
    assert ask(one, "0603e80001") == "8602"
    lines = audits.await_writes(tmp_path / "a.log", 7)
    by_modbus, by_rest = (
        [of for of in lines if of["listener"] == who] for who in ("scada", "rest")
    )
    *_, refused = by_modbus
    assert (refused["outcome"], "log_sequence" in refused) == ("illegal_data_address", False)
    plant, alone, first, second = by_rest
    assert "log_sequence" not in alone
    assert first["log_sequence"] == second["log_sequence"], "a batch is one step"
    sequences = [of["log_sequence"] for of in (*by_modbus[:2], plant, first)]
    assert sequences == sorted(set(sequences))
    assert {of["outcome"] for of in (*by_modbus[:2], *by_rest)} == {"done"}
    file = str(tmp_path / "a.yaml")
    for sequence, value in zip(sequences, (1, 15, 15, 15), strict=True):
        values = done("log", "replay", file, "--to", str(sequence), "--values")
        assert f"plant holding_registers 3: {value}" in values
    assert server.url


def test_the_audit_log_says_which_writes_were_not_confirmed(
    node: Callable[..., Appliance], server: NatsServer, tmp_path: Path
) -> None:
    one = node("a", audit="a.log", log=SHORT)
    server.freeze()
    try:
        assert ingest(one, ("plant", 7), ("plant", 8)) == 504
    finally:
        server.thaw()
    unclear = audits.await_writes(tmp_path / "a.log", 2)
    assert [(of["outcome"], of["values"]) for of in unclear] == [
        ("not_confirmed", [7]),
        ("not_confirmed", [8]),
    ]
    server.kill()
    wire.until(lambda: not one.replicas()["site"]["connected"], "it notices")
    assert ingest(one, ("plant", 9)) == 503
    *_, refused = audits.await_writes(tmp_path / "a.log", 3)
    assert (refused["outcome"], len(audits.writes(tmp_path / "a.log"))) == ("log_unavailable", 3)


def test_a_change_stream_of_a_node_that_is_behind_says_so(
    node: Callable[..., Appliance], server: NatsServer
) -> None:
    one = node("a", log={"when_behind": "refuse", "max_lag": 1})
    wire.until(lambda: ask(one, "060003002a") == "060003002a", "it is written")
    place = "memory=plant&area=holding_registers&address=3&count=1&min_interval=0.05"
    path = f"/api/v1/memory/changes?{place}"
    stream = event_streams.opened(endpoint(one, "rest"), path)
    try:
        # On a loaded machine, the node may be behind now and then.
        events = iter(stream)
        while next(events).name != "values":
            pass
        server.kill()
        while (event := next(events)).name != "unavailable":
            assert event.data["values"] == [42]
        assert event.data["reason"] == "log_unavailable"
        assert "contact" in event.data["detail"]
        server.start()
        event = next(events)
        assert (event.name, event.data["address"], event.data["values"]) == ("values", 3, [42])
    finally:
        stream.close()


def test_masks_of_all_nodes_at_once_have_one_order(node: Callable[..., Appliance]) -> None:
    nodes = [node(name) for name in "abc"]

    def toggle(of: Appliance, bit: int) -> None:
        others = f"160003{0xFFFF ^ 1 << bit:04x}"
        set_, clear = f"{others}{1 << bit:04x}", f"{others}0000"
        with wire.Connection(endpoint(of, "scada")) as connection:
            for pdu in map(bytes.fromhex, [set_, clear] * 40 + [set_]):
                assert connection.ask(pdu) == pdu

    threads = [threading.Thread(target=toggle, args=(of, bit)) for bit, of in enumerate(nodes)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(wire.DEADLINE)
    wire.until(lambda: [register(of) for of in nodes] == [7, 7, 7], "all bits are set everywhere")


def test_contents_survive_all_nodes(
    node: Callable[..., Appliance], server: NatsServer, tmp_path: Path
) -> None:
    (tmp_path / "values.csv").write_text("holding_registers,1,7\n")
    first = node("a", initial="values.csv")
    assert register(first, 1) == 7
    first.memories["plant"].write("holding_registers", 1, [8])
    first.stop()
    with Appliance(config(tmp_path, [server.url], "b", initial="values.csv")) as second:
        assert register(second, 1) == 8


def test_a_seal_is_closed_again_unless_another_node_runs(
    node: Callable[..., Appliance], server: NatsServer, tmp_path: Path
) -> None:
    sealed = {"seal": {"area": "coils", "address": 15, "mode": "once"}}
    read, refused = "0300030001", "8306"
    first = node("a", **sealed)
    first.memories["plant"].write("coils", 15, [True])
    first.stop()
    with Appliance(config(tmp_path, [server.url], "a", **sealed)) as alone:
        assert ask(alone, read) == refused
        assert alone.memories["plant"].read("coils", 15, 1) == [False]
        alone.memories["plant"].write("coils", 15, [True])
        node("b", **sealed)
    again = node("a", **sealed)
    assert ask(again, read) == "03020000"


def test_a_node_that_keeps_its_memory_does_not_go_back_with_its_servers(
    tmp_path: Path, server: NatsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, copy, file = tmp_path / "server/store", tmp_path / "copy", tmp_path / "plant.redb"
    settings = config(tmp_path, [server.url], keep={"file": "plant.redb"})
    with Appliance(settings) as node:
        node.memories["plant"].write("holding_registers", 1, [111])
    server.kill()
    shutil.copytree(store, copy)
    server.start()
    with Appliance(settings) as node:
        assert register(node, 1) == 111
        for _ in range(5):
            node.memories["plant"].write("holding_registers", 1, [222])
    server.kill()
    shutil.rmtree(store)
    copy.rename(store)
    server.start()
    monkeypatch.setattr(_core, "Log", functools.partial(_core.Log, cut_off=0))
    with pytest.raises(LogNotJoined, match="the servers have lost messages") as raised:
        Appliance(settings).start()
    assert raised.value.is_permanent, "another start changes nothing"
    found = re.search(
        r"logs\.site: the stream ends at sequence (\d+) \(\S+Z\), but this node has applied "
        r"sequence (\d+) \(\S+Z\)",
        str(raised.value),
    )
    assert found is not None, raised.value
    assert int(found[1]) < int(found[2])
    assert f"are kept in {file}. Stop all nodes and decide" in str(raised.value)
    # The contents of the node, in a new log.
    done("memory", "export", str(file), "--output", str(tmp_path / "values.csv"))
    file.rename(tmp_path / "before.redb")
    config(tmp_path, [server.url], "b", keep={"file": "plant.redb"}, initial="values.csv")
    (tmp_path / "b.yaml").write_text((tmp_path / "b.yaml").read_text().replace("site", "again"))
    with Appliance(load(tmp_path / "b.yaml")) as node:
        assert register(node, 1) == 222
    # Those of the log.
    file.unlink()
    with Appliance(settings) as node:
        assert register(node, 1) == 111


def test_nothing_is_imported_into_the_file_of_a_log(tmp_path: Path, server: NatsServer) -> None:
    settings, file = config(tmp_path, [server.url], keep={"file": "plant.redb"}), "plant.redb"
    with Appliance(settings) as node:
        node.memories["plant"].write("holding_registers", 1, [111])
    (tmp_path / "values.csv").write_text("holding_registers,1,7\n")
    result = invoke("memory", "import", str(tmp_path / file), str(tmp_path / "values.csv"))
    assert (result.exit_code, result.stdout) == (2, "")
    assert f"{file}: the file is of a log, which alone changes it" in result.stderr
    with Appliance(settings) as node:
        assert register(node, 1) == 111


def test_without_its_log_a_node_reads_and_does_not_write(
    node: Callable[..., Appliance], server: NatsServer
) -> None:
    one = node("a")
    assert ask(one, "0600030001") == "0600030001"
    server.kill()
    wire.until(lambda: not one.replicas()["site"]["connected"], "it notices")
    assert ask(one, "0600030002") == "8606"
    assert ask(one, "0300030001") == "03020001"
    with pytest.raises(OSError, match="can't be reached"):
        one.memories["plant"].write("holding_registers", 3, [2])
    one.memories["alone"].write("holding_registers", 3, [2])
    server.start()
    wire.until(lambda: ask(one, "0600030003") == "0600030003", "it comes back")


def test_a_server_that_does_not_answer_confirms_nothing(
    node: Callable[..., Appliance], server: NatsServer
) -> None:
    one = node("a", log=SHORT)
    server.freeze()
    try:
        assert ask(one, "0600030002") == "8604"
        assert register(one) == 0
    finally:
        server.thaw()
    # It may still be carried out.
    wire.until(lambda: register(one) in (0, 2) and ask(one, "0600030005")[:2] == "06", "it is back")


def test_a_log_that_does_not_answer_does_not_hold_up_devices(
    server: NatsServer, tmp_path: Path
) -> None:
    source = holdfast.Memory(holding_registers=10)
    with holdfast.Server({1: source}, bind="127.0.0.1:0", access="read-write") as device:
        host, port = device.address

        def polled(into: str) -> Settings:
            read = {"area": "holding_registers", "address": 0, "count": 10}
            read |= {"into": {"memory": into, "area": "holding_registers", "address": 0}}
            url = f"tcp://{host if into == 'plant' else 'localhost'}:{port}"
            return {"url": url, "unit": 1, "interval": 0.02, "reads": [read]}

        devices = {"shared": polled("plant"), "local": polled("alone")}
        with Appliance(
            config(tmp_path, [server.url], devices=devices, log={"write_timeout": 1})
        ) as one:

            def told(name: str) -> dict[str, Any]:
                found: dict[str, Any] = one.diagnostics.stats()["devices"][name]
                return found

            source.write("holding_registers", 3, [42])
            wire.until(lambda: register(one) == 42, "it is mirrored")
            server.freeze()
            try:
                wire.until(lambda: told("shared")["unstored"] > 0, "what is lost is counted")
                before = told("local")["polls"]
                # A write that waited for the log would take a second each.
                wire.until(lambda: told("local")["polls"] > before + 50, "polls go on")
                assert told("local")["health"] == "ok"
                wire.until(lambda: told("shared")["health"] == "standby", "its lease is over")
            finally:
                server.thaw()
            source.write("holding_registers", 3, [43])
            wire.until(lambda: register(one) == 43, "it is mirrored again")
            wire.until(lambda: told("shared")["health"] == "ok", "the device says so")


def test_other_areas_are_refused_and_named(
    node: Callable[..., Appliance], server: NatsServer, tmp_path: Path
) -> None:
    node("a")
    with pytest.raises(LogNotJoined, match=r"logs\.site: .*holding_registers") as caught:
        Appliance(config(tmp_path, [server.url], "b", holding_registers=99)).start()
    assert caught.value.is_permanent
    result = invoke("run", str(tmp_path / "b.yaml"))
    assert result.exit_code == 2
    # The log is written by a thread of its own, before or after this line.
    assert "holdfast: logs.site: " in {line[:21] for line in result.stderr.splitlines()}


def test_a_start_without_a_snapshot_may_succeed_later(
    node: Callable[..., Appliance], server: NatsServer, tmp_path: Path
) -> None:
    async def purge() -> None:
        client = await nats.connect(server.url)
        await client.jetstream().purge_stream("OBJ_holdfast-log-site")
        await client.close()

    node("a")
    asyncio.run(purge())
    other = config(tmp_path, [server.url], "b")
    with pytest.raises(LogNotJoined, match="it is missing: only the next snapshot of a") as caught:
        Appliance(other).start()
    assert not caught.value.is_permanent, "the node that runs will store another one"
    assert invoke("run", str(tmp_path / "b.yaml")).exit_code == 1


def test_a_log_has_no_room_for_a_further_node(tmp_path: Path, server: NatsServer) -> None:
    """As after many starts of a container that has a new name each time."""

    async def join() -> None:
        client = await nats.connect(server.url)
        jetstream = client.jetstream()
        for number in range(1, 1024):
            name, one = f"pod-{number}".encode(), (1).to_bytes(8, "little")
            message = b"HFL\x01\x00" + bytes([len(name)]) + name + one + one
            await jetstream.publish("holdfast.log.site.steps", message)
        await client.close()

    with Appliance(config(tmp_path, [server.url])):
        asyncio.run(join())
    with pytest.raises(LogNotJoined, match=r"logs\.site: the log has had 1024 nodes") as caught:
        Appliance(config(tmp_path, [server.url], "b")).start()
    assert caught.value.is_permanent


def test_a_change_of_logs_requires_a_restart(
    node: Callable[..., Appliance], server: NatsServer, tmp_path: Path
) -> None:
    one = node("a")
    with pytest.raises(ReloadRefused, match=r"logs: changed"):
        one.reload(config(tmp_path, [server.url, server.url.replace("127.0.0.1", "localhost")]))
    assert one.reload(config(tmp_path, [server.url])) == []


@pytest.mark.parametrize(
    ("more", "problem"),
    [
        ("memories: {plant: {coils: 8, replicate: {log: sit}}}", "found 'sit', allowed: site; did"),
        (
            "memories: {plant: {coils: 8, keep: {file: x, sync: 0}, replicate: {log: site}}}",
            "memories.plant.keep.sync: found 0, allowed with replicate: more than 0",
        ),
        (
            "memories: {plant: {coils: 8, keep: {file: x}, replicate: {log: site}}, "
            "own: {coils: 8, keep: {file: x}}}",
            "memories.plant.keep.file: found the file of own, which is not of this log",
        ),
        (
            "memories: {plant: {coils: 8, keep: {file: x}, replicate: {log: site}}, "
            "other: {coils: 8, replicate: {log: site}}}",
            "memories.other: missing, required: all memories of a log have keep if plant has",
        ),
    ],
)
def test_settings_are_checked(tmp_path: Path, more: str, problem: str) -> None:
    text = f"""
{more}
logs: {{site: {{servers: ["nats://127.0.0.1"], node: a}}}}
rest: {{bind: "127.0.0.1:0", tokens: none}}
"""
    assert any(problem in found for found in Folder(tmp_path).problems(text))


def test_a_log_that_no_memory_uses_is_doubtful(tmp_path: Path) -> None:
    text = """
memories: {plant: {coils: 8}}
logs: {site: {servers: ["nats://127.0.0.1"], node: a}}
rest: {bind: "127.0.0.1:0", sources: [127.0.0.0/8], tokens: none}
"""
    [warning] = Folder(tmp_path).warnings(text)
    assert "logs.site: has no effect: no memory is replicated through it" in warning


def test_a_message_with_a_broken_header_is_counted_and_logged(
    tmp_path: Path,
    server: NatsServer,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("holdfast.appliance.appliance.CHECK_INTERVAL_S", 0)
    with Appliance(config(tmp_path, [server.url], metrics=True)) as one:
        with socket.create_connection((server.host, server.port), wire.DEADLINE) as publisher:
            publisher.sendall(
                b'CONNECT {"headers":true}\r\n'
                b"HPUB holdfast.log.site.steps 12 19\r\nNATS/9.9\r\n\r\npayload\r\n"
            )
            wire.until(lambda: one.replicas()["site"]["ignored"] == 1, "it is ignored")
        wire.until(lambda: ask(one, "060003002a") == "060003002a", "it is connected again")
        client = web.Client(endpoint(one, "metrics"))
        shown = client.get("/metrics").body.decode()
        client.close()
        assert 'holdfast_log_messages_ignored_total{log="site"} 1.0' in shown
        one.log_events(0)
    [line] = [each for each in caplog.records if each.message == "log_message_ignored"]
    fields = line.__dict__["fields"]
    assert (fields["log"], fields["reason"]) == ("site", "it was not sent by a node")
    assert int(fields["sequence"]) > 0


def test_the_past_can_be_rebuilt(
    node: Callable[..., Appliance], tmp_path: Path, server: NatsServer
) -> None:
    one = node("a")
    for value in (1, 2, 3):
        ask(one, f"06000300{value:02x}")
    file = str(tmp_path / "a.yaml")
    last = one.replicas()["site"]["sequence"]
    head, *values = done("log", "replay", file, "--values")
    assert head.startswith(f"sequence {last}, digest ")
    assert values == ["plant holding_registers 3: 3"]
    before = done("log", "replay", file, "--to", str(last - 1), "--values")
    assert before[1:] == ["plant holding_registers 3: 2"]
    assert before[0] != head
    told = json.loads(invoke("log", "replay", file, "--json", "--values").stdout)
    row = {"memory": "plant", "area": "holding_registers", "address": 3, "value": 3}
    assert (told["sequence"], told["values"]) == (last, [row])
    assert server.url


def test_a_larger_memory_begins_a_new_log_with_the_values_of_the_old_one(
    node: Callable[..., Appliance], tmp_path: Path, server: NatsServer
) -> None:
    one = node("a", files={4: 2})
    ask(one, "060003002a")
    ask(one, "05000cff00")
    one.memories["plant"].write("file:4", 1, [7])
    one.stop()
    values = tmp_path / "plant.csv"
    done("log", "replay", str(tmp_path / "a.yaml"), "--output", str(values))
    config(tmp_path, [server.url], holding_registers=200, files={4: 9}, initial="plant.csv")
    file = tmp_path / "a.yaml"
    file.write_text(file.read_text().replace("site", "larger"))
    with Appliance(load(file)) as larger:
        assert ask(larger, "0300030001") == "0302002a"
        assert ask(larger, "01000c0001") == "010101"
        assert larger.memories["plant"].read("file:4", 0, 9) == [0, 7, *[0] * 7]
        assert ask(larger, "0600c70001") == "0600c70001"


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--output", "x.csv"], "the log has several memories, add --memory: plant, more"),
        (["--output", "x.csv", "--memory", "mor"], "no memory 'mor', allowed: plant, more; did"),
        (["--output", "x.json"], "found x.json, allowed: a file with one of .csv, .yaml, .yml"),
        (["--output", "x.csv", "--follow"], "--follow and --output can't be used together"),
        (["--values", "--follow"], "--follow and --values can't be used together"),
        (["--memory", "plant"], "--memory is for --output"),
    ],
    ids=["several", "unknown", "kind", "follow", "values", "alone"],
)
def test_a_replay_writes_one_memory(tmp_path: Path, options: list[str], told: str) -> None:
    file = tmp_path / "a.yaml"
    file.write_text(
        "memories: {plant: &memory {coils: 8, replicate: {log: site}}, more: *memory}\n"
        "logs: {site: {servers: ['nats://127.0.0.1:1'], node: a}}\n"
        "rest: {bind: 127.0.0.1:0, sources: [127.0.0.1], tokens: none}\n"
    )
    assert told in usage_error("log", "replay", str(file), *options)


def test_a_replay_that_follows_serves_what_it_has_followed(
    node: Callable[..., Appliance], tmp_path: Path
) -> None:
    # It proves its contact with messages without steps, and they print nothing.
    one = node("a", log={"max_lag": 0.2})
    ask(one, "060003002a")
    file = str(tmp_path / "a.yaml")
    replay = ServingCommand("log", "replay", file, "--follow", "--bind", "127.0.0.1:0")
    try:
        step, *_ = replay.wait_for_greeting().splitlines()
        assert step.endswith(" a plant holding_registers 3: 42")
        match = re.search(r"plant: tcp://([0-9.]+):([0-9]+), unit 1", replay.greeting)
        assert match, replay.greeting
        with wire.Connection((match[1], int(match[2]))) as connection:
            read = bytes.fromhex("0300030001")
            assert connection.ask(read).hex() == "0302002a"
            ask(one, "060003002b")
            wire.until(lambda: connection.ask(read).hex() == "0302002b", "it has followed")
        [step] = early_lines(replay.process, 1)
        assert step.endswith(" a plant holding_registers 3: 43\n")
    finally:
        replay.end(signal.SIGTERM)


def test_a_replay_to_before_or_behind_the_log_says_so(
    node: Callable[..., Appliance], tmp_path: Path
) -> None:
    one = node("a")
    ask(one, "060003002a")
    file = str(tmp_path / "a.yaml")
    one.stop()
    told = json.loads(invoke("log", "replay", file, "--json").stdout)
    last = told["sequence"]
    result = invoke("log", "replay", file, "--to", str(last + 1))
    assert (result.exit_code, result.stdout) == (1, "")
    expected = f"holdfast: logs.site: --to is {last + 1}, but the log ends at sequence {last}, 2"
    assert result.stderr.startswith(expected)
    result = invoke("log", "replay", file, "--to", "2000-01-01T00:00Z")
    assert (result.exit_code, result.stdout.split(",")[0]) == (0, "sequence 0")
    assert result.stderr == (
        "holdfast: --to is before the first message: these are the values that the log began with\n"
    )
    result = invoke("log", "replay", file, "--json", "--to", "2200-01-01T00:00Z")
    assert (result.exit_code, json.loads(result.stdout)) == (0, told)
    expected = f"holdfast: --to is after the last message: the log ends at sequence {last}, 2"
    assert result.stderr.startswith(expected)
    assert not invoke("log", "replay", file, "--to", str(last)).stderr


def test_a_log_without_messages_has_no_last_one(capsys: pytest.CaptureFixture[str]) -> None:
    empty: Any = SimpleNamespace(sequence=0, last_sequence=0, time_ns=0)
    log_replay._check_end(empty, None, 1)
    assert capsys.readouterr().err == (
        "holdfast: --to is before the first message: these are the values that the log began with\n"
    )
    with pytest.raises(ValueError, match="--to is 1, but the log has no message yet"):
        log_replay._check_end(empty, 1, None)


def test_a_log_that_is_not_there_can_not_be_replayed(tmp_path: Path) -> None:
    config(tmp_path, [f"nats://127.0.0.1:{free_port()}"])
    result = invoke("log", "replay", str(tmp_path / "a.yaml"))
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.startswith("holdfast: logs.site: ")


@pytest.mark.parametrize("to", ["yesterday", "9" * 30, "3000-01-01T00:00Z", "1900-01-01T00:00Z"])
def test_a_moment_that_no_log_can_have_is_wrong_usage(tmp_path: Path, to: str) -> None:
    config(tmp_path, ["nats://127.0.0.1:1"])
    told = usage_error("log", "replay", str(tmp_path / "a.yaml"), "--to", to)
    assert f"found '{to}', allowed: a sequence, or a time as in 2026-11-20T14:05:00Z" in told

"""`holdfast log`: from the server of one machine to three, without a change of memories."""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import nats
import pytest
from nats.errors import NoRespondersError

from holdfast.appliance import Appliance
from holdfast.config import load
from holdfast.replication import backup as log_backup
from support import nats_cluster, wire
from support.brokers import NatsServer, free_port
from support.cli import done, invoke
from support.machine import missing
from support.nats_keys import Operator, User

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(autouse=True)
def program() -> None:
    if not (Path(sys.executable).parent / "nats-server").exists():
        missing("the program nats-server")


def configuration(folder: Path, name: str = "plant", log: str = "site", **settings: Any) -> Path:
    """A node of the log; by default with a server of its own."""
    if not settings:
        settings = {"embedded": "log", "servers": [f"nats://127.0.0.1:{free_port()}"]}
    file = folder / f"{name}.yaml"
    parts = {
        "memories": {"plant": {"holding_registers": 100, "replicate": {"log": log}}},
        "logs": {log: {"node": "scada-a", **settings}},
        "rest": {"bind": "127.0.0.1:0", "sources": ["127.0.0.0/8"], "tokens": "none"},
    }
    file.write_text(json.dumps(parts))
    return file


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[list[NatsServer]]:
    """Three servers, which elect a leader."""
    for made in nats_cluster.running(tmp_path):
        yield list(made.servers.values())


def urls(servers: list[NatsServer]) -> list[str]:
    return [server.url for server in servers]


def register(appliance: Appliance, address: int) -> int:
    return appliance.memories["plant"].read("holding_registers", address, 1)[0]


def write(appliance: Appliance, address: int, value: int) -> None:
    """Writes until the log confirms it: servers may elect a leader."""

    def is_written() -> bool:
        try:
            appliance.memories["plant"].write("holding_registers", address, [value])
        except OSError:
            return False
        return True

    wire.until(is_written, "the write is confirmed")


def test_a_log_grows_from_one_server_to_three(tmp_path: Path, cluster: list[NatsServer]) -> None:
    alone = configuration(tmp_path)
    with Appliance(load(alone)) as appliance:
        for address in range(10):
            write(appliance, address, 40 + address)
        # Nodes may run, and what they write now may be missing.
        [head] = done("log", "backup", str(alone), str(tmp_path / "early"))
        assert head.startswith("Backed up: log site, ")
        write(appliance, 10, 7)
    done("log", "backup", str(alone), str(tmp_path / "backup"))
    grown = configuration(tmp_path, "grown", servers=urls(cluster), replicas=3)
    [head] = done("log", "restore", str(grown), str(tmp_path / "backup"))
    assert head.startswith("Restored: log site, ")
    assert head.endswith(" messages, 3 replicas.")
    with Appliance(load(grown)) as appliance:
        assert [register(appliance, each) for each in (0, 9, 10)] == [40, 49, 7]
        assert appliance.replicas()["site"]["replicas"] == 3
        cluster[0].kill()
        write(appliance, 11, 8)
        assert register(appliance, 11) == 8


def test_a_log_is_kept_by_as_many_servers_as_wanted(
    tmp_path: Path, cluster: list[NatsServer], caplog: pytest.LogCaptureFixture
) -> None:
    def told() -> list[dict[str, Any]]:
        return [vars(each)["fields"] for each in caplog.records if "replicas" in each.message]

    file = configuration(tmp_path, servers=urls(cluster))
    with Appliance(load(file)) as appliance:
        write(appliance, 1, 7)
    assert not told()
    file = configuration(tmp_path, servers=urls(cluster), replicas=3)
    with Appliance(load(file)) as appliance:

        def is_logged() -> bool:
            appliance.log_events(0)
            return bool(told())

        wire.until(is_logged, "the event is logged")
        assert told() == [{"log": "site", "replicas": "1", "configured": "3"}]
        assert appliance.replicas()["site"]["replicas"] == 1
        name = "holdfast-log-site"
        streams = [f"KV_{name}", f"OBJ_{name}", name, f"KV_{name}-leases"]
        assert done("log", "replicas", str(file)) == [f"{each}: 1 -> 3" for each in streams]
        assert done("log", "replicas", str(file)) == [f"{each}: 3" for each in streams]
        # Each session looks.
        used = appliance.replicas()["site"]["server"]
        server = next(each for each in cluster if each.url.endswith(used))
        server.kill()
        server.start()  # It may be the only one that has all messages yet.
        wire.until(lambda: appliance.replicas()["site"]["replicas"] == 3, "the node sees it")
        write(appliance, 1, 8)
    assert len(told()) == 1


def failed(*arguments: object) -> str:
    result = invoke("log", *map(str, arguments))
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.startswith("holdfast: logs.")
    return result.stderr


def test_what_can_not_be_restored_is_told_and_changes_nothing(tmp_path: Path) -> None:
    file, backup = configuration(tmp_path), tmp_path / "backup"
    with Appliance(load(file)) as appliance:
        write(appliance, 1, 7)
        done("log", "backup", str(file), str(backup))
        assert "backup: File exists" in failed("backup", file, backup)
        told = failed("restore", file, backup)
        assert "already have the log: KV_holdfast-log-site, OBJ_holdfast-log-site, " in told
        assert "delete" not in told  # Nodes use it.
        write(appliance, 1, 8)
    other = configuration(tmp_path, "other", "line")
    assert "a backup of the log site, not of line" in failed("restore", other, backup)
    assert "no/backup.json: No such file" in failed("restore", file, tmp_path / "no")
    data = backup / "holdfast-log-site"
    data.write_bytes(data.read_bytes()[:-1])
    assert "holdfast-log-site: damaged, its SHA-256" in failed("restore", file, backup)
    (backup / "backup.json").write_text("[]")
    assert "damaged, or not a backup of a log" in failed("restore", file, backup)


def test_a_part_that_a_server_refuses_leaves_nothing_behind(tmp_path: Path) -> None:
    file, backup = configuration(tmp_path), tmp_path / "backup"
    with Appliance(load(file)) as appliance:
        write(appliance, 1, 7)
        done("log", "backup", str(file), str(backup))
    (tmp_path / "server").mkdir()
    server = NatsServer(tmp_path / "server")
    try:
        # One server can't keep three replicas.
        file = configuration(tmp_path, servers=[server.url], replicas=3)
        assert "replicas > 1 not supported in non-clustered mode" in failed("restore", file, backup)
        file = configuration(tmp_path, servers=[server.url])
        done("log", "restore", str(file), str(backup))
        assert done("log", "replicas", str(file))[0] == "KV_holdfast-log-site: 1"
        with Appliance(load(file)) as appliance:
            assert register(appliance, 1) == 7
    finally:
        server.kill()


def streams(server: NatsServer) -> list[str]:
    async def found() -> list[str]:
        client = await nats.connect(server.url)
        answer = await client.request("$JS.API.STREAM.NAMES", b"")
        await client.close()
        return json.loads(answer.data)["streams"] or []

    return asyncio.run(found())


def delete(server: NatsServer, *names: str) -> None:
    async def deleted() -> None:
        client = await nats.connect(server.url)
        for name in names:
            await client.jetstream().delete_stream(name)
        await client.close()

    asyncio.run(deleted())


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGHUP")
def test_no_node_begins_with_a_restore_that_was_cut_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, backup = configuration(tmp_path), tmp_path / "backup"
    with Appliance(load(file)) as appliance:
        write(appliance, 1, 7)
    done("log", "backup", str(file), str(backup))
    (tmp_path / "server").mkdir()
    server = NatsServer(tmp_path / "server")
    file = configuration(tmp_path, servers=[server.url])
    send, clean_up, left = log_backup._send, log_backup._clean_up, list[str]()

    async def send_most(client: Any, stream: str, *more: Any) -> None:
        if stream.startswith("KV_"):
            signal.raise_signal(number)
            await asyncio.sleep(0)  # Ctrl-C ends it here.
        await send(client, stream, *more)

    async def note_and_clean_up(*arguments: Any) -> str | None:
        left.extend(await asyncio.to_thread(streams, server))
        return await clean_up(*arguments)

    async def fail_to_clean_up(*_: Any) -> None:
        raise log_backup.BackupFailed("no connection")

    # The tests may run in the background of a shell, or under nohup.
    usual: dict[signal.Signals, Any] = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    try:
        with monkeypatch.context() as patched:
            patched.setattr(log_backup, "_send", send_most)
            patched.setattr(log_backup, "_clean_up", note_and_clean_up)
            for number in usual:  # noqa: B007 - `send_most` raises it.
                left.clear()
                result = invoke("log", "restore", str(file), str(backup))
                assert (result.exit_code, result.output) == (1, "holdfast: interrupted\n")
                # What a process that was killed leaves: a log with messages and without the key,
                # which nodes refuse.
                assert sorted(left) == ["OBJ_holdfast-log-site", "holdfast-log-site"]
                assert not streams(server)
            patched.setattr(log_backup, "_clean_up", fail_to_clean_up)
            told = failed("restore", file, backup)
            assert "interrupted. What was restored could not be deleted, but no node begins" in told
        told = failed("restore", file, backup)
        assert "but no key of a snapshot" in told
        assert "if no node runs, delete these streams" in told
        delete(server, *streams(server))
        done("log", "restore", str(file), str(backup))
        assert "KV_holdfast-log-site" in streams(server)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        server.kill()


@pytest.mark.parametrize("kind", ["server", "cluster"])
def test_an_upload_that_was_cut_leaves_nothing_behind(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, backup = configuration(tmp_path), tmp_path / "backup"
    with Appliance(load(file)) as appliance:
        write(appliance, 1, 7)
    done("log", "backup", str(file), str(backup))
    monkeypatch.setattr(log_backup, "CHUNK_BYTES", 64)
    sent = log_backup._request

    async def send_one(client: Any, subject: str, payload: bytes) -> Any:
        reply = await sent(client, subject, payload)
        if len(payload) == 64:
            raise log_backup.BackupFailed("cut")
        return reply

    monkeypatch.setattr(log_backup, "_request", send_one)
    if kind == "cluster":
        servers = request.getfixturevalue("cluster")
        file = configuration(tmp_path, servers=urls(servers), replicas=3)
        assert failed("restore", file, backup) == "holdfast: logs.site: cut\n"
        # Without the deletion it would keep the name, and make a stream after some seconds.
        assert "holdfast-log-site" not in streams(servers[0])
        return
    (tmp_path / "server").mkdir()
    server = NatsServer(tmp_path / "server")
    try:

        async def look(*_: Any) -> None:
            assert not await asyncio.to_thread(streams, server)

        monkeypatch.setattr(log_backup, "_clean_up", look)
        file = configuration(tmp_path, servers=[server.url])
        assert failed("restore", file, backup) == "holdfast: logs.site: cut\n"
    finally:
        server.kill()


@pytest.mark.parametrize("begun", ["holdfast-log-site", "OBJ_holdfast-log-site"])
def test_a_restore_deletes_nothing_that_a_node_uses(
    begun: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node begins while the steps are sent, or one that still runs goes on with the steps."""
    (tmp_path / "server").mkdir()
    server, backup = NatsServer(tmp_path / "server"), tmp_path / "backup"
    file, send = configuration(tmp_path, servers=[server.url]), log_backup._send
    runs = begun == "OBJ_holdfast-log-site"
    try:
        with ExitStack() as stack, ExitStack() as former:
            node = former.enter_context(Appliance(load(file)))
            write(node, 1, 7)
            done("log", "backup", str(file), str(backup))
            if not runs:
                former.close()
            delete(server, *streams(server))

            async def send_late(client: Any, name: str, *more: Any) -> None:
                nonlocal node
                if name == begun:
                    if not runs:
                        node = Appliance(load(file))
                        await asyncio.to_thread(stack.enter_context, node)
                    await asyncio.to_thread(write, node, 2, 8)
                await send(client, name, *more)

            monkeypatch.setattr(log_backup, "_send", send_late)
            told = failed("restore", file, backup)
            assert (
                f"{begun}: stream name already in use, cannot restore. A node seems to run" in told
            )
            assert "nothing was deleted. Stop all nodes." in told
            assert {*log_backup.streams("site")} <= {*streams(server)}
            write(node, 3, 9)
            assert [register(node, each) for each in (2, 3)] == [8, 9]
    finally:
        server.kill()


class Servers:
    """A client whose servers know only after some attempts where a request goes."""

    def __init__(self, attempts: int) -> None:
        self.left = attempts

    async def request(self, *_: object, **__: object) -> Any:
        self.left -= 1
        if self.left >= 0:
            raise NoRespondersError
        return SimpleNamespace(data=b'{"config": {"num_replicas": 3}}')


def test_a_request_that_nobody_takes_yet_is_sent_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_backup, "RETRY_S", 0.001)
    config = log_backup._config(Servers(3), "site")  # type: ignore[arg-type]
    assert asyncio.run(config) == {"num_replicas": 3}
    monkeypatch.setattr(log_backup, "LEADER_TIMEOUT_S", 0.0)
    config = log_backup._config(Servers(10**6), "site")  # type: ignore[arg-type]
    with pytest.raises(
        log_backup.BackupFailed, match=r"STREAM\.INFO\.site: nobody answers; JetStream"
    ):
        asyncio.run(config)


def purge(server: NatsServer, stream: str) -> int:
    """Deletes all messages of a stream. Returns the sequence of the last one."""

    async def purged() -> int:
        client = await nats.connect(server.url)
        jetstream = client.jetstream()
        await jetstream.purge_stream(stream)
        last = (await jetstream.stream_info(stream)).state.last_seq
        await client.close()
        return last

    return asyncio.run(purged())


def test_a_log_that_can_not_be_rebuilt_is_not_backed_up(tmp_path: Path) -> None:
    (tmp_path / "server").mkdir()
    server, backup = NatsServer(tmp_path / "server"), tmp_path / "backup"
    file = configuration(tmp_path, servers=[server.url])
    try:
        with Appliance(load(file)) as appliance:
            write(appliance, 1, 7)
        last = purge(server, "holdfast-log-site")
        missing_steps = f"messages 1 to {last} behind the newest snapshot are missing: no node"
        assert missing_steps in failed("backup", file, backup)
        purge(server, "OBJ_holdfast-log-site")
        assert "OBJ_holdfast-log-site has no object 0-scada-a-" in failed("backup", file, backup)
        purge(server, "KV_holdfast-log-site")
        assert "KV_holdfast-log-site has no key snapshot: no" in failed("backup", file, backup)
    finally:
        server.kill()
    assert not backup.exists()


class Snapshots:
    """Replaces the snapshot of a log, as nodes do, when its keys or what they name was fetched."""

    def __init__(self, url: str, times: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.url, self.times, self.fetched = url, times, log_backup._fetch
        self.names: list[str] = []
        monkeypatch.setattr(log_backup, "_fetch", self.fetch)

    async def fetch(self, client: Any, name: str, file: Path) -> Any:
        if name.startswith("OBJ_") and len(self.names) < self.times:
            await self.replace()
        return await self.fetched(client, name, file)

    async def replace(self) -> None:
        client = await nats.connect(self.url)
        jetstream = client.jetstream()
        keys = await jetstream.key_value("holdfast-log-site")
        objects = await jetstream.object_store("holdfast-log-site")
        pointer = json.loads((await keys.get("snapshot")).value or b"")
        former, name = pointer["newest"]["object"], f"snapshot {len(self.names)}"
        await objects.put(name, (await objects.get(former)).data or b"")
        pointer["newest"]["object"] = name
        await keys.put("snapshot", json.dumps(pointer).encode())
        await objects.delete(former)
        self.names.append(name)
        await client.close()


def test_a_backup_begins_again_when_its_snapshot_was_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = [tmp_path / name for name in ("one", "other")]
    for folder in folders:
        folder.mkdir()
    one, other = map(NatsServer, folders)
    file = configuration(tmp_path, servers=[one.url])
    try:
        with Appliance(load(file)) as appliance:
            write(appliance, 1, 7)
        snapshots = Snapshots(one.url, log_backup.ATTEMPTS - 1, monkeypatch)
        done("log", "backup", str(file), str(tmp_path / "backup"))
        assert len(snapshots.names) == log_backup.ATTEMPTS - 1
        snapshots.times += log_backup.ATTEMPTS
        assert "have replaced the snapshot 5 times" in failed("backup", file, tmp_path / "late")
        file = configuration(tmp_path, servers=[other.url])
        done("log", "restore", str(file), str(tmp_path / "backup"))
        with Appliance(load(file)) as appliance:
            assert register(appliance, 1) == 7
    finally:
        one.kill()
        other.kill()
    assert not (tmp_path / "late").exists()


class Messages:
    """Servers that send one part of a stream."""

    def __init__(self, *states: tuple[int, int]) -> None:
        states_of = [dict(zip(("last_seq", "messages"), each, strict=True)) for each in states]
        self.answers = [{"config": {}, "state": each} for each in states_of]
        self.parts = [SimpleNamespace(data=data, reply="", headers=None) for data in (b"part", b"")]

    def new_inbox(self) -> str:
        return "inbox"

    async def subscribe(self, _: str) -> Any:
        async def next_msg(**_: object) -> object:
            return self.parts.pop(0)

        async def unsubscribe() -> None:
            pass

        return SimpleNamespace(next_msg=next_msg, unsubscribe=unsubscribe)

    async def request(self, *_: object, **__: object) -> Any:
        return SimpleNamespace(data=json.dumps(self.answers.pop(0)).encode())


def test_a_stream_that_loses_messages_while_it_is_fetched_is_fetched_again(tmp_path: Path) -> None:
    def fetch(*states: tuple[int, int]) -> dict[str, Any]:
        client: Any = Messages(*states)
        return asyncio.run(log_backup._fetch(client, "site", tmp_path / "site"))

    assert fetch((9, 5), (12, 8))["state"]["messages"] == 5  # Messages were added.
    with pytest.raises(log_backup._Replaced):
        fetch((9, 5), (12, 7))


def test_servers_without_the_log_are_told(tmp_path: Path) -> None:
    (tmp_path / "server").mkdir()
    server = NatsServer(tmp_path / "server")
    file = configuration(tmp_path, servers=[server.url])
    try:
        assert "stream not found" in failed("backup", file, tmp_path / "backup")
        assert "the servers don't have KV_holdfast-log-site" in failed("replicas", file)
    finally:
        server.kill()
    assert not (tmp_path / "backup").exists()
    assert failed("backup", file, tmp_path / "backup")


def test_a_restore_fits_the_limit_of_an_account(tmp_path: Path) -> None:
    alone = configuration(tmp_path)
    with Appliance(load(alone)) as appliance:
        for value in range(200):
            write(appliance, 1, value)
    done("log", "backup", str(alone), str(tmp_path / "backup"))
    operator = Operator()
    unlimited = dict.fromkeys(("mem_storage", "disk_storage", "streams", "consumer"), -1)
    account = operator.account(**unlimited, payload=2048)
    assert (tmp_path / "backup" / "holdfast-log-site").stat().st_size > 2048
    server = NatsServer(tmp_path, "-c", str(operator.configure(tmp_path / "nats.conf")))
    credentials = str(User(account).write(tmp_path / "node.creds"))
    file = configuration(tmp_path, servers=[server.url], credentials_file=credentials)
    try:
        done("log", "restore", str(file), str(tmp_path / "backup"))
        with Appliance(load(file)) as appliance:
            assert register(appliance, 1) == 199
    finally:
        server.kill()

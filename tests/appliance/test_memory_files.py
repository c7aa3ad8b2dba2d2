"""Memories that are kept: over restarts, with disks that fail, and what clients are told."""

from __future__ import annotations

import json
import re
import resource
import shutil
import signal
import socket
import urllib.error
import urllib.request
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast import _core
from holdfast._core import UnusableMemoryFile
from holdfast.appliance import Appliance
from holdfast.appliance.parts.memories import Memories, created
from holdfast.appliance.parts.part import Plan
from holdfast.appliance.reload import ReloadRefused
from holdfast.config import load
from support import wire
from support.cli import RunCommand, invoke
from support.config_folder import Folder, written
from support.machine import full_disk

if TYPE_CHECKING:
    from pathlib import Path

    from support import web

Settings = dict[str, Any]

UNUSED = {
    "scada": {
        "type": "modbus-tcp",
        "bind": "127.0.0.1:0",
        "rules": [{"sources": ["127.0.0.0/8"], "units": {1: "plant"}, "access": "read-write"}],
    }
}


def keeping(sync: float = 0, file: str = "plant.redb", **more: Any) -> Settings:
    return {"holding_registers": 100, "keep": {"file": file, "sync": sync}, **more}


def config(folder: Path, listeners: Settings = UNUSED, **memories: Settings) -> Any:
    """Loads a configuration; without memories, that of one that is kept."""
    parts = {"memories": memories or {"plant": keeping()}, "listeners": listeners}
    (folder / "p.yaml").write_text(written(parts))
    return load(folder / "p.yaml")


@pytest.mark.parametrize("sync", [0, 1, 3600])
def test_values_survive_a_restart(tmp_path: Path, sync: float) -> None:
    settings = config(tmp_path, plant=keeping(sync))
    appliance = Appliance(settings)
    for number in range(3):
        with appliance:
            memory = appliance.memories["plant"]
            assert memory.read("holding_registers", 5, 1) == [number]
            memory.write("holding_registers", 5, [number + 1])
    with Appliance(settings) as other:
        assert other.memories["plant"].read("holding_registers", 5, 1) == [3]


def test_a_crash_costs_at_most_a_second_by_default(tmp_path: Path) -> None:
    settings = config(tmp_path, plant={"coils": 8, "keep": {"file": "plant.redb"}})
    assert settings.memories["plant"].keep.sync == 1
    with Appliance(settings) as appliance:
        appliance.memories["plant"].write("coils", 0, [1])
    with Appliance(settings) as again:
        assert again.memories["plant"].read("coils", 0, 1) == [1]


def test_initial_values_are_those_of_the_first_start(tmp_path: Path) -> None:
    (tmp_path / "values.csv").write_text("holding_registers,1,7\nholding_registers,2,8\n")
    settings = config(tmp_path, plant=keeping(initial="values.csv"))
    with Appliance(settings) as first:
        assert first.memories["plant"].read("holding_registers", 1, 2) == [7, 8]
        first.memories["plant"].write("holding_registers", 1, [0])
    with Appliance(settings) as second:
        assert second.memories["plant"].read("holding_registers", 1, 2) == [0, 8]


@pytest.mark.parametrize(("mode", "sealed"), [("once", True), ("level", False)])
def test_nobody_knows_how_old_the_contents_of_an_open_memory_are(
    tmp_path: Path, mode: str, sealed: bool
) -> None:
    seal = {"area": "discrete_inputs", "address": 3, "mode": mode}
    settings = config(tmp_path, plant=keeping(discrete_inputs=8, seal=seal))
    with Appliance(settings) as first:
        first.memories["plant"].write("discrete_inputs", 3, [1])
        assert not first.memories["plant"].sealed
    with Appliance(settings) as second:
        memory = second.memories["plant"]
        assert memory.sealed == sealed
        memory.write("holding_registers", 0, [1])
        assert memory.sealed == sealed
        memory.write("discrete_inputs", 3, [1])
        assert not memory.sealed


def test_addresses_that_remain_keep_their_values(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Appliance(config(tmp_path)) as first:
        first.memories["plant"].write("holding_registers", 0, range(100))
    smaller = keeping(holding_registers={"start": 50, "size": 60}, coils=8)
    with Appliance(config(tmp_path, plant=smaller)) as second:
        values = second.memories["plant"].read("holding_registers", 50, 60)
        assert values == [*range(50, 100), *[0] * 10]
    told = [vars(each)["fields"] for each in caplog.records if each.message.endswith("_differs")]
    assert any("holding_registers" in each["warning"] for each in told)


def test_values_of_an_area_that_is_gone_for_one_start_come_back(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = keeping(coils=8)
    with Appliance(config(tmp_path, plant=whole)) as first:
        first.memories["plant"].write("holding_registers", 0, range(100))
        first.memories["plant"].write("coils", 3, [1])
    for _ in range(2):
        caplog.clear()
        with Appliance(config(tmp_path, plant=keeping(holding_registers=10))) as second:
            second.memories["plant"].write("holding_registers", 9, [77])
        fields = [vars(each)["fields"] for each in caplog.records]
        warnings = [each["warning"] for each in fields if "warning" in each]
        assert "set aside in the file: coils 0-7, holding_registers 10-99" in warnings[-1]
        assert "'holdfast memory release' deletes them" in warnings[-1]
    with Appliance(config(tmp_path, plant=whole)) as third:
        memory = third.memories["plant"]
        assert memory.read("holding_registers", 0, 100) == [*range(9), 77, *range(10, 100)]
        assert memory.read("coils", 0, 8) == [0, 0, 0, 1, 0, 0, 0, 0]


def test_memories_in_one_file_are_written_in_one_step(tmp_path: Path) -> None:
    both = {"one": keeping(), "plant": keeping(), "alone": keeping(file="alone.redb")}
    with Appliance(config(tmp_path, **both)) as appliance:
        assert appliance.memories["one"].waits
    names = sorted(file.name for file in tmp_path.glob("*.redb"))
    assert names == ["alone.redb", "plant.redb"]


def test_a_file_that_is_damaged_or_in_use_keeps_everything_from_starting(tmp_path: Path) -> None:
    settings = config(tmp_path)
    with Appliance(settings):
        assert "plant.redb: the file is in use by another process" in not_started(tmp_path, 1)
    file = tmp_path / "plant.redb"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UnusableMemoryFile, match=r"plant\.redb: .*damaged"):
        Appliance(settings).start()
    assert file.read_bytes() == whole[: len(whole) // 2]
    not_started(tmp_path, 2)


def test_a_disk_that_is_full_may_have_room_at_the_next_start(tmp_path: Path) -> None:
    config(tmp_path)
    with full_disk():
        assert "File too large" in not_started(tmp_path, 1)


def not_started(folder: Path, exit_code: int) -> str:
    """Why `holdfast run` ends with this exit code: service managers don't try again after 2."""
    result = invoke("run", str(folder / "p.yaml"))
    assert result.exit_code == exit_code
    [line] = result.stderr.splitlines()
    assert line.startswith(f"holdfast: {folder / 'plant.redb'}: ")
    return line


def test_keep_takes_effect_at_a_start(tmp_path: Path) -> None:
    with Appliance(config(tmp_path)) as appliance:
        for other in (keeping(1), {"holding_registers": 100}, keeping(file="other.redb")):
            with pytest.raises(ReloadRefused, match=r"memories\.plant: keep changed"):
                appliance.reload(config(tmp_path, plant=other))
        both = {"plant": keeping(), "new": keeping()}
        with pytest.raises(ReloadRefused, match=r"memories\.new: added with keep or replicate"):
            appliance.reload(config(tmp_path, **both))
        assert appliance.reload(config(tmp_path)) == []


@pytest.mark.parametrize(
    ("keep", "problem"),
    [
        ("{file: none/x.redb}", "memories.plant.keep.file: found 'none/x.redb', whose folder does"),
        ("{file: .}", "memories.plant.keep.file: found '.', which is a folder"),
        (
            "{file: x.redb, sync: -1}",
            "memories.plant.keep.sync: found -1, allowed: a number from 0 to 3600 seconds",
        ),
        ("{file: x.redb, snyc: 0}", "memories.plant.keep.snyc: unknown key, allowed: file, sync"),
        ("{sync: 0}", "memories.plant.keep.file: missing, allowed: text"),
    ],
)
def test_settings_are_checked(tmp_path: Path, keep: str, problem: str) -> None:
    text = f"memories:\n  plant: {{coils: 8, keep: {keep}}}\nlisteners: {written(UNUSED)}\n"
    [found] = Folder(tmp_path).problems(text)
    assert problem in found


def test_memories_in_one_file_have_the_same_sync(tmp_path: Path) -> None:
    memories = {"plant": keeping(0), "other": keeping(1)}
    [found] = Folder(tmp_path).problems(written({"memories": memories, "listeners": UNUSED}))
    assert "memories.other.keep.sync: found 1, allowed: 0, as plant has for the file" in found


LISTENERS = """
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], units: {1: plant, 2: volatile}, access: read-write}]
  sender:
    type: raw-ingest
    bind: 127.0.0.1:0
    format: v1
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, areas: [holding_registers]}]
rest: {bind: "127.0.0.1:0", sources: [127.0.0.0/8], tokens: none}
metrics: {bind: "127.0.0.1:0", sources: [127.0.0.0/8]}
"""


class Plant:
    """A running `holdfast run` whose disk can be full."""

    def __init__(self, folder: Path, sync: float, **more: Any) -> None:
        memories = {"plant": keeping(sync, **more), "volatile": {"holding_registers": 100}}
        self.file = folder / "p.yaml"
        self.file.write_text(f"memories: {written(memories)}\n{LISTENERS}")
        self.command = RunCommand(self.file)
        self.scada = self.command.wait_until_it_serves()
        self.greeting = self.command.greeting

    def port(self, name: str) -> int:
        found = re.search(rf"^ *{name} .*127\.0\.0\.1:([0-9]+)", self.greeting, re.MULTILINE)
        assert found is not None, self.greeting
        return int(found[1])

    def disk(self, *, full: bool) -> None:
        """Lets no file of the process grow or be written, or lets it again."""
        pid = self.command.process.pid
        _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (0 if full else hard, hard))

    def until_logged(self, text: str) -> None:
        log = self.command.process.stderr
        assert log is not None
        assert any(text in line for line in iter(log.readline, ""))

    def modbus(self, pdu: str, unit: int = 1) -> str:
        with wire.Connection(self.scada) as connection:
            return connection.ask(bytes.fromhex(pdu), unit).hex()

    def rest(self, *commands: tuple[str, int]) -> tuple[int, str]:
        body = [
            {"memory": memory, "area": "holding_registers", "address": 3, "values": [value]}
            for memory, value in commands
        ]
        request = urllib.request.Request(
            f"http://127.0.0.1:{self.port('rest')}/api/v1/ingest",
            json.dumps(body if len(body) > 1 else body[0]).encode(),
            {"Content-Type": "application/json"},
        )
        try:
            with urllib.request.urlopen(request, timeout=wire.DEADLINE) as answer:
                return answer.status, json.load(answer)["status"]
        except urllib.error.HTTPError as error:
            self.refusal = json.load(error)
            return error.code, self.refusal["reason"]

    def packet(self, value: int) -> bytes:
        with socket.create_connection(("127.0.0.1", self.port("sender"))) as sender:
            sender.settimeout(wire.DEADLINE)
            sender.sendall(bytes.fromhex("52490103000100030001") + value.to_bytes(2, "big"))
            return sender.recv(16)

    def metric(self, name: str) -> float:
        url = f"http://127.0.0.1:{self.port('metrics')}/metrics"
        with urllib.request.urlopen(url, timeout=wire.DEADLINE) as answer:
            lines = answer.read().decode().splitlines()
        [value] = [line.rpartition(" ")[2] for line in lines if line.startswith(f"{name}{{")]
        return float(value)


@pytest.fixture
def plant(tmp_path: Path, request: pytest.FixtureRequest) -> Any:
    made = Plant(tmp_path, request.param)
    yield made
    made.command.process.kill()
    made.command.process.communicate()


@pytest.mark.parametrize("plant", [0], indirect=True)
def test_with_a_full_disk_no_write_is_confirmed_and_none_is_carried_out(plant: Plant) -> None:
    assert plant.modbus("0600030007") == "0600030007"
    assert plant.packet(8) == b"\0"
    assert plant.rest(("plant", 9)) == (200, "accepted")
    plant.disk(full=True)
    assert plant.modbus("0600030001") == "8604"
    assert plant.modbus("10000300010200ff") == "9004"
    assert plant.modbus("16000300000001") == "9604"
    assert plant.modbus("170003000100030001020001") == "9704"
    assert plant.packet(1) == b"\1"
    assert plant.rest(("plant", 1)) == (503, "not_stored")
    assert plant.modbus("0300030001") == "03020009"
    # Other memories are not concerned.
    assert plant.modbus("0600030001", unit=2) == "0600030001"
    assert plant.metric("holdfast_memory_file_failing") == 1
    plant.disk(full=False)
    wire.until(lambda: plant.modbus("060003000a") == "060003000a", "it recovers by itself")
    wire.until(lambda: plant.metric("holdfast_memory_file_failing") == 0, "it says so")
    assert plant.metric("holdfast_memory_file_refused_total") >= 6
    plant.command.process.kill()
    plant.command.process.communicate()
    again = RunCommand(plant.file)
    try:
        plant.scada = again.wait_until_it_serves()
        assert plant.modbus("0300030001") == "0302000a"
        code, log = again.end(signal.SIGTERM)
    finally:
        again.process.kill()
    assert code == 0
    assert " info memory_file file=" in log


@pytest.mark.parametrize("plant", [0], indirect=True)
def test_a_batch_is_one_step_or_none(plant: Plant) -> None:
    assert plant.rest(("volatile", 1), ("plant", 1)) == (400, "not_one_step")
    assert plant.refusal["detail"] == (
        "commands[0]: volatile and other memories of the batch are not kept together, "
        "so no step writes all of them"
    )
    assert plant.rest(("plant", 1), ("volatile", 1)) == (400, "not_one_step")
    assert plant.rest(("plant", 1), ("plant", 2)) == (200, "accepted")
    assert plant.modbus("0300030001") == "03020002"
    assert plant.modbus("0300030001", unit=2) == "03020000"


@pytest.mark.parametrize("plant", [0.05], indirect=True)
def test_with_sync_above_0_a_memory_goes_on_without_its_disk(plant: Plant) -> None:
    plant.disk(full=True)
    assert plant.modbus("0600030007") == "0600030007"
    plant.until_logged("error memory_file_failing")
    assert plant.metric("holdfast_memory_file_failing") == 1
    assert plant.rest(("plant", 8), ("volatile", 8)) == (200, "accepted")
    plant.disk(full=False)
    plant.until_logged("info memory_file_back")
    assert plant.metric("holdfast_memory_file_failing") == 0
    assert plant.command.end(signal.SIGTERM)[0] == 0
    with Appliance(load(plant.file)) as again:
        assert again.memories["plant"].read("holding_registers", 3, 1) == [8]


@pytest.mark.parametrize("plant", [3600], indirect=True)
def test_writes_that_the_stop_can_not_store_are_counted(plant: Plant) -> None:
    for _ in range(3):
        assert plant.modbus("0600030007") == "0600030007"
    plant.disk(full=True)
    code, log = plant.command.end(signal.SIGTERM)
    assert code == 1
    assert f" error memory_file_lost file={plant.file.with_name('plant.redb')} writes=3" in log
    assert " info stopped" in log


@pytest.mark.parametrize("plant", [0, 0.05], indirect=True)
def test_a_file_that_is_removed_while_it_is_written_is_written_anew(plant: Plant) -> None:
    file = plant.file.with_name("plant.redb")
    plant.disk(full=True)
    plant.modbus("0600030001")
    plant.until_logged("error memory_file_failing")
    file.unlink()
    plant.disk(full=False)
    plant.until_logged(f"warning memory_file_recreated file={file}")
    wire.until(lambda: plant.modbus("0600030007") == "0600030007", "it recovers")
    file.unlink()
    plant.until_logged("warning memory_file_recreated")
    file.unlink()
    code, log = plant.command.end(signal.SIGTERM)
    assert code == 0
    assert " warning memory_file_recreated " in log
    with Appliance(load(plant.file)) as again:
        assert again.memories["plant"].read("holding_registers", 3, 1) == [7]


@pytest.mark.parametrize("plant", [0, 0.05], indirect=True)
def test_another_file_in_the_place_of_its_own_is_not_changed(plant: Plant) -> None:
    file, other = (plant.file.with_name(name) for name in ("plant.redb", "other"))
    plant.disk(full=True)
    plant.modbus("0600030001")
    plant.until_logged('error="File too large')
    other.write_bytes(b"other")
    other.rename(file)
    # Another reason is logged too.
    plant.until_logged('error="another file is in its place')
    file.rename(other)
    plant.disk(full=False)
    plant.until_logged("info memory_file_back")
    assert plant.modbus("0600030007") == "0600030007"
    other.rename(file)
    plant.until_logged('error="another file is in its place')
    code, log = plant.command.end(signal.SIGTERM)
    assert code == 1
    assert " error memory_file_lost " in log
    assert file.read_bytes() == b"other"


@pytest.mark.parametrize(("removed", "lost"), [(False, [0, 0]), (True, [2, 1])])
def test_writes_in_a_file_that_was_moved_with_its_folder_are_not_lost(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, removed: bool, lost: list[int]
) -> None:
    kept, moved, copy = (tmp_path / name for name in ("kept", "moved", "copy"))
    kept.mkdir()
    settings = config(tmp_path, plant=keeping(file="kept/plant.redb"))
    # The second start writes nothing.
    for values, expected in zip([[7, 8], []], lost, strict=True):
        caplog.clear()
        with Appliance(settings) as appliance:
            for value in values:
                appliance.memories["plant"].write("holding_registers", 3, [value])
            kept.rename(moved)
            if removed:
                shutil.copytree(moved, copy)
                shutil.rmtree(moved)
        assert appliance.lost_writes == expected
        events = {each.message: vars(each)["fields"] for each in caplog.records}
        assert "its folder is gone" in str(events["memory_file_failing"]["error"])
        assert events.get("memory_file_lost", {"writes": 0})["writes"] == expected
        (copy if removed else moved).rename(kept)
        with Appliance(settings) as again:
            assert again.memories["plant"].read("holding_registers", 3, 1) == [8]


class FakeFile:
    """In the place of a `MemoryFile`, with a status as given."""

    loaded = ("plant",)
    warnings = ()
    failing: str | None = None

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def start(self) -> None:
        pass

    def stop(self) -> None:
        pass

    def status(self) -> dict[str, Any]:
        return {"failing": self.failing, "pending": 0, "recreated": 0}


@pytest.fixture
def part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Memories:
    """Has one file, a `FakeFile`."""
    monkeypatch.setattr(_core, "MemoryFile", FakeFile)
    settings = config(tmp_path)
    memories = {"plant": created(settings, "plant")}
    made = Memories(settings, memories)
    made.open(Plan(settings, (), memories, ExitStack()))
    return made


def test_a_reason_is_logged_once_until_the_file_can_be_written(
    part: Memories, log: web.Records, monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs, full = "the disk has not answered for 5 s", "no space"
    seen = [hangs, full, hangs, "the disk has not answered for 6 s", full, None, None, full, hangs]
    for error in seen:
        monkeypatch.setattr(FakeFile, "failing", error)
        part.tick()
    events = [(fields["event"], fields.get("error")) for fields in log.fields]
    failing, back = "memory_file_failing", "memory_file_back"
    expected = [(failing, hangs), (failing, full), (back, None), (failing, full), (failing, hangs)]
    assert events == expected


def test_a_stop_that_waits_for_a_failing_disk_says_so_without_a_write(
    part: Memories, log: web.Records, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeFile, "failing", "the disk has not answered for 5 s")
    part.close()
    assert log.fields[-1]["event"] == "memory_file_storing"


def test_a_mirror_is_kept_too(tmp_path: Path) -> None:
    source = holdfast.Memory(holding_registers=10)
    with holdfast.Server({1: source}, bind="127.0.0.1:0", access="read-write") as device:
        host, port = device.address
        read = {"area": "holding_registers", "address": 0, "count": 10}
        read |= {"into": {"memory": "plant", "area": "holding_registers", "address": 0}}
        meter = {"url": f"tcp://{host}:{port}", "unit": 1, "interval": 0.02, "reads": [read]}
        parts = {"memories": {"plant": keeping()}, "devices": {"meter": meter}, "listeners": UNUSED}
        (tmp_path / "p.yaml").write_text(written(parts))
        source.write("holding_registers", 0, [42])
        with Appliance(load(tmp_path / "p.yaml")) as appliance:
            memory = appliance.memories["plant"]
            wire.until(lambda: memory.read("holding_registers", 0, 1) == [42], "it is mirrored")
    with Appliance(config(tmp_path)) as again:
        assert again.memories["plant"].read("holding_registers", 0, 1) == [42]


WITH_FILES: Settings = {"files": {4: 300}, "fifo": [10]}


@pytest.mark.parametrize("sync", [0, 1])
def test_files_are_kept_as_areas_are(tmp_path: Path, sync: float) -> None:
    settings = config(tmp_path, plant=keeping(sync, **WITH_FILES))
    with Appliance(settings) as appliance:
        appliance.memories["plant"].write("file:4", 299, [7])
    other = config(tmp_path, plant=keeping(sync, files={1: 5, 4: 10}))
    with Appliance(other) as appliance:
        assert appliance.memories["plant"].files == {1: 5, 4: 10}
    with Appliance(settings) as appliance:
        assert appliance.memories["plant"].read("file:4", 299, 1) == [7]


def test_records_that_were_confirmed_survive_a_kill(tmp_path: Path) -> None:
    made = Plant(tmp_path, 0, **WITH_FILES)
    try:
        write = "150906000400070001aaaa"
        assert made.modbus(write) == write
        assert made.modbus("0600" + "0a0001") == "0600" + "0a0001"
        made.command.process.kill()
        made.command.process.communicate()
        again = RunCommand(made.file)
        try:
            made.scada = again.wait_until_it_serves()
            assert made.modbus("140706000400070001") == "14040306aaaa"
            assert made.modbus("18000a") == "180004" + "00010000"
        finally:
            again.process.kill()
            again.process.communicate()
    finally:
        made.command.process.kill()
        made.command.process.communicate()


def test_files_are_verified_exported_and_imported(tmp_path: Path) -> None:
    settings = config(tmp_path, plant=keeping(0, **WITH_FILES))
    with Appliance(settings) as appliance:
        appliance.memories["plant"].write("file:4", 7, [8, 9])
    file, values = str(tmp_path / "plant.redb"), tmp_path / "values.yaml"
    assert "plant: file:4 0 to 299, 2 not 0" in invoke("memory", "verify", file).stdout
    assert "file:4,8,9" in invoke("memory", "export", file).stdout
    assert invoke("memory", "export", file, "--output", str(values)).exit_code == 0
    text = values.read_text()
    assert "file:4:\n  7: [8, 9]\n" in text
    values.write_text(text.replace("[8, 9]", "[1, 2]"))
    assert invoke("memory", "import", file, str(values)).exit_code == 0
    with Appliance(settings) as appliance:
        assert appliance.memories["plant"].read("file:4", 6, 4) == [0, 1, 2, 0]


def test_initial_values_may_be_of_files(tmp_path: Path) -> None:
    (tmp_path / "first.csv").write_text("area,address,value\nfile:4,299,5\n")
    plant = {"coils": 1, "files": {4: 300}, "initial": "first.csv"}
    with Appliance(config(tmp_path, plant=plant)) as appliance:
        assert appliance.memories["plant"].read("file:4", 298, 2) == [0, 5]


def test_files_change_at_a_start_only(tmp_path: Path) -> None:
    with Appliance(config(tmp_path, plant={"coils": 1, "files": {4: 300}})) as appliance:
        other = config(tmp_path, plant={"coils": 1, "files": {4: 301}})
        with pytest.raises(ReloadRefused, match=r"memories\.plant: "):
            appliance.reload(other)

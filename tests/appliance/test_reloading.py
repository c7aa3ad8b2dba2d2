"""When a running appliance rereads its files, and what happens if they don't answer."""

from __future__ import annotations

import os
import sys
import threading
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.appliance.service_manager import ServiceManager
from holdfast.cli.configuration import load_whole
from holdfast.cli.services import reloader
from holdfast.cli.services.changed_files import FileSnapshot
from holdfast.cli.services.reloader import Reloader
from support import web, wire
from support.silent_files import Silent, threads

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from holdfast.config import Config

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="files of other systems differ")

HEAD = """\
reload: on-change
memories: {plant: {holding_registers: 10}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: read-only}]
"""
MORE = HEAD.partition("listeners:\n")[2].replace("scada", "historian")
DEVICE = "devices: {meter: {url: tcp://127.0.0.1:1, interval: 1, profile: meter}}\n"
PROFILE = "tags: {power: {area: holding_registers, address: %d}}\n"


class Plant:
    """A configuration, and what reloads it for an appliance that notes what it takes over."""

    def __init__(self, folder: Path, text: str = HEAD + MORE, timeout_ms: int = 50) -> None:
        self.folder = folder
        self.file = folder / "plant.yaml"
        self.file.write_text(text)
        self.config = load_whole(self.file)
        self.taken: list[Config] = []
        self.diagnostics = web.diagnostics_of({})
        this: Any = self
        self.reloading = Reloader(
            this,
            ServiceManager({}),
            lambda: load_whole(self.file),
            self.file,
            watch_interval_ms=1,
            timeout_ms=timeout_ms,
        )

    def reload(self, config: Config) -> list[str]:
        self.config = config
        self.taken.append(config)
        return []

    def replace(self, text: str, file: str = "plant.yaml") -> None:
        (self.folder / "new").write_text(text)
        (self.folder / "new").rename(self.folder / file)

    def request(self) -> Mapping[str, Any]:
        """Requests a reload, as `holdfast reload` does. Returns the answer."""
        answers: list[Mapping[str, Any]] = []
        asking = threading.Thread(target=lambda: answers.append(self.reloading.ask()), daemon=True)
        asking.start()
        self.step_until(lambda: answers, "the reload was answered")
        asking.join(wire.DEADLINE)
        return answers[0]

    def step(self) -> bool:
        self.reloading.step(requested=False)
        return True

    def step_until(self, condition: Callable[[], object], what: str) -> None:
        wire.until(lambda: self.step() and condition(), what)


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> list[FileSnapshot]:
    """The looks at the files that have begun."""
    found: list[FileSnapshot] = []

    class Watched(FileSnapshot):
        def __init__(self, files: Any, *, hold: bool) -> None:
            super().__init__(files, hold=hold)
            found.append(self)

    monkeypatch.setattr(reloader, "FileSnapshot", Watched)
    return found


def look_on(plant: Plant, looks: list[FileSnapshot]) -> None:
    """Has files looked at so often that a change would have been noticed."""
    enough = len(looks) + 5
    plant.step_until(lambda: len(looks) >= enough, "the files were looked at")


def test_a_slow_writer_changes_nothing_until_a_reload_is_requested(
    tmp_path: Path, looks: list[FileSnapshot], log: web.Records
) -> None:
    """Half of the file is valid too: without the second listener."""
    plant = Plant(tmp_path)
    with plant.file.open("w") as writer:
        for part in ("", HEAD, MORE.replace("read-only", "read-write")):
            writer.write(part)
            writer.flush()
            look_on(plant, looks)
    look_on(plant, looks)
    assert plant.taken == []
    [needed] = log.of("reload_needed")
    assert needed == {
        "event": "reload_needed",
        "file": str(plant.file),
        "reason": "written in place, not renamed",
        "command": f"holdfast reload {plant.file}",
    }
    assert "problems" not in plant.request()
    assert list(plant.config.listeners) == ["scada", "historian"]
    look_on(plant, looks)
    assert len(plant.taken) == 1


def test_a_file_that_was_renamed_into_place_is_taken_over(
    tmp_path: Path, looks: list[FileSnapshot], log: web.Records
) -> None:
    plant = Plant(tmp_path)
    for number, text in enumerate((HEAD, HEAD + MORE, HEAD), start=1):
        plant.replace(text)
        plant.step_until(lambda: len(plant.taken) == number, "it was taken over")  # noqa: B023
        look_on(plant, looks)
    assert len(plant.taken) == 3
    assert log.of("reload_needed") == []


def test_a_changed_configmap_is_taken_over(tmp_path: Path, log: web.Records) -> None:
    """Kubernetes renames a symbolic link to a folder with all files of the new version."""
    for version, text in (("1", HEAD + MORE), ("2", HEAD)):
        (tmp_path / version).mkdir()
        (tmp_path / version / "plant.yaml").write_text(text)
    (tmp_path / "..data").symlink_to("1")
    (tmp_path / "plant.yaml").symlink_to("..data/plant.yaml")
    plant = Plant(tmp_path)
    (tmp_path / "..data_tmp").symlink_to("2")
    (tmp_path / "..data_tmp").rename(tmp_path / "..data")
    (tmp_path / "1" / "plant.yaml").unlink()
    plant.step_until(lambda: plant.taken, "it was taken over")
    assert list(plant.config.listeners) == ["scada"]
    assert log.of("reload_needed") == []


def test_a_file_that_is_written_after_it_was_renamed_waits_for_the_writer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = Plant(tmp_path)
    sizes = []
    with (tmp_path / "new").open("w") as writer:
        writer.write(HEAD)
        writer.flush()
        (tmp_path / "new").rename(plant.file)
        lines = iter(["# more\n"] * 20)

        class Watched(FileSnapshot):
            """Between any two looks, the writer writes another line."""

            def __init__(self, files: Any, *, hold: bool) -> None:
                super().__init__(files, hold=hold)
                writer.write(next(lines, ""))
                writer.flush()
                sizes.append(plant.file.stat().st_size)

        monkeypatch.setattr(reloader, "FileSnapshot", Watched)
        plant.step_until(lambda: len(sizes) >= 20, "the writer has ended")
        assert plant.taken == []
        plant.step_until(lambda: plant.taken, "it was taken over")


def test_a_file_that_has_the_number_of_an_old_one_is_noticed(
    tmp_path: Path, looks: list[FileSnapshot]
) -> None:
    """The known file is kept open, so that no other one gets its number."""
    plant = Plant(tmp_path)
    look_on(plant, looks)
    number = plant.file.stat().st_ino
    for _ in range(20):
        plant.replace(HEAD)
        assert plant.file.stat().st_ino != number
    plant.step_until(lambda: plant.taken, "it was taken over")


def test_profiles_are_watched_too(
    tmp_path: Path, looks: list[FileSnapshot], log: web.Records
) -> None:
    profile = tmp_path / "meter.yaml"
    profile.write_text(PROFILE % 1)
    plant = Plant(tmp_path, f"{HEAD}profiles: [meter.yaml]\n{DEVICE}")
    profile.write_text(PROFILE % 2)
    plant.step_until(lambda: log.of("reload_needed"), "the change was noticed")
    plant.replace(HEAD)
    plant.step_until(lambda: len(log.of("reload_needed")) == 2, "the other change was noticed")
    look_on(plant, looks)
    assert plant.taken == []
    reasons = {each["file"]: each["reason"] for each in log.of("reload_needed")}
    assert reasons == {
        str(profile): "written in place, not renamed",
        str(plant.file): "replaced, but another file was written in place",
    }
    plant.replace(PROFILE % 3, "meter.yaml")
    plant.step_until(lambda: plant.taken, "both are complete now")


def test_a_removed_file_changes_nothing(
    tmp_path: Path, looks: list[FileSnapshot], log: web.Records
) -> None:
    plant = Plant(tmp_path)
    plant.file.unlink()
    look_on(plant, looks)
    [needed] = log.of("reload_needed")
    assert (needed["reason"], plant.taken) == ("removed", [])
    plant.replace(HEAD)
    plant.step_until(lambda: plant.taken, "the new file was taken over")


def test_a_wrong_file_is_refused_once(
    tmp_path: Path, looks: list[FileSnapshot], log: web.Records
) -> None:
    plant = Plant(tmp_path)
    plant.replace("wrong")
    plant.step_until(lambda: log.of("reload_refused"), "it was refused")
    look_on(plant, looks)
    assert len(log.of("reload_refused")) == 1


def test_the_diagnostics_have_the_result_of_the_last_reload(tmp_path: Path) -> None:
    plant = Plant(tmp_path, HEAD.replace("on-change", "on-request"))
    start = plant.diagnostics.stats()["reload"]
    assert (start["failed"], start["succeeded_at"] > 0) == (False, True)
    start["succeeded_at"] = 0
    plant.replace("wrong")
    assert "problems" in plant.request()
    assert plant.diagnostics.stats()["reload"] == {"failed": True, "succeeded_at": 0}
    plant.replace(HEAD)
    assert "changed" in plant.request()
    end = plant.diagnostics.stats()["reload"]
    assert (end["failed"], end["succeeded_at"] > 0) == (False, True)


def test_an_internal_error_of_reading_refuses_the_reload(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(_: Path) -> Config:
        raise KeyError("plant")

    plant = Plant(tmp_path)
    monkeypatch.setitem(globals(), "load_whole", fails)
    assert plant.request() == {"problems": [f"{plant.file}: internal error: KeyError('plant')"]}
    assert plant.taken == []


GATEWAY = (
    "gateway: {bind: 127.0.0.1:0, sources: [127.0.0.1], access: read-only, allow: [127.0.0.1], "
    "tokens: none}"
)
TAGS = (
    "devices: {pump: {url: 'tcp://127.0.0.1:1', interval: 1, tags: {a: {area: coils, address: 0}}}}"
)


@pytest.mark.parametrize(
    ("module", "section"),
    [("holdfast.gateway", GATEWAY), ("holdfast.appliance.parts.tag_values", TAGS)],
)
def test_a_package_that_was_removed_meanwhile_refuses_the_reload(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, section: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    plant = Plant(tmp_path)
    plant.replace(f"{HEAD}{section}\n")
    [problem] = plant.request()["problems"]
    assert problem.startswith(f"{plant.file}: internal error: ModuleNotFoundError")
    assert plant.taken == []


@pytest.mark.parametrize("function", ["open", "stat"])
def test_a_file_that_never_answers_is_a_problem_and_leaves_one_thread_behind(
    function: str, tmp_path: Path, log: web.Records, monkeypatch: pytest.MonkeyPatch
) -> None:
    profile = tmp_path / "meter.yaml"
    profile.write_text(PROFILE % 1)
    text = f"{HEAD}profiles: [meter.yaml]\n{DEVICE}".replace("on-change", "on-request")
    plant = Plant(tmp_path, text)
    with Silent(monkeypatch, function, profile) as silent:
        for _ in range(4):
            [problem] = plant.request()["problems"]
            assert problem == f"{profile}: can't be read: no answer within 0.05 s, the limit"
        assert (len(threads()), plant.taken) == (1, [])
        plant.replace(HEAD)
        assert "problems" not in plant.request(), "without the file, there is no problem"
        plant.replace(text)
        silent.answer()
        wire.until(lambda: not threads(), "the thread has ended")
        assert "problems" not in plant.request()
    assert len(log.of("reload_refused")) == 4


def test_a_watched_file_that_never_answers_is_logged_once(
    tmp_path: Path, log: web.Records, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = Plant(tmp_path)
    with Silent(monkeypatch, "stat", plant.file) as silent:
        plant.step_until(lambda: log.of("reload_needed"), "it was noticed")
        for _ in range(100):
            plant.step()
        assert silent.calls == 1
    [needed] = log.of("reload_needed")
    assert needed["reason"] == "no answer within 0.05 s, the limit"
    plant.replace(HEAD)
    plant.step_until(lambda: plant.taken, "it is watched again")


def test_a_reload_that_the_watch_began_is_not_repeated_while_a_file_is_silent(
    tmp_path: Path, log: web.Records, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = Plant(tmp_path)
    with Silent(monkeypatch, "read", plant.file) as silent:
        plant.replace(HEAD)
        plant.step_until(lambda: log.of("reload_refused"), "it was refused")
        for _ in range(100):
            plant.step()
        assert (len(log.of("reload_refused")), silent.calls) == (1, 1)


def test_while_a_file_is_read_nothing_waits_for_it(
    tmp_path: Path,
) -> None:
    plant = Plant(tmp_path, HEAD.replace("on-change", "on-request"), 60_000)
    plant.file.unlink()
    os.mkfifo(plant.file)
    plant.reloading.step(requested=True)
    for _ in range(3):
        plant.step()
    assert plant.taken == []
    with plant.file.open("w") as writer:
        writer.write(HEAD)
    plant.step_until(lambda: plant.taken, "it was read")


def test_who_waits_for_a_reload_is_answered_when_the_appliance_stops(tmp_path: Path) -> None:
    plant = Plant(tmp_path, HEAD.replace("on-change", "on-request"))
    plant.file.unlink()
    os.mkfifo(plant.file)
    answers: list[Mapping[str, Any]] = []
    asking = threading.Thread(target=lambda: answers.append(plant.reloading.ask()))
    asking.start()
    plant.step_until(threads, "the file is read")
    plant.reloading.close()
    asking.join(wire.DEADLINE)
    assert answers == [{"problems": [f"{plant.file}: the appliance has stopped"]}]
    with plant.file.open("w") as writer:
        writer.write(HEAD)


def test_a_reload_raises_the_limit_on_open_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raised: list[tuple[int, int]] = []
    monkeypatch.setattr("resource.getrlimit", lambda _: (1000, 100_000))
    monkeypatch.setattr("resource.setrlimit", lambda _, limits: raised.append(limits))
    plant = Plant(tmp_path)
    plant.file.write_text(HEAD + MORE + "    max_connections: 5000\n")
    assert "problems" not in plant.request()
    [(soft, hard)] = raised
    assert soft > 5000
    assert hard == 100_000

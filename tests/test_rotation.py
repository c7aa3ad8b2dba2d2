"""Full files: the steps of putting them aside, each of which may fail or be the last."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from holdfast.events import rotation
from holdfast.events.rotation import Rotation
from support.renaming import not_renamed

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A full file with two older ones, each of which contains its name."""
    for name in ("a.log", "a.log.1", "a.log.2"):
        (tmp_path / name).write_text(name)
    return tmp_path / "a.log"


def contents(file: Path) -> dict[str, str]:
    return {each.name: each.read_text() for each in file.parent.iterdir()}


def test_files_change_their_names_and_the_oldest_goes(file: Path) -> None:
    Rotation(file, 2, pytest.fail).rotate()
    assert contents(file) == {"a.log.1": "a.log", "a.log.2": "a.log.1"}


@pytest.mark.parametrize("name", ["a.log", "a.log.1"])
@pytest.mark.parametrize("keep", [2, 3])
def test_a_file_that_can_not_be_renamed_keeps_its_name(
    file: Path, monkeypatch: pytest.MonkeyPatch, name: str, keep: int
) -> None:
    before, failures = set(contents(file).values()), []
    allow = not_renamed(monkeypatch, file.with_name(name))
    rotated = Rotation(file, keep, lambda: failures.append(name))
    for _ in range(3):
        rotated.rotate()
    assert set(contents(file).values()) == before
    assert file.read_text() == "a.log"
    assert failures == [name]
    allow()
    rotated.rotate()
    assert contents(file)["a.log.1"] == "a.log"
    assert contents(file)["a.log.2"] == "a.log.1"


def test_after_a_failure_the_file_grows_for_some_time(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    allow = not_renamed(monkeypatch, file)
    rotated = Rotation(file, 2, lambda: None)
    assert rotated.may_rotate
    rotated.rotate()
    assert not rotated.may_rotate
    now += rotation.RETRY_S
    assert rotated.may_rotate
    allow()
    rotated.rotate()
    assert rotated.may_rotate


@pytest.mark.parametrize("steps", range(4))
def test_what_a_crash_leaves_is_put_aside_later(
    file: Path, monkeypatch: pytest.MonkeyPatch, steps: int
) -> None:
    class Crash(BaseException):
        pass

    left, real = steps, type(file).replace

    def replaced(old: Path, new: Path) -> Path:
        nonlocal left
        if not left:
            raise Crash
        left -= 1
        return real(old, new)

    monkeypatch.setattr(type(file), "replace", replaced)
    rotated = Rotation(file, 3, pytest.fail)
    with pytest.raises(Crash):
        rotated.rotate()
    monkeypatch.setattr(type(file), "replace", real)
    rotated.take_up()
    aside = {"a.log.1": "a.log", "a.log.2": "a.log.1", "a.log.3": "a.log.2"}
    before = {"a.log": "a.log", "a.log.1": "a.log.1", "a.log.2": "a.log.2"}
    assert contents(file) == (aside if steps else before)


def test_what_can_not_be_put_aside_is_not_overwritten(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spare = file.with_name("a.log.0")
    file.rename(spare)
    file.write_text("new")
    not_renamed(monkeypatch, spare)
    failures: list[None] = []
    rotated = Rotation(file, 2, lambda: failures.append(None))
    rotated.take_up()
    rotated.rotate()
    assert (spare.read_text(), file.read_text()) == ("a.log", "new")
    assert failures == [None]

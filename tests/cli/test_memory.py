"""`holdfast memory`: files that keep memories, while no appliance uses them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

import holdfast
from holdfast._core import MemoryFile
from holdfast.config.text import yaml_document
from support.cli import answer, done, invoke, usage_error
from support.machine import full_disk

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def file(tmp_path: Path) -> str:
    """A file with one memory."""
    path = tmp_path / "plant.redb"
    keep(path, plant=[7, 0, 8])
    return str(path)


def keep(path: Path, **memories: list[int]) -> None:
    made = {name: holdfast.Memory(coils=10, holding_registers=(50, 20)) for name in memories}
    kept = MemoryFile(path, list(made.items()), 0)
    for name, memory in made.items():
        memory.write("holding_registers", 60, memories[name])
        memory.write("coils", 9, [1])
    kept.start()
    kept.stop()


def cut(path: Path | str, **memories: holdfast.Memory) -> list[str]:
    """Starts once with memories of other sizes, and returns the warnings."""
    kept = MemoryFile(path, list(memories.items()), 0)
    kept.start()
    kept.stop()
    return kept.warnings


def registers(path: str, memory: str = "plant") -> list[int]:
    loaded = holdfast.Memory(coils=10, holding_registers=(50, 20))
    MemoryFile(path, [(memory, loaded)], 1).stop()
    return [*loaded.read("holding_registers", 60, 3), *loaded.read("coils", 9, 1)]


def test_a_file_is_verified(file: str) -> None:
    assert done("memory", "verify", file) == [
        "intact",
        "plant: coils 0 to 9, 1 not 0",
        "plant: holding_registers 50 to 69, 2 not 0",
    ]
    areas = {
        "coils": {"address": 0, "count": 10},
        "holding_registers": {"address": 50, "count": 20},
    }
    shown = {"ok": True, "target": file, "memories": {"plant": areas}, "set_aside": {}}
    assert answer("memory", "verify", file) == shown


def test_a_damaged_file_is_named(file: str, tmp_path: Path) -> None:
    data = bytearray((tmp_path / "plant.redb").read_bytes())
    at = data.index(bytes([0, 7, 0, 0, 0, 8]))
    data[at] ^= 1
    (tmp_path / "plant.redb").write_bytes(data)
    for arguments in (["verify", file], ["export", file], ["import", file, str(__file__)]):
        if arguments[0] == "import":
            (tmp_path / "v.csv").write_text("coils,1,1\n")
            arguments[2] = str(tmp_path / "v.csv")
        result = invoke("memory", *arguments)
        assert (result.exit_code, result.stdout) == (2, "")
        assert result.stderr.startswith(f"holdfast: {file}: the file is damaged")
    assert (tmp_path / "plant.redb").read_bytes() == data


def test_a_file_in_use_is_refused(file: str) -> None:
    memory = holdfast.Memory(coils=10, holding_registers=(50, 20))
    used = MemoryFile(file, [("plant", memory)], 0)
    result = invoke("memory", "verify", file)
    assert result.exit_code == 2
    assert "in use by another process" in result.stderr
    used.stop()


@pytest.mark.parametrize("kind", ["csv", "yaml"])
@pytest.mark.parametrize("zeros", [[], ["--zeros"]])
def test_what_is_exported_can_be_imported(
    file: str, tmp_path: Path, kind: str, zeros: list[str]
) -> None:
    values = str(tmp_path / f"values.{kind}")
    assert done("memory", "export", file, "--output", values, *zeros) == []
    keep(tmp_path / "other.redb", other=[1, 2, 3])
    other = str(tmp_path / "other.redb")
    [told] = done("memory", "import", other, values)
    assert told == f"other: {30 if zeros else 3} values stored in {other}"
    assert registers(other, "other") == [7, 0, 8, 1]


@pytest.mark.parametrize("kind", ["csv", "yaml"])
@pytest.mark.parametrize("zeros", [[], ["--zeros"]])
@pytest.mark.parametrize("step", [1, 2, 3])
def test_a_memory_of_any_size_can_be_exported_and_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, zeros: list[str], step: int
) -> None:
    """The limits of `initial` follow the memory, however its values are written."""
    monkeypatch.setattr("holdfast.config.initial_values.MAX_CSV_BYTES", 1)
    monkeypatch.setattr(yaml_document, "MAX_BYTES", 1)
    monkeypatch.setattr(yaml_document, "MAX_WRITTEN", 1)
    monkeypatch.setattr(yaml_document, "MAX_VALUES", 1)
    memory = holdfast.Memory(discrete_inputs=(65500, 36), files={65535: 40, 1: 1})
    given = [int(at % step == 0) for at in range(36)]
    path, values = tmp_path / "plant.redb", str(tmp_path / f"values.{kind}")
    kept = MemoryFile(path, [("plant", memory)], 0)
    memory.write("discrete_inputs", 65500, given)
    memory.write("file:65535", 0, [65535 * bit for bit in given])
    kept.start()
    kept.stop()
    assert done("memory", "export", str(path), "--output", values, *zeros) == []
    [stored] = done("memory", "import", str(path), values)
    count = 77 if zeros else 2 * sum(given)
    assert stored == f"plant: {count} values stored in {path}"


def test_values_are_merged_on_request(file: str, tmp_path: Path) -> None:
    (tmp_path / "v.csv").write_text("area,address,value\nholding_registers,61,5\n")
    done("memory", "import", file, str(tmp_path / "v.csv"), "--merge")
    assert registers(file) == [7, 5, 8, 1]
    done("memory", "import", file, str(tmp_path / "v.csv"))
    assert registers(file) == [0, 5, 0, 0]


def test_an_export_that_fails_leaves_the_one_before(file: str, tmp_path: Path) -> None:
    values = tmp_path / "values.csv"
    values.write_text("backup")
    with full_disk(5):
        result = invoke("memory", "export", file, "--output", str(values))
    assert "File too large" in result.stderr
    assert [values.read_text(), *tmp_path.glob(".*")] == ["backup"]


def test_the_export_is_csv_on_standard_output(file: str) -> None:
    assert done("memory", "export", file) == [
        "area,address,value",
        "coils,9,1",
        "holding_registers,60,7",
        "holding_registers,62,8",
    ]


def test_wrong_values_change_nothing(file: str, tmp_path: Path) -> None:
    values = tmp_path / "v.csv"
    values.write_text("holding_registers,60,1\nholding_registers,70,1\ncoils,3,2\n")
    result = invoke("memory", "import", file, str(values))
    assert result.exit_code == 2
    assert result.stderr.splitlines() == [
        f"holdfast: {values}:2: found address 70, allowed in holding_registers: 50 to 69",
        f"{values}:3: found 2, allowed in coils: 0 or 1",
    ]
    assert registers(file) == [7, 0, 8, 1]


def test_with_several_memories_one_is_named(tmp_path: Path) -> None:
    file = str(tmp_path / "two.redb")
    keep(tmp_path / "two.redb", first=[1, 0, 0], second=[2, 0, 0])
    assert usage_error("memory", "export", file).endswith("add --memory: first, second.")
    message = usage_error("memory", "export", file, "--memory", "secnd")
    assert "has no memory 'secnd', allowed: first, second; did you mean 'second'?" in message
    assert "holding_registers,60,2" in done("memory", "export", file, "--memory", "second")
    values = tmp_path / "v.csv"
    values.write_text("holding_registers,60,9\n")
    done("memory", "import", file, str(values), "--memory", "second")
    assert (registers(file, "first")[0], registers(file, "second")[0]) == (1, 9)


def test_a_file_without_memories_says_so(tmp_path: Path) -> None:
    keep(tmp_path / "empty.redb")
    file, values = str(tmp_path / "empty.redb"), tmp_path / "v.csv"
    values.write_text("holding_registers,60,9\n")
    for words in (("export", file), ("import", file, str(values))):
        for more in ((), ("--memory", "plant")):
            message = usage_error("memory", *words, *more)
            assert message == f"Error: {file} has no memories."


def test_a_form_is_chosen_by_its_ending(file: str, tmp_path: Path) -> None:
    message = usage_error("memory", "export", file, "--output", str(tmp_path / "v.txt"))
    assert message.endswith("found v.txt, allowed: a file with one of .csv, .yaml, .yml.")


def test_values_that_were_cut_can_be_exported_and_released(file: str) -> None:
    cut(file, plant=holdfast.Memory(holding_registers=(50, 11)))
    assert done("memory", "verify", file) == [
        "intact",
        "plant: holding_registers 50 to 60, 1 not 0",
        "set aside of plant: coils 0 to 9, 1 not 0",
        "set aside of plant: holding_registers 61 to 69, 1 not 0",
    ]
    assert answer("memory", "verify", file)["set_aside"] == {
        "plant": {
            "coils": {"address": 0, "count": 10},
            "holding_registers": {"address": 61, "count": 9},
        }
    }
    header = "area,address,value"
    assert done("memory", "export", file) == [header, "holding_registers,60,7"]
    before = [header, "coils,9,1", "holding_registers,62,8"]
    assert done("memory", "export", file, "--set-aside") == before
    assert done("memory", "release", file) == [
        "released of plant: coils 0 to 9, 1 not 0",
        "released of plant: holding_registers 61 to 69, 1 not 0",
    ]
    assert done("memory", "release", file) == [f"{file}: no values are set aside"]
    assert done("memory", "export", file, "--set-aside") == [header]
    assert registers(file) == [7, 0, 0, 0]


def test_values_of_one_memory_are_released(tmp_path: Path) -> None:
    path = tmp_path / "two.redb"
    keep(path, first=[1, 2, 3], second=[4, 5, 6])
    cut(path, first=holdfast.Memory(coils=10), second=holdfast.Memory(coils=10))
    file = str(path)
    assert usage_error("memory", "release", file).endswith("add --memory: first, second.")
    assert "has no memory 'thrid'" in usage_error("memory", "release", file, "--memory", "thrid")
    done("memory", "release", file, "--memory", "first")
    assert registers(file, "first") == [0, 0, 0, 1]
    assert registers(file, "second") == [4, 5, 6, 1]


def test_values_of_a_file_in_use_are_not_released(file: str) -> None:
    cut(file, plant=holdfast.Memory(coils=10))
    used = MemoryFile(file, [("plant", holdfast.Memory(coils=10))], 0)
    result = invoke("memory", "release", file)
    assert result.exit_code == 2
    assert "in use by another process" in result.stderr
    used.stop()
    assert registers(file) == [7, 0, 8, 1]

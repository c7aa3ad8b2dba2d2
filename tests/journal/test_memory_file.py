"""A file that keeps memories: loading, storing, stopping, errors and status."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from holdfast import Memory
from holdfast._core import MemoryFile, read_memory_file

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "memories.redb"


def plant() -> Memory:
    return Memory(holding_registers=(100, 300), coils=9)


@pytest.mark.parametrize("sync", [0, 3600])
def test_contents_are_there_after_a_restart(path: Path, sync: float) -> None:
    one, two = plant(), Memory(coils=8)
    file = MemoryFile(str(path), [("one", one), ("two", two)], sync)
    assert file.loaded == []
    one.write("holding_registers", 100, [1])
    file.start()
    one.write("holding_registers", 399, [65535])
    one.write("coils", 8, [1])
    two.write("coils", 0, [1, 0, 1])
    file.stop()
    file.stop()
    one, two = plant(), Memory(coils=8)
    file = MemoryFile(path, [("one", one), ("two", two)], sync)
    assert file.loaded == ["one", "two"]
    assert file.warnings == []
    assert one.read("holding_registers", 100, 300) == [1, *[0] * 298, 65535]
    assert one.read("coils", 0, 9) == [*[0] * 8, 1]
    assert two.read("coils", 0, 8) == [1, 0, 1, 0, 0, 0, 0, 0]


def test_writes_are_refused_after_the_stop(path: Path) -> None:
    memory = plant()
    file = MemoryFile(path, [("plant", memory)], 0)
    file.start()
    file.stop()
    with pytest.raises(OSError, match="can't be reached, and nothing was written"):
        memory.write("coils", 0, [1])
    assert memory.read("coils", 0, 1) == [0]
    assert file.status()["refused"] == 1


def test_the_status_counts(path: Path) -> None:
    memory = plant()
    file = MemoryFile(path, [("plant", memory)], 0)
    began = time.time()
    file.start()
    commits = file.status()["commits"]
    for value in range(1, 6):
        memory.write("holding_registers", 100, [value])
    status = file.status()
    assert status["failing"] is None
    assert status["commits"] == commits + 5
    assert status["pending"] == status["refused"] == 0
    assert status["stored_at"] is not None
    assert abs(status["stored_at"] - began) < 600
    assert status["last_commit_seconds"] > 0
    assert status["bytes"] == path.stat().st_size
    file.stop()


def test_a_resized_area_is_a_warning(path: Path) -> None:
    file = MemoryFile(path, [("plant", plant()), ("gone", Memory(coils=8))], 0)
    file.start()
    file.stop()
    file = MemoryFile(path, [("plant", Memory(holding_registers=(200, 300), coils=9))], 0)
    assert file.warnings == [
        "plant: holding_registers had addresses 100-399 and now has addresses 200-499: "
        "addresses 200-399 are kept, addresses 100-199 are set aside",
        "plant: set aside in the file: holding_registers 100-199. Their values come back when the "
        "memory has these addresses again; 'holdfast memory release' deletes them",
        "gone: is in the file but not configured, and stays there",
    ]


def test_the_file_can_be_read(path: Path) -> None:
    memory = plant()
    file = MemoryFile(path, [("plant", memory)], 0)
    file.start()
    memory.write("holding_registers", 101, [0x0102])
    memory.write("coils", 0, [1, 0, 0, 0, 0, 0, 0, 0, 1])
    with pytest.raises(OSError, match=r"memories\.redb: the file is in use by another process"):
        read_memory_file(path)
    file.stop()
    before = path.read_bytes()
    registers = bytes([0, 0, 1, 2, *[0] * 596])
    areas = {"holding_registers": (100, 300, registers), "coils": (0, 9, b"\1\1")}
    assert read_memory_file(str(path)) == {"plant": areas}
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is damaged: it has 0 bytes. Restore it"),
        (b"coils:\n", r"not a file of memories: it begins with coil"),
        (b"redb", "the file is damaged: "),
    ],
)
def test_a_file_that_is_none_of_memories_is_refused(
    path: Path, content: bytes, message: str
) -> None:
    path.write_bytes(content)
    memory = plant()
    with pytest.raises(OSError, match=message) as raised:
        MemoryFile(path, [("plant", memory)], 0)
    assert str(raised.value).startswith(f"{path}: ")
    with pytest.raises(OSError, match=message):
        read_memory_file(path)
    assert path.read_bytes() == content
    memory.write("coils", 0, [1])


def test_a_damaged_file_is_refused(path: Path) -> None:
    memory = plant()
    file = MemoryFile(path, [("plant", memory)], 0)
    file.start()
    memory.write("holding_registers", 100, list(range(1000, 1300)))
    file.stop()
    content = path.read_bytes()
    page = bytes.fromhex("03e803e903ea")
    assert page in content
    path.write_bytes(content.replace(page, bytes.fromhex("03e803e903eb")))
    memory = plant()
    with pytest.raises(OSError, match="the file is damaged"):
        MemoryFile(path, [("plant", memory)], 0)
    assert memory.read("holding_registers", 100, 1) == [0]


def test_a_file_in_use_by_another_process_is_refused(path: Path) -> None:
    program = (
        "import sys; from holdfast import Memory; from holdfast._core import MemoryFile\n"
        f"file = MemoryFile({str(path)!r}, [('a', Memory(coils=8))], 0); file.start()\n"
        "print('open', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "open\n"
        with pytest.raises(OSError, match="the file is in use by another process"):
            MemoryFile(path, [("a", Memory(coils=8))], 0)
        other.kill()
    assert MemoryFile(path, [("a", Memory(coils=8))], 0).loaded == ["a"]


def test_places_without_a_file_are_errors(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="a directory"):
        MemoryFile(tmp_path, [], 0)
    with pytest.raises(OSError, match="No such file"):
        MemoryFile(tmp_path / "none" / "file", [], 0)
    with pytest.raises(OSError, match="not found"):
        read_memory_file(tmp_path / "none")


def test_memories_that_cannot_be_kept_together_are_errors(path: Path) -> None:
    memory = plant()
    with pytest.raises(ValueError, match="memory a is given twice"):
        MemoryFile(path, [("a", memory), ("a", plant())], 0)
    with pytest.raises(ValueError, match='sync is "-1", allowed: 0 to 31622400 seconds'):
        MemoryFile(path, [("a", memory)], -1)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize("started", [True, False])
def test_a_forked_child_does_not_touch_the_file(path: Path, started: bool) -> None:
    program = (
        "import os; from holdfast import Memory; from holdfast._core import MemoryFile\n"
        f"memory = Memory(coils=8); file = MemoryFile({str(path)!r}, [('a', memory)], 0)\n"
        f"if {started}: file.start()\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    try:\n"
        "        memory.write('coils', 0, [1])\n"
        "    except OSError:\n"
        "        file.stop(); del file\n"
        "        os._exit(7)\n"
        "    os._exit(0)\n"
        "print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))\n"
        "file.start()\n"
        "memory.write('coils', 1, [1]); file.stop()"
    )
    ran = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, check=True)
    assert ran.stdout == b"7\n"
    assert read_memory_file(path)["a"] == {"coils": (0, 8, b"\2")}


@pytest.mark.skipif(sys.platform == "win32", reason="needs symbolic links")
def test_a_link_to_a_file_is_followed(path: Path) -> None:
    MemoryFile(path, [("a", Memory(coils=8))], 0).start()
    link = path.with_name("link")
    link.symlink_to(path)
    assert MemoryFile(link, [("a", Memory(coils=8))], 0).loaded == ["a"]
    assert link.is_symlink()


@pytest.mark.skipif(sys.platform == "win32", reason="needs symbolic links")
def test_a_link_to_nothing_is_named(path: Path) -> None:
    target = path.with_name("moved.redb")
    path.symlink_to(target)
    message = (
        rf"memories\.redb: not a file of memories: a symbolic link to {target}, which does not"
    )
    with pytest.raises(OSError, match=message):
        MemoryFile(path, [("a", Memory(coils=8))], 0)
    with pytest.raises(OSError, match=message):
        read_memory_file(path)
    assert [path] == list(path.parent.iterdir())

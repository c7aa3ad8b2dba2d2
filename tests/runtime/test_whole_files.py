"""Files that are written whole or not at all."""

from __future__ import annotations

import errno
import os
import sys
from typing import TYPE_CHECKING

import pytest

from holdfast.runtime import whole_files

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no modes, owners and such pipes")


@pytest.fixture
def _private_files() -> Iterator[None]:
    before = os.umask(0o077)
    yield
    os.umask(before)


@pytest.mark.usefixtures("_private_files")
def test_a_file_keeps_its_mode_and_a_new_one_has_that_of_the_process(tmp_path: Path) -> None:
    new, old = tmp_path / "new", tmp_path / "old"
    old.write_bytes(b"1")
    old.chmod(0o664)
    for file in (new, old):
        whole_files.replace(file, b"2")
    assert (new.stat().st_mode & 0o777, old.stat().st_mode & 0o777) == (0o600, 0o664)


def test_a_file_keeps_its_owner_but_not_one_with_a_secret(tmp_path: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root gives files away")
    file = tmp_path / "file"
    file.write_bytes(b"1")
    file.chmod(0o666)
    os.chown(file, 1234, 5678)
    whole_files.replace(file, b"2")
    assert (file.stat().st_uid, file.stat().st_gid, file.read_bytes()) == (1234, 5678, b"2")
    whole_files.replace(file, b"3", whole_files.SECRET)
    assert (file.stat().st_uid, file.stat().st_gid) == (os.geteuid(), os.getegid())
    assert (file.stat().st_mode & 0o777, file.read_bytes()) == (0o600, b"3")


def test_a_file_is_replaced_where_none_can_be_given_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    file = tmp_path / "file"
    file.write_bytes(b"1")
    before = file.stat()
    monkeypatch.setattr(os, "chown", refuse)
    with file.open("rb") as reader:
        whole_files.replace(file, b"2")
        assert reader.read() == b"1"
    assert (file.stat().st_mode, file.read_bytes()) == (before.st_mode, b"2")


def test_a_private_file_is_private_while_it_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    modes = list[int]()
    file = tmp_path / "file"
    file.write_bytes(b"1")
    file.chmod(0o600)
    monkeypatch.setattr(os, "fsync", lambda number: modes.append(os.fstat(number).st_mode & 0o777))
    whole_files.replace(file, b"2")
    assert modes == [0o600]


def test_a_long_name_leaves_room_for_the_name_of_the_new_file(tmp_path: Path) -> None:
    for letter in "a\N{OLD ITALIC LETTER A}":
        file = tmp_path / (letter * (255 // len(letter.encode())))
        file.write_bytes(b"1")
        whole_files.replace(file, b"2")
        assert file.read_bytes() == b"2"


def test_the_file_behind_a_link_is_replaced(tmp_path: Path) -> None:
    file, link = tmp_path / "file", tmp_path / "link"
    file.write_bytes(b"1")
    link.symlink_to(file)
    whole_files.replace(link, b"2")
    assert (link.is_symlink(), file.read_bytes()) == (True, b"2")


def test_a_pipe_is_written_to(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    whole_files.try_replace(tmp_path / f"/dev/fd/{writing}")
    whole_files.replace(tmp_path / f"/dev/fd/{writing}", b"2")
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        assert pipe.read() == b"2"


def test_a_file_in_a_folder_that_takes_no_other_is_written_in_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    file = tmp_path / "file"
    file.write_bytes(b"1")
    monkeypatch.setattr(whole_files, "write_new", refuse)
    whole_files.try_replace(file)
    whole_files.replace(file, b"2")
    assert file.read_bytes() == b"2"
    with pytest.raises(PermissionError):
        whole_files.replace(tmp_path / "new", b"2")


def test_a_file_that_can_be_neither_written_nor_given_to_its_owner_is_found_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    file = tmp_path / "file"
    file.write_bytes(b"1")
    monkeypatch.setattr(os, "chown", refuse)
    whole_files.try_replace(file)
    mode, inode, device, links, owner, *others = file.stat()
    of_another = os.stat_result([mode, inode, device, links, owner + 1, *others])
    monkeypatch.setattr(whole_files, "_before", lambda _: of_another)
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(PermissionError):
        whole_files.try_replace(file)
    assert list(tmp_path.iterdir()) == [file]

"""A wheel does not depend on the folder in which it was built."""

from __future__ import annotations

import base64
import hashlib
import zipfile
from pathlib import Path

import dist

COMPONENTS = "holdfast_modbus-1.dist-info/sboms/core.json"
RECORD = "holdfast_modbus-1.dist-info/RECORD"


def wheel(path: Path, folder: Path) -> Path:
    """A wheel as maturin makes it: its list of components names the folder of the build."""
    components = f'{{"ref": "path+file://{folder}/crates/engine#0.1.0"}}'.encode()
    code = b"print(1)\n"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        files = {"holdfast/code.py": code, COMPONENTS: components}
        lines = [dist.recorded(zipfile.ZipInfo(name), content) for name, content in files.items()]
        files[RECORD] = b"".join(lines) + f"{RECORD},,\n".encode()
        for name, content in files.items():
            made.writestr(zipfile.ZipInfo(name, (2001, 9, 9, 1, 46, 40)), content)
    return path


def test_a_wheel_does_not_name_the_folder_of_its_build(tmp_path: Path) -> None:
    made = []
    for number, folder in enumerate((Path("/home/one/build"), Path("/srv/another/place"))):
        built = wheel(tmp_path / f"{number}.built", folder)
        made.append(dist.without_folder(built, folder, tmp_path / f"{number}.whl").read_bytes())
    assert made[0] == made[1]

    with zipfile.ZipFile(tmp_path / "0.whl") as archive:
        files = {each.filename: archive.read(each) for each in archive.infolist()}
    assert files[COMPONENTS] == b'{"ref": "path+file:///crates/engine#0.1.0"}'
    *lines, own = files[RECORD].decode().splitlines()
    assert own == f"{RECORD},,"
    for line in lines:
        name, digest, size = line.split(",")
        sha256 = base64.urlsafe_b64encode(hashlib.sha256(files[name]).digest()).rstrip(b"=")
        assert (digest, int(size)) == (f"sha256={sha256.decode()}", len(files[name]))

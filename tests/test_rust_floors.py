"""The rooms of a crate import only those of lower floors in its Cargo.toml, and form no circle.

`make lint` checks the floors of the Python package (.importlinter).
"""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING, Any

import pytest

from support import rust_imports
from support.imports import Import, circles
from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

CRATES = sorted(file.parent for file in (ROOT / "crates").glob("*/Cargo.toml"))


def imports_of(crates: list[Path], root: Path) -> list[Import]:
    """All imports of the files of these crates."""
    modules = [module for crate in crates for module in rust_imports.modules(crate)]
    return rust_imports.rust_imports(modules, crates, root)


def forbidden(crate: Path, imports: list[Import]) -> list[str]:
    """The imports of a crate that its floors, or the homes of its libraries, do not allow."""
    name = rust_imports.crate_name(crate)
    house = _house(crate)
    floor = {room: number for number, rooms in enumerate(house["floors"]) for room in rooms}
    found = []
    for one in imports:
        crate_of, _, below = one.importer.partition("::")
        room = below.split("::")[0]
        if crate_of != name or not below:
            continue
        target = one.target.split("::")
        if target[0] != name:
            allowed = house["libraries"].get(target[0], [room])
            if room not in allowed:
                found.append(f"{one}, which only {', '.join(allowed)} may import")
        elif len(target) > 1 and target[1] != room and floor[room] >= floor[target[1]]:
            found.append(f"{one}, which is not below it")
    return found


def _house(crate: Path) -> dict[str, Any]:
    manifest = tomllib.loads((crate / "Cargo.toml").read_text(encoding="utf-8"))
    house: dict[str, Any] = manifest["package"].get("metadata", {}).get("house", {})
    return {"floors": house.get("floors", []), "libraries": house.get("libraries", {})}


@pytest.fixture(scope="module")
def imports() -> list[Import]:
    return imports_of(CRATES, ROOT)


@pytest.mark.parametrize(
    "crate", [each for each in CRATES if _house(each)["floors"]], ids=lambda crate: crate.name
)
def test_rooms_import_only_what_is_below_them(crate: Path, imports: list[Import]) -> None:
    found = forbidden(crate, imports)
    assert not found, "\n".join(found)


def test_files_form_no_circle(imports: list[Import]) -> None:
    found = circles(imports)
    assert not found, "\n".join(str(one) for circle in found for one in circle)


# That the checks above can fail: crates that are made up.


@pytest.fixture
def barn(tmp_path: Path) -> Callable[[dict[str, str]], Path]:
    """Writes a crate of three rooms, with these files in place of its own."""

    def write(files: dict[str, str]) -> Path:
        own = {
            "Cargo.toml": '[package]\nname = "barn"\n'
            '[dependencies]\ntokio = "1"\nserde-json = "1"\n'
            '[package.metadata.house]\nfloors = [["door"], ["stable"], ["hay"]]\n'
            '[package.metadata.house.libraries]\ntokio = ["stable"]\n',
            "src/lib.rs": "mod door;\nmod hay;\nmod stable;\npub use hay::Bale;\n",
            "src/door.rs": "",
            "src/hay.rs": "pub struct Bale;\n",
            "src/stable/mod.rs": "mod horse;\n",
            "src/stable/horse.rs": "",
        }
        for name, text in (own | files).items():
            file = tmp_path / "barn" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
        return tmp_path / "barn"

    return write


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        (
            "hay.rs",
            "use crate::stable::Horse;",
            "barn::hay imports barn::stable::Horse, which is not",
        ),
        ("hay.rs", "fn f() {\n    crate::door::Knob\n}", "barn::hay imports barn::door::Knob"),
        ("stable/horse.rs", "use super::super::door::Knob;", "horse imports barn::door::Knob"),
        ("hay.rs", "use tokio::net;", "barn::hay imports tokio::net, which only stable may import"),
        (
            "hay.rs",
            "use {\n    std::io, crate::door::{self, Knob},\n};",
            "imports barn::door::Knob",
        ),
    ],
)
def test_an_import_that_is_not_allowed_is_named(
    barn: Callable[[dict[str, str]], Path], tmp_path: Path, file: str, text: str, message: str
) -> None:
    crate = barn({f"src/{file}": text})
    found = forbidden(crate, imports_of([crate], tmp_path))
    assert found
    assert all(message in one for one in found)


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("door.rs", "use crate::stable::Horse;\nuse crate::Bale;"),
        ("stable/horse.rs", "use tokio::net::TcpStream;\nuse crate::hay::Bale;\nuse super::Horse;"),
        ("hay.rs", "// use crate::door::Knob;\n/* tokio::net /* crate::door */ */"),
        ("hay.rs", 'const TEXT: &str = "tokio::net \\" crate::door";'),
        ("hay.rs", "#[cfg(test)]\nmod tests {\n    use crate::door::Knob;\n}"),
        ("hay.rs", "use serde_json::Value;\nfn f() { core::mem::drop(()) }"),
    ],
)
def test_what_is_allowed_is_not_named(
    barn: Callable[[dict[str, str]], Path], tmp_path: Path, file: str, text: str
) -> None:
    crate = barn({f"src/{file}": text})
    assert forbidden(crate, imports_of([crate], tmp_path)) == []


def test_a_circle_of_files_is_found(barn: Callable[[dict[str, str]], Path], tmp_path: Path) -> None:
    crate = barn(
        {
            "src/stable/mod.rs": "mod horse;\nmod foal;\n",
            "src/stable/horse.rs": "use super::foal::Foal;",
            "src/stable/foal.rs": "use crate::stable::horse::Horse;",
        }
    )
    (circle,) = circles(imports_of([crate], tmp_path))
    assert [one.importer for one in circle] == ["barn::stable::foal", "barn::stable::horse"]

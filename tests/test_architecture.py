"""The imports are those that docs/architecture.md allows, and form no circle."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from support import python_imports, rust_imports
from support.architecture import Architecture, shown
from support.imports import Import, circles
from support.paths import DOCS, ROOT

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

PACKAGE = ROOT / "python" / "holdfast"
CRATES = sorted(file.parent for file in (ROOT / "crates").glob("*/Cargo.toml"))


class Tree:
    """What is to be judged: the files of packages and crates, and their imports."""

    def __init__(self, root: Path, package: Path | None, crates: list[Path]) -> None:
        self.modules: dict[str, Path] = {}
        self.imports: list[Import] = []
        if package is not None:
            self.modules |= python_imports.modules(package)
            self.imports += python_imports.python_imports(package, root)
        rust = [module for crate in crates for module in rust_imports.modules(crate)]
        self.modules |= {module.name: module.file for module in rust}
        self.imports += rust_imports.rust_imports(rust, crates, root)
        self.imports += rust_imports.exceptions_from_python(rust, root, "holdfast._core")
        self.modules = {name: file.relative_to(root) for name, file in self.modules.items()}


@pytest.fixture(scope="module")
def tree() -> Tree:
    return Tree(ROOT, PACKAGE, CRATES)


@pytest.fixture(scope="module")
def architecture() -> Architecture:
    return Architecture(DOCS / "architecture.md")


def test_every_file_is_in_a_room_of_the_table(tree: Tree, architecture: Architecture) -> None:
    assert architecture.modules_without_a_room(tree.modules) == []


def test_every_room_of_the_table_has_files(tree: Tree, architecture: Architecture) -> None:
    assert architecture.rooms_without_a_module(tree.modules) == []


def test_every_import_is_allowed(tree: Tree, architecture: Architecture) -> None:
    forbidden = architecture.forbidden(tree.imports, tree.modules)
    assert not forbidden, "\n".join(forbidden)


def test_the_table_allows_nothing_that_no_file_needs(
    tree: Tree, architecture: Architecture
) -> None:
    unused = architecture.unused(tree.imports, tree.modules)
    assert not unused, "\n".join(unused)


def test_files_form_no_circle(tree: Tree) -> None:
    found = circles(tree.imports)
    assert not found, "\n".join(map(shown, found))


def test_rooms_form_no_circle(tree: Tree, architecture: Architecture) -> None:
    found = architecture.circles_of_rooms(tree.imports)
    assert not found, "\n".join(map(shown, found))


@pytest.mark.parametrize("crate", CRATES, ids=lambda crate: crate.name)
def test_a_crate_depends_only_on_what_its_rooms_may_import(
    crate: Path, architecture: Architecture
) -> None:
    name = rust_imports.crate_name(crate)
    rows = [row for room, row in architecture.rows.items() if room.split("::")[0] == name]
    crates = {room.split("::")[0] for row in rows for room in row.rooms}
    libraries = {library for row in rows for library in row.libraries}
    assert rust_imports.dependencies(crate) == (crates | libraries) - {name}


def test_the_page_describes_every_room_of_the_table(architecture: Architecture) -> None:
    described = (DOCS / "architecture.md").read_text(encoding="utf-8").split("## Imports")[0]
    assert [room for room in architecture.rows if f"`{room}`" not in described] == []


def test_every_file_that_the_page_names_exists() -> None:
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:crates|python|tests|docs)/[\w/.]+)`", page)
    assert len(named) > 20
    assert [name for name in named if not (ROOT / name).exists()] == []


# That the checks above can fail: trees that are made up.

PAGE = """
| room | may import of ours | may import of others |
| --- | --- | --- |
| `house` | `house.kitchen` | |
| `house.kitchen` | `house.cellar` | `water.cold` |
| `house.cellar` | | |
"""

RUST_PAGE = """
| room | may import of ours | may import of others |
| --- | --- | --- |
| `barn` | | |
| `barn::stable` | `barn::hay`, `field` | `tokio` |
| `barn::hay` | | |
| `field` | | |
"""


@pytest.fixture
def package(tmp_path: Path) -> Callable[[dict[str, str]], Tree]:
    """Writes a Python package of three rooms, with these files in place of its own."""

    def write(files: dict[str, str]) -> Tree:
        empty = ["house/__init__.py", "house/kitchen/__init__.py", "house/cellar.py"]
        return _written(tmp_path, dict.fromkeys(empty, "") | files)

    return write


@pytest.fixture
def crates(tmp_path: Path) -> Callable[[dict[str, str]], Tree]:
    """Writes two Rust crates, with these files in place of their own."""

    def write(files: dict[str, str]) -> Tree:
        dependencies = '[dependencies]\nfield = "1"\ntokio = "1"\nserde-json = "1"\n'
        own = {
            "barn/Cargo.toml": f'[package]\nname = "barn"\n{dependencies}',
            "barn/src/lib.rs": "mod hay;\nmod stable;\n",
            "barn/src/hay.rs": "pub struct Bale;\n",
            "barn/src/stable/mod.rs": "mod horse;\n",
            "barn/src/stable/horse.rs": "",
            "field/Cargo.toml": '[package]\nname = "field"\n',
            "field/src/lib.rs": "pub mod grass;\npub use grass::Blade;\n",
            "field/src/grass.rs": "pub struct Blade;\n",
        }
        return _written(tmp_path, own | files)

    return write


def _written(root: Path, files: dict[str, str]) -> Tree:
    for name, text in files.items():
        file = root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    package = root / "house"
    return Tree(
        root,
        package if package.exists() else None,
        sorted(file.parent for file in root.glob("*/Cargo.toml")),
    )


def _table(folder: Path, text: str) -> Architecture:
    page = folder / "page.md"
    page.write_text(text, encoding="utf-8")
    return Architecture(page)


@pytest.mark.parametrize(
    ("line", "text", "name"),
    [
        (1, "import house.kitchen", "house.kitchen"),
        (1, "from house.kitchen import stove", "house.kitchen.stove"),
        (1, "from .kitchen import stove", "house.kitchen.stove"),
        (1, "from . import kitchen", "house.kitchen"),
        (2, "def cook():\n    import house.kitchen", "house.kitchen"),
        (2, "if TYPE_CHECKING:\n    from house import kitchen", "house.kitchen"),
        (1, "importlib.import_module('house.kitchen')", "house.kitchen"),
        (1, "LAZY = {'cook': 'house.kitchen'}", "house.kitchen"),
        (1, "import water.cold", "water.cold"),
        (1, "from water import cold", "water.cold"),
    ],
)
def test_an_import_that_is_not_allowed_is_named_with_its_place(
    package: Callable[[dict[str, str]], Tree], tmp_path: Path, line: int, text: str, name: str
) -> None:
    tree = package({"house/cellar.py": text})
    assert _table(tmp_path, PAGE).forbidden(tree.imports, tree.modules) == [
        f"house/cellar.py:{line}: house.cellar imports {name}; "
        "page.md allows house.cellar to import: nothing"
    ]


@pytest.mark.parametrize(
    "text",
    [
        "import os\nfrom collections import abc",
        "from house import cellar",
        "from house.kitchen import stove",
        "from ..cellar import shelf",
        "from water.cold import tap",
    ],
)
def test_an_import_that_is_allowed_is_not_named(
    package: Callable[[dict[str, str]], Tree], tmp_path: Path, text: str
) -> None:
    tree = package({"house/kitchen/stove.py": text})
    assert _table(tmp_path, PAGE).forbidden(tree.imports, tree.modules) == []


def test_a_part_of_a_library_does_not_allow_its_other_parts(
    package: Callable[[dict[str, str]], Tree], tmp_path: Path
) -> None:
    tree = package({"house/kitchen/stove.py": "import water.hot"})
    assert _table(tmp_path, PAGE).forbidden(tree.imports, tree.modules) == [
        "house/kitchen/stove.py:1: house.kitchen.stove imports water.hot; "
        "page.md allows house.kitchen to import: house.cellar, water.cold"
    ]


def test_a_file_in_no_room_is_named(
    package: Callable[[dict[str, str]], Tree], tmp_path: Path
) -> None:
    tree = package({"house/attic.py": ""})
    table = _table(tmp_path, PAGE)
    assert table.modules_without_a_room(tree.modules) == [
        "house/attic.py: page.md has no row for house.attic"
    ]


def test_a_room_without_files_is_named(
    package: Callable[[dict[str, str]], Tree], tmp_path: Path
) -> None:
    table = _table(tmp_path, PAGE + "| `house.attic` | | |\n")
    assert table.rooms_without_a_module(package({}).modules) == ["house.attic"]


def test_what_is_allowed_and_not_needed_is_named(
    package: Callable[[dict[str, str]], Tree], tmp_path: Path
) -> None:
    tree = package(
        {
            "house/__init__.py": "from house import kitchen",
            "house/kitchen/a.py": "import water.cold",
        }
    )
    assert _table(tmp_path, PAGE).unused(tree.imports, tree.modules) == [
        "house.kitchen imports nothing of house.cellar, though page.md allows it"
    ]


def test_a_circle_of_python_files_is_shown_import_by_import(
    package: Callable[[dict[str, str]], Tree],
) -> None:
    tree = package(
        {
            "house/kitchen/stove.py": "from house.kitchen.pan import lid",
            "house/kitchen/pan.py": "import os\n\n\ndef lid():\n    from house.cellar import shelf",
            "house/cellar.py": "if TYPE_CHECKING:\n    from house.kitchen import stove",
            "house/__init__.py": "from house.kitchen import stove",
        }
    )
    (circle,) = circles(tree.imports)
    assert shown(circle) == (
        "a circle of imports:\n"
        "  house/cellar.py:2: house.cellar imports house.kitchen.stove\n"
        "  house/kitchen/stove.py:1: house.kitchen.stove imports house.kitchen.pan.lid\n"
        "  house/kitchen/pan.py:5: house.kitchen.pan imports house.cellar.shelf"
    )


def test_a_package_that_imports_its_own_parts_is_in_a_circle_with_a_part_that_imports_it(
    package: Callable[[dict[str, str]], Tree],
) -> None:
    tree = package(
        {
            "house/kitchen/__init__.py": "from .stove import heat",
            "house/kitchen/stove.py": "from house.kitchen import taste",
        }
    )
    assert [len(circle) for circle in circles(tree.imports)] == [2]


def test_rooms_form_a_circle_even_where_their_files_do_not(
    package: Callable[[dict[str, str]], Tree], tmp_path: Path
) -> None:
    tree = package(
        {
            "house/kitchen/stove.py": "import house.cellar",
            "house/kitchen/pan.py": "",
            "house/cellar.py": "from house.kitchen import pan",
        }
    )
    assert circles(tree.imports) == []
    (circle,) = _table(tmp_path, PAGE).circles_of_rooms(tree.imports)
    assert [one.importer for one in circle] == ["house.cellar", "house.kitchen"]


@pytest.mark.parametrize(
    ("line", "text", "name"),
    [
        (1, "use crate::hay::Bale;", "barn::hay::Bale"),
        (1, "use super::hay::Bale as Straw;", "barn::hay::Bale"),
        (2, "use {\n    crate::hay::{self, Bale},\n};", "barn::hay::Bale"),
        (2, "fn feed() {\n    crate::hay::Bale\n}", "barn::hay::Bale"),
        (2, "use crate::hay;\nfn feed() { hay::Bale }", "barn::hay::Bale"),
        (1, "mod inner { use super::super::hay::Bale; }", "barn::hay::Bale"),
        (1, "pub(crate) use crate::hay::*;", "barn::hay::*"),
        (1, "use field::Blade;", "field::Blade"),
        (1, "fn feed() -> field::grass::Blade {}", "field::grass::Blade"),
        (1, "use serde_json::Value;", "serde_json::Value"),
        (2, "#[derive(Debug)]\nstruct A(serde_json::Value);", "serde_json::Value"),
        (3, "/* crate::\n/* hay */ */\nuse serde_json as json;", "serde_json"),
    ],
)
def test_a_rust_import_that_is_not_allowed_is_named_with_its_place(
    crates: Callable[[dict[str, str]], Tree], tmp_path: Path, line: int, text: str, name: str
) -> None:
    tree = crates({"barn/src/door.rs": text, "barn/src/lib.rs": "mod door;\nmod hay;\n"})
    table = _table(tmp_path, RUST_PAGE + "| `barn::door` | | |\n")
    assert table.forbidden(tree.imports, tree.modules) == [
        f"barn/src/door.rs:{line}: barn::door imports {name}; "
        "page.md allows barn::door to import: nothing"
    ]


@pytest.mark.parametrize(
    "text",
    [
        "use std::io;\nfn f() { core::mem::drop(()) }",
        "// use crate::hay::Bale;\n/* serde_json::Value /* crate::hay */ field::Blade */",
        'const TEXT: &str = "serde_json::Value \\" crate::hay";',
        'const TEXT: &str = r#"" serde_json::Value"#;',
        "fn f<'a>(x: &'a u8) -> char { '\"' }  // \" serde_json::Value",
        "#[cfg(test)]\nmod tests {\n    use serde_json::Value;\n}",
        "#[cfg(test)]\n#[allow(dead_code)]\nuse serde_json::Value;",
        "#[cfg(test)]\nfn f(a: [u8; 2]) { serde_json::from(a) }",
        "impl Iterator for A { fn f(&self) -> impl Fn() + use<'_> { Self::g } }",
    ],
)
def test_comments_strings_tests_and_the_standard_library_are_no_imports(
    crates: Callable[[dict[str, str]], Tree], text: str
) -> None:
    tree = crates({"barn/src/hay.rs": text})
    assert [one for one in tree.imports if one.importer == "barn::hay"] == []


def test_a_file_that_is_only_for_tests_is_not_read(
    crates: Callable[[dict[str, str]], Tree],
) -> None:
    tree = crates(
        {
            "barn/src/hay.rs": "pub mod bale;\n#[cfg(test)]\nmod tests;\n",
            "barn/src/hay/bale.rs": "",
            "barn/src/hay/tests.rs": "use serde_json::Value;\n",
        }
    )
    assert "barn::hay::bale" in tree.modules
    assert "barn::hay::tests" not in tree.modules
    assert tree.imports == []


def test_what_is_not_only_for_tests_is_an_import(crates: Callable[[dict[str, str]], Tree]) -> None:
    text = "#[cfg(not(test))]\nuse serde_json::Value;\n#[cfg(test)]\nmod tests {}\nuse tokio::net;"
    tree = crates({"barn/src/hay.rs": text})
    assert [one.name for one in tree.imports] == ["serde_json::Value", "tokio::net"]


def test_what_the_table_allows_a_part_of_a_crate_is_not_named(
    crates: Callable[[dict[str, str]], Tree], tmp_path: Path
) -> None:
    text = "use crate::hay::Bale;\nuse field::Blade;\nuse tokio::net::TcpStream;\nuse super::Horse;"
    tree = crates({"barn/src/stable/horse.rs": text})
    table = _table(tmp_path, RUST_PAGE)
    assert table.forbidden(tree.imports, tree.modules) == []
    assert table.unused(tree.imports, tree.modules) == []


def test_an_exception_that_native_code_takes_from_python_is_an_import_of_the_native_module(
    crates: Callable[[dict[str, str]], Tree],
) -> None:
    tree = crates({"barn/src/hay.rs": "\npyo3::import_exception!(house.cellar, Locked);\n"})
    assert list(map(str, tree.imports)) == [
        "barn/src/hay.rs:2: holdfast._core imports house.cellar.Locked"
    ]


def test_a_re_export_leads_to_the_file_that_defines_the_name(
    crates: Callable[[dict[str, str]], Tree],
) -> None:
    tree = crates(
        {
            "barn/src/lib.rs": "mod hay;\nmod stable;\npub use hay::Bale;\n",
            "barn/src/stable/horse.rs": "use crate::Bale;\nuse field::Blade;\n",
        }
    )
    assert [(one.importer, one.target) for one in tree.imports] == [
        ("barn::stable::horse", "barn::hay"),
        ("barn::stable::horse", "field::grass"),
    ]


def test_a_circle_of_rust_files_is_shown_import_by_import(
    crates: Callable[[dict[str, str]], Tree],
) -> None:
    tree = crates(
        {
            "barn/src/hay.rs": "pub struct Bale(crate::stable::Horse);",
            "barn/src/stable/mod.rs": "mod horse;\npub use horse::Horse;\n",
            "barn/src/stable/horse.rs": "\nuse crate::hay::{self, Bale};\npub struct Horse;",
        }
    )
    (circle,) = circles(tree.imports)
    assert shown(circle) == (
        "a circle of imports:\n"
        "  barn/src/hay.rs:1: barn::hay imports barn::stable::Horse\n"
        "  barn/src/stable/horse.rs:2: barn::stable::horse imports barn::hay::Bale"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# A page\n", "no table has the columns room | may import of ours"),
        (PAGE + "| `house.cellar` | | |\n", "one row for each room is required"),
        (PAGE + "| `house.attic` | `house.roof` | |\n", r"may import \['house.roof'\]"),
    ],
)
def test_a_table_that_is_wrong_is_not_taken(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message.replace("|", r"\|")):
        _table(tmp_path, text)

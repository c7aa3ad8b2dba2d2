"""Reads all imports of a Python package, including lazy imports and imports for typing."""

from __future__ import annotations

import ast
import sys
from typing import TYPE_CHECKING

from support.imports import Import

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def modules(package: Path) -> dict[str, Path]:
    """Returns the file of every module of a package, by the module's full name."""
    files = [file for suffix in ("py", "pyi") for file in package.rglob(f"*.{suffix}")]
    return {_name(file, package.parent): file for file in sorted(files)}


def python_imports(package: Path, root: Path) -> list[Import]:
    """Returns all imports of a package except of the standard library; paths relative to `root`."""
    files = modules(package)
    return [
        Import(importer, file.relative_to(root), line, name, _target(name, files))
        for importer, file in files.items()
        for line, name in dict.fromkeys(_names(file, importer, files))
        if name.partition(".")[0] not in sys.stdlib_module_names
    ]


def _name(file: Path, above: Path) -> str:
    parts = file.relative_to(above).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _target(name: str, files: dict[str, Path]) -> str:
    """Returns the project's module of a name; the name itself if it is from a library."""
    module = name
    while module not in files and "." in module:
        module = module.rpartition(".")[0]
    return module if module in files else name


def _names(file: Path, importer: str, files: dict[str, Path]) -> Iterator[tuple[int, str]]:
    """Returns the lines and the full names of a file's imports."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"), file)):
        match node:
            case ast.Import():
                yield from ((node.lineno, alias.name) for alias in node.names)
            case ast.ImportFrom():
                start = _absolute(node, file, importer)
                yield from ((node.lineno, f"{start}.{alias.name}") for alias in node.names)
            case ast.Call(
                func=ast.Attribute(attr="import_module") | ast.Name(id="import_module"),
                args=[ast.Constant(value=str(name)), *_],
            ):
                yield node.lineno, name
            case ast.Constant(value=str(name)) if name in files and "." in name:
                # The name of a module as a string, as in a table of lazy imports.
                yield node.lineno, name


def _absolute(node: ast.ImportFrom, file: Path, importer: str) -> str:
    if not node.level:
        assert node.module is not None
        return node.module
    package = importer.split(".")
    climb = node.level - (file.stem == "__init__")
    start = package[: len(package) - climb]
    return ".".join([*start, *([node.module] if node.module else [])])

"""Private names of other packages: each is in the table of docs/dependencies.md, and exists.

Private is a name that begins with an underscore, and everything in a module that its package does
not document. No package promises to keep such names, so the versions of these packages are capped.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.metadata
import inspect
import re
import sys
import tomllib
from collections.abc import Iterator
from typing import NamedTuple

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from support.paths import DOCS, ROOT

PRODUCT = ROOT / "python" / "holdfast"
UNDOCUMENTED = ("nats.aio.transport", "nats.protocol", "ruamel.yaml.scanner")
"""Modules that nothing in their package's documentation speaks of."""

DOCUMENTED = ("_exit",)
"""Names that only look private: `os._exit`."""

VARIABLES = {"net/nats/batch.py": {"client": "nats.aio.client.Client"}}
"""What variables hold that a file takes private names of, by their names."""

DERIVED = {"BrokerClient": "paho.mqtt.client.Client"}
"""Classes of the product that others derive from, and what they are derived from themselves."""


class Use(NamedTuple):
    file: str
    owner: str
    """The module or class that has the name."""
    name: str


def in_table() -> list[Use]:
    section = (DOCS / "dependencies.md").read_text().split("\n## Private names\n")[1]
    rows = re.findall(r"^\| `([^`]+)` \| (.*?) \| `([^`]+)` \|", section, re.MULTILINE)
    return [
        Use(file, owner, name)
        for owner, names, file in rows
        for name in re.findall(r"`([^`]+)`", names)
    ]


WINDOWS_ONLY = {"win32serviceutil"}


@functools.cache
def in_product() -> frozenset[Use]:
    return frozenset(
        use
        for path in PRODUCT.rglob("*.py")
        for use in uses(
            path.relative_to(PRODUCT).as_posix(), ast.parse(path.read_text()), own_names()
        )
    )


def uses(file: str, tree: ast.Module, own: frozenset[str]) -> Iterator[Use]:
    """The private names that a file takes of other packages."""
    imported: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if is_foreign(alias.name) and is_private(alias.name):
                    module, _, name = alias.name.rpartition(".")
                    yield Use(file, module, name)
        if not isinstance(node, ast.ImportFrom):
            continue
        derived = [alias.name for alias in node.names if alias.name in DERIVED]
        imported |= {name: DERIVED[name] for name in derived}
        if not is_foreign(node.module):
            continue
        for alias in node.names:
            imported[alias.asname or alias.name] = f"{node.module}.{alias.name}"
            if is_private(str(node.module)) or is_private(alias.name):
                yield Use(file, str(node.module), alias.name)
    inside: set[ast.AST] = set()
    bases: dict[str, str] = {}
    for node in ast.walk(tree):
        if not isinstance(node, ast.ClassDef):
            continue
        for base in node.bases:
            owner = imported.get(name_of(base)) or bases.get(name_of(base))
            found = None if owner is None else loaded(owner)
            if owner is None or not isinstance(found, type):
                continue
            bases[node.name] = owner
            private = private_members(found)
            methods = {each.name for each in node.body if isinstance(each, ast.FunctionDef)}
            methods |= {each.name for each in node.body if isinstance(each, ast.AsyncFunctionDef)}
            yield from (Use(file, owner, name) for name in methods & private)
            for each in ast.walk(node):
                if isinstance(each, ast.Attribute) and is_self(each.value):
                    inside.add(each)
                    if each.attr in private:
                        yield Use(file, owner, each.attr)
    variables = VARIABLES.get(file, {})
    for node in ast.walk(tree):
        if not isinstance(node, ast.Attribute) or node in inside:
            continue
        variable = variables.get(name_of(node.value))
        if variable in sys.stdlib_module_names:
            if is_hidden(node.attr):
                yield Use(file, variable, node.attr)
        elif variable is not None and node.attr in private_members(loaded(variable)):
            yield Use(file, variable, node.attr)
        elif is_hidden(node.attr) and node.attr not in own:
            yield Use(file, variable or "?", node.attr)


def is_foreign(module: str | None) -> bool:
    top = (module or "").partition(".")[0]
    return top not in ("", "holdfast") and top not in sys.stdlib_module_names


def is_hidden(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__") and name not in DOCUMENTED


def is_private(dotted: str) -> bool:
    return dotted.startswith(UNDOCUMENTED) or any(map(is_hidden, dotted.split(".")))


def is_self(node: ast.expr) -> bool:
    """Whether a node is `self`, or `super()`."""
    return name_of(node.func if isinstance(node, ast.Call) else node) in ("self", "super")


def name_of(node: ast.expr) -> str:
    """`c` for `c` and for `a.b.c`."""
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def loaded(dotted: str) -> object:
    """What has that name. `None` if it exists on Windows only: `Svc…` methods are public."""
    module, _, name = dotted.rpartition(".")
    if module in WINDOWS_ONLY:
        return None
    return getattr(importlib.import_module(module), name)


@functools.cache
def private_members(owner: type) -> frozenset[str]:
    """The private attributes of a class, those of its objects included, but for what it has of the
    standard library.
    """
    public = {
        name for each in owner.__mro__ if not is_foreign(each.__module__) for name in dir(each)
    }
    return frozenset(
        name
        for name in members(owner) - public
        if is_hidden(name) or (is_private(owner.__module__) and not name.endswith("__"))
    )


@functools.cache
def members(owner: object) -> frozenset[str]:
    """The attributes of a module, or of a class and its objects."""
    found = set(dir(owner))
    for each in owner.__mro__ if isinstance(owner, type) else ():
        if is_foreign(each.__module__):
            tree = ast.parse(inspect.cleandoc("\n" + inspect.getsource(each)))
            found |= {
                node.attr
                for node in ast.walk(tree)
                if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
            }
            found |= set(each.__annotations__)
    return frozenset(found)


@functools.cache
def own_names() -> frozenset[str]:
    """All names that the product defines itself."""
    found: set[str] = set()
    for path in PRODUCT.rglob("*.py*"):
        if path.suffix in (".py", ".pyi"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                    found.add(node.name)
                elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
                    if is_self(node.value):
                        found.add(node.attr)
                elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                    found.add(node.id)
                elif isinstance(node, ast.alias):
                    found.add(node.name.rpartition(".")[2])
    return frozenset(found)


def test_every_private_name_in_use_is_in_the_table() -> None:
    assert sorted(in_product() - set(in_table())) == []


def test_every_private_name_in_the_table_is_in_use() -> None:
    assert sorted(set(in_table()) - in_product()) == []


@pytest.mark.parametrize("use", in_table(), ids=lambda use: f"{use.owner}.{use.name}")
def test_every_private_name_in_the_table_exists(use: Use) -> None:
    try:
        owner: object = importlib.import_module(use.owner)
    except ModuleNotFoundError:
        owner = loaded(use.owner)
    assert use.name in members(owner)


def test_the_versions_of_packages_with_private_names_are_capped() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    of_extras = project["optional-dependencies"].values()
    requirements = [*project["dependencies"], *(each for extra in of_extras for each in extra)]
    required = {each.name: each for each in map(Requirement, requirements)}
    distributions = {"nats": "nats-py", "paho": "paho-mqtt", "ruamel": "ruamel.yaml"}
    tops = {use.owner.partition(".")[0] for use in in_table()}
    for top in tops - sys.stdlib_module_names:
        name = distributions.get(top, top)
        installed = Version(importlib.metadata.version(name))
        following = f"{installed.major}.{installed.minor + 1}.0"
        assert required[name].specifier.contains(str(installed))
        assert not required[name].specifier.contains(following), f"{name} is not capped"


@pytest.mark.parametrize(
    ("text", "owner", "name"),
    [
        ("from click._compat import WIN", "click._compat", "WIN"),
        ("from click import _compat", "click", "_compat"),
        ("import click._compat", "click", "_compat"),
        ("from nats.aio.transport import TcpTransport", "nats.aio.transport", "TcpTransport"),
        ("print(thing.part._secret)", "?", "_secret"),
        ("thing._secret = 1", "?", "_secret"),
        (
            "from paho.mqtt.client import Client\nclass Own(Client):\n def _sock_close(self): ...",
            "paho.mqtt.client.Client",
            "_sock_close",
        ),
        (
            "from paho.mqtt.client import Client\n"
            "class Own(Client):\n"
            " def end(self): self._sock_close()",
            "paho.mqtt.client.Client",
            "_sock_close",
        ),
        (
            "from paho.mqtt.client import Client\n"
            "class Own(Client): ...\n"
            "class More(Own):\n"
            " def __init__(self): self._thread = None",
            "paho.mqtt.client.Client",
            "_thread",
        ),
    ],
)
def test_a_private_name_is_found(text: str, owner: str, name: str) -> None:
    assert Use("some.py", owner, name) in set(uses("some.py", ast.parse(text), frozenset()))

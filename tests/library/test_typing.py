"""The types of results, which mypy checks with the tests; and the docstrings of public names."""

from __future__ import annotations

import ast
import inspect
from typing import TYPE_CHECKING, Any, SupportsIndex, assert_type, get_args

import pytest

import holdfast
from holdfast import _core, polling, raw_ingest, server, values
from holdfast.types import BoolType, FloatType, FourByteOrder, IntegerType
from holdfast.values import register_count
from holdfast.values.orders import FOUR
from holdfast.values.types import FIXED
from support.paths import ROOT
from support.wire import DEADLINE

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.types import Integers


def of_the_blocking_client(plc: holdfast.SyncClient, kind: str) -> None:
    assert_type(plc.read("holding_registers", 0, "float32", "CDAB"), float)
    assert_type(plc.read("holding_registers", 0, "uint64", order="GHEFCDAB"), int)
    assert_type(plc.read("coils", 0, "bool"), bool)
    assert_type(plc.read("holding_registers", 0, "bit:3", unit=7), bool)
    assert_type(plc.read("holding_registers", 0, "string:20", encoding="utf-8"), Any)
    assert_type(plc.read("holding_registers", 0, kind), Any)
    assert_type(plc.read_coils(0, 8), list[bool])


def of_values_as_numpy_has_them(
    plc: holdfast.SyncClient, one: SupportsIndex, many: Integers
) -> None:
    plc.write_register(0, one)
    plc.write_registers(0, many)
    plc.write_registers(0, [one])
    plc.write_coil(0, 1)
    plc.write_coils(0, many)
    plc.write_file_records([(4, 0, many)])
    assert_type(plc.read_write(0, 1, 0, many), list[int])
    assert_type(values.decode(many, "float32"), float)


def of_memories(memory: holdfast.Memory, one: SupportsIndex, many: Integers) -> None:
    memory.write("holding_registers", 0, many)
    memory.write_many([("coils", 0, [one])])


async def of_the_asynchronous_client(plc: holdfast.Client) -> None:
    assert_type(await plc.read("holding_registers", 0, "float64"), float)
    assert_type(await plc.read("holding_registers", 0, "bcd16"), int)
    assert_type(await plc.read("input_registers", 0, "bit:15"), bool)
    assert_type(await plc.read("holding_registers", 0, "uint16[4]"), Any)


def test_decoded_values_have_the_type_that_is_promised() -> None:
    number = values.decode([0x4148, 0], "float32")
    count = values.decode([7], "uint16")
    bit = values.decode([8], "bit:3")
    assert_type(number, float)
    assert_type(count, int)
    assert_type(bit, bool)
    found: list[object] = [number, count, bit]
    assert [type(value) for value in found] == [float, int, bool]


class Index:
    """An integer that has nothing but the method of `SupportsIndex`."""

    def __init__(self, number: int) -> None:
        self._number = number

    def __index__(self) -> int:
        return self._number


def test_an_integer_needs_no_more_than_its_stub_promises(
    memory: holdfast.Memory, server: holdfast.Server
) -> None:
    memory.write("holding_registers", 0, [Index(7), 8])
    memory.write_many([("coils", 0, [Index(1)])])
    with holdfast.SyncClient(f"tcp://127.0.0.1:{server.address[1]}", timeout=DEADLINE) as plc:
        plc.write_register(2, Index(9))
        plc.write_registers(3, [Index(65535)])
        plc.write_coil(1, Index(1))
        plc.write_coils(2, (Index(0), Index(1)))
    assert memory.read("holding_registers", 0, 4) == [7, 8, 9, 65535]
    assert memory.read("coils", 0, 4) == [1, 1, 0, 1]
    for wrong in (65536, -1, 2**63, 2**200):
        with pytest.raises((ValueError, TypeError), match="allowed: integers 0 to 65535"):
            memory.write("holding_registers", 0, [Index(wrong)])


def test_the_named_types_and_orders_are_all_there_are() -> None:
    numbers = {*get_args(IntegerType), *get_args(FloatType)}
    bits = {name for name in get_args(BoolType) if name.startswith("bit:")}
    assert numbers | {"bool"} == set(FIXED)
    assert bits == {f"bit:{number}" for number in range(16)}
    assert all(register_count(name) == 1 for name in bits)
    assert set(get_args(FourByteOrder)) == set(FOUR)


# Docstrings.


def public() -> Iterator[tuple[str, Any]]:
    """Every public name of the library, and every public member of its classes."""
    for module in (holdfast, polling, raw_ingest, server, values):
        yield module.__name__, module
        for name in module.__all__:
            found = getattr(module, name)
            if isinstance(found, str) or inspect.ismodule(found):
                continue
            path = f"{module.__name__}.{name}"
            if inspect.isclass(found) or callable(found):
                yield path, found
            if inspect.isclass(found):
                for member, value in vars(found).items():
                    is_member = inspect.isroutine(value) or inspect.isdatadescriptor(value)
                    is_field = inspect.ismemberdescriptor(value)  # Its class describes it.
                    if is_member and not is_field and not member.startswith("_"):
                        yield f"{path}.{member}", value


PUBLIC = dict(public())


@pytest.mark.parametrize("path", sorted(PUBLIC))
def test_every_public_name_has_a_docstring(path: str) -> None:
    assert (getattr(PUBLIC[path], "__doc__", None) or "").strip(), path


def stub() -> dict[str, ast.ClassDef]:
    tree = ast.parse((ROOT / "python/holdfast/_core.pyi").read_text())
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


@pytest.mark.parametrize("name", ["Memory", "OutOfRange", "Rule", "ServerTls"])
def test_help_shows_what_editors_show(name: str) -> None:
    native, described = getattr(_core, name), stub()[name]
    assert inspect.cleandoc(native.__doc__) == ast.get_docstring(described)
    for node in described.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            assert inspect.cleandoc(getattr(native, node.name).__doc__) == ast.get_docstring(node)

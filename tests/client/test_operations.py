"""The operations of both clients: one text, and the same for `help` and for type checkers."""

from __future__ import annotations

import inspect
import typing

import pytest

import holdfast
import sync_operations
from holdfast.client.async_operations import AsyncOperations

OPERATIONS = [name for name, _ in inspect.getmembers(AsyncOperations, inspect.iscoroutinefunction)]


def test_the_blocking_operations_are_the_text_of_those_for_asyncio() -> None:
    committed = sync_operations.TARGET.read_text(encoding="utf-8")
    assert committed == sync_operations.blocking_operations(), "run `make format`"


@pytest.mark.parametrize("name", [name for name in OPERATIONS if not name.startswith("_")])
def test_both_clients_show_the_same_signature_overloads_and_docstring(name: str) -> None:
    blocking, awaited = getattr(holdfast.SyncClient, name), getattr(holdfast.Client, name)
    assert blocking.__doc__
    assert blocking.__doc__ == awaited.__doc__
    assert inspect.signature(blocking) == inspect.signature(awaited)
    assert _overloads(blocking) == _overloads(awaited)
    assert not inspect.iscoroutinefunction(blocking)


def test_reading_a_typed_value_has_an_overload_for_each_kind_of_value() -> None:
    kinds = [each.return_annotation for each in _overloads(holdfast.SyncClient.read)]
    assert kinds == ["bool", "int", "float", "Any"]


def _overloads(method: typing.Any) -> list[inspect.Signature]:
    return [inspect.signature(each) for each in typing.get_overloads(method)]

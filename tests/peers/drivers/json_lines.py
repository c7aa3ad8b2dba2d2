"""The protocol of drivers in Python: operations as JSON lines in, a result for each out."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    Execute = Callable[[dict[str, Any]], Any]


class Answered(Exception):
    """The server answered with an exception code."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(code)


def answer_all(execute: Execute) -> None:
    """Executes each operation of standard input, and prints its result."""
    for line in sys.stdin:
        print(json.dumps(result(execute, json.loads(line))), flush=True)


def result(execute: Execute, operation: dict[str, Any]) -> dict[str, Any]:
    try:
        return {"value": execute(operation)}
    except Answered as answer:
        return {"exception": answer.code}
    except Exception as error:
        return {"error": f"{type(error).__name__}: {error}"}


def discrete_inputs() -> list[bool]:
    """What every server has: each third discrete input is on."""
    return [at % 3 == 0 for at in range(1000)]


def input_registers() -> list[int]:
    """What every server has: input register N holds N."""
    return list(range(1000))

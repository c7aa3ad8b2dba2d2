"""Changes one expression of a Python package after the other; its tests must find each change.

`make proof` runs it: `tools/mutants.py SECONDS [SEED]`. The seed decides the order. A change that
makes no difference is in `mutants.toml`, with the reason. It changes files of this checkout and
restores them.
"""

from __future__ import annotations

import ast
import random
import sys
import time
import tomllib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from planted import ROOT, mutated, run_tests

if TYPE_CHECKING:
    from collections.abc import Iterator

PACKAGES = {
    "python/holdfast/values": ("tests/values",),
    "python/holdfast/tags": ("tests/tags", "tests/values"),
}
"""Which tests must find the changes."""

EQUIVALENT = Path(__file__).with_name("mutants.toml")

SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.FloorDiv,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
"""What an operator becomes."""

SKIPPED_FIELDS = {"annotation", "returns", "decorator_list"}


@dataclass(frozen=True)
class Mutant:
    """One change."""

    file: Path
    line: int
    text: str
    """The file with the change."""

    old: str
    new: str

    def __str__(self) -> str:
        return f"{self.file.relative_to(ROOT)}:{self.line}: {self.old}  ->  {self.new}"


def changed(node: ast.AST) -> str | None:
    """The expression with one change, as text; `None` if there is none for it."""
    match node:
        case ast.Compare(ops=[op]) if type(op) in SWAPPED:
            new: ast.expr = ast.Compare(node.left, [SWAPPED[type(op)]()], node.comparators)  # type: ignore[list-item]
        case ast.BoolOp() | ast.BinOp() if type(node.op) in SWAPPED:
            new = type(node)(**{**dict(ast.iter_fields(node)), "op": SWAPPED[type(node.op)]()})
        case ast.UnaryOp(op=ast.Not()):
            new = node.operand
        case ast.Constant(value=bool() as flag):
            new = ast.Constant(not flag)
        case ast.Constant(value=int() as number):
            new = ast.Constant(number + 1)
        case _:
            return None
    return f"({ast.unparse(new)})"


def expressions(node: ast.AST) -> Iterator[ast.expr]:
    """All expressions that run, but those inside of f-strings."""
    for name, value in ast.iter_fields(node):
        if name in SKIPPED_FIELDS or isinstance(node, ast.JoinedStr):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.expr):
                yield child
            if isinstance(child, ast.AST):
                yield from expressions(child)


def mutants(file: Path) -> Iterator[Mutant]:
    """All changes of a file."""
    source = file.read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node in expressions(ast.parse(source)):
        new = changed(node)
        if new is None or node.end_lineno is None or node.end_col_offset is None:
            continue
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        text = source[:start] + new.encode() + source[end:]
        yield Mutant(file, node.lineno, text.decode(), source[start:end].decode(), new)


def main(seconds: float, seed: int) -> int:
    """Returns 1 if a change was not found."""
    known = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8"))["equivalent"]
    same = {(each["file"], each["old"], each["new"]) for each in known}
    every = [
        (mutant, tests)
        for package, tests in PACKAGES.items()
        for file in sorted((ROOT / package).glob("*.py"))
        for mutant in mutants(file)
        if (file.relative_to(ROOT).as_posix(), mutant.old, mutant.new) not in same
    ]
    random.Random(seed).shuffle(every)
    until = time.monotonic() + seconds
    verdicts = Counter[str]()
    for mutant, tests in every:
        if time.monotonic() > until:
            break
        with mutated(mutant.file, mutant.text):
            found = run_tests(*tests)
        verdicts[found] += 1
        if found == "passes":
            print(f"SURVIVED {mutant}", flush=True)
    tried = verdicts.total()
    print(f"seed {seed}: {len(every)} mutants, {tried} tried, {verdicts['passes']} survived")
    return int(verdicts["passes"] > 0)


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1]), int(sys.argv[2]) if sys.argv[2:] else 1))

"""Changes the Python packages in one place after the other; their tests must find each change.

`make proof` runs it: `tools/mutants.py SECONDS [SEED]`. The seed decides the order. A change that
makes no difference is in `mutants.toml`, with the reason.

No file is changed: a package is imported with all its changes, each behind a switch. The tests run
once, which tells what they reach, and how long they take. For each change, a copy of this process
turns it on and runs the tests that reach it, the cheap ones first. What runs on import is imported
again in another copy.

mutmut and cosmic-ray don't replace it: mutmut 3 refuses sources in `python/` and leaves out tables
and decorated functions, cosmic-ray starts pytest anew for each change.
"""

from __future__ import annotations

import ast
import builtins
import copy
import gc
import multiprocessing
import os
import random
import resource
import sys
import time
import tomllib
import traceback
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib import import_module
from importlib.machinery import SourceFileLoader
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, cast

import pytest
from hypothesis import Phase, settings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import CodeType

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("values", "tags")
EQUIVALENT = Path(__file__).with_name("mutants.toml")
MOST_SURVIVING = 0.05
"""The part of the changes that may survive without a failure."""
OPTIONS = (
    "--noconftest --capture=no --timeout=0 -W ignore::pytest.PytestAssertRewriteWarning "
    "-p no:cacheprovider -p no:logging -p no:threadexception -p no:unraisableexception -p no:xdist"
)
"""What the tests don't use takes most of their time."""

MEMORY = 8 << 30
"""What the tests of one change may use, in bytes."""

SWITCH = "_is_mutant"
CACHE = type(lru_cache(int))

SWAPPED: dict[type[ast.AST], Any] = {
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
    ast.Div: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitOr,
}
"""What an operator becomes."""

SKIPPED = {"TYPE_CHECKING", "TypeAlias", "TypeVar", "cast", "AssertionError"}
"""What is for type checkers, and what can't happen."""

Result = TypeVar("Result")
Trials: TypeAlias = tuple[dict[str, float], dict[int, bool], list[int], list[str]]
"""The costs of all tests; which changes survived; those of them that must be imported anew; the
modules of others, which need not.
"""


@dataclass(frozen=True)
class Mutant:
    """One change. Its text is that of its first line, without a number, which changes often."""

    file: str
    line: str
    old: str
    new: str

    def __str__(self) -> str:
        return f"{self.file}: {self.line}  |  {self.old}  ->  {self.new}"


def alternatives(node: Any, is_condition: bool) -> Iterator[Any]:
    """What an expression or a statement is changed to."""
    if is_condition:
        yield from (ast.Constant(True), ast.Constant(False))
    match node:
        case ast.Compare(left, ops, right):
            for at, op in enumerate(ops):
                yield ast.Compare(left, [*ops[:at], SWAPPED[type(op)](), *ops[at + 1 :]], right)
        case ast.BoolOp(op, values):
            yield ast.BoolOp(SWAPPED[type(op)](), values)
            for at in range(len(values)):
                rest = values[:at] + values[at + 1 :]
                yield ast.BoolOp(op, rest) if len(rest) > 1 else rest[0]
        case ast.BinOp(left, op, right) if type(op) in SWAPPED:
            yield ast.BinOp(left, SWAPPED[type(op)](), right)
        case ast.UnaryOp(ast.Not() | ast.USub()):
            yield node.operand
        case ast.Constant(bool() as flag):
            yield ast.Constant(not flag)
        case ast.Constant(int() as number):
            yield from (ast.Constant(number + 1), ast.Constant(number - 1))
        case ast.Constant(float() as number):
            yield ast.Constant(number / 2)
        case ast.Constant(str() | bytes() as text):
            empty = text[:0]
            yield ast.Constant(empty if text else empty.ljust(1))
        case ast.Call(keywords=[*keywords]):
            for at, keyword in enumerate(keywords):
                if keyword.arg not in (None, "strict"):
                    yield ast.Call(node.func, node.args, keywords[:at] + keywords[at + 1 :])
        case ast.Return(ast.expr() as value) if ast.unparse(value) not in ("None", "False"):
            yield ast.Return(ast.Constant(None))
        case ast.Raise() | ast.AugAssign() | ast.Continue() | ast.Break() | ast.Expr(ast.Call()):
            yield ast.Pass()


def is_skipped(node: Any) -> bool:
    """Whether a node is for type checkers, is a text for readers, or can't happen."""
    match node:
        case ast.Assert() | ast.Expr(ast.Constant()):
            return True
        case ast.If(ast.Name(name)) | ast.AnnAssign(annotation=ast.Name(name)):
            return name in SKIPPED
        case ast.Call(ast.Name(name)) | ast.Raise(ast.Call(ast.Name(name))):
            return name in SKIPPED
        case ast.Assign([ast.Name(name)]):
            return name.startswith("__")
        case ast.keyword("strict"):
            return True
        case ast.FunctionDef(decorator_list=[ast.Name("overload")]):
            return True
    return False


class Planter(ast.NodeTransformer):
    """Puts all changes of a file into its tree, behind switches."""

    def __init__(self, file: Path, mutants: list[Mutant]) -> None:
        self._file = file.relative_to(ROOT).as_posix()
        self._lines = file.read_text(encoding="utf-8").splitlines()
        self._mutants = mutants
        self._conditions: set[Any] = set()
        self._skipped: set[Any] = set()

    def visit(self, node: Any) -> Any:
        """The node with its changes, and those inside of it."""
        match node:
            case ast.If(test) | ast.IfExp(test) | ast.While(test):
                self._conditions.add(test)
            case ast.comprehension(ifs=tests):
                self._conditions.update(tests)
            case ast.JoinedStr(parts):
                self._skipped.update(each for each in parts if isinstance(each, ast.Constant))
            case ast.arg(annotation=note) | ast.AnnAssign(annotation=note):
                self._skipped.add(note)
            case ast.FunctionDef(decorator_list=notes, returns=note):
                self._skipped.update([*notes, note])
            case ast.ClassDef(decorator_list=notes):
                self._skipped.update(notes)
        if node in self._skipped or is_skipped(node):
            return node
        before = copy.deepcopy(node)
        changed: Any = self.generic_visit(node)
        old = ast.unparse(before)
        for other in alternatives(before, node in self._conditions):
            new = ast.unparse(other)
            if new != old:
                number = ast.Constant(len(self._mutants))
                line = self._lines[node.lineno - 1].strip()
                self._mutants.append(Mutant(self._file, line, old, new))
                switch = ast.Call(ast.Name(SWITCH, ast.Load()), [number], [])
                if isinstance(node, ast.stmt):
                    changed = ast.If(switch, [other], [changed])
                else:
                    changed = ast.IfExp(switch, other, changed)
                ast.copy_location(changed, node)
        return ast.fix_missing_locations(changed)


def plant(package: str, mutants: list[Mutant]) -> None:
    """From now on, this process imports a package with all its changes, which are appended."""
    changed: dict[str, CodeType] = {}
    for file in sorted((ROOT / "python" / "holdfast" / package).glob("*.py")):
        tree = Planter(file, mutants).visit(ast.parse(file.read_text("utf-8")))
        changed[str(file)] = compile(tree, file, "exec")
    usual = SourceFileLoader.get_code

    def get_code(self: SourceFileLoader, name: str) -> CodeType | None:
        return changed.get(self.path) or usual(self, name)

    SourceFileLoader.get_code = get_code  # type: ignore[method-assign, assignment]


def forked(work: Callable[[], Result]) -> Result | None:
    """What a copy of this process returns; `None` if it dies."""
    ours, theirs = multiprocessing.Pipe(duplex=False)
    child = os.fork()
    if not child:
        try:
            theirs.send(work())
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(0)
    theirs.close()
    try:
        return cast("Result", ours.recv())
    except EOFError:
        return None
    finally:
        os.waitpid(child, 0)


def caches() -> list[Any]:
    """All caches of the program. What is cached reaches nothing."""
    modules = [module for name, module in sys.modules.items() if name.startswith("holdfast.")]
    found = [value for module in modules for value in vars(module).values()]
    return [value for value in found if type(value) is CACHE]


class Tests:
    """A plugin of pytest: runs tests of a package as `work` says."""

    def __init__(self, package: str, work: Callable[[Tests], object]) -> None:
        self._work = work
        self._now = ""
        self.items: list[pytest.Item] = []
        self.have_passed = False
        self.costs: dict[str, float] = {}
        """The processor time of each test, in seconds."""
        self.reached: defaultdict[int, set[str]] = defaultdict(set)
        """The tests that reach a change; the empty name is that of the imports."""
        if not hasattr(builtins, SWITCH):
            setattr(builtins, SWITCH, self._reach)
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        pytest.main([*OPTIONS.split(), f"tests/{package}"], [self])

    def _reach(self, number: int) -> bool:
        self.reached[number].add(self._now)
        return False

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """All tests are collected."""
        if not session.testsfailed:
            self.items = session.items
            self._work(self)
        return True

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A part of a test has ended."""
        self.have_passed &= not report.failed

    def run(self, costs: dict[str, float]) -> bool:
        """Runs the tests that have costs until one fails: first all functions with a cheap case."""
        chosen = [item for item in self.items if item.nodeid in costs]
        spent: defaultdict[str, float] = defaultdict(float)
        ranks: dict[str, float] = {}
        for item in sorted(chosen, key=lambda each: costs[each.nodeid]):
            function = item.nodeid.partition("[")[0]
            spent[function] += costs[item.nodeid]
            ranks[item.nodeid] = spent[function]
        self.have_passed = True
        cached = caches()
        for item in sorted(chosen, key=lambda each: ranks[each.nodeid]):
            for cache in cached:
                cache.cache_clear()
            self._now, started = item.nodeid, time.process_time()
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=None)
            self.costs[item.nodeid] = time.process_time() - started
            if not self.have_passed:
                break
        return self.have_passed


def survives(number: int, costs: dict[str, float], work: Callable[[], bool]) -> bool:
    """Whether tests pass with a change, in about the time that they need without."""

    def changed() -> bool:
        setattr(builtins, SWITCH, number.__eq__)
        seconds = 5 + int(2 * sum(costs.values()))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        return work()

    return bool(forked(changed))


def trials(package: str, numbers: list[int], until: float) -> Trials:
    """Tries changes with the tests that reach them."""
    survived: dict[int, bool] = {}
    anew: list[int] = []

    def work(tests: Tests) -> None:
        if not tests.run(dict.fromkeys((item.nodeid for item in tests.items), 0)):
            return
        gc.freeze()
        for number in numbers:
            if time.monotonic() > until:
                break
            near = {each: tests.costs[each] for each in tests.reached[number] if each}
            survived[number] = survives(number, near, partial(tests.run, near))
            if survived[number] and "" in tests.reached[number]:
                anew.append(number)

    tests = Tests(package, work)
    assert tests.have_passed
    ours = tuple(str(ROOT / folder) for folder in ("python", "tests", "tools"))
    files = {name: str(getattr(module, "__file__", "")) for name, module in sys.modules.items()}
    others = [name for name in files if not files[name].startswith(ours)]
    return tests.costs, survived, anew, others


def passes(package: str, costs: dict[str, float]) -> bool:
    """Whether all tests pass when everything is imported anew."""
    return Tests(package, lambda tests: tests.run(costs)).have_passed


def verdicts(package: str, numbers: list[int], until: float) -> dict[int, bool]:
    """Which changes survive, of those for which there is time."""
    found = forked(partial(trials, package, numbers, until))
    if found is None:
        raise SystemExit(f"ERROR: the tests of {package} fail without a change")
    costs, survived, anew, modules = found
    for name in modules:
        with suppress(ImportError):
            import_module(name)
    for number in anew:
        if time.monotonic() > until:
            del survived[number]
        else:
            survived[number] = survives(number, costs, partial(passes, package, costs))
    return survived


def main(seconds: float, seed: int) -> int:
    """Returns 1 if more changes survived than are allowed."""
    # The usual cases; one that fails is not made shorter.
    settings.register_profile(
        "mutants",
        settings.get_profile("ci"),
        phases=[Phase.generate],
        report_multiple_bugs=False,
    )
    settings.load_profile("mutants")
    sys.dont_write_bytecode = False
    listed = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8"))["equivalent"]
    known = {Mutant(*(each[part] for part in ("file", "line", "old", "new"))) for each in listed}
    mutants: list[Mutant] = []
    start, tried, survivors, same = time.monotonic(), 0, 0, 0
    for at, package in enumerate(PACKAGES, 1):
        first = len(mutants)
        plant(package, mutants)
        numbers = [number for number in range(first, len(mutants)) if mutants[number] not in known]
        same += len(mutants) - first - len(numbers)
        random.Random(seed).shuffle(numbers)
        found = verdicts(package, numbers, start + seconds * at / len(PACKAGES))
        alive = [number for number in sorted(found) if found[number]]
        for number in alive:
            print(f"SURVIVED {mutants[number]}", flush=True)
        tried, survivors = tried + len(found), survivors + len(alive)
    gone = known.difference(mutants)
    for mutant in gone:
        print(f"ERROR in {EQUIVALENT.name}, nothing is {mutant}")
    counted = f"{len(mutants)} mutants, {same} make no difference"
    print(f"seed {seed}: {counted}, {tried} tried, {survivors} survived")
    return int(survivors > MOST_SURVIVING * tried or bool(gone))


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1]), int(sys.argv[2]) if sys.argv[2:] else 1))

"""Puts faults into the program, one after the other, and tells which their tests find.

`make proof` runs it with all faults of `mutations.toml`, in an order that is another one each time.
Words on the command line choose those whose row has all of them. It changes files of this checkout
and restores them.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import tomllib
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).resolve().parents[1]
LIST = ROOT / "tests" / "conformance" / "mutations.toml"
CORE = ROOT / "python" / "holdfast" / "_core.abi3.so"
BUILT = ROOT / "target" / "debug" / "lib_core.so"
TIMEOUT_S = 3600
"""For each command of a fault."""

FAILED = 1
"""What pytest returns if a test fails."""


def done(*line: str) -> int:
    """Runs a command; its exit code, that of a failure if it takes too long."""
    started = subprocess.Popen(
        line,
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        return started.wait(TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return FAILED
    finally:
        if started.poll() is None:
            os.killpg(started.pid, signal.SIGKILL)
            started.wait()


def outcome(test: str, *, rust: bool) -> str:
    """Whether a test passes with the files as they are."""
    if ".py::" not in test:
        cargo = ("cargo", "test", "--locked", "--quiet", "-p", *test.split())
        if done(*cargo, "--no-run"):
            return "does not compile"
        return "fails" if done(*cargo) else "passes"
    if rust:
        if done("cargo", "build", "--locked", "--quiet", "-p", "holdfast-binding"):
            return "does not compile"
        # A process that has the old file open keeps it.
        CORE.unlink()
        shutil.copy(BUILT, CORE)
    return run_tests(test)


def run_tests(*tests: str) -> str:
    """Whether Python tests pass with the files as they are."""
    code = done(sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests)
    return {0: "passes", FAILED: "fails"}.get(code, "is not there")


@contextmanager
def mutated(file: Path, text: str) -> Iterator[None]:
    """Gives a file another text. An end from outside restores it too."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(FAILED))
    before = file.read_bytes()
    try:
        file.write_text(text, encoding="utf-8")
        yield
    finally:
        file.write_bytes(before)


def verdict(fault: dict[str, str]) -> str:
    """What the test of a fault finds."""
    file = ROOT / fault["file"]
    text = file.read_text(encoding="utf-8")
    if text.count(fault["old"]) != 1:
        return "the place is gone"
    with mutated(file, text.replace(fault["old"], fault["new"])):
        found = outcome(fault["test"], rust=file.suffix == ".rs")
    return {"fails": "killed", "passes": "SURVIVED"}.get(found, found)


def main(words: list[str]) -> int:
    """Returns 1 if a fault was not found, or could not be put in."""
    every = tomllib.loads(LIST.read_text())["mutation"]
    chosen = [each for each in every if all(word in each["row"] for word in words)]
    random.shuffle(chosen)
    verdicts = Counter[str]()
    saved = CORE.read_bytes()
    try:
        for each in chosen:
            found = verdict(each)
            verdicts[found] += 1
            print(f"{found:16} {each['row']}  ({each['test'].split('::')[-1].split()[-1]})")
            sys.stdout.flush()
    finally:
        CORE.unlink()
        CORE.write_bytes(saved)
        found = ", ".join(f"{count} {each}" for each, count in verdicts.items())
        print(f"of {len(chosen)} faults: {found}", flush=True)
    return int(verdicts.total() != verdicts["killed"])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

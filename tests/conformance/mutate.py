"""Puts faults into the program, one after the other, and tells which their tests find.

`make proof` runs it with all faults of `mutations.toml`. Words on the command line choose those
whose row has all of them. It changes files of this checkout and restores them.
"""

from __future__ import annotations

import os
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

ROOT = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_name("mutations.toml")
CORE = ROOT / "python" / "holdfast" / "_core.abi3.so"
BUILT = ROOT / "target" / "debug" / "lib_core.so"
TIMEOUT_S = 600
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
    code = done(sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", test)
    return {0: "passes", FAILED: "fails"}.get(code, "is not there")


@contextmanager
def mutated(file: Path, old: str, new: str) -> Iterator[bool]:
    """Puts a fault in; yields whether its place was found."""
    text = file.read_text()
    try:
        if text.count(old) == 1:
            file.write_text(text.replace(old, new))
        yield text.count(old) == 1
    finally:
        file.write_text(text)


def main(words: list[str]) -> int:
    """Returns 1 if a fault was not found, or could not be put in."""
    every = tomllib.loads(LIST.read_text())["mutation"]
    chosen = [each for each in every if all(word in each["row"] for word in words)]
    verdicts = Counter[str]()
    # An end from outside restores the files too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(FAILED))
    saved = CORE.read_bytes()
    try:
        for each in chosen:
            is_rust = each["file"].endswith(".rs")
            with mutated(ROOT / each["file"], each["old"], each["new"]) as is_in:
                found = outcome(each["test"], rust=is_rust) if is_in else "the place is gone"
            verdict = {"fails": "killed", "passes": "SURVIVED"}.get(found, found)
            verdicts[verdict] += 1
            print(f"{verdict:16} {each['row']}  ({each['test'].split('::')[-1].split()[-1]})")
            sys.stdout.flush()
    finally:
        CORE.unlink()
        CORE.write_bytes(saved)
    print(", ".join(f"{count} {verdict}" for verdict, count in verdicts.items()))
    return int(verdicts.total() != verdicts["killed"])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

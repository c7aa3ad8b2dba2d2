"""Looks for faults in the program and in its tests for some hours, and writes one report.

`make proof HOURS=4` runs it. Each part gets its share of the time that is left. Its output is in
`.cache/proof`, the report is `.cache/proof/report.md`. It changes files of the checkout meanwhile.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / ".cache" / "proof"
GRACE_S = 60
"""How long a part may take to end."""

BUILD_S = 1200
"""How long a part that ends by itself may build before, on a busy machine."""

PYTEST = (sys.executable, "-m", "pytest", "-q")
MUTANTS = ".cache/tools/bin/cargo-mutants"
BAD = "SURVIVED|MISSED|FAILED|ERROR"
"""How a line begins that tells of a fault, in a part that is ended when its time is over."""

SHOWN = 40
"""The most lines of a part in the report."""


@dataclass(frozen=True)
class Part:
    """A command, and what the report has of its output."""

    name: str
    share: float
    line: tuple[str, ...]
    """`{seconds}` is the time that it has."""

    shown: str
    """A pattern: the lines that the report has."""

    env: dict[str, str] = field(default_factory=dict)
    ends: bool = True
    """Whether it ends by itself in its time. Otherwise it is ended, which is no failure."""


def parts() -> list[Part]:
    """In the order in which they run."""
    targets = sorted(each.name for each in (ROOT / "fuzz" / "corpus").iterdir())
    python = (sys.executable,)
    torture = {"HOLDFAST_TORTURE": "1", "HOLDFAST_TORTURE_SECONDS": "{seconds}"}
    failed = r"^FAILED|^ERROR|\b(passed|failed)\b|^test result: FAILED|panicked at|SEED=|inputs in"
    return [
        Part("planted faults", 4, (*python, "tools/planted.py"), r"^(?!killed)", ends=False),
        *(
            Part(
                f"fuzz {target}",
                4 / len(targets),
                ("make", "fuzz", f"TARGET={target}", "SECONDS={seconds}"),
                r"^Done|^#\d+\s+DONE|panicked at|ERROR|Test unit written",
            )
            for target in targets
        ),
        Part("new cases", 2, ("make", "explore", "SECONDS=30"), failed, ends=False),
        Part("hostile devices", 1, (*PYTEST, "tests/hostile"), failed, torture),
        Part(
            "model of the memory",
            1,
            (*PYTEST, "tests/oracle/test_running_appliance.py"),
            failed,
            torture,
        ),
        Part(
            "mutants of Rust",
            3,
            (MUTANTS, "mutants", "--shuffle", "--output", str(OUT)),
            r"^(MISSED|TIMEOUT)|mutants? tested|^Found",
            ends=False,
        ),
        Part(
            "mutants of Python",
            1,
            (*python, "tools/mutants.py", "{seconds}", str(int(time.time()))),
            r"SURVIVED|ERROR|tried",
        ),
    ]


def run(part: Part, seconds: int) -> tuple[str, list[str]]:
    """Runs a part; whether it failed, and its lines for the report."""
    log = OUT / f"{part.name.replace(' ', '-')}.log"
    line = [each.format(seconds=seconds) for each in part.line]
    env = {name: value.format(seconds=seconds) for name, value in part.env.items()}
    with log.open("w") as out:
        started = subprocess.Popen(
            line,
            cwd=ROOT,
            env={**os.environ, **env},
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        code: int | None = None
        try:
            code = started.wait(seconds + (BUILD_S if part.ends else 0))
        except subprocess.TimeoutExpired:
            os.killpg(started.pid, signal.SIGTERM)
            try:
                started.wait(GRACE_S)
            except subprocess.TimeoutExpired:
                os.killpg(started.pid, signal.SIGKILL)
                started.wait()
    text = log.read_text(errors="replace")
    lines = [each.strip() for each in text.splitlines() if re.search(part.shown, each.strip())]
    if code is None and part.ends:
        return "FAILED: not finished in time", lines
    if code is None:
        is_bad = any(re.match(BAD, each) for each in lines)
        return f"{'FAILED' if is_bad else 'passed'} until its time was over", lines
    return ("passed" if code == 0 else f"FAILED: exit code {code}"), lines


def commit() -> str:
    """What is tested."""

    def git(*line: str) -> str:
        return subprocess.run(
            ("git", *line), cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.strip()

    changed = " with changes" if git("status", "--porcelain") else ""
    return git("rev-parse", "HEAD") + changed


def main(hours: float) -> int:
    """Returns 1 if a part failed."""
    OUT.mkdir(parents=True, exist_ok=True)
    report = [
        f"# Proof of {commit()}",
        "",
        f"Begun {time.strftime('%Y-%m-%d %H:%M %Z')}, {hours:g} hours.",
        "",
    ]
    left = parts()
    until = time.monotonic() + hours * 3600
    has_failed = False
    while left:
        part = left[0]
        rest = max(until - time.monotonic(), 0)
        seconds = max(int(rest * part.share / sum(each.share for each in left)), 1)
        started = time.monotonic()
        outcome, lines = run(part, seconds)
        has_failed |= outcome.startswith("FAILED")
        took = round(time.monotonic() - started)
        report += [f"## {part.name}: {outcome}", "", f"{took} of {seconds} s.", ""]
        report += [f"    {line}" for line in lines[-SHOWN:]] + [""]
        (OUT / "report.md").write_text("\n".join(report))
        print(f"{part.name}: {outcome}, {took} s", flush=True)
        del left[0]
    print(f"report: {(OUT / 'report.md').relative_to(ROOT)}")
    return int(has_failed)


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1])))

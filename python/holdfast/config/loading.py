"""From a file to a `Config`, or to all that is wrong with it.

The shape of the data and the rules between its parts are judged side by side, each on the data as
it was written: a mistake of one kind hides none of the other.
"""

from __future__ import annotations

from pathlib import Path

from holdfast.config import source
from holdfast.config.allowed import allowed
from holdfast.config.listener_checks import ListenerChecks
from holdfast.config.memory_checks import MemoryChecks
from holdfast.config.model import Config
from holdfast.config.problems import ConfigError, Problem, Report
from holdfast.config.structure import build
from holdfast.config.tolerance import mapping
from holdfast.config.unavailable import refuse_unavailable
from holdfast.config.words import show


def load(path: Path | str) -> Config:
    """Reads a configuration; raises `ConfigError` with every problem that it has.

    What is right but has no effect is in `Config.warnings`.
    """
    file = str(path)
    document, problems = source.parse(source.read_text(Path(path), file), file)
    if not isinstance(document.data, dict):
        found = "an empty file" if document.data is None else show(document.data)
        message = f"found {found}, allowed: {allowed(())}"
        raise ConfigError(file, problems or [Problem(file, 1, 1, "", message)])
    report = Report(document)
    skip = refuse_unavailable(document.data, report)
    folder = Path(path).absolute().parent
    memories = MemoryChecks(folder, report)
    memories.check(document.data.get("memories"))
    names = [str(name) for name in mapping(document.data.get("memories"))]
    ListenerChecks(report, skip, names or None).check(document.data.get("listeners"))
    context = {"folder": folder, "initial_values": memories.values}
    config = build(document.data, context, report, skip)
    problems += [*report.problems, *memories.problems_elsewhere]
    if config is None or problems:
        raise ConfigError(file, problems)
    return config.with_warnings(report.doubts)

"""The memories of an appliance, and the files that keep them over restarts.

Files are opened before anything listens, and closed last. A reload adds memories, and never touches
the others.
"""

from __future__ import annotations

import logging
import re
from collections import defaultdict
from typing import TYPE_CHECKING, Any

from holdfast import _core
from holdfast.appliance.parts.part import Part
from holdfast.events import log_lines

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from holdfast._core import Memory
    from holdfast.appliance.parts.part import Plan
    from holdfast.config import Config
    from holdfast.config.models.memories import MemoryConfig


class Memories(Part):
    """The memories by name, and their files."""

    def __init__(self, config: Config, memories: dict[str, Memory]) -> None:
        super().__init__(config)
        self.by_name = memories
        """Services use it too, so that they find memories that a reload has added."""
        self._seals = {name: memory.seal_changes for name, memory in memories.items()}
        self._files: dict[Path, _core.MemoryFile] = {}
        self._of_logs: dict[str, Path] = {}
        self._reasons: defaultdict[Path, set[str]] = defaultdict(set)
        """Why a file can't be written, as logged since it last could. Reasons may alternate."""
        self._recreated: dict[Path, int] = {}
        self._only_copies: set[Path] = set()
        """Files that are written: what they lack is lost, unlike in those of logs."""
        self.lost_writes = 0
        """The confirmed writes that could not be stored when the files were closed."""

    def open(self, plan: Plan) -> None:
        """Loads the contents of the memories. Raises the `OSError`s of `MemoryFile`."""
        for path, names in _files_of(self.config).items():
            self._open(path, names, plan.memories)

    def prepare(self, plan: Plan) -> Callable[[], None]:
        """Creates memories that the configuration adds."""
        added = {
            name: created(plan.config, name)
            for name in plan.config.memories
            if name not in self.by_name
        }
        plan.memories |= added

        def adopt() -> None:
            self._seals |= {name: memory.seal_changes for name, memory in added.items()}
            self.by_name.update(added)

        return adopt

    def log_seals(self) -> None:
        """Logs seals that have opened or closed since the last call."""
        for name, memory in self.by_name.items():
            before, now = self._seals[name], memory.seal_changes
            if now != before:
                self._seals[name] = now
                opened, closed = (count - past for count, past in zip(now, before, strict=True))
                state = "sealed" if memory.sealed else "open"
                log_lines.write(
                    logging.INFO, "seal", memory=name, state=state, opened=opened, closed=closed
                )

    def _open(self, path: Path, names: list[str], memories: Mapping[str, _core.Memory]) -> None:
        first = self.config.memories[names[0]]
        keep, replicate = first.keep, first.replicate
        assert keep is not None, "the memory is kept"
        members = [(name, memories[name]) for name in names]
        file = _core.MemoryFile(str(path), members, keep.sync, of_log=replicate is not None)
        self._files[path] = file
        self.closing.callback(self._close, path, file)
        for warning in file.warnings:
            log_lines.write(logging.WARNING, "memory_file_differs", file=path, warning=warning)
        for name in names:
            if name not in file.loaded:
                fill(memories[name], self.config.memories[name])
        if replicate is None:
            file.start()
            self._only_copies.add(path)
        else:
            self._of_logs[replicate.log] = path
        loaded = ",".join(file.loaded) or "-"
        log_lines.write(logging.INFO, "memory_file", file=path, loaded=loaded, sync=keep.sync)

    def _close(self, path: Path, file: _core.MemoryFile) -> None:
        """Stores pending writes."""
        # A disk that hangs keeps the stop waiting, also without a write.
        status = file.status()
        pending = status["pending"]
        if pending or status["failing"] is not None:
            log_lines.write(logging.INFO, "memory_file_storing", file=path, writes=pending)
        try:
            file.stop()
        except OSError as error:
            log_lines.write(logging.ERROR, "memory_file_failing", file=path, error=error)
            lost = file.status()["pending"]
            if lost and path in self._only_copies:
                self.lost_writes += lost
                log_lines.write(logging.ERROR, "memory_file_lost", file=path, writes=lost)
        self._log_recreated(path, file)

    def of_log(self, log: str) -> Path | None:
        """The file of the memories of a log."""
        return self._of_logs.get(log)

    def note(self, log: str) -> bytes | None:
        """The state of the log in its file, for `Log.resume`."""
        path = self.of_log(log)
        return None if path is None else self._files[path].note

    def follow(self, name: str, log: _core.Log) -> None:
        """Stores from now on what the memories of a log contain.

        Raises the `OSError`s of `MemoryFile`.
        """
        path = self.of_log(name)
        if path is not None:
            self._files[path].start(log)

    def stats(self) -> Mapping[str, Any]:
        """The state and the counters of each file."""
        files = self._files.items()
        return {"memory_files": {str(path): dict(file.status()) for path, file in files}}

    def tick(self) -> None:
        """Logs why a file can't be written, once for each reason, and when it can again."""
        for path, file in self._files.items():
            self._log_recreated(path, file)
            logged, error = self._reasons[path], file.status()["failing"]
            if error is None:
                if logged:
                    logged.clear()
                    log_lines.write(logging.INFO, "memory_file_back", file=path)
                continue
            # Numbers, such as that of a page, do not make another reason.
            reason = re.sub(r"\d+", "", error)
            if reason not in logged:
                logged.add(reason)
                log_lines.write(logging.ERROR, "memory_file_failing", file=path, error=error)

    def _log_recreated(self, path: Path, file: _core.MemoryFile) -> None:
        count = file.status()["recreated"]
        if count > self._recreated.get(path, 0):
            log_lines.write(logging.WARNING, "memory_file_recreated", file=path)
        self._recreated[path] = count


def created(config: Config, name: str) -> Memory:
    """Creates a memory with its initial values; one that is kept gets its values later."""
    settings = config.memories[name]
    made = empty(config, name)
    if settings.keep is None:
        # The first node of a log begins with them; others get those of the log.
        fill(made, settings)
    return made


def empty(config: Config, name: str) -> Memory:
    """Creates the memory of that name, with all values 0."""
    settings = config.memories[name]
    seal = settings.seal
    return _core.Memory(
        **{area: (span.start, span.size) for area, span in settings.areas().items()},
        files=settings.files,
        seal=None if seal is None else (seal.area, seal.address, seal.mode),
        name=name,
    )


def fill(made: Memory, settings: MemoryConfig) -> None:
    """Writes the initial values."""
    writes = [(run.area, run.address, run.values) for run in settings.initial_values]
    if writes:
        made.write_many(writes)


def _files_of(config: Config) -> dict[Path, list[str]]:
    """The names of the memories in each file."""
    files: dict[Path, list[str]] = {}
    for name, settings in config.memories.items():
        if settings.keep is not None:
            files.setdefault(settings.keep.file, []).append(name)
    return files

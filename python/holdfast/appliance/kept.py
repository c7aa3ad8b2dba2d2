"""The files that keep memories over restarts: opened before anything listens, closed last."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from holdfast import _core, logs
from holdfast.appliance import assembly

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from holdfast.config import Config


class UnusableFile(OSError):
    """A file of memories is damaged, in use, or can't be written."""


class KeptMemories:
    """The files of one configuration. The constructor opens all of them or none."""

    def __init__(self, config: Config, memories: Mapping[str, _core.Memory]) -> None:
        """Loads the contents of the memories. Raises `UnusableFile`."""
        self._files: dict[Path, _core.MemoryFile] = {}
        self._of_logs: dict[str, Path] = {}
        self._failing: dict[Path, str | None] = {}
        try:
            for path, names in _files(config).items():
                self._open(path, names, config, memories)
        except OSError as error:
            self.stop()
            raise UnusableFile(str(error)) from None
        except BaseException:
            self.stop()
            raise

    def _open(
        self, path: Path, names: list[str], config: Config, memories: Mapping[str, _core.Memory]
    ) -> None:
        keep, replicate = config.memories[names[0]].keep, config.memories[names[0]].replicate
        assert keep is not None, "the memory is kept"
        members = [(name, memories[name]) for name in names]
        file = _core.MemoryFile(str(path), members, keep.sync, of_log=replicate is not None)
        self._files[path] = file
        for warning in file.warnings:
            logs.write(logging.WARNING, "memory_file_differs", file=path, warning=warning)
        for name in names:
            if name not in file.loaded:
                assembly.fill(memories[name], config.memories[name])
        if replicate is None:
            file.start()
        else:
            self._of_logs[replicate.log] = path
        loaded = ",".join(file.loaded) or "-"
        logs.write(logging.INFO, "memory_file", file=path, loaded=loaded, sync=keep.sync)

    def of_log(self, log: str) -> Path | None:
        """The file of the memories of a log."""
        return self._of_logs.get(log)

    def note(self, log: str) -> bytes | None:
        """What that file has noted of the log."""
        path = self.of_log(log)
        return None if path is None else self._files[path].note

    def start(self, name: str, log: _core.Log) -> None:
        """Stores from now on what the memories of a log contain. Raises `UnusableFile`."""
        path = self.of_log(name)
        if path is None:
            return
        try:
            self._files[path].start(log)
        except OSError as error:
            raise UnusableFile(str(error)) from None

    def status(self) -> dict[str, dict[str, Any]]:
        """The state and the counters of each file."""
        return {str(path): dict(file.status()) for path, file in self._files.items()}

    def check(self) -> None:
        """Logs files that can't be written any more, and those that can again."""
        for path, file in self._files.items():
            error = file.status()["failing"]
            if error is not None and self._failing.get(path) is None:
                logs.write(logging.ERROR, "memory_file_failing", file=path, error=error)
            elif error is None and self._failing.get(path) is not None:
                logs.write(logging.INFO, "memory_file_back", file=path)
            self._failing[path] = error

    def stop(self) -> None:
        """Stores what is left, and closes the files."""
        for path, file in self._files.items():
            try:
                file.stop()
            except OSError as error:
                logs.write(logging.ERROR, "memory_file_failing", file=path, error=error)


def made(config: Config, name: str) -> _core.Memory:
    """Creates a memory with its initial values; a memory that is kept gets its values later."""
    settings = config.memories[name]
    memory = assembly.memory(settings)
    if settings.keep is None:
        # Of a log, the first node has them; the others get those of the log.
        assembly.fill(memory, settings)
    return memory


def _files(config: Config) -> dict[Path, list[str]]:
    """The names of the memories in each file."""
    files: dict[Path, list[str]] = {}
    for name, settings in config.memories.items():
        if settings.keep is not None:
            files.setdefault(settings.keep.file, []).append(name)
    return files

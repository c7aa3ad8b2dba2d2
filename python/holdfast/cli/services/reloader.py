"""Rereads the configuration of a running appliance: at a signal, a request, or a changed file."""

from __future__ import annotations

import logging
import threading
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from holdfast.adapters.plugins import UnknownAdapter
from holdfast.appliance.reload import ReloadIncomplete, ReloadRefused, described
from holdfast.cli.services.changed_files import FileSnapshot
from holdfast.cli.services.open_files import allow_open_files
from holdfast.cli.shell_command import shell_command
from holdfast.config import ConfigError
from holdfast.config.fingerprint import files_of
from holdfast.config.text.problems import ConfigNotAnswered
from holdfast.events import log_lines
from holdfast.runtime.bounded_files import TIMEOUT_MS, FileWork, NotAnswered, Unreadable, answered
from holdfast.runtime.text import file_error_text

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from concurrent.futures import Future

    from holdfast.appliance import Appliance
    from holdfast.appliance.service_manager import ServiceManager
    from holdfast.config import Config

WATCH_INTERVAL_MS = 1000
"""Milliseconds between two looks at the files. A change counts when it is the same at the next."""

PROMPT_MS = 100
"""Milliseconds that the thread of the appliance waits for files: most are read by then."""


_REFUSALS = (ConfigError, click.UsageError, Unreadable, UnknownAdapter, OSError, ValueError)
"""Errors of files that can't be taken over."""


@dataclass(frozen=True)
class _Read:
    """The result of reading the files, in a thread beside the appliance."""

    config: Config | None
    error: Exception | None
    files: FileSnapshot | None
    """The files as they were before they were read, if they are watched."""
    is_steady: bool = True
    """Whether no watched file has changed meanwhile."""


def _import_for(config: Config) -> None:
    """Imports what an appliance without tags and adapters has not imported at its start."""
    if any(device.has_tags for device in config.devices.values()):
        import holdfast.appliance.parts.tag_values
        import holdfast.appliance.parts.tag_writes
    if config.adapters:
        import holdfast.ingest.memory_access  # noqa: F401


class Reloader:
    """Reloads one appliance with what `load` returns. `step` is for the thread that runs it.

    `load` reads the configuration `file`, or the files of command-line options. That, and every
    look at the files, is done in another thread: a file that does not answer holds up nothing.
    """

    def __init__(
        self,
        appliance: Appliance,
        manager: ServiceManager,
        load: Callable[[], Config],
        file: Path | None = None,
        *,
        watch_interval_ms: int = WATCH_INTERVAL_MS,
        timeout_ms: int = TIMEOUT_MS,
    ) -> None:
        self._appliance = appliance
        self._manager = manager
        self._load = load
        self._file = file
        self._watch_interval_ms = watch_interval_ms
        self._timeout_ms = timeout_ms
        self._requests: list[Future[Mapping[str, Any]]] = []
        self._lock = threading.Lock()
        self._request_is_pending = False
        self._reading: FileWork[_Read] | None = None
        self._reading_is_requested = False
        """Whether the files are read because of a request, not because they changed."""
        self._served_requests: list[Future[Mapping[str, Any]]] = []
        self._notification = ExitStack()
        self._snapshot: FileWork[FileSnapshot] | None = None
        self._snapshot_at = time.monotonic()
        self._last_snapshot: FileSnapshot | None = None
        self._logged: set[tuple[str, str | None]] = set()
        self._loaded_files: FileSnapshot | None = None
        with suppress(OSError):
            config = appliance.config
            self._loaded_files = answered(lambda: self._watched(config, hold=True), timeout_ms)

    def ask(self) -> Mapping[str, Any]:
        """Has the appliance reloaded. Waits for the result: what changed, or the problems."""
        from concurrent.futures import Future

        future: Future[Mapping[str, Any]] = Future()
        with self._lock:
            self._requests.append(future)
        return future.result()

    def close(self) -> None:
        """Answers requests that still wait: the appliance has stopped."""
        self._notification.close()
        with self._lock:
            waiting, self._requests = [*self._served_requests, *self._requests], []
        for future in waiting:
            if not future.done():
                future.set_result({"problems": [self._placed("the appliance has stopped")]})

    def step(self, *, requested: bool) -> None:
        """Reloads if that was requested, or if a watched file was replaced.

        Begins to read the files, or takes over what was read since the last call.
        """
        self._request_is_pending |= requested
        if self._reading is None:
            with self._lock:
                self._served_requests, self._requests = self._requests, []
            self._reading_is_requested = bool(self._served_requests or self._request_is_pending)
            if not self._reading_is_requested and not self._is_replaced():
                return
            self._request_is_pending = False
            self._notification.enter_context(self._manager.reloading())
            config = self._appliance.config
            self._reading = FileWork(lambda: self._read(config), self._timeout_ms)
        if self._reading.is_over(PROMPT_MS):
            reading, self._reading = self._reading, None
            with self._notification:
                result = self._reload(reading)
            if result:
                self._appliance.diagnostics.note_reload(is_done="changed" in result)
            for future in self._served_requests:
                future.set_result(result)

    def _read(self, config: Config) -> _Read:
        """Reads the files again. Runs in its own thread; `config` is the present configuration."""
        before = self._watched(config, hold=True)
        try:
            now = self._load()
            # The package may have been replaced: what a new part imports fails here, where nothing
            # has changed yet.
            allow_open_files(now, self._file)
            _import_for(now)
        except Exception as error:  # Raised again by the thread of the appliance.
            return _Read(None, error, before)
        after = self._watched(now, hold=True)
        if before is None or after is None:
            return _Read(now, None, after)
        is_steady = not before.changed(after)
        return _Read(now, None, after.read_after(before), is_steady)

    def _watched(self, config: Config, *, hold: bool) -> FileSnapshot | None:
        """The files of a configuration, if they are watched."""
        if self._file is None or config.reload != "on-change":
            return None
        return FileSnapshot(files_of(self._file, config), hold=hold)

    def _is_replaced(self) -> bool:
        """Whether changed files are to be taken over, which `not_taken_over` decides."""
        config = self._appliance.config
        if self._file is None or config.reload != "on-change":
            return False
        if self._snapshot is None:
            if time.monotonic() - self._snapshot_at >= self._watch_interval_ms / 1000:
                self._snapshot_at = time.monotonic()
                files = files_of(self._file, config)
                self._snapshot = FileWork(lambda: FileSnapshot(files, hold=False), self._timeout_ms)
            return False
        if not self._snapshot.is_over():
            return False
        looking, self._snapshot = self._snapshot, None
        try:
            now = looking.result()
        except OSError as error:
            self._log_once(error.filename or self._file, error.strerror)
            return False
        before, self._last_snapshot = self._last_snapshot, now
        if self._loaded_files is None:
            self._loaded_files = now
        reasons = self._loaded_files.not_taken_over(before, now)
        for file, reason in (reasons or {}).items():
            self._log_once(file, reason)
        return reasons is None

    def _log_once(self, file: Path | str, reason: str | None) -> None:
        """Logs a change that is not taken over; once until the next reload."""
        if (key := (str(file), reason)) not in self._logged:
            self._logged.add(key)
            todo = shell_command("holdfast", "reload", self._file)
            log_lines.write(
                logging.WARNING, "reload_needed", file=str(file), reason=reason, command=todo
            )

    def _reload(self, reading: FileWork[_Read]) -> Mapping[str, Any]:
        problems: list[str] = []
        changed: list[str] = []
        try:
            read = reading.result()
            if not read.is_steady and not self._reading_is_requested:
                return {}  # The next looks tell whether somebody still writes.
            self._loaded_files, self._last_snapshot, self._snapshot = read.files, None, None
            self._logged.clear()
            if isinstance(read.error, _REFUSALS):
                raise read.error
            if read.error is not None:
                raise ValueError(f"internal error: {read.error!r}") from read.error
            assert read.config is not None, "without an error, there is a configuration"
            config = read.config
            before = self._appliance.config
            changed = self._appliance.reload(config)
        except ConfigError as error:
            problems = [str(problem) for problem in error.problems]
        except NotAnswered as error:
            # The look that led here is not to lead here again.
            self._loaded_files = self._last_snapshot or self._loaded_files
            problems = [str(ConfigNotAnswered.of(error))]
        except click.UsageError as error:
            problems = [error.format_message()]
        except ReloadRefused as refused:
            problems = [self._placed(reason) for reason in refused.reasons]
        except (Unreadable, UnknownAdapter, ValueError) as error:
            problems = [self._placed(str(error))]
        except OSError as error:
            problems = [self._placed(file_error_text(error))]
        except ReloadIncomplete as error:
            log_lines.problem("reload_incomplete")
            return {"incomplete": self._placed(f"internal error: {error}")}
        for problem in problems:
            log_lines.write(logging.ERROR, "reload_refused", problem=problem)
        if problems:
            return {"problems": problems}
        warnings = [str(warning) for warning in config.warnings]
        for warning in warnings:
            log_lines.write(logging.WARNING, "config_warning", warning=warning)
        log_lines.write(
            logging.INFO,
            "reloaded",
            changed=" ".join(changed) or "nothing",
            sha256=config.sha256 or "-",
        )
        return {
            "changed": described(changed, before, config),
            "sha256": config.sha256,
            "warnings": warnings,
        }

    def _placed(self, problem: str) -> str:
        return problem if self._file is None else f"{self._file}: {problem}"

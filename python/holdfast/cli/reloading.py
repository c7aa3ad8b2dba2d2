"""Rereads the configuration of a running appliance: at a signal, a request, or a changed file."""

from __future__ import annotations

import logging
import threading
import time
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any

import click

from holdfast import logs
from holdfast.adapters.foreign import UnknownAdapter
from holdfast.appliance import changes
from holdfast.config import ConfigError
from holdfast.config.fingerprint import signature
from holdfast.web.port import explained

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from holdfast.appliance import Appliance
    from holdfast.appliance.service_manager import ServiceManager
    from holdfast.config import Config

WATCH_INTERVAL = 1.0
"""Seconds between two looks at the files. A change counts when it is still the same at the next."""


class Reloading:
    """Reloads one appliance with what `load` returns. `step` is for the thread that runs it.

    `load` reads the configuration `file`, or the files of command-line options.
    """

    def __init__(
        self,
        appliance: Appliance,
        manager: ServiceManager,
        load: Callable[[], Config],
        file: Path | None = None,
    ) -> None:
        self._appliance = appliance
        self._manager = manager
        self._load = load
        self._file = file
        self._waiting: list[Future[Mapping[str, Any]]] = []
        self._lock = threading.Lock()
        self._looked = time.monotonic()
        self._known = self._seen = self._signature()

    def ask(self) -> Mapping[str, Any]:
        """Has the appliance reloaded. Waits for the result: what changed, or the problems."""
        future: Future[Mapping[str, Any]] = Future()
        with self._lock:
            self._waiting.append(future)
        return future.result()

    def step(self, *, requested: bool) -> None:
        """Reloads if that was requested, or if a watched file has changed."""
        with self._lock:
            waiting, self._waiting = self._waiting, []
        if not (waiting or requested or self._has_changed()):
            return
        with self._manager.reloading():
            result = self._reload()
        for future in waiting:
            future.set_result(result)

    def _has_changed(self) -> bool:
        if self._appliance.config.reload != "on-change":
            return False
        now = time.monotonic()
        if now - self._looked < WATCH_INTERVAL:
            return False
        self._looked = now
        before, self._seen = self._seen, self._signature()
        return self._seen == before != self._known

    def _reload(self) -> Mapping[str, Any]:
        problems: list[str] = []
        changed: list[str] = []
        before = self._signature()
        try:
            config = self._load()
            changed = self._appliance.reload(config)
        except ConfigError as error:
            problems = [str(problem) for problem in error.problems]
        except click.UsageError as error:
            problems = [error.format_message()]
        except changes.ReloadRefused as refused:
            problems = [self._placed(reason) for reason in refused.reasons]
        except OSError as error:
            problems = [self._placed(explained(error))]
        except (UnknownAdapter, ValueError) as error:
            problems = [self._placed(str(error))]
        except changes.ReloadIncomplete as error:
            logs.problem("reload_incomplete")
            return {"incomplete": self._placed(f"internal error: {error}")}
        finally:
            # A file that was written meanwhile still differs from what is known.
            now = self._signature()
            self._known = self._seen = {file: before.get(file, now[file]) for file in now}
        for problem in problems:
            logs.write(logging.ERROR, "reload_refused", problem=problem)
        if problems:
            return {"problems": problems}
        for warning in config.warnings:
            logs.write(logging.WARNING, "config_warning", warning=str(warning))
        logs.write(
            logging.INFO,
            "reloaded",
            changed=" ".join(changed) or "nothing",
            sha256=config.sha256 or "-",
        )
        return {"changed": changed, "sha256": config.sha256}

    def _placed(self, problem: str) -> str:
        return problem if self._file is None else f"{self._file}: {problem}"

    def _signature(self) -> Mapping[Path, object]:
        return {} if self._file is None else signature(self._file, self._appliance.config)

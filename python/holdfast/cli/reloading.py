"""Rereads the configuration of a running appliance: at a signal, a request, or a changed file."""

from __future__ import annotations

import logging
import threading
import time
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any

from holdfast import logs
from holdfast.adapters.foreign import UnknownAdapter
from holdfast.appliance import changes
from holdfast.cli.configuration import load_whole
from holdfast.config import ConfigError
from holdfast.config.fingerprint import signature
from holdfast.web.port import explained

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from holdfast.appliance import Appliance
    from holdfast.appliance.service_manager import ServiceManager

WATCH_INTERVAL = 1.0
"""Seconds between two looks at the files. A change counts when it is still the same at the next."""


class Reloading:
    """Reloads one appliance. `step` is for the thread that runs it."""

    def __init__(self, appliance: Appliance, file: Path, manager: ServiceManager) -> None:
        self._appliance = appliance
        self._manager = manager
        self._file = file
        self._waiting: list[Future[Mapping[str, Any]]] = []
        self._lock = threading.Lock()
        self._looked = time.monotonic()
        self._known = self._seen = signature(file, appliance.config)

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
        before, self._seen = self._seen, signature(self._file, self._appliance.config)
        return self._seen == before != self._known

    def _reload(self) -> Mapping[str, Any]:
        problems: list[str] = []
        changed: list[str] = []
        try:
            config = load_whole(self._file)
            changed = self._appliance.reload(config)
        except ConfigError as error:
            problems = [str(problem) for problem in error.problems]
        except changes.ReloadRefused as refused:
            problems = [f"{self._file}: {reason}" for reason in refused.reasons]
        except OSError as error:
            problems = [f"{self._file}: {explained(error)}"]
        except (UnknownAdapter, ValueError) as error:
            problems = [f"{self._file}: {error}"]
        except changes.ReloadIncomplete as error:
            logs.problem("reload_incomplete")
            return {"incomplete": f"{self._file}: internal error: {error}"}
        finally:
            self._known = self._seen = signature(self._file, self._appliance.config)
        for problem in problems:
            logs.write(logging.ERROR, "reload_refused", problem=problem)
        if problems:
            return {"problems": problems}
        for warning in config.warnings:
            logs.write(logging.WARNING, "config_warning", warning=str(warning))
        logs.write(
            logging.INFO, "reloaded", changed=" ".join(changed) or "nothing", sha256=config.sha256
        )
        return {"changed": changed, "sha256": config.sha256}

"""Checks rules between memories and the logs that they share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.embedded_checks import check_embedded, check_servers
from holdfast.config.lenient import entries, mapping
from holdfast.config.nats_checks import check_nats
from holdfast.config.words import show
from holdfast.runtime.text import all_of, guess, listing

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.report import Report


def check_logs(data: dict[Any, Any], folder: Path, report: Report) -> None:
    """Reports what is wrong; files are relative to `folder`."""
    logs, used = mapping(data.get("logs")), set[str]()
    for name, settings in logs.items():
        check_nats(("logs", name), mapping(settings), folder, report)
        check_servers(("logs", name), mapping(settings), report)
    check_embedded(logs, folder, report)
    for name, memory in mapping(data.get("memories")).items():
        log = mapping(mapping(memory).get("replicate")).get("log")
        if not isinstance(log, str):
            continue  # Reported by the model.
        used.add(log)
        if log not in logs:
            words = f"allowed: {listing(logs) or 'none, there are no logs'}{guess(log, logs)}"
            report.add(("memories", name, "replicate", "log"), f"found {show(log)}, {words}")
    for name in logs:
        if name not in used:
            report.doubt(("logs", name), "has no effect: no memory is replicated through it")
    _check_files(mapping(data.get("memories")), folder, report)
    _check_devices(data, report)


def _check_files(memories: dict[Any, Any], folder: Path, report: Report) -> None:
    """Reports files that don't have all memories of one log, and no others."""
    logs: dict[str, object] = {}
    files: dict[str, Path] = {}
    for name, memory in memories.items():
        logs[name] = mapping(mapping(memory).get("replicate")).get("log")
        file = mapping(mapping(memory).get("keep")).get("file")
        if isinstance(file, str) and file:
            files[name] = folder / file
    for name, log in logs.items():
        if log is None:
            continue
        path = ("memories", name, "keep")
        own = files.get(name)
        for other in memories:
            if logs[other] == log and own is None and other in files:
                message = f"missing, required: all memories of a log have keep if {other} has"
                report.add(("memories", name), message)
                break
            if own is None or other not in files or other == name:
                continue
            if logs[other] == log and files[other] != own:
                message = (
                    f"found {show(str(own))}, allowed: {show(str(files[other]))}, as {other} has"
                )
                report.add((*path, "file"), message)
                break
            if logs[other] != log and files[other] == own:
                report.add((*path, "file"), f"found the file of {other}, which is not of this log")
                break
        keep = mapping(mapping(memories[name]).get("keep"))
        if own is not None and keep.get("sync", 1) == 0:
            report.add((*path, "sync"), "found 0, allowed with replicate: more than 0")


def _check_devices(data: dict[Any, Any], report: Report) -> None:
    """Reports devices of more than one log: one lease says which node polls a device."""
    memories = mapping(data.get("memories"))
    for name, device in mapping(data.get("devices")).items():
        settings = mapping(device)
        into = [mapping(mapping(read).get("into")) for read in entries(settings.get("reads"))]
        logs = dict.fromkeys(
            str(log)
            for place in [*into, mapping(settings.get("status"))]
            if isinstance(memory := place.get("memory"), str)
            and (log := mapping(mapping(memories.get(memory)).get("replicate")).get("log"))
        )
        if len(logs) > 1:
            message = f"found memories of the logs {all_of(logs)}, allowed: those of one log"
            report.add(("devices", name), message, of_key=True)

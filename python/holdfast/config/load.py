"""Loads a file into a `Config`, or reports every problem of the file.

The models check each value, and the checks test rules between values. Both run on the data of the
file, so an error in one does not hide an error in the other.
"""

from __future__ import annotations

import hashlib
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from holdfast import bounded_files
from holdfast.config import source
from holdfast.config.allowed import allowed, known_keys
from holdfast.config.device_checks import DeviceChecks
from holdfast.config.grant_checks import GrantChecks, doubt_grants
from holdfast.config.lenient import mapping
from holdfast.config.listener_checks import ListenerChecks
from holdfast.config.log_checks import check_logs
from holdfast.config.memory_checks import MemoryChecks
from holdfast.config.model import Config
from holdfast.config.output_checks import OutputChecks
from holdfast.config.problems import ConfigError, Problem
from holdfast.config.profile_files import ProfileFiles
from holdfast.config.report import Report
from holdfast.config.route_checks import RouteChecks, doubt_routes
from holdfast.config.service_checks import ServiceChecks
from holdfast.config.shared_connection_checks import AddressChecks
from holdfast.config.socket_checks import check_sockets
from holdfast.config.structure import build
from holdfast.config.tag_checks import TagChecks
from holdfast.config.templates import expanded
from holdfast.config.words import shape, show


def load(path: Path | str) -> Config:
    """Reads a configuration. Raises `ConfigError` with every problem.

    Valid settings without effect are in `Config.warnings`.
    """
    return loaded(path)[0]


def loaded(path: Path | str) -> tuple[Config, source.Document]:
    """Reads a configuration, as `load` does. Returns it with its document."""
    file = str(path)

    def work() -> tuple[Config, source.Document]:
        content = source.read_bytes(Path(path), file)
        document, problems = source.parse(source.decoded(content, file), file)
        config = checked(document, problems, Path(path).absolute().parent)
        return config.with_sha256(hashlib.sha256(content).hexdigest()), document

    try:
        return bounded_files.answered(work)
    except bounded_files.NotAnswered as error:
        raise ConfigError(file, [unanswered(error)]) from None


def unanswered(error: bounded_files.NotAnswered) -> Problem:
    """The problem of a file that was not read in time."""
    return Problem(str(error.filename), None, None, "", f"can't be read: {error.strerror}")


def checked(document: source.Document, problems: list[Problem], folder: Path) -> Config:
    """The configuration of a document that has these problems. It names files from `folder`.

    Raises `ConfigError` with these problems, and all others.
    """
    found = _foreign(document.data)
    if found is not None:
        message = f"found {found}, allowed: {allowed((), None)}"
        raise ConfigError(document.file, problems or [Problem(document.file, 1, 1, "", message)])
    assert isinstance(document.data, dict), "anything else is foreign"
    report = Report(document)
    profiles = ProfileFiles(folder, report)
    profiles.read()
    expanded(report)
    data = report.document.data
    memories = MemoryChecks(folder, report)
    memories.check(data.get("memories"))
    _check_others(data, folder, report)
    context = {"folder": folder, "initial_values": memories.values}
    config = build(data, context, report)
    problems = [
        *problems,
        *report.problems,
        *memories.problems_elsewhere,
        *profiles.problems_elsewhere,
    ]
    if config is None or problems:
        raise ConfigError(document.file, problems)
    doubt_grants(config, report)
    doubt_routes(config, report)
    config.with_profile_files(profiles.files)
    return config.with_warnings(sorted(report.doubts, key=lambda doubt: doubt.line or 0))


def _foreign(data: object) -> str | None:
    """What a file is that is no configuration. Its content is not shown: it could be a secret."""
    if data is None:
        return "an empty file"
    if not isinstance(data, dict):
        return shape(data) if data else show(data)
    known = known_keys((), None)
    if not data or any(get_close_matches(str(key), known, cutoff=0.8) for key in data):
        return None
    return (
        f"a mapping with {len(data)} other keys" if len(data) > 1 else "a mapping with another key"
    )


def _check_others(data: dict[Any, Any], folder: Path, report: Report) -> None:
    memories = mapping(data.get("memories"))
    grants = GrantChecks(report, [str(name) for name in memories])
    routes = RouteChecks(report, grants, mapping(data.get("devices")), mapping(data.get("links")))
    routes.check_names()
    ListenerChecks(folder, report, grants, routes, memories).check(data.get("listeners"))
    ServiceChecks(folder, report, grants).check(data)
    check_logs(data, folder, report)
    AddressChecks(folder, report).check(data)
    DeviceChecks(report, grants, memories).check(data.get("devices"))
    OutputChecks(folder, report).check(data)
    tags = TagChecks(report)
    tags.profiles(data.get("profiles"))
    tags.devices(data.get("devices"), mapping(data.get("profiles")))
    check_sockets(data, report)

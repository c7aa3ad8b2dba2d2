"""Loads a file into a `Config`, or reports every problem of the file.

The models check each value. Then the checks test rules between values, on all models and parts of
models that are valid, so an error in one does not hide an error in the other.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from holdfast.config.allowed_words import allowed, known_keys
from holdfast.config.build import build
from holdfast.config.checks.bind_addresses import check_binds
from holdfast.config.checks.common import Scope
from holdfast.config.checks.devices import check_devices, warn_of_devices
from holdfast.config.checks.extras import check_extras
from holdfast.config.checks.former_keys import take_out_former_keys
from holdfast.config.checks.listeners import (
    check_listeners,
    warn_of_listeners,
    warn_of_source_limit,
)
from holdfast.config.checks.memories import check_memories, warn_of_grants
from holdfast.config.checks.nats import check_logs, warn_of_logs
from holdfast.config.checks.outputs import check_outputs, warn_of_outputs
from holdfast.config.checks.services import check_services
from holdfast.config.checks.shared_addresses import AddressChecks
from holdfast.config.checks.tags import check_tags
from holdfast.config.checks.units import warn_of_routes
from holdfast.config.checks.written_files import check_written_files
from holdfast.config.models.root import Config
from holdfast.config.tag_files.profiles import ProfileFiles
from holdfast.config.text import yaml_document
from holdfast.config.text.messages import shape, show
from holdfast.config.text.problems import ConfigError, ConfigNotAnswered, Problem
from holdfast.config.text.report import Report
from holdfast.config.text.templates import expand_templates
from holdfast.runtime import bounded_files
from holdfast.runtime.suggestion import HIGH_LIKENESS, alike

_ITEM = r"\s*(?:#.*\n\s*)*-\s+"
"""What is between a key and the first entry of the list that is its value."""

_OTHER_PROGRAMS = {
    ("Telegraf", "telegraf FILE"): r"^[ \t]*\[\[ *inputs\.modbus *\]\]",
    ("modpoll", "modpoll FILE --url URL"): r"^poll, *(?:coil|discrete_input|\w+_register) *,",
    ("modbus-proxy", "modbus-proxy FILE"): rf"^devices:{_ITEM}(?:modbus|listen):",
    ("Home Assistant", "home-assistant FILE"): rf"^modbus:(?:{_ITEM}| +!include)",
}
"""What is only in configurations of other programs, by the program and what `holdfast import`
takes."""


def load(path: Path | str) -> Config:
    """Reads a configuration. Raises `ConfigError` with every problem.

    Valid settings without effect are in `Config.warnings`.
    """
    return loaded(path)[0]


def loaded(path: Path | str) -> tuple[Config, yaml_document.Document]:
    """Reads a configuration, as `load` does. Returns it with its document."""
    file = str(path)

    def work() -> tuple[Config, yaml_document.Document]:
        content = yaml_document.read_bytes(Path(path), file)
        text = yaml_document.decoded(content, file)
        try:
            document, problems = yaml_document.parse(text, file)
            config = checked(document, problems, Path(path).absolute().parent)
        except ConfigNotAnswered:
            raise
        except ConfigError:
            _refuse_other_program(text, file)
            raise
        config.set_sha256(hashlib.sha256(content).hexdigest())
        return config, document

    try:
        return bounded_files.answered(work)
    except bounded_files.NotAnswered as error:
        raise ConfigNotAnswered.of(error) from None


def checked(document: yaml_document.Document, problems: list[Problem], folder: Path) -> Config:
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
    expand_templates(report)
    take_out_former_keys(report)
    config = build(report.document.data, folder, report)
    config.set_profile_files(profiles.files)
    scope = Scope(config, folder, report)
    _check(scope)
    problems = [*problems, *report.problems, *report.elsewhere]
    if problems:
        raise ConfigError(document.file, problems)
    _warn(scope)
    config.set_warnings(sorted(report.warnings, key=lambda warning: warning.line or 0))
    return config


def _check(scope: Scope) -> None:
    """Reports every problem between valid values."""
    check_memories(scope)
    check_listeners(scope)
    check_services(scope)
    check_logs(scope)
    AddressChecks(scope).check()
    check_devices(scope)
    check_outputs(scope)
    check_tags(scope)
    check_written_files(scope)
    check_binds(scope)
    check_extras(scope)


def _warn(scope: Scope) -> None:
    """Warns about valid settings that have no effect, or probably a wrong one."""
    warn_of_listeners(scope)
    for name, service in (("rest", scope.config.rest), ("gateway", scope.config.gateway)):
        if service is not None:
            warn_of_source_limit(scope, (name,), service)
    warn_of_logs(scope)
    warn_of_devices(scope)
    warn_of_outputs(scope)
    warn_of_grants(scope)
    warn_of_routes(scope)


def _refuse_other_program(text: str, file: str) -> None:
    """Raises `ConfigError` if the text, which is not valid, is a configuration of another program
    that can be imported.
    """
    for (program, arguments), pattern in _OTHER_PROGRAMS.items():
        if found := re.search(pattern, text, re.MULTILINE):
            line = text.count("\n", 0, found.start()) + 1
            message = f"found a configuration of {program}, allowed: one of Holdfast"
            hint = f"to convert it: holdfast import {arguments}"
            raise ConfigError(file, [Problem(file, line, 1, "", f"{message}; {hint}")]) from None


def _foreign(data: object) -> str | None:
    """What a file is that is no configuration. Its content is not shown: it could be a secret."""
    if data is None:
        return "an empty file"
    if not isinstance(data, dict):
        return shape(data) if data else show(data)
    if not data or any(str(key) in Config.model_fields for key in data):
        return None
    known = known_keys((), None)
    if any(alike(str(key).lower(), known, HIGH_LIKENESS) for key in data):
        return None
    unknown = "one unknown key" if len(data) == 1 else f"{len(data)} unknown keys"
    return f"a mapping with {unknown}"

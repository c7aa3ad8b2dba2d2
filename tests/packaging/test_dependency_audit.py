"""`make audit`: what is refused, and that missing data is said."""

from __future__ import annotations

import importlib
from typing import Any

import pytest


@pytest.fixture
def audit() -> Any:
    return importlib.import_module("dependencies")


@pytest.mark.parametrize(
    ("name", "licence", "is_good"),
    [
        ("click", "BSD License", True),
        ("msgspec", "BSD-3-Clause", True),
        ("click", "GNU General Public License v3 (GPLv3)", False),
        ("click", "Mozilla Public License 2.0 (MPL 2.0)", False),
        ("hypothesis", "MPL-2.0", True),
        ("hypothesis", "UNKNOWN", False),
    ],
)
def test_what_is_distributed_has_a_permissive_licence(
    audit: Any,
    name: str,
    licence: str,
    is_good: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(audit, "licences", lambda: {name: licence})
    assert audit.package_licences() is is_good
    assert (f"{name}: licence {licence!r}" in capsys.readouterr().out) is not is_good


@pytest.mark.parametrize(
    "report", [None, [{"name": "click", "skip_reason": "not found"}]], ids=["offline", "skipped"]
)
def test_missing_data_is_said(
    audit: Any,
    report: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(audit, "reported", lambda _: report)
    assert audit.package_vulnerabilities()
    assert "requirements/dev.lock: not checked" in capsys.readouterr().out


def test_a_known_vulnerability_is_refused(
    audit: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = {"id": "PYSEC-1", "description": "It leaks."}
    report = [{"name": "click", "version": "1.0", "vulns": [found]}]
    monkeypatch.setattr(audit, "reported", lambda _: report)
    assert not audit.package_vulnerabilities()
    assert "click 1.0: PYSEC-1 It leaks." in capsys.readouterr().out

"""Certificates that expire: what the log has of them, and how often."""

from __future__ import annotations

import logging
from typing import Any

import pytest

from holdfast.appliance.parts.certificate_expiry import CertificateExpiry
from holdfast.config import Config

NOTHING = Config.model_construct()
DAY = 24 * 3600.0
END = 1_800_000_000.0
EXPIRIES = {
    "certificates": {"server.pem": END},
    "revocation_lists": {"crl.pem": END + 365 * DAY},
}


@pytest.fixture
def told(caplog: pytest.LogCaptureFixture) -> Any:
    """Returns the events since the last call: name and file."""
    caplog.set_level(logging.INFO, "holdfast")

    def events() -> list[tuple[str, str]]:
        found = [(each.message, vars(each)["fields"]["file"]) for each in caplog.records]
        caplog.clear()
        return found

    return events


def test_a_certificate_is_logged_once_a_day_before_and_after_it_expires(told: Any) -> None:
    expiry = CertificateExpiry(NOTHING)
    expiry.log_due(EXPIRIES, END - 31 * DAY)
    assert told() == []
    for _ in range(2):
        expiry.log_due(EXPIRIES, END - 30 * DAY)
    assert told() == [("certificate_expires", "server.pem")]
    expiry.log_due(EXPIRIES, END - 29 * DAY)
    assert told() == [("certificate_expires", "server.pem")]
    expiry.log_due(EXPIRIES, END - 1)
    assert told() == [("certificate_expires", "server.pem")]
    for _ in range(2):
        expiry.log_due(EXPIRIES, END)
    assert told() == [("certificate_expired", "server.pem")]


def test_a_clock_that_is_set_back_does_not_silence_it(told: Any) -> None:
    expiry = CertificateExpiry(NOTHING)
    expiry.log_due(EXPIRIES, END + 100 * DAY)
    assert told() == [("certificate_expired", "server.pem")]
    expiry.log_due(EXPIRIES, END + 50 * DAY)
    assert told() == [("certificate_expired", "server.pem")]


def test_an_expiry_has_its_kind_and_its_date(caplog: pytest.LogCaptureFixture) -> None:
    CertificateExpiry(NOTHING).log_due({"revocation_lists": {"crl.pem": END}}, END)
    [record] = caplog.records
    assert vars(record)["fields"] == {
        "kind": "revocation list",
        "file": "crl.pem",
        "expires": "2027-01-15T08:00:00.000Z",
    }

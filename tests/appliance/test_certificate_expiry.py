"""Certificates that expire: which are found, what the log has of them, and how often."""

from __future__ import annotations

import logging
import shutil
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin

import pytest

from holdfast.appliance.parts.certificate_expiry import (
    KINDS,
    CertificateExpiry,
    expiries,
    warnings,
)
from holdfast.config import Config, load
from holdfast.config.models.base import Model
from support.certificates import Certificates
from support.config_folder import written

if TYPE_CHECKING:
    from collections.abc import Iterator

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


# Which certificates are found.

DATELESS = {
    "credentials_file",
    "embedded",
    "file",
    "initial",
    "key_file",
    "key_passphrase_file",
    "password_file",
    "token_file",
}
"""The keys of files that do not expire."""


def keys(model: type[Model], place: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The keys of files in a model, each with its place. `*` is any name or index."""
    for key, field in model.model_fields.items():
        yield from within(field.annotation, (*place, key))


def within(annotation: Any, place: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    if annotation is Path:
        yield place
    elif isinstance(annotation, type) and issubclass(annotation, Model):
        yield from keys(annotation, place)
    origin, parts = get_origin(annotation), get_args(annotation)
    for part in parts[:1] if origin is Annotated else parts:
        yield from within(part, (*place, "*") if origin in (dict, tuple) else place)


EXPIRING = {place for place in keys(Config) if place[-1] in KINDS}
URLS = {("devices", "*", "url"), ("devices", "*", "forward", "*", "url"), ("links", "*", "url")}


def test_each_key_of_a_file_is_known_to_expire_or_not() -> None:
    assert {place[-1] for place in keys(Config)} == KINDS.keys() | DATELESS


class Pems:
    """Files that expire tomorrow, and a configuration that names one in each place."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._authority = folder, Certificates(folder)
        tomorrow = (datetime.now(UTC) + timedelta(hours=36)).strftime("%Y%m%d%H%M%SZ")
        self._dates = "20200101000000Z", tomorrow
        self._issued = self._authority.issue("soon", "DNS:localhost", dates=self._dates)
        self._list = self._authority.revoke(dates=self._dates)
        self.certificates: set[str] = set()
        self.lists: set[str] = set()

    def _certificate(self) -> str:
        file = self._folder / f"{len(self.certificates)}.pem"
        self.certificates.add(str(shutil.copy(self._issued.certificate, file)))
        return str(file)

    def _revocation_list(self) -> str:
        file = self._folder / f"{len(self.lists)}.crl"
        self.lists.add(str(shutil.copy(self._list, file)))
        return str(file)

    def _client(self) -> dict[str, str]:
        return {"ca_file": self._certificate(), **self._own()}

    def _server(self, ca: str) -> dict[str, str]:
        return {ca: self._certificate(), "crl_file": self._revocation_list(), **self._own()}

    def _own(self) -> dict[str, str]:
        return {"cert_file": self._certificate(), "key_file": str(self._issued.key)}

    def _url(self, scheme: str) -> str:
        files = self._client()
        query = "&".join(f"{key.removesuffix('_file')}={file}" for key, file in files.items())
        return f"{scheme}://127.0.0.1:9?{query}"

    def configuration(self) -> Config:
        at = {"bind": "127.0.0.1:0", "sources": ["127.0.0.1"]}
        http = [{**at, "tls": self._server("client_ca_file")} for _ in range(3)]
        rules = [{"sources": ["127.0.0.1"], "units": {1: "plant"}, "access": "read-only"}]
        raw = [{"sources": ["127.0.0.1"], "units": {1: "plant"}, "areas": ["coils"]}]
        bus = [{"servers": ["tls://127.0.0.1"], "tls": self._client()} for _ in range(3)]
        broker = [{"url": "mqtts://127.0.0.1", "tls": self._client()} for _ in range(3)]
        read = {"area": "coils", "address": 0, "count": 1}
        file = self._folder / "plant.yaml"
        file.write_text(
            written(
                {
                    "memories": {"plant": {"coils": 8, "replicate": {"log": "site"}}},
                    "logs": {"site": {**bus[0], "node": "a"}},
                    "listeners": {
                        "scada": {
                            "type": "modbus-tls",
                            "bind": "127.0.0.1:0",
                            "tls": self._server("ca_file"),
                            "rules": rules,
                        },
                        "sender": {
                            "type": "raw-ingest",
                            "bind": "127.0.0.1:0",
                            "tls": self._server("ca_file"),
                            "rules": raw,
                        },
                    },
                    "devices": {
                        "meter": {
                            "url": self._url("tls"),
                            "interval": 1,
                            "reads": [read],
                            "forward": [{"url": self._url("raw+tls"), "unit": 1}],
                            "tags": {"on": {"area": "coils", "address": 0}},
                        }
                    },
                    "links": {"line": {"url": self._url("tls")}},
                    "rest": {**http[0], "tokens": "none"},
                    "gateway": {
                        **http[1],
                        "tokens": "none",
                        "allow": ["127.0.0.1"],
                        "access": "read-only",
                        "device_tls": self._client(),
                    },
                    "metrics": http[2],
                    "mqtt": {
                        **broker[0],
                        "client_id": "plant",
                        "subscriptions": [
                            {"topic": "plant", "memories": ["plant"], "areas": ["coils"]}
                        ],
                    },
                    "nats": {**bus[1], "devices": ["127.0.0.1"], "device_tls": self._client()},
                    "outputs": {
                        "bus": {**bus[2], "type": "nats", "prefix": "plant"},
                        "broker": {**broker[1], "type": "mqtt"},
                        "scada": {
                            **broker[2],
                            "type": "sparkplug",
                            "group": "plant",
                            "edge_node": "a",
                        },
                        "database": {
                            "type": "influx",
                            "url": "https://127.0.0.1",
                            "bucket": "plant",
                            "tls": self._client(),
                        },
                    },
                }
            )
        )
        return load(file)


@pytest.fixture
def pems(tmp_path: Path) -> Pems:
    return Pems(tmp_path)


def general(place: tuple[str | int, ...]) -> tuple[str | int, ...]:
    """A place with `*` for each name and index."""
    named = ("devices", "links", "listeners", "logs", "outputs")
    return tuple(
        "*" if isinstance(part, int) or (index == 1 and place[0] in named) else part
        for index, part in enumerate(place)
    )


def test_the_expiry_of_each_configured_file_is_found(pems: Pems) -> None:
    config = pems.configuration()
    found = expiries(config)
    assert found["certificates"].keys() == pems.certificates
    assert found["revocation_lists"].keys() == pems.lists
    warned = warnings(config)
    assert all(" expires in 1 day, on " in text for _, text in warned)
    assert {general(place) for place, _ in warned} == EXPIRING | URLS


def test_the_warning_without_cryptography_says_what_requires_it(
    pems: Pems, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = pems.configuration()
    monkeypatch.setitem(sys.modules, "cryptography", None)
    [(_, text)] = warnings(config)
    assert text.startswith("checking the dates of certificates requires cryptography, not ")

"""Host, Origin and Sec-Fetch-Site: REST, metrics and gateway apply one rule to them."""

from __future__ import annotations

import asyncio
import hashlib
from contextlib import closing
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.adapters.metrics import Metrics
from holdfast.config.models.services import MetricsConfig
from holdfast.gateway import Gateway, Settings
from holdfast.net.http.health import Check
from holdfast.net.http.host_and_origin import Origins
from holdfast.net.http.port import listen
from holdfast.net.http.requests import Request, Response
from support import web

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from holdfast.net.http.application import Application

NAME = "plant.example"
SECRET = "a-secret-of-the-test"
DIGEST = hashlib.sha256(SECRET.encode())
PATHS = {"rest": "/api/v1/diagnostics/stats", "metrics": "/metrics", "gateway": "/api/gateway"}
OPEN = {"rest": "/docs", "metrics": "/health/live", "gateway": "/"}


class Healthy:
    """A process that is well."""

    def live(self) -> Mapping[str, Check]:
        return {"logs": Check(True, "site: connected")}

    ready = live


def application(kind: str, https: Any = None, *, secured: bool = False) -> Application:
    """One of the three, with `NAME` as the name that it may have."""
    with closing(listen("127.0.0.1", 0)) as listener:
        if kind == "rest":
            tokens = [web.token("edge", SECRET)] if secured else "none"
            service = web.Service(
                {"plant_a": holdfast.Memory(coils=8)}, hosts=[NAME], tokens=tokens
            )
            service.https = https
            service.listener.close()
            service.listener = listener
            return service.made()._app
        diagnostics = web.diagnostics_of({})
        if kind == "metrics":
            settings = MetricsConfig.model_validate({"bind": "127.0.0.1:0", "hosts": [NAME]})
            return Metrics(settings, diagnostics, Healthy(), listener, https=https)._app
        chosen = Settings(
            (),
            hosts=frozenset({NAME}),
            tokens=(("edge", DIGEST.digest()),) if secured else (),
        )
        return Gateway(chosen, listener, https=https, health=Healthy())._app


def asked(app: Application, path: str, *headers: tuple[str, str], version: str = "1.1") -> Response:
    async def ask() -> Response:
        sent = [(name.lower().encode(), value.encode("latin-1")) for name, value in headers]
        answer = app(Request("GET", path, b"", sent, "127.0.0.1:50000", version=version))
        assert not callable(answer)
        response = answer if isinstance(answer, Response) else await answer
        assert response is not None
        return response

    return asyncio.run(ask())


@pytest.fixture(params=PATHS)
def kind(request: pytest.FixtureRequest) -> Iterator[str]:
    return request.param  # type: ignore[no-any-return]


ADDRESS = ("Host", "127.0.0.1:8080")


@pytest.mark.parametrize(
    "host",
    [
        "127.0.0.1",
        "10.0.0.7:9464",
        "[::1]:8080",
        "localhost",
        "LocalHost:8080",
        "plant.example",
        "Plant.Example:8080",
    ],
)
def test_host_may_be_an_address_localhost_or_a_name_of_the_configuration(
    kind: str, host: str
) -> None:
    assert asked(application(kind), PATHS[kind], ("Host", host)).status == 200


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "127.0.0.1.evil.example:8080",
        "www.plant.example",
        "plant.example.",
        "[fe80::1%eth0]",
        "fe80::1%25eth0",
        "0x7f.1",
        "127.0.0.1, evil.example",
        "user@127.0.0.1",
        ":8080",
        "",
        "\u00e9",
    ],
)
def test_another_host_is_refused_without_tokens(kind: str, host: str) -> None:
    answer = asked(application(kind), PATHS[kind], ("Host", host))
    assert (answer.status, b"a name in" in answer.body) == (403, True)


@pytest.mark.parametrize(
    ("host", "over_http", "over_https"),
    [
        ("localhost:8080", True, True),
        ("127.0.0.1:8080", True, True),
        ("127.1.2.3", True, True),
        ("[::1]:8080", True, True),
        ("192.168.1.5:8080", False, True),
        ("[fd00::2]:8080", False, True),
        ("0.0.0.0:8080", False, True),
        ("[::ffff:127.0.0.1]:8080", False, True),
        (NAME, False, False),
    ],
)
def test_browsers_mark_all_requests_of_other_pages_to_this_machine_and_over_https(
    host: str, over_http: bool, over_https: bool
) -> None:
    request = Request("GET", "/", b"", [(b"host", host.encode())], "127.0.0.1:50000")
    for is_https, expected in ((False, over_http), (True, over_https)):
        origins = Origins(names={NAME}, name_refusal="", is_https=is_https)
        assert origins.browsers_mark_foreign_requests(request) is expected


@pytest.mark.parametrize("kind", ["rest", "gateway"])
def test_with_tokens_host_may_be_any_name_but_a_page_must_be_of_this_server(kind: str) -> None:
    app = application(kind, secured=True)
    headers = [("Host", "gw.plant"), ("Authorization", f"Bearer {SECRET}")]
    assert asked(app, PATHS[kind], *headers).status == 200
    assert asked(app, PATHS[kind], *headers, ("Origin", "http://gw.plant")).status == 200
    assert asked(app, PATHS[kind], *headers, ("Origin", "http://evil.example")).status == 403


@pytest.mark.parametrize(
    ("hosts", "version", "status"),
    [
        (0, "1.1", 400),
        (2, "1.1", 400),
        (0, "1.0", 200),
        (1, "1.0", 200),
        (2, "1.0", 400),
    ],
)
def test_there_is_one_host_whatever_is_asked_for(
    kind: str, hosts: int, version: str, status: int
) -> None:
    for path in (PATHS[kind], OPEN[kind]):
        answer = asked(application(kind), path, *[ADDRESS] * hosts, version=version)
        assert answer.status == status


FOREIGN = [
    [("Origin", "http://evil.example")],
    [("Origin", "null")],
    [("Origin", "http://127.0.0.1")],
    [("Origin", "ftp://127.0.0.1:8080")],
    [("Origin", "127.0.0.1:8080")],
    [("Origin", "http://evil.example"), ("Origin", "http://127.0.0.1:8080")],
    [("Origin", "http://127.0.0.1:8080"), ("Origin", "http://evil.example")],
    [("Sec-Fetch-Site", "cross-site")],
    [("Sec-Fetch-Site", "same-site")],
    [("Sec-Fetch-Site", "cross-site"), ("Sec-Fetch-Site", "same-origin")],
]


@pytest.mark.parametrize("headers", FOREIGN)
def test_a_page_of_another_site_is_refused(kind: str, headers: list[tuple[str, str]]) -> None:
    answer = asked(application(kind), PATHS[kind], ADDRESS, *headers)
    assert (answer.status, b"a page of another site" in answer.body) == (403, True)


@pytest.mark.parametrize(
    "headers",
    [
        [("Origin", "http://127.0.0.1:8080"), ("Sec-Fetch-Site", "same-origin")],
        [("Origin", "HTTP://127.0.0.1:8080")],
        [("Sec-Fetch-Site", "none")],
    ],
)
def test_its_own_page_and_a_person_are_answered(kind: str, headers: list[tuple[str, str]]) -> None:
    assert asked(application(kind), PATHS[kind], ADDRESS, *headers).status == 200


def test_an_origin_of_http_is_another_site_than_https(kind: str) -> None:
    """A proxy in front of HTTP may speak HTTPS, not the other way round."""
    plain, secure = application(kind), application(kind, https=object())
    http, https = ("Origin", "http://127.0.0.1:8080"), ("Origin", "https://127.0.0.1:8080")
    found = [
        asked(app, PATHS[kind], ADDRESS, of).status
        for app in (plain, secure)
        for of in (http, https)
    ]
    assert found == [200, 200, 403, 200]


@pytest.mark.parametrize("kind", ["rest", "gateway"])
def test_a_page_may_link_to_what_holds_no_secret(kind: str) -> None:
    answer = asked(application(kind), OPEN[kind], ADDRESS, ("Sec-Fetch-Site", "cross-site"))
    assert answer.status == 200


@pytest.mark.parametrize("path", ["/health/live", "/health/ready"])
@pytest.mark.parametrize(
    "headers", [[("Host", "holdfast.default.svc:9464")], *[[ADDRESS, *each] for each in FOREIGN]]
)
def test_a_probe_is_answered_under_any_name_and_without_details(
    path: str, headers: list[tuple[str, str]]
) -> None:
    for kind in ("metrics", "gateway"):
        answer = asked(application(kind), path, *headers)
        assert (answer.status, answer.body) == (200, b'{"ok":true,"checks":{"logs":{"ok":true}}}')
    assert b"site: connected" in asked(application("metrics"), path, ADDRESS).body

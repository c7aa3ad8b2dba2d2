"""Refusals: a reason has one status, which handlers and documents take from one table."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from holdfast.adapters.rest.operations import OPERATIONS
from holdfast.adapters.rest.operations import document as rest_document
from holdfast.adapters.rest.refusals import REFUSALS as OF_REST
from holdfast.gateway import Settings
from holdfast.gateway.operations import document as gateway_document
from holdfast.gateway.refusals import FAILURE
from holdfast.gateway.refusals import REFUSALS as OF_GATEWAY
from holdfast.ingest import REFUSED_FOR_NOW
from holdfast.net.http.refusals import Refusal, Refusals, headers_with
from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterable

PACKAGE = ROOT / "python" / "holdfast"


def raised(*rooms: str) -> set[str]:
    """The reasons that the source of some rooms names where it refuses."""
    files = [file for room in rooms for file in sorted((PACKAGE / room).rglob("*.py"))]
    form = re.compile(r'\b(?:BadRequest|Declined|Refused|refusal)\(\s*"(\w+)"')
    return {reason for file in files for reason in form.findall(file.read_text())}


def statuses(responses: Iterable[str]) -> set[int]:
    return {int(status) for status in responses} - {200}


def test_every_reason_of_a_handler_has_a_status() -> None:
    assert raised("net/http", "gateway") == set(OF_GATEWAY.reasons)
    of_rest = {*raised("net/http", "adapters/rest", "ingest"), *REFUSED_FOR_NOW}
    # Only a broker delivers old messages.
    assert of_rest - {"stale_command"} == set(OF_REST.reasons)


def test_every_reason_of_a_failure_is_named() -> None:
    sources = "".join(file.read_text() for file in (PACKAGE / "gateway").glob("*.py"))
    found = set(re.findall(r'\bFailed\("(\w+)"', sources)) - {"unfinished"}  # Only of a stream.
    assert found <= set(FAILURE.reasons)


def test_a_reason_has_one_status() -> None:
    with pytest.raises(AssertionError, match="a reason has two statuses"):
        Refusals(Refusal(400, ("a", "b"), "", ""), Refusal(404, ("b",), "", ""))


def test_refusals_are_found_by_reason_each_status_once_and_in_order() -> None:
    found = OF_REST.of(["timeout", "out_of_range", "invalid_area", "unauthorized"])
    assert [row.status for row in found] == [400, 401, 408]
    assert OF_REST.status("unknown_memory") == 404
    with pytest.raises(KeyError):
        OF_REST.status("nobody_knows")


def test_a_status_has_its_headers() -> None:
    assert headers_with(401) == [(b"www-authenticate", b"Bearer")]
    assert headers_with(503) == [(b"retry-after", b"1")]
    assert headers_with(404) == []


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("ingest", {400, 403, 404, 405, 408, 409, 413, 415, 502, 503, 504}),
        ("read", {400, 403, 404, 405, 503}),
        ("changes", {400, 403, 404, 405, 503}),
        ("health", {405}),
        ("memories", {405}),
        ("stats", {405}),
        ("mqtt", {404, 405}),
        ("openapi", {405}),
        ("docs", {405}),
    ],
)
@pytest.mark.parametrize("secured", [True, False])
def test_the_document_of_rest_has_what_a_route_refuses(
    name: str, expected: set[int], secured: bool
) -> None:
    document = rest_document("1.0", 1024, secured=secured)
    [route] = [route for route in OPERATIONS if route.name == name]
    operation = document["paths"][route.path][route.method.lower()]
    asking = set() if route.is_public else {401, 403} if secured else {403}
    assert statuses(operation["responses"]) == expected | asking


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("/api/modbus/read", {400, 403, 405, 408, 413, 415, 500, 503}),
        ("/api/modbus/write/coil", {400, 403, 405, 408, 409, 413, 415, 500, 503}),
        ("/api/modbus/map", {400, 403, 405, 408, 413, 415, 500, 503}),
        ("/api/modbus/watch", {400, 403, 405, 500, 503}),
        ("/api/gateway", {403, 405}),
        ("/openapi.json", {405}),
    ],
)
@pytest.mark.parametrize("secured", [True, False])
def test_the_document_of_the_gateway_has_what_a_route_refuses(
    path: str, expected: set[int], secured: bool
) -> None:
    tokens = (("panel", b""),) if secured else ()
    document = gateway_document("1.0", Settings((), tokens=tokens))
    [operation] = document["paths"][path].values()
    asking = {401} if secured and path != "/openapi.json" else set()
    assert statuses(operation["responses"]) == expected | asking

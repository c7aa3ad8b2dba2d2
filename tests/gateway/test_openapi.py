"""The gateway's OpenAPI document: true of what a gateway answers to all sorts of requests."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import positive_data_acceptance

import holdfast
from holdfast import __version__
from holdfast.gateway import Settings, port_of_call
from holdfast.gateway.operations import document
from support import gateways
from support.cases import examples
from support.gateways import Dialed

if TYPE_CHECKING:
    from collections.abc import Iterator

    from schemathesis import Case
    from schemathesis.specs.openapi.schemas import OpenApiSchema

    from holdfast.client.async_transports import OwnTransport
    from holdfast.client.url import NetworkTarget
    from holdfast.config.models.services import Compat
    from support.gateways import Running

EXCLUDED: list[Any] = [
    # 500 says that there was no connection or no reply.
    not_a_server_error,
    # A schema takes 1.0 for an integer, and can't say that a type goes with a quantity.
    positive_data_acceptance,
]

ANY_TEXT = ("pattern", r"^[\s\S]*$")

DOCUMENT = document(__version__, Settings(()))
OPERATIONS = [
    (path, method.upper(), mode)
    for path, methods in DOCUMENT["paths"].items()
    for method, operation in methods.items()
    for mode in GenerationMode
    if "watch" not in path  # It does not end.
    if mode is GenerationMode.POSITIVE or "requestBody" in operation
]


class Everywhere(Dialed):
    """Leads to one and the same device, whoever is asked for."""

    def __init__(self, device: tuple[str, int]) -> None:
        super().__init__()
        self._device = device

    def __call__(self, target: NetworkTarget, in_flight: int) -> OwnTransport:
        host, port = self._device
        return super().__call__(replace(target, host=host, port=port), in_flight)


@contextlib.contextmanager
def serving(compat: Compat | None = None, **limits: float) -> Iterator[Running]:
    """A gateway for which all names and addresses are the same device."""

    async def anybody(_: str) -> list[str]:
        return ["127.0.0.1"]

    memory = holdfast.Memory(
        coils=65536,
        discrete_inputs=1000,
        holding_registers=65536,
        input_registers=1000,
        files={4: 100},
    )
    rule = holdfast.Rule(
        {1: memory, 0: memory}, sources=["127.0.0.1"], access="read-write", fifo={1: [1246]}
    )
    with (
        holdfast.Server(bind="127.0.0.1:0", rules=[rule]) as server,
        gateways.running(
            allow=["0.0.0.0/0:*"],
            resolve=anybody,
            dialed=Everywhere(server.address),
            limits={"discovery": 0.02, **limits},
            compat=compat,
        ) as running,
    ):
        yield running


@pytest.fixture(scope="module")
def gateway() -> Iterator[Running]:
    """A gateway that waits only briefly for devices that do not answer, and takes any body."""
    with serving(timeout=0.2, body=2**20) as running:
        yield running


@pytest.fixture(scope="module")
def lenient() -> Iterator[Running]:
    """As `gateway`, with requests and errors as of Port of Call."""
    with serving("port-of-call", timeout=0.2, body=2**20) as running:
        yield running


def schema_of(gateway: Running) -> OpenApiSchema:
    """The document, without the pattern of any text: the generator counts with it for seconds."""

    def plain(each: dict[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in each.items() if (key, value) != ANY_TEXT}

    text = gateway.client().get("/openapi.json").body
    return schemathesis.openapi.from_dict(json.loads(text, object_hook=plain))


@pytest.fixture(scope="module")
def schema(gateway: Running) -> OpenApiSchema:
    return schema_of(gateway)


@pytest.fixture(scope="module")
def lenient_schema(lenient: Running) -> OpenApiSchema:
    return schema_of(lenient)


def check_answers(gateway: Running, operation: Any, mode: GenerationMode, count: int) -> None:
    """Compares the answers to `count` generated requests with the document."""

    @settings(
        max_examples=examples(count),
        database=None,
        phases=[Phase.explicit, Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=operation.as_strategy(generation_mode=mode))
    def asked(case: Case[Any]) -> None:
        response = case.call_and_validate(base_url=gateway.url, excluded_checks=EXCLUDED)
        assert response.headers.get("holdfast-reason") != ["internal_error"]

    asked()


@pytest.mark.parametrize(("path", "method", "mode"), OPERATIONS)
def test_what_is_answered_is_what_the_document_says(
    gateway: Running, schema: OpenApiSchema, path: str, method: str, mode: GenerationMode
) -> None:
    check_answers(gateway, schema[path][method], mode, 25)


@pytest.mark.parametrize("mode", GenerationMode)
@pytest.mark.parametrize("path", sorted(port_of_call.PATHS))
def test_what_port_of_call_is_answered_is_what_the_document_says(
    lenient: Running, lenient_schema: OpenApiSchema, path: str, mode: GenerationMode
) -> None:
    check_answers(lenient, lenient_schema[path]["POST"], mode, 10)


def test_every_request_of_a_device_may_have_tls() -> None:
    for path, methods in DOCUMENT["paths"].items():
        if not path.startswith(gateways.API):
            continue
        [operation] = methods.values()
        if "requestBody" in operation:
            content = operation["requestBody"]["content"]
            fields = content["application/json"]["schema"]["properties"]
        else:
            fields = {each["name"]: each["schema"] for each in operation["parameters"]}
        assert "tls" in fields["transport"]["enum"], path
        assert fields["serverName"]["type"] == "string", path


@pytest.mark.parametrize(("path", "most"), [("/write/registers", 123), ("/write/coils", 1968)])
def test_an_answer_has_no_larger_quantity_than_its_request(path: str, most: int) -> None:
    answers = DOCUMENT["paths"][gateways.API + path]["post"]["responses"]["200"]["content"]
    properties, *_ = answers["application/json"]["schema"]["oneOf"]
    assert properties["properties"]["quantity"]["maximum"] == most


@pytest.fixture
def default_gateway() -> Iterator[Running]:
    with serving() as running:
        yield running


def test_every_example_is_answered_as_the_document_says(default_gateway: Running) -> None:
    document = default_gateway.client().get("/openapi.json").json
    for path, methods in document["paths"].items():
        if "post" not in methods:
            continue
        answers = methods["post"]["responses"]["200"]["content"]
        if "text/event-stream" in answers:
            continue
        content = methods["post"]["requestBody"]["content"]["application/json"]
        for example in content["examples"].values():
            answer = default_gateway.client().ask("POST", path, example["value"])
            assert (answer.status, answer.json["success"]) == (200, True), (path, answer.json)
        told = answers["application/json"]
        properties, *_ = told["schema"].get("oneOf", [told["schema"]])
        assert set(properties["required"]) <= set(told["example"])
        assert set(told["example"]) <= set(properties["properties"])


def test_the_page_has_every_route_and_needs_nothing(gateway: Running) -> None:
    answer = gateway.client().get("/docs")
    text = answer.body.decode()
    assert answer.headers["content-type"].startswith("text/html")
    assert "<script" not in text
    for path in DOCUMENT["paths"]:
        assert f"<code>GET {path}</code>" in text or f"<code>POST {path}</code>" in text
    assert f"curl {gateway.url}/api/modbus/read" in text

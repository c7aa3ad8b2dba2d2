"""An HTTP application: answers requests by its table of operations."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from holdfast.net.http import openapi_page as page
from holdfast.net.http.bearer import owner
from holdfast.net.http.fields import from_query
from holdfast.net.http.openapi import html_answer, json_answer
from holdfast.net.http.operations import Operation
from holdfast.net.http.refusals import UNREAD, headers_with
from holdfast.net.http.requests import JSON, SAFE, BadRequest, Response, response, shown
from holdfast.runtime import tasks

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

    from holdfast.net.http.host_and_origin import Origins
    from holdfast.net.http.operations import Body, Given, Later
    from holdfast.net.http.requests import Request, SecondStep

JUDGED = "judged"
"""The key of the judgement in `Request.kept`."""


class _Judged(NamedTuple):
    """A head without fault, by the tokens and rules of an application, which never change."""

    operation: Operation[Any]
    who: str
    parameters: Given


class Application:
    """Routes a request, checks who sends it, reads its parameters or its body, and answers it.

    A subclass has the handlers, and says how a refusal looks.
    """

    def __init__(
        self,
        operations: Iterable[Operation[Any]],
        origins: Origins,
        *,
        tokens: Iterable[tuple[str, bytes]] = (),
        anyone: str = "-",
        max_body: int = 0,
    ) -> None:
        """`tokens`: names and SHA-256; without them, the sender has the name `anyone`."""
        self.routes: dict[str, Operation[Any]] = {each.path: each for each in operations}
        self.origins = origins
        self._loop: asyncio.AbstractEventLoop | None = None
        self._tokens = tuple(tokens)
        self._anyone = anyone
        self.max_body = max_body
        self._document = self._page = b""

    def __call__(self, request: Request) -> Response | Later:
        """Answers one request; at once, unless its body still arrives or something must wait."""
        self._loop = asyncio.get_running_loop()
        try:
            answer = self._answer(request)
        except Exception as error:
            return self._refusal(request, error)
        if isinstance(answer, Response):
            return answer
        if callable(answer):
            return partial(self._second_step, request, answer)
        return self._finished(request, answer)

    def _second_step(self, request: Request, step: SecondStep) -> Response:
        try:
            return step()
        except Exception as error:
            return self._refusal(request, error)

    async def _finished(
        self, request: Request, answer: Awaitable[Response | None]
    ) -> Response | None:
        try:
            return await answer
        except Exception as error:
            return self._refusal(request, error)

    def call_soon(self, function: Callable[[], object]) -> None:
        """Calls a function in the thread of the application. Thread-safe."""
        if self._loop is not None:
            tasks.call_soon(self._loop, function)

    # What a subclass has.

    def error_response(self, request: Request, error: Exception) -> Response:
        """Returns the response to what a handler raised. Raises it if it is no refusal."""
        raise NotImplementedError

    def nowhere(self, path: str) -> str:
        """Returns the error for a path without an operation."""
        return f"no resource at {shown(path)}"

    def not_allowed(self, operation: Operation[Any]) -> str:
        """Returns the error for another method."""
        return f"allowed: {operation.methods}"

    def check_type(self, request: Request) -> None:
        """Raises `BadRequest` for a body that is not JSON by its type, or has a query beside it."""
        request.check_json()
        request.check_no_query()

    # Steps.

    def _answer(self, request: Request) -> Response | Later:
        judged = request.kept.get(JUDGED)
        if judged is None:
            self.origins.check_host(request)
            operation = self.routes.get(request.path)
            if operation is None:
                raise BadRequest("not_found", self.nowhere(request.path))
            head = request.method == "HEAD" and operation.method == "GET" and operation.has_head
            if request.method != operation.method and not head:
                return self._other_method(request, operation)
            judged = request.kept[JUDGED] = self._judged(request, operation)
        operation, request.who, parameters = judged
        if operation.body is None:
            return operation.handler(self, request, parameters)
        body = request.arrived(self.max_body)
        if body is None:
            return self._arriving(operation, operation.body, request)
        return operation.handler(self, request, operation.body.parse(request, body))

    def _judged(self, request: Request, operation: Operation[Any]) -> _Judged:
        """Judges all of a head but the length of the body. Raises `BadRequest`."""
        if not operation.is_public:
            self.origins.check(request)
            request.who = owner(request, self._tokens) if self._tokens else self._anyone
        if operation.check is not None:
            operation.check(self, request)
        parameters: Given = {}
        if operation.body is not None:
            self.check_type(request)
        elif operation.parameters:
            parameters = from_query(request.query, operation.parameters)
        return _Judged(operation, request.who, parameters)

    async def _arriving(
        self, operation: Operation[Any], body: Body, request: Request
    ) -> Response | None:
        fields = body.parse(request, await request.body(self.max_body))
        answer = operation.handler(self, request, fields)
        if isinstance(answer, Response):
            return answer
        return answer() if callable(answer) else await answer

    def _other_method(self, request: Request, operation: Operation[Any]) -> Response:
        if request.method == "OPTIONS":
            answer = Response(204, headers=SAFE)
        else:
            error = BadRequest("method_not_allowed", self.not_allowed(operation))
            answer = self._refusal(request, error)
        answer.headers = (*answer.headers, (b"allow", operation.methods.encode()))
        return answer

    def _refusal(self, request: Request, error: Exception) -> Response:
        answer = self.error_response(request, error)
        answer.headers = (*answer.headers, *headers_with(answer.status))
        answer.closes = answer.status in UNREAD or request.header(b"expect") is not None
        return answer

    # The document and its page.

    def describe(self, document: dict[str, Any], url: str) -> None:
        """Sets the OpenAPI document, and the base URL of the examples in its page."""
        self._document, self._page = msgspec.json.encode(document), page.render(document, url)

    def send_document(self, _: Request, __: Given) -> Response:
        """Answers with the OpenAPI document."""
        return response(JSON, self._document)

    def send_page(self, _: Request, __: Given) -> Response:
        """Answers with the document as a web page."""
        return response(page.KIND, self._page, (b"content-security-policy", page.POLICY))


def json_response(document: Any, *more: tuple[bytes, bytes], status: int = 200) -> Response:
    """Returns a response in JSON; values of other types are as their text."""
    return response(JSON, msgspec.json.encode(document, enc_hook=str), *more, status=status)


DOCUMENTS: tuple[Operation[Application], ...] = (
    Operation(
        "GET",
        "/openapi.json",
        "openapi",
        "Get this document",
        Application.send_document,
        json_answer("The OpenAPI 3.1 document", {"type": "object"}),
        is_public=True,
    ),
    Operation(
        "GET",
        "/docs",
        "docs",
        "Get this document as a web page",
        Application.send_page,
        html_answer(),
        is_public=True,
    ),
)
"""The operations for the OpenAPI document."""

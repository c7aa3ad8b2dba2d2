"""Operations: what an HTTP application offers.

An operation is a row of the application's table: its route, its parameters or its body, its
answers, its refusals, and the function that carries it out. `application` routes and validates by
the table, `openapi` makes the document from it.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeAlias, TypeVar

from holdfast.net.http.fields import from_json, object_with
from holdfast.net.http.requests import Request, Response, SecondStep

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from holdfast.net.http.fields import Field
    from holdfast.net.http.refusals import Refusal
    from holdfast.net.http.schemas import Schema

MAX_PARSED = 64
"""Parsed bodies kept for each operation."""

MAX_PARSED_BYTES = 1024
"""The largest body that is kept in its parsed form."""

App = TypeVar("App", contravariant=True)
Later: TypeAlias = SecondStep | Awaitable[Response | None]
Given: TypeAlias = Any
"""The parameters by name, or what the body was parsed as."""


@dataclass(frozen=True)
class Body:
    """A required JSON body."""

    schema: Schema
    examples: Mapping[str, Any]
    """Example requests by title."""
    parse: Callable[[Request, bytes], Given] = lambda _, body: body
    """Returns what the handler gets. Raises `BadRequest`."""


def body_of(fields: Sequence[Field], examples: Mapping[str, Any]) -> Body:
    """Returns the body that is an object with these fields."""

    def parse(body: bytes) -> Mapping[str, Any]:
        return from_json(body, fields)

    # Pollers repeat the same body, and parsing takes as long as the answer. Requests share the
    # parsed body: a handler must not change it.
    known = lru_cache(MAX_PARSED)(parse)
    return Body(
        object_with(fields),
        examples,
        lambda _, body: (known if len(body) <= MAX_PARSED_BYTES else parse)(body),
    )


@dataclass(frozen=True)
class Operation(Generic[App]):
    """A path and its method. GET includes HEAD."""

    method: Literal["GET", "POST"]
    path: str
    name: str
    """The `operationId`."""
    summary: str
    handler: Callable[[App, Request, Given], Response | Later]
    answer: dict[str, Any] | None = None
    """The OpenAPI response of status 200; `None`: the document does not have the operation."""
    refusals: Sequence[str] = ()
    """The reasons of refusals that not all operations have."""
    description: str = ""
    parameters: Sequence[Field] = ()
    headers: Sequence[Field] = ()
    """Headers that the handler checks."""
    body: Body | None = None
    check: Callable[[App, Request], None] | None = None
    """Raises `BadRequest` for a client without the right to the operation, before its body is
    received."""
    is_public: bool = False
    """Whether anyone may call it: no token is required, and pages of other sites may link to it."""
    has_head: bool = True
    failures: Sequence[Refusal] = ()
    """Further error responses: the request was accepted, but could not be carried out."""

    @property
    def methods(self) -> str:
        """The methods that the path supports."""
        head = ", HEAD" if self.method == "GET" and self.has_head else ""
        return f"{self.method}{head}, OPTIONS"

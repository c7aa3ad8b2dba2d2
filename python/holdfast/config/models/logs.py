"""The model of a log of writes, which several appliances share."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, Strict, model_validator

from holdfast._core import MAX_LAG_S, WRITE_TIMEOUT_S
from holdfast.config.models.services import NatsServersConfig
from holdfast.config.values.scalars import (
    FilePath,
    HttpUrl,
    Name,
    NatsUrl,
    NotNull,
    integral,
    seconds,
    whole_number,
)

EMBEDDED_URL = "nats://127.0.0.1:4222"
"""Where an embedded server listens, unless servers says otherwise."""

TOKEN_FILE = "token"
"""The file with the secret of an embedded server, in its folder, unless the log has another one."""

Seconds = Annotated[float, seconds(0.05, 3600), whole_number]


class SharedLogConfig(NatsServersConfig):
    """A log in NATS JetStream: nodes that share it have the same contents of their memories."""

    own_files = ("embedded",)

    servers: Annotated[tuple[NatsUrl, ...], Strict(False), Field(min_length=1)] = ()
    """The NATS servers: nats://host:port or tls://host:port; optional with embedded, whose only
    entry is where the embedded server listens."""
    monitoring: Annotated[tuple[HttpUrl, ...], Strict(False)] = ()
    """Where the NATS servers answer HTTP (their key http): at its start, the appliance warns of
    those that a power cut may cost what they have confirmed."""
    embedded: Annotated[FilePath | None, NotNull()] = None
    """The folder of a NATS server that is started with the appliance; requires nats-server."""
    node: Name
    """The name of this appliance in the log; unique."""
    replicas: Annotated[Literal[1, 3, 5], BeforeValidator(integral)] = 1
    """On how many servers each write is, when it is confirmed."""
    write_timeout: Seconds = WRITE_TIMEOUT_S
    """Seconds until a write that the log has not confirmed is answered with exception 04."""
    when_behind: Literal["serve", "refuse"] = "serve"
    """What happens to reads without contact to the log for max_lag seconds: they are served from
    the contents of this node, however old these are, or get exception 06."""
    max_lag: Seconds = MAX_LAG_S
    """Seconds without contact to the log."""

    @property
    def makes_token(self) -> bool:
        """Whether the embedded server makes the file of its token."""
        return self.embedded is not None and self.token_file == self.embedded / TOKEN_FILE

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, data: object) -> object:
        """Adds where an embedded server is, and the token that it makes, unless they are given."""
        if not isinstance(data, dict) or not isinstance(data.get("embedded"), str):
            return data
        token = {} if "username" in data else {"token_file": f"{data['embedded']}/{TOKEN_FILE}"}
        return {"servers": [EMBEDDED_URL], **token, **data}

"""The model of a log of writes, which several appliances share."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from holdfast.config.scalars import Name, whole_number
from holdfast.config.services import NatsServersConfig

Seconds = Annotated[float, Field(ge=0.05, le=3600, allow_inf_nan=False), whole_number]


class SharedLogConfig(NatsServersConfig):
    """A log in NATS JetStream: nodes that share it have the same contents of their memories."""

    node: Name
    """The name of this appliance in the log; unique."""
    replicas: Literal[1, 3, 5] = 1
    """On how many servers each write is, when it is confirmed."""
    write_timeout: Seconds = 1.0
    """Seconds until a write that the log has not confirmed is answered with exception 04."""
    when_behind: Literal["serve", "refuse"] = "serve"
    """What happens to reads without contact to the log for max_lag seconds: they are served from
    the contents of this node, or get exception 06."""
    max_lag: Seconds = 5.0
    """Seconds without contact to the log."""

"""Runs a bare ASGI application on uvicorn: the peer of REST and the gateway.

It parses the JSON of a request with msgspec into a type of its own. A write is answered with what
it says, a read with the JSON of its path; the file in the second argument has these answers. The
first argument is the event loop.
"""

from __future__ import annotations

import json
import socket
import sys
from pathlib import Path
from typing import Any, Literal

import msgspec
import uvicorn


class Command(msgspec.Struct, forbid_unknown_fields=True):
    """A write over REST."""

    memory: str
    area: Literal["holding_registers"]
    address: int
    values: list[int]


class Read(msgspec.Struct, forbid_unknown_fields=True):
    """A read through the gateway."""

    host: str
    port: int
    functionCode: int
    address: int
    quantity: int


TYPES: dict[str, Any] = {"/api/v1/ingest": Command, "/api/modbus/read": Read}
DECODERS = {path: msgspec.json.Decoder(type) for path, type in TYPES.items()}
ANSWERS = json.loads(Path(sys.argv[2]).read_text())
ENCODER = msgspec.json.Encoder()


async def answer(scope: Any, receive: Any, send: Any) -> None:
    """Parses a request, and answers it."""
    path = scope["path"]
    told = ANSWERS[path]
    if scope["method"] == "POST":
        body, more = b"", True
        while more:
            message = await receive()
            body, more = body + message["body"], message["more_body"]
        asked = DECODERS[path].decode(body)
        if type(asked) is Command:
            written = len(asked.values)
            told = {"status": "accepted", "memory": asked.memory, "written": written}
    reply = ENCODER.encode(told)
    length = b"%d" % len(reply)
    headers = [(b"content-type", b"application/json"), (b"content-length", length)]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": reply})


# With the protocol, asyncio sends small pieces at once.
with socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP) as listener:
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    host, port = listener.getsockname()
    print(f"listening {host}:{port}", flush=True)
    loop: Any = sys.argv[1]
    config = uvicorn.Config(
        answer,
        loop=loop,
        http="httptools",
        ws="none",
        lifespan="off",
        interface="asgi3",
        log_config=None,
        access_log=False,
        proxy_headers=False,
        server_header=False,
    )
    uvicorn.Server(config).run(sockets=[listener])

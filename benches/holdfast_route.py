"""Passes requests on to a device: URL, requests in flight, equal reads `together` or `apart`."""

from __future__ import annotations

import sys

from holdfast import _core
from holdfast.client.endpoint import endpoint
from holdfast.client.url import parse
from holdfast.server.options import STREAM_DEFAULTS

poller = _core.Poller([])
url, in_flight, reads = sys.argv[1:]
coalesce = reads == "together"
link = poller.link(endpoint(parse(url)), in_flight=int(in_flight), coalesce=coalesce)
rule = _core.Rule(
    {1: link.route("device", timeout=1.0)}, sources=["127.0.0.1"], access="read-write"
)
engine = _core.Engine(
    [_core.Listener("front", "127.0.0.1:0", [rule], STREAM_DEFAULTS)],
    identity=[(0, "Holdfast"), (1, "HF"), (2, "1")],
    unit_names=[],
    workers=1,
)
((host, port),) = filter(None, engine.addresses)
print(f"listening {host}:{port}", flush=True)
sys.stdin.read()

"""Whatever a request of NATS holds: a request of the right types, or a refusal."""

from __future__ import annotations

import json

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from holdfast.scanner.dialects import DIALECTS
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.decoding import Adjustments, decode, decode_lenient
from holdfast.scanner.messages.types import SubscribeRequest, TagRequest, UnsubscribeRequest
from support.cases import examples

MAX_BYTES = 10_000

scalars = (
    st.none()
    | st.booleans()
    | st.integers(-1, 70000)
    | st.integers()
    | st.floats(allow_nan=False)
    | st.sampled_from(["plc", "holding", "uint16", "tcp", "1", "5.0", "", "all", "scan"])
    | st.text(max_size=5)
)
anything = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner),
    max_leaves=6,
)


def objects(*kinds: type[msgspec.Struct], **more: st.SearchStrategy[object]) -> st.SearchStrategy:
    """Objects with keys of these requests, and values of any kind."""
    keys = [field.encode_name for kind in kinds for field in msgspec.structs.fields(kind)]
    pairs = st.tuples(st.sampled_from([*keys, "registers", "tag"]), scalars | anything)
    lists = [st.tuples(st.just(key), value) for key, value in more.items()]
    return st.lists(st.one_of(pairs, *lists), max_size=12).map(dict)


tags = objects(TagRequest)
requests = objects(
    SubscribeRequest,
    UnsubscribeRequest,
    tags=st.lists(tags | anything, max_size=3),
    registers=st.lists(tags | anything, max_size=3),
)
bodies = (requests | anything).map(lambda body: json.dumps(body).encode()) | st.binary(max_size=60)


@settings(max_examples=examples(60))
@example(body=b"[" * 9_000, lenient=True)
@example(body=b'{"tags":' * 1_000, lenient=True)
@given(body=bodies, lenient=st.booleans())
@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("kind", [SubscribeRequest, UnsubscribeRequest])
def test_a_request_is_of_its_types_or_refused(
    dialect: str, kind: type[SubscribeRequest], body: bytes, lenient: bool
) -> None:
    normalize = DIALECTS[dialect].normalize  # type: ignore[index]
    try:
        request = decode_lenient(body, kind, MAX_BYTES, Adjustments(lenient), normalize)
    except Refused:
        return
    # What is sent again is the same request, and exact.
    assert decode(msgspec.json.encode(request), kind, 10 * MAX_BYTES) == request

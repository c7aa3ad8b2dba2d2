"""`holdfast describe identify`, as people and programs use it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.server import Identity
from support import cli
from support.cli import answer, done, failure
from support.fake_device import HANG_UP, FakeDevice, exception

if TYPE_CHECKING:
    import holdfast
    from support.running import Serve

SERVER_ID = bytes([17, 4, 9, 0, 0x1B, 0xFF])


def test_a_device_says_who_it_is(memory: holdfast.Memory, serve: Serve) -> None:
    identity = Identity(vendor_name="Acme", product_code="P", revision="2", model_name="Größe 7")
    server = serve({3: memory}, identity=identity)
    text = "\n".join(done("describe", "identify", cli.url(server), "--unit", "3"))
    assert "  vendor name       Acme\n  product code      P\n  revision          2\n" in text
    assert "  model name        Größe 7\n" in text
    assert "  running    yes\n" in text
    found = answer("describe", "identify", cli.url(server), "--unit", "3")
    assert found["identification"]["vendor_name"] == "Acme"
    assert found["identification"]["objects"]["1"] == "50"
    assert found["server_id"]["running"] is True


def test_one_answer_is_enough() -> None:
    def only_17(pdu: bytes) -> bytes:
        return SERVER_ID if pdu[0] == 17 else exception(pdu, 1)

    with FakeDevice(only_17) as device:
        lines = done("describe", "identify", device.url)
        found = answer("describe", "identify", device.url)
    assert lines == [
        "Device identification (function 43/14)",
        "  exception 01 (Illegal Function)",
        "",
        "Server id (function 17)",
        "  server id  9",
        "  running    no",
        "  bytes      09 00 1b ff",
    ]
    assert found["ok"] is True
    assert (found["identification"]["ok"], found["identification"]["code"]) == (False, 1)
    assert found["server_id"]["data"] == "09001bff"


def test_a_device_that_hangs_up_at_one_function_is_asked_for_the_other() -> None:
    with FakeDevice(lambda pdu: SERVER_ID if pdu[0] == 17 else HANG_UP) as device:
        found = answer("describe", "identify", device.url)
    assert found["identification"]["reason"] == "connection"
    assert found["server_id"]["server_id"] == 9


def test_text_can_do_the_terminal_no_harm() -> None:
    identification = bytes([43, 14, 1, 1, 0, 0, 1, 0, 5]) + b"\x1b[2JA"

    with FakeDevice(
        lambda pdu: identification if pdu[0] == 43 and pdu[2] == 1 else exception(pdu, 3)
    ) as device:
        lines = done("describe", "identify", device.url)
    assert "  vendor name       \\x1b[2JA" in lines


def test_no_answer_is_a_failure() -> None:
    with FakeDevice(lambda pdu: exception(pdu, 1)) as device:
        assert failure("describe", "identify", device.url) == [
            f"holdfast: {device.url}: function 43/14: exception 01 (Illegal Function)",
            f"holdfast: {device.url}: function 17: exception 01 (Illegal Function)",
        ]
        assert answer("describe", "identify", device.url, code=1)["ok"] is False

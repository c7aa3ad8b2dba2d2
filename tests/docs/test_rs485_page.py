"""The page about RS-485: what commands print for each fault of a line."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from holdfast.client.url import parse
from support import lines
from support.cli import invoke
from support.fake_device import Asked, Serial, exception, silent
from support.paths import DOCS

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

PAGE = (DOCS / "rs485.md").read_text()
TIMEOUT = ("--timeout", "0.1")


def cut_off(asked: Asked) -> None:
    asked.send(asked.frame()[:5])


def noise(asked: Asked) -> None:
    asked.send(b"\x00\xff\x13\x80")


def damaged(asked: Asked) -> None:
    *most, last = asked.frame()
    asked.send(bytes([*most, last ^ 0x10]))


def two_at_once(asked: Asked) -> None:
    frame = asked.frame()
    asked.send(bytes(one | other for one, other in zip(frame, reversed(frame), strict=True)))


def of_another_unit(asked: Asked) -> None:
    asked.answer(unit=9)


def without_the_address(asked: Asked) -> None:
    asked.answer(exception(asked.pdu, 2))


def echo(asked: Asked) -> None:
    asked.send(asked.raw)


def echo_and_reply(asked: Asked) -> None:
    asked.send(asked.raw, asked.frame())


FAULTS: list[tuple[Callable[[Asked], None], str]] = [
    (silent, "no reply within"),
    (cut_off, "no complete reply within"),
    (noise, "the checksum is wrong"),
    (damaged, "the checksum is wrong"),
    (two_at_once, "the frame is too short or too long"),
    (of_another_unit, "reply from unit 9 to a request to unit 1"),
    (without_the_address, "exception 02 (Illegal Data Address)"),
]


@pytest.mark.parametrize(("fault", "message"), FAULTS)
def test_a_fault_has_the_message_of_the_page(
    fault: Callable[[Asked], None], message: str, tmp_path: Path
) -> None:
    assert f"| `{message}" in PAGE
    with Serial(lines.RTU, tmp_path / "line", then=fault) as device:
        result = invoke("read", device.url, "hr", "0", "2", *TIMEOUT)
    assert result.exit_code == 1
    assert message in result.stderr


def test_a_line_that_is_not_there_has_the_message_of_the_page(tmp_path: Path) -> None:
    result = invoke("read", f"rtu://{tmp_path}/line", "hr", "0")
    assert "can't connect to" in result.stderr
    assert "No such file or directory" in result.stderr


def test_an_echo_confirms_a_write_unless_it_is_read_back(tmp_path: Path) -> None:
    with Serial(lines.RTU, tmp_path / "line", then=echo) as device:
        write = ("write", device.url, "hr", "0", "7", *TIMEOUT)
        assert invoke(*write).exit_code == 0
        assert invoke(*write, "--verify").exit_code == 1
    with Serial(lines.RTU, tmp_path / "other", then=echo_and_reply) as device:
        assert invoke("read", device.url, "hr", "0", "2").exit_code == 0


@pytest.mark.parametrize("url", sorted(set(re.findall(r"rtu://[^\s'`]+\w", PAGE))))
def test_every_url_is_valid(url: str) -> None:
    assert parse(url)

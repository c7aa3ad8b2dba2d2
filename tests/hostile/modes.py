"""The vices of devices: what each sends, and when, after a request.

What no client can tell from a correct device says so, with the reason; docs/client.md lists it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from hostile.devices import Action, Turn, other

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from hostile.devices import Vice

MS = 0.001
PIECE = 0.7 * MS
DATAGRAMS = ("udp", "rtu+udp")


@dataclass(frozen=True)
class Mode:
    """A vice, and what its clients can reach."""

    vice: Vice
    fails: Callable[[str], bool] = lambda _kind: False
    """Whether all reads may fail on this transport."""
    is_undetectable: Callable[[str], bool] = lambda _kind: False
    """Whether no client can tell its replies from right ones on this transport."""
    reason: str = ""
    """Why."""


def late(factor: float) -> Vice:
    """All replies come after this many times the timeout."""
    return lambda turn: [turn.reply(factor * turn.timeout)]


def between(least: float, most: float) -> Vice:
    """All replies come after a random time between these many times the timeout."""
    return lambda turn: [turn.reply(turn.random.uniform(least, most) * turn.timeout)]


def slowly(vice: Vice) -> Vice:
    """All of it comes a fifth of the timeout later."""
    return lambda turn: [
        replace(action, after=action.after + turn.timeout / 5) for action in vice(turn)
    ]


def sometimes(rare: Vice, every: int = 3) -> Vice:
    """Every so many requests are treated in a rare way, the others well."""
    return lambda turn: rare(turn) if turn.number % every == 0 else [turn.reply()]


def once(rare: Vice, number: int) -> Vice:
    """One request is treated in a rare way, the others well."""
    return lambda turn: rare(turn) if turn.number == number else [turn.reply()]


def copies(*gaps: float, late: float = 0.0) -> Vice:
    """All replies come several times, these times after each other."""

    def vice(turn: Turn) -> Iterable[Action]:
        first = turn.reply(late * turn.timeout)
        times = [first.after + sum(gaps[:number]) for number in range(1, len(gaps) + 1)]
        return [first, *[Action(at, first.data) for at in times]]

    return vice


def instead(pdu: Callable[[Turn], bytes]) -> Vice:
    """Another reply comes in the place of the right one."""
    return lambda turn: [Action(0.0, pdu(turn))]


def before(pdu: Callable[[Turn], bytes], gap: float) -> Vice:
    """Another reply comes first."""
    return lambda turn: [Action(0.0, pdu(turn)), turn.reply(gap)]


def half_a_timeout(pdu: Callable[[Turn], bytes]) -> Vice:
    """Another reply comes first, and its own half a timeout later."""
    return lambda turn: before(pdu, turn.timeout / 2)(turn)


def after(pdu: Callable[[Turn], bytes], gap: float) -> Vice:
    """Another reply follows."""
    return lambda turn: [turn.reply(), Action(gap, pdu(turn))]


def joined(*parts: Callable[[Turn], bytes]) -> Vice:
    """All parts come at once."""

    def vice(turn: Turn) -> Iterable[Action]:
        whole = b"".join(part(turn) for part in parts)
        return [Action(0.0, whole, turn.reply().executes)]

    return vice


def in_pieces(turn: Turn) -> Iterable[Action]:
    """The reply comes byte by byte, after those before it."""
    reply = turn.reply()
    assert reply.data is not None
    now = time.monotonic()
    begins = max(turn.device.busy - now, 0.0)
    pieces = [reply.data[at : at + 1] for at in range(len(reply.data))]
    last = len(pieces) - 1
    turn.device.busy = now + begins + PIECE * len(pieces)
    return [
        Action(begins + PIECE * at, piece, reply.executes and at == last)
        for at, piece in enumerate(pieces)
    ]


def keeping(released: Callable[[Turn, bytes], Iterable[Action]], every: int = 3) -> Vice:
    """Some replies are kept until the next request comes."""

    def vice(turn: Turn) -> Iterable[Action]:
        if turn.number % every == 0:
            turn.device.kept.append(turn.frame())
            return []
        kept, turn.device.kept = b"".join(turn.device.kept), []
        return released(turn, kept) if kept else [turn.reply()]

    return vice


def right(turn: Turn) -> bytes:
    return turn.frame()


def begun(turn: Turn) -> bytes:
    """The first half of the reply."""
    frame = turn.frame()
    return frame[: len(frame) // 2]


def nearly_all(turn: Turn) -> bytes:
    """The reply without its last two bytes."""
    return turn.frame()[:-2]


def echo(turn: Turn) -> bytes:
    return turn.raw


def half_an_echo(turn: Turn) -> bytes:
    return turn.raw[:5]


def of_another_unit(turn: Turn) -> bytes:
    return turn.frame(unit=turn.unit + 1)


def of_another_function(turn: Turn) -> bytes:
    return turn.frame(bytes([turn.answer[0] ^ 7]) + turn.answer[1:])


def longer(turn: Turn) -> bytes:
    """The reply to a read of one more register."""
    if turn.is_write:
        return turn.frame(turn.answer + b"\0")
    return turn.frame(turn.answer[:1] + bytes([turn.answer[1] + 2]) + turn.answer[2:] + b"\0\0")


def shorter(turn: Turn) -> bytes:
    """The reply to a read of one register less."""
    if turn.is_write:
        return turn.frame(turn.answer[:-1])
    return turn.frame(turn.answer[:1] + bytes([turn.answer[1] - 2]) + turn.answer[2:-2])


def damaged(turn: Turn) -> bytes:
    """The reply with a wrong CRC or LRC; with frames that have neither, with a wrong length."""
    frame = bytearray(turn.frame())
    if turn.device.has_ids:
        frame[5] ^= 1
    else:
        frame[-3 if turn.device.kind.startswith("ascii") else -1] ^= 1
    return bytes(frame)


def of_another_transaction(turn: Turn) -> bytes:
    """The reply to another address, with another transaction id where there is one."""
    answer = turn.answer if turn.is_write else other(turn.answer)
    return turn.frame(answer, transaction=turn.transaction ^ 0x5A5A)


def of_another_protocol(turn: Turn) -> bytes:
    frame = turn.frame()
    return frame[:2] + b"\0\1" + frame[4:] if turn.device.has_ids else frame[:-1]


def exception(code: int) -> Callable[[Turn], bytes]:
    return lambda turn: turn.exception(code)


def stray(data: bytes) -> Callable[[Turn], bytes]:
    return lambda _turn: data


def closing(vice: Vice, after: float = 0.0) -> Vice:
    """The connection ends after the last action."""

    def closes(turn: Turn) -> Iterable[Action]:
        actions = list(vice(turn))
        end = max((action.after for action in actions), default=0.0)
        return [*actions, Action(end + after, None)]

    return closes


def on_the_next_connection(factor: float) -> Vice:
    """The connection ends without a reply, which comes on the next one."""
    return lambda turn: [Action(0.0, None), turn.reply(factor * turn.timeout)]


def silent_at(address: int) -> Vice:
    """One address is never answered."""
    return lambda turn: [] if turn.address == address else [turn.reply()]


def flood(count: int, part: Callable[[Turn], bytes]) -> Vice:
    """Many copies follow a reply, one each millisecond."""
    return lambda turn: [
        turn.reply(),
        *[Action(MS * number, part(turn)) for number in range(1, count + 1)],
    ]


def echo_of_a_write(turn: Turn) -> Iterable[Action]:
    """A write is sent back, and not executed."""
    return [Action(0.0, turn.raw)] if turn.is_write else [turn.reply()]


def of_another_address(turn: Turn) -> bytes:
    return turn.frame() if turn.is_write else turn.frame(other(turn.answer))


def guessed(turn: Turn) -> bytes:
    """The reply to another address, with the next transaction id."""
    answer = turn.answer if turn.is_write else other(turn.answer)
    return turn.frame(answer, transaction=turn.transaction + 1)


def is_datagrams(kind: str) -> bool:
    return kind in DATAGRAMS


def has_ids(kind: str) -> bool:
    return kind in ("tcp", "udp")


def has_no_ids(kind: str) -> bool:
    return not has_ids(kind)


def is_udp(kind: str) -> bool:
    return kind == "udp"


def is_tcp(kind: str) -> bool:
    return kind == "tcp"


def always(_kind: str) -> bool:
    return True


LATE = {
    "late: 0.9": Mode(late(0.9), always),
    "late: 1.1": Mode(late(1.1), always),
    "late: 1.3": Mode(late(1.3), always),
    "late: 2.2": Mode(late(2.2), always),
    "late: 0.5 to 1.5": Mode(between(0.5, 1.5), always),
    "late: 0.95 to 1.05": Mode(between(0.95, 1.05), always),
    "late: 1.1 to 2.2": Mode(between(1.1, 2.2), always),
    "late: once": Mode(once(late(1.3), 6)),
    "late: a third": Mode(sometimes(between(1.1, 2.2))),
    "late: a third, others slow": Mode(
        lambda turn: [turn.reply((2.0 if turn.number % 3 == 0 else 0.4) * turn.timeout)]
    ),
    "late: 3.5": Mode(
        late(3.5),
        always,
        has_no_ids,
        "nobody waits for it any longer",
    ),
    "slow: 0.4": Mode(late(0.4)),
}

TWICE = {
    "twice: at once": Mode(copies(0.0)),
    "twice: 0.5 ms": Mode(copies(0.5 * MS)),
    "twice: 2 ms": Mode(copies(2 * MS)),
    "twice: 10 ms": Mode(copies(10 * MS)),
    "twice: 10 ms, slowly": Mode(slowly(copies(10 * MS))),
    "twice: 50 ms": Mode(
        copies(50 * MS), is_undetectable=has_no_ids, reason="it comes after the guard time"
    ),
    "twice: 50 ms, slowly": Mode(
        slowly(copies(50 * MS)), is_undetectable=has_no_ids, reason="it comes after the guard time"
    ),
    "twice: late": Mode(copies(2 * MS, late=1.3), always),
    "twice: a third": Mode(sometimes(copies(5 * MS))),
    "three times": Mode(copies(3 * MS, 6 * MS)),
}

IN_ANOTHER_ORDER = {
    "kept: before the next": Mode(keeping(lambda turn, kept: [Action(0.0, kept), turn.reply()])),
    "kept: behind the next": Mode(keeping(lambda turn, kept: [turn.reply(), Action(MS, kept)])),
    "kept: joined with the next": Mode(
        keeping(lambda turn, kept: [Action(0.0, kept + turn.frame(), turn.reply().executes)])
    ),
    "kept: instead of the next": Mode(
        keeping(lambda _turn, kept: [Action(0.0, kept)]), is_undetectable=has_no_ids,
        reason="it is the only reply to the next request",
    ),
}  # fmt: skip

IN_PIECES = {
    "pieces": Mode(in_pieces, is_datagrams),
    "cut off": Mode(sometimes(instead(begun))),
    "cut off, then whole": Mode(sometimes(before(begun, 2 * MS))),
    "cut off, joined with the whole": Mode(sometimes(joined(begun, right))),
    "cut off late": Mode(sometimes(instead(nearly_all))),
    "cut off late, joined with the whole": Mode(sometimes(joined(nearly_all, right))),
    "cut off late, then whole": Mode(sometimes(before(nearly_all, 2 * MS))),
}  # fmt: skip

CONFIRMS = "the reply to function 5 or 6 is the request"

ECHOES = {
    "echo: always": Mode(before(echo, MS), has_ids, has_ids, CONFIRMS),
    "echo: joined": Mode(joined(echo, right), has_ids, has_ids, CONFIRMS),
    "echo: once": Mode(once(before(echo, MS), 6)),
    "echo: cut off": Mode(sometimes(before(half_an_echo, MS))),
    "echo: of writes, which are not executed": Mode(
        echo_of_a_write, is_undetectable=always,
        reason=CONFIRMS,
    ),
}  # fmt: skip

OF_SOMETHING_ELSE = {
    "unit: instead": Mode(sometimes(instead(of_another_unit))),
    "unit: before": Mode(sometimes(before(of_another_unit, 5 * MS))),
    "unit: long before": Mode(sometimes(half_a_timeout(of_another_unit))),
    "unit: long before, slowly": Mode(slowly(sometimes(half_a_timeout(of_another_unit)))),
    "function: instead": Mode(sometimes(instead(of_another_function))),
    "function: before": Mode(sometimes(before(of_another_function, 5 * MS))),
    "length: more": Mode(sometimes(instead(longer))),
    "length: less": Mode(sometimes(instead(shorter))),
    "length: less, then right": Mode(sometimes(before(shorter, 5 * MS))),
    "length: less, long before, slowly": Mode(slowly(sometimes(half_a_timeout(shorter)))),
    "check sum: wrong": Mode(sometimes(instead(damaged))),
    "check sum: wrong, then right": Mode(sometimes(before(damaged, 5 * MS))),
    "transaction: before": Mode(
        sometimes(before(of_another_transaction, 2 * MS)), is_undetectable=has_no_ids,
        reason="without transaction ids, it is the reply",
    ),
    "transaction: after": Mode(after(of_another_transaction, 10 * MS)),
    "transaction: guessed": Mode(
        slowly(sometimes(after(guessed, 2 * MS))), is_undetectable=is_tcp,
        reason="transaction ids of a connection count up",
    ),
    "protocol": Mode(sometimes(instead(of_another_protocol))),
    "address: another": Mode(
        sometimes(instead(of_another_address)), is_undetectable=always,
        reason="a reply does not name the address",
    ),
}  # fmt: skip

STRAY_BYTES = {
    "stray: before": Mode(joined(stray(b"\0"), right), has_ids),
    "stray: after": Mode(after(stray(b"\0\xff"), MS)),
    "stray: joined": Mode(joined(right, stray(b"\0\xff")), is_udp),
    "flood: replies": Mode(sometimes(flood(60, right), 5)),
    "flood: bytes": Mode(sometimes(flood(60, stray(b"\x01\x03" * 40)), 5)),
}

CONNECTIONS = {
    "close: after each reply": Mode(closing(copies(), MS)),
    "close: in a reply": Mode(sometimes(closing(instead(begun)))),
    "close: reply on the next, soon": Mode(sometimes(on_the_next_connection(0.3))),
    "close: reply on the next, late": Mode(sometimes(on_the_next_connection(0.7))),
    "close: reply on the next, slowly": Mode(slowly(sometimes(on_the_next_connection(0.4)))),
}

REFUSALS = {
    "silent at one address": Mode(silent_at(4)),
    "exception: instead": Mode(sometimes(instead(exception(4)))),
    "exception: 00 instead": Mode(sometimes(instead(exception(0)))),
    "exception: before": Mode(before(exception(4), 5 * MS), always),
    "exception: of a gateway, then the reply": Mode(sometimes(half_a_timeout(exception(0x0B)))),
    "exception: of a gateway, then the reply, slowly": Mode(
        slowly(sometimes(half_a_timeout(exception(0x0B))))
    ),
}

MODES: dict[str, Mode] = {
    **LATE,
    **TWICE,
    **IN_ANOTHER_ORDER,
    **IN_PIECES,
    **ECHOES,
    **OF_SOMETHING_ELSE,
    **STRAY_BYTES,
    **CONNECTIONS,
    **REFUSALS,
}

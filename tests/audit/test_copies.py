"""Copies of the audit log: syslog over UDP, TCP and a Unix socket, and the journal."""

from __future__ import annotations

import array
import contextlib
import json
import os
import re
import socket
import struct
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.events.audit import Audit, Copies, Journal, Syslog, copies
from support import wire
from support.audits import full, lines

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from support.running import Run

NOTICE = 5
LOCAL0 = 16

MESSAGE = re.compile(
    rb"<(?P<priority>\d+)>1 (?P<time>[0-9T:.-]+Z) (?P<host>\S+) holdfast (?P<process>\d+) audit - "
    rb"(?P<record>\{.*\})",
    re.DOTALL,
)


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(copies, "RETRY_DELAY_S", 0.01)


@pytest.fixture
def udp() -> Iterator[socket.socket]:
    with socket.socket(type=socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        bound.settimeout(wire.DEADLINE)
        yield bound


@pytest.fixture
def unix(tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        path = str(tmp_path / "log.sock")
        bound.bind(path)
        bound.settimeout(wire.DEADLINE)
        yield bound, path


@pytest.fixture
def tcp() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(wire.DEADLINE)
        yield listening


def accepted(listening: socket.socket) -> socket.socket:
    connection, _ = listening.accept()
    connection.settimeout(wire.DEADLINE)
    return connection


@pytest.fixture
def audit() -> Iterator[Callable[..., Audit]]:
    """Opens logs with copies, and closes them."""
    with contextlib.ExitStack() as closing:

        def opened(*receivers: Copies, file: Path | None = None) -> Audit:
            audit = Audit(file, max_bytes=10**6, keep=1, copies=receivers)
            closing.callback(audit.close)
            return audit

        yield opened


def record(message: bytes) -> dict[str, Any]:
    match = MESSAGE.fullmatch(message)
    assert match is not None, message
    assert int(match["priority"]) == LOCAL0 * 8 + NOTICE
    assert int(match["process"]) == os.getpid()
    found: dict[str, Any] = json.loads(match["record"])
    assert found["time"] == match["time"].decode()
    return found


def framed(stream: socket.socket) -> bytes:
    """Reads one message that begins with its length."""
    size = b""
    while not size.endswith(b" "):
        size += stream.recv(1)
    message = b""
    while len(message) < int(size):
        message += stream.recv(int(size) - len(message))
    return message


def counts(audit: Audit, name: str) -> Any:
    told: Any = audit.counts()["copies"]
    return told[name]


def await_counts(audit: Audit, name: str, **expected: int) -> None:
    wire.until(lambda: counts(audit, name) | expected == counts(audit, name), f"{name}: {expected}")


def test_syslog_over_udp_receives_the_lines_of_the_file(
    udp: socket.socket, audit: Callable[..., Audit], tmp_path: Path
) -> None:
    file = tmp_path / "audit.log"
    log = audit(Copies("syslog", Syslog("udp", udp.getsockname())), file=file)
    log.write_all([{"number": 1}, {"number": 2}])
    received = [record(udp.recv(65536)) for _ in range(3)]
    assert received == lines(file)
    await_counts(log, "syslog", sent=3, failed=0, dropped=0, waiting=0)


def test_syslog_over_tcp_has_framed_messages_and_connects_again(
    tcp: socket.socket, audit: Callable[..., Audit]
) -> None:
    log = audit(Copies("syslog", Syslog("tcp", tcp.getsockname())))
    log.write(number=1)
    with accepted(tcp) as first:
        assert record(framed(first))["number"] == 1
        log.write(number=2)
        assert record(framed(first))["number"] == 2
    log.write(number=3)
    with accepted(tcp) as second:
        assert record(framed(second))["number"] == 3


def test_a_syslog_receiver_that_has_reset_the_connection_gets_the_next_line(
    tcp: socket.socket, audit: Callable[..., Audit], caplog: pytest.LogCaptureFixture
) -> None:
    log = audit(Copies("syslog", Syslog("tcp", tcp.getsockname())))
    log.write(number=1)
    with accepted(tcp) as first:
        assert record(framed(first))["number"] == 1
        first.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    log.write(number=2)
    with accepted(tcp) as second:
        assert record(framed(second))["number"] == 2
    assert "audit_copy_failed" not in caplog.messages


def test_lines_wait_for_a_receiver_that_is_down(
    tmp_path: Path, audit: Callable[..., Audit], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    path = str(tmp_path / "later.sock")
    log = audit(Copies("syslog", Syslog("unix", path)))
    log.write_all([{"number": 1}, {"number": 2}])
    wire.until(lambda: counts(log, "syslog")["failed"] > 1, "it was tried twice")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(path)
        bound.settimeout(wire.DEADLINE)
        assert [record(bound.recv(65536))["number"] for _ in range(2)] == [1, 2]
        await_counts(log, "syslog", sent=2, dropped=0, waiting=0)
        outage = ["audit_copy_failed", "audit_copies_back"]
        wire.until(lambda: caplog.messages == outage, "it is logged")
    log.write(number=3)
    wire.until(lambda: caplog.messages == [*outage, "audit_copy_failed"], "so is the next outage")


@pytest.mark.parametrize(("back_after", "is_back"), [(3600.0, []), (0.3, ["audit_copies_back"])])
def test_nobody_who_listens_over_udp_is_logged_once(
    udp: socket.socket,
    audit: Callable[..., Audit],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    back_after: float,
    is_back: list[str],
) -> None:
    """The end of the outage is logged without another line."""
    monkeypatch.setattr(copies, "BACK_AFTER_S", back_after)
    caplog.set_level("INFO")
    address = udp.getsockname()
    udp.connect(("127.0.0.1", 9))  # It takes nothing from others, and nobody else gets its port.
    log = audit(Copies("syslog", Syslog("udp", address)))
    log.write_all([{"number": number} for number in range(20)])
    await_counts(log, "syslog", waiting=0)
    assert counts(log, "syslog")["failed"] > 1
    wire.until(lambda: caplog.messages == ["audit_copy_failed", *is_back], "it is logged")


def test_a_syslog_receiver_that_resets_each_connection_is_logged_once(
    audit: Callable[..., Audit],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """As a load balancer without a receiver behind it: the first line of a connection is sent."""
    monkeypatch.setattr(copies, "BACK_AFTER_S", 3600.0)
    caplog.set_level("INFO")
    attempts = iter(range(10**6))

    def transmit(_connection: socket.socket, _line: bytes) -> None:
        if (attempt := next(attempts)) % 2 == 0:
            raise ConnectionResetError("reset") if attempt % 4 else BrokenPipeError("broken")

    receiver = Syslog("tcp", ("127.0.0.1", 9))
    monkeypatch.setattr(receiver, "_connect", socket.socket)
    monkeypatch.setattr(receiver, "_transmit", lambda *each: transmit(*each))
    log = audit(Copies("syslog", receiver))
    for number in range(10):
        log.write(number=number)
        await_counts(log, "syslog", sent=number + 1, waiting=0)
    assert caplog.messages == ["audit_copy_failed", "audit_copy_failed"]  # Each reason.


def test_lines_that_find_no_room_are_dropped_counted_and_logged(
    tmp_path: Path,
    audit: Callable[..., Audit],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(copies, "MAX_WAITING_BYTES", 1000)
    file = tmp_path / "audit.log"
    log = audit(Copies("syslog", Syslog("unix", str(tmp_path / "none"))), file=file)
    log.write_all([{"number": number} for number in range(100)])
    told = counts(log, "syslog")
    assert told["dropped"] + told["waiting"] == 101
    assert 0 < told["waiting"] < 20
    assert len(lines(file)) == 101
    wire.until(lambda: "audit_copies_lost" in caplog.messages, "it is logged")
    failed = counts(log, "syslog")["failed"]
    wire.until(lambda: counts(log, "syslog")["failed"] > failed + 1, "it is tried again")
    log.close()
    lost = [vars(each)["fields"]["count"] for each in caplog.records if "lost" in each.msg]
    # The second time, those that waited at the end.
    assert lost == [told["dropped"], told["waiting"]]
    assert caplog.messages.count("audit_copy_failed") == 1


def test_a_line_that_is_too_long_for_a_datagram_is_dropped(
    udp: socket.socket, audit: Callable[..., Audit], caplog: pytest.LogCaptureFixture
) -> None:
    log = audit(Copies("syslog", Syslog("udp", udp.getsockname())))
    log.write(values=[65535] * 20_000)
    log.write(number=2)
    assert record(udp.recv(65536))["number"] == 2
    await_counts(log, "syslog", sent=1, failed=0, dropped=1, waiting=0)
    log.close()
    assert caplog.messages == ["audit_copy_failed"]


def test_the_journal_receives_entries(
    unix: tuple[socket.socket, str], audit: Callable[..., Audit]
) -> None:
    journal, path = unix
    log = audit(Copies("journald", Journal(path)))
    log.write(number=1)
    head, _, message = journal.recv(65536).partition(b"MESSAGE=")
    assert head == b"SYSLOG_IDENTIFIER=holdfast-audit\nPRIORITY=5\n"
    assert message.endswith(b"}\n")
    assert json.loads(message)["number"] == 1


def test_a_large_entry_of_the_journal_is_passed_as_a_file(
    unix: tuple[socket.socket, str], audit: Callable[..., Audit]
) -> None:
    journal, path = unix
    log = audit(Copies("journald", Journal(path)))
    log.write(values=[65535] * 65535)
    descriptors = array.array("i")
    data, [(_, _, passed)], _, _ = journal.recvmsg(1, socket.CMSG_SPACE(descriptors.itemsize))
    descriptors.frombytes(passed[: descriptors.itemsize])
    assert data == b""
    with os.fdopen(descriptors[0], "rb") as file:
        file.seek(0)
        _, _, message = file.read().partition(b"MESSAGE=")
    assert len(json.loads(message)["values"]) == 65535


def test_a_line_that_the_file_lacks_is_copied_without_a_place_in_the_chain(
    udp: socket.socket,
    audit: Callable[..., Audit],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = tmp_path / "audit.log"
    log = audit(Copies("syslog", Syslog("udp", udp.getsockname())), file=file)
    make_room = full(monkeypatch)
    log.write(number=1)
    missing = record(udp.recv(65536))
    assert (missing["number"], missing["seq"], missing["prev"]) == (1, None, None)
    make_room()
    log.write(number=2)
    assert [record(udp.recv(65536)) for _ in range(3)] == lines(file)


def test_the_last_lines_are_sent_before_the_end(
    udp: socket.socket, audit: Callable[..., Audit]
) -> None:
    log = audit(Copies("syslog", Syslog("udp", udp.getsockname())))
    log.write_all([{"number": number} for number in range(50)])
    log.close()
    assert [record(udp.recv(65536))["number"] for _ in range(50)] == list(range(50))


def test_the_end_does_not_wait_for_a_receiver_that_is_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(copies, "CLOSE_TIMEOUT_S", 0.01)
    receiver = Copies("syslog", Syslog("unix", str(tmp_path / "none")))
    log = Audit(None, max_bytes=10**6, keep=1, copies=[receiver])
    log.write_all([{"number": 1}, {"number": 2}])
    log.close()
    assert "audit_copies_lost" in caplog.messages
    assert counts(log, "syslog")["dropped"] == 2


def test_an_appliance_can_do_without_a_file(run: Run, udp: socket.socket) -> None:
    host, port = udp.getsockname()
    appliance = run(
        "memories: {plant: {id: 3, coils: 16}}\n"
        "listeners: {raw: {type: raw-ingest, format: crc, compat: {crc: none}, "
        "bind: '127.0.0.1:0', "
        "rules: [{sources: [127.0.0.0/8], memories: [plant], areas: [coils]}]}}\n"
        f"audit: {{syslog: 'udp://{host}:{port}'}}\n"
    )
    appliance.stop()
    assert [record(udp.recv(65536))["event"] for _ in range(2)] == ["start", "stop"]

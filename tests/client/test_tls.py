"""Clients over TLS: whom they trust, what they show, and what becomes of a connection that fails.

Each test is for the client that waits, the one that is awaited and the native poller, and most are
for both versions of TLS.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import socket
import ssl
import threading
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest
from pymodbus import FramerType
from pymodbus.server import ModbusTlsServer

import holdfast
from holdfast import _core
from holdfast.client.async_transports import _Protocol
from holdfast.client.endpoint import endpoint
from holdfast.client.url import parse
from holdfast.net import event_loop
from support import wire
from support.cli import answer, done, failure, usage_error
from support.faces import FACES, dialling, run
from support.fake_device import Asked, Stream, good, silent
from support.pymodbus_server import Pymodbus, tour, unit_1
from support.secured import VERSIONS, Authority, Relay, context

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from support.faces import Dial, Face
    from support.running import Run
    from support.secured import Owner

    Address = tuple[str, int]

HOST = "IP:127.0.0.1"
SHORT = 0.1
"""A timeout that is waited for."""

TIMEOUT, REFUSED, RESET = 0x8001, 0x8002, 0x8003
UNKNOWN = "the issuer of the certificate is unknown"
LOST = "before any reply; it may have refused the certificate"
"""What is told when a reset has overtaken the alert."""
NO_TLS = "the peer closed the connection during the TLS handshake"
OTHER_TLS = "no TLS version or cipher suite in common; supported: TLS 1.2 and 1.3"


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("authority"))


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("stranger"), "stranger")


@pytest.fixture(scope="module")
def plc(authority: Authority) -> Owner:
    return authority.issue("plc", HOST)


@pytest.fixture(scope="module")
def without_names(authority: Authority) -> Owner:
    """A certificate with a common name only."""
    return authority.rsa("localhost")


@pytest.fixture(params=VERSIONS)
def version(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


@pytest.fixture(params=FACES)
def dial(request: pytest.FixtureRequest) -> Iterator[Dial]:
    yield from dialling(request.param)


@pytest.fixture
def device(server: holdfast.Server, memory: holdfast.Memory) -> Address:
    """What is behind the TLS: a server of ours."""
    memory.write("holding_registers", 0, [11, 22, 33])
    return server.address


class Failed(Exception):
    """A poll that failed, and the code of a status block."""

    def __init__(self, code: int) -> None:
        super().__init__(f"{code:#06x}")
        self.code = code


class Reader:
    """Reads three registers once, by one kind of client."""

    def __init__(self, kind: str) -> None:
        self._kind = kind

    def read(self, url: str, timeout: float = wire.DEADLINE) -> Sequence[int]:
        if self._kind == "poller":
            return _polled(url, timeout)
        [made] = [each for name, each in FACES.items() if name == self._kind]
        client: Any = made(url, timeout=timeout)
        try:
            read: list[int] = client.read_holding_registers(0, 3)
        finally:
            client.end() if self._kind == "asyncio" else client.close()
        return read

    def fails(
        self,
        url: str,
        words: str,
        code: int = REFUSED,
        error: type[Exception] = holdfast.ConnectionLost,
        timeout: float = wire.DEADLINE,
    ) -> None:
        """It fails with this error, and these words in it; the poller with the code."""
        if self._kind == "poller":
            with pytest.raises(Failed) as caught:
                self.read(url, timeout)
            assert caught.value.code == code
        else:
            with pytest.raises(error, match=words):
                self.read(url, timeout)


def _polled(url: str, timeout: float) -> Sequence[int]:
    reads: Any = [("holding_registers", 0, 3, None)]
    options: dict[str, Any] = {"interval": 60, "timeout": timeout, "start_within": 0}
    poller = _core.Poller([])
    results = poller.new_receiver()
    device = _core.PolledDevice(
        "plc", endpoint(parse(url)), unit=1, reads=reads, receiver=results, **options
    )
    try:
        poller.add(device)
        taken = results.take(2 * wire.DEADLINE)
        assert taken is not None
        [(_, _, [(_, _, _, data, fault, _)])], _ = taken
    finally:
        poller.stop()
    if data is None:
        raise Failed(fault)
    return [int.from_bytes(data[at : at + 2]) for at in range(0, len(data), 2)]


@pytest.fixture(params=[*FACES, "poller"])
def reader(request: pytest.FixtureRequest) -> Reader:
    return Reader(request.param)


# Whom they trust


@pytest.mark.parametrize(
    ("name", "host", "more"),
    [
        (HOST, "127.0.0.1", {}),
        ("DNS:localhost", "localhost", {}),
        ("DNS:plc7.example", "127.0.0.1", {"name": "plc7.example"}),
        ("DNS:*.plant.example", "127.0.0.1", {"name": "plc7.plant.example"}),
        ("IP:10.0.0.5,DNS:plc7", "127.0.0.1", {"name": "10.0.0.5"}),
    ],
)
def test_a_device_that_the_authority_vouches_for(
    reader: Reader,
    version: str,
    device: Address,
    authority: Authority,
    name: str,
    host: str,
    more: dict[str, str],
) -> None:
    with Relay(device, context(authority.issue("named", name), version)) as relay:
        assert reader.read(relay.url(host, ca=authority.ca, **more)) == [11, 22, 33]


def test_another_authority_is_not_trusted(
    reader: Reader, version: str, device: Address, stranger: Authority, plc: Owner
) -> None:
    with Relay(device, context(plc, version)) as relay:
        reader.fails(relay.url(ca=stranger.ca), UNKNOWN)
        reader.fails(relay.url(), UNKNOWN)


@pytest.mark.parametrize(
    ("name", "host"), [("DNS:plc7", "127.0.0.1"), ("IP:127.0.0.2", "localhost"), ("DNS:a", "b")]
)
def test_a_certificate_for_another_name_is_refused(
    reader: Reader, version: str, device: Address, authority: Authority, name: str, host: str
) -> None:
    more = {} if host != "b" else {"name": host}
    with Relay(device, context(authority.issue("other", name), version)) as relay:
        url = relay.url("127.0.0.1" if more else host, ca=authority.ca, **more)
        reader.fails(url, f"the certificate is .*not for '{host}'")


def test_the_common_name_is_no_name(
    reader: Reader, version: str, device: Address, authority: Authority, without_names: Owner
) -> None:
    with Relay(device, context(without_names, version)) as relay:
        url = relay.url("localhost", ca=authority.ca)
        reader.fails(url, "not for 'localhost'|has no alternative name, allowed: localhost")


def test_a_certificate_that_has_expired_is_refused(
    reader: Reader, version: str, device: Address, authority: Authority
) -> None:
    with Relay(device, context(authority.issue_expired("late", HOST), version)) as relay:
        reader.fails(relay.url(ca=authority.ca), "the certificate expired")


@pytest.mark.parametrize("ca", [True, False])
def test_a_device_with_a_certificate_of_its_own(
    reader: Reader, version: str, device: Address, stranger: Authority, ca: bool
) -> None:
    own = stranger.self_signed("own", HOST, ca=ca)
    twin = stranger.self_signed("twin", HOST, ca=ca)
    with Relay(device, context(own, version)) as relay:
        assert reader.read(relay.url(ca=own[0])) == [11, 22, 33]
        reader.fails(relay.url(ca=own[0], name="plc7"), "not for 'plc7'")
        reader.fails(relay.url(ca=twin[0]), f"{UNKNOWN}|the peer presented a CA certificate")


def test_a_certificate_of_an_unknown_authority_is_trusted_by_itself(
    reader: Reader, version: str, device: Address, stranger: Authority
) -> None:
    owner, late = stranger.issue("plc", HOST), stranger.issue_expired("late", HOST)
    with Relay(device, context(owner, version)) as relay:
        assert reader.read(relay.url(ca=owner[0])) == [11, 22, 33]
    with Relay(device, context(late, version)) as relay:
        reader.fails(relay.url(ca=late[0]), "the certificate expired")


def test_the_key_of_a_trusted_device_vouches_for_no_other(
    reader: Reader, device: Address, authority: Authority
) -> None:
    own = authority.self_signed("plc1", "DNS:plc1", ca=False)
    forged = authority.issue_by(own, "plc2", HOST)
    with Relay(device, context(forged)) as relay:
        reader.fails(relay.url(ca=own[0]), f"{UNKNOWN}|the certificate: ")


# What they show


def test_a_device_that_asks_for_a_certificate(
    reader: Reader,
    version: str,
    device: Address,
    authority: Authority,
    stranger: Authority,
    plc: Owner,
) -> None:
    # With TLS 1.3 the device refuses when the client holds the handshake to be over.
    code = REFUSED if version == "TLS 1.2" else RESET
    with Relay(device, context(plc, version, asks=authority.ca)) as relay:
        certificate, key = authority.issue("panel", "DNS:panel")
        url = relay.url(ca=authority.ca, cert=certificate, key=key)
        assert reader.read(url) == [11, 22, 33]

        reader.fails(relay.url(ca=authority.ca), f"the peer .*requires? a certificate|{LOST}", code)

        certificate, key = stranger.issue("panel", "DNS:panel")
        url = relay.url(ca=authority.ca, cert=certificate, key=key)
        words = f"the peer refused the certificate: unknown issuer|{LOST}"
        reader.fails(url, words, code)


def test_keys_of_every_form(reader: Reader, device: Address, authority: Authority) -> None:
    certificate, key = authority.issue("forms", "DNS:panel")
    shown = {
        "PKCS#8": (certificate, key),
        "SEC1": (certificate, authority.sec1(key)),
        "PKCS#1": authority.rsa("rsa"),
    }
    begins = {"PKCS#8": "PRIVATE", "SEC1": "EC PRIVATE", "PKCS#1": "RSA PRIVATE"}
    plc = authority.issue("plc", HOST)
    with Relay(device, context(plc, asks=authority.ca)) as relay:
        for form, (cert, own_key) in shown.items():
            assert f"BEGIN {begins[form]} KEY" in own_key.read_text()
            assert reader.read(relay.url(ca=authority.ca, cert=cert, key=own_key)) == [11, 22, 33]


@pytest.mark.parametrize("made", [holdfast.SyncClient, holdfast.Client])
def test_files_are_judged_when_the_client_is_made(
    made: Any, authority: Authority, stranger: Authority, tmp_path: Path
) -> None:
    cert, key = authority.issue("panel", "DNS:panel")
    other = stranger.issue("panel", "DNS:panel")[1]
    empty = tmp_path / "empty.pem"
    empty.write_text("nothing\n")

    def told(**options: object) -> str:
        query = "&".join(f"{name}={value}" for name, value in options.items())
        with pytest.raises((ValueError, OSError)) as caught:
            made(f"tls://plc?{query}")
        return str(caught.value)

    assert told(ca=tmp_path / "none") == f"[Errno 2] No such file or directory: '{tmp_path}/none'"
    assert told(ca=tmp_path) == f"[Errno 21] Is a directory: '{tmp_path}'"
    assert told(ca=empty) == f"{empty}: found no certificate, allowed: a certificate in PEM"
    assert told(cert=cert, key=cert) == f"{cert}: found no key, allowed: a key in PEM"
    assert told(cert=cert, key=other) == (
        f"{other}: it is not the key of the certificate in {cert}"
    )
    for traditional in (True, False):
        locked = authority.locked(key, traditional=traditional)
        assert told(cert=cert, key=locked) == (
            f"{locked}: the key is encrypted; use a key without a passphrase"
        )
    assert told(name="a b").startswith('found "a b" as the name in a certificate, allowed: ')


def test_cert_and_key_go_together() -> None:
    with pytest.raises(ValueError, match="cert and key: give both, or neither"):
        _core.Endpoint.tls("plc", 802, cert="plc.pem")


# What is no device with TLS


def test_a_device_without_tls(reader: Reader, device: Address, authority: Authority) -> None:
    reader.fails(f"tls://127.0.0.1:{device[1]}?ca={authority.ca}", NO_TLS)


def test_a_peer_that_speaks_another_protocol(reader: Reader, authority: Authority) -> None:
    def greet(peer: Any, _: int) -> None:
        peer.send(b"HTTP/1.1 400 Bad Request\r\n\r\n")

    with Stream("tcp", greet=greet, deaf=True) as other:
        url = f"tls://127.0.0.1:{other.port}?ca={authority.ca}"
        reader.fails(url, "the peer does not speak TLS")


def test_nobody_there(reader: Reader, authority: Authority) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    reader.fails(f"tls://127.0.0.1:{port}?ca={authority.ca}", "[Rr]efused|Connect call failed")


def test_a_peer_that_hangs_in_the_handshake(reader: Reader, authority: Authority) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        url = f"tls://127.0.0.1:{listening.getsockname()[1]}?ca={authority.ca}"
        reader.fails(url, f"within {SHORT} s", TIMEOUT, holdfast.RequestTimeout, SHORT)


def test_only_old_tls(reader: Reader, authority: Authority, plc: Owner, device: Address) -> None:
    old = context(plc, "TLS 1.2")
    old.set_ciphers("ALL:@SECLEVEL=0")
    with pytest.warns(DeprecationWarning, match="TLSv1_1"):
        old.minimum_version = old.maximum_version = ssl.TLSVersion.TLSv1_1
    with Relay(device, old) as relay:
        reader.fails(relay.url(ca=authority.ca), OTHER_TLS)


# What becomes of connections


@pytest.mark.parametrize("piece", [1, 100])
def test_records_in_pieces(
    reader: Reader,
    version: str,
    device: Address,
    authority: Authority,
    plc: Owner,
    piece: int,
) -> None:
    with (
        Relay(device, context(plc, version)) as relay,
        Relay(relay.address, piece=piece) as slow,
    ):
        assert reader.read(slow.url(ca=authority.ca)) == [11, 22, 33]


@pytest.mark.parametrize("most", [1, 5, 50, 200, 600])
def test_a_handshake_that_is_cut(
    reader: Reader, version: str, device: Address, authority: Authority, plc: Owner, most: int
) -> None:
    with (
        Relay(device, context(plc, version)) as relay,
        Relay(relay.address, most=most) as cut,
    ):
        reader.fails(cut.url(ca=authority.ca), NO_TLS)


def test_a_reply_that_is_cut(
    dial: Dial, version: str, device: Address, authority: Authority, plc: Owner
) -> None:
    with (
        Relay(device, context(plc, version)) as relay,
        Relay(relay.address) as wire_to,
    ):
        client = dial(wire_to.url(ca=authority.ca))
        for most in range(1000, 3000, 53):
            wire_to.most = most
            client.close()
            made = wire_to.connections + 1
            for _ in range(100):
                try:
                    client.read_holding_registers(0, 3)
                except holdfast.ConnectionLost:
                    break
                if wire_to.connections > made:  # It was cut between two replies.
                    break
            else:
                raise AssertionError("the connection was never cut")
        wire_to.most = None
        client.close()
        assert client.read_holding_registers(0, 3) == [11, 22, 33]


def test_a_lost_connection_is_made_anew(
    dial: Dial, version: str, device: Address, authority: Authority, plc: Owner
) -> None:
    with Relay(device, context(plc, version)) as relay:
        client = dial(relay.url(ca=authority.ca))
        assert client.read_holding_registers(0, 3) == [11, 22, 33]
        for number in (1, 2, 3):
            assert relay.connections == number
            relay.cut()
            with contextlib.suppress(holdfast.ConnectionLost):  # Unless it is noticed before.
                client.read_holding_registers(0, 3)
            assert client.read_holding_registers(0, 3) == [11, 22, 33]
        assert relay.connections == 4


def test_the_poller_reads_again_after_a_loss(
    version: str, device: Address, authority: Authority, plc: Owner
) -> None:
    with Relay(device, context(plc, version)) as relay:
        made = endpoint(parse(relay.url(ca=authority.ca)))
        reads: Any = [("holding_registers", 0, 3, None)]
        options: dict[str, Any] = {"interval": 0.01, "timeout": wire.DEADLINE}
        poller = _core.Poller([_core.PolledDevice("plc", made, unit=1, reads=reads, **options)])

        def reached(count: int) -> bool:
            return bool(poller.counters()["plc"]["valid"] >= count)

        try:
            for cuts in range(4):
                enough = poller.counters()["plc"]["valid"] + 3
                wire.until(functools.partial(reached, enough), "it reads")
                if cuts < 3:
                    relay.cut()
        finally:
            poller.stop()
        wire.until(lambda: len(relay.ends) >= 1, "the last connection has ended")


def test_devices_share_a_link_only_with_the_same_tls(
    device: Address, authority: Authority, stranger: Authority, plc: Owner
) -> None:
    with Relay(device, context(plc)) as relay:
        cert, key = authority.issue("panel", "DNS:panel")
        urls = [
            *[relay.url(ca=authority.ca)] * 2,
            *[relay.url(ca=authority.ca, cert=cert, key=key)] * 2,
            relay.url(ca=stranger.ca),
        ]
        reads: Any = [("holding_registers", 0, 3, None)]
        options: dict[str, Any] = {"interval": 0.01, "timeout": wire.DEADLINE, "start_within": 0}
        poller = _core.Poller(
            [
                _core.PolledDevice(
                    str(number), endpoint(parse(url)), unit=1, reads=reads, **options
                )
                for number, url in enumerate(urls)
            ]
        )
        try:
            wire.until(
                lambda: all(poller.counters()[name]["valid"] >= 3 for name in "0123"), "all read"
            )
            wire.until(lambda: poller.counters()["4"]["health"] == "error", "the last does not")
            assert relay.agreed == 2
        finally:
            poller.stop()


def test_sixteen_in_flight(
    version: str, memory: holdfast.Memory, device: Address, authority: Authority, plc: Owner
) -> None:
    memory.write("holding_registers", 0, range(1000))

    async def main() -> None:
        async with holdfast.Client(
            relay.url(ca=authority.ca), timeout=wire.DEADLINE, max_in_flight=16
        ) as client:
            calls = [client.read_holding_registers(at, 1) for at in range(200)]
            assert await asyncio.gather(*calls) == [[at] for at in range(200)]

    with Relay(device, context(plc, version)) as relay:
        run(main)
        assert relay.connections == 1


def test_replies_in_another_order(version: str, authority: Authority, plc: Owner) -> None:
    asked: list[Asked] = []

    def answer_all(last: Asked) -> None:
        for each in (last, *reversed(asked)):
            each.answer()

    async def main() -> None:
        async with holdfast.Client(
            relay.url(ca=authority.ca), timeout=wire.DEADLINE, max_in_flight=16
        ) as client:
            calls = [client.read_holding_registers(at, 1) for at in range(16)]
            assert await asyncio.gather(*calls) == [[at] for at in range(16)]

    with (
        Stream("tcp", *[asked.append] * 15, answer_all) as device,
        Relay(("127.0.0.1", device.port), context(plc, version)) as relay,
    ):
        run(main)


def test_a_late_reply_is_dropped(
    dial: Dial, version: str, authority: Authority, plc: Owner
) -> None:
    with (
        Stream("tcp", good, silent) as device,
        Relay(("127.0.0.1", device.port), context(plc, version)) as relay,
    ):
        client = dial(relay.url(ca=authority.ca), timeout=wire.DEADLINE)
        assert client.read_holding_registers(6, 1) == [6]
        client.timeout = SHORT
        with pytest.raises(holdfast.RequestTimeout):
            client.read_holding_registers(7, 1)
        device.await_requests(2)
        device.requests[1].answer()
        client.timeout = wire.DEADLINE
        wire.until(lambda: client.read_holding_registers(8, 1) == [8] and client.late == 1, "late")
        assert relay.connections == 1


def test_threads_share_a_client(
    device: Address, memory: holdfast.Memory, authority: Authority, plc: Owner
) -> None:
    memory.write("holding_registers", 0, range(1000))
    with (
        Relay(device, context(plc)) as relay,
        holdfast.SyncClient(relay.url(ca=authority.ca), timeout=wire.DEADLINE) as client,
    ):
        found: dict[int, list[int]] = {}

        def work(first: int) -> None:
            for at in range(first, first + 50):
                found[at] = client.read_holding_registers(at, 1)

        threads = [threading.Thread(target=work, args=(at,)) for at in range(0, 400, 50)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert found == {at: [at] for at in range(400)}
        assert relay.connections == 1


def test_a_client_says_that_it_goes(
    version: str, device: Address, authority: Authority, plc: Owner
) -> None:
    with Relay(device, context(plc, version)) as relay:
        client = holdfast.SyncClient(relay.url(ca=authority.ca), timeout=wire.DEADLINE)
        for _ in range(2):
            assert client.read_holding_registers(0, 3) == [11, 22, 33]
            client.close()
        wire.until(lambda: relay.ends == ["in order"] * 2, "both connections have ended")
        assert relay.connections == 2


@pytest.mark.parametrize("loop_factory", [asyncio.new_event_loop, event_loop.fastest])
@pytest.mark.parametrize("at", ["connection_made", "_greet"])
def test_a_client_may_be_closed_in_the_turn_in_which_it_has_connected(
    loop_factory: Callable[[], asyncio.AbstractEventLoop],
    at: str,
    device: Address,
    authority: Authority,
    plc: Owner,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    goes_on = getattr(_Protocol, at)

    async def main() -> None:
        closing: list[asyncio.Task[None]] = []

        def close(protocol: _Protocol, *args: Any) -> None:
            if args or protocol.core.is_ready:
                closing.append(asyncio.create_task(client.close()))
            goes_on(protocol, *args)

        monkeypatch.setattr(_Protocol, at, close)
        client = holdfast.Client(relay.url(ca=authority.ca), timeout=wire.DEADLINE)
        with pytest.raises(holdfast.ConnectionLost, match="closed by this side"):
            await client.read_holding_registers(0, 3)
        [closed] = closing
        await closed
        await asyncio.to_thread(wire.until, lambda: relay.has_ended, "it is closed")

    with Relay(device, context(plc)) as relay, asyncio.Runner(loop_factory=loop_factory) as runner:
        runner.run(main())


def test_calls_that_wait_end_when_the_client_is_closed(
    version: str, authority: Authority, plc: Owner
) -> None:
    async def main() -> None:
        client = holdfast.Client(relay.url(ca=authority.ca), timeout=wire.DEADLINE, max_in_flight=3)
        calls = [asyncio.create_task(client.read_holding_registers(at, 1)) for at in range(3)]
        while len(device.requests) < 3:
            await asyncio.sleep(0.001)
        await client.close()
        for call in calls:
            with pytest.raises(holdfast.ConnectionLost, match="closed by this side"):
                await call

    with (
        Stream("tcp", then=silent) as device,
        Relay(("127.0.0.1", device.port), context(plc, version)) as relay,
    ):
        run(main)


def test_many_values(
    dial: Dial, memory: holdfast.Memory, device: Address, authority: Authority, plc: Owner
) -> None:
    memory.write("holding_registers", 0, range(1000))
    with Relay(device, context(plc)) as relay:
        client: Face = dial(relay.url(ca=authority.ca))
        assert client.read_holding_registers(0, 1000) == list(range(1000))


# Servers of others, and everything that takes a URL


class PymodbusTls(Pymodbus):
    """pymodbus's server with TLS."""

    def __init__(self, secure: ssl.SSLContext) -> None:
        self._secure = secure
        super().__init__("tls")

    @property
    def connections(self) -> int:
        return len(self._server.active_connections)

    async def _started(self, kind: str, cable: object) -> Any:  # noqa: ARG002
        server: Any = ModbusTlsServer(
            unit_1(), framer=FramerType.SOCKET, address=("127.0.0.1", 0), sslctx=self._secure
        )
        await server.serve_forever(background=True)
        return server


def test_pymodbus(dial: Dial, version: str, authority: Authority, plc: Owner) -> None:
    cert, key = authority.issue("panel", "DNS:panel")
    server = PymodbusTls(context(plc, version, asks=authority.ca))
    try:
        # Of requests that come together it answers only one.
        client = dial(f"{server.url}?ca={authority.ca}&cert={cert}&key={key}")
        tour(client)
        client.close()
        wire.until(lambda: not server.connections, "pymodbus has noticed")
    finally:
        server.stop()


def test_commands(device: Address, authority: Authority, plc: Owner, tmp_path: Path) -> None:
    with Relay(device, context(plc)) as relay:
        url = relay.url(ca=authority.ca)
        told = answer("read", url, "hr", "0", "3")
        assert told["registers"] == [11, 22, 33]
        told = answer("bench", url, "hr:0", "3", "--in-flight", "4", "--duration", "50ms")
        assert told["errors"] == {}

        [told] = failure("read", relay.url(ca=authority.ca, name="plc7"), "hr", "0")
        assert told.endswith("the certificate is for '127.0.0.1', not for 'plc7'")
        none = f"tls://plc?ca={tmp_path}/none.pem"
        for words in (("read", none, "hr", "0"), ("bench", none), ("watch", none, "hr", "0")):
            assert "No such file or directory" in usage_error(*words)
        assert "1 request" in done("check", "plan", none, "hr:0-2")


def test_an_appliance_polls_a_device_with_files_beside_its_configuration(
    run: Run, tmp_path: Path, device: Address, authority: Authority, plc: Owner
) -> None:
    (tmp_path / "own ca.pem").write_bytes(authority.ca.read_bytes())
    with ExitStack() as stack:
        relay = stack.enter_context(Relay(device, context(plc)))
        url = relay.url(ca="own%20ca.pem")
        appliance = run(
            "memories: {mirror: {holding_registers: 10}}\n"
            f"devices: {{plc: {{url: '{url}', unit: 1, interval: 0.02, reads: [{{"
            "area: holding_registers, address: 0, count: 3, "
            "into: {memory: mirror, area: holding_registers, address: 5}}]}}\n"
        )
        mirror = appliance.memories["mirror"]
        wire.until(lambda: mirror.read("holding_registers", 5, 3) == [11, 22, 33], "it is there")


def test_an_appliance_that_can_not_use_a_file_does_not_start(run: Run, tmp_path: Path) -> None:
    (tmp_path / "ca.pem").write_text("nothing\n")
    with pytest.raises(
        OSError, match=r"^devices\.plc\.url: .*ca\.pem: found no certificate, allow"
    ):
        run(
            "memories: {mirror: {holding_registers: 10}}\n"
            "devices: {plc: {url: 'tls://127.0.0.1?ca=ca.pem', unit: 1, interval: 1, reads: [{"
            "area: holding_registers, address: 0, count: 3, "
            "into: {memory: mirror, area: holding_registers, address: 5}}]}}\n"
        )

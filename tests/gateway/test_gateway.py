"""The gateway: what is asked for over HTTP, what a real server is asked, and what is answered."""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any
from unittest.mock import ANY

import pytest

import holdfast
from holdfast.gateway import pool, repeated_writes
from holdfast.gateway.pool import Pool
from support import gateways, transports, web, wire
from support.fake_device import HANG_UP, FakeDevice, Stream, exception, registers
from support.gateways import PLC, Dialed, Names, Running

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.fake_device import Asked, Connection
    from support.running import Serve


@pytest.fixture
def device(serve: Serve, memory: holdfast.Memory) -> tuple[str, int]:
    """A server of units 1 and 3, which have the same memory."""
    memory.write("holding_registers", 0, [42])
    memory.write("holding_registers", 100, [1234, 0, 65535, 42, 7])
    memory.write("coils", 0, [1, 0, 1, 1])
    memory.write("discrete_inputs", 5, [1])
    memory.write("input_registers", 9, [99])
    return serve({1: memory, 3: memory}).address


@pytest.fixture
def gateway(device: tuple[str, int]) -> Iterator[Running]:
    """Knows the device under the name and the address that examples have."""
    names = Names(plc_factory_local=[["10.1.2.3"]])
    dialed = Dialed({("10.1.2.3", 502): device, ("192.168.1.50", 5020): device})
    allow = ["10.0.0.0/8", "192.168.1.0/24:5020", "127.0.0.0/8:*"]
    with gateways.running(allow=allow, resolve=names, dialed=dialed) as started:
        yield started


@pytest.fixture
def client(gateway: Running) -> web.Client:
    return gateway.client()


def ask(client: web.Client, path: str, **body: Any) -> web.Answer:
    return client.ask("POST", gateways.API + path, {"host": PLC, **body})


def done(client: web.Client, path: str, **body: Any) -> Any:
    """The answer, which must be a success, without the round trip time."""
    answer = ask(client, path, **body)
    assert (answer.status, answer.json["success"]) == (200, True), answer.json
    rtt = answer.json.get("rtt", 0)
    assert type(rtt) is int
    assert rtt >= 0
    return {name: value for name, value in answer.json.items() if name != "rtt"}


TARGET = {"host": PLC, "port": 502, "unitId": 1}

# Connecting.


def test_an_exception_is_an_answer_too(client: web.Client, serve: Serve) -> None:
    bare = serve({1: holdfast.Memory(coils=1)}).address[1]
    answer = ask(client, "/connect", host="127.0.0.1", port=bare, unitId=1, timeout=10000)
    assert answer.status == 200
    assert answer.json == {
        "success": True,
        "message": "Modbus server reachable (responded with exception)",
        "host": "127.0.0.1",
        "port": bare,
        "unitId": 1,
        "exception": "Illegal Data Address",
    }


def test_a_device_that_says_nothing_is_a_timeout(client: web.Client) -> None:
    with FakeDevice(lambda _: None) as mute:
        port = mute.port
        answer = ask(client, "/connect", host="127.0.0.1", port=port, timeout=50)
    assert answer.status == 500
    assert answer.json == {"success": False, "error": "Connection timeout"}
    assert answer.headers["holdfast-reason"] == "timeout"


@pytest.mark.parametrize("transport", ["tcp", "rtu+tcp"])
def test_nobody_at_a_port_is_no_connection(client: web.Client, transport: str) -> None:
    with FakeDevice(registers) as gone:
        port = gone.port
    answer = ask(client, "/connect", host="127.0.0.1", port=port, transport=transport)
    assert answer.status == 500
    assert answer.json["success"] is False
    assert "can't connect to 127.0.0.1" in answer.json["error"]
    assert "Connection refused" in answer.json["error"]
    assert answer.headers["holdfast-reason"] == "no_connection"


def test_a_name_that_nobody_knows_is_no_connection(client: web.Client) -> None:
    answer = ask(client, "/connect", host="nowhere.local")
    assert answer.status == 500
    assert answer.json["error"].startswith("can't resolve nowhere.local: ")
    assert answer.headers["holdfast-reason"] == "no_such_name"


# Reading.


@pytest.mark.parametrize(
    ("function", "name", "address", "form", "values"),
    [
        (1, "READ_COILS", 2, "coils", [True, True, False]),
        (2, "READ_DISCRETE_INPUTS", 4, "coils", [False, True, False]),
        (3, "READ_HOLDING_REGISTERS", 100, "registers", [1234, 0, 65535]),
        (4, "READ_INPUT_REGISTERS", 8, "registers", [0, 99, 0]),
    ],
)
def test_every_area_is_read(
    client: web.Client, function: int, name: str, address: int, form: str, values: list[Any]
) -> None:
    assert done(client, "/read", functionCode=function, address=address, quantity=3) == {
        "success": True,
        **TARGET,
        "functionCode": function,
        "functionName": name,
        "address": address,
        "quantity": 3,
        "format": form,
        "values": values,
    }


@pytest.mark.parametrize(
    ("datatype", "order", "kind", "values", "texts"),
    [
        ("float32", "ABCD", ">f", [0.1, -2.5], ["0.1", "-2.5"]),
        ("int16", "ABCD", ">h", [-1, 2], ["-1", "2"]),
        ("uint64", "ABCD", ">Q", [2**64 - 1], [str(2**64 - 1)]),
    ],
)
def test_values_are_read_in_their_type(
    client: web.Client,
    memory: holdfast.Memory,
    datatype: str,
    order: str,
    kind: str,
    values: list[Any],
    texts: list[str],
) -> None:
    data = b"".join(struct.pack(kind, value) for value in values)
    raw = list(struct.unpack(f">{len(data) // 2}H", data))
    memory.write("holding_registers", 0, raw)
    found = done(
        client,
        "/read",
        functionCode=3,
        address=0,
        quantity=len(raw),
        datatype=datatype,
        byteOrder=order,
    )
    assert found["values"] == raw
    assert found["typed"] == pytest.approx(values)
    assert found["typedText"] == texts


def test_a_type_says_how_many_registers(client: web.Client, memory: holdfast.Memory) -> None:
    memory.write("holding_registers", 0, [0, 0x41AC, 0, 0x41AC])
    found = done(
        client, "/read", functionCode=3, address=0, datatype="float32[2]", byteOrder="CDAB"
    )
    assert (found["quantity"], found["typed"]) == (4, [21.5, 21.5])


def test_what_is_no_value_is_told_by_its_place(client: web.Client, memory: holdfast.Memory) -> None:
    memory.write("holding_registers", 0, [0x1234, 0x00FA])
    found = done(client, "/read", functionCode=3, address=0, quantity=2, datatype="bcd16")
    assert found["typed"] == [1234, None]
    assert found["typedText"] == ["1234", "?"]
    assert list(found["typedErrors"]) == ["1"]


def test_a_number_that_json_can_not_have_says_so(
    client: web.Client, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [0x7FC0, 0, 0xFF80, 0, 0x3FC0, 0])
    found = done(client, "/read", functionCode=3, address=0, datatype="float32[3]")
    assert found["typed"] == [None, None, 1.5]
    assert found["typedText"] == ["nan", "-inf", "1.5"]
    assert found["typedErrors"] == {
        "0": "not a number",
        "1": "infinite",
    }


def test_an_exception_says_what_was_asked(client: web.Client) -> None:
    answer = ask(client, "/read", functionCode=3, address=9999, quantity=1)
    assert answer.status == 200
    assert answer.json == {
        "success": False,
        "error": "Modbus exception: Illegal Data Address (code 0x2)",
        "functionCode": 3,
        "address": 9999,
        "quantity": 1,
    }


@pytest.mark.parametrize("code", [1, 4, 5, 6, 0x0A, 0x0B, 0x42])
def test_exceptions_have_their_names(client: web.Client, code: int) -> None:
    with FakeDevice(lambda pdu: exception(pdu, code)) as device:
        port = device.port
        answer = ask(client, "/read", host="127.0.0.1", port=port, functionCode=3, address=0)
    name = {
        1: "Illegal Function",
        4: "Server Device Failure",
        5: "Acknowledge",
        6: "Server Device Busy",
        0x0A: "Gateway Path Unavailable",
        0x0B: "Gateway Target Device Failed To Respond",
        0x42: "Unknown exception: 0x42",
    }[code]
    assert answer.json["error"] == f"Modbus exception: {name} (code 0x{code:x})"


# Writing.


def test_a_coil_is_written(client: web.Client, memory: holdfast.Memory) -> None:
    told = {**TARGET, "success": True, "address": 17}
    assert done(client, "/write/coil", address=17, value=1) == {
        **told,
        "coilValue": 65280,
        "written": True,
    }
    assert memory.read("coils", 17, 1) == [1]
    assert done(client, "/write/coil", address=17, value=False) == {
        **told,
        "coilValue": 0,
        "written": False,
    }
    assert memory.read("coils", 17, 1) == [0]


def test_registers_are_written(client: web.Client, memory: holdfast.Memory) -> None:
    written = {"success": True, **TARGET, "startAddress": 100, "quantity": 3}
    assert done(client, "/write/registers", address=100, values=[1000, 2000, 3000]) == written
    assert memory.read("holding_registers", 100, 3) == [1000, 2000, 3000]


def test_typed_values_are_written(client: web.Client, memory: holdfast.Memory) -> None:
    asked = {"values": [21.5, -1], "datatype": "float32", "byteOrder": "CDAB"}
    assert done(client, "/write/registers", address=7, **asked)["quantity"] == 4
    assert memory.read("holding_registers", 7, 4) == [0, 0x41AC, 0, 0xBF80]
    done(client, "/write/registers", address=7, values=["Hi"], datatype="string:4")
    assert memory.read("holding_registers", 7, 2) == [0x4869, 0]
    done(client, "/write/registers", address=7, values=["00fF"], datatype="bytes:2")
    assert memory.read("holding_registers", 7, 1) == [0x00FF]


def test_one_register_is_written(client: web.Client, memory: holdfast.Memory) -> None:
    answer = {"success": True, **TARGET, "address": 5, "value": 1234}
    assert done(client, "/write/register", address=5, value=1234) == answer
    assert memory.read("holding_registers", 5, 1) == [1234]


def test_coils_are_written(client: web.Client, memory: holdfast.Memory) -> None:
    answer = {"success": True, **TARGET, "startAddress": 16, "quantity": 3}
    assert done(client, "/write/coils", address=16, values=[True, 0, 1]) == answer
    assert memory.read("coils", 16, 3) == [1, 0, 1]


def test_bits_of_a_register_are_changed(client: web.Client, memory: holdfast.Memory) -> None:
    memory.write("holding_registers", 4, [0x12])
    masks = {"address": 4, "andMask": 0xF2, "orMask": 0x25}
    assert done(client, "/write/mask", **masks) == {"success": True, **TARGET, **masks}
    assert memory.read("holding_registers", 4, 1) == [0x17]


def test_a_write_and_a_read_are_one_step(client: web.Client) -> None:
    asked = {"readAddress": 100, "readQuantity": 3, "writeAddress": 101, "values": [7, 8]}
    assert done(client, "/readwrite", **asked) == {
        "success": True,
        **TARGET,
        "writeAddress": 101,
        "written": 2,
        "readAddress": 100,
        "quantity": 3,
        "format": "registers",
        "values": [1234, 7, 8],
    }


def test_an_exception_to_a_write_says_where(client: web.Client) -> None:
    answer = ask(client, "/write/registers", address=5000, values=[1])
    assert answer.status == 200
    assert answer.json == {
        "success": False,
        "error": "Modbus exception: Illegal Data Address (code 0x2)",
        **TARGET,
        "address": 5000,
    }


# What a device says of itself.


def test_the_echo_comes_back(client: web.Client) -> None:
    answer = {"success": True, **TARGET, "subFunction": 0, "data": [0xA537]}
    assert done(client, "/diagnostics", subFunction=0, data=[0xA537]) == answer


def test_a_server_id_is_told(client: web.Client) -> None:
    found = done(client, "/server-id")
    assert found["running"] is True
    assert bytes.fromhex(found["data"])[0] == found["serverId"]


def test_an_identification_is_told(client: web.Client) -> None:
    found = done(client, "/identify")
    assert (found["vendorName"], found["productCode"]) == ("Holdfast", "HF")
    assert found["revision"] == holdfast.__version__
    assert found["modelName"] is None
    assert bytes.fromhex(found["objects"]["0"]) == b"Holdfast"


# Transports, and connections that are kept.


@pytest.mark.parametrize("kind", ["tcp", "udp", "rtu"])
def test_every_transport_reads_and_writes(client: web.Client, tmp_path: Path, kind: str) -> None:
    with transports.running(tmp_path, transports.configuration(kind)) as appliance:
        host, port = transports.address(appliance)
        where = {"host": host, "port": port, "transport": "rtu+tcp" if kind == "rtu" else kind}
        done(client, "/write/registers", **where, address=7, values=[1, 2, 3])
        for timeout in (4000, 5000):
            asked = {"functionCode": 3, "address": 7, "quantity": 3, "timeout": timeout}
            assert done(client, "/read", **where, **asked)["values"] == [1, 2, 3]
        assert client.get("/api/gateway").json["connections"] == 1


def read(client: web.Client, device: FakeDevice, **more: Any) -> web.Answer:
    where = {"host": "127.0.0.1", "port": device.port, "functionCode": 3, "address": 0}
    return ask(client, "/read", **where, **more)


def test_requests_of_one_device_share_a_connection(client: web.Client) -> None:
    # It takes one connection after the other: a second one would have no answer.
    with FakeDevice(registers) as device:
        assert [read(client, device, unitId=unit).status for unit in (1, 2, 1)] == [200] * 3
        assert client.get("/api/gateway").json["connections"] == 1


def test_one_request_at_a_time_goes_to_a_device(gateway: Running) -> None:
    asked, go_on = threading.Semaphore(0), threading.Event()

    def answer(pdu: bytes) -> bytes:
        asked.release()
        assert go_on.wait(wire.DEADLINE)
        return registers(pdu)

    with FakeDevice(answer) as device, ThreadPoolExecutor(3) as threads:
        answers = [threads.submit(read, gateway.client(), device) for _ in range(3)]
        assert asked.acquire(timeout=wire.DEADLINE)
        assert done(gateway.client(), "/connect")["testRegister"] == 42, "others need not wait"
        assert len(device.asked) == 1
        go_on.set()
        assert [each.result(wire.DEADLINE).status for each in answers] == [200] * 3


def test_a_read_is_repeated_when_its_connection_had_ended(client: web.Client) -> None:
    replies = iter([None, HANG_UP, None])

    def answer(pdu: bytes) -> bytes:
        reply = next(replies)
        return registers(pdu, 7) if reply is None else reply

    with FakeDevice(answer) as device:
        assert read(client, device).json["values"] == [7]
        assert read(client, device).json["values"] == [7]
        assert len(device.asked) == 3


def test_a_write_is_never_repeated(client: web.Client) -> None:
    with FakeDevice(lambda pdu: HANG_UP if pdu[0] == 6 else registers(pdu)) as device:
        assert read(client, device).status == 200
        where = {"host": "127.0.0.1", "port": device.port, "address": 0, "value": 1}
        answer = ask(client, "/write/register", **where)
        assert (answer.status, answer.headers["holdfast-reason"]) == (500, "connection_lost")
        assert [pdu[0] for pdu in device.asked] == [3, 6]


def write_with_key(client: web.Client, port: int, key: str, **more: Any) -> web.Answer:
    where = {"host": "127.0.0.1", "port": port, "address": 0, "value": 1, **more}
    path = f"{gateways.API}/write/register"
    return client.ask("POST", path, where, {**web.JSON, "Idempotency-Key": key})


def test_a_write_that_is_sent_again_is_carried_out_once(client: web.Client) -> None:
    prefix = client.get("/api/gateway").json["keyPrefix"]
    with FakeDevice(lambda pdu: pdu) as device:
        for key in ("1f0a", '"1f0b"', f"{prefix}1"):
            first = write_with_key(client, device.port, key)
            assert first.status == 200
            assert write_with_key(client, device.port, key).body == first.body
        assert len(device.asked) == 3
        for key, more, says in (
            ("1f0a", {"value": 2}, "Idempotency-Key was used for another request"),
            ("", {}, 'Idempotency-Key is "", allowed: 1 to 128 visible ASCII characters'),
            ("1" * 129, {}, "allowed: 1 to 128 visible ASCII characters"),
        ):
            answer = write_with_key(client, device.port, key, **more)
            assert (answer.status, answer.headers["holdfast-reason"]) == (400, "malformed")
            assert says in answer.json["error"]
            assert "holdfast-maybe-written" not in answer.headers
        of_another_start = write_with_key(client, device.port, "00000000/1")
        assert of_another_start.status == 409
        assert of_another_start.headers["holdfast-reason"] == "repeated"
        assert of_another_start.headers["holdfast-maybe-written"] == "true"
        assert len(device.asked) == 3


def test_the_last_keys_are_remembered(client: web.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(repeated_writes, "MAX_ENDED", 2)
    with FakeDevice(lambda pdu: pdu) as device:
        for key in ("1", "2", "3", "3", "2", "1"):
            assert write_with_key(client, device.port, key).status == 200
        assert len(device.asked) == 4


@pytest.mark.parametrize("then", ["is answered", "is alone", "ends"])
def test_a_write_that_is_sent_again_has_the_outcome_of_the_first(
    gateway: Running, then: str
) -> None:
    """That its client is gone, or that the gateway ends, leaves what was sent unknown."""
    asked, go_on = threading.Semaphore(0), threading.Event()

    def answer(pdu: bytes) -> bytes | None:
        asked.release()
        assert go_on.wait(wire.DEADLINE)
        return pdu if then == "is answered" else None

    with FakeDevice(answer) as device, ThreadPoolExecutor(1) as threads:
        first = wire.Connection(gateway.address)
        body = {"host": "127.0.0.1", "port": device.port, "address": 0, "value": 1}
        text = json.dumps({**body, "timeout": 60_000}).encode()
        length = f"Content-Length: {len(text)}"
        path = f"{gateways.API}/write/register"
        first.send(web.head("POST", path, "Idempotency-Key: 1", length) + text)
        assert asked.acquire(timeout=wire.DEADLINE)
        requests = gateway.gateway.status()["requests"]
        again = threads.submit(write_with_key, gateway.client(), device.port, "1", timeout=60_000)
        wire.until(lambda: gateway.gateway.status()["requests"] != requests, "it has come")
        if then == "is alone":
            first.reset()
        elif then == "ends":
            gateway.stop.set()
        go_on.set()
        found = again.result(wire.DEADLINE)
        first.close()
        assert len(device.asked) == 1
    reason = found.headers.get("holdfast-reason")
    allowed: dict[str, list[tuple[int, str | None]]] = {
        "is answered": [(200, None)],
        "is alone": [(409, "repeated")],
        "ends": [(503, "stopping"), (409, "repeated")],  # The first may end earlier.
    }
    assert (found.status, reason) in allowed[then]
    assert found.headers.get("holdfast-maybe-written") == (None if reason is None else "true")


def test_a_repetition_that_has_no_place_says_that_the_first_may_be_carried_out() -> None:
    asked, go_on = threading.Semaphore(0), threading.Event()

    def answer(pdu: bytes) -> bytes:
        asked.release()
        assert go_on.wait(wire.DEADLINE)
        return pdu

    limits = {"requests_of_device": 1}
    with (
        gateways.running(limits=limits) as gateway,
        FakeDevice(answer) as device,
        ThreadPoolExecutor(1) as threads,
    ):
        first = threads.submit(write_with_key, gateway.client(), device.port, "1", timeout=60_000)
        assert asked.acquire(timeout=wire.DEADLINE)
        for key, maybe in (("1", "true"), ("2", None)):
            refused = write_with_key(gateway.client(), device.port, key, timeout=60_000)
            assert refused.headers["holdfast-reason"] == "busy"
            assert refused.headers.get("holdfast-maybe-written") == maybe
        go_on.set()
        assert first.result(wire.DEADLINE).status == 200


def test_a_write_that_was_not_sent_is_carried_out_when_it_is_sent_again(gateway: Running) -> None:
    with socket.socket() as plc, ThreadPoolExecutor(1) as threads:
        plc.settimeout(wire.DEADLINE)
        plc.bind(("127.0.0.1", 0))
        _, port = plc.getsockname()
        answer = write_with_key(gateway.client(), port, "1")
        assert answer.headers["holdfast-reason"] == "no_connection"
        plc.listen()
        again = threads.submit(write_with_key, gateway.client(), port, "1")
        with plc.accept()[0] as connection:
            connection.sendall(connection.recv(64))
            assert again.result(wire.DEADLINE).status == 200


def test_after_a_timeout_the_next_request_has_a_new_connection(client: web.Client) -> None:
    replies = iter([b"", b"x"])
    with FakeDevice(lambda pdu: registers(pdu, 5) if next(replies) else None) as device:
        assert read(client, device, timeout=500).json["error"] == "Connection timeout"
        assert read(client, device).json["values"] == [5]


def test_a_dead_connection_is_replaced_although_requests_overlap() -> None:
    first: list[Connection] = []

    def answers_on_another_one(asked: Asked) -> None:
        if asked.peer is not first[0]:
            asked.answer()

    def greet(connection: Connection, _: int) -> None:
        first.append(connection)

    with (
        Stream("tcp", then=answers_on_another_one, greet=greet) as device,
        gateways.running(limits={"in_flight": 4}) as running,
        ThreadPoolExecutor(4) as threads,
    ):

        def is_answered(number: int) -> bool:
            where = {"host": "127.0.0.1", "port": device.port, "functionCode": 3}
            body = {**where, "address": number, "timeout": 200 + 50 * number}
            return running.ask("/read", body).status == 200

        def goes_on(number: int) -> None:
            until = time.monotonic() + wire.DEADLINE
            while not is_answered(number):
                assert time.monotonic() < until, "there is no other connection"

        list(threads.map(goes_on, range(4)))


def test_what_is_no_reply_is_told(client: web.Client) -> None:
    with FakeDevice(lambda _: b"\x03\x04\0\0\0\0") as device:
        answer = read(client, device)
        assert (answer.status, answer.headers["holdfast-reason"]) == (500, "invalid_reply")


def test_a_connection_that_nobody_uses_is_closed(serve: Serve, memory: holdfast.Memory) -> None:
    port = serve({1: memory}).address[1]
    with gateways.running(limits={"idle": 0.01}) as running:
        client = running.client()
        done(client, "/connect", host="127.0.0.1", port=port)

        def is_closed() -> bool:
            return bool(client.get("/api/gateway").json["connections"] == 0)

        wire.until(is_closed, "it is closed")


class Roaming:
    """Behaves as a gateway that sends its first reply only on the next connection."""

    def __init__(self) -> None:
        self.kept = b""

    def keep(self, asked: Asked) -> None:
        self.kept = asked.frame()

    def greet(self, connection: Connection, _number: int) -> None:
        connection.send(self.kept)


@pytest.mark.parametrize("factor", [1, 2], ids=["same timeout", "other timeout"])
def test_a_reply_to_an_earlier_request_is_not_taken_for_the_next_one(
    factor: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    checks: list[Pool] = []
    check = Pool._close_unused

    async def checked(pool: Pool) -> None:
        await check(pool)
        checks.append(pool)

    monkeypatch.setattr(Pool, "_close_unused", checked)
    monkeypatch.setattr(pool, "CHECK_INTERVAL_S", 0.001)

    def is_answered(timeout: float) -> bool:
        roaming = Roaming()
        with (
            gateways.running() as running,
            Stream("rtu+tcp", roaming.keep, greet=roaming.greet) as device,
        ):
            client = running.client()
            where = {"host": "127.0.0.1", "port": device.port, "transport": "rtu+tcp"}
            given = {"functionCode": 3, "timeout": round(1000 * timeout)}
            first = ask(client, "/read", **where, address=5, **given)
            assert first.headers["holdfast-reason"] == "timeout"
            enough = len(checks) + 2
            wire.until(lambda: len(checks) >= enough, "idle connections were looked for")
            given["timeout"] *= factor
            second = ask(client, "/read", **where, address=6, **given)
        if second.headers.get("holdfast-reason") == "timeout":
            return False
        assert second.json["values"] == [6]
        return True

    wire.until_long_enough(is_answered, "the second request has a reply")


def test_the_next_address_of_a_name_is_tried(device: tuple[str, int]) -> None:
    names = Names(plc_factory_local=[["127.0.0.9", "127.0.0.1"]])
    with gateways.running(resolve=names) as running:
        found = done(running.client(), "/connect", port=device[1])
    assert found["testRegister"] == 42


# What is refused.


@pytest.mark.parametrize(
    ("path", "body", "says"),
    [
        ("/connect", {}, "Missing required parameter: host"),
        ("/read", {"host": PLC}, "Missing required parameters: functionCode and address"),
        ("/read", {"host": PLC, "functionCode": 3}, "Missing required parameter: address"),
        ("/write/coil", {"host": PLC}, "Missing required parameters: address and value"),
        ("/write/registers", {"host": PLC, "address": 1}, "Missing required parameter: values"),
        ("/connect", {"host": ""}, "host"),
        ("/connect", {"host": "a b"}, "host"),
        ("/connect", {"host": "plc\n"}, "host"),
        ("/connect", {"host": "/dev/ttyUSB0"}, "host"),
        ("/connect", {"host": "rtu:///dev/ttyUSB0"}, "host"),
        ("/connect", {"host": "tcp://10.0.0.1"}, "host"),
        ("/connect", {"host": "fe80::1%eth0"}, "host"),
        ("/connect", {"host": 7}, "host"),
        ("/connect", {"host": None}, "host"),
        ("/connect", {"host": "x" * 300}, "host"),
        ("/connect", {"host": PLC, "port": 0}, "port is 0, allowed: an integer 1 to 65535"),
        ("/connect", {"host": PLC, "port": 65536}, "port"),
        ("/connect", {"host": PLC, "port": "502"}, "port"),
        ("/connect", {"host": PLC, "port": 502.0}, "port"),
        ("/connect", {"host": PLC, "port": None}, "port"),
        ("/connect", {"host": PLC, "unitId": 256}, "unitId is 256"),
        ("/read", {"byteOrder": "abcd"}, 'byteOrder is "abcd", allowed: ABCD, CDAB, BADC, DCBA'),
        ("/read", {"datatype": ""}, 'datatype is "", allowed: a type such as int16'),
        ("/read", {"quantity": 2001}, "allowed: an integer 1 to 125 for registers"),
        ("/write/registers", {"values": []}, "has 0 elements, allowed: 1 to 123"),
        ("/connect", {"host": PLC, "unitId": -1}, "unitId"),
        ("/connect", {"host": PLC, "unitId": True}, "unitId"),
        ("/connect", {"host": PLC, "timeout": 0}, "timeout"),
        ("/connect", {"host": PLC, "timeout": 60001}, "timeout is 60001"),
        ("/connect", {"host": PLC, "transport": "rtu"}, "transport"),
        ("/connect", {"host": PLC, "serverName": "plc"}, "serverName requires transport tls"),
        ("/connect", {"host": PLC, "transport": "tls", "serverName": ""}, "serverName"),
        ("/connect", {"host": PLC, "transport": "tls", "serverName": "a b"}, "serverName"),
        ("/connect", {"host": PLC, "transport": "tls", "serverName": "plc-"}, 'is "plc-"'),
        ("/connect", {"host": PLC, "unitid": 3}, '"unitid" is not a parameter'),
        ("/connect?unitId=3", {"host": PLC}, 'query is "unitId=3", allowed: none beside a body'),
        ("/read", {"functionCode": 5}, "Invalid read function code: 0x5"),
        ("/read", {"functionCode": 6}, "Invalid read function code: 0x6"),
        ("/read", {"functionCode": 16}, "Invalid read function code: 0x10"),
        ("/read", {"functionCode": "3"}, "Invalid read function code"),
        ("/read", {"functionCode": True}, "Invalid read function code"),
        ("/read", {"address": 65536}, "address is 65536"),
        ("/read", {"address": -1}, "address"),
        ("/read", {"address": 1.5}, "address"),
        ("/read", {"quantity": 0}, "quantity is 0"),
        ("/read", {"quantity": 126}, "Quantity must be between 1 and 125"),
        ("/read", {"functionCode": 1, "quantity": 2001}, "quantity is 2001"),
        ("/read", {"address": 65535, "quantity": 2}, "the last address is 65535"),
        ("/read", {"datatype": "float33"}, "float33"),
        ("/read", {"datatype": "float32", "byteOrder": "ABCE"}, "byteOrder"),
        ("/read", {"datatype": "float32", "byteOrder": "AABB"}, "order"),
        ("/read", {"datatype": "float32", "quantity": 3}, "multiple of 2"),
        ("/read", {"datatype": "float32[2]", "quantity": 2}, "the datatype requires 4"),
        ("/read", {"datatype": "float32[99]"}, "Quantity must be between 1 and 125"),
        ("/read", {"functionCode": 1, "datatype": "int16"}, "allowed for coils: bool"),
        ("/read", {"byteOrder": "CDAB"}, "byteOrder requires datatype"),
        ("/write/coil", {"value": 2}, "value is 2, allowed: false, true, 0, 1"),
        ("/write/coil", {"value": "on"}, "value"),
        ("/write/coil", {"value": 1.0}, "value"),
        ("/write/coil", {"value": None}, "value"),
        ("/write/registers", {"values": []}, "values has 0 elements"),
        ("/write/registers", {"values": 7}, "values is 7, allowed: an array"),
        ("/write/registers", {"values": [1, 65536]}, "values[1] is 65536"),
        ("/write/registers", {"values": [-1]}, "values[0] is -1"),
        ("/write/registers", {"values": [1.5]}, "values[0] is 1.5"),
        ("/write/registers", {"values": [True]}, "values[0] is true"),
        ("/write/registers", {"values": ["1"]}, 'values[0] is "1"'),
        ("/write/registers", {"values": [0] * 124}, "124 elements, allowed: 1 to 123"),
        ("/write/registers", {"values": [0] * 62, "datatype": "int32"}, "124 registers"),
        ("/write/registers", {"values": [1e39], "datatype": "float32"}, "values[0]"),
        ("/write/registers", {"values": [1, 2], "datatype": "int16[3]"}, "2 elements"),
        ("/write/registers", {"values": [True], "datatype": "bit:3"}, "/write/mask"),
        ("/write/registers", {"values": ["0g"], "datatype": "bytes:1"}, "hexadecimal"),
        ("/write/registers", {"address": 65535, "values": [1, 2]}, "the last address is 65535"),
        ("/write/register", {"value": 65536}, "value"),
        ("/write/coils", {"values": [1, 2]}, "values[1] is 2"),
        ("/write/coils", {"values": [1] * 1969}, "values has 1969 elements"),
        ("/write/mask", {"andMask": 65536}, "andMask"),
        ("/readwrite", {"readQuantity": 126}, "readQuantity"),
        ("/readwrite", {"values": [0] * 122}, "values has 122 elements"),
        ("/diagnostics", {"data": []}, "data has 0 elements"),
        ("/map", {"areas": []}, "areas"),
        ("/map", {"areas": ["coils", "coils"]}, "duplicate"),
        ("/map", {"areas": ["coil"]}, "areas[0]"),
        ("/map", {"first": 5, "last": 4}, "first is 5"),
        ("/map", {"exact": 1}, "exact is 1, allowed: true and false"),
    ],
)
def test_what_is_wrong_is_named_before_a_device_is_asked(
    client: web.Client, path: str, body: dict[str, Any], says: str
) -> None:
    whole: dict[str, dict[str, Any]] = {
        "/read": {"host": PLC, "functionCode": 3, "address": 0},
        "/write/coil": {"host": PLC, "address": 0, "value": True},
        "/write/registers": {"host": PLC, "address": 0, "values": [1]},
        "/write/register": {"host": PLC, "address": 0, "value": 1},
        "/write/coils": {"host": PLC, "address": 0, "values": [1]},
        "/write/mask": {"host": PLC, "address": 0, "andMask": 0, "orMask": 0},
        "/readwrite": {
            "host": PLC,
            "readAddress": 0,
            "readQuantity": 1,
            "writeAddress": 0,
            "values": [1],
        },
        "/diagnostics": {"host": PLC},
        "/map": {"host": PLC},
    }
    sent = body if "host" in body or not body else {**whole[path], **body}
    answer = client.ask("POST", gateways.API + path, sent)
    assert (answer.status, answer.json["success"]) == (400, False)
    assert says in answer.json["error"]
    assert len(answer.json["error"]) < 300
    assert answer.headers["holdfast-reason"] == "malformed"
    assert client.get("/api/gateway").json["connections"] == 0


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"[]",
        b"null",
        b"{",
        b'{"host":"a"}x',
        b'{"host":"a","host":"a"}',
        b'\xef\xbb\xbf{"host":"a"}',
        b"[" * 60000,
    ],
)
def test_what_is_no_object_is_malformed(client: web.Client, body: bytes) -> None:
    answer = client.ask("POST", "/api/modbus/connect", body)
    assert (answer.status, answer.headers["holdfast-reason"]) == (400, "malformed")


@pytest.mark.parametrize("method", ["GET", "PUT", "DELETE", "HEAD"])
def test_another_method_is_not_allowed(client: web.Client, method: str) -> None:
    answer = client.ask(method, "/api/modbus/read", headers={})
    assert (answer.status, answer.headers["allow"]) == (405, "POST, OPTIONS")
    if method != "HEAD":
        assert answer.json["success"] is False
        assert answer.json["error"].startswith("Method not allowed")


def test_options_say_what_is_allowed(client: web.Client) -> None:
    for path, allowed in (
        ("/api/modbus/read", "POST, OPTIONS"),
        ("/api/modbus/watch", "GET, OPTIONS"),
        ("/docs", "GET, HEAD, OPTIONS"),
    ):
        answer = client.ask("OPTIONS", path, headers={})
        assert (answer.status, answer.headers["allow"], answer.body) == (204, allowed, b"")


def test_there_is_nothing_elsewhere(client: web.Client) -> None:
    for path in ("/api/modbus", "/api/modbus/read/", "/console/", "/console/../app.py", "/x"):
        answer = client.get(path)
        assert (answer.status, answer.json["success"]) == (404, False)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Content-Type": "application/json; charset=utf-8"}, 200),
        ({"Content-Type": "application/x-www-form-urlencoded"}, 200),
        ({"Content-Type": "text/plain"}, 415),
        ({"Content-Type": "text/plain;charset=UTF-8"}, 415),
        ({"Content-Type": "application/json;"}, 200),
        ({"Content-Type": "Application/JSON; v=1"}, 200),
        ({"Content-Type": "application/jsonx"}, 415),
        ({"Content-Type": "application/json", "Content-Encoding": "gzip"}, 415),
    ],
)
def test_json_is_taken_and_what_curl_calls_it(
    client: web.Client, headers: dict[str, str], status: int
) -> None:
    body = json.dumps({"host": PLC}).encode()
    assert client.ask("POST", "/api/modbus/connect", body, headers).status == status


def test_a_gateway_says_what_it_may_do(client: web.Client) -> None:
    assert client.get("/api/gateway").json == {
        "version": holdfast.__version__,
        "writes": True,
        "tokens": False,
        "allow": ["10.0.0.0/8", "192.168.1.0/24:5020", "127.0.0.0/8:*"],
        "limits": {"timeout": 60000, "interval": 100},
        "connections": 0,
        "keyPrefix": ANY,
    }


# Registers in every type.


def test_registers_are_shown_in_every_type_and_order(client: web.Client) -> None:
    registers = [0x1234, 0x5678, 0x3FF8, 0x0A41]
    answer = client.ask("POST", "/api/gateway/types", {"registers": registers}).json
    four, eight = answer["tables"]
    assert four["orders"] == ["ABCD", "CDAB", "BADC", "DCBA"]
    texts = {row["type"]: row["texts"] for row in four["rows"]}
    assert texts["uint16"] == ["4660", "4660", "13330", "13330"]
    assert texts["bcd32"] == ["12345678", "56781234", "34127856", "78563412"]
    assert texts["bits on"] == ["2 4–5 9 12", "2 4–5 9 12", "1 4 10 12–13", "1 4 10 12–13"]
    assert texts["text"][0] == "·4Vx?··A"
    assert texts["bytes"][1] == "0a413ff856781234"
    assert texts["bool"] == ["true", "", "", ""]
    assert [row["type"] for row in eight["rows"]] == ["int64", "uint64", "float64"]


def test_types_that_do_not_fit_the_registers_are_not_shown(client: web.Client) -> None:
    answer = client.ask("POST", "/api/gateway/types", {"registers": [0x00FA]}).json
    [table] = answer["tables"]
    assert [row["type"] for row in table["rows"]] == [
        *("int16", "uint16", "float16", "bcd16", "text", "bytes", "bits on", "bool"),
    ]
    assert table["rows"][3]["texts"] == ["?", "?", "?", "?"]

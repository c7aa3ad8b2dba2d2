"""Devices with TLS: whom the scanner trusts is its own setting, not that of its callers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from holdfast.net.tls import Tls
from support import wire
from support.nats_bus import leaving, tag
from support.secured import VERSIONS, Authority, Relay, context

if TYPE_CHECKING:
    from pathlib import Path

    import holdfast
    from support.nats_bus import Caller, Inbox, Run
    from support.secured import Owner

HOST = "DNS:localhost,IP:127.0.0.1"


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("authority"))


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("stranger"), "stranger")


@pytest.fixture(scope="module")
def plc(authority: Authority) -> Owner:
    return authority.issue("plc", HOST)


@pytest.fixture
def address(server: holdfast.Server, memory: holdfast.Memory) -> tuple[str, int]:
    memory.write("holding_registers", 0, [77])
    return server.address


def subscribed(caller: Caller, **where: Any) -> tuple[Inbox, Inbox]:
    """Its data and its states, when it is subscribed to."""
    data, states = caller.listen("modbus.data.plc1"), caller.listen("modbus.status.plc1")
    who = {"deviceId": "plc1", "subscriberId": "hmi", "scanRate": 50}
    request = who | {"tags": [tag("a", 0, writable=True)]} | where
    answer = caller.request("modbus.subscribe", request)
    assert answer == {"success": True, "count": 1}
    return data, states


def refused(states: Inbox) -> str:
    """Why a device is offline from the start."""
    assert states.next()["state"] == "connecting"
    # A new connection to the broker publishes the state again.
    state = states.until(lambda state: state["state"] != "connecting", "a result")
    assert state["state"] == "offline"
    error: str = state["error"]
    return error


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
@pytest.mark.parametrize("by_url", [False, True])
@pytest.mark.parametrize("version", VERSIONS)
def test_a_device_is_scanned_and_written_by_the_name_that_was_asked_for(
    run_scanner: Run,
    caller: Caller,
    memory: holdfast.Memory,
    address: tuple[str, int],
    authority: Authority,
    version: str,
    by_url: bool,
    host: str,
) -> None:
    """With `localhost` a certificate that has no address."""
    owner = authority.issue("named", f"{'DNS' if host == 'localhost' else 'IP'}:{host}")
    run_scanner(device_tls=Tls.of(authority.ca))
    with Relay(address, context(owner, version)) as relay:
        where: dict[str, Any] = {"host": host, "port": relay.address[1], "transport": "tls"}
        if by_url:
            where = {"url": f"tls://{host}:{relay.address[1]}"}
        data, _ = subscribed(caller, **where)
        assert data.next()["value"] == 77
        assert caller.request("modbus.command.a", "78") == {"success": True}
        assert memory.read("holding_registers", 0, 1) == [78]
        [device] = caller.request("modbus.browse", b"")["devices"]
        assert device["url"] == f"tls://{host}:{relay.address[1]}"
        assert device["address"] == f"tls://127.0.0.1:{relay.address[1]}"
        caller.request("modbus.unsubscribe", leaving("a"))


def test_the_port_is_802_if_none_is_said(run_scanner: Run, caller: Caller) -> None:
    run_scanner(allow=("127.0.0.77",))
    subscribed(caller, host="127.0.0.77", transport="tls")
    [device] = caller.request("modbus.browse", b"")["devices"]
    assert device["url"] == "tls://127.0.0.77:802"


def test_another_authority_is_not_trusted(
    run_scanner: Run,
    caller: Caller,
    address: tuple[str, int],
    plc: Owner,
    stranger: Authority,
) -> None:
    run_scanner(device_tls=Tls.of(stranger.ca))
    with Relay(address, context(plc)) as relay:
        data, states = subscribed(caller, url=f"tls://127.0.0.1:{relay.address[1]}")
        assert refused(states) == "no connection"
        assert data.take() == []
        caller.request("modbus.unsubscribe", leaving("a"))


def test_the_systems_authorities_are_trusted_if_no_others_are_named(
    run_scanner: Run, caller: Caller, address: tuple[str, int], plc: Owner
) -> None:
    run_scanner()
    with Relay(address, context(plc)) as relay:
        _, states = subscribed(caller, url=f"tls://127.0.0.1:{relay.address[1]}")
        assert refused(states) == "no connection"
        caller.request("modbus.unsubscribe", leaving("a"))


@pytest.mark.parametrize("name", [None, "plc7", "plc8"])
def test_the_certificate_has_the_name_that_is_said(
    run_scanner: Run,
    caller: Caller,
    address: tuple[str, int],
    authority: Authority,
    name: str | None,
) -> None:
    run_scanner(device_tls=Tls.of(authority.ca))
    with Relay(address, context(authority.issue("plc7", "DNS:plc7"))) as relay:
        url = f"tls://127.0.0.1:{relay.address[1]}"
        data, states = subscribed(caller, url=url if name is None else f"{url}?name={name}")
        if name == "plc7":
            assert data.next()["value"] == 77
        else:
            assert refused(states) == "no connection"
        other = {
            "deviceId": "plc1",
            "subscriberId": "other",
            "url": f"{url}?name=x",
            "tags": [tag("a", 0)],
        }
        answer = caller.request("modbus.subscribe", other)
        assert f"not as {url} with the name x unit 1" in answer["error"]
        caller.request("modbus.unsubscribe", leaving("a"))


@pytest.mark.parametrize("shows", [False, True])
def test_a_certificate_is_shown_to_a_device_that_asks_for_one(
    run_scanner: Run,
    caller: Caller,
    address: tuple[str, int],
    authority: Authority,
    plc: Owner,
    shows: bool,
) -> None:
    own = authority.issue("scanner", "DNS:scanner") if shows else (None, None)
    run_scanner(device_tls=Tls.of(authority.ca, *own))
    with Relay(address, context(plc, asks=authority.ca)) as relay:
        data, states = subscribed(caller, url=f"tls://127.0.0.1:{relay.address[1]}")
        if shows:
            assert data.next()["value"] == 77
        else:
            states.until(lambda state: state["state"] == "offline", "it refuses")
            assert data.take() == []
        caller.request("modbus.unsubscribe", leaving("a"))


def test_a_name_that_no_certificate_can_have_is_refused(run_scanner: Run, caller: Caller) -> None:
    run_scanner()
    request = {
        "deviceId": "plc1",
        "subscriberId": "hmi",
        "url": "tls://127.0.0.1?name=a..b",
        "tags": [tag("a", 0)],
    }
    answer = caller.request("modbus.subscribe", request)
    assert not answer["success"]
    assert "a..b" in answer["error"]
    assert caller.request("modbus.browse", b"")["count"] == 0


def test_files_that_can_not_be_used_end_it_before_it_serves(
    run_scanner: Run, tmp_path: Path, authority: Authority, plc: Owner
) -> None:
    empty = tmp_path / "empty"
    empty.touch()
    wrong = [
        Tls.of(tmp_path / "missing"),
        Tls.of(empty),
        Tls.of(authority.ca, plc[0], empty),
        Tls.of(authority.ca, plc[0], authority.issue("other", HOST)[1]),
    ]
    for files in wrong:
        running = run_scanner(wait=False, device_tls=files)
        wire.until(running.ended.done, "it has ended")
        assert isinstance(running.ended.exception(), OSError)
        assert not running.serves
        with pytest.raises(OSError, match=r"."):
            running.stop()

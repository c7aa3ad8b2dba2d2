"""What strangers find out about an appliance: nmap's `modbus-discover`, and what pymodbus asks for
identification and diagnostics.
"""

from __future__ import annotations

import subprocess
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import pytest
from pymodbus.client import AsyncModbusTcpClient, ModbusTcpClient

from support.machine import tool
from support.pymodbus_peer import OPTIONS, Patient, connected
from support.transports import ALL, address, configuration, counters

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.appliance import Appliance
    from support.running import Run

IDENTITY = {
    "vendor_name": "Acme",
    "product_code": "P-1",
    "revision": "1.2",
    "vendor_url": "https://acme.example",
    "product_name": "Pump",
    "model_name": "Mark II",
    "user_application_name": "cellar",
    "unit_names": {2: "boiler house"},
    "objects": {128: "north", 255: "x" * 240},
}
UNITS = {1: "plant", 2: "plant", 3: "sealed"}


@pytest.fixture
def appliance(run: Run) -> Appliance:
    """Units 1 and 2 are open, unit 2 has a name; unit 3 is sealed."""
    sealed = {"coils": 8, "seal": {"area": "coils", "address": 0}}
    rules = [{"sources": ["127.0.0.1"], "units": UNITS, "access": "read-write"}]
    memories = {"plant": ALL, "sealed": sealed}
    more = {"identity": IDENTITY}
    return run(configuration("tcp", rules=rules, memories=memories, more=more, listen_only=True))


# nmap


def discovered(appliance: Appliance, *, aggressive: bool) -> dict[str, dict[str, str]]:
    """What nmap says of each unit id that answered."""
    host, port = address(appliance)
    # With the plus sign the script runs though the port is not 502.
    script = ["--script", "+modbus-discover"]
    if aggressive:
        script += ["--script-args", "modbus-discover.aggressive=true"]
    ran = subprocess.run(
        [tool("nmap"), "-sT", "-Pn", "-n", "-oX", "-", "-p", str(port), *script, host],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    report = ElementTree.fromstring(ran.stdout)
    assert [service.get("name") for service in report.iter("service")] == ["modbus"]
    return {
        str(unit.get("key")): {str(found.get("key")): str(found.text) for found in unit}
        for unit in report.iter("table")
    }


def test_nmap_finds_the_units_and_what_they_are(appliance: Appliance) -> None:
    units = discovered(appliance, aggressive=True)

    device = "Acme P-1 1.2"
    assert units.pop("sid 0x1") == {
        "Slave ID data": rf"\x01\xFF{device}",
        "Device identification": device,
    }
    assert units.pop("sid 0x2") == {
        "Slave ID data": r"\x02\xFFboiler house",
        "Device identification": device,
    }
    assert units.pop("sid 0x3") == {"error": "SLAVE DEVICE BUSY"}
    assert len(units) == 243
    for found in units.values():
        assert found == {"error": "GATEWAY TARGET DEVICE FAILED TO RESPOND"}


def test_nmap_stops_at_the_first_unit_unless_told(appliance: Appliance) -> None:
    assert list(discovered(appliance, aggressive=False)) == ["sid 0x1"]


def test_nmap_finds_nothing_where_the_functions_are_denied(run: Run) -> None:
    rules = [{"sources": ["127.0.0.1"], "units": UNITS, "access": "read-only", "deny": [17, 43]}]
    memories = {"plant": ALL, "sealed": ALL}
    appliance = run(configuration("tcp", rules=rules, memories=memories))

    units = discovered(appliance, aggressive=True)
    assert len(units) == 246
    # Whether a unit is there does not show either.
    for found in units.values():
        assert found == {"error": "ILLEGAL FUNCTION"}
    assert set(counters(appliance)["exceptions"]) == {1}


# pymodbus


@pytest.fixture(params=["sync", "asyncio"])
def client(request: pytest.FixtureRequest, appliance: Appliance) -> Iterator[Any]:
    host, port = address(appliance)
    if request.param == "sync":
        with connected(ModbusTcpClient(host, port=port, **OPTIONS)) as made:
            yield made
    else:
        with Patient(lambda: AsyncModbusTcpClient(host, port=port, **OPTIONS)) as made:
            yield made


BASIC = {0: b"Acme", 1: b"P-1", 2: b"1.2"}
REGULAR = {**BASIC, 3: b"https://acme.example", 4: b"Pump", 5: b"Mark II", 6: b"cellar"}


def test_pymodbus_reads_the_identification_of_each_category(client: Any) -> None:
    basic = client.read_device_information(read_code=1)
    regular = client.read_device_information(read_code=2)
    extended = client.read_device_information(read_code=3)

    assert (basic.information, basic.more_follows) == (BASIC, 0)
    assert (regular.information, regular.more_follows) == (REGULAR, 0)
    assert extended.information == {**REGULAR, 128: b"north"}
    assert (extended.more_follows, extended.next_object_id) == (0xFF, 255)
    assert {basic.conformity, regular.conformity, extended.conformity} == {0x83}


def test_pymodbus_reads_on_where_more_follows(client: Any) -> None:
    rest = client.read_device_information(read_code=3, object_id=255)

    assert rest.information == {255: b"x" * 240}
    assert rest.more_follows == 0


def test_pymodbus_reads_single_objects(client: Any) -> None:
    for key, value in {**REGULAR, 128: b"north", 255: b"x" * 240}.items():
        single = client.read_device_information(read_code=4, object_id=key)
        assert single.information == {key: value}
    assert client.read_device_information(read_code=4, object_id=7).exception_code == 2


def test_pymodbus_reads_the_name_of_a_unit(client: Any) -> None:
    regular = client.read_device_information(read_code=2, device_id=2)

    assert regular.information == {**REGULAR, 6: b"boiler house"}


def test_pymodbus_reads_the_server_ids(client: Any) -> None:
    # pymodbus takes the last byte for the run indicator.
    assert client.report_device_id().identifier == b"\x01\xffAcme P-1 1.2"[:-1]
    assert client.report_device_id(device_id=2).identifier == b"\x02\xffboiler house"[:-1]
    assert client.report_device_id(device_id=3).exception_code == 6
    assert client.report_device_id(device_id=4).exception_code == 11


def test_pymodbus_reads_every_counter(client: Any) -> None:
    assert not client.diag_clear_counters().isError()
    client.read_coils(1000)
    client.read_coils(0, device_id=3)
    expected = {
        "diag_read_diagnostic_register": 0,
        "diag_read_bus_message_count": 4,
        "diag_read_bus_comm_error_count": 0,
        "diag_read_bus_exception_error_count": 2,
        "diag_read_device_message_count": 7,
        "diag_read_device_no_response_count": 0,
        "diag_read_device_nak_count": 0,
        "diag_read_device_busy_count": 1,
        "diag_read_bus_char_overrun_count": 0,
    }

    assert {name: getattr(client, name)().message for name in expected} == expected


def test_pymodbus_counts_events_and_restarts_them(client: Any) -> None:
    assert not client.diag_restart_communication(True).isError()
    assert client.diag_get_comm_event_counter().count == 0
    client.read_coils(0)
    client.read_coils(1000)
    assert client.diag_get_comm_event_counter().count == 1
    assert client.diag_get_comm_event_counter().status
    assert not client.diag_restart_communication(False).isError()
    assert client.diag_get_comm_event_counter().count == 0


def test_pymodbus_changes_the_delimiter_and_clears_the_overrun_counter(client: Any) -> None:
    assert client.diag_change_ascii_input_delimeter(delimiter=0x2300).message == 0x2300
    assert client.diag_clear_overrun_counter().message == 0


@pytest.mark.parametrize("call", ["diag_read_iop_overrun_count", "diag_getclear_modbus_response"])
def test_pymodbus_is_told_of_an_unknown_sub_function(call: str, client: Any) -> None:
    assert getattr(client, call)().exception_code == 1


def test_pymodbus_is_told_that_there_is_no_event_log(client: Any) -> None:
    assert client.diag_get_comm_event_log().exception_code == 1


def test_pymodbus_reads_the_exception_status_and_the_event_log(run: Run) -> None:
    status = {"memory": "plant", "exception_status": {"area": "coils", "address": 3}}
    rules = [{"sources": ["127.0.0.1"], "units": {1: status}, "access": "read-only"}]
    appliance = run(configuration("tcp", rules=rules, event_log=True))
    appliance.memories["plant"].write("coils", 3, [1, 0, 0, 0, 0, 1, 0, 1])
    host, port = address(appliance)
    with connected(ModbusTcpClient(host, port=port, **OPTIONS)) as client:
        assert client.read_exception_status().status == 0b1010_0001
        assert client.read_coils(5000).exception_code == 2
        log = client.diag_get_comm_event_log()

    assert (log.event_count, log.message_count) == (1, 3)
    assert log.events == [0x80, 0x41, 0x80, 0x40, 0x80]


def test_pymodbus_silences_a_unit_and_wakes_it(client: Any) -> None:
    client.diag_force_listen_only()
    client.diag_restart_communication(True, no_response_expected=True)

    assert client.read_coils(0).bits[0] is False

"""What a good configuration comes to: defaults, both forms of an area, initial values, dump."""

from __future__ import annotations

import json
from ipaddress import ip_network
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import jsonschema_rs
import pytest
from hypothesis import given, settings

from holdfast._core import UNMEASURED_COST_MS
from holdfast.client.url import Receiver, parse
from holdfast.config import Config, json_schema, load, read_plans
from holdfast.config.initial_values import InitialRun
from holdfast.config.models.devices import DestinationConfig, DeviceConfig, ReadConfig
from holdfast.config.models.listeners import (
    Listener,
    ModbusAsciiListener,
    ModbusAsciiOverTcpListener,
    ModbusRtuListener,
    ModbusRtuOverTcpListener,
    ModbusRtuOverUdpListener,
    ModbusTcpListener,
    ModbusUdpListener,
    RawIngestListener,
    RtuSerialConfig,
    SerialRuleConfig,
)
from holdfast.config.models.memories import Seal, Span
from holdfast.config.models.services import AuditConfig, MqttConfig, RestConfig, TokenConfig
from holdfast.config.text import yaml_document
from support.cases import examples
from support.config_folder import written
from support.configurations import configurations
from support.paths import EXAMPLES

if TYPE_CHECKING:
    from collections.abc import Callable

L = TypeVar("L")

SMALL = """\
memories:
  plant: {coils: 8, input_registers: {start: 1000, size: 200}%s}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:5020
    rules:
      - {sources: [10.0.0.7, "fd00::/64"], units: {1: plant, 0x10: plant}, access: read-only}
"""


@pytest.fixture
def loaded(tmp_path: Path) -> Callable[..., Config]:
    """Loads text, with other files beside it."""

    def write_and_load(text: str = SMALL % "", **files: str) -> Config:
        for name, content in files.items():
            (tmp_path / name.replace("_", ".")).write_text(content, encoding="utf-8")
        path = tmp_path / "plant.yaml"
        path.write_text(text, encoding="utf-8")
        return load(path)

    return write_and_load


def scada_of(config: Config) -> ModbusTcpListener:
    listener = config.listeners["scada"]
    assert isinstance(listener, ModbusTcpListener)
    return listener


def test_a_size_is_an_area_from_0(loaded: Callable[..., Config]) -> None:
    assert loaded().memories["plant"].coils == Span(start=0, size=8)


def test_the_long_form_gives_the_first_address(loaded: Callable[..., Config]) -> None:
    span = loaded().memories["plant"].input_registers
    assert span == Span(start=1000, size=200)
    assert span.addresses == range(1000, 1200)


def test_an_area_that_is_left_out_does_not_exist(loaded: Callable[..., Config]) -> None:
    plant = loaded().memories["plant"]
    assert plant.holding_registers is None
    assert list(plant.areas()) == ["coils", "input_registers"]


def test_a_listener_has_the_documented_defaults(loaded: Callable[..., Config]) -> None:
    scada = scada_of(loaded())
    assert (scada.max_connections, scada.max_connections_per_source) == (256, 128)
    assert (scada.when_full, scada.idle_timeout, scada.request_timeout) == ("refuse", 300, 10)


@pytest.mark.parametrize(
    ("written", "most"),
    [
        ("max_connections: 1", 1),
        ("max_connections: 2", 2),
        ("max_connections: 17", 16),
        ("max_connections: 33", 17),
        ("max_connections: 65535", 32768),
        ("max_connections_per_source: null", None),
        ("max_connections_per_source: 256", 256),
    ],
)
def test_one_source_has_half_of_the_places_unless_the_file_says_otherwise(
    loaded: Callable[..., Config], written: str, most: int | None
) -> None:
    for kind, units in (("modbus-tcp", "access: read-only"), ("raw-ingest", "areas: [coils]")):
        rule = f"{{sources: [10.0.0.7], units: {{1: plant}}, {units}}}"
        text = f"type: {kind}, bind: '127.0.0.1:1', {written}, rules: [{rule}]"
        listener: Any = loaded(f"{SERVED}listeners:\n  a: {{{text}}}\n").listeners["a"]
        assert listener.max_connections_per_source == most


def test_the_appliance_has_the_documented_defaults(loaded: Callable[..., Config]) -> None:
    config = loaded()
    assert (config.log.level, config.log.format, config.workers) == ("info", "text", 1)
    assert (config.identity.vendor_name, config.identity.product_code) == ("Holdfast", "HF")
    assert config.identity.unit_names == {}


def test_a_rule_holds_networks_units_and_access(loaded: Callable[..., Config]) -> None:
    (rule,) = scada_of(loaded()).rules
    assert rule.sources == (ip_network("10.0.0.7"), ip_network("fd00::/64"))
    assert rule.units == {1: "plant", 16: "plant"}
    assert (rule.access, rule.functions, rule.deny) == ("read-only", None, None)


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [("0.0.0.0:502", "0.0.0.0", 502), ("[::1]:0", "::1", 0), ("[fe80::1%2]:5", "fe80::1%2", 5)],
)
def test_a_bind_is_an_address_and_a_port(
    loaded: Callable[..., Config], text: str, host: str, port: int
) -> None:
    bind = scada_of(loaded((SMALL % "").replace("127.0.0.1:5020", f'"{text}"'))).bind
    assert (bind.host, bind.port, str(bind)) == (host, port, text)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("127.0.0.1:502", "127.0.0.2:502"),
        ("127.0.0.1:502", "127.0.0.1:503"),
        ("127.0.0.1:0", "127.0.0.1:0"),
        ("[::1]:502", "0.0.0.0:502"),
        ("[::1]:502", "127.0.0.1:502"),
    ],
)
def test_listeners_with_sockets_of_their_own_go_together(
    loaded: Callable[..., Config], one: str, other: str
) -> None:
    rule = "rules: [{sources: [::/0], units: {1: m}, access: read-only}]"
    config = loaded(
        "memories: {m: {coils: 1}}\nlisteners:\n"
        f"  a: {{type: modbus-tcp, bind: '{one}', {rule}}}\n"
        f"  b: {{type: modbus-tcp, bind: '{other}', {rule}}}\n"
    )
    assert list(config.listeners) == ["a", "b"]


def test_a_rule_below_a_narrower_one_can_match(loaded: Callable[..., Config]) -> None:
    text = (SMALL % "").rstrip() + "\n" + (" " * 6) + "- {sources: [10.0.0.0/24, 10.0.0.7],"
    text += " units: {1: plant}, access: read-write}\n"
    assert len(loaded(text).listeners["scada"].rules) == 2


def test_a_seal_opens_once_unless_it_says_otherwise(loaded: Callable[..., Config]) -> None:
    plant = loaded(SMALL % ", seal: {area: coils, address: 7}").memories["plant"]
    assert plant.seal == Seal(area="coils", address=7, mode="once")


SERVED = """\
memories: {plant: {id: 1, coils: 8}}
"""
GRANT = "memories: [plant], areas: [coils]"
RULE = "{sources: [10.0.0.7], units: {1: plant}, access: read-only}"
LINE = "{units: {247: plant}, access: read-only}"


def listener_of(loaded: Callable[..., Config], text: str, kind: type[L]) -> L:
    listener = loaded(f"{SERVED}listeners:\n  a: {{{text}}}\n").listeners["a"]
    assert isinstance(listener, kind)
    return listener


@pytest.mark.parametrize(
    ("kind", "model"),
    [
        ("modbus-rtu-over-tcp", ModbusRtuOverTcpListener),
        ("modbus-ascii-over-tcp", ModbusAsciiOverTcpListener),
    ],
)
def test_serial_frames_over_tcp_are_set_like_modbus_tcp(
    loaded: Callable[..., Config],
    kind: str,
    model: type[ModbusRtuOverTcpListener | ModbusAsciiOverTcpListener],
) -> None:
    text = f"type: {kind}, bind: '127.0.0.1:1', rules: [{RULE}]"
    listener = listener_of(loaded, text, model)
    assert not isinstance(listener, ModbusTcpListener)
    assert (listener.max_connections, listener.idle_timeout, listener.when_full) == (
        256,
        300,
        "refuse",
    )


def test_a_udp_listener_has_a_bind_and_rules(loaded: Callable[..., Config]) -> None:
    text = f"type: modbus-udp, bind: '127.0.0.1:1', rules: [{RULE}]"
    listener = listener_of(loaded, text, ModbusUdpListener)
    assert (listener.bind.port, listener.rules[0].units) == (1, {1: "plant"})


def test_rtu_over_udp_is_set_like_modbus_udp(loaded: Callable[..., Config]) -> None:
    text = f"type: modbus-rtu-over-udp, bind: '127.0.0.1:1', rules: [{RULE}]"
    listener = listener_of(loaded, text, ModbusRtuOverUdpListener)
    assert not isinstance(listener, ModbusUdpListener)
    assert (listener.bind.port, listener.rules[0].units) == (1, {1: "plant"})


def test_an_rtu_line_has_the_defaults_of_the_standard(loaded: Callable[..., Config]) -> None:
    text = f"type: modbus-rtu, serial: {{device: COM3}}, rules: [{LINE}]"
    listener = listener_of(loaded, text, ModbusRtuListener)
    assert listener.serial == RtuSerialConfig(device="COM3", baud=19200, parity="even", stop_bits=1)
    assert listener.rules == (SerialRuleConfig(units={247: "plant"}, access="read-only"),)


def test_an_ascii_line_has_the_defaults_of_the_standard(loaded: Callable[..., Config]) -> None:
    text = f"type: modbus-ascii, serial: {{device: COM3}}, rules: [{LINE}]"
    listener = listener_of(loaded, text, ModbusAsciiListener)
    assert (listener.serial.parity, listener.serial.data_bits) == ("even", 7)


@pytest.mark.parametrize(
    ("settings", "bits"),
    [
        ("parity: none", 2),
        ("parity: odd", 1),
        ("parity: even", 1),
        ("parity: none, stop_bits: 1", 1),
        ("parity: even, stop_bits: 2", 2),
    ],
)
def test_stop_bits_follow_parity_unless_they_are_given(
    loaded: Callable[..., Config], settings: str, bits: int
) -> None:
    text = f"type: modbus-rtu, serial: {{device: a, {settings}}}, rules: [{LINE}]"
    assert listener_of(loaded, text, ModbusRtuListener).serial.stop_bits == bits


def test_raw_ingest_speaks_v1_unless_it_says_otherwise(loaded: Callable[..., Config]) -> None:
    rule = "{sources: [10.0.0.7], units: {65535: plant}, areas: [coils]}"
    text = f"type: raw-ingest, bind: '127.0.0.1:1', rules: [{rule}]"
    listener = listener_of(loaded, text, RawIngestListener)
    assert (listener.format, listener.compat) == ("v1", None)
    assert (listener.max_connections, listener.max_connections_per_source) == (256, 128)
    assert listener.when_full == "refuse"
    assert (listener.rules[0].units, listener.rules[0].memories) == ({65535: "plant"}, ())


@pytest.mark.parametrize(("written", "compat"), [("", None), ("crc: none", {"crc": "none"})])
def test_raw_ingest_of_format_crc_needs_the_crc_unless_compat_says_otherwise(
    loaded: Callable[..., Config], written: str, compat: dict[str, str] | None
) -> None:
    rule = f"{{sources: [10.0.0.7], {GRANT}}}"
    group = f"compat: {{{written}}}, " if written else ""
    text = f"type: raw-ingest, format: crc, {group}bind: '127.0.0.1:1', rules: [{rule}]"
    listener = listener_of(loaded, text, RawIngestListener)
    given = listener.compat and listener.compat.model_dump(exclude_none=True)
    assert given == compat
    assert (listener.rules[0].units, listener.rules[0].memories) == ({}, ("plant",))


def rest_of(loaded: Callable[..., Config], tokens: str) -> RestConfig:
    rest = f"rest: {{bind: '[::1]:80', sources: [10.0.0.7], tokens: {tokens}}}\n"
    config = loaded(SERVED + rest)
    assert config.listeners == {}
    assert config.rest is not None
    return config.rest


def test_rest_has_the_documented_defaults(loaded: Callable[..., Config]) -> None:
    rest = rest_of(loaded, "none")
    assert (rest.max_body, rest.max_connections, rest.request_timeout) == (8388608, 128, 10)
    assert (rest.max_connections_per_source, rest.when_full) == (64, "evict")
    assert rest.tokens == "none"


def test_the_hash_of_a_token_is_kept_in_small_letters(loaded: Callable[..., Config]) -> None:
    token = f"{{name: a, sha256: {'aB' * 32}, {GRANT}, access: read-only}}"
    assert rest_of(loaded, f"[{token}]").tokens == (
        TokenConfig(
            name="a", sha256="ab" * 32, memories=("plant",), areas=("coils",), access="read-only"
        ),
    )


def mqtt_of(loaded: Callable[..., Config], settings: str, **files: str) -> MqttConfig:
    topic = f"{{topic: a, {GRANT}}}"
    text = f"{SERVED}mqtt: {{client_id: a, {settings}, subscriptions: [{topic}]}}\n"
    mqtt = loaded(text, **files).mqtt
    assert mqtt is not None
    return mqtt


@pytest.mark.parametrize(
    ("url", "parts"),
    [
        ("mqtt://broker", ("broker", 1883, False)),
        ("mqtts://broker.example", ("broker.example", 8883, True)),
        ("mqtt://127.0.0.1:1", ("127.0.0.1", 1, False)),
        ("mqtts://[fd00::1]:65535", ("fd00::1", 65535, True)),
        ("mqtt://[::1]", ("::1", 1883, False)),
    ],
)
def test_a_url_says_where_the_broker_is(
    loaded: Callable[..., Config], url: str, parts: tuple[str, int, bool]
) -> None:
    mqtt = mqtt_of(loaded, f"url: '{url}'")
    assert (mqtt.host, mqtt.port, mqtt.tls_files is not None) == parts


def test_mqtt_has_the_documented_defaults(loaded: Callable[..., Config]) -> None:
    mqtt = mqtt_of(loaded, "url: mqtt://a")
    assert (mqtt.version, mqtt.keep_alive, mqtt.tls) == ("5", 60, None)
    assert (mqtt.username, mqtt.password_file, mqtt.subscriptions[0].qos) == (None, None, 0)


@pytest.mark.parametrize(
    ("written", "version"), [("5", "5"), ("'5'", "5"), ("3.1.1", "3.1.1"), ("'3.1.1'", "3.1.1")]
)
def test_the_version_of_mqtt_may_be_a_number(
    loaded: Callable[..., Config], written: str, version: str
) -> None:
    assert mqtt_of(loaded, f"url: mqtt://a, version: {written}").version == version


def test_files_are_relative_to_the_configuration_and_not_read(
    loaded: Callable[..., Config], tmp_path: Path
) -> None:
    tls = "tls: {cert_file: p.txt, key_file: p.txt}"
    settings = f"url: mqtts://a, username: a, password_file: p.txt, {tls}"
    mqtt = mqtt_of(loaded, settings, p_txt="my-secret")
    assert mqtt.tls is not None
    assert (mqtt.password_file, mqtt.tls.key_file) == (tmp_path / "p.txt", tmp_path / "p.txt")
    assert "my-secret" not in repr(mqtt)


def test_metrics_are_for_this_machine_unless_they_say_otherwise(
    loaded: Callable[..., Config],
) -> None:
    metrics = loaded((SMALL % "") + "metrics: {bind: '127.0.0.1:1'}\n").metrics
    assert metrics is not None
    assert metrics.sources == (ip_network("127.0.0.0/8"), ip_network("::1/128"))


def test_an_audit_file_has_the_documented_limits(
    loaded: Callable[..., Config], tmp_path: Path
) -> None:
    audit = loaded((SMALL % "") + "audit: {file: a.log}\n").audit
    assert audit == AuditConfig(
        file=tmp_path / "a.log", max_bytes=104857600, keep=10, fail="open", journald=False
    )


def test_syslog_or_the_journal_can_replace_the_audit_file(loaded: Callable[..., Config]) -> None:
    audit = loaded((SMALL % "") + "audit: {syslog: 'tcp://10.0.0.9'}\n").audit
    assert audit is not None
    assert (audit.file, audit.syslog) == (None, "tcp://10.0.0.9")
    audit = loaded((SMALL % "") + "audit: {journald: true}\n").audit
    assert audit == AuditConfig(journald=True)


METER = "url: tcp://10.0.0.9, unit: 1, interval: 1"
READ = "{area: coils, address: 9, count: 8, into: {memory: plant, area: coils, address: 0}}"


def device_of(
    loaded: Callable[..., Config], more: str = "", reads: str = READ, meter: str = METER
) -> DeviceConfig:
    return loaded(f"{SERVED}devices: {{a: {{{meter}, reads: [{reads}]{more}}}}}\n").devices["a"]


def test_a_device_has_the_documented_defaults(loaded: Callable[..., Config]) -> None:
    device = device_of(loaded)
    assert (device.enabled, device.timeout, device.max_gap) == (True, 1, 0)
    assert (device.max_registers, device.max_bits) == (125, 2000)
    assert (device.readable, device.forbidden, device.forward, device.status) == ((), (), (), None)
    assert device.target == parse("tcp://10.0.0.9:502")
    assert device.reads == (
        ReadConfig(
            area="coils",
            address=9,
            count=8,
            into=DestinationConfig(memory="plant", area="coils", address=0),
        ),
    )


def test_a_device_with_an_automatic_gap_is_planned_by_costs(loaded: Callable[..., Config]) -> None:
    rules = read_plans.rules(device_of(loaded, ", max_gap: auto"))
    assert (rules["max_gap"], rules["cost"]) == (None, UNMEASURED_COST_MS)


@pytest.mark.parametrize(
    ("written", "addresses"),
    [
        ("start: 10, end: 19", range(10, 20)),
        ("start: 10, end: 10", range(10, 11)),
        ("start: 65526, end: 65535", range(65526, 65536)),
    ],
)
def test_a_range_of_a_device_has_a_last_address(
    loaded: Callable[..., Config], written: str, addresses: range
) -> None:
    device = device_of(loaded, f", forbidden: [{{area: holding_registers, {written}}}]")
    assert device.forbidden[0].addresses == addresses


@pytest.mark.parametrize(
    ("written", "crc", "target"),
    [
        ("unit: 65535", None, 65535),
        ("format: v1, unit: 0", None, 0),
        ("format: crc, memory_id: 7", "required", 7),
        ("format: crc, memory_id: 0, crc: none", "none", 0),
    ],
)
def test_a_forward_names_a_unit_or_a_memory(
    loaded: Callable[..., Config], written: str, crc: str | None, target: int
) -> None:
    more = f", forward: [{{url: 'raw://[fd00::9]:9000', {written}}}]"
    (forward,) = device_of(loaded, more, "{area: coils, address: 0, count: 1}").forward
    assert forward.receiver == Receiver("fd00::9", 9000)
    assert (forward.crc, forward.target, forward.timeout) == (crc, target, 5)


def test_devices_of_one_line_drive_it_alike(loaded: Callable[..., Config]) -> None:
    line = "url: 'rtu:///dev/ttyX?baud=9600', interval: 1"
    reads = "forward: [{url: 'raw://a:1', unit: 1}], reads: [{area: coils, address: %d, count: 1}]"
    both = f"a: {{unit: 1, {line}, {reads % 0}}}, b: {{unit: 247, {line}, {reads % 1}}}"
    config = loaded(f"{SERVED}devices: {{{both}}}\n")
    assert config.warnings == ()


def test_options_of_an_adapter_are_kept_as_they_are(loaded: Callable[..., Config]) -> None:
    adapter = (
        f"{{type: b, {GRANT}, access: read-only, options: {{x: , y: {{1: [1.5, no, true]}}}}}}"
    )
    config = loaded((SMALL % "") + f"adapters: {{a: {adapter}}}\n")
    assert config.adapters["a"].options == {"x": None, "y": {1: [1.5, "no", True]}}
    assert loaded(config.dump()) == config


def test_what_is_left_out_is_not_there(loaded: Callable[..., Config]) -> None:
    config = loaded()
    assert (config.rest, config.mqtt, config.metrics, config.audit) == (None, None, None, None)
    assert (config.nats, config.gateway) == (None, None)
    assert config.adapters == {}


def test_yes_and_no_are_text(loaded: Callable[..., Config]) -> None:
    config = loaded((SMALL % "") + "identity: {vendor_name: yes, revision: 1_0}\n")
    assert (config.identity.vendor_name, config.identity.revision) == ("yes", "1_0")


def test_an_alias_repeats_a_value(loaded: Callable[..., Config]) -> None:
    text = (SMALL % "").replace("listeners:", "  other: *p\nlisteners:")
    config = loaded(text.replace("plant: {", "plant: &p {", 1))
    assert config.memories["other"] == config.memories["plant"]


def test_initial_values_from_csv_come_in_runs(loaded: Callable[..., Config]) -> None:
    csv = (
        "\ufeffArea, Address, Value\r\n# a comment\r\n\r\n"
        "input_registers,1001,65535\r\ncoils,7,1\r\ninput_registers,1000,1\r\ncoils,0,0\r\n"
    )
    plant = loaded(SMALL % ", initial: v.csv", v_csv=csv).memories["plant"]
    assert plant.initial_values == (
        InitialRun("input_registers", 1000, (1, 65535)),
        InitialRun("coils", 0, (0,)),
        InitialRun("coils", 7, (1,)),
    )


def test_initial_values_from_yaml_may_be_lists(loaded: Callable[..., Config]) -> None:
    text = "coils: {0: [1, 0, 1], 5: 1}\ninput_registers:\n  1000: 0xFFFF\n"
    plant = loaded(SMALL % ", initial: v.yaml", v_yaml=text).memories["plant"]
    assert plant.initial_values == (
        InitialRun("coils", 0, (1, 0, 1)),
        InitialRun("coils", 5, (1,)),
        InitialRun("input_registers", 1000, (65535,)),
    )


@pytest.mark.parametrize("mode", ["once", "level"])
@pytest.mark.parametrize("gate", [0, 1])
def test_a_memory_starts_sealed_whatever_its_gate_bit_was(
    loaded: Callable[..., Config], mode: str, gate: int
) -> None:
    extra = f", seal: {{area: coils, address: 7, mode: {mode}}}, initial: v.csv"
    values = f"coils,6,1\ncoils,7,{gate}\nholding_registers,7,1\n"
    config = loaded(SMALL % f"{extra}, holding_registers: 8", v_csv=values)
    found = [each.message for each in config.warnings if each.key.endswith(".initial")]
    warning = "v.csv has 1 in the gate bit of the seal, taken as 0: the memory starts sealed"
    assert found == [warning] * gate
    bits, registers = config.memories["plant"].initial_values
    assert (bits, registers) == (
        InitialRun("coils", 6, (1, 0)),
        InitialRun("holding_registers", 7, (1,)),
    )


def test_all_65536_values_of_an_area_can_be_given(loaded: Callable[..., Config]) -> None:
    csv = "".join(f"holding_registers,{address},{address}\n" for address in range(65536))
    text = SMALL % ", holding_registers: 65536, initial: v.csv"
    (run,) = loaded(text, v_csv=csv).memories["plant"].initial_values
    assert run.values == tuple(range(65536))


def test_a_configuration_cannot_be_changed(loaded: Callable[..., Config]) -> None:
    with pytest.raises(ValueError, match="frozen"):
        loaded().workers = 2  # type: ignore[misc]


def test_the_dump_of_the_example_shows_every_default(loaded: Callable[..., Config]) -> None:
    dump = loaded((SMALL % "") + "identity: {revision: '1.0'}\n").dump()
    assert dump == (
        "memories:\n"
        "  plant:\n"
        "    coils: {start: 0, size: 8}\n"
        "    input_registers: {start: 1000, size: 200}\n"
        "logs: {}\n"
        "identity:\n"
        "  vendor_name: Holdfast\n"
        "  product_code: HF\n"
        '  revision: "1.0"\n'
        "  unit_names: {}\n"
        "  objects: {}\n"
        "listeners:\n"
        "  scada:\n"
        "    type: modbus-tcp\n"
        "    bind: 127.0.0.1:5020\n"
        "    max_connections: 256\n"
        "    max_connections_per_source: 128\n"
        "    when_full: refuse\n"
        "    idle_timeout: 300\n"
        "    request_timeout: 10\n"
        "    keepalive: 60\n"
        "    listen_only: false\n"
        "    event_log: false\n"
        "    rules:\n"
        "      - sources: [10.0.0.7/32, fd00::/64]\n"
        "        units: {1: plant, 16: plant}\n"
        "        access: read-only\n"
        "profiles: {}\n"
        "devices: {}\n"
        "links: {}\n"
        "outputs: {}\n"
        "adapters: {}\n"
        "log:\n"
        "  level: info\n"
        "  format: text\n"
        "reload: on-request\n"
        "workers: 1\n"
    )


def test_the_dump_loads_from_another_folder_with_its_initial_values(
    loaded: Callable[..., Config], tmp_path: Path
) -> None:
    config = loaded(SMALL % ", initial: v.csv", v_csv="coils,1,1\n")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "dump.yaml").write_text(config.dump(), encoding="utf-8")
    again = load(elsewhere / "dump.yaml")
    assert again == config
    assert again.memories["plant"].initial_values == (InitialRun("coils", 1, (1,)),)


def test_the_examples_are_right() -> None:
    for path in EXAMPLES.glob("*.yaml"):
        assert load(path).warnings == ()


def test_the_schema_accepts_devices_that_are_written_once_for_many() -> None:
    data = yaml_document.parse((EXAMPLES / "full.yaml").read_text(), "full.yaml")[0].data
    validator = jsonschema_rs.validator_for(json_schema())
    validator.validate(json.loads(json.dumps(data)))
    assert any("for" in device for device in data["devices"].values())
    for wrong in ({"for": {"n": "1-"}, "url": "tcp://a{n}"}, {"url": "tcp://a", "fro": {"n": 1}}):
        assert not validator.is_valid({"devices": {"a{n}": wrong}})


def test_the_full_example_has_every_section_and_every_listener() -> None:
    config = load(EXAMPLES / "full.yaml")
    assert config.model_fields_set == set(Config.model_fields)
    assert {type(listener) for listener in config.listeners.values()} == set(get_args(Listener))


@settings(max_examples=examples(60))
@given(data=configurations())
def test_every_dump_loads_as_an_equal_configuration(
    tmp_path_factory: pytest.TempPathFactory, data: dict[str, Any]
) -> None:
    path = tmp_path_factory.mktemp("dump") / "plant.yaml"
    path.write_text(written(data), encoding="utf-8")
    config = load(path)
    dump = config.dump()
    path.write_text(dump, encoding="utf-8")
    again = load(path)
    assert again == config
    assert again.dump() == dump


def properties(schema: dict[str, Any]) -> dict[str, dict[str, Any]]:
    found = {}
    for name, node in {"Config": schema, **schema["$defs"]}.items():
        for key, value in node.get("properties", {}).items():
            found[f"{name}.{key}"] = value
    return found


def test_the_schema_is_of_draft_2020_12() -> None:
    assert json_schema()["$schema"] == "https://json-schema.org/draft/2020-12/schema"


def test_the_schema_titles_and_describes_every_key() -> None:
    for key, node in properties(json_schema()).items():
        assert node.get("title"), key
        assert node.get("description"), key


def test_the_schema_takes_both_forms_of_an_area() -> None:
    coils = properties(json_schema())["MemoryConfig.coils"]
    assert coils["anyOf"] == [
        {"type": "integer", "minimum": 1, "maximum": 65536},
        {"$ref": "#/$defs/Span"},
    ]


def test_the_schema_knows_what_a_measurement_is() -> None:
    measurement = properties(json_schema())["InfluxConfig.measurement"]
    takes = jsonschema_rs.validator_for(measurement).is_valid
    assert all(map(takes, ["a", "a#", "\\a b", "\\#", 'a, "b"=c']))
    assert not any(
        map(takes, ["", "#", "#a", "\\", "a\\", "\\ b", "a\\\\b", 'a\\"', "a\n", "a\\\n"])
    )


def test_the_schema_takes_null_only_where_it_means_no_limit() -> None:
    nullable = [
        key
        for key, node in properties(json_schema()).items()
        if {"type": "null"} in node.get("anyOf", ())
    ]
    assert sorted(nullable) == [
        "GatewayConfig.max_connections_per_source",
        "ModbusAsciiOverTcpListener.max_connections_per_source",
        "ModbusRtuOverTcpListener.max_connections_per_source",
        "ModbusTcpListener.max_connections_per_source",
        "ModbusTlsListener.max_connections_per_source",
        "RawIngestListener.max_connections_per_source",
        "RestConfig.max_connections_per_source",
    ]


def test_the_schema_asks_for_what_bears_on_safety() -> None:
    required = {name: node.get("required") for name, node in json_schema()["$defs"].items()}
    assert required == {
        "AdapterConfig": ["type", "memories", "areas", "access"],
        "AsciiSerialConfig": ["device"],
        "AuditConfig": None,
        "BufferConfig": None,
        "ClientTlsConfig": None,
        "DestinationConfig": ["memory", "area", "address"],
        "DeviceConfig": ["url"],
        "DeviceIdentityConfig": None,
        "FileConfig": ["type", "file", "format"],
        "ForwardConfig": ["url"],
        "ForwardedStatusConfig": ["area", "slot"],
        "GatewayConfig": ["bind", "sources", "allow", "access", "tokens"],
        "GatewayTokenConfig": ["name", "sha256"],
        "HttpsConfig": ["cert_file", "key_file"],
        "IdentityConfig": None,
        "InfluxConfig": ["type", "url"],
        "KeepConfig": ["file"],
        "LinkConfig": ["url"],
        "LogConfig": None,
        "MappingConfig": ["topic", "memory"],
        "MemoryConfig": None,
        "MetricsConfig": ["bind"],
        "ModbusAsciiListener": ["type", "serial", "rules"],
        "ModbusAsciiOverTcpListener": ["type", "bind", "rules"],
        "ModbusRtuListener": ["type", "serial", "rules"],
        "ModbusRtuOverTcpListener": ["type", "bind", "rules"],
        "ModbusRtuOverUdpListener": ["type", "bind", "rules"],
        "ModbusTcpListener": ["type", "bind", "rules"],
        "ModbusTlsListener": ["type", "bind", "rules", "tls"],
        "ModbusUdpListener": ["type", "bind", "rules"],
        "MqttConfig": ["url", "client_id"],
        "MqttOutputConfig": ["url", "type"],
        "NatsConfig": ["servers", "devices"],
        "NatsFleetConfig": ["name", "node"],
        "NatsDefaultsConfig": None,
        "NatsLimitsConfig": None,
        "NatsOutputConfig": ["servers", "type"],
        "NatsPingConfig": None,
        "RawIngestListener": ["type", "bind", "rules"],
        "OffsetsConfig": None,
        "ProfileConfig": ["tags"],
        "ExceptionStatusConfig": ["area", "address"],
        "RangeConfig": ["area", "start", "end"],
        "RawCompatConfig": None,
        "RawIngestConfig": ["rules"],
        "RawRuleConfig": ["sources", "areas"],
        "SecureRawRuleConfig": ["sources", "areas"],
        "ReadConfig": ["area", "address", "count"],
        "ReplicateConfig": ["log"],
        "RestConfig": ["bind", "sources", "tokens"],
        "RetryConfig": None,
        "RouteConfig": ["route"],
        "RtuSerialConfig": ["device"],
        "RuleConfig": ["sources", "units", "access"],
        "Seal": ["area", "address"],
        "SerialRuleConfig": ["units", "access"],
        "SharedLogConfig": ["node"],
        "ServerTlsConfig": ["cert_file", "key_file", "ca_file"],
        "Span": ["size"],
        "StaleConfig": ["after"],
        "StatusConfig": ["area", "slot", "memory"],
        "SparkplugConfig": ["url", "type", "group", "edge_node"],
        "SubscriptionConfig": ["topic", "memories", "areas"],
        "TagConfig": ["area", "address"],
        "TlsRuleConfig": ["sources", "units", "access"],
        "TokenConfig": ["name", "sha256", "memories", "areas", "access"],
        "ToleranceConfig": None,
        "UnitMemoryConfig": ["memory"],
    }
    assert "required" not in json_schema()


def test_the_schema_is_the_same_in_every_version() -> None:
    assert "default" not in properties(json_schema())["IdentityConfig.revision"]
    assert "default" not in properties(json_schema())["Config.identity"]

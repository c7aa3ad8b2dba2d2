"""What a good configuration comes to: defaults, both forms of an area, initial values, dump."""

from __future__ import annotations

import json
from ipaddress import ip_network
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.config import (
    Config,
    InitialRun,
    Seal,
    Span,
    json_schema,
    load,
)

if TYPE_CHECKING:
    from collections.abc import Callable

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
EXAMPLES = Path(__file__).parents[1] / "examples"


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
    scada = loaded().listeners["scada"]
    assert (scada.max_connections, scada.max_connections_per_source) == (256, None)
    assert (scada.when_full, scada.idle_timeout, scada.request_timeout) == ("refuse", 300, 10)


def test_the_appliance_has_the_documented_defaults(loaded: Callable[..., Config]) -> None:
    config = loaded()
    assert (config.log.level, config.log.format, config.workers) == ("info", "text", 1)
    assert (config.identity.vendor_name, config.identity.product_code) == ("Holdfast", "HF")
    assert config.identity.unit_names == {}


def test_a_rule_holds_networks_units_and_access(loaded: Callable[..., Config]) -> None:
    (rule,) = loaded().listeners["scada"].rules
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
    bind = loaded((SMALL % "").replace("127.0.0.1:5020", f'"{text}"')).listeners["scada"].bind
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


def test_the_gate_bit_may_be_given_as_0(loaded: Callable[..., Config]) -> None:
    extra = ", seal: {area: coils, address: 7}, initial: v.csv"
    plant = loaded(SMALL % extra, v_csv="coils,7,0\n").memories["plant"]
    assert plant.initial_values == (InitialRun("coils", 7, (0,)),)


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
        "    max_connections_per_source: null\n"
        "    when_full: refuse\n"
        "    idle_timeout: 300\n"
        "    request_timeout: 10\n"
        "    rules:\n"
        "      - sources: [10.0.0.7/32, fd00::/64]\n"
        "        units: {1: plant, 16: plant}\n"
        "        access: read-only\n"
        "log:\n"
        "  level: info\n"
        "  format: text\n"
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
        assert load(path).memories


NAMES = st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True)
TEXTS = st.text(st.characters(exclude_categories=("Cc", "Cs")), min_size=1, max_size=60)
SPANS = st.integers(0, 65535).flatmap(
    lambda start: st.integers(1, 65536 - start).map(lambda size: {"start": start, "size": size})
)
SIZES = st.integers(1, 65536) | SPANS
CODES = st.lists(st.sampled_from([1, 2, 3, 4, 8, 11, 17, 43]), min_size=1, unique=True)
NETWORKS = st.ip_addresses(v=4, network="10.0.0.0/8").map(str) | st.ip_addresses(
    v=6, network="fd00::/16"
).map(str)


@st.composite
def rules(draw: st.DrawFn, memories: list[str], source: str) -> dict[str, Any]:
    rule: dict[str, Any] = {
        "sources": [source],
        "units": draw(
            st.dictionaries(st.integers(0, 255), st.sampled_from(memories), min_size=1, max_size=4)
        ),
        "access": draw(st.sampled_from(["read-only", "read-write"])),
    }
    limit = draw(st.sampled_from([None, "functions", "deny"]))
    return rule if limit is None else {**rule, limit: draw(CODES)}


@st.composite
def listeners(draw: st.DrawFn, memories: list[str], port: int) -> dict[str, Any]:
    sources = draw(st.lists(NETWORKS, min_size=1, max_size=3, unique=True))
    most = draw(st.integers(1, 65535))
    return {
        "type": "modbus-tcp",
        "bind": f"127.0.0.1:{port}",
        "rules": [draw(rules(memories, source)) for source in sources],
        "max_connections": most,
        "max_connections_per_source": draw(st.none() | st.integers(1, most)),
        "when_full": draw(st.sampled_from(["refuse", "evict"])),
        "idle_timeout": draw(st.just(0) | st.floats(0.001, 31_622_400) | st.integers(1, 1000)),
        "request_timeout": draw(st.floats(0.001, 31_622_400)),
    }


@st.composite
def configurations(draw: st.DrawFn) -> dict[str, Any]:
    areas = st.fixed_dictionaries(
        {"holding_registers": SIZES},
        optional={"coils": SIZES, "discrete_inputs": SIZES, "input_registers": SIZES},
    )
    memories = draw(st.dictionaries(NAMES, areas, min_size=1, max_size=3))
    names = draw(st.lists(NAMES, min_size=1, max_size=3, unique=True))
    return {
        "memories": memories,
        "identity": draw(
            st.fixed_dictionaries(
                {"vendor_name": TEXTS},
                optional={
                    "revision": TEXTS,
                    "model_name": TEXTS,
                    "unit_names": st.dictionaries(st.integers(0, 255), TEXTS, max_size=3),
                    "objects": st.dictionaries(st.integers(128, 255), TEXTS, max_size=3),
                },
            )
        ),
        "listeners": {
            name: draw(listeners(list(memories), 5000 + index)) for index, name in enumerate(names)
        },
        "workers": draw(st.integers(1, 64)),
    }


def written(data: object) -> str:
    """The data as YAML on one line, all text quoted."""
    if isinstance(data, dict):
        return "{" + ", ".join(f"{written(k)}: {written(v)}" for k, v in data.items()) + "}"
    if isinstance(data, list):
        return "[" + ", ".join(written(item) for item in data) + "]"
    return json.dumps(data, ensure_ascii=False)


@settings(deadline=None, max_examples=60)
@given(data=configurations())
def test_every_dump_loads_as_an_equal_configuration(
    tmp_path_factory: pytest.TempPathFactory, data: dict[str, Any]
) -> None:
    path = tmp_path_factory.mktemp("dump") / "plant.yaml"
    path.write_text(written(data), encoding="utf-8")
    config = load(path)
    path.write_text(config.dump(), encoding="utf-8")
    again = load(path)
    assert again == config
    assert again.dump() == config.dump()


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


def test_the_schema_takes_null_only_where_it_means_no_limit() -> None:
    nullable = [
        key
        for key, node in properties(json_schema()).items()
        if {"type": "null"} in node.get("anyOf", ())
    ]
    assert nullable == ["ModbusTcpListener.max_connections_per_source"]


def test_the_schema_asks_for_what_bears_on_safety() -> None:
    schema = json_schema()
    assert schema["$defs"]["RuleConfig"]["required"] == ["sources", "units", "access"]
    assert schema["$defs"]["ModbusTcpListener"]["required"] == ["type", "bind", "rules"]
    assert schema["required"] == ["memories", "listeners"]


def test_the_schema_is_the_same_in_every_version() -> None:
    assert "default" not in properties(json_schema())["IdentityConfig.revision"]
    assert "default" not in properties(json_schema())["Config.identity"]

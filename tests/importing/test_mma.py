"""`holdfast import mma`: what a configuration of either generation becomes."""

from __future__ import annotations

import functools
import hashlib
import ipaddress
import json
import operator
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from holdfast.cli import main
from holdfast.config import load
from holdfast.config.dump import to_yaml
from holdfast.config.text.yaml_document import parse
from holdfast.importing import NotImportable, read_mma
from holdfast.importing.key_reader import Section
from holdfast.importing.mma.address_filters import EVERYBODY, Peers, parse_network, read_filter
from holdfast.importing.mma.function_rights import ALL, SOURCE, touching
from holdfast.importing.mma.policies import Policy, merged
from holdfast.importing.notes import Desk
from holdfast.types import AREAS
from support.paths import DATA, DOCS

if TYPE_CHECKING:
    from collections.abc import Callable

    from click.testing import Result

    from holdfast.importing import Imported
    from holdfast.net.addresses import Address, Network

    class Import(Protocol):
        """Imports a text."""

        def __call__(self, text: str, **options: Any) -> Imported: ...


MMA = DATA / "mma"
SAMPLES = sorted(MMA.glob("*.yaml"))

MEMORY = "memory: {memories: {plant: {coils: {start: 0, size: 8}}}}\n"
ROUTING = "routing: {unit_id_map: {1: plant}}\n"
PORT = "ports: {502: {unit_ids: all, memories: all, access: read-write%s}}\n"
FIRST = MEMORY + ROUTING + PORT % ""
RULE = "{id: a, source_ip: [10.0.0.0/8], allow_fc: [1, 2, 3, 4, 5, 6, 15, 16]}"
ALLOW = RULE.partition("allow_fc")[0] + "allow: %s}"
READ_WRITE = {"access": "read-write", "functions": [1, 2, 3, 4, 5, 6, 15, 16]}
SECOND = """\
listeners:
  - id: main
    listen: 127.0.0.1:502
    memory:
      - unit_id: 1
        coils: {start: 0, count: 8}
        holding_registers: {start: 0, count: 4}
        policy: {rules: [%s]}
        %s
"""
AREA_LINES = """\
        coils: {start: 0, count: 8}
        holding_registers: {start: 0, count: 4}
"""
REST = """\
rest:
  enabled: true
  address: %s
  auth: {enabled: true, type: bearer, bearer: {tokens: [{name: gate, token: %s}]}}
"""
MQTT = "mqtt: {enabled: true, broker: %s, client_id: c, topic: t%s}\n"
RAW = "raw_ingest: {enabled: true, listen: ':9000', max_packet_bytes: 99, read_timeout_ms: 1500}\n"
NUMBERED = FIRST.replace("{plant:", "{5:").replace("plant", "5")
FOUR_AREAS = FIRST.replace(
    "coils: {start: 0, size: 8}", ", ".join(f"{area}: {{size: 8}}" for area in AREAS)
)


@pytest.fixture
def imported(tmp_path: Path) -> Import:
    def read(text: str, **options: Any) -> Imported:
        path = tmp_path / "mma.yaml"
        path.write_text(text, encoding="utf-8")
        found = read_mma(path, **options)
        (tmp_path / "mqtt.password").write_text("x")
        (tmp_path / "new.yaml").write_text(found.to_yaml(), encoding="utf-8")
        load(tmp_path / "new.yaml")
        return found

    return read


@pytest.fixture
def refused(imported: Import) -> Callable[..., list[str]]:
    def problems(text: str, **options: Any) -> list[str]:
        with pytest.raises(NotImportable) as error:
            imported(text, **options)
        return [str(problem).partition("mma.yaml:")[2] for problem in error.value.problems]

    return problems


def notes(found: Imported) -> list[str]:
    return [str(note).partition("mma.yaml:")[2] for note in found.notes]


def noted(found: Imported, *parts: str) -> bool:
    return any(all(part in note for part in parts) for note in notes(found))


def port(found: Imported, name: str = "port-502") -> dict[str, Any]:
    listener: dict[str, Any] = found.data["listeners"][name]
    return listener


def rule(found: Imported, name: str = "port-502") -> dict[str, Any]:
    only: dict[str, Any]
    (only,) = port(found, name)["rules"]
    return only


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["import", "mma", *map(str, arguments)])


# What loads.


@pytest.mark.parametrize("as_meant", [False, True])
@pytest.mark.parametrize("sample", SAMPLES, ids=lambda path: path.stem)
def test_every_sample_becomes_a_configuration_that_loads(
    sample: Path, as_meant: bool, tmp_path: Path
) -> None:
    (tmp_path / "mqtt.password").write_text("x")
    text = read_mma(sample, as_meant=as_meant, keep_published_tokens=as_meant).to_yaml()
    (tmp_path / "new.yaml").write_text(text, encoding="utf-8")
    config = load(tmp_path / "new.yaml")
    doubts = [doubt for doubt in config.warnings if "can never be opened" not in str(doubt)]
    assert doubts == []


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda path: path.stem)
def test_what_is_printed_is_what_programs_get(sample: Path) -> None:
    found = read_mma(sample)
    document, problems = parse(found.to_yaml(), "new.yaml")
    assert (document.data, problems) == (found.data, [])


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda path: path.stem)
def test_every_note_is_a_comment_and_names_line_and_key(sample: Path) -> None:
    found = read_mma(sample)
    comments = [line for line in found.to_yaml().splitlines() if line.startswith("#")]
    assert [f"# {note}" for note in found.notes] == comments[3:]
    for note in found.notes:
        assert f"{sample}:{note.line}: {note.key}: " in str(note)


def test_a_generation_is_told_from_the_other() -> None:
    found = {path.stem: read_mma(path).generation for path in SAMPLES}
    assert found == {"plant": 1, "minimal": 1, "adapters": 1, "listeners": 2, "policies": 2}


def test_the_example_of_the_page_is_what_the_command_makes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (DOCS / "moving-from-mma.md").read_text()
    old, new, *_ = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text(old)
    assert read_mma("config.yaml").to_yaml() == new


# The first generation.


def test_areas_take_the_short_form_where_they_start_at_0(imported: Import) -> None:
    text = FIRST.replace("size: 8}", "size: 8}, input_registers: {start: 100, size: 20}")
    assert imported(text, as_meant=True).data["memories"] == {
        "plant": {"coils": 8, "input_registers": {"start": 100, "size": 20}}
    }


def test_the_start_of_an_area_had_no_effect(imported: Import) -> None:
    text = FIRST.replace("size: 8}", "size: 8}, input_registers: {start: 100, size: 20}")
    found = imported(text)
    assert found.data["memories"] == {"plant": {"coils": 8, "input_registers": 20}}
    assert noted(
        found,
        "1: memory.memories.plant.input_registers.start: left out: as it ran: addresses start at "
        "0; as it was meant: addresses start at 100 (--as-it-was-meant)",
    )


def test_an_area_of_no_size_is_left_out(imported: Import) -> None:
    found = imported(FIRST.replace("size: 8}", "size: 8}, input_registers: {start: 0, size: 0}"))
    assert found.data["memories"] == {"plant": {"coils": 8}}
    assert noted(found, "input_registers: left out: the area has no addresses")


def test_a_default_memory_is_noted(imported: Import) -> None:
    found = imported(FIRST.replace("{coils", "{default: true, coils"))
    assert noted(found, "1: memory.memories.plant.default: left out: there is no default memory")


def test_a_numeric_name_becomes_an_id(imported: Import) -> None:
    assert imported(NUMBERED).data["memories"] == {"5": {"id": 5, "coils": 8}}


@pytest.mark.parametrize("name", ["07", "65536", "x1"])
def test_other_names_are_no_ids(imported: Import, name: str) -> None:
    found = imported(FIRST.replace("plant", f"'{name}'"))
    assert "id" not in found.data["memories"][name]


def test_a_name_that_is_not_allowed_is_changed_everywhere(imported: Import) -> None:
    areas = "{coils: {start: 0, size: 8}}"
    memory = f"memory: {{memories: {{'a b': {areas}, a_b: {areas}, 'ä b': {areas}}}}}\n"
    routing = "routing: {unit_id_map: {1: a b, 2: a_b, 3: ä b}}\n"
    found = imported(memory + routing + PORT % "")
    assert list(found.data["memories"]) == ["a_b-2", "a_b", "__b"]
    assert rule(found)["units"] == {1: "a_b-2", 2: "a_b", 3: "__b"}
    assert noted(found, "memory.memories.'a b': changed: renamed to a_b-2")


SEAL = "state_sealing: {enable: true, gate: {area: discrete_inputs, address: 3}}"
SEALED = FIRST.replace("{coils", "{discrete_inputs: {start: 0, size: 8}, coils")


def test_a_seal_of_one_memory_opens_once(imported: Import) -> None:
    found = imported(SEALED.replace("{discrete", f"{{{SEAL}, discrete"))
    seal = {"area": "discrete_inputs", "address": 3, "mode": "once"}
    assert found.data["memories"]["plant"]["seal"] == seal


def test_a_seal_of_all_memories_had_no_effect(imported: Import) -> None:
    text = SEALED.replace("memory: {", f"memory: {{{SEAL}, ")
    ran, meant = imported(text), imported(text, as_meant=True)
    assert "seal" not in ran.data["memories"]["plant"]
    assert noted(
        ran,
        "1: memory.state_sealing: left out: as it ran: it had no effect; as it was meant: it seals "
        "every memory without a seal of its own (--as-it-was-meant)",
    )
    assert meant.data["memories"]["plant"]["seal"]["address"] == 3
    assert noted(
        meant,
        "1: memory.state_sealing: changed: as it was meant: it seals every memory without a seal "
        "of its own; as it ran: it had no effect (--as-it-ran)",
    )


def test_a_seal_of_its_own_stands_before_that_of_all(imported: Import) -> None:
    off = "{state_sealing: {enable: false}, discrete"
    text = SEALED.replace("memory: {", f"memory: {{{SEAL}, ").replace("{discrete", off)
    found = imported(text)
    assert "seal" not in found.data["memories"]["plant"]
    assert noted(found, "plant.state_sealing: left out: not enabled")


def test_a_seal_that_nothing_can_open_is_noted(imported: Import) -> None:
    text = SEALED.replace("{discrete", f"{{{SEAL}, discrete")
    assert noted(imported(text), "nothing can open plant")
    assert not noted(imported(text + MQTT % ("b", "")), "nothing can open")


def test_a_port_serves_units_that_map_and_port_allow(imported: Import) -> None:
    memories = "memory: {memories: {a: {coils: 8}, b: {coils: 8}}}\n"
    routing = "routing: {unit_id_map: {1: a, 2: b, 3: a, 4: b}}\n"
    ports = "ports: {502: {unit_ids: [1, 2, 9], memories: [a], access: read-only}}\n"
    found = imported(memories + routing + ports)
    assert rule(found)["units"] == {1: "a"}
    assert rule(found)["access"] == "read-only"
    assert noted(found, "ports.502.unit_ids[2]", "unit id 9 is not in routing.unit_id_map")
    assert noted(found, "routing.unit_id_map.3: left out: no port serves")


def test_a_port_that_serves_no_unit_is_left_out(imported: Import) -> None:
    other = "503: {unit_ids: [9], memories: all, access: read-only}"
    found = imported(FIRST.replace("ports: {", f"ports: {{{other}, "))
    assert list(found.data["listeners"]) == ["port-502"]
    assert noted(found, "ports.503: left out: the port is left out: it allows no unit id")


@pytest.mark.parametrize(
    ("key", "bind", "note"),
    [
        ("502", "[::]:502", "check: listens on all addresses, [::]:502; without IPv6"),
        ("':502'", "[::]:502", "check: listens on all addresses, [::]:502; without IPv6"),
        ("'0.0.0.0:502'", "[::]:502", "left out: as it ran: IPv4 and IPv6, [::]:502; as it was"),
        ("'10.0.0.1:502'", "10.0.0.1:502", ""),
        ("'[::]:502'", "[::]:502", ""),
        ("localhost:502", "127.0.0.1:502", "changed: listens on 127.0.0.1:502: host names are"),
    ],
)
def test_a_port_is_a_number_or_an_address(imported: Import, key: str, bind: str, note: str) -> None:
    found = imported(FIRST.replace("{502:", f"{{{key}:"))
    assert port(found)["bind"] == bind
    assert noted(found, note or "listens on") == bool(note)


def test_ipv4_addresses_are_ipv4_only_if_that_was_meant(imported: Import) -> None:
    found = imported(FIRST.replace("{502:", "{'0.0.0.0:502':"), as_meant=True)
    assert port(found)["bind"] == "0.0.0.0:502"
    assert noted(found, "changed: as it was meant: IPv4 only; as it ran: IPv4 and IPv6")


def test_a_full_port_closes_the_connection_that_is_idle_longest(imported: Import) -> None:
    assert port(imported(FIRST))["when_full"] == "evict"
    assert port(imported(FIRST))["max_connections_per_source"] is None
    assert port(imported(FIRST))["idle_timeout"] == 0
    assert port(imported(SECOND % (RULE, "")), "main")["when_full"] == "evict"


@pytest.mark.parametrize(
    ("written", "most"), [("", 32), (", max_connections: 5", 5), (", max_connections: 0", 32)]
)
def test_a_port_takes_32_connections_by_default(imported: Import, written: str, most: int) -> None:
    found = imported(MEMORY + ROUTING + PORT % written)
    assert port(found)["max_connections"] == most


@pytest.mark.parametrize(
    ("codes", "rights"),
    [
        ("allow: [3, 4, 16]", {"functions": [3, 4, 16]}),
        ("allow: [3, 6, 16], deny: [6]", {"functions": [3, 16]}),
        ("allow: [], deny: [1]", {"deny": [1]}),
        ("deny: [5]", {"deny": [5]}),
        ("deny: [5, 6]", {"deny": [5, 6, 22, 23]}),
        ("deny: [3]", {"deny": [3, 23]}),
        ("deny: [6, 22, 16]", {"deny": [6, 22, 16, 23]}),
        ("deny: []", {}),
        ("allow: [3, 3, 100]", {"functions": [3]}),
    ],
)
def test_function_codes(imported: Import, codes: str, rights: dict[str, Any]) -> None:
    found = rule(imported(MEMORY + ROUTING + PORT % f", function_codes: {{{codes}}}"))
    assert {key: found[key] for key in ("functions", "deny") if key in found} == rights


def test_functions_that_write_are_not_listed_where_nothing_is_written(imported: Import) -> None:
    text = PORT.replace("read-write", "read-only") % ", function_codes: {allow: [3, 6]}"
    found = imported(MEMORY + ROUTING + text)
    assert rule(found)["functions"] == [3]
    assert noted(found, "function_codes.allow: changed: without 6: it writes")


def test_an_unknown_function_code_is_noted(imported: Import) -> None:
    found = imported(MEMORY + ROUTING + PORT % ", function_codes: {deny: [7]}")
    assert "deny" not in rule(found)
    assert noted(found, "function_codes.deny[0]: left out: function 7 is not supported")


def test_a_port_that_allows_no_function_is_left_out(
    refused: Callable[[str], list[str]],
) -> None:
    text = MEMORY + ROUTING + PORT % ", function_codes: {allow: [6], deny: [6]}"
    assert refused(text) == ["1: nothing to serve, allowed: at least one listener, REST or MQTT"]


def test_denied_addresses_are_cut_out(imported: Import) -> None:
    filters = "ip_filter: {allow: [10.0.0.0/30, 'fd00::/127'], deny: [10.0.0.2, 'fd00::1']}"
    found = imported(MEMORY + ROUTING + PORT % f", {filters}")
    assert rule(found)["sources"] == ["10.0.0.0/31", "10.0.0.3", "fd00::"]


def test_both_filters_must_let_a_peer_in(imported: Import) -> None:
    filters = "ip_filter: {allow: [10.0.0.0/8]}"
    text = MEMORY + ROUTING + PORT % f", {filters}" + "ip_filter: {deny: [10.128.0.0/9]}"
    assert rule(imported(text, as_meant=True))["sources"] == ["10.0.0.0/9"]


def test_a_filter_of_the_whole_file_had_no_effect(imported: Import) -> None:
    found = imported(FIRST + "ip_filter: {allow: [10.0.0.0/8]}")
    assert rule(found)["sources"] == ["0.0.0.0/0", "::/0"]
    assert noted(
        found,
        "4: ip_filter: left out: as it ran: it had no effect; as it was meant: only the addresses "
        "that it allows have access (--as-it-was-meant)",
    )


def test_without_a_filter_everybody_is_let_in_and_that_is_noted(imported: Import) -> None:
    found = imported(FIRST)
    assert rule(found)["sources"] == ["0.0.0.0/0", "::/0"]
    assert noted(found, "ports.502: check: no ip_filter")


def test_an_ipv4_address_mapped_into_ipv6_becomes_ipv4(imported: Import) -> None:
    filters = "ip_filter: {allow: ['::ffff:10.0.0.1', '::ffff:10.1.0.0/112']}"
    found = imported(MEMORY + ROUTING + PORT % f", {filters}")
    assert rule(found)["sources"] == ["10.0.0.1", "10.1.0.0/16"]


def test_a_filter_that_lets_nobody_in_leaves_the_port_out(imported: Import) -> None:
    other = "503: {unit_ids: all, memories: all, access: read-only, ip_filter: {deny: [0.0.0.0/0]}}"
    text = FIRST.replace("ports: {", f"ports: {{{other}, ") + "ip_filter: {allow: [10.0.0.0/8]}"
    found = imported(text, as_meant=True)
    assert list(found.data["listeners"]) == ["port-502"]
    assert noted(found, "ports.503: left out: the port is left out: its ip_filter")


def test_every_unknown_key_is_noted_with_its_line(imported: Import) -> None:
    text = FIRST + "historian:\n  url: x\n"
    text = text.replace("{coils: {start: 0,", "{coil: 5, coils: {first: 3, start: 0,")
    text = text.replace("all, access", "all, acces: 1, access")
    found = imported(text)
    assert noted(found, "4: historian: left out: unknown key")
    assert noted(
        found, "1: memory.memories.plant.coil: left out: unknown key; did you mean 'coils'"
    )
    assert noted(found, "1: memory.memories.plant.coils.first: left out: unknown key")
    assert noted(found, "3: ports.502.acces: left out: unknown key; did you mean 'access'")


def test_other_answers_to_what_is_not_allowed_are_noted(imported: Import) -> None:
    assert noted(imported(FIRST), "ports: check:", "0x01", "0x0B", "0x02")


# The second generation.


def raw_ingest(units: dict[int, str], areas: list[str]) -> dict[str, Any]:
    """What everybody may write by Raw Ingest."""
    rule = {"sources": ["0.0.0.0/0", "::/0"], "units": units, "areas": areas}
    compat = {"packets": "many", "after_refusal": "continue"}
    return {"compat": compat, "rules": [rule]}


def test_a_listener_keeps_its_name_and_names_its_memory(imported: Import) -> None:
    found = imported(SECOND % (RULE, ""))
    assert found.data["memories"] == {"main-1": {"coils": 8, "holding_registers": 4}}
    assert port(found, "main") == {
        "type": "modbus-tcp",
        "bind": "127.0.0.1:502",
        "max_connections_per_source": None,
        "when_full": "evict",
        "idle_timeout": 0,
        "rules": [{"sources": ["10.0.0.0/8"], "units": {1: "main-1"}, **READ_WRITE}],
        "raw_ingest": raw_ingest({1: "main-1"}, ["coils", "holding_registers"]),
    }


@pytest.mark.parametrize(
    ("allowed", "rights"),
    [
        ("allow: ro", {"access": "read-only"}),
        ("allow: rw", {"access": "read-write"}),
        ("allow: wo", {"access": "read-write", "functions": [5, 6, 15, 16]}),
        ("allow_fc: [4, 3]", {"access": "read-only", "functions": [3, 4]}),
        ("allow_fc: [3, 16, 99]", {"access": "read-write", "functions": [3, 16]}),
    ],
)
def test_what_a_policy_rule_allows(imported: Import, allowed: str, rights: dict[str, Any]) -> None:
    text = SECOND % (ALLOW.replace("allow: %s", allowed), "")
    found = rule(imported(text, as_meant=allowed.startswith("allow: ")), "main")
    assert {key: found[key] for key in ("access", "functions") if key in found} == rights


def test_write_only_is_noted(imported: Import) -> None:
    found = imported(SECOND % (ALLOW % "wo", ""), as_meant=True)
    assert noted(found, "policy.rules[0].allow: changed: only functions 5, 6, 15, 16")


@pytest.mark.parametrize("word", ["ro", "rw", "wo"])
def test_allow_had_no_effect_so_its_rule_allows_nothing(imported: Import, word: str) -> None:
    """Its peers are refused, also by later rules: the first rule that names a peer decides."""
    rules = ALLOW.replace("10.0.0.0/8", "10.0.0.0/9") % word + ", " + RULE
    found = imported(SECOND % (rules, ""))
    assert rule(found, "main")["sources"] == ["10.128.0.0/9"]
    at = "listeners[0].memory[0].policy.rules[0].allow"
    assert noted(
        found,
        f"{at}: left out: as it ran: it had no effect: the rule allowed no function",
        "as it was meant: its peers may",
        "--as-it-was-meant",
    )
    meant = imported(SECOND % (rules, ""), as_meant=True)
    assert [len(one["sources"]) for one in port(meant, "main")["rules"]] == [1, 1]
    assert noted(
        meant, f"{at}: changed: as it was meant: its peers may", "as it ran: it had no effect"
    )


def test_beside_allow_fc_allow_had_no_effect(imported: Import) -> None:
    found = imported(SECOND % (ALLOW % "rw, allow_fc: [3]", ""))
    assert rule(found, "main")["functions"] == [3]
    assert noted(found, "rules[0].allow: left out: as it ran: it had no effect: allow_fc decided")


def test_a_word_that_allow_never_had_is_an_error_only_if_it_is_to_have_an_effect(
    imported: Import, refused: Callable[..., list[str]]
) -> None:
    text = SECOND % (ALLOW % "all" + ", " + RULE.replace("10.", "11."), "")
    assert rule(imported(text), "main")["sources"] == ["11.0.0.0/8"]
    assert noted(imported(text), "rules[0].allow: left out", "an error: it is not ro, rw or wo")
    (problem,) = refused(text, as_meant=True)
    assert "allow: found 'all', allowed: ro, rw or wo" in problem


def test_a_sealing_coil_is_followed(imported: Import) -> None:
    seal = "state_sealing: {area: coil, address: 7, exception: 0x0B}"
    found = imported(SECOND % (RULE, seal))
    expected = {"area": "coils", "address": 7, "mode": "level"}
    assert found.data["memories"]["main-1"]["seal"] == expected
    assert noted(found, "state_sealing.exception: left out", "0x06")
    assert not noted(found, "nothing can open main-1")


def test_a_seal_that_is_off_is_left_out(imported: Import) -> None:
    seal = "state_sealing: {enabled: false, area: coil, address: 7}"
    assert "seal" not in imported(SECOND % (RULE, seal)).data["memories"]["main-1"]


def test_a_memory_without_a_policy_is_served_to_nobody(imported: Import) -> None:
    found = imported(SECOND % (RULE, "") + "      - {unit_id: 2, coils: {start: 0, count: 1}}\n")
    assert rule(found, "main")["units"] == {1: "main-1"}
    assert "main-2" in found.data["memories"]
    assert noted(found, "10: listeners[0].memory[1]: check: no policy")


def test_each_unit_of_a_sample_has_rules_of_its_own() -> None:
    imported = read_mma(MMA / "policies.yaml", as_meant=True)
    rules = imported.data["listeners"]["ems"]["rules"]
    assert [(one["units"], one["access"], one.get("functions")) for one in rules] == [
        ({1: "inverter"}, "read-only", None),
        ({2: "setpoints"}, "read-write", None),
        ({2: "setpoints"}, "read-write", [5, 6, 15, 16]),
        ({3: "status"}, "read-only", [2]),
    ]
    assert [one["sources"] for one in rules[1:]] == [["10.20.1.10"], ["10.20.1.11"], ["0.0.0.0/0"]]
    blocked = [ipaddress.ip_network(source) for source in rules[0]["sources"]]
    assert Peers.of(map(parse_network, ["10.20.0.0/16", "fd00:20::/32"])) - Peers.of(
        blocked
    ) == Peers.of([parse_network("10.20.5.0/28")])


def test_a_unit_that_allows_nothing_is_noted(imported: Import) -> None:
    other = "{unit_id: 2, holding_registers: {start: 0, count: 1}, policy: {rules: [%s]}}"
    nothing = ALLOW.replace("allow: %s", "allow_fc: [4]")
    found = imported(SECOND % (RULE, "") + f"      - {other % nothing}\n")
    assert rule(found, "main")["units"] == {1: "main-1"}
    assert noted(found, "listeners[0]: check: no rule serves unit 2")


def test_each_unit_keeps_its_own_rules(imported: Import) -> None:
    rules = "{source_ip: [10.1.0.0/16], allow_fc: [3]}, " + RULE
    other = "{unit_id: 2, holding_registers: {start: 0, count: 1}, policy: {rules: [" + RULE + "]}}"
    found = imported(SECOND % (rules, "") + f"      - {other}\n")
    both = {1: "main-1", 2: "main-2"}
    assert port(found, "main")["rules"] == [
        {
            "sources": ["10.1.0.0/16"],
            "units": {1: "main-1"},
            "access": "read-only",
            "functions": [3],
        },
        {"sources": ["10.0.0.0/8"], "units": both, **READ_WRITE},
    ]
    assert not noted(found, "listeners[0]: changed")


def test_a_rule_that_allows_nothing_is_cut_out_of_later_ones(imported: Import) -> None:
    rules = "{source_ip: [10.0.0.0/9], allow_fc: []}, " + RULE
    found = imported(SECOND % (rules, ""))
    assert rule(found, "main")["sources"] == ["10.128.0.0/9"]


def test_same_names_in_two_listeners_are_two_memories(imported: Import) -> None:
    first = SECOND % (RULE, "name: a")
    second = first.partition("\n")[2].replace("main", "lab").replace(":502", ":503")
    found = imported(first + second)
    assert list(found.data["memories"]) == ["a", "a-2"]
    assert rule(found, "lab")["units"] == {1: "a-2"}
    assert noted(found, "listeners[1].memory[0].name: changed: renamed to a-2")


def test_names_with_a_meaning_in_logs_are_changed(imported: Import) -> None:
    found = imported((SECOND % (RULE, "")).replace("main", "rest"))
    assert list(found.data["listeners"]) == ["rest-2"]
    assert noted(found, "changed: renamed to rest-2: the name has another meaning in logs")
    text = (SEALED + REST % ("127.0.0.1:8080", "x" * 20)).replace("name: gate", "name: '-'")
    assert imported(text).data["rest"]["tokens"][0]["name"] == "--2"


@pytest.mark.parametrize("key", ["debug", "rbe", "notify", "persistence", "access_events"])
def test_what_has_no_counterpart_is_noted_with_the_reason(imported: Import, key: str) -> None:
    found = imported(SECOND % (RULE, "") + f"{key}: true\n")
    assert noted(found, f"10: {key}: left out: ")
    assert not noted(found, "unknown key")


def test_everybody_may_write_by_raw_ingest_whatever_the_policies_say(imported: Import) -> None:
    nobody = "      - {unit_id: 2, name: silent, input_registers: {start: 0, count: 1}}\n"
    found = imported(SECOND % (RULE, "") + nobody)
    areas = ["coils", "holding_registers", "input_registers"]
    assert port(found, "main")["raw_ingest"] == raw_ingest({1: "main-1", 2: "silent"}, areas)
    assert rule(found, "main")["units"] == {1: "main-1"}
    assert noted(
        found,
        "2: listeners[0]: check: every address may write all areas of all its units by Raw Ingest",
        "as it ran",
        "or remove raw_ingest",
    )


def test_the_filter_of_the_whole_file_can_limit_raw_ingest(imported: Import) -> None:
    text = SECOND % (RULE, "") + "ip_filter: {allow: [10.0.0.0/9]}\n"
    (limited,) = port(imported(text, as_meant=True), "main")["raw_ingest"]["rules"]
    assert limited["sources"] == ["10.0.0.0/9"]


def test_a_listener_without_policies_takes_only_raw_ingest(imported: Import) -> None:
    found = imported(SECOND % (ALLOW.replace("allow: %s", "allow_fc: []"), ""))
    assert port(found, "main") == {
        "type": "raw-ingest",
        "bind": "127.0.0.1:502",
        "max_connections_per_source": None,
        "when_full": "evict",
        "idle_timeout": 0,
        **raw_ingest({1: "main-1"}, ["coils", "holding_registers"]),
    }
    assert noted(found, "listeners[0]: changed: no policy allows a function for its areas")


# REST, MQTT and Raw Ingest.


def test_tokens_are_hashed(imported: Import) -> None:
    found = imported(SEALED + REST % ("127.0.0.1:8080", "a-long-secret-token-of-a-gate"))
    assert found.data["rest"] == {
        "bind": "127.0.0.1:8080",
        "sources": ["127.0.0.0/8", "::1"],
        "tokens": [
            {
                "name": "gate",
                "sha256": hashlib.sha256(b"a-long-secret-token-of-a-gate").hexdigest(),
                "memories": ["plant"],
                "areas": ["discrete_inputs"],
                "access": "read-write",
            }
        ],
    }
    assert noted(
        found, "rest.auth: check: each token may write discrete inputs and input registers"
    )
    assert noted(found, "rest.auth: check: as it ran: these tokens had no effect")


def test_a_token_that_looks_octal_is_not_shown(imported: Import) -> None:
    with pytest.raises(NotImportable) as raised:
        imported(FIRST + REST % ("127.0.0.1:8080", "0123456701234567"))
    messages = [each.message for each in raised.value.problems]
    assert messages[0] == (
        "found a number (hidden, as it may be a secret), which the source read as octal, allowed: "
        "text in quotes"
    )
    assert "23456701234567" not in str(raised.value)


def test_tokens_only_read_where_there_is_nothing_that_rest_could_write(imported: Import) -> None:
    found = imported(FIRST + REST % ("127.0.0.1:8080", "a-long-secret-token-of-a-gate"))
    (token,) = found.data["rest"]["tokens"]
    assert (token["areas"], token["access"]) == (["coils"], "read-only")
    assert noted(found, "rest.auth: check: no memory has discrete inputs or input registers")


def test_an_option_grants_rest_other_areas(imported: Import) -> None:
    text = FOUR_AREAS + REST % ("127.0.0.1:8080", "a-long-secret-token-of-a-gate")
    found = imported(text)
    (token,) = found.data["rest"]["tokens"]
    assert token["areas"] == ["discrete_inputs", "input_registers"]
    assert noted(found, "rest.auth: check", "holding_registers", "--grant-rest AREA[,AREA]")
    more = imported(text, grant_rest=["holding_registers"])
    (token,) = more.data["rest"]["tokens"]
    assert token["areas"] == ["discrete_inputs", "holding_registers", "input_registers"]
    assert noted(more, "rest.auth: check", "and holding registers, by --grant-rest")
    same = imported(text, grant_rest=["input_registers"])
    assert same.data == found.data
    assert not noted(same, "rest.auth: check", "by --grant-rest")


def test_an_option_grants_mqtt_other_areas(imported: Import) -> None:
    text = FOUR_AREAS + MQTT % ("broker", "")
    found = imported(text)
    (topic,) = found.data["mqtt"]["subscriptions"]
    assert topic["areas"] == ["discrete_inputs", "input_registers"]
    assert noted(found, "mqtt.topic: check", "holding_registers", "--grant-mqtt AREA[,AREA]")
    more = imported(text, grant_mqtt=["coils"])
    (topic,) = more.data["mqtt"]["subscriptions"]
    assert topic["areas"] == ["coils", "discrete_inputs", "input_registers"]


@pytest.mark.parametrize("as_meant", [False, True])
def test_messages_may_restore_all_areas_of_a_sealed_memory_but_rest_may_not(
    imported: Import, as_meant: bool
) -> None:
    rest = REST % ("127.0.0.1:8080", "a-long-secret-token-of-a-gate")
    sealed = FOUR_AREAS.replace("{plant: {", f"{{plant: {{{SEAL}, ")
    found = imported(sealed + MQTT % ("broker", "") + rest, as_meant=as_meant)
    (topic,) = found.data["mqtt"]["subscriptions"]
    assert topic["areas"] == ["discrete_inputs", "input_registers"]
    assert topic["while_sealed"] == ["coils", "holding_registers"]
    assert noted(found, "mqtt.topic: check", "coils and holding registers", "while_sealed")
    (token,) = found.data["rest"]["tokens"]
    assert "while_sealed" not in token
    more = imported(sealed + MQTT % ("broker", ""), grant_mqtt=["coils"])
    (topic,) = more.data["mqtt"]["subscriptions"]
    assert topic["while_sealed"] == ["holding_registers"]


def test_without_a_seal_there_is_nothing_to_restore(imported: Import) -> None:
    found = imported(FOUR_AREAS + MQTT % ("broker", ""))
    assert "while_sealed" not in found.data["mqtt"]["subscriptions"][0]


@pytest.mark.parametrize("token", ["CHANGE_ME_LONG_RANDOM", "INGEST_ONLY_TOKEN"])
def test_published_tokens_are_left_out_unless_they_are_to_be_kept(
    imported: Import, token: str
) -> None:
    text = SEALED + REST % ("127.0.0.1:8080", token)
    found = imported(text)
    assert "rest" not in found.data
    assert noted(
        found, "tokens[0]: left out: everybody knows this token", "--keep-published-tokens"
    )
    digest = hashlib.sha256(token.encode()).hexdigest()
    kept = imported(text, as_meant=True, keep_published_tokens=True)
    assert [each["sha256"] for each in kept.data["rest"]["tokens"]] == [digest]


@pytest.mark.parametrize("auth", ["", ", auth: {enabled: false}"])
def test_the_token_that_was_always_accepted_can_be_kept(imported: Import, auth: str) -> None:
    text = f"{SEALED}rest: {{enabled: true, address: ':8080'{auth}}}\n"
    assert "rest" not in imported(text).data
    found = imported(text, keep_published_tokens=True)
    assert noted(found, "each token may write discrete inputs", "--grant-rest AREA[,AREA]")
    rest = found.data["rest"]
    assert rest["bind"] == "[::]:8080"
    assert [(each["name"], each["sha256"], each["areas"]) for each in rest["tokens"]] == [
        ("published", hashlib.sha256(b"INGEST_ONLY_TOKEN").hexdigest(), ["discrete_inputs"])
    ]


def test_rest_admits_those_of_the_filter(imported: Import) -> None:
    text = FIRST + REST % ("':8080'", "x" * 20)
    everybody = imported(text)
    assert everybody.data["rest"]["sources"] == ["0.0.0.0/0", "::/0"]
    assert noted(everybody, "rest: check: sources are all addresses")
    found = imported(text + "ip_filter: {allow: [10.0.0.0/8]}\n", as_meant=True)
    assert found.data["rest"]["sources"] == ["10.0.0.0/8"]
    assert noted(found, "rest: check: sources are from ip_filter")


def test_rest_without_tokens_stays_on_loopback(imported: Import) -> None:
    rest = "rest: {enabled: true, address: '127.0.0.1:8080', auth: {enabled: false}}\n"
    assert imported(FIRST + rest).data["rest"]["tokens"] == "none"
    found = imported(FIRST + rest.replace("127.0.0.1", ""))
    assert "rest" not in found.data
    assert noted(found, "rest: left out: REST is left out: without auth", "holdfast token")
    assert not noted(found, "rest.address")


def test_rest_that_nobody_could_use_is_left_out(imported: Import) -> None:
    found = imported(FIRST + REST % ("127.0.0.1:8080", "''"))
    assert "rest" not in found.data
    assert noted(found, "it has no usable token")


def test_a_short_or_repeated_token_is_noted(imported: Import) -> None:
    text = REST % ("127.0.0.1:8080", "abc}, {name: other, token: abc")
    found = imported(FIRST + text)
    assert [token["name"] for token in found.data["rest"]["tokens"]] == ["gate"]
    assert noted(found, "tokens[0].token: check", "fewer than 16 characters")
    assert noted(found, "tokens[1]: left out: the token repeats")


@pytest.mark.parametrize(
    ("broker", "url"),
    [
        ("localhost:1883", "mqtt://localhost:1883"),
        ("tcp://10.0.0.1:1884", "mqtt://10.0.0.1:1884"),
        ("mqtt://broker", "mqtt://broker"),
        ("ssl://broker:8883", "mqtts://broker:8883"),
        ("mqtts://broker.example", "mqtts://broker.example"),
        ("'tcp://[fd00::1]:1883/'", "mqtt://[fd00::1]:1883"),
    ],
)
def test_the_broker_becomes_a_url(imported: Import, broker: str, url: str) -> None:
    assert imported(SEALED + MQTT % (broker, "")).data["mqtt"] == {
        "url": url,
        "version": "3.1.1",
        "client_id": "c",
        "subscriptions": [
            {"topic": "t", "qos": 0, "memories": ["plant"], "areas": ["discrete_inputs"]}
        ],
    }


def test_mqtt_that_could_write_nothing_is_left_out(imported: Import) -> None:
    found = imported(FIRST + MQTT % ("b", ""))
    assert "mqtt" not in found.data
    assert noted(found, "mqtt: left out: MQTT is left out: no memory has discrete inputs")


def test_a_broker_by_websocket_leaves_mqtt_out(imported: Import) -> None:
    found = imported(FIRST + MQTT % ("wss://broker/mqtt", ""))
    assert "mqtt" not in found.data
    assert noted(found, "mqtt.broker: left out: MQTT is left out: 'wss' is not supported")


def test_the_password_is_to_be_put_in_a_file(imported: Import) -> None:
    found = imported(SEALED + MQTT % ("b", ", username: u, password: geheim"))
    assert found.data["mqtt"]["username"] == "u"
    assert found.data["mqtt"]["password_file"] == "mqtt.password"
    assert noted(found, "mqtt.password: check: write the password into the file mqtt.password")


def test_a_password_without_a_username_is_left_out(imported: Import) -> None:
    found = imported(SEALED + MQTT % ("b", ", username: '', password: geheim"))
    assert "password_file" not in found.data["mqtt"]
    assert noted(found, "mqtt.password: left out")


def test_raw_ingest_becomes_a_listener_without_crc(imported: Import) -> None:
    text = NUMBERED + RAW + "ip_filter: {allow: [10.0.0.0/8]}\n"
    found = imported(text, as_meant=True)
    assert port(found, "raw-ingest") == {
        "type": "raw-ingest",
        "bind": "[::]:9000",
        "format": "crc",
        "compat": {"crc": "none", "flags": "ignore", "packets": "many"},
        "max_connections_per_source": None,
        "when_full": "evict",
        "request_timeout": 1.5,
        "idle_timeout": 1.5,
        "rules": [{"sources": ["10.0.0.0/8"], "memories": ["5"], "areas": ["coils"]}],
    }
    assert noted(found, "raw_ingest.max_packet_bytes: left out")


def test_raw_ingest_never_reached_memories_whose_name_is_no_number(imported: Import) -> None:
    found = imported(FIRST + RAW)
    assert "raw-ingest" not in found.data["listeners"]
    assert noted(found, "raw_ingest: check: could not write plant")
    assert noted(found, "raw_ingest: left out: Raw Ingest is left out")


@pytest.mark.parametrize("section", ["rest", "mqtt", "raw_ingest"])
def test_what_is_not_enabled_is_left_out_with_a_note(imported: Import, section: str) -> None:
    found = imported(FIRST + f"{section}: {{enabled: false, broker: x, listen: 5}}\n")
    assert list(found.data) == ["memories", "listeners"]
    assert noted(found, f"4: {section}: left out: not enabled")


# What can't be imported.


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("size: 8", "size: -1", "coils.size: found -1, allowed: an integer from 0 to 65536"),
        ("size: 8", "size: '8'", "coils.size: found '8', allowed: an integer from 0 to 65536"),
        (
            "start: 0",
            "start: 65535",
            "coils: found start 65535 and size 8, allowed: a sum up to 65536",
        ),
        ("start: 0, size: 8", "start: 0", "coils.size: missing, allowed: an integer"),
        ("coils: {start: 0, size: 8}", "", "plant: found nothing, allowed: a mapping"),
        ("1: plant", "1: plan", "1: found 'plan', allowed: plant; did you mean 'plant'?"),
        ("1: plant", "256: plant", "found 256, allowed: a unit id from 0 to 255"),
        ("502:", "70000:", "ports.70000: found 70000, allowed: a port, :port or address:port"),
        ("502:", "plc:", "ports.plc: found 'plc', allowed: a port, :port or address:port"),
        ("unit_ids: all, ", "", "unit_ids: missing, allowed: all or a list of unit ids"),
        ("unit_ids: all", "unit_ids: [256]", "[0]: found 256, allowed: a unit id from 0 to 255"),
        ("memories: all", "memories: []", "found an empty list, allowed: all or a list of names"),
        ("memories: all", "memories: [x]", "memories[0]: found 'x', allowed: plant"),
        ("read-write", "rw", "access: found 'rw', allowed: read-only or read-write"),
        ("read-write}", "read-write, max_connections: x}", "found 'x', allowed: an integer"),
        (
            "read-write}",
            "read-write, function_codes: {deny: [256]}}",
            "deny[0]: found 256, allowed: a function code from 0 to 255",
        ),
        (
            "read-write}",
            "read-write, ip_filter: {deny: [10.0.0.0/33]}}",
            "deny[0]: found '10.0.0.0/33', allowed: a network or an address",
        ),
        ("{coils", "{<<: {}, coils", "found a merge key, allowed: the keys themselves"),
    ],
)
def test_an_impossible_value_is_refused(
    refused: Callable[[str], list[str]], old: str, new: str, problem: str
) -> None:
    if not new and old.startswith("coils"):
        old, new = "{coils: {start: 0, size: 8}}", "~"
    (found,) = refused(FIRST.replace(old, new))
    assert problem in found


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("id: main", "name: main", "listeners[0].id: missing, allowed: text"),
        ("    listen: 127.0.0.1:502\n", "", "listeners[0].listen: missing"),
        ("unit_id: 1", "name: x", "unit_id: missing, allowed: a unit id from 0 to 255"),
        ("allow_fc: [", "allow: all, x: [", "allow: found 'all', allowed: ro, rw or wo"),
        ("allow_fc", "allow: rw, allow_fc", "allow: found together with allow_fc"),
        ("source_ip: [10.0.0.0/8], ", "", "source_ip: missing, allowed: a list"),
        ("[10.0.0.0/8]", "10.0.0.0/8", "source_ip: found '10.0.0.0/8', allowed: a list"),
        (AREA_LINES, "", "memory[0]: no area, allowed: at least one of"),
        ("policy:", "state_sealing: {area: coil, address: 8}\n        policy:", "0 to 7"),
        ("policy:", "state_sealing: {area: coils, address: 1}\n        policy:", "allowed: coil"),
    ],
)
def test_an_impossible_value_of_the_second_generation_is_refused(
    refused: Callable[..., list[str]], old: str, new: str, problem: str
) -> None:
    (found,) = refused((SECOND % (RULE, "")).replace(old, new), as_meant=True)
    assert problem in found


def test_two_memories_of_one_unit_are_refused(refused: Callable[[str], list[str]]) -> None:
    text = SECOND % (RULE, "") + "      - {unit_id: 1, coils: {start: 0, count: 1}}\n"
    expected = "found 1, which is the unit id of listeners[0].memory[0], allowed: a different one"
    assert refused(text) == [f"10: listeners[0].memory[1].unit_id: {expected}"]


def test_a_gate_outside_its_area_is_refused(refused: Callable[[str], list[str]]) -> None:
    text = SEALED.replace("{discrete", f"{{{SEAL}, discrete").replace("address: 3", "address: 8")
    assert "found 8, allowed in discrete_inputs of plant: 0 to 7" in refused(text)[0]
    assert "which plant does not have" in refused(FIRST.replace("{coils", f"{{{SEAL}, coils"))[0]


def test_two_servers_of_one_port_are_refused(refused: Callable[[str], list[str]]) -> None:
    text = FIRST + REST % ("':502'", "x" * 20)
    assert refused(text) == [
        "6: rest.address: found ':502', which ports.502 uses, allowed: another port"
    ]


def test_all_problems_come_at_once(refused: Callable[[str], list[str]]) -> None:
    text = FIRST.replace("size: 8", "size: x").replace("1: plant", "1: y").replace("-write", "")
    assert [problem.partition(":")[0] for problem in refused(text)] == ["1", "2", "3"]


@pytest.mark.parametrize("text", ["", "[]", "other: 1\n", "memory: {}\nlisteners: {}\n"])
def test_what_is_no_such_configuration_is_refused(imported: Import, text: str) -> None:
    with pytest.raises(NotImportable):
        imported(text)


# Secrets.

SECRETS = ["s3cret-of-the-broker", "CHANGE_ME_LONG_RANDOM", "INGEST"]


@pytest.mark.parametrize("extra", [[], ["--json"]])
def test_no_secret_of_a_sample_is_printed(extra: list[str]) -> None:
    result = run(MMA / "plant.yaml", *extra)
    assert result.exit_code == 0
    assert not [secret for secret in SECRETS if f'"{secret}"' in result.output]
    assert "s3cret" not in result.output
    assert "CHANGE_ME" not in result.output


@pytest.mark.parametrize("token", ["4711471147114711", "!geheim4711", "*geheim4711", "[4711]"])
@pytest.mark.parametrize("extra", [[], ["--json"]])
def test_no_secret_is_shown_where_it_is_wrong(tmp_path: Path, token: str, extra: list[str]) -> None:
    path = tmp_path / "mma.yaml"
    path.write_text(FIRST + REST % ("127.0.0.1:8080", token), encoding="utf-8")
    result = run(path, *extra)
    assert result.exit_code == 2
    assert "4711" not in result.output


@pytest.mark.parametrize(
    "broker", ["tcp://u:geheim@b:1883", "u:geheim@b", "u:ge://heim@b", "ws://u:geheim@b"]
)
def test_no_password_in_a_url_is_shown(tmp_path: Path, broker: str) -> None:
    path = tmp_path / "mma.yaml"
    path.write_text(FIRST + MQTT % (f"'{broker}'", ""), encoding="utf-8")
    assert "heim" not in run(path).output


# The command.


def test_the_yaml_is_printed_and_the_notes_beside_it() -> None:
    path = MMA / "minimal.yaml"
    result = run(path)
    found = read_mma(path)
    assert (result.exit_code, result.stdout) == (0, found.to_yaml())
    summary = f"{path} is of the first generation: {len(found.notes)} notes"
    assert result.stderr.splitlines() == [*map(str, found.notes), summary]


def test_the_yaml_goes_to_a_file(tmp_path: Path) -> None:
    out = tmp_path / "new.yaml"
    result = run(MMA / "minimal.yaml", "--output", out)
    assert (result.exit_code, result.stdout) == (0, "")
    assert out.read_text() == read_mma(MMA / "minimal.yaml").to_yaml()
    assert result.stderr.splitlines()[-1].endswith(f"; next: holdfast check {out}")


def test_a_file_is_replaced_only_by_force(tmp_path: Path) -> None:
    out = tmp_path / "new.yaml"
    out.write_text("mine")
    result = run(MMA / "minimal.yaml", "--output", out)
    assert (result.exit_code, out.read_text()) == (1, "mine")
    assert result.stderr == f"{out}: already exists; --force overwrites it\n"
    assert run(MMA / "minimal.yaml", "--output", out, "--force").exit_code == 0
    assert "memory1" in out.read_text()


def test_the_source_is_never_replaced(tmp_path: Path) -> None:
    path = tmp_path / "mma.yaml"
    path.write_text(FIRST)
    assert run(path, "--output", path, "--force").exit_code == 2
    assert path.read_text() == FIRST


def test_a_file_that_cannot_be_written_is_a_failure(tmp_path: Path) -> None:
    result = run(MMA / "minimal.yaml", "--output", tmp_path / "none" / "new.yaml")
    assert result.exit_code == 1
    assert "can't be written: No such file or directory" in result.stderr


@pytest.mark.parametrize(
    ("options", "sealed"),
    [([], False), (["--as-it-ran"], False), (["--as-it-was-meant"], True)],
)
def test_options_choose_between_the_meanings(options: list[str], sealed: bool) -> None:
    found = json.loads(run(MMA / "plant.yaml", "--json", *options).stdout)
    assert ("seal" in found["config"]["memories"]["plant_a"]) == sealed
    assert "CHANGE_ME_LONG_RANDOM" not in json.dumps(found)
    digest = hashlib.sha256(b"CHANGE_ME_LONG_RANDOM").hexdigest()
    assert digest not in json.dumps(found)
    kept = run(MMA / "plant.yaml", "--json", "--keep-published-tokens", *options).stdout
    assert digest in kept


def test_options_grant_areas(tmp_path: Path) -> None:
    path = tmp_path / "mma.yaml"
    rest = REST % ("127.0.0.1:8080", "a-long-secret-token-of-a-gate")
    path.write_text(FOUR_AREAS + rest + MQTT % ("broker", ""))
    options = ["--grant-rest", "holding_registers,coils", "--grant-mqtt", "hr"]
    config = json.loads(run(path, "--json", *options).stdout)["config"]
    assert config["rest"]["tokens"][0]["areas"] == list(AREAS)
    assert config["mqtt"]["subscriptions"][0]["areas"] == [*AREAS[1:]]
    wrong = run(path, "--grant-rest", "registers")
    assert wrong.exit_code == 2
    assert "'registers' is not an area, allowed: coils" in wrong.stderr


def test_programs_get_json() -> None:
    result = run(MMA / "listeners.yaml", "--json")
    answer = json.loads(result.stdout)
    assert (result.exit_code, result.stderr, answer["ok"]) == (0, "", True)
    assert answer["generation"] == 2
    assert answer["config"]["listeners"]["lab"]["bind"] == "127.0.0.1:5040"
    assert answer["notes"][0] == {
        "kind": "left out",
        "file": str(MMA / "listeners.yaml"),
        "line": 2,
        "column": 1,
        "key": "debug",
        "message": "log.level sets what is logged",
    }


def test_problems_are_printed_with_their_number(tmp_path: Path) -> None:
    path = tmp_path / "mma.yaml"
    path.write_text(FIRST.replace("read-write", "rw"))
    result = run(path)
    problem = "ports.502.access: found 'rw', allowed: read-only or read-write"
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.splitlines()[-2:] == [f"{path}:3: {problem}", "1 problem"]
    answer = json.loads(run(path, "--json").stdout)
    assert (answer["ok"], answer["problems"][0]["line"]) == (False, 3)


def test_a_file_that_is_not_there_is_a_problem(tmp_path: Path) -> None:
    result = run(tmp_path / "none.yaml")
    assert result.exit_code == 2
    assert "can't be read: No such file or directory" in result.stderr


def test_the_help_has_an_example() -> None:
    assert "Example: holdfast import mma " in run("--help").stdout


# Who is let in, for any filter and any peer.

FEW_BITS = 6


@st.composite
def networks(draw: st.DrawFn) -> str:
    """Networks that often overlap: they differ in the last bits only."""
    family = draw(st.sampled_from(["10.0.0.{}", "fd00::{:x}", "::ffff:10.0.0.{}", "::ffff:{:x}"]))
    address = family.format(draw(st.integers(0, 2**FEW_BITS - 1)))
    most = ipaddress.ip_address(address).max_prefixlen
    bits = st.one_of(st.integers(most - FEW_BITS, most), st.integers(0, most))
    return address if draw(st.booleans()) else f"{address}/{draw(bits)}"


@st.composite
def peers(draw: st.DrawFn) -> Address:
    number = draw(st.integers(0, 2**FEW_BITS - 1))
    form = draw(st.sampled_from(["10.0.0.{}", "fd00::{:x}", "::ffff:{:x}", "11.0.0.{}", "1::{:x}"]))
    return ipaddress.ip_address(form.format(number))


def holds(network: str, peer: Address) -> bool:
    """As the source tells: mapped addresses are IPv4, host bits do not count."""
    wanted = ipaddress.ip_network(network, strict=False)
    if isinstance(wanted, ipaddress.IPv6Network) and wanted.prefixlen >= 96:
        mapped = wanted.network_address.ipv4_mapped
        if mapped is not None:
            wanted = ipaddress.ip_network(f"{mapped}/{wanted.prefixlen - 96}")
    return peer in wanted


def admits(sources: list[str], peer: Address) -> bool:
    return any(peer in ipaddress.ip_network(source) for source in sources)


@given(st.lists(networks(), max_size=6), st.lists(networks(), max_size=6), peers())
def test_sources_hold_whom_the_filter_lets_in(
    allow: list[str], deny: list[str], peer: Address
) -> None:
    text = json.dumps({"ip_filter": {"allow": allow, "deny": deny}})
    document, _ = parse(text, "mma.yaml")
    found = read_filter(Section(Desk(document), (), document.data))
    sources = Peers.of(EVERYBODY).written() if found is None else found.written()
    allowed = not allow or any(holds(network, peer) for network in allow)
    expected = allowed and not any(holds(network, peer) for network in deny)
    assert admits(sources, peer) == expected


@given(st.lists(networks(), max_size=6), st.lists(networks(), max_size=6))
def test_sources_are_what_a_configuration_takes(allow: list[str], deny: list[str]) -> None:
    left = Peers.of(map(parse_network, allow)) - Peers.of(map(parse_network, deny))
    mapped = ipaddress.IPv6Network("::ffff:0:0/96")
    found = left.networks()
    assert bool(left) == bool(found)
    six = [one for one in found if isinstance(one, ipaddress.IPv6Network)]
    assert not [one for one in six if one.subnet_of(mapped)]


PolicyRules = list[tuple[list[str], frozenset[int]]]
RIGHTS = st.sampled_from([ALL, SOURCE, frozenset({1, 3}), frozenset({3, 16}), frozenset[int]()])
TOUCHING = touching(AREAS)
POLICY = st.lists(st.tuples(st.lists(networks(), min_size=1, max_size=3), RIGHTS), max_size=4)


def rules_of(policies: list[PolicyRules]) -> list[dict[str, Any]]:
    read = [
        Policy(
            unit,
            f"m{unit}",
            TOUCHING,
            tuple((tuple(map(parse_network, sources)), codes) for sources, codes in rules),
        )
        for unit, rules in enumerate(policies)
    ]
    return merged(read, Peers.of(EVERYBODY))


def source_says(rules: PolicyRules, peer: Address) -> frozenset[int]:
    for sources, codes in rules:
        if any(holds(source, peer) for source in sources):
            return codes
    return frozenset()


def rules_say(rules: list[dict[str, Any]], unit: int, peer: Address) -> frozenset[int]:
    for one in rules:
        if admits(one["sources"], peer) and unit in one["units"]:
            access = ALL if one["access"] == "read-write" else ALL - {5, 6, 15, 16, 22, 23}
            return access & frozenset(one.get("functions", ALL))
    return frozenset()


@given(st.lists(POLICY, min_size=1, max_size=3), peers())
def test_every_unit_keeps_its_rights_exactly(policies: list[PolicyRules], peer: Address) -> None:
    rules = rules_of(policies)
    for unit, policy in enumerate(policies):
        assert rules_say(rules, unit, peer) == source_says(policy, peer)


@given(st.lists(POLICY, min_size=1, max_size=3))
def test_no_rule_is_hidden_by_those_before_it(policies: list[PolicyRules]) -> None:
    before: dict[int, list[Network]] = {unit: [] for unit in range(len(policies))}
    for one in rules_of(policies):
        own = [ipaddress.ip_network(source) for source in one["sources"]]
        for unit in one["units"]:
            assert Peers.of(own) - Peers.of(before[unit])
            before[unit] += own


@given(POLICY, st.integers(2, 3))
def test_units_with_equal_policies_share_their_rules(policy: PolicyRules, count: int) -> None:
    alone = rules_of([policy])
    units = {unit: f"m{unit}" for unit in range(count)}
    assert rules_of([policy] * count) == [{**one, "units": units} for one in alone]


# Any mistake in a sample.

ANYTHING = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-1, 70000),
    st.sampled_from(["", "all", "a b", ":502", "::1", "10.0.0.0/8", "ro", "coil", 1.5, "\n"]),
    st.sampled_from([[], [1], ["x"], [None], [{}], {}, {"x": 1}, {1: "x"}]),
)


def places(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all values."""
    inside: list[tuple[Any, Any]] = []
    if isinstance(data, dict | list):
        inside = list(data.items() if isinstance(data, dict) else enumerate(data))
    return [path, *(place for key, value in inside for place in places(value, (*path, key)))]


@given(st.sampled_from(SAMPLES), st.data())
def test_a_changed_sample_loads_or_is_refused(
    tmp_path_factory: pytest.TempPathFactory, sample: Path, data: st.DataObject
) -> None:
    folder = tmp_path_factory.getbasetemp()
    document, _ = parse(sample.read_text(encoding="utf-8"), str(sample))
    *parents, last = data.draw(st.sampled_from(places(document.data)[1:]))
    functools.reduce(operator.getitem, parents, document.data)[last] = data.draw(ANYTHING)
    (folder / "mma.yaml").write_text(to_yaml(document.data), encoding="utf-8")
    try:
        found = read_mma(folder / "mma.yaml")
    except NotImportable:
        return
    (folder / "mqtt.password").write_text("x")
    (folder / "new.yaml").write_text(found.to_yaml(), encoding="utf-8")
    load(folder / "new.yaml")

"""`holdfast import replicator`: what units of the Modbus Replicator become."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner

from holdfast.cli import main
from holdfast.config import load
from holdfast.config.dump import to_yaml
from holdfast.importing import NotImportable, read_replicator

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.importing import Imported

UNIT = """\
replicator:
  units:
    - id: "pump 1"
      source: {endpoint: "10.5.1.29:502", unit_id: 7, timeout_ms: 1500,
               device_name: P1, status_slot: 4}
      reads:
        - {fc: 1, address: 0, quantity: 128}
        - {fc: 3, address: 999, quantity: 30}
      targets:
        - id: 2
          endpoint: "10.5.1.20:501"
          status_unit_id: 100
          memories:
            - {memory_id: 1, offsets: {3: 1000}}
            - {memory_id: 2, offsets: {}}
      poll: {interval_ms: 250}
"""


@pytest.fixture
def imported(tmp_path: Path) -> Callable[[str], Imported]:
    def read(text: str) -> Imported:
        file = tmp_path / "replicator.yaml"
        file.write_text(text)
        return read_replicator(file)

    return read


def changed(old: str, new: str, text: str = UNIT) -> str:
    assert text.count(old) == 1, old
    return text.replace(old, new)


def notes(found: Imported) -> list[str]:
    return [f"{note.line}: {note.key}: {note.kind}: {note.message}" for note in found.notes]


def test_a_unit_becomes_a_device_that_is_forwarded(
    imported: Callable[[str], Imported], tmp_path: Path
) -> None:
    found = imported(UNIT)
    receiver = {"url": "raw://10.5.1.20:501", "unit": 2, "timeout": 1.5}
    block = {"unit": 100, "area": "holding_registers", "slot": 4, "name": "P1"}
    assert found.data == {
        "devices": {
            "pump_1": {
                "url": "tcp://10.5.1.29:502",
                "unit": 7,
                "interval": 0.25,
                "timeout": 1.5,
                "reads": [
                    {"area": "coils", "address": 0, "count": 128},
                    {"area": "holding_registers", "address": 999, "count": 30},
                ],
                "forward": [
                    {**receiver, "offsets": {"holding_registers": 1000}, "status": block},
                    receiver,
                ],
                "retry": {"first": 0.25, "most": 0.25},
            }
        }
    }
    assert notes(found) == [
        "2: replicator.units: check: if a read fails, the others are written; the "
        "replicator wrote none",
        "3: replicator.units[0].id: changed: renamed to pump_1: a name has "
        "1 to 64 letters, digits, '_', '.' and '-'",
    ]
    made = tmp_path / "made.yaml"
    made.write_text(found.to_yaml())
    assert load(made).warnings == ()
    assert made.read_text().startswith(
        "# Made by `holdfast import replicator` from a configuration of the Modbus Replicator,\n"
    )


@pytest.mark.parametrize(
    ("old", "new", "key", "value"),
    [
        ("10.5.1.29:502", "[fd00::7]:502", "url", "tcp://[fd00::7]:502"),
        ("10.5.1.29:502", ":1502", "url", "tcp://127.0.0.1:1502"),
        ("10.5.1.29:502", "plc-a.plant:502", "url", "tcp://plc-a.plant:502"),
        (" unit_id: 7,", "", "unit", 0),
        ("interval_ms: 250", "interval_ms: 3", "interval", 0.01),
        ("interval_ms: 250", "interval_ms: 2000", "interval", 2),
        (" timeout_ms: 1500,", "", "timeout", 5),
        ("timeout_ms: 1500", "timeout_ms: 0", "timeout", 5),
    ],
)
def test_settings_of_the_source_are_converted(
    imported: Callable[[str], Imported], old: str, new: str, key: str, value: object
) -> None:
    assert imported(changed(old, new)).data["devices"]["pump_1"][key] == value


@pytest.mark.parametrize(
    ("old", "new", "note"),
    [
        ("timeout_ms: 1500", "timeout_ms: 0",
         "4: replicator.units[0].source: check: no timeout_ms: 5 s; the replicator waited without "
         "an end"),
        ("interval_ms: 250", "interval_ms: 3",
         "16: replicator.units[0].poll.interval_ms: changed: raised to 10 ms, the shortest "
         "interval"),
        ("id: 2\n", "id: 2\n          unit_id: 3\n",
         "11: replicator.units[0].targets[0].unit_id: left out: packets go to unit 2, the id of "
         "the target, as before"),
        ("offsets: {3: 1000}", "offsets: {3: 1000, 16: 4}",
         "14: replicator.units[0].targets[0].memories[0].offsets.16: left out: no read has this "
         "function, allowed: 1 to 4"),
        ("  units:", "  Status_Memory: {endpoint: 'a:1'}\n  units:",
         "2: replicator.Status_Memory: left out: the replicator ignores it; each target has a "
         "status_unit_id"),
        ("replicator:", "listeners: []\nreplicator:",
         "1: listeners: left out: for the memories in this file, use: holdfast import mma"),
        ("interval_ms: 250", "interval_ms: 250, jitter: 4",
         "16: replicator.units[0].poll.jitter: left out: unknown key"),
    ],
)  # fmt: skip
def test_a_note_names_what_is_not_converted_unchanged(
    imported: Callable[[str], Imported], old: str, new: str, note: str
) -> None:
    assert note in notes(imported(changed(old, new)))


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (UNIT, "7\n", "1: : found 7, allowed: a mapping"),
        (UNIT, "replicator: {units: []}\n",
         "1: replicator.units: no unit, allowed: at least one"),
        (UNIT, "listeners: []\n", "1: replicator: missing, allowed: a mapping"),
        ('id: "pump 1"', 'id: ""', "3: replicator.units[0].id: found an empty text, allowed: text"),
        ("10.5.1.29:502", "10.5.1.29",
         "4: replicator.units[0].source.endpoint: found '10.5.1.29', allowed: host:port, as in "
         "10.5.1.29:502"),
        ("10.5.1.29:502", "",
         "4: replicator.units[0].source.endpoint: found an empty text, allowed: text"),
        ("10.5.1.20:501", " ",
         "11: replicator.units[0].targets[0].endpoint: found an empty text, allowed: text"),
        ("10.5.1.29:502", "10.5.1.029:502",
         "4: replicator.units[0].source.endpoint: found '10.5.1.029:502', allowed: host:port, as "
         "in 10.5.1.29:502"),
        ("10.5.1.29:502", "u@a:1",
         "4: replicator.units[0].source.endpoint: found 'u@a:1', allowed: host:port, as in "
         "10.5.1.29:502"),
        ("fc: 1", "fc: 5",
         "7: replicator.units[0].reads[0].fc: found 5, allowed: a function from 1 to 4"),
        ("address: 999, quantity: 30", "address: 65530, quantity: 30",
         "8: replicator.units[0].reads[1].quantity: found 30, allowed: up to 6 from address 65530"),
        ("quantity: 128", "quantity: 0",
         "7: replicator.units[0].reads[0].quantity: found 0, allowed: an integer from 1 to 65535"),
        ("3: 1000", "3: 64508",
         "14: replicator.units[0].targets[0].memories[0].offsets.3: found 64508, allowed: an "
         "offset from 0 to 64507"),
        ("          status_unit_id: 100\n", "",
         "10: replicator.units[0].targets[0].status_unit_id: missing with status_slot, allowed: a "
         "unit id from 0 to 255"),
        ("status_slot: 4", "status_slot: 2184",
         "5: replicator.units[0].source.status_slot: found 2184, allowed: an integer from 0 to "
         "2183"),
        ("device_name: P1", "device_name: Pümpe",
         "5: replicator.units[0].source.device_name: found 'Pümpe', allowed: ASCII characters"),
        ("quantity: 128", "quantity: 128, invert: true",
         "7: replicator.units[0].reads[0].invert: found true, allowed: false; nothing here inverts "
         "bits"),
        ("quantity: 128", "quantity: 128, addinvert: true",
         "7: replicator.units[0].reads[0].addinvert: found true, allowed: false; nothing here "
         "inverts bits"),
        ("status_unit_id: 100", "status_unit_id: 0100",
         "12: replicator.units[0].targets[0].status_unit_id: found 0100, which the source read "
         "as octal, allowed: 64, or 100 if that is meant"),
        ("{3: 1000}", "{'3': 1000}",
         "14: replicator.units[0].targets[0].memories[0].offsets.3: found '3', allowed: a function "
         "from 1 to 4, without quotes"),
        ("status_unit_id: 100", "status_unit_id: 100\n          health_output: {enabled: true}",
         "13: replicator.units[0].targets[0].health_output: found a coil that tells whether the "
         "source answers, allowed: without: nothing here writes it; stale of a device refuses old "
         "values"),
        ("id: 2\n", "id: 256\n",
         "2: replicator.units: no unit has a target that is written"),
    ],
)  # fmt: skip
def test_what_the_source_could_not_run_is_refused(
    imported: Callable[[str], Imported], old: str, new: str, problem: str
) -> None:
    with pytest.raises(NotImportable) as refused:
        imported(changed(old, new))
    told = [f"{each.line}: {each.key}: {each.message}" for each in refused.value.problems]
    assert problem in told


def test_what_the_source_ignored_is_no_problem(imported: Callable[[str], Imported]) -> None:
    found = imported(changed("quantity: 30", "quantity: 30, invert: true, addinvert: false"))
    assert found.data == imported(UNIT).data
    off = changed(
        "status_unit_id: 100", "status_unit_id: 100\n          health_output: {enabled: false}"
    )
    assert imported(off).data == imported(UNIT).data
    assert imported(changed("address: 999", "address: 0999")).data == imported(UNIT).data


def test_units_at_one_address_share_its_settings(
    imported: Callable[[str], Imported], tmp_path: Path
) -> None:
    """They have one connection here, so that their retries are those of the fastest."""
    second = changed("interval_ms: 250", "interval_ms: 4000").partition("units:\n")[2]
    second = second.replace("status_slot: 4", "status_slot: 5")
    found = imported(UNIT + second)
    assert [note for note in notes(found) if "renamed" in note] == [
        "3: replicator.units[0].id: changed: renamed to pump_1: a name has "
        "1 to 64 letters, digits, '_', '.' and '-'",
        "17: replicator.units[1].id: changed: renamed to pump_1-2: the name is in use",
    ]
    devices = found.data["devices"]
    assert [each["retry"]["most"] for each in devices.values()] == [0.25, 0.25]
    made = tmp_path / "made.yaml"
    made.write_text(to_yaml(found.data))
    assert len(load(made).devices) == 2


def test_a_target_that_got_nothing_gets_nothing(imported: Callable[[str], Imported]) -> None:
    text = changed(
        "      poll:",
        "        - {id: 300, endpoint: 'a:1', status_unit_id: 1, memories: [{memory_id: 1}]}\n"
        "        - {id: 4, endpoint: 'b:1', status_unit_id: 1}\n      poll:",
    )
    found = imported(text)
    assert [each["unit"] for each in found.data["devices"]["pump_1"]["forward"]] == [2, 2]
    lost = ". It received the status block, which requires values here"
    reasons = [
        "16: replicator.units[0].targets[1]: left out: its id is 300, more than 255: the "
        "replicator never wrote to it",
        "17: replicator.units[0].targets[2]: left out: no memories: it received no values",
    ]
    assert notes(found)[2:] == [f"{reason}{lost}" for reason in reasons]
    assert notes(imported(changed(", status_slot: 4", "", text)))[2:] == reasons


def test_the_other_import_names_this_one(tmp_path: Path) -> None:
    source = tmp_path / "replicator.yaml"
    source.write_text(UNIT)
    result = CliRunner().invoke(main, ["import", "mma", str(source)])
    assert result.exit_code == 2
    assert "1: replicator: for the units in this file, use: holdfast import replicator" in (
        result.stderr
    )


def test_a_binary_file_is_refused_as_one(tmp_path: Path) -> None:
    source = tmp_path / "replicator"
    source.write_bytes(b"\x7fELF\x02\x01\x00\x00\xff")
    result = CliRunner().invoke(main, ["import", "replicator", str(source)])
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.splitlines()[0] == f"{source}: a binary file, allowed: YAML in UTF-8"


def test_the_command_writes_a_file_and_tells_programs(tmp_path: Path) -> None:
    source, made = tmp_path / "replicator.yaml", tmp_path / "mirror.yaml"
    source.write_text(UNIT)
    run = CliRunner()
    result = run.invoke(main, ["import", "replicator", str(source), "--output", str(made)])
    assert result.exit_code == 0
    assert result.stderr.endswith(f"{source}: 2 notes; next: holdfast check {made}\n")
    assert run.invoke(main, ["check", str(made)]).exit_code == 0

    result = run.invoke(main, ["import", "replicator", str(source), "--json"])
    answer: dict[str, Any] = json.loads(result.stdout)
    assert (answer["ok"], len(answer["notes"]), "generation" in answer) == (True, 2, False)
    source.write_text("replicator: 7\n")
    result = run.invoke(main, ["import", "replicator", str(source)])
    assert (result.exit_code, result.stdout) == (2, "")
    assert "replicator: found 7, allowed: a mapping" in result.stderr

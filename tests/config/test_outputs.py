"""Errors in outputs."""

from __future__ import annotations

import json
import os
import sys
from typing import TYPE_CHECKING

import pytest

from holdfast.config import ConfigError, load
from holdfast.config.fingerprint import files_of, fingerprint
from support.config_folder import Folder

if TYPE_CHECKING:
    from pathlib import Path

DEVICE = "devices: {a: {url: tcp://a, tags: {x: {area: coils, address: 1}}, interval: 1}}\n"


@pytest.mark.parametrize(
    ("output", "expected"),
    [
        ("{type: sparkplug, url: 'mqtt://h', group: g}", "o.edge_node: missing"),
        (
            "{type: sparkplug, url: 'mqtt://h', group: a/b, edge_node: e}",
            "o.group: found 'a/b', allowed: text without +, / and #",
        ),
        (
            "{type: sparkplug, url: 'mqtt://h', group: g, edge_node: e, primary_host: '#'}",
            "o.primary_host: found '#', allowed: text without +, / and #",
        ),
        (
            "{type: sparkplug, url: 'mqtt://h', group: g, edge_node: e, tls: {}}",
            "o.tls: found with a url that begins with mqtt://",
        ),
        (
            "{type: sparkplug, url: 'mqtt://h', group: g, edge_node: e, qos: 1}",
            "o.qos: unknown key",
        ),
        ("{type: file, file: a, format: xml}", "o.format: found 'xml', allowed: csv, jsonl"),
        ("{file: a, format: csv}", "o.type: missing, allowed: "),
        ("{type: mysql}", "o.type: found 'mysql', allowed: "),
        ("{type: file, file: a, format: csv, devices: [b]}", "o.devices[0]: found 'b', allowed: a"),
        ("{type: file, file: a, format: csv, devices: []}", "o.devices: found an empty list"),
        ("{type: file, file: a, format: csv, publish: all}", "o.publish: found 'all', allowed: ch"),
        ("{type: influx, url: 'http://h:1'}", "o.bucket: missing, allowed: a bucket, or a url"),
        ("{type: influx, url: 'ftp://h', bucket: b}", "o.url: found neither http:// nor https://"),
        ("{type: influx, url: 'http://h/a b'}", "o.url: found a path with blanks"),
        ("{type: influx, url: 'http://u:p@h/w'}", "o.url: found a user in the URL"),
        *(
            (
                f"{{type: influx, url: 'http://h/w?db=a{more}'}}",
                "o.url: found credentials in the query of the URL, allowed: none; set username",
            )
            for more in ("&u=x&p=y", "&P=y", "&token=y", "&Token=y", "&%70=y", ";p=y", "&p")
        ),
        (
            "{type: influx, url: 'http://h/w', measurement: '#1 pump'}",
            "o.measurement: found '#1 pump', allowed: text that does not begin with #, without ",
        ),
        (
            "{type: influx, url: 'http://h/w', measurement: 'M\\ 5'}",
            r"o.measurement: found 'M\\ 5', allowed: text that does not begin with #, without ",
        ),
        *(
            (
                f"{{type: influx, url: 'http://h/w', tags: {{s: {json.dumps(text)}}}}}",
                f"o.tags.s: found {text!r}, allowed: text without control characters, and without "
                "a backslash at its end or before a blank",
            )
            for text in ('a\\"b', "C:\\", "C:\\ x", r"a\,b", r"a\=b", r"\\pc\d", "a\tb", "a\n")
        ),
        ("{type: influx, url: 'http://h/w', tls: {}}", "o.tls: found with http://, allowed: only"),
        (
            "{type: influx, url: 'http://h/w', username: u}",
            "o.username: found without password_file",
        ),
        (
            "{type: influx, url: 'http://h/w', token_file: t}",
            "o.token_file: found text of 1 characters, which can't be read",
        ),
        ("{type: nats, servers: []}", "o.servers: found an empty list"),
        ("{type: nats, servers: ['http://a']}", "o.servers[0]: "),
        ("{type: nats, servers: ['nats://a'], tls: {}}", "o.tls: found with servers that begin"),
        (
            "{type: nats, servers: ['nats://a'], password_file: p.yaml}",
            "o.password_file: found without username",
        ),
        (
            "{type: file, file: a, format: csv, buffer: {max_bytes: 1}}",
            "o.buffer.max_bytes: found 1, allowed",
        ),
    ],
)
def test_a_wrong_output_is_refused(tmp_path: Path, output: str, expected: str) -> None:
    file = tmp_path / "p.yaml"
    file.write_text(f"{DEVICE}outputs:\n  o: {output}\n")
    with pytest.raises(ConfigError) as caught:
        load(file)
    [problem] = caught.value.problems
    assert str(problem).removeprefix(f"{file}:3: outputs.").startswith(expected)


def test_outputs_without_tags_have_no_effect(tmp_path: Path) -> None:
    file = tmp_path / "p.yaml"
    file.write_text(
        "memories: {m: {coils: 1}}\n"
        "rest: {bind: '127.0.0.1:1', sources: [127.0.0.1], tokens: none}\n"
        "outputs: {o: {type: file, file: a, format: csv}}\n"
    )
    [doubt] = load(file).warnings
    assert str(doubt) == f"{file}:3: outputs: has no effect: no device has tags"


def test_names_that_influxdb_does_not_take_or_confuses_give_warnings(tmp_path: Path) -> None:
    file = tmp_path / "p.yaml"
    tags = {
        name: {"area": "coils", "address": at, "type": kind}
        for at, (name, kind) in enumerate(
            {"time": "bool", "device": "bool", "site": "bool", "line": "bool[2]"}.items()
        )
    }
    device = {"url": "tcp://h", "interval": 1, "tags": tags}
    named = {"time": "x", "site": "north", "line": "1"}
    influx = {"type": "influx", "url": "http://h/w", "tags": named}
    outputs = {"o": influx, "other": {**influx, "tags": {}, "devices": ["b"]}}
    other = {**device, "tags": {"a": tags["site"]}}
    made = {"devices": {"d": device, "e": device, "b": other}, "outputs": outputs}
    file.write_text(json.dumps(made))
    confused = "as a tag of all points: queries of InfluxDB confuse them"
    assert [str(each).partition(": ")[2] for each in load(file).warnings] == [
        "outputs.o.tags.time: InfluxDB refuses all points with a tag of this name",
        "outputs.o: found the tag time of d: InfluxDB stores no field of this name, its values are "
        "lost",
        f"outputs.o: found the tag device of d, and device {confused}",
        f"outputs.o: found the tag site of d, and site {confused}",
    ]


def test_what_is_written_to_own_files_is_no_change_of_the_configuration(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("one")
    file = tmp_path / "p.yaml"
    file.write_text(
        f"{DEVICE}audit: {{file: audit.log}}\n"
        "outputs:\n"
        "  o: {type: file, file: out, format: csv, buffer: {file: kept}}\n"
        "  i: {type: influx, url: 'http://h/w', token_file: token}\n"
    )
    config = load(file)
    assert files_of(file, config) == [file, tmp_path / "token"]
    before = fingerprint(config)
    for name in ("audit.log", "out", "kept"):
        (tmp_path / name).write_text("lines")
    assert fingerprint(config) == before
    (tmp_path / "token").write_text("two and more")
    assert fingerprint(config) != before


def csv(file: str, more: str = "") -> str:
    return f"{{type: file, file: {file}, format: csv{more}}}"


OTHER = "allowed: a different one"
READ = "which the configuration reads, allowed: another file"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            f"audit: {{file: log}}\noutputs: {{o: {csv('./log')}}}",
            f"3: outputs.o.file: found './log', which is the file of audit in line 2, {OTHER}",
        ),
        (
            f"outputs: {{o: {csv('a')}, p: {csv('folder/../a')}}}",
            "2: outputs.p.file: found 'folder/../a', which is the file of outputs.o in line 2, "
            f"{OTHER}",
        ),
        (
            f"outputs: {{o: {csv('a', ', buffer: {file: a}')}}}",
            "2: outputs.o.buffer.file: found 'a', which is the file of outputs.o in line 2, "
            f"{OTHER}",
        ),
        (
            "memories: {m: {coils: 1, keep: {file: k}}, n: {coils: 1, keep: {file: k}}}\n"
            "outputs: {o: {type: nats, servers: ['nats://a'], buffer: {file: k}}}",
            "2: memories.m.keep.file: found 'k', which is the file of outputs.o.buffer in line 3, "
            f"{OTHER}",
        ),
        (
            "memories: {m: {coils: 1, keep: {file: k}}, n: {coils: 1, keep: {file: folder/../k}}}",
            "2: memories.n.keep.file: found 'folder/../k', which is the file of memories.m.keep in "
            "line 2, allowed: the same text, to share it, or another file",
        ),
        ("audit: {file: p.yaml}", f"2: audit.file: found 'p.yaml', {READ}"),
        (
            f"outputs: {{o: {csv('t')}, i: {{type: influx, url: 'http://h/w', token_file: t}}}}",
            f"2: outputs.o.file: found 't', {READ}",
        ),
    ],
)
def test_nothing_else_uses_a_file_that_is_written(tmp_path: Path, text: str, problem: str) -> None:
    (tmp_path / "folder").mkdir()
    assert Folder(tmp_path).problems(f"{DEVICE}{text}\n", t="token") == [f"p.yaml:{problem}"]


def test_memories_may_share_a_file(tmp_path: Path) -> None:
    kept = "{coils: 1, keep: {file: k}}"
    Folder(tmp_path).config(f"{DEVICE}memories: {{m: {kept}, n: {kept}}}\n")


PLACE = "allowed: a file in an existing folder"


def test_databases_of_outputs_may_be_one(tmp_path: Path) -> None:
    database = "{type: file, file: v.db, format: sqlite}"
    assert Folder(tmp_path).warnings(f"{DEVICE}outputs: {{o: {database}, p: {database}}}\n") == []


def test_files_of_outputs_have_a_folder_and_are_regular(tmp_path: Path) -> None:
    kinds = {"none/a": "whose folder does not exist", ".": "which is a folder"}
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        kinds |= {"pipe": "which is a named pipe", os.devnull: "which is a device"}
    for file, reason in kinds.items():
        for output, key in (
            (csv(file), "file"),
            (csv("v", f", buffer: {{file: {file}}}"), "buffer.file"),
        ):
            text = f"{DEVICE}outputs: {{o: {output}}}\n"
            # A disk may be mounted later: an output tries again.
            folder, is_later = Folder(tmp_path), file == "none/a"
            [found] = folder.warnings(text) if is_later else folder.problems(text)
            assert found == f"p.yaml:2: outputs.o.{key}: found {file!r}, {reason}, {PLACE}"


MQTT = "type: mqtt, url: 'mqtt://h'"


@pytest.mark.parametrize(
    ("outputs", "count"),
    [
        (f"{{o: {{{MQTT}}}, p: {{{MQTT}, payload: device}}}}", 1),
        (f"{{o: {{{MQTT}}}, p: {{{MQTT}, status: plant/p}}}}", 0),
        (f"{{o: {{{MQTT}}}, p: {{type: mqtt, url: 'mqtt://other'}}}}", 0),
    ],
)
def test_outputs_at_one_broker_need_a_status_each(tmp_path: Path, outputs: str, count: int) -> None:
    found = "outputs.p.status: found 'plant/holdfast/status', which is the status topic of "
    found += "outputs.o at the same broker, and can't show both, allowed: a different one"
    expected = [f"p.yaml:2: {found}"] * count
    assert Folder(tmp_path).warnings(f"{DEVICE}outputs: {outputs}\n") == expected


NODE = "{type: sparkplug, url: 'mqtt://h', group: g, edge_node: e}"


def test_two_edge_nodes_need_two_names(tmp_path: Path) -> None:
    file = tmp_path / "p.yaml"
    file.write_text(f"{DEVICE}outputs:\n  o: {NODE}\n  p: {NODE}\n")
    with pytest.raises(ConfigError) as caught:
        load(file)
    [problem] = caught.value.problems
    expected = "found 'e' in the group 'g', which is the edge node of outputs.o in line"
    assert str(problem).startswith(f"{file}:4: outputs.p.edge_node: {expected}")


def test_without_protobuf_sparkplug_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "google.protobuf", None)
    file = tmp_path / "p.yaml"
    file.write_text(f"{DEVICE}outputs:\n  o: {NODE}\n")
    with pytest.raises(ConfigError) as caught:
        load(file)
    [problem] = caught.value.problems
    assert "found 'sparkplug', which requires protobuf, not installed" in str(problem)

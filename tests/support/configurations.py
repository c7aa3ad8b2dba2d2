"""Strategies for valid configurations of every kind, as plain data."""

from __future__ import annotations

from typing import Any, cast

from hypothesis import strategies as st

from holdfast.config.values.scalars import RESERVED
from support.paths import EXAMPLES

NAMES = st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True)
UNRESERVED = NAMES.filter(lambda name: name not in RESERVED)
TEXTS = st.text(st.characters(exclude_categories=("Cc", "Cs")), min_size=1, max_size=60)
SPANS = st.integers(0, 65535).flatmap(
    lambda start: st.integers(1, 65536 - start).map(lambda size: {"start": start, "size": size})
)
SIZES = st.integers(1, 65536) | SPANS
CODES = st.lists(st.sampled_from([1, 2, 3, 4, 8, 11, 17, 43]), min_size=1, unique=True)
NETWORKS = st.ip_addresses(v=4, network="10.0.0.0/8").map(str) | st.ip_addresses(
    v=6, network="fd00::/16"
).map(str)
SOURCES = st.lists(NETWORKS, min_size=1, max_size=3, unique=True)
AREAS = st.lists(
    st.sampled_from(["coils", "discrete_inputs", "holding_registers", "input_registers"]),
    min_size=1,
    unique=True,
)
ROLES = st.text(st.characters(exclude_categories=("Cc", "Cs")), max_size=60)
CERTIFICATES = {
    key: str(EXAMPLES / "certificates" / name)
    for key, name in [
        ("cert_file", "server.pem"),
        ("key_file", "server.key"),
        ("ca_file", "ca.pem"),
    ]
}
ACCESS = st.sampled_from(["read-only", "read-write"])
SECONDS = st.floats(0.001, 31_622_400)
CONNECTIONS = st.integers(1, 65535)
HASHES = st.text("0123456789abcdefABCDEF", min_size=64, max_size=64).filter(
    lambda digits: any(digit in "abcdfABCDF" for digit in digits)
)
TOPICS = st.from_regex(r"(([a-z$ ]{0,9}|\+)/){0,3}([a-z]{1,9}|\+|#)", fullmatch=True)
OPTIONS = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | TEXTS,
    lambda inside: (
        st.lists(inside, max_size=3) | st.dictionaries(TEXTS | st.integers(), inside, max_size=3)
    ),
    max_leaves=6,
)
URLS = st.builds(
    "{}{}".format,
    st.sampled_from(["mqtt://broker", "mqtts://broker.example", "mqtts://[fd00::1]"]),
    st.just("") | st.integers(1, 65535).map(":{}".format),
)


LINK = "the.link"


@st.composite
def modbus_rules(draw: st.DrawFn, memories: list[str], units: range = range(256)) -> dict[str, Any]:
    ids = st.sampled_from([unit for unit in units if not 100 <= unit <= 120])
    target: st.SearchStrategy[Any] = st.sampled_from(memories) | st.just({"route": LINK})
    of_range = st.dictionaries(st.sampled_from(["100-120", "105-110"]), target, max_size=1)
    rule: dict[str, Any] = {
        "units": draw(st.dictionaries(ids, target, min_size=1, max_size=4)) | draw(of_range),
        "access": draw(ACCESS),
    }
    limit = draw(st.sampled_from([None, "functions", "deny"]))
    return rule if limit is None else {**rule, limit: draw(CODES)}


def with_sources(rules: st.SearchStrategy[dict[str, Any]]) -> st.SearchStrategy[Any]:
    return st.lists(
        st.builds(lambda sources, rule: {"sources": sources, **rule}, SOURCES, rules),
        min_size=1,
        max_size=3,
    )


@st.composite
def connections(draw: st.DrawFn, memories: list[str], port: int) -> dict[str, Any]:
    return {
        "type": draw(
            st.sampled_from(["modbus-tcp", "modbus-rtu-over-tcp", "modbus-ascii-over-tcp"])
        ),
        "bind": f"127.0.0.1:{port}",
        "rules": draw(with_sources(modbus_rules(memories))),
        "max_connections": draw(CONNECTIONS),
        "max_connections_per_source": draw(st.none() | CONNECTIONS),
        "when_full": draw(st.sampled_from(["refuse", "evict"])),
        "idle_timeout": draw(st.just(0) | SECONDS | st.integers(1, 1000)),
        "request_timeout": draw(SECONDS),
    }


@st.composite
def secure(draw: st.DrawFn, memories: list[str], port: int) -> dict[str, Any]:
    of_roles = st.fixed_dictionaries(
        {}, optional={"roles": st.lists(ROLES, min_size=1, max_size=3, unique=True)}
    )
    rules = st.builds(lambda rule, roles: rule | roles, modbus_rules(memories), of_roles)
    return {
        **draw(connections(memories, port)),
        "type": "modbus-tls",
        "tls": CERTIFICATES,
        "rules": draw(with_sources(rules)),
    }


@st.composite
def datagrams(draw: st.DrawFn, memories: list[str], port: int) -> dict[str, Any]:
    rules = draw(with_sources(modbus_rules(memories)))
    kind = draw(st.sampled_from(["modbus-udp", "modbus-rtu-over-udp"]))
    return {"type": kind, "bind": f"127.0.0.1:{port}", "rules": rules}


@st.composite
def lines(draw: st.DrawFn, memories: list[str], port: int) -> dict[str, Any]:
    kind = draw(st.sampled_from(["modbus-rtu", "modbus-ascii"]))
    of_kind: dict[str, tuple[str, st.SearchStrategy[Any]]] = {
        "modbus-rtu": ("silence", st.floats(0.0001, 10)),
        "modbus-ascii": ("data_bits", st.sampled_from([7, 8])),
    }
    key, values = of_kind[kind]
    optional = {
        "baud": st.integers(50, 4_000_000),
        "parity": st.sampled_from(["none", "even", "odd"]),
        "stop_bits": st.sampled_from([1, 2]),
        key: values,
    }
    serial = draw(st.fixed_dictionaries({"device": st.just(f"/dev/tty{port}")}, optional=optional))
    rules = st.lists(modbus_rules(memories, range(1, 248)), min_size=1, max_size=2)
    return {"type": kind, "serial": serial, "rules": draw(rules)}


@st.composite
def raw_ingest(draw: st.DrawFn, memories: list[str], port: int) -> dict[str, Any]:
    name = st.sampled_from(memories)
    units = st.dictionaries(st.integers(0, 65535), name, min_size=1, max_size=4)
    names = st.lists(name, min_size=1, unique=True)
    form = draw(st.sampled_from(["v1", "crc"]))
    named = {"units": units} if form == "v1" else {"memories": names}
    compat = {"packets": st.just("many")}
    if form == "crc":
        compat |= {"crc": st.just("none"), "flags": st.just("ignore")}
    own: dict[str, st.SearchStrategy[Any]] = {
        "when_full": st.sampled_from(["refuse", "evict"]),
        "compat": st.fixed_dictionaries({}, optional=compat),
    }
    return {
        "type": "raw-ingest",
        "format": form,
        "bind": f"127.0.0.1:{port}",
        "rules": draw(with_sources(st.fixed_dictionaries({**named, "areas": AREAS}))),
        **draw(st.fixed_dictionaries({}, optional={**own, "max_connections": CONNECTIONS})),
    }


def grants(memories: list[str]) -> dict[str, st.SearchStrategy[Any]]:
    names = st.lists(st.sampled_from(memories), min_size=1, unique=True)
    return {"memories": names, "areas": AREAS}


def tokens(**more: st.SearchStrategy[Any]) -> st.SearchStrategy[list[dict[str, Any]]]:
    return st.lists(
        st.fixed_dictionaries({"name": NAMES.filter("-".__ne__), "sha256": HASHES, **more}),
        min_size=1,
        max_size=3,
        unique_by=(lambda t: t["name"], lambda t: t["sha256"].lower()),
    )


def rest(memories: list[str]) -> st.SearchStrategy[dict[str, Any]]:
    listed = tokens(**grants(memories), access=ACCESS)
    return st.fixed_dictionaries(
        {"bind": st.just("127.0.0.1:80"), "sources": SOURCES, "tokens": listed | st.just("none")},
        optional={
            "max_body": st.integers(1024, 2**30),
            "request_timeout": SECONDS,
            "max_connections_per_source": st.none() | CONNECTIONS,
            "when_full": st.sampled_from(["refuse", "evict"]),
        },
    )


def mqtt(memories: list[str]) -> st.SearchStrategy[dict[str, Any]]:
    subscription = st.fixed_dictionaries(
        {"topic": TOPICS, **grants(memories)}, optional={"qos": st.sampled_from([0, 1, 2])}
    )
    subscriptions = st.lists(subscription, min_size=1, max_size=3, unique_by=lambda s: s["topic"])
    return st.fixed_dictionaries(
        {"url": URLS, "client_id": TEXTS, "subscriptions": subscriptions},
        optional={
            "username": TEXTS,
            "version": st.sampled_from([5, "5", "3.1.1"]),
            "keep_alive": st.integers(1, 65535),
        },
    )


POLLABLE = NETWORKS | st.sampled_from(["/dev/ttyUSB9", "COM3", "172.16.0.0/12"])
NATS = st.fixed_dictionaries(
    {
        "servers": st.lists(
            st.sampled_from(["nats://127.0.0.1", "tls://nats.example:4443", "nats://[fd00::1]"]),
            min_size=1,
            max_size=3,
        ),
        "devices": st.lists(POLLABLE, min_size=1, max_size=3),
    },
    optional={
        "username": TEXTS,
        "prefix": st.from_regex(r"[A-Za-z0-9_-]{1,9}(\.[A-Za-z0-9_-]{1,9}){0,2}", fullmatch=True),
        "limits": st.fixed_dictionaries(
            {}, optional={"devices": st.integers(1, 2**40), "tags": st.integers(1, 2**40)}
        ),
    },
)
EGRESS = st.sampled_from(
    ["10.0.0.0/8", "10.0.0.5:5020", "0.0.0.0/0:*", "10.0.0.0/24:502-510", "[fd00::]/8:1-9"]
)


@st.composite
def gateway(draw: st.DrawFn) -> dict[str, Any]:
    return {
        "bind": "127.0.0.1:82",
        "allow": draw(st.lists(EGRESS, min_size=1, max_size=3)),
        "access": draw(ACCESS),
        **draw(
            st.fixed_dictionaries({"sources": SOURCES, "tokens": tokens()})
            | st.just({"sources": ["127.0.0.0/8", "::1"], "tokens": "none"})
        ),
        **draw(
            st.fixed_dictionaries(
                {},
                optional={
                    "in_flight": st.integers(1, 64),
                    "max_connections": CONNECTIONS,
                    "max_connections_per_source": st.none() | CONNECTIONS,
                },
            )
        ),
    }


def adapters(memories: list[str]) -> st.SearchStrategy[dict[str, Any]]:
    adapter = st.fixed_dictionaries(
        {"type": NAMES, **grants(memories), "access": ACCESS},
        optional={"options": st.dictionaries(TEXTS, OPTIONS, max_size=3)},
    )
    return st.dictionaries(UNRESERVED, adapter, max_size=2)


PLACES = st.sampled_from(
    ["tcp://10.0.0.9", "udp://[fd00::1]:5020", "rtu+tcp://plc:4001", "rtu:///dev/line?baud=9600"]
)
STRETCHES: st.SearchStrategy[dict[str, int]] = SPANS.flatmap(
    lambda span: st.sampled_from(
        [
            {"start": span["start"], "end": span["start"] + span["size"] - 1},
        ]
    )
)
RANGES = st.lists(
    st.builds(lambda area, span: {"area": area, **span}, st.sampled_from(["coils"]), STRETCHES),
    max_size=2,
)
FORWARDS = st.sampled_from(
    [
        {"format": "v1", "unit": 65535},
        {"unit": 0},
        {"format": "crc", "memory_id": 0},
        {"format": "crc", "crc": "none", "memory_id": 9, "timeout": 0.5},
    ]
).map(lambda named: {"url": "raw://[fd00::9]:9000", **cast("dict[str, Any]", named)})
HOLES: st.SearchStrategy[dict[str, Any]] = st.sampled_from(
    [{}, {"max_gap": 0}, {"max_gap": 65535}, {"max_gap": "auto"}]
)


@st.composite
def devices(draw: st.DrawFn, memories: dict[str, Any]) -> dict[str, Any]:
    """Devices of which at most one read has a destination in memory."""
    made: dict[str, Any] = {}
    for name in draw(st.lists(NAMES, max_size=3, unique=True)):
        read = {"area": "input_registers", "address": 65535, "count": 1}
        made[name] = {
            "url": draw(PLACES),
            "unit": draw(st.integers(1, 255)),
            "interval": draw(st.floats(0.01, 31_622_400)),
            "reads": [read, *draw(st.lists(st.just(read), max_size=2))],
            **draw(HOLES),
            **draw(
                st.fixed_dictionaries(
                    {},
                    optional={
                        "enabled": st.booleans(),
                        "timeout": SECONDS,
                        "max_registers": st.integers(1, 125),
                        "max_bits": st.integers(1, 2000),
                        "readable": RANGES,
                        "forbidden": RANGES,
                        "forward": st.lists(FORWARDS, max_size=2),
                    },
                )
            ),
        }
    if made:
        name, memory = next(iter(memories.items()))
        size = memory["holding_registers"]
        start = 0 if isinstance(size, int) else size["start"]
        into = {"memory": name, "area": "holding_registers", "address": start}
        first = next(iter(made.values()))
        first["reads"][0] = {**first["reads"][0], "into": into}
    return made


IDENTITIES = st.fixed_dictionaries(
    {"vendor_name": TEXTS},
    optional={
        "revision": TEXTS,
        "model_name": TEXTS,
        "unit_names": st.dictionaries(st.integers(0, 255), TEXTS, max_size=3),
        "objects": st.dictionaries(st.integers(128, 255), TEXTS, max_size=3),
    },
)
METRICS = st.fixed_dictionaries({"bind": st.just("[::1]:81")}, optional={"sources": SOURCES})
AUDITS = st.fixed_dictionaries(
    {"file": st.just("a.log")},
    optional={
        "max_bytes": st.integers(65536, 2**60),
        "keep": st.integers(1, 1000),
        "fail": st.sampled_from(["open", "closed"]),
        "journald": st.booleans(),
        "syslog": st.sampled_from(["udp://10.0.0.9", "tcp://[::1]:6514", "unix:///dev/log"]),
    },
)


LINKS = st.fixed_dictionaries(
    {"url": st.just("tcp://192.168.0.1")},
    optional={
        "timeout": SECONDS,
        "in_flight": st.integers(1, 1024) | st.just("auto"),
        "tolerance": st.fixed_dictionaries({"retries": st.integers(0, 10)}),
        "queue": st.integers(1, 65535),
        "priority": st.dictionaries(
            st.sampled_from(["10.0.0.5", "fd00::5"]), st.just("high"), max_size=2
        ),
        "coalesce": st.booleans(),
        "cache": st.just(0) | SECONDS,
    },
)


@st.composite
def configurations(draw: st.DrawFn) -> dict[str, Any]:
    """Configurations that need no other files."""
    areas = st.fixed_dictionaries(
        {"holding_registers": SIZES},
        optional={"coils": SIZES, "discrete_inputs": SIZES, "input_registers": SIZES},
    )
    memories = draw(st.dictionaries(NAMES, areas, min_size=1, max_size=3))
    for number, memory in enumerate(memories.values()):
        memory["id"] = number
    names = list(memories)
    kinds = [connections, secure, datagrams, lines, raw_ingest]
    listeners = {
        name: draw(draw(st.sampled_from(kinds))(names, 5000 + index))
        for index, name in enumerate(draw(st.lists(UNRESERVED, max_size=3, unique=True)))
    }
    optional = {
        "rest": rest(names),
        "mqtt": mqtt(names),
        "nats": NATS,
        "gateway": gateway(),
        "metrics": METRICS,
        "audit": AUDITS,
    }
    sections = draw(
        st.fixed_dictionaries(
            {
                "identity": IDENTITIES,
                "adapters": adapters(names),
                "devices": devices(memories),
                "links": st.builds(lambda link: {LINK: link}, LINKS),
                "reload": st.sampled_from(["on-request", "on-change"]),
                "workers": st.integers(1, 64),
            },
            optional=optional,
        )
    )
    if not listeners and not sections.keys() & {"rest", "mqtt", "nats", "gateway"}:
        sections["rest"] = draw(rest(names))
    return {"memories": memories, "listeners": listeners, **sections}

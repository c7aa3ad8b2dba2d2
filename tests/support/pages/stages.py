"""The devices, appliances, brokers and files that the examples of each page need."""

from __future__ import annotations

import itertools
import json
import math
import re
import shutil
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast._core import MemoryFile
from support import wire
from support.brokers import Mosquitto, NatsServer
from support.cli import done, invoke
from support.config_folder import written
from support.fake_device import Serial
from support.lines import RTU
from support.machine import tool
from support.pages.configurations import put_certificates
from support.paths import DOCS, EXAMPLES, ROOT

if TYPE_CHECKING:
    from collections.abc import Callable

    from support.fake_device import Asked
    from support.pages.stage import Stage

HEATER = "examples/tags/heater.yaml"
SECRET = "secret"
SHA256 = "2bb80d537b1da3e38bd30361aa855686bde0eacd7162fef6a25fe97bf527a25b"


def everywhere(stage: Stage) -> None:
    """The examples of the repository, certificates, and the programs."""
    shutil.copytree(EXAMPLES, stage.folder / "examples")
    put_certificates(stage.folder)
    stage.program()
    stage.file(".curlrc", "silent\n")
    # They look several times at values that change here every 0.1 s, or faster.
    stage.replaced["describe tcp"] = "describe --every 0.2 tcp"
    stage.replaced["guess tcp"] = "guess --every 0.1 tcp"
    stage.environment |= {
        "CURL_HOME": str(stage.folder),
        "HOME": str(stage.folder),
        "TOKEN": SECRET,
    }
    file = stage.folder / "examples" / "plant.yaml"
    file.write_text(stage.here(file.read_text()))


def plant(stage: Stage) -> None:
    """The appliance of `make run`, with a client that changes some registers."""
    stage.serve("run", "examples/plant.yaml")
    client = stage.enter_context(holdfast.SyncClient(stage.here("tcp://127.0.0.1:5010")))
    client.write("holding_registers", 20, "PUMP-01", "string:8")
    numbers = itertools.count()

    def change() -> None:
        number = next(numbers)
        value = 21.4 + math.sin(number / 9) / 100
        client.write("holding_registers", 100, value, "float32", "CDAB")
        client.write("holding_registers", 110, 100000 + number, "uint32")

    change()
    stage.repeat(change)


def heater(stage: Stage, port: str = "5020") -> None:
    """`holdfast simulate examples/tags/heater.yaml`."""
    stage.serve("simulate", HEATER, "--every", "0.1", "--bind", f":{stage.port(port)}")


def own_plant(page: str) -> Callable[[Stage], None]:
    """`plant.yaml` is the first configuration of the page. `watch` ends."""

    def put(stage: Stage) -> None:
        [text, *_] = re.findall(r"^```yaml\n(.*?)^```", (ROOT / page).read_text(), re.M | re.S)
        stage.file("plant.yaml", stage.here(text))
        stage.replaced["watch tcp"] = "watch --times 2 tcp"
        # Which types `describe` infers depends on when it looks, and so on the load of the machine.
        floats = {"area": "input_registers", "type": "float32", "order": "CDAB"}
        tags = {name: {**floats, "address": at} for name, at in (("ir_0", 0), ("ir_2", 2))}
        stage.file("described.yaml", written({"tags": tags}))
        stage.replaced["heater.yaml --only"] = "described.yaml --only"

    return put


def tour(stage: Stage) -> None:
    """`make run`."""
    process = subprocess.Popen(
        [sys.executable, str(ROOT / "tools" / "tour.py")], stdout=subprocess.PIPE, text=True
    )
    stage.callback(process.communicate)
    stage.callback(process.terminate)
    assert process.stdout is not None
    stage.names["greeting"] = "".join(iter(process.stdout.readline, "Ctrl-C stops it.\n"))
    stage.file(
        "plant.yaml",
        """\
memories:
  plant: {holding_registers: 70000}
listeners:
  scada:
    type: modbus-tcp
    bind: localhost:502
    acces: read-write
    rules:
      - {sources: [10.0.0.1/8], units: {1: plnt}, access: rw}
""",
    )


def audit(stage: Stage) -> None:
    """An audit log with one line of each kind of the page."""
    drive = stage.enter_context(
        holdfast.Server(
            {1: holdfast.Memory(holding_registers=9)}, bind="127.0.0.1:0", access="read-write"
        )
    )
    stage.appliance(
        f"""\
memories: {{plant: {{id: 3, coils: 8, holding_registers: 16}}}}
devices: {{drive: {{url: "tcp://127.0.0.1:{stage.keep(drive.address[1])}", unit: 1}}}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:5020
    rules:
      - sources: [127.0.0.0/8]
        units: {{1: plant, 7: {{route: drive}}}}
        access: read-write
  raw:
    type: raw-ingest
    format: crc
    bind: 127.0.0.1:9000
    rules: [{{sources: [127.0.0.0/8], memories: [plant], areas: [coils]}}]
rest:
  bind: 127.0.0.1:8080
  sources: [127.0.0.0/8]
  tokens:
    - {{name: edge, sha256: {SHA256}, memories: [plant], areas: [coils], access: read-write}}
audit: {{file: audit.log}}
"""
    )
    with holdfast.SyncClient(stage.here("tcp://127.0.0.1:5020")) as client:
        client.write_registers(2, [7, 8])
        client.unit = 7
        client.write_register(5, 4660)
    done("raw-send", stage.here("127.0.0.1:9000"), "coils", "0", "1", "0", "1", "--memory-id", "3")
    post(stage, "ingest", {"memory": "plant", "area": "coils", "address": 1, "values": [1, 0]})
    with pytest.raises(urllib.error.HTTPError):
        post(stage, "sessions/end", {"listener": "scada", "id": 1}, "another")
    file = stage.folder / "audit.log"
    wire.until(lambda: file.read_text().count("\n") >= 7, "the log is written")
    stage.names["audit_log"] = file.read_text()

    def delete(text: str) -> None:
        if "not intact" in text:
            lines = stage.names["audit_log"].splitlines(keepends=True)
            file.write_text("".join(lines[:2] + lines[4:]))

    stage.before = delete


def post(stage: Stage, path: str, body: Any, secret: str = SECRET) -> None:
    address = stage.here("http://127.0.0.1:8080")
    request = urllib.request.Request(
        f"{address}/api/v1/{path}",
        json.dumps(body).encode(),
        {"Content-Type": "application/json", "Authorization": f"Bearer {secret}"},
    )
    with urllib.request.urlopen(request, timeout=wire.DEADLINE) as response:
        response.read()


def command_line(stage: Stage) -> None:
    """The plant, and the heater."""
    stage.replaced |= {
        "--every 0.5": "--every 0.1",
        "--every 500ms": "--every 100ms",
        "--every 1": "--every 0.1",
        "--duration 3s": "--duration 300ms",
        "--times 3 --json": "--times 3 --json --every 0.1",
        "--times 4": "--times 4 --every 0.1",
    }
    plant(stage)
    heater(stage)
    for folder in (
        ".local/share/bash-completion/completions",
        ".zfunc",
        ".config/fish/completions",
    ):
        (stage.folder / folder).mkdir(parents=True)


WRONG = """\
memories:
  plant_a:
    coils: 16
    holding_register: 4096
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:502
    rules:
      - sources: [10.0.0.1/24]
        units: {1: plant_b}
        access: rw
"""
RIGHT = """\
memories: {plant: {holding_registers: 100}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8, 10.0.0.7], units: {1: plant}, access: read-write}]
"""


def configuration(stage: Stage) -> None:
    def put(text: str) -> None:
        stage.file("plant.yaml", WRONG if "problems" in text else RIGHT)
        stage.file("plant_a.csv", "area,address,value\nholding_registers,0,850\n")

    stage.before = put


def devices(stage: Stage) -> None:
    stage.file(
        "plant.yaml",
        """\
devices:
  burner:
    url: tcp://127.0.0.1:5502
    unit: 3
    interval: 1
    max_gap: 8
    forward: [{url: "raw://127.0.0.1:9000", unit: 1}]
    reads:
      - {area: holding_registers, address: 100, count: 4}
      - {area: holding_registers, address: 110, count: 8}
      - {area: coils, address: 0, count: 10}
""",
    )
    stage.replaced["127.0.0.1:5502"] = "127.0.0.1:5502"  # Nothing is sent.


def gateway(stage: Stage) -> None:
    """A device with changing registers."""
    memory = holdfast.Memory(holding_registers=100)
    memory.write("holding_registers", 4, [16812, 59743, 16256, 64926])
    bind = stage.here("127.0.0.1:5020")
    stage.enter_context(holdfast.Server({1: memory}, bind=bind, access="read-write"))
    values = itertools.count(1)
    changed = [0]

    def change() -> None:
        value = next(values) % 60000
        memory.write("holding_registers", changed[0], [value] * (2 - changed[0]))

    def choose(text: str) -> None:
        changed[0] = 1 if "/watch/view" in text else 0

    stage.before = choose
    change()
    stage.repeat(change)


def library(stage: Stage) -> None:
    """Two devices."""
    stage.replaced["interval=1"] = "interval=0.1"
    stage.file("meter.yaml", "tags: {power: {area: holding_registers, address: 2}}\n")
    for port in ("5020", "5021"):
        memory = holdfast.Memory(holding_registers=100)
        bind = f"127.0.0.1:{stage.port(port)}"
        stage.enter_context(holdfast.Server({1: memory}, bind=bind, access="read-only"))
    stage.names["holdfast"] = holdfast


def metrics(stage: Stage) -> None:
    """A sealed memory that was read once, and two refused requests."""
    stage.appliance(
        f"""\
memories:
  plant_a: {{coils: 8, holding_registers: 10, seal: {{area: coils, address: 0}}}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:5020
    rules: [{{sources: [127.0.0.0/8], units: {{1: plant_a}}, access: read-only}}]
rest:
  bind: 127.0.0.1:8080
  sources: [127.0.0.0/8]
  tokens:
    - {{name: edge, sha256: {SHA256}, memories: [plant_a], areas: [coils], access: read-write}}
metrics: {{bind: 127.0.0.1:9464, sources: [127.0.0.0/8]}}
"""
    )
    with (
        holdfast.SyncClient(stage.here("tcp://127.0.0.1:5020")) as client,
        pytest.raises(holdfast.ModbusException),
    ):
        client.read_holding_registers(0, 1)
    body = {"memory": "plant_a", "area": "coils", "address": 0, "values": [2]}
    for secret in (SECRET, "wrong"):
        with pytest.raises(urllib.error.HTTPError) as refused:
            post(stage, "ingest", body, secret)
        refused.value.close()


def monitoring(stage: Stage) -> None:
    """The folder with the rules, and an appliance that is ready."""
    tool("promtool")
    shutil.copytree(ROOT / "monitoring", stage.folder / "monitoring")
    stage.file(
        "plant.yaml",
        stage.here(
            """\
memories: {plant: {holding_registers: 8}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:5020
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: read-only}]
metrics: {bind: 127.0.0.1:9464}
"""
        ),
    )
    stage.serve("run", "plant.yaml")
    wire.until(lambda: invoke("health", "plant.yaml").exit_code == 0, "it is ready")


def tls(stage: Stage) -> None:
    """A certificate with a wrong role; a listener with the certificates of OpenSSL."""
    extension = "1.3.6.1.4.1.50316.802.1=ASN1:PRINTABLESTRING:operator"
    added = ["-addext", "basicConstraints=critical,CA:FALSE", "-addext", extension]
    command = f"{tool('openssl')} req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes"
    subject = ["-subj", "/CN=plc", "-keyout", "plc.key", "-out", "plc.pem", *added]
    subprocess.run([*command.split(), *subject], check=True, capture_output=True)

    def serve(text: str) -> None:
        if text.startswith("openssl s_client"):
            stage.appliance(
                """\
memories: {plant: {holding_registers: 100}}
listeners:
  secure:
    type: modbus-tls
    bind: 127.0.0.1:802
    tls: {cert_file: server.pem, key_file: server.key, ca_file: ca.pem}
    rules:
      - {sources: [127.0.0.0/8], roles: [operator], units: {1: plant}, access: read-only}
"""
            )

    stage.before = serve


def client(stage: Stage) -> None:
    """A device with TLS in place of 10.0.0.5:802."""
    memory = holdfast.Memory(coils=8)
    rule = holdfast.Rule({1: memory}, access="read-only", sources=["127.0.0.0/8"], roles=[""])
    files = holdfast.ServerTls(cert_file="server.pem", key_file="server.key", ca_file="ca.pem")
    server = holdfast.Server(bind="tls://127.0.0.1:0", rules=[rule], tls=files)
    stage.enter_context(server)
    stage.replaced["10.0.0.5:802"] = f"127.0.0.1:{server.address[1]}"


def importing(stage: Stage) -> None:
    """A configuration of each of the other programs."""
    page = (DOCS / "moving-from-mma.md").read_text()
    stage.file("config.yaml", page.split("```yaml\n")[1].split("```")[0])
    stage.file(
        "replicator.yaml",
        """\
replicator:
  units:
    - id: pump
      source: {endpoint: "127.0.0.1:5502", unit_id: 7, timeout_ms: 1500}
      reads: [{fc: 3, address: 999, quantity: 30}]
      targets: [{id: 2, endpoint: "127.0.0.1:501", memories: [{memory_id: 1, offsets: {}}]}]
      poll: {interval_ms: 250}
""",
    )


def mqtt(stage: Stage) -> None:
    """A broker, and an appliance that takes messages of `plant/ingest`."""
    broker = mosquitto(stage)
    stage.appliance(
        f"""\
memories: {{plant: {{input_registers: 100}}}}
rest: {{bind: 127.0.0.1:8080, sources: [127.0.0.0/8], tokens: none}}
mqtt:
  url: {broker.url}
  client_id: plant-a
  subscriptions: [{{topic: plant/ingest, qos: 1, memories: [plant], areas: [input_registers]}}]
"""
    )

    def diagnostics() -> Any:
        address = stage.here("http://127.0.0.1:8080")
        with urllib.request.urlopen(f"{address}/api/v1/diagnostics/mqtt") as response:
            return json.load(response)

    stage.names["diagnostics"] = diagnostics
    wire.until(lambda: diagnostics()["topics"][0]["granted"] == 1, "it has subscribed")


def mosquitto(stage: Stage) -> Mosquitto:
    """A broker, which the programs of Mosquitto use."""
    folder = stage.folder / "broker"
    folder.mkdir()
    broker = Mosquitto(folder)
    stage.callback(broker.kill)
    stage.keep(broker.port)
    for program in ("mosquitto_pub", "mosquitto_rr", "mosquitto_sub"):
        stage.replaced[program] = f"{program} -p {broker.port}"
    return broker


def home_assistant(stage: Stage) -> None:
    """A broker in place of 127.0.0.1:1883."""
    stage.replaced["1883"] = str(mosquitto(stage).port)
    own_plant("docs/home-assistant.md")(stage)
    del stage.replaced["heater.yaml --only"]


def serial_line(stage: Stage) -> None:
    """A device on a pseudo-terminal in place of /dev/ttyUSB0."""

    def slow_as_a_line(asked: Asked) -> None:
        threading.Event().wait(0.03)
        asked.answer()

    device = stage.folder / "ttyUSB0"
    stage.enter_context(Serial(RTU, device, then=slow_as_a_line))
    stage.replaced["/dev/ttyUSB0"] = str(device.resolve())
    own_plant("docs/raspberry-pi.md")(stage)


def troubles(stage: Stage) -> None:
    """A device with registers, and an appliance."""
    stage.file("plant.yaml", stage.here(f"{RIGHT}metrics: {{bind: 127.0.0.1:9464}}\n"))
    stage.serve("run", "plant.yaml")
    memory = holdfast.Memory(holding_registers=100)
    bind = stage.here("127.0.0.1:5020")
    stage.enter_context(holdfast.Server({1: memory}, bind=bind, access="read-only"))
    stage.replaced["watch tcp"] = "watch --times 2 --every 0.1 tcp"


def outputs(stage: Stage) -> None:
    """Two devices whose values go to files and a broker, and can be set."""
    broker = mosquitto(stage)
    memory = holdfast.Memory(holding_registers=100)
    server = stage.enter_context(
        holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write")
    )
    url = f"tcp://127.0.0.1:{stage.keep(server.address[1])}"
    stage.appliance(
        f"""\
profiles:
  meter: {{tags: {{power: {{area: holding_registers, address: 10}}}}}}
  boiler:
    tags:
      setpoint: {{area: holding_registers, address: 0, scale: 0.1, writable: true, min: 5, max: 30}}
      mode: {{area: holding_registers, address: 1, states: {{0: off, 1: running}}, writable: true}}
devices:
  meter_1: {{url: "{url}", profile: meter, interval: 0.1}}
  boiler: {{url: "{url}", profile: boiler, interval: 0.1}}
outputs:
  home: {{type: mqtt, url: "{broker.url}", topic: "plant/{{device}}/{{tag}}", writes: true}}
  base: {{type: file, file: values.db, format: sqlite}}
"""
    )
    wire.until(lambda: "plant/boiler/setpoint/set (" in broker.log, "it takes values")


def raw_ingest(stage: Stage) -> None:
    """The first appliance of the page; listeners for the format `crc` and for TLS."""
    stage.replaced["10.0.2.9"] = "127.0.0.1"
    for name in ("ca.pem", "holdfast.pem", "holdfast.key"):
        (stage.folder / name).unlink()
    done("cert", "ca", "Plant authority")
    done("cert", "server", "holdfast", "--san", "127.0.0.1")
    done("cert", "client", "line-1", "--role", "line")
    page = (DOCS / "raw-ingest.md").read_text()
    text = page.split("```yaml\n")[1].split("```")[0]
    for port in ("9000", "9001", "8900"):
        stage.port(port)
    stage.appliance(
        text.replace("input_registers: 128}", "input_registers: 128, holding_registers: 100}")
        + """
  crc:
    type: raw-ingest
    format: crc
    bind: 127.0.0.1:9001
    rules: [{sources: [127.0.0.0/8], memories: [plant], areas: [discrete_inputs]}]
  secure:
    type: raw-ingest
    bind: 127.0.0.1:8900
    tls: {cert_file: holdfast.pem, key_file: holdfast.key, ca_file: ca.pem}
    rules:
      - {sources: [127.0.0.0/8], roles: [line], units: {1: plant}, areas: [holding_registers]}
"""
    )


def rest(stage: Stage) -> None:
    """A memory and a token as on the page, and a listener with connections."""
    appliance = stage.appliance(
        f"""\
memories:
  plant_a: {{holding_registers: 100, input_registers: {{start: 1000, size: 100}}}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:5020
    rules: [{{sources: [127.0.0.0/8], units: {{1: plant_a}}, access: read-write}}]
rest:
  bind: 127.0.0.1:8080
  sources: [127.0.0.0/8]
  tokens:
    - name: edge
      sha256: {SHA256}
      memories: [plant_a]
      areas: [holding_registers, input_registers]
      access: read-write
      manage: true
"""
    )
    for _ in range(18):
        stage.enter_context(wire.Connection(("127.0.0.1", stage.port("5020"))))
    numbers = itertools.count(201)

    def change() -> None:
        number = next(numbers) % 60000
        appliance.memories["plant_a"].write("holding_registers", 1, [number] * 3)

    def follow(text: str) -> None:
        if text.startswith("curl -N"):
            stage.repeat(change)

    stage.before = follow


def scanner(stage: Stage) -> None:
    """NATS in place of `localhost:4222`."""
    folder = stage.folder / "nats-server"
    folder.mkdir()
    server = NatsServer(folder)
    stage.callback(server.kill)
    stage.replaced["4222"] = str(server.port)


def fleet(stage: Stage) -> None:
    """The two nodes of the page."""
    scanner(stage)
    for node in ("scan-a", "scan-b"):
        url = f"nats://127.0.0.1:{stage.replaced['4222']}"
        stage.serve("scan", "--nats", url, "--fleet", "plant", "--node", node)
    shown = ("fleet", "status", "plant", "--nats", url)
    wire.until(lambda: invoke(*shown).exit_code == 0, "the nodes have joined")


def durability(stage: Stage) -> None:
    memory = holdfast.Memory(holding_registers=1000)
    memory.write("holding_registers", 10, [7, 8])
    file = MemoryFile(stage.folder / "setpoints.redb", [("setpoints", memory)], 0)
    file.start()
    file.stop()
    folder = stage.folder / "nats-server"
    folder.mkdir()
    server = NatsServer(folder)
    stage.callback(server.kill)
    (stage.folder / "more-servers").mkdir()
    grown = NatsServer(stage.folder / "more-servers")
    stage.callback(grown.kill)
    # Nothing listens at 5041, the first address of the client.
    for name, url in (("plant", server.url), ("grown", grown.url)):
        stage.file(
            f"{name}.yaml",
            f"""memories: {{plant: {{holding_registers: 100, replicate: {{log: site}}}}}}
logs: {{site: {{servers: ["{url}"], node: scada-a}}}}
listeners:
  scada:
    type: modbus-tcp
    bind: {stage.here("127.0.0.1:5042")}
    rules: [{{sources: [127.0.0.0/8], units: {{1: plant}}, access: read-write}}]
""",
        )
    stage.serve("run", "plant.yaml")


def operations(stage: Stage) -> None:
    """A configuration, and an appliance that has not polled its device yet."""
    stage.file("plant.yaml", RIGHT)
    rules = "rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: read-only}]"
    appliance = stage.appliance(
        f"""\
memories: {{plant: {{holding_registers: 8}}}}
listeners:
  scada: {{type: modbus-tcp, bind: "127.0.0.1:5020", {rules}}}
  historian: {{type: modbus-tcp, bind: "127.0.0.1:5021", {rules}}}
devices:
  meter:
    url: tcp://127.0.0.1:1
    interval: 60
    reads: [{{area: holding_registers, address: 0, count: 1}}]
metrics: {{bind: 127.0.0.1:9464}}
"""
    )
    stage.names["ready"] = appliance.health.ready
    wire.until(lambda: appliance.health.ready()["services"].ok, "the metrics are served")


def tags(stage: Stage) -> None:
    stage.file(
        "wrong.yaml",
        "order: CDAB\ntags:\n  power: {area: input_registers, address: 2, type: float23}\n",
    )


STAGES: dict[str, Callable[[Stage], None]] = {
    "README.md": own_plant("README.md"),
    "docs/audit.md": audit,
    "docs/cli.md": command_line,
    "docs/client.md": client,
    "docs/config.md": configuration,
    "docs/describe.md": plant,
    "docs/devices.md": devices,
    "docs/durability.md": durability,
    "docs/fleet.md": fleet,
    "docs/gateway.md": gateway,
    "docs/home-assistant.md": home_assistant,
    "docs/just-the-memory.md": own_plant("docs/just-the-memory.md"),
    "docs/library.md": library,
    "docs/metrics.md": metrics,
    "docs/monitoring.md": monitoring,
    "docs/modbus-tls.md": tls,
    "docs/moving-from-mma.md": importing,
    "docs/moving-from-tentacle.md": scanner,
    "docs/mqtt.md": mqtt,
    "docs/operations.md": operations,
    "docs/outputs.md": outputs,
    "docs/raspberry-pi.md": serial_line,
    "docs/raw-ingest.md": raw_ingest,
    "docs/rest.md": rest,
    "docs/routes.md": audit,
    "docs/rs485.md": serial_line,
    "docs/start.md": own_plant("docs/start.md"),
    "docs/tags.md": tags,
    "docs/tour.md": tour,
    "docs/troubleshooting.md": troubles,
}
"""What a page needs besides `everywhere`."""

"""Compares an MQTT output with paho itself, which publishes the same messages.

Each turn publishes tag changes with QoS 1, retained, to a Mosquitto of its own, until all are
confirmed. The output also converts the values; paho gets topics and payloads as they are. Turns
are processes of their own, on one core; the broker has the other. Ratios compare turns of the same
round; figures are the medians of all rounds.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from common import medians, pinned, python, ratio, turns
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

from holdfast.config.models.outputs import MqttOutputConfig
from holdfast.outputs import Buffer, OutputSender
from holdfast.outputs.device_access import DeviceInfo
from holdfast.outputs.mqtt import MqttOutput
from holdfast.outputs.mqtt.messages import Payloads
from holdfast.polling import Reading
from holdfast.runtime.stop import Stop
from holdfast.tags import Tag

DEVICES, TAGS = 100, 100
TIMEOUT = 120.0


def main() -> None:
    """Prints a line for each contestant, and writes all results to the file of `--json`."""
    options = arguments()
    if options.turn:
        print(TURNS[options.turn](options.port, options.changes, options.payload))
        return
    rounds = []
    for index in range(options.rounds):
        result = {}
        for name in turns(list(TURNS), index):
            with broker() as port:
                command = python(
                    "mqtt_output.py", "--turn", name, "--port", port,
                    "--changes", options.changes, "--payload", options.payload,
                )  # fmt: skip
                found = subprocess.run(
                    command, check=True, stdout=subprocess.PIPE, text=True, preexec_fn=pinned(1)
                )
                figures = map(float, found.stdout.split())
                result[name] = dict(zip(("rate", "cpu"), figures, strict=True))
        rounds.append(result)
    for name in TURNS:
        rate, used = medians(rounds, name, "rate", "cpu")
        of = ratio(rounds, name, "paho")
        print(f"{name:10} {rate:10,.0f} changes/s {used:6.1f} us cpu  {of} of paho")
    if options.json:
        options.json.write_text(json.dumps(rounds, indent=1))


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--changes", type=int, default=50_000, help="in each turn")
    parser.add_argument("--payload", choices=["plain", "json", "device"], default="plain")
    parser.add_argument("--json", type=Path, help="file for all results")
    parser.add_argument("--turn", help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    return parser.parse_args()


@contextmanager
def broker() -> Iterator[int]:
    """A broker that takes 1000 messages before it confirms one, as the output sends them."""
    with tempfile.TemporaryDirectory() as folder:
        process, port = mosquitto(Path(folder))
        try:
            yield port
        finally:
            process.kill()
            process.wait()


def mosquitto(folder: Path) -> tuple[subprocess.Popen[str], int]:
    program = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin:/usr/local/sbin")
    if program is None:
        sys.exit("mosquitto is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    file = folder / "mosquitto.conf"
    file.write_text(
        f"listener {port} 127.0.0.1\nallow_anonymous true\nuser root\n"
        "max_inflight_messages 1000\nlog_dest none\n"
    )
    process = subprocess.Popen(
        [program, "-c", str(file)], text=True, stderr=subprocess.DEVNULL, preexec_fn=pinned(0)
    )
    until(lambda: connects(port))
    return process, port


def connects(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), 1).close()
    except OSError:
        return False
    return True


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + TIMEOUT
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError
        time.sleep(0.001)


def readings(count: int) -> list[Reading]:
    tags = [
        Tag(f"tag_{number}", "input_registers", number, "int16", scale=0.1, unit="V")
        for number in range(TAGS)
    ]
    return [
        Reading(f"device_{number // TAGS % DEVICES}", tags[number % TAGS], number / 10, 1.7e9)
        for number in range(count)
    ]


class Site:
    """A site without devices: only values are published."""

    revision = answering_revision = 0
    standby: frozenset[str] = frozenset()

    def __init__(self) -> None:
        self.retained: dict[tuple[str, str], str] = {}

    def devices(self) -> dict[str, DeviceInfo]:
        return {}

    def tags(self) -> dict[str, list[Tag]]:
        return {}

    def answering(self) -> dict[str, bool]:
        return {}

    def latest(self) -> list[Reading]:
        return []

    def refresh(self) -> None:
        pass

    def write(self, *_: object, **__: object) -> None:
        pass


def settings(port: int, payload: str) -> MqttOutputConfig:
    url = f"mqtt://127.0.0.1:{port}"
    return MqttOutputConfig.model_validate({"type": "mqtt", "url": url, "payload": payload})


def holdfast(port: int, count: int, payload: str) -> str:
    output = MqttOutput("bench", settings(port, payload), Site())
    buffer, stop = Buffer(), Stop()
    sender = OutputSender("bench", output, buffer)
    thread = threading.Thread(target=sender.run, args=[stop])
    output.use_stop(stop)
    output.idle()  # Connects.
    changes = readings(count)
    thread.start()
    began, cpu = time.perf_counter(), time.process_time()
    for at in range(0, count, 1000):
        buffer.offer([changes[at : at + 1000]])
    until(lambda: not len(buffer))
    took = time.perf_counter() - began
    used = time.process_time() - cpu
    stop.set()
    thread.join()
    return f"{count / took} {used / count * 1e6}"


def paho(port: int, count: int, payload: str) -> str:
    client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5)
    client.max_inflight_messages_set(1000)
    client.max_queued_messages_set(0)
    client.connect("127.0.0.1", port)
    client.loop_start()
    until(client.is_connected)
    packed = Payloads(settings(port, payload)).messages(readings(count))
    messages = [(each.topic[2:].decode(), each.payload) for each in packed]
    began, cpu = time.perf_counter(), time.process_time()
    for topic, text in messages:
        last = client.publish(topic, text, 1, retain=True)
    last.wait_for_publish(TIMEOUT)  # They are confirmed in order.
    took = time.perf_counter() - began
    used = time.process_time() - cpu
    client.disconnect()
    client.loop_stop()
    return f"{count / took} {used / count * 1e6}"


TURNS = {"holdfast": holdfast, "paho": paho}

if __name__ == "__main__":
    main()

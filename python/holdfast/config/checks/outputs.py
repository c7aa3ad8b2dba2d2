"""Checks rules between keys of outputs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.config.checks.common import Owners, check_name, given, items, until_invalid
from holdfast.config.checks.nats import check_dialect_of, check_nats
from holdfast.config.checks.services import check_broker
from holdfast.config.checks.tls import check_client_tls, check_files
from holdfast.config.models.outputs import (
    InfluxConfig,
    MqttOutputConfig,
    NatsOutputConfig,
    SparkplugConfig,
)
from holdfast.config.text.messages import show
from holdfast.config.values.mqtt_output_topics import REPLY
from holdfast.config.values.topics import TAG

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.config.checks.common import Scope
    from holdfast.config.models.outputs import Output
    from holdfast.config.text.yaml_document import KeyPath


def check_outputs(scope: Scope) -> None:
    """Reports what is wrong."""
    edge_nodes = Owners(scope.report, "edge node")
    with until_invalid():
        for path, output in items(("outputs",), scope.config.outputs):
            with until_invalid():
                for where, name in items((*path, "devices"), output.devices or ()):
                    check_name(where, name, scope.names("devices"), "devices", scope.report)
            with until_invalid():
                _check_output(scope, path, output, edge_nodes)


def _check_output(scope: Scope, path: KeyPath, output: Output, edge_nodes: Owners) -> None:
    if not output.type:
        return  # Never: the read ends the checks of an output whose type is invalid.
    if isinstance(output, InfluxConfig):
        _check_influx(scope, path, output)
    elif isinstance(output, NatsOutputConfig):
        check_nats(path, output, scope.report)
        check_dialect_of(path, output, scope.report)
    elif isinstance(output, MqttOutputConfig):
        check_broker(path, output, scope.report)
        _check_topics(scope, path, output)
    elif isinstance(output, SparkplugConfig):
        with until_invalid():
            node, group = output.edge_node, output.group
            shown = f"{show(node)} in the group {show(group)}"
            edge_nodes.claim((*path, "edge_node"), (group, node), shown, path)
        check_broker(path, output, scope.report)


def _check_influx(scope: Scope, path: KeyPath, output: InfluxConfig) -> None:
    target, report = output.target, scope.report
    with until_invalid():
        if "device" in output.tags:
            message = "found device, which has the name of the device, allowed: another name"
            report.add_key((*path, "tags", "device"), message)
    if target.path in ("", "/") and not given(output, "bucket"):
        report.add_key((*path, "bucket"), "missing, allowed: a bucket, or a url with a path")
    if given(output, "tls") and not target.secure:
        report.add_key((*path, "tls"), "found with http://, allowed: only with https://")
    if len(given(output, "username", "token_file")) > 1:
        message = "found together with token_file, allowed: only one of them"
        report.add_key((*path, "username"), message)
    user = given(output, "username", "password_file")
    if len(user) == 1:
        other = "password_file" if user == ["username"] else "username"
        report.add_key((*path, *user), f"found without {other}")
    check_files(path, output, ("token_file", "password_file"), report)
    check_client_tls((*path, "tls"), output.tls, report)


def _check_topics(scope: Scope, path: KeyPath, output: MqttOutputConfig) -> None:
    template, whole = output.topic, output.payload == "device"
    if template is not None and whole and TAG in template:
        message = f"found {show(template)} with payload: device, allowed: without {TAG}"
        scope.report.add((*path, "topic"), message)
    if template is not None and not whole and TAG not in template:
        message = f"found {show(template)}, allowed: with {TAG} (optional with payload: device)"
        scope.report.add((*path, "topic"), message)
    with until_invalid():
        known = scope.names("devices")
        devices = [each for each in output.devices or known if each in known]
        owners = {
            topic: device for device in devices for topic in _topics_of(scope, output, device)
        }
        status = output.topics.status
        for topic in (status, *map(output.topics.of_availability, devices)):
            if (owner := owners.get(topic)) is not None:
                found = show(status)
                if topic != status:
                    found += f", and below it {show(topic)}"
                message = f"found {found}, which is a topic of the device {owner}"
                scope.report.add_key((*path, "status"), f"{message}, allowed: another topic")
                break


def _topics_of(scope: Scope, output: MqttOutputConfig, device: str) -> Iterator[str]:
    """The topics of a device's values; with `writes`, also those of commands and replies."""
    settings = scope.config.devices[device]
    profile = None if settings.profile is None else scope.config.profiles.get(settings.profile)
    found = {*settings.tags, *(() if profile is None else profile.tags)}
    names, tags = output.topics, [name for name in found if isinstance(name, str)]
    yield from names.of_values(device, tags)
    if output.writes:
        for command in (names.of_commands(device, tag) for tag in tags):
            yield from (command, f"{command}/{REPLY}")


def warn_of_outputs(scope: Scope) -> None:
    """Warns about settings of valid outputs that have no effect."""
    config = scope.config
    if config.outputs and not any(device.has_tags for device in config.devices.values()):
        scope.report.warn(("outputs",), "has no effect: no device has tags")
    owners: dict[tuple[str, int, str], str] = {}
    for name, output in config.outputs.items():
        path: KeyPath = ("outputs", name)
        if isinstance(output, InfluxConfig):
            _warn_of_influx(scope, path, output)
        if not isinstance(output, MqttOutputConfig):
            continue
        status = output.topics.status
        owner = owners.setdefault((output.host, output.port, status), name)
        if owner != name:
            message = f"found {show(status)}, which is the status topic of outputs.{owner}"
            message += " at the same broker, and can't show both, allowed: a different one"
            scope.report.warn((*path, "status"), message)
        if given(output, "discovery_prefix") and output.discovery is None:
            scope.report.warn((*path, "discovery_prefix"), "has no effect without discovery")
        if output.discovery is not None and not output.retain:
            message = "with it, Home Assistant has no value after a start until one changes"
            scope.report.warn((*path, "retain"), message)


def _warn_of_influx(scope: Scope, path: KeyPath, output: InfluxConfig) -> None:
    """Warns of names that InfluxDB does not take, or confuses. Other receivers may take them."""
    if "time" in output.tags:
        message = "InfluxDB refuses all points with a tag of this name"
        scope.report.warn((*path, "tags", "time"), message)
    fields: dict[str, str] = {}
    for device in output.devices or scope.config.devices:
        for tag in scope.config.tags(device):
            if tag.of_type.count is None:  # The fields of an array have other names.
                fields.setdefault(tag.name, device)
    for name, device in fields.items():
        found = f"found the tag {name} of {device}"
        if name == "time":
            message = f"{found}: InfluxDB stores no field of this name, its values are lost"
            scope.report.warn(path, message)
        elif name == "device" or name in output.tags:
            message = (
                f"{found}, and {name} as a tag of all points: queries of InfluxDB confuse them"
            )
            scope.report.warn(path, message)

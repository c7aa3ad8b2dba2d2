"""Outputs: publish the values of tags. Only configured outputs load their library."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, assert_never

from holdfast.appliance.client_credentials import nats_servers
from holdfast.appliance.services.services import Service
from holdfast.appliance.services.supervision import Supervisor
from holdfast.config.models.outputs import (
    FileConfig,
    InfluxConfig,
    MqttOutputConfig,
    NatsOutputConfig,
    SparkplugConfig,
)
from holdfast.outputs.device_access import NotWritten

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping

    from holdfast.appliance.parts.tag_values import TagValues
    from holdfast.appliance.parts.tag_writes import TagWrites
    from holdfast.appliance.services.services import Services
    from holdfast.config import Config
    from holdfast.config.models.outputs import Output
    from holdfast.outputs import Receiver
    from holdfast.outputs.device_access import DeviceInfo, Site
    from holdfast.polling import Reading
    from holdfast.tags import Tag

PREFIX = "output/"
"""The beginning of the names of outputs among the adapters, whose names have no slash."""


class Outputs(Service):
    """The services of the section `outputs`."""

    def adapters(self, config: Config, running: Services) -> Iterator[Supervisor]:
        """Yields all outputs, if there are tags."""
        values, writes = running.context.devices.values, running.context.devices.writes
        if values is None or writes is None:
            return
        for name, settings in config.outputs.items():
            site = _Site(name, settings.devices, values, writes)
            factory = partial(values.sending, name, partial(receiver, name, settings, site))
            yield Supervisor(f"{PREFIX}{name}", factory, settings)


class _Site:
    """The devices of the appliance, as one output may see them: a `Site`."""

    def __init__(
        self, output: str, only: Collection[str] | None, values: TagValues, writes: TagWrites
    ) -> None:
        self._output, self._only = output, only
        self._values, self._writes = values, writes

    @property
    def revision(self) -> int:
        return self._values.revision

    @property
    def answering_revision(self) -> int:
        return self._values.answers

    def tags(self) -> dict[str, tuple[Tag, ...]]:
        return {name: tags for name, tags in self._values.tags().items() if self._has(name)}

    def devices(self) -> Mapping[str, DeviceInfo]:
        return self._values.devices

    def answering(self) -> dict[str, bool]:
        answers = self._values.answering()
        return {name: answer for name, answer in answers.items() if self._has(name)}

    @property
    def standby(self) -> frozenset[str]:
        return self._values.standby

    def latest(self) -> list[Reading]:
        return [reading for reading in self._values.latest() if self._has(reading.device)]

    @property
    def retained(self) -> dict[tuple[str, str], str]:
        return self._values.retained

    def _has(self, device: str) -> bool:
        return self._only is None or device in self._only

    def refresh(self) -> None:
        self._values.refresh(self._output)

    def write(
        self,
        device: str,
        tag: str,
        text: str,
        peer: str,
        done: Callable[[NotWritten | None], None],
        *,
        states: bool = True,
    ) -> None:
        if not self._has(device):
            raise NotWritten("unknown_tag", "no such tag")
        self._writes.write(device, tag, text, f"output/{self._output}", peer, done, states=states)


def receiver(name: str, settings: Output, site: Site) -> Receiver:
    """The receiver that the settings describe."""
    match settings:
        case InfluxConfig():
            from holdfast.outputs.influx import Influx

            return Influx(settings)
        case NatsOutputConfig():
            from holdfast.scanner.publish.nats_output import NatsOutput

            return NatsOutput(nats_servers(settings), settings.prefix, settings.dialect)
        case MqttOutputConfig():
            from holdfast.outputs.mqtt import MqttOutput

            return MqttOutput(name, settings, site)
        case SparkplugConfig():
            from holdfast.outputs.sparkplug import SparkplugOutput

            return SparkplugOutput(name, settings, site)
        case FileConfig(format="sqlite"):
            from holdfast.outputs.sqlite_file import SqliteFile

            return SqliteFile(settings)
        case FileConfig():
            from holdfast.outputs.text_file import TextFile

            return TextFile(settings)
        case _:
            assert_never(settings)

"""Creates the receiver of an output. Its library is imported only if it is configured."""

from __future__ import annotations

from typing import TYPE_CHECKING, assert_never

from holdfast.appliance import assembly
from holdfast.config.outputs import (
    FileConfig,
    InfluxConfig,
    MqttOutputConfig,
    NatsOutputConfig,
    SparkplugConfig,
)

if TYPE_CHECKING:
    from holdfast.config.outputs import Output
    from holdfast.outputs import Receiver
    from holdfast.outputs.site import Site


def receiver(name: str, settings: Output, site: Site) -> Receiver:
    """The receiver that the settings describe."""
    match settings:
        case InfluxConfig():
            from holdfast.outputs.influx import Influx

            return Influx(settings)
        case NatsOutputConfig():
            from holdfast.scanner.publish.nats_output import NatsOutput

            servers = assembly.nats_servers(settings)
            return NatsOutput(servers, settings.prefix, settings.dialect)
        case MqttOutputConfig():
            from holdfast.outputs.mqtt import MqttOutput

            return MqttOutput(name, settings, site)
        case SparkplugConfig():
            from holdfast.outputs.sparkplug import SparkplugOutput

            return SparkplugOutput(name, settings, site)
        case FileConfig(format="sqlite"):
            from holdfast.outputs.database import Database

            return Database(settings)
        case FileConfig():
            from holdfast.outputs.text_file import TextFile

            return TextFile(settings)
        case _:
            assert_never(settings)

"""The receiver of a Sparkplug output: sessions with the broker, births and deaths."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.events import log_lines
from holdfast.outputs.mqtt.receiver import BrokerReceiver
from holdfast.outputs.mqtt.session import Session
from holdfast.outputs.sender import Refused
from holdfast.outputs.sparkplug.commands import Commands
from holdfast.outputs.sparkplug.node import EdgeNode, Names, state_topic
from holdfast.outputs.sparkplug.primary_host import PrimaryHost

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.config.models.outputs import SparkplugConfig
    from holdfast.net.mqtt.packets import Publish
    from holdfast.outputs.buffer import Buffer
    from holdfast.outputs.device_access import Site
    from holdfast.outputs.mqtt.delivery import Message
    from holdfast.polling import Reading
    from holdfast.runtime.stop import Stop


class SparkplugOutput(BrokerReceiver):
    """Publishes readings as an edge node."""

    def __init__(self, name: str, settings: SparkplugConfig, site: Site) -> None:
        super().__init__(name, settings, f"{settings.group}/{settings.edge_node}")
        self._settings, self._site = settings, site
        self._names = Names(settings.group, settings.edge_node)
        self._node = EdgeNode(
            self._names, self._next_number, always_typed=settings.datatypes == "always"
        )
        self._commands = Commands(name, self._broker, site, self._node.find, writes=settings.writes)
        self._primary = None if settings.primary_host is None else PrimaryHost()
        self._has_published_births = False
        self._births = 0
        self._buffer: Buffer | None = None

    def use_buffer(self, buffer: Buffer) -> None:
        """Takes the buffer, whose order tells which values are historical."""
        self._buffer = buffer

    def send(self, readings: list[Reading]) -> None:
        """Publishes readings, and waits until the broker must have them.

        If it fails, the same readings follow in the next session, as historical values. Raises
        `Refused` for those that are of an earlier form of their tag.
        """
        assert self._buffer is not None, "use_buffer comes first"
        number = self._buffer.first_number
        session = self._ready()
        data = list(self._node.data(readings, self._latest, number))
        deaths = self._node.device_deaths(self._site.answering(), readings)
        self._publish(session, [*data, *deaths])
        if unfit := self._node.unfit:
            raise Refused("they were read before their tags were changed", unfit)

    def idle(self) -> bool:
        """Keeps the session, and publishes which devices answer."""
        session = self._ready()
        self._publish(session, self._node.device_deaths(self._site.answering()))
        return True

    def close(self) -> None:
        """Ends the session with NDEATH."""
        self._disconnect()

    def status(self) -> dict[str, object]:
        """The broker, the node and the session."""
        found: dict[str, object] = {
            **super().status(),
            "group": self._settings.group,
            "edge_node": self._settings.edge_node,
            "born": self._has_published_births,
            "births": self._births,
            "commands_written": self._commands.written,
            "commands_refused": self._commands.refused,
            "commands_ignored": self._commands.ignored,
        }
        if self._primary is not None:
            found["primary_host_online"] = self._primary.is_online
        return found

    def _ready(self) -> Session:
        """The session, after all births that are due. Raises `OSError`."""
        session = self._connected()
        if self._primary is not None and not self._primary.is_online:
            if self._has_published_births:
                self._disconnect()
            raise ConnectionError(f"the primary host {self._settings.primary_host} is offline")
        revision, answering = self._site.revision, self._site.answering()
        if revision != self._revision or not self._has_published_births:
            self._adopt(session)
            self._revision = revision
            self._commands.rebirth.set()
        if self._commands.rebirth.is_set():
            self._commands.rebirth.clear()
            self._births += 1
            self._publish(session, self._node.births(answering, self._latest))
            self._has_published_births = True
        else:
            self._publish(session, self._node.device_births(answering, self._latest))
        return session

    def _open(self, stop: Stop) -> Session:
        self._node.begin()
        if self._primary is not None:
            self._primary.begin()
        return Session(
            self._settings,
            self._client_id,
            self._node.death(),
            self._on_message,
            self._on_refused,
            stop,
            qos=0,
            will_qos=1,
            takes_commands=self._settings.writes,
            confirms_by_ping=True,
        )

    def _greet(self, session: Session) -> None:
        session.subscribe([self._names.of("NCMD")], retained=False)
        if self._primary is not None:
            assert self._settings.primary_host is not None, "there is one"
            session.subscribe([state_topic(self._settings.primary_host)], retained=True)
            self._primary.wait()

    def _adopt(self, session: Session) -> None:
        """Takes over the tags: of a new session, and after a reload."""
        tags = self._site.tags()
        self._node.adopt(tags)
        if self._settings.writes:
            devices = [device for device, some in tags.items() if any(tag.writable for tag in some)]
            topics = [self._names.of("DCMD", device) for device in devices]
            session.subscribe(topics, retained=False)

    def _next_number(self) -> int:
        assert self._buffer is not None, "use_buffer comes first"
        return self._buffer.next_number

    def _latest(self) -> dict[str, dict[str, Reading]]:
        """The last reading of each tag of each device."""
        found: dict[str, dict[str, Reading]] = {}
        for reading in self._site.latest():
            found.setdefault(reading.device, {})[reading.tag.name] = reading
        return found

    def _publish(self, session: Session, messages: Sequence[Message]) -> None:
        """Publishes messages, and waits until the broker must have them. Raises `OSError`."""
        if messages:
            self._wait(session, session.publish(messages))

    def _disconnect(self) -> None:
        session, self._session = self._session, None
        self._has_published_births = False
        if session is not None:
            session.close([self._node.death()], with_will=True)

    def _on_message(self, message: Publish) -> None:
        """Takes a message of the broker. Called by the thread of the connection."""
        if message.topic == self._names.of("NCMD"):
            self._commands.take(message, None)
        elif (device := self._names.device_of(message.topic)) is not None:
            self._commands.take(message, device)
        elif self._primary is not None:
            try:
                self._primary.take(bytes(message.payload))
            except ValueError as error:
                log_lines.refused(
                    "output_state_ignored",
                    kind=self._name,
                    output=self._name,
                    topic=message.topic,
                    reason=str(error),
                )

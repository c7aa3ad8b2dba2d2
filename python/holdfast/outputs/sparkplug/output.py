"""The receiver of a Sparkplug output: sessions with the broker, births and deaths."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING

from holdfast import logs
from holdfast.net.addresses import joined
from holdfast.outputs.mqtt.session import Session
from holdfast.outputs.sparkplug.commands import Commands
from holdfast.outputs.sparkplug.names import Names, state_topic
from holdfast.outputs.sparkplug.node import EdgeNode
from holdfast.outputs.sparkplug.primary_host import PrimaryHost

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.config.outputs import SparkplugConfig
    from holdfast.mqtt.packets import Publish
    from holdfast.outputs.mqtt.messages import Delivery, Message
    from holdfast.outputs.site import Site
    from holdfast.polling import Reading
    from holdfast.runtime.stop import Stop

TIMEOUT = 2.0
"""Seconds to wait for the state of the primary host after connecting."""


class SparkplugOutput:
    """Publishes readings as an edge node. Reconnects when it is asked to send, and after an idle
    second.
    """

    def __init__(self, name: str, settings: SparkplugConfig, site: Site) -> None:
        self._name, self._settings, self._site = name, settings, site
        self._client_id = settings.client_id or f"holdfast-{name}-{socket.gethostname()}"
        self._broker = joined(settings.host, settings.port)
        self._names = Names(settings.group, settings.edge_node)
        self._node = EdgeNode(self._names, always_typed=settings.datatypes == "always")
        self._commands = Commands(name, self._broker, site, self._node.find, writes=settings.writes)
        self._primary = None if settings.primary_host is None else PrimaryHost()
        self._stop: Stop | None = None
        self._session: Session | None = None
        self._is_born = False
        self._revision = -1
        self._connects = self._births = self._not_accepted = 0

    def until(self, stop: Stop) -> None:
        """Takes the stop that ends all waiting. Called before all else."""
        self._stop = stop

    def send(self, readings: list[Reading]) -> None:
        """Publishes readings, and waits until the broker must have them.

        If it fails, the same readings follow in the next session, as historical values.
        """
        session = self._ready()
        data = list(self._node.data(readings, self._latest))
        deaths = self._node.device_deaths(self._site.answering(), readings)
        self._publish(session, [*data, *deaths])

    def idle(self) -> None:
        """Keeps the session, and publishes which devices answer."""
        session = self._ready()
        self._publish(session, self._node.device_deaths(self._site.answering()))

    def close(self) -> None:
        """Ends the session with NDEATH."""
        self._disconnect()

    def status(self) -> dict[str, object]:
        """The broker, the node and the session."""
        found: dict[str, object] = {
            "broker": self._broker,
            "client_id": self._client_id,
            "version": self._settings.version,
            "group": self._settings.group,
            "edge_node": self._settings.edge_node,
            "born": self._is_born,
            "births": self._births,
            "reconnects": max(0, self._connects - 1),
            "not_accepted": self._not_accepted,
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
            if self._is_born:
                self._disconnect()
            raise ConnectionError(f"the primary host {self._settings.primary_host} is offline")
        revision, answering = self._site.revision, self._site.answering()
        if revision != self._revision or not self._is_born:
            self._adopt(session)
            self._revision = revision
            self._commands.rebirth.set()
        if self._commands.rebirth.is_set():
            self._commands.rebirth.clear()
            self._births += 1
            self._publish(session, self._node.births(answering, self._latest))
            self._is_born = True
        else:
            self._publish(session, self._node.device_births(answering, self._latest))
        return session

    def _connected(self) -> Session:
        """The session; a new one if there is none. Raises `OSError`."""
        if self._session is not None and (error := self._session.error) is not None:
            self._disconnect()
            raise ConnectionError(error)
        if self._session is None:
            assert self._stop is not None, "until comes first"
            self._node.begin()
            if self._primary is not None:
                self._primary.begin()
            self._session = Session(
                self._settings,
                self._client_id,
                self._node.death(),
                self._on_message,
                self._stop,
                qos=0,
                will_qos=1,
                writes=self._settings.writes,
                proves=True,
            )
            self._connects += 1
            self._session.subscribe([self._names.of("NCMD")], retained=False)
            if self._primary is not None:
                assert self._settings.primary_host is not None, "there is one"
                self._session.subscribe([state_topic(self._settings.primary_host)], retained=True)
                self._primary.wait(TIMEOUT)
        return self._session

    def _adopt(self, session: Session) -> None:
        """Takes over the tags: of a new session, and after a reload."""
        tags = self._site.tags()
        self._node.adopt(tags)
        if self._settings.writes:
            devices = [device for device, some in tags.items() if any(tag.writable for tag in some)]
            topics = [self._names.of("DCMD", device) for device in devices]
            session.subscribe(topics, retained=False)

    def _latest(self) -> dict[str, dict[str, Reading]]:
        """The last reading of each tag of each device."""
        found: dict[str, dict[str, Reading]] = {}
        for reading in self._site.latest():
            found.setdefault(reading.device, {})[reading.tag.name] = reading
        return found

    def _publish(self, session: Session, messages: Sequence[Message]) -> None:
        """Publishes messages, and waits until the broker must have them. Raises `OSError`."""
        if not messages:
            return
        delivery = session.publish(messages)
        try:
            session.wait(delivery)
        except OSError:
            self._disconnect()
            raise
        finally:
            self._tell_refused(delivery)

    def _disconnect(self) -> None:
        session, self._session = self._session, None
        self._is_born = False
        if session is not None:
            session.close([self._node.death()], with_will=True)

    def _tell_refused(self, delivery: Delivery) -> None:
        self._not_accepted += len(delivery.refused)
        for message, reason in delivery.refused[:1]:
            logs.refused(
                "output_not_accepted",
                kind=self._name,
                output=self._name,
                topic=message.topic[2:].decode(),
                reason=reason,
                count=len(delivery.refused),
            )

    def _on_message(self, message: Publish, is_retained: bool) -> None:
        """Takes a message of the broker. Called by the thread of the connection."""
        if message.topic == self._names.of("NCMD"):
            self._commands.take(message, None, is_retained=is_retained)
        elif (device := self._names.device_of(message.topic)) is not None:
            self._commands.take(message, device, is_retained=is_retained)
        elif self._primary is not None:
            try:
                self._primary.take(bytes(message.payload))
            except ValueError as error:
                logs.refused(
                    "output_state_ignored",
                    kind=self._name,
                    output=self._name,
                    topic=message.topic,
                    reason=str(error),
                )

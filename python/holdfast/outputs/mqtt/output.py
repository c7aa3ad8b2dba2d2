"""The receiver of an MQTT output: its connection, and what is published besides values."""

from __future__ import annotations

import threading
import time
from collections import deque
from math import inf
from typing import TYPE_CHECKING

from holdfast.config.values.mqtt_output_topics import DEFAULT_STATUS
from holdfast.outputs import sender
from holdfast.outputs.mqtt.availability import OFFLINE, ONLINE, Availability
from holdfast.outputs.mqtt.commands import Commands
from holdfast.outputs.mqtt.delivery import Message, packed_topic, unpacked_topic
from holdfast.outputs.mqtt.home_assistant import Discovery
from holdfast.outputs.mqtt.messages import Payloads
from holdfast.outputs.mqtt.receiver import BrokerReceiver
from holdfast.outputs.mqtt.session import Session
from holdfast.outputs.sender import Refused

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence, Set

    from holdfast.config.models.outputs import MqttOutputConfig
    from holdfast.net.mqtt.packets import Publish
    from holdfast.outputs.device_access import Site
    from holdfast.outputs.mqtt.delivery import Delivery
    from holdfast.polling import Reading
    from holdfast.runtime.stop import Stop
    from holdfast.tags import Tag


class MqttOutput(BrokerReceiver):
    """Publishes readings."""

    def __init__(self, name: str, settings: MqttOutputConfig, site: Site) -> None:
        self._topics = settings.topics
        status = self._topics.status
        super().__init__(name, settings, "" if status == DEFAULT_STATUS else status)
        self._settings, self._site = settings, site
        self._payloads = Payloads(settings)
        self._taken: list[Reading] = []
        self._messages: Sequence[Message] = ()
        self._standby: Set[str] = frozenset()
        """The devices whose readings are left out of the messages."""
        self._commands = Commands(name, self._broker, self._topics, site)
        self._tags: dict[str, set[str]] = {}
        self._removal: Delivery | None = None
        """Of topics that are gone, until the broker has confirmed it."""
        # Home Assistant looks at availability only after discovery, so it must be retained. A will
        # that is retained would keep a broker without retained messages from any connection.
        self._retains = settings.retain or settings.discovery is not None
        self._availability = Availability(self._topics, site, retain=self._retains)
        self._discovery = None if settings.discovery is None else Discovery(name, settings)
        self._entities: dict[str, bytes] = {}
        self._found: deque[str] = deque()
        self._discovery_requested = threading.Event()
        self._has_sent = True
        """Whether the broker has confirmed values since all were offered again."""
        self._refused: dict[bytes, str] = {}
        """The topics of new refusals of the broker, with its reasons."""
        self._lost: set[str] = set()
        """Those of availability, entities and removals, until these are repeated."""
        self._renewed_at = -inf

    def send(self, readings: list[Reading]) -> None:
        """Publishes readings, and waits until the broker has confirmed them.

        If it fails and is called with the same readings, it goes on where it was. Raises `Refused`
        for those that the broker did not accept.
        """
        session = self._connected()
        self._keep_up(session)
        standby = self._site.standby
        if readings is not self._taken or standby != self._standby:
            self._payloads.settle(sent=False)
            # What waited here is older than what the node that polls the device has published.
            own = [each for each in readings if each.device not in standby]
            self._taken, self._messages = readings, self._payloads.messages(own)
            self._standby = standby
        delivery = session.publish(self._messages)
        try:
            self._wait(session, delivery)
        except OSError:
            self._messages = self._messages[delivery.confirmed :]
            self._has_sent |= delivery.confirmed > 0
            raise
        self._has_sent = True
        self._payloads.settle(sent=True)
        self._taken, self._messages = [], ()
        self._publish_availability(session, answering=True)
        self._settle_refused([each for each in readings if each.device not in standby])

    def idle(self) -> bool:
        """Keeps the connection, and publishes what has changed besides values."""
        session = self._connected()
        self._keep_up(session)
        self._publish_availability(session, answering=True)
        self._settle_refused([])
        return True

    def close(self) -> None:
        """Publishes the last replies and that this output is offline, and ends the connection."""
        if self._session is not None and self._session.error is None:
            self._commands.end()
        self._disconnect(self._availability.of_output(OFFLINE))

    def status(self) -> dict[str, object]:
        """The broker and the connection."""
        return {**super().status(), "commands": self._commands.counts()}

    def _open(self, stop: Stop) -> Session:
        return Session(
            self._settings,
            self._client_id,
            self._availability.of_output(OFFLINE),
            self._on_message,
            self._on_refused,
            stop,
            qos=self._settings.qos,
            takes_commands=self._settings.writes,
        )

    def _greet(self, session: Session) -> None:
        """Publishes what a broker may have lost, or has never had."""
        self._availability.begin()
        self._revision = -1
        self._entities = {}
        self._removal, self._lost = None, set()
        # Some brokers end the connection of a program that may only publish.
        if self._settings.writes or self._discovery is not None:
            session.subscribe([self._topics.status], retained=False)
        # A broker that ends each connection at once must not fill the buffer with repetitions.
        if self._connects > 1 and self._has_sent:
            self._has_sent = False
            self._site.refresh()

    def _keep_up(self, session: Session) -> None:
        """Publishes what has to be known before values."""
        # In this order: the broker may have kept that a device answers from the run before. And
        # before entities, which may take long.
        self._publish_availability(session, answering=False)
        if online := self._availability.online():
            session.publish([online])
        self._forget_removed()
        revision = self._site.revision
        if revision != self._revision:
            self._revision = revision
            self._adopt(session, self._site.tags())
        if self._discovery is not None:
            if self._discovery_requested.is_set():
                self._discovery_requested.clear()
                self._publish(session, self._entities)
            self._remove_stale(session)
        self._repeat_lost(session)

    def _adopt(self, session: Session, tags: Mapping[str, Sequence[Tag]]) -> None:
        """Takes over the tags: of the first configuration, and after each reload."""
        if self._settings.writes:
            session.subscribe(self._commands.adopt(tags), retained=False)
        names = {device: {tag.name for tag in some} for device, some in tags.items()}
        if names != self._tags:
            # What waits for its confirmation may be of tags that are gone: it is made again.
            self._payloads.settle(sent=False)
            self._taken, self._messages = [], ()
            self._payloads.restrict_to(names)
        self._tags = names
        before = self._entities
        if self._discovery is not None:
            self._entities = self._discovery.entities(tags, self._site.devices())
        self._remove_gone(session)
        self._availability.forget_except(names.keys())
        if self._discovery is None:
            return
        if not before:
            session.subscribe([self._discovery.birth_topic], retained=False)
        changed = {
            topic: entity for topic, entity in self._entities.items() if before.get(topic) != entity
        }
        self._publish(session, changed)
        if not before:
            session.subscribe([self._discovery.filter], retained=True)

    def _remove_gone(self, session: Session) -> None:
        """Removes what this output, or the one before it, has published and does not publish any
        more. Another output may do so now: that topic stays.
        """
        # In this order, so that values of a tag end before its entity.
        wanted = dict.fromkeys([*self._topics_of(self._tags), *self._entities])
        for topic in wanted:
            self._site.retained[self._broker, topic] = self._name
        gone = {topic: b"" for topic in self._retained() if topic not in wanted}
        self._removal = self._publish(session, gone)

    def _retained(self) -> list[str]:
        """The topics that this output, or the one before it, has published and not removed."""
        own = self._broker, self._name
        known = [*self._site.retained.items()]  # A copy: other outputs change it at any time.
        return [topic for (at, topic), name in known if (at, name) == own]

    def _forget_removed(self) -> None:
        """Forgets topics once the broker has removed them. Those that it refused stay."""
        removal = self._removal
        if removal is None or not removal.is_done:
            return
        self._removal = None
        for message in removal.messages:
            topic = unpacked_topic(message.topic)
            if message.topic in self._refused or topic in self._lost:
                continue
            if self._site.retained.get((self._broker, topic)) == self._name:
                del self._site.retained[self._broker, topic]

    def _repeat_lost(self, session: Session) -> None:
        """Publishes again what the broker has refused, and nothing else: it may be refused again.

        Removals under way come first: which of them it refuses is known once they are done.
        """
        if not self._lost or self._removal is not None:
            return
        if (now := time.monotonic()) < self._renewed_at + sender.RENEWAL_INTERVAL_S:
            return
        lost, self._lost, self._renewed_at = self._lost, set(), now
        self._availability.forget(lost)
        self._publish(session, {key: each for key, each in self._entities.items() if key in lost})
        self._remove_gone(session)

    def _on_refused(self, message: Message, reason: str) -> None:
        super()._on_refused(message, reason)
        self._refused[message.topic] = reason

    def _settle_refused(self, readings: Sequence[Reading]) -> None:
        """Raises `Refused` for readings that the broker did not accept.

        Notes what else it refused, but replies to commands: they are not repeated.
        """
        refused: dict[bytes, str] = {}
        while self._refused:  # Filled by the thread of the connection.
            topic, reason = self._refused.popitem()
            refused[topic] = reason
        if not refused:
            return
        names = self._topics
        own = {names.status, *map(names.of_availability, self._tags), *self._retained()}
        self._lost |= own.intersection(map(unpacked_topic, refused))
        lost = [each for each in readings if self._payloads.topic(each) in refused]
        if lost:
            topic = self._payloads.topic(lost[0])
            raise Refused(f"{unpacked_topic(topic)}: {refused[topic]}", lost)

    def _topics_of(self, tags: Mapping[str, set[str]]) -> set[str]:
        """The retained topics of the output, its devices and tags."""
        names = self._topics
        found: set[str] = set()
        if self._retains:
            found = {names.status, *map(names.of_availability, tags)}
        if not self._settings.retain:
            return found
        return found.union(*(names.of_values(device, some) for device, some in tags.items()))

    def _remove_stale(self, session: Session) -> None:
        """Removes entities of an earlier configuration, which the broker has kept."""
        if not self._found or self._removal is not None:
            return
        while self._found:
            self._site.retained[self._broker, self._found.popleft()] = self._name
        self._remove_gone(session)

    @staticmethod
    def _publish(session: Session, retained: Mapping[str, bytes]) -> Delivery | None:
        if not retained:
            return None
        messages = retained.items()
        return session.publish([Message(packed_topic(key), text, True) for key, text in messages])

    def _disconnect(self, *last: Message) -> None:
        """Ends the session, if there is one. Without a last message, the broker sends the will."""
        session, self._session = self._session, None
        if session is not None:
            session.close(last)

    def _publish_availability(self, session: Session, *, answering: bool) -> None:
        if changed := self._availability.changed(answering=answering):
            session.publish(changed)

    def _on_message(self, message: Publish) -> None:
        """Takes a message of the broker. Called by the thread of the connection."""
        session = self._session
        if message.topic == self._topics.status and not message.is_retained:
            self._availability.heard(message.payload)
            return
        if session is None or self._commands.take(message, session):
            return
        if self._discovery is None:
            return
        if message.topic == self._discovery.birth_topic:
            if message.payload == ONLINE and not message.is_retained:
                self._discovery_requested.set()
        elif message.is_retained and message.payload and self._discovery.owns(message.topic):
            self._found.append(message.topic)

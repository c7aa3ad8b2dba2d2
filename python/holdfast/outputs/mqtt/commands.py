"""Commands: messages to the set topics of tags, and the replies to them."""

from __future__ import annotations

import threading
from functools import partial
from typing import TYPE_CHECKING

import msgspec
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from holdfast.config.values.mqtt_output_topics import REPLY
from holdfast.outputs.device_access import CommandOutcomes, NotWritten
from holdfast.outputs.mqtt.connection import MAX_PAYLOAD_BYTES
from holdfast.outputs.mqtt.delivery import NO_PROPERTIES, Message, packed_topic
from holdfast.polling.faults import STANDBY, fault_word

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from holdfast.config.values.mqtt_output_topics import TopicNames
    from holdfast.net.mqtt.packets import Publish
    from holdfast.outputs.device_access import Site
    from holdfast.outputs.mqtt.delivery import Delivery
    from holdfast.outputs.mqtt.session import Session
    from holdfast.tags import Tag

MAX_REPLIES = 1000
"""The most replies that the broker has not confirmed; more are dropped and counted."""

END_TIMEOUT_S = 2.5
"""How long an output waits for its last outcomes. After a stop, all are known before."""


class Commands(CommandOutcomes):
    """The set topics of writable tags. A stale command must never be carried out.

    Retained and late messages are ignored. The broker keeps no session, so one that is delivered
    again was delivered over this connection before.
    """

    def __init__(self, output: str, broker: str, names: TopicNames, site: Site) -> None:
        super().__init__(output)
        self._broker, self._names, self._site = broker, names, site
        self._tags: dict[str, tuple[str, str]] = {}
        self._replies: list[Delivery] = []
        self.replies_dropped = 0
        self._waiting = 0
        """Writes whose outcome is not known yet."""
        self._changed = threading.Condition(self._lock)

    def counts(self) -> dict[str, int]:
        """The outcomes of commands, and the replies that could not be sent."""
        return {
            "written": self.written,
            "refused": self.refused,
            "ignored": self.ignored,
            "replies_dropped": self.replies_dropped,
        }

    def adopt(self, tags: Mapping[str, Sequence[Tag]]) -> list[str]:
        """Takes over the tags. Returns the topics to subscribe to."""
        self._tags = {
            self._names.of_commands(device, tag.name): (device, tag.name)
            for device, some in tags.items()
            for tag in some
            if tag.writable
        }
        return list(self._tags)

    def take(self, message: Publish, session: Session) -> bool:
        """Carries out a message, if its topic is one of a writable tag.

        A command for a device that another node polls is left to that node, without a reply.
        """
        found = self._tags.get(message.topic)
        if found is None:
            return False
        if message.staleness is not None:
            self.ignore(message.topic, message.staleness)
        elif message.payload and found[0] not in self._site.standby:
            self._write(message, session, *found)
        return True

    def end(self) -> None:
        """Waits for the outcomes of all commands, so that their replies are published."""
        with self._changed:
            self._changed.wait_for(lambda: not self._waiting, END_TIMEOUT_S)

    def _write(self, message: Publish, session: Session, device: str, tag: str) -> None:
        done = partial(self._done, message, session, device, tag)
        with self._changed:
            self._waiting += 1
        try:
            if message.size > MAX_PAYLOAD_BYTES:
                detail = f"{message.size} bytes, allowed: {MAX_PAYLOAD_BYTES}"
                raise NotWritten("too_large", detail)
            try:
                text = bytes(message.payload).decode()
            except UnicodeDecodeError:
                raise NotWritten("invalid_value", "the payload is not UTF-8") from None
            if message.problem is not None:
                raise NotWritten("malformed", message.problem)
            peer = f"{self._broker} {message.topic}"
            self._site.write(device, tag, text, peer, done)
        except NotWritten as refused:
            done(refused)

    def _done(
        self,
        message: Publish,
        session: Session,
        device: str,
        tag: str,
        refused: NotWritten | None,
    ) -> None:
        """Notes an outcome, and replies. Called by any thread."""
        # The lease may just have gone to another node, which replies.
        is_ours = refused is None or refused.reason != fault_word(STANDBY)
        answer = None
        if is_ours:
            self.ended(device, tag, refused)
            reply = {"status": "accepted", "device": device, "tag": tag}
            if refused is not None:
                reply |= {"status": "rejected", "reason": refused.reason, "detail": refused.detail}
            answer = self._answer(message, msgspec.json.encode(reply))
        with self._changed:
            self._waiting -= 1
            self._changed.notify_all()
            if not is_ours:
                return
            self._replies = [each for each in self._replies if not each.is_done]
            if answer is None or len(self._replies) >= MAX_REPLIES or session.error is not None:
                self.replies_dropped += 1
                return
            self._replies.append(session.publish([answer]))

    def _answer(self, message: Publish, payload: bytes) -> Message | None:
        """The reply: to the response topic of MQTT 5, or beside the command."""
        if message.response_topic is None:
            return Message(packed_topic(f"{message.topic}/{REPLY}"), payload)
        topic, properties = message.answer_topic, NO_PROPERTIES
        if topic is None or topic in self._tags:
            return None
        if message.correlation is not None:
            packed = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            packed.CorrelationData = message.correlation
            properties = packed.pack()  # type: ignore[no-untyped-call]
        return Message(packed_topic(topic), payload, properties=properties)

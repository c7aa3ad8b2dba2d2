"""Commands over MQTT. There is no reply unless it is asked for, and it can be lost."""

from __future__ import annotations

import json
import math
import queue
from typing import TYPE_CHECKING, Any

from oracle.faces import commands
from oracle.history import Operation, Outcome, now
from oracle.requests import Surprise, is_passed
from support import wire
from support.mqtt_rig import Probe

if TYPE_CHECKING:
    from oracle.history import Recorder
    from oracle.requests import Request

NAME = "mqtt"
TOPIC = "oracle/ingest"
QOS = 2
"""With QoS 2, a message is written once even if the connection of the appliance is cut."""

ANSWER_S = 3.0
"""A reply is not waited for longer: it is dropped if the connection to the broker ends."""


class MqttFace:
    """A publisher. Messages of one publisher are written in their order, so the reply to one of
    them shows that all earlier ones have been written.
    """

    name = NAME

    def __init__(self, port: int, number: int, recorder: Recorder) -> None:
        self._probe = Probe(port)
        self._answers = f"oracle/answers/{number}"
        self._recorder = recorder
        self._number = 0
        self._waiting: list[tuple[Request, int]] = []
        """Messages without a reply, and when they were published."""
        self._probe.subscribe(self._answers)

    def publish(self, request: Request, *, wants_answer: bool) -> None:
        """Publishes a command; waits for its reply if it is wanted."""
        begin = now()
        answer = None
        if wants_answer:
            answer = self._ask(request, ANSWER_S)
        else:
            self._probe.publish(TOPIC, _body(request), QOS)
        end = now()
        if answer is None:
            self._waiting.append((request, begin))
            return
        self._settle(end)
        if answer["status"] == "accepted":
            outcome = Outcome.DONE
        elif is_passed([write.block for write in request.writes]):
            outcome = Outcome.REFUSED if answer["reason"] == "mirrored" else Outcome.UNKNOWN
        else:
            raise Surprise(f"{answer} to {request}")
        self._record(request, begin, math.inf if outcome is Outcome.UNKNOWN else end, outcome)

    def finish(self, request: Request) -> None:
        """Publishes until a reply comes: then all earlier messages have been written."""
        begin = now()
        wire.until(lambda: self._ask(request, ANSWER_S), "MQTT messages are written")
        end = now()
        self._settle(end)
        self._record(request, begin, end, Outcome.DONE)

    def close(self) -> None:
        self._probe.__exit__(None, None, None)

    def _ask(self, request: Request, seconds: float) -> dict[str, Any] | None:
        self._number += 1
        number = str(self._number).encode()
        properties: dict[str, Any] = {"ResponseTopic": self._answers, "CorrelationData": number}
        self._probe.publish(TOPIC, _body(request), QOS, **properties)
        while True:
            try:
                message = self._probe.messages.get(timeout=seconds)
            except queue.Empty:
                return None
            if getattr(message.properties, "CorrelationData", None) == number:
                answer: dict[str, Any] = json.loads(message.payload)
                return answer

    def _settle(self, end: int) -> None:
        for request, begin in self._waiting:
            if is_passed([write.block for write in request.writes]):
                # The device may have refused it.
                self._record(request, begin, math.inf, Outcome.UNKNOWN)
            else:
                self._record(request, begin, end, Outcome.DONE)
        self._waiting.clear()

    def _record(self, request: Request, begin: int, end: float, outcome: Outcome) -> None:
        self._recorder.add(Operation(NAME, "publish", begin, end, outcome, request.writes))


def _body(request: Request) -> str:
    asked = commands(request)
    return json.dumps(asked[0] if len(asked) == 1 else asked)

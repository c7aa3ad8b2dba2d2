"""Clients: each has a face, a thread, and one request after another, all of which are recorded."""

from __future__ import annotations

import itertools
import math
import threading
from typing import TYPE_CHECKING, NamedTuple, Protocol

from oracle.history import Operation, Outcome, Reading, now
from oracle.mqtt_face import MqttFace
from oracle.requests import Lost, Reply, Request, Surprise
from support import wire

if TYPE_CHECKING:
    import random

    from oracle.faces import Face
    from oracle.history import Recorder
    from oracle.workload import Draws


PACE_S = 0.003
"""Between two requests of an endless client, which would be too fast for the others."""


class Source(Protocol):
    """Where the requests of a client come from."""

    def draw(self) -> Request:
        """The next one."""


class Cuts(NamedTuple):
    """How often a client hangs up, of 1000 requests: within the request, or behind it."""

    within: int = 15
    behind: int = 15


CUTS = Cuts()


class Client(threading.Thread):
    """Sends a number of requests, or sends them `until` an event. The recorder has what happens."""

    def __init__(
        self,
        face: Face,
        source: Source,
        recorder: Recorder,
        count: int,
        chance: random.Random,
        cuts: Cuts | None = None,
        until: threading.Event | None = None,
    ) -> None:
        super().__init__(name=f"oracle {face.name}")
        self.face = face
        self._source = source
        self._recorder = recorder
        self._count = count
        self._chance = chance
        self._cuts = cuts if face.can_cut else None
        self._until = until
        self.is_endless = until is not None
        self._is_connected = False
        self.failure: BaseException | None = None

    def _is_over(self, number: int) -> bool:
        if self._until is None:
            return number >= self._count
        return self._until.wait(PACE_S)

    def run(self) -> None:
        try:
            for number in itertools.count():
                if self._is_over(number):
                    return
                request = self._source.draw()
                if self._cuts is not None and request.writes and self._cut(request, self._cuts):
                    continue
                self.ask(request)
        except BaseException as error:
            self.failure = error
        finally:
            self.face.close()

    def ask(self, request: Request) -> Reply | None:
        """Carries out a request; `None` if the reply was lost or is wrong."""
        self._connect()
        begin = now()
        try:
            reply = self.face.carry_out(request)
        except (Lost, Surprise) as error:
            if isinstance(error, Surprise):
                self._recorder.surprise(f"{self.face.name}: {error}")
            self._record(request, begin, Reply(Outcome.UNKNOWN))
            self.disconnect()
            return None
        self._record(request, begin, reply)
        return reply

    def _record(self, request: Request, begin: int, reply: Reply) -> None:
        is_unknown = reply.outcome is Outcome.UNKNOWN
        if is_unknown and not request.writes:
            return
        readings = zip(request.reads, reply.values, strict=True) if reply.values else ()
        name = " and ".join(["write"] * bool(request.writes) + ["read"] * bool(request.reads))
        self._recorder.add(
            Operation(
                self.face.name,
                name,
                begin,
                math.inf if is_unknown else now(),
                reply.outcome,
                request.writes,
                tuple(Reading(*each) for each in readings),
                reply.is_open,
            )
        )

    def _cut(self, request: Request, cuts: Cuts) -> bool:
        """Sends a write, or a part of it, and hangs up: sometimes."""
        dice = self._chance.randrange(1000)
        if dice >= cuts.within + cuts.behind:
            return False
        is_whole = dice < cuts.behind
        self._connect()
        begin = now()
        self.face.send_only(request, 1 if is_whole else self._chance.random())
        self._is_connected = False
        # A part of a request must never take effect.
        outcome = Outcome.UNKNOWN if is_whole else Outcome.REFUSED
        end = math.inf if is_whole else now()
        name = "cut behind" if is_whole else "cut within"
        self._recorder.add(Operation(self.face.name, name, begin, end, outcome, request.writes))
        return True

    def _connect(self) -> None:
        """Connects, if there is no connection. A listener may be away for a while."""
        if not self._is_connected:
            wire.until(self._is_answered, f"{self.face.name} is served")
            self._is_connected = True

    def _is_answered(self) -> bool:
        try:
            self.face.connect()
        except OSError:
            self.face.close()
            return False
        return True

    def disconnect(self) -> None:
        """Ends the connection; the next request opens another one."""
        self.face.close()
        self._is_connected = False


class Publisher(threading.Thread):
    """Publishes commands over MQTT, and waits for about half of the replies."""

    is_endless = False

    def __init__(
        self,
        face: MqttFace,
        source: Draws,
        recorder: Recorder,
        count: int,
        chance: random.Random,
    ) -> None:
        super().__init__(name="oracle mqtt")
        self.face = face
        self._source = source
        self._recorder = recorder
        self._count = count
        self._chance = chance
        self.failure: BaseException | None = None

    def run(self) -> None:
        try:
            for _ in range(self._count):
                try:
                    wants_answer = self._chance.random() < 0.5
                    self.face.publish(self._source.draw(), wants_answer=wants_answer)
                except Surprise as error:
                    self._recorder.surprise(f"mqtt: {error}")
            self.face.finish(self._source.write_own())
        except BaseException as error:
            self.failure = error

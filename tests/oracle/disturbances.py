"""What happens to the appliance meanwhile: one thing after another, in the order of a seed."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from oracle.history import Write
from oracle.plant import GATE, MAX_REGISTERS, NAMED, PARTS
from oracle.requests import Request
from oracle.workload import TWIN
from support import wire

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

    from oracle.clients import Client
    from oracle.history import Ids, Recorder
    from oracle.plant import Plant, Settings
    from support.tcp_proxy import Proxy

GUEST = "guest"
"""The listener that comes and goes."""

MAY_END = ("ascii", "secure", "checked", GUEST)
"""Listeners whose connections are ended. The others have the owners of blocks, whose writes must
have a known outcome."""

MEANWHILE = 60
"""Operations that go on while a memory is sealed, or a device is away."""


class Gate:
    """Opens and closes the memory by other ways than Modbus, and may write at the same moment."""

    def __init__(self, ways: list[Client], ids: Ids, chance: random.Random, count: int) -> None:
        self._ways = ways
        self._ids = ids
        self._chance = chance
        self.count = count
        """How often it was turned. It is open if that is odd."""

    def turn(self) -> None:
        self.count += 1
        writes = [Write(GATE, self.count)]
        if self._chance.random() < 0.5:
            # One packet can have both: they are in one area.
            block = NAMED["d32"]
            writes.append(Write(block, self._ids.draw(block)))
        way = self._chance.choice(self._ways)
        reply = way.ask(Request(tuple(writes)))
        # REST may start again until the next turn, which ends its connections.
        way.disconnect()
        assert reply is not None, "the gate was not written"

    def open(self) -> None:
        if self.count % 2 == 0:
            self.turn()


class Disturbances(threading.Thread):
    """Does each of them once, at even distances within a number of operations, and then again."""

    def __init__(
        self,
        plant: Plant,
        gate: Gate,
        proxy: Proxy,
        ids: Ids,
        recorder: Recorder,
        chance: random.Random,
        every: int,
    ) -> None:
        super().__init__(name="oracle disturbances")
        self._plant = plant
        self._gate = gate
        self._proxy = proxy
        self._ids = ids
        self._recorder = recorder
        self._chance = chance
        self._every = every
        self._over = threading.Event()
        self.done: list[str] = []
        self.failure: BaseException | None = None

    def run(self) -> None:
        try:
            while True:
                kinds = list(self._kinds())
                self._chance.shuffle(kinds)
                for kind in kinds:
                    if not self._wait(self._every):
                        return
                    self.done.append(kind.__name__.strip("_"))
                    kind()
        except BaseException as error:
            self.failure = error

    def finish(self) -> None:
        """Ends after the disturbance that is under way."""
        self._over.set()
        self.join()

    def bring_guest(self) -> None:
        """Lets the clients of the guest go on."""

        def edit(settings: Settings) -> None:
            if GUEST not in settings["listeners"]:
                settings["listeners"][GUEST] = self._plant.listener("modbus-tcp")

        self._plant.change(edit)

    def _kinds(self) -> list[Callable[[], None]]:
        return [
            self._seal,
            self._seal,
            self._guest,
            self._guest,
            self._guest,
            self._rights,
            self._schedule,
            self._refusing,
            self._rest,
            self._mqtt,
            self._broker,
            self._session,
            self._session,
            self._away,
        ]

    def _wait(self, operations: int) -> bool:
        """Waits for that many operations; the device changes meanwhile. False at the end."""
        start = len(self._recorder.operations)

        def goes_on() -> bool:
            at = self._chance.randrange(len(PARTS))
            block = TWIN[PARTS[at].device]
            self._plant.device.change(at, self._ids.draw(block))
            return self._over.is_set() or len(self._recorder.operations) >= start + operations

        wire.until(goes_on, f"{operations} operations")
        return not self._over.is_set()

    def _seal(self) -> None:
        self._gate.turn()
        self._wait(MEANWHILE)
        self._gate.turn()

    def _guest(self) -> None:
        """A listener comes, moves to another port, or goes."""
        goes = self._chance.random() < 0.5

        def edit(settings: Settings) -> None:
            there = settings["listeners"].pop(GUEST, None)
            if there is None or not goes:
                settings["listeners"][GUEST] = self._plant.listener("modbus-tcp")

        self._plant.change(edit)

    def _rights(self) -> None:
        """Rules and timeouts change, which open connections survive."""
        seconds = self._chance.randrange(100, 1000)

        def edit(settings: Settings) -> None:
            for name in ("scada", "rtu", "secure"):
                settings["listeners"][name]["idle_timeout"] = seconds
            rules = settings["listeners"]["scada"]["rules"]
            other = {"sources": ["10.9.8.7"], "units": {1: "plant"}, "access": "read-only"}
            settings["listeners"]["scada"]["rules"] = [rules[0], other][: 3 - len(rules)]

        self._plant.change(edit)

    def _schedule(self) -> None:
        """The device is polled in another way."""
        change = {
            "interval": self._chance.choice([0.01, 0.02, 0.03]),
            "timeout": self._chance.choice([0.2, 0.25]),
            "max_registers": self._chance.choice(MAX_REGISTERS),
            "emulate": self._chance.random() < 0.5,
        }
        self._plant.change(lambda settings: settings["devices"]["drive"].update(change))

    def _refusing(self) -> None:
        """Writes into the mirror are refused for a while."""
        self._plant.change(lambda settings: settings["devices"]["drive"].update(writes="refuse"))
        self._wait(MEANWHILE)
        self._plant.change(lambda settings: settings["devices"]["drive"].update(writes="pass"))

    def _rest(self) -> None:
        """REST starts again."""
        size = self._chance.randrange(1_000_000, 2_000_000)
        self._plant.change(lambda settings: settings["rest"].update(max_body=size))

    def _mqtt(self) -> None:
        """The MQTT client starts again."""
        seconds = self._chance.randrange(30, 60)
        self._plant.change(lambda settings: settings["mqtt"].update(keep_alive=seconds))

    def _broker(self) -> None:
        """The connection to the broker is cut."""
        self._proxy.cut()

    def _session(self) -> None:
        """A connection is ended."""
        found = [each for each in self._plant.sessions() if each["listener"] in MAY_END]
        if found:
            session = self._chance.choice(found)
            self._plant.end_session(session["listener"], session["id"])

    def _away(self) -> None:
        """The device goes away, and comes back."""
        self._plant.device.stop()
        self._wait(MEANWHILE)
        wire.until(self._is_back, "the port of the device is free")

    def _is_back(self) -> bool:
        try:
            self._plant.device.start()
        except OSError:
            return False
        return True

"""The appliance: memories and listeners built from a configuration, started, logged and stopped.

It wires parts that know their work. It parses no protocol, and once started it takes no part in
answering a request.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from holdfast import _core, logs
from holdfast.identity import Identity

if TYPE_CHECKING:
    from holdfast.config import (
        Config,
        IdentityConfig,
        MemoryConfig,
        ModbusTcpListener,
        RuleConfig,
    )

# Everything else that a listener reports is a refusal or a fault.
ORDINARY = {"opened", "closed", "idle"}


@dataclass(frozen=True)
class Endpoint:
    """Where a listener of the configuration listens."""

    name: str
    host: str
    port: int
    settings: ModbusTcpListener


class Appliance:
    """One configuration, running from `start` (or `with`) to `stop`.

    Raises `OSError` from `start` when a listener can't be bound; nothing is left running then.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.memories = {name: _memory(entry) for name, entry in config.memories.items()}
        self._engine: _core.Engine | None = None
        self._throttle = logs.Throttle()
        self._lost = 0

    def start(self) -> Self:
        """Binds all listeners and serves. Raises `RuntimeError` when it runs already."""
        if self._engine is not None:
            raise RuntimeError("the appliance runs already")
        config = self.config
        identity = _identity(config.identity)
        verbose = config.log.level == "debug"
        self._engine = _core.Engine(
            [self._listener(name, entry) for name, entry in config.listeners.items()],
            identity=identity.objects(),
            unit_names=identity.names(),
            workers=config.workers,
            events="all" if verbose else "refusals",
        )
        for endpoint in self.endpoints():
            address = f"{endpoint.host}:{endpoint.port}"
            logs.write(logging.INFO, "listening", listener=endpoint.name, address=address)
        return self

    def stop(self) -> None:
        """Answers what was received and ends, within a second."""
        engine, self._engine = self._engine, None
        if engine is not None:
            engine.stop()
            logs.write(logging.INFO, "stopped")

    def endpoints(self) -> list[Endpoint]:
        """Where each listener listens, in the order of the configuration."""
        listeners = self.config.listeners.items()
        addresses = self._running().addresses
        return [
            Endpoint(name, host, port, settings)
            for (name, settings), (host, port) in zip(listeners, addresses, strict=True)
        ]

    def log_events(self, timeout: float) -> None:
        """Waits up to `timeout` seconds for an event, and logs it."""
        engine = self._running()
        event = engine.next_event(timeout)
        if event is not None:
            self._log_event(*event)
        lost, self._lost = engine.lost_events - self._lost, engine.lost_events
        if lost:
            logs.write(logging.WARNING, "events_lost", count=lost)

    def _log_event(self, listener: str, kind: str, peer: str | None) -> None:
        level = logging.DEBUG if kind in ORDINARY else logging.WARNING
        admitted, held_back = self._throttle.admit((listener, kind), time.monotonic())
        if admitted or level == logging.DEBUG:
            fields = {"held_back": held_back} if held_back else {}
            logs.write(level, kind, listener=listener, peer=peer or "-", **fields)

    def _listener(self, name: str, settings: ModbusTcpListener) -> _core.Listener:
        return _core.Listener(
            name,
            str(settings.bind),
            [self._rule(rule) for rule in settings.rules],
            max_connections=settings.max_connections,
            max_connections_per_source=settings.max_connections_per_source,
            when_full=settings.when_full,
            idle_timeout=settings.idle_timeout,
            request_timeout=settings.request_timeout,
        )

    def _rule(self, rule: RuleConfig) -> _core.Rule:
        return _core.Rule(
            {unit: self.memories[name] for unit, name in rule.units.items()},
            sources=[str(source) for source in rule.sources],
            access=rule.access,
            functions=rule.functions,
            deny=rule.deny,
        )

    def _running(self) -> _core.Engine:
        if self._engine is None:
            raise RuntimeError("the appliance does not run")
        return self._engine

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()


def _memory(settings: MemoryConfig) -> _core.Memory:
    """The memory that a configuration describes, with its initial values."""
    seal = settings.seal
    memory = _core.Memory(
        **{area: (span.start, span.size) for area, span in settings.areas().items()},
        seal=None if seal is None else (seal.area, seal.address, seal.mode),
    )
    writes = [(run.area, run.address, run.values) for run in settings.initial_values]
    if writes:
        memory.write_many(writes)
    return memory


def _identity(settings: IdentityConfig) -> Identity:
    return Identity(
        vendor_name=settings.vendor_name,
        product_code=settings.product_code,
        revision=settings.revision,
        vendor_url=settings.vendor_url or "",
        product_name=settings.product_name or "",
        model_name=settings.model_name or "",
        user_application_name=settings.user_application_name or "",
        unit_names=settings.unit_names,
        private_objects=settings.objects,
    )

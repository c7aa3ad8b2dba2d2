"""The interface of a part of a running appliance.

The appliance walks its list of parts forwards to start, to reload and to request the stop, and
backwards to close. An order that matters is a place in the list, a step of its own here, or a rank
at the end.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from holdfast.appliance.parts.native_links import Links

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from holdfast._core import Memory, MirrorAge
    from holdfast.appliance.parts.mirror_place import Place
    from holdfast.config import Config
    from holdfast.types import ThreadHeartbeat


@dataclass
class Plan:
    """A configuration that is to be served. Parts add what later parts of the list need."""

    config: Config
    changed: Collection[str]
    """The keys of the configuration whose settings or files differ from those in use."""
    memories: dict[str, Memory]
    """The memories in use, and those that the configuration adds."""
    undo: ExitStack
    """Frees what was opened, if this part or a later one raises."""
    retries_ports: bool = False
    """Whether a port of HTTP that is in use is no error: it is bound later."""
    links: Links = field(default_factory=Links)
    ages: Mapping[Place, MirrorAge] = field(default_factory=dict)
    """The ages of the ranges that devices are read into."""


class Part:
    """A part of an appliance. A method that a part does not need does nothing.

    The constructor reads and checks settings and files, and opens nothing: what is wrong there is
    reported before anything is opened.
    """

    closing_rank = 0
    """Parts with a higher rank are closed after all with a lower one, those of one rank backwards.
    For parts that must outlive others that were opened after them."""

    def __init__(self, config: Config) -> None:
        self.config = config
        """The configuration in use."""
        self.closing = ExitStack()
        """What `close` ends, in reverse order."""

    def open(self, plan: Plan) -> None:
        """Opens what must be there before the next part opens: by default, as a reload does.

        If this part or a later one raises, `close` ends what was opened, and nothing is served.
        """
        self.prepare(plan)()

    def start(self) -> None:
        """Begins to work. Nothing may fail any more, because clients may be served already."""

    def prepare(self, plan: Plan) -> Callable[[], None]:  # noqa: ARG002
        """Opens what a reload needs, and returns what takes it over.

        It may raise, and changes nothing before all parts are prepared: a reload is refused as a
        whole. What it returns may not fail. `config` is the new configuration then.
        """
        return _unchanged

    def stop(self) -> None:
        """Requests the stop and returns at once, so that parts stop at the same time."""

    def close(self) -> None:
        """Waits for the end of what was started, and frees what was opened."""
        self.closing.close()

    def tick(self) -> None:
        """Called about once a second: logs changes and does periodic work."""

    def heartbeats(self) -> Sequence[ThreadHeartbeat]:
        """The heartbeats of the threads of this part. Thread-safe."""
        return ()

    def stats(self) -> Mapping[str, Any]:
        """Counters and states for diagnostics, by their keys there. Thread-safe.

        The mappings of all parts are merged into one: no two may have the same key.
        """
        return {}


def _unchanged() -> None:
    """A reload does not concern the part."""

"""Imports configurations of the Modbus Memory Appliance, of both generations.

The first has `memory`, `routing` and `ports`, the second nests memories in `listeners`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.importing.imported import Generation, Imported, Source
from holdfast.importing.key_reader import Section
from holdfast.importing.mma.adapters import Adapters
from holdfast.importing.mma.address_filters import read_filter
from holdfast.importing.mma.draft import Draft
from holdfast.importing.mma.first_generation import FirstGeneration
from holdfast.importing.mma.listen_addresses import Binds
from holdfast.importing.mma.second_generation import TOP_REASONS, SecondGeneration
from holdfast.importing.notes import Choices

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from holdfast.importing.notes import Desk
    from holdfast.types import Area

_FIRST = ("memory", "routing", "ports")
_SECOND = "listeners"


def read_mma(
    path: Path | str,
    *,
    as_meant: bool = False,
    keep_published_tokens: bool = False,
    grant_rest: Sequence[Area] = (),
    grant_mqtt: Sequence[Area] = (),
) -> Imported:
    """Converts a configuration of either generation.

    The appliance ignored some keys. By default, the result behaves as the appliance did; with
    `as_meant`, these keys take effect as documented. Tokens that the documentation of the appliance
    publishes are left out, unless `keep_published_tokens` is set. REST and MQTT may write the areas
    that they could write, and those of `grant_rest` and `grant_mqtt`.

    Raises `ConfigError` with every problem that prevents the import.
    """
    source = Source(path)
    desk, draft = source.desk, Draft()
    generation = _generation(desk) if source.is_mapping() else None
    if generation is not None:
        choices = Choices(as_meant, keep_published_tokens, grant_rest, grant_mqtt)
        _read(desk, draft, generation, choices)
        if not (draft.listeners or draft.rest or draft.mqtt or desk.report.problems):
            desk.problem((), "nothing to serve, allowed: at least one listener, REST or MQTT")
    source.finish()
    program = "the Modbus Memory Appliance"
    return Imported(source.file, "mma", program, draft.data(), desk.notes, generation)


def _generation(desk: Desk) -> Generation | None:
    data = desk.document.data
    if _SECOND in data:
        return 2
    if any(key in data for key in _FIRST):
        return 1
    if "replicator" in data:
        desk.problem(("replicator",), "for the units in this file, use: holdfast import replicator")
        return None
    message = (
        "not a configuration of the Modbus Memory Appliance: found none of memory, routing and "
        "ports (first generation), or listeners (second)"
    )
    desk.problem((), message)
    return None


def _read(desk: Desk, draft: Draft, generation: Generation, choices: Choices) -> None:
    root = Section(desk, (), desk.document.data)
    admitted = read_filter(root)
    if admitted is not None:
        ran, meant = "it had no effect", "only the addresses that it allows have access"
        choices.note(desk, root.at("ip_filter"), ran=ran, meant=meant)
        admitted = admitted if choices.as_meant else None
    binds = Binds(desk, choices)
    if generation == 1:
        FirstGeneration(desk, draft, binds, admitted, choices).read(root)
    else:
        SecondGeneration(desk, draft, binds, admitted, choices).read(root)
    Adapters(desk, draft, binds, admitted, choices).read(root)
    root.close(TOP_REASONS if generation == 2 else None)

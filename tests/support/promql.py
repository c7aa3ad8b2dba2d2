"""The names in queries of Prometheus: metrics, labels, and values that the program decides."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    Labels = Mapping[str, Mapping[str, set[str]]]
    """By the name of a metric and of a label: the values that occur."""

OF_PROMETHEUS = {"instance", "job"}
"""Labels that Prometheus adds to all metrics."""

DECIDED = {"check", "counter", "field", "limit", "outcome", "reason", "state"}
"""Labels whose values are words of the program, and not names of a configuration."""

METRIC = re.compile(r"\b((?:holdfast|process|python)_\w+|up\b)(?:\{([^}]*)\})?")
MATCHER = re.compile(r'(\w+)\s*(=~|!~|!=|=)\s*"([^"]*)"')
GROUPING = re.compile(r"\b(?:by|without|on|ignoring|group_left|group_right)\s*\(([^)]*)\)")


def names(query: str) -> set[str]:
    """The metrics of a query."""
    return {name for name, _ in METRIC.findall(query)}


def labels(query: str, metrics: Labels) -> set[str]:
    """The labels that the result of a query can have."""
    of_metrics = {label for name in names(query) for label in metrics.get(name, ())}
    return of_metrics | OF_PROMETHEUS


def problems(query: str, metrics: Labels) -> Iterator[str]:
    """What a query names that these metrics do not have."""
    if not names(query):
        yield f"no metric in {query}"
    for name, matchers in METRIC.findall(query):
        if name != "up" and name not in metrics:
            yield f"no metric {name}"
            continue
        for label, operator, text in MATCHER.findall(matchers):
            known = metrics.get(name, {})
            if label not in known and label not in OF_PROMETHEUS:
                yield f"{name} has no label {label}"
            elif label in DECIDED and "$" not in text:
                values = text.split("|") if "~" in operator else [text]
                unknown = [value for value in values if value not in known[label]]
                yield from (f"{name} has no {label}={value}" for value in unknown)
    for grouping in GROUPING.findall(query):
        for label in filter(None, map(str.strip, grouping.split(","))):
            if label not in labels(query, metrics):
                yield f"no metric of {query} has the label {label}"

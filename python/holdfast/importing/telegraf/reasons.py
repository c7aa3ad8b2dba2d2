"""Why settings of several tables are left out."""

from __future__ import annotations

FILTERS = dict.fromkeys(
    (
        *("fielddrop", "fieldexclude", "fieldinclude", "fieldpass", "drop", "pass"),
        *("namedrop", "namepass", "tagdrop", "tagexclude", "taginclude", "tagpass", "metricpass"),
    ),
    "nothing is filtered: all tags are published",
)
"""Keys that filter metrics."""

LOGGED = "see log"
NO_COUNTERPART = "there is no such setting"

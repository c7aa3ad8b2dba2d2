"""The former name of `holdfast.raw_ingest`. Deprecated: the next release removes it."""

from __future__ import annotations

import warnings

from holdfast.raw_ingest import *  # noqa: F403

warnings.warn(
    "holdfast.raw is now holdfast.raw_ingest; the next release removes the old name",
    DeprecationWarning,
    stacklevel=2,
)

"""The former name of `holdfast.raw_ingest`. Deprecated: it goes with the next release."""

from __future__ import annotations

import warnings

from holdfast.raw_ingest import *  # noqa: F403

warnings.warn(
    "holdfast.raw is now holdfast.raw_ingest; the old name goes with the next release",
    DeprecationWarning,
    stacklevel=2,
)

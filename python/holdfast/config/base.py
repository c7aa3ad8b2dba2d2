"""The base class of all models of a configuration."""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel, ConfigDict


class Model(BaseModel):
    """Frozen and strict: no unknown keys, no conversions. Docstrings become key descriptions."""

    own_files: ClassVar[tuple[str, ...]] = ()
    """The keys of files that Holdfast writes itself, so that no change of them is a change of the
    configuration."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True
    )

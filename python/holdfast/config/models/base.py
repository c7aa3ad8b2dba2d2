"""The base class of all models of a configuration."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Final, Self, get_args

from pydantic import BaseModel, ConfigDict
from pydantic_core import PydanticCustomError


class InvalidValue(Exception):
    """A check needs a value that is invalid, which has been reported: the check ends here."""


class _Invalid:
    """Stands for an invalid entry of a list or mapping of an invalid configuration."""

    def __getattr__(self, name: str) -> Any:
        raise InvalidValue

    def __repr__(self) -> str:
        return "INVALID"


def problem_at(key: str, message: str) -> PydanticCustomError:
    """The error of a validator of a whole model, with the key that it concerns."""
    return PydanticCustomError("problem_at", "{message}", {"key": key, "message": message})


INVALID: Final[Any] = _Invalid()


class Model(BaseModel):
    """Frozen and strict: no unknown keys, no conversions. Docstrings of keys describe them in the
    JSON Schema: see `holdfast.config.schema`."""

    own_files: ClassVar[tuple[str, ...]] = ()
    """The keys of files that Holdfast writes itself, so that no change of them is a change of the
    configuration."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    def whole(self) -> Self:
        """This model, if all its keys are valid. Raises `InvalidValue`."""
        if len(self.__dict__) < len(type(self).model_fields):
            raise InvalidValue
        return self

    if not TYPE_CHECKING:  # A type checker would accept any attribute.

        def __getattr__(self, name: str) -> Any:
            """Called for keys that are invalid: only a configuration with errors has them."""
            if name in type(self).model_fields:
                raise InvalidValue
            return super().__getattr__(name)


def types_of(union: object) -> tuple[str, ...]:
    """The values of `type` of the models of a union, in its order."""
    models: tuple[type[Model], ...] = get_args(union)
    assert models, "a union of one model is the model"
    return tuple(
        word for model in models for word in get_args(model.model_fields["type"].annotation)
    )

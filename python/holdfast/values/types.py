"""Parses the names of types: content and size of a field."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache

from holdfast.protocol import ADDRESSES
from holdfast.runtime.suggestion import HIGH_LIKENESS, MAX_COMPARED, alike
from holdfast.values.errors import UnknownType, shown

FIXED = {
    "bool": 2,
    "int16": 2,
    "uint16": 2,
    "int32": 4,
    "uint32": 4,
    "int64": 8,
    "uint64": 8,
    "float16": 2,
    "float32": 4,
    "float64": 8,
    "bcd16": 2,
    "bcd32": 4,
}
"""Types without a parameter, and how many bytes an element has in registers."""

LONGEST_NUMBER = max(FIXED.values()) // 2
"""The registers of the longest number."""

ALLOWED = f"bit:0 to bit:15, {', '.join(FIXED)}, string:N, bytes:N, and arrays: float32[10]"
MAX_REGISTERS = ADDRESSES

_NUMBER = r"(0|[1-9][0-9]{0,5})"
_NAME = re.compile(rf"(([a-z]+[0-9]*)(?::{_NUMBER})?)(?:\[{_NUMBER}\])?")


@dataclass(frozen=True, slots=True)
class Type:
    """A type, split into its parts."""

    name: str
    """The whole name, such as `string:5[3]`."""
    element: str
    """The name of one element: `string:5`."""
    base: str
    """`string`."""
    parameter: int
    """The number after the colon, 0 without one: 5."""
    width: int
    """The bytes of an element in registers: 6."""
    count: int | None
    """The length of an array: 3. `None` for a single value, which differs from an array of 1."""

    @property
    def registers(self) -> int:
        """Registers per field of this type."""
        return self.width // 2 * (1 if self.count is None else self.count)

    @property
    def is_float(self) -> bool:
        """Whether the elements are floating-point numbers."""
        return self.base.startswith("float")

    @property
    def is_number(self) -> bool:
        """Whether the elements are numbers, and not bits or text."""
        return self.base in FIXED and self.base != "bool"


@lru_cache(1024)
def parsed(name: str) -> Type:
    """Parses the name of a type. Raises `UnknownType`."""
    match = _NAME.fullmatch(name) if isinstance(name, str) else None
    if match is None:
        raise _unknown(name)
    element, base, parameter, count = match.groups()
    width = _width(base, None if parameter is None else int(parameter))
    if width is None:
        raise _unknown(name)
    type_ = Type(name, element, base, int(parameter or 0), width, int(count) if count else None)
    if not 1 <= type_.registers <= MAX_REGISTERS:
        allowed = f"allowed: 1 to {MAX_REGISTERS}"
        raise UnknownType(f"type {shown(name)} would take {type_.registers} registers, {allowed}")
    return type_


def _width(base: str, parameter: int | None) -> int | None:
    if parameter is None:
        return FIXED.get(base)
    if base == "bit" and parameter <= 15:
        return 2
    if base in ("string", "bytes"):
        return parameter + parameter % 2
    return None


def whole_elements(most: int, element: int) -> int:
    """The most registers, up to `most`, with whole elements; `most` if not even one fits."""
    return most // element * element or most


USUAL_NAMES = {
    "bit": "bit:0",
    "boolean": "bool",
    "bytes": "bytes:8",
    "char": "string:8",
    "double": "float64",
    "dint": "int32",
    "dword": "uint32",
    "float": "float32",
    "half": "float16",
    "int": "int16",
    "integer": "int16",
    "lint": "int64",
    "longlong": "int64",
    "long": "int32",
    "lreal": "float64",
    "lword": "uint64",
    "qword": "uint64",
    "real": "float32",
    "short": "int16",
    "signed": "int16",
    "single": "float32",
    "str": "string:8",
    "string": "string:8",
    "text": "string:8",
    "udint": "uint32",
    "uint": "uint16",
    "ulint": "uint64",
    "ulong": "uint32",
    "unsigned": "uint16",
    "unsignedint": "uint16",
    "unsignedlong": "uint32",
    "unsignedshort": "uint16",
    "ushort": "uint16",
    "word": "uint16",
    **dict.fromkeys(("byte", "sint", "usint", "wchar", "wstring"), ""),
}
"""What other programs call these types, to suggest ours; "" for types that are not here."""

_SIZED = re.compile(r"(bit|bytes|char|str|string|text)([:.\[]?)([0-9]{1,6})[.\]]?")


def _unknown(name: object) -> UnknownType:
    if len(str(name)) > MAX_COMPARED:
        return UnknownType(f"type {shown(name)} is unknown, allowed: {ALLOWED}")
    base, bracket, count = re.sub(r"[\s_-]", "", str(name).lower()).partition("[")
    meant = _meant(base)
    sized = _SIZED.fullmatch(base + bracket + count)
    if sized:  # STRING[20]
        meant, bracket = _with_number(sized[1], int(sized[3])), ""
    elif sized := _SIZED.fullmatch(base):
        meant = _with_number(sized[1], int(sized[3]))
    array = meant + bracket + count if bracket else meant
    near = f"; did you mean {array if _NAME.fullmatch(array) else meant!r}?" if meant else ""
    return UnknownType(f"type {shown(name)} is unknown, allowed: {ALLOWED}{near}")


def _with_number(word: str, number: int) -> str:
    """The type of this number of a field's bit or bytes, "" if there is none."""
    base = USUAL_NAMES.get(word, word).partition(":")[0]
    return f"{base}:{number}" if _width(base, number) else ""


def _meant(word: str) -> str:
    """The type that a word is probably meant to be, "" if that is not clear."""
    short = re.fullmatch("([uisf])(16|32|64)", word)
    if short:
        word = {"u": "uint", "i": "int", "s": "int", "f": "float"}[short[1]] + short[2]
    known = (*FIXED, *USUAL_NAMES)
    if word not in known:
        # Sign and size must not be guessed: others copy what is suggested.
        traits = _traits(word)
        same_traits = [each for each in known if _traits(each) == traits]
        swapped = [each for each in known if sorted(each) == sorted(word)]
        word = next(iter(swapped or alike(word, same_traits, HIGH_LIKENESS)), "")
    return USUAL_NAMES.get(word, word)


def _traits(word: str) -> tuple[bool, str]:
    """What tells the sign and the size: whether the word has a `u`, and its digits."""
    return "u" in word, re.sub("[^0-9]", "", word)

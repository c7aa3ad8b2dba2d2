"""The messages of Sparkplug B, as far as an edge node without templates and data sets needs them.

Written from section 6.4.1 of the specification: names and numbers of fields. The classes are made
when this module is imported, so that no generated code depends on a version of `protobuf`.
"""

from __future__ import annotations

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

_Field = descriptor_pb2.FieldDescriptorProto
_PACKAGE = "holdfast.sparkplug_b"

_TYPES = {
    "uint32": _Field.TYPE_UINT32,
    "uint64": _Field.TYPE_UINT64,
    "float": _Field.TYPE_FLOAT,
    "double": _Field.TYPE_DOUBLE,
    "bool": _Field.TYPE_BOOL,
    "string": _Field.TYPE_STRING,
    "bytes": _Field.TYPE_BYTES,
}

_MESSAGES = {
    "PropertyValue": (
        "1 type uint32, 2 is_null bool, 3 int_value uint32, 4 long_value uint64, "
        "5 float_value float, 6 double_value double, 7 boolean_value bool, 8 string_value string"
    ),
    "PropertySet": "1 keys string*, 2 values PropertyValue*",
    "Metric": (
        "1 name string, 2 alias uint64, 3 timestamp uint64, 4 datatype uint32, "
        "5 is_historical bool, 6 is_transient bool, 7 is_null bool, 9 properties PropertySet, "
        "10 int_value uint32, 11 long_value uint64, 12 float_value float, 13 double_value double, "
        "14 boolean_value bool, 15 string_value string, 16 bytes_value bytes"
    ),
    "Payload": "1 timestamp uint64, 2 metrics Metric*, 3 seq uint64, 4 uuid string, 5 body bytes",
}


def _file() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(
        name="holdfast/sparkplug_b.proto", package=_PACKAGE, syntax="proto2"
    )
    for name, fields in _MESSAGES.items():
        message = file.message_type.add(name=name)
        for text in fields.split(", "):
            number, field, kind = text.split()
            made = message.field.add(name=field, number=int(number))
            made.label = _Field.LABEL_REPEATED if kind.endswith("*") else _Field.LABEL_OPTIONAL
            kind = kind.removesuffix("*")
            made.type = _TYPES.get(kind, _Field.TYPE_MESSAGE)
            if kind not in _TYPES:
                made.type_name = f".{_PACKAGE}.{kind}"
    return file


_pool = descriptor_pool.DescriptorPool()
_pool.AddSerializedFile(_file().SerializeToString())


def _class(name: str) -> Any:
    return message_factory.GetMessageClass(_pool.FindMessageTypeByName(f"{_PACKAGE}.{name}"))


Payload: Any = _class("Payload")
Metric: Any = _class("Metric")


def parsed(data: bytes) -> Any:
    """Parses a payload. Raises `ValueError`."""
    try:
        return Payload.FromString(data)
    except DecodeError:
        raise ValueError("not a Sparkplug B payload") from None

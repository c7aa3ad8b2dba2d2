"""The types of single values in a configuration.

Every type is strict: text is not a number, a boolean is not an integer. If a JSON Schema can't
express a rule in full, the type raises `ValueError` with its own message.
"""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, Literal, TypeGuard
from urllib.parse import unquote

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    PlainSerializer,
    PlainValidator,
    Strict,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic.config import JsonDict
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from holdfast.client.base import MAX_INTERVAL_S
from holdfast.client.url import FORMS, RECEIVER_FORM, in_folder, receiver_in_folder
from holdfast.config.text.messages import PATH_QUOTES, shape, show, show_file
from holdfast.config.values.allow_entries import parse_allowed
from holdfast.config.values.host_names import parse_host_name
from holdfast.config.values.ip_addresses import Bind, parse_bind, parse_peer, parse_source
from holdfast.config.values.scanner_settings import (
    PREFIX,
    parse_fleet,
    parse_member,
    parse_pollable,
    parse_prefix,
    parse_server,
    written_pollable,
)
from holdfast.config.values.topics import parse_topic_filter, parse_topic_name, parse_topic_template
from holdfast.config.values.unit_keys import EXAMPLE, UnitKey, parse_unit_key
from holdfast.config.values.urls import parse_broker, parse_http, parse_syslog
from holdfast.net.addresses import Network
from holdfast.net.allow_list import AllowedNetwork, AllowEntry
from holdfast.net.mqtt import MAX_TEXT
from holdfast.protocol import (
    MAX_CODE,
    MAX_ROLE,
    MAX_SERIAL_UNIT,
    MAX_UNIT,
    MAX_WORD,
    PRIVATE_OBJECTS,
)
from holdfast.runtime.text import either
from holdfast.types import Area

MAX_BYTES = 244
MAX_CONNECTIONS = 65535
MAX_DEVICE = 4095
MAX_TIME = MAX_INTERVAL_S
MIN_TIME = 0.001

NOT_ON_A_LINE = f"; 0 is the broadcast, {MAX_SERIAL_UNIT + 1} to {MAX_UNIT} are reserved"
MAX_SPARKPLUG_ID = 255
NAME_FORM = "1 to 64 letters, digits, '_', '.' and '-'"
TOKEN_NAME_FORM = f"{NAME_FORM}, not '-' alone"
_POINT_FORM = (
    "without control characters, and without a backslash at its end or before a blank, comma, =, "
    '" or \\'
)
POINT_TAG_FORM = f"text {_POINT_FORM}"
MEASUREMENT_FORM = f"text that does not begin with #, {_POINT_FORM}"
_NAME = r"[A-Za-z0-9_.-]{1,64}"
_TOKEN_NAME = f"(?!-$){_NAME}"
_POINT_TAG = r'([^\\\x00-\x1f]|\\[^ ,="\\\x00-\x1f])+'
_MEASUREMENT = f"(?!#){_POINT_TAG}"
_STATUS_NAME = "[ -~]{0,16}"
_BYTE = r"([01]?[0-9]?[0-9]|2[0-4][0-9]|25[0-5])"
_HIGH_BYTE = r"(12[89]|1[3-9][0-9]|2[0-4][0-9]|25[0-5])"
_SERIAL = r"([1-9]|[1-9][0-9]|1[0-9][0-9]|2[0-3][0-9]|24[0-7])"
_WORD = r"([0-5]?[0-9]{1,4}|6([0-4][0-9]{3}|5([0-4][0-9]{2}|5([0-2][0-9]|3[0-5]))))"

RESERVED = ("rest", "mqtt", "nats", "gateway", "metrics")
"""Names of built-in services in logs, which listeners, outputs and adapters can't have."""

_HASHES_OF_NOTHING = {hashlib.sha256(text).hexdigest() for text in (b"", b"\n")}
"""What `printf %s "$TOKEN" | sha256sum` and `echo` print if the variable is not set."""


def is_name(value: object) -> TypeGuard[str]:
    """Whether the value is a valid name."""
    return isinstance(value, str) and re.fullmatch(_NAME, value) is not None


def _name(value: object) -> str:
    if is_name(value):
        return value
    raise ValueError(f"found {show(value)}, allowed: {NAME_FORM}{_quotable(value)}")


def is_token_name(value: object) -> TypeGuard[str]:
    """Whether the value is a valid name of a token; logs have `-` for requests without one."""
    return is_name(value) and value != "-"


def _token_name(value: object) -> str:
    if is_token_name(value):
        return value
    raise ValueError(f"found {show(value)}, allowed: {TOKEN_NAME_FORM}{_quotable(value)}")


def _raw_target(value: object) -> str:
    if isinstance(value, dict) and "memory" in value:
        raise ValueError("found a mapping, allowed: a memory; areas limit a raw ingest rule")
    if isinstance(value, dict):
        raise ValueError("found a route, allowed: a memory; a route takes Modbus requests only")
    return _name(value)


def _id_of(what: str, least: int, most: int) -> Callable[[object], int]:
    """A validator for integers from `least` to `most`."""

    def number(value: object) -> int:
        if type(value) is int and least <= value <= most:
            return value
        form = f"{what} from {least} to {most}{_unquoted(value)}"
        raise ValueError(f"found {show(value)}, allowed: {form}")

    return number


def _unreserved_name(value: object) -> str:
    if value in RESERVED:
        raise ValueError(f"found {show(value)}, allowed: a name other than {either(RESERVED)}")
    return _name(value)


def _option_name(value: object) -> str:
    if isinstance(value, str):
        return value
    raise ValueError(f"found {show(value)}, allowed: text{_quotable(value)}")


def parse_sha256(value: object) -> str:
    """Checks a SHA-256. The `ValueError` omits the value, which could be the token itself."""
    if isinstance(value, str) and re.fullmatch("[0-9a-fA-F]{64}", value):
        return value.lower()
    quote = "" if isinstance(value, str) else ", as text"
    allowed = f"allowed: the SHA-256 of the token, 64 hexadecimal digits{quote}"
    raise ValueError(f"found {shape(value)}, {allowed}")


def parse_token_hash(value: object) -> str:
    """Checks the SHA-256 of a token, as `parse_sha256`."""
    digest = parse_sha256(value)
    if digest in _HASHES_OF_NOTHING:
        found = "found the SHA-256 of an empty text, perhaps of an unset variable"
        raise ValueError(f"{found}, allowed: that of a token, as from `holdfast token`")
    return digest


def _syslog_url(value: object) -> str:
    if isinstance(value, dict):
        raise ValueError("found a mapping, allowed: its url alone; the facility is always local0")
    return _checked(parse_syslog)(value)


def _checked(parse: Callable[[object], object]) -> Callable[[object], str]:
    """A validator that keeps the text that a function can parse."""

    def text(value: object) -> str:
        parse(value)
        return str(value)

    return text


def _without_nul(value: object, forms: str) -> str:
    """Checks that a URL is text without NUL. `forms` are the allowed URLs."""
    if not isinstance(value, str):
        raise ValueError(f"found {show(value)}, allowed: {forms}")
    if "\0" in unquote(value):
        raise ValueError(f"found {show(value)}, allowed: a URL without NUL")
    return value


def _device_url(value: object, info: ValidationInfo) -> str:
    return in_folder(_without_nul(value, FORMS), _folder(info))


def _receiver_url(value: object, info: ValidationInfo) -> str:
    return receiver_in_folder(_without_nul(value, RECEIVER_FORM), _folder(info))


def integral(value: object) -> object:
    """Refuses `true` and `1.0`, which pydantic's literals accept as 1."""
    if type(value) is not int:
        raise PydanticCustomError("integral", "not an integer")
    return value


def _version(value: object) -> object:
    return "5" if type(value) is int and value == 5 else value


def _folder(info: ValidationInfo) -> Path:
    """The folder of the configuration; file paths are relative to it."""
    folder: Path = (info.context or {}).get("folder", Path())
    return folder


def _in_folder(value: object, info: ValidationInfo) -> object:
    if not isinstance(value, str):
        return value
    return _folder(info) / check_file_path(value)


def check_file_path(value: str) -> str:
    """Raises `ValueError` if a path is empty or has a control character.

    An escape of YAML, in a quoted path of Windows, makes such a character.
    """
    if not value:
        raise ValueError(f"found {show(value)}, allowed: the path of a file")
    for character in value:
        if unicodedata.category(character) == "Cc":
            allowed = f"allowed: the path of a file, without {character!r}; {PATH_QUOTES}"
            raise ValueError(f"found {show_file(value)}, {allowed}")
    return value


def check_state_name(value: str) -> str:
    """Raises `ValueError` for a name that a write would not take as it was published.

    Empty text is no value, and blanks around a value are no part of it.
    """
    is_plain = all(unicodedata.category(character) not in ("Cc", "Cs") for character in value)
    if not value or value != value.strip() or not is_plain:
        allowed = "allowed: a name without control characters, and without blanks at its ends"
        raise ValueError(f"found {show(value)}, {allowed}")
    return value


def _key_of(least: int, most: int, note: str = "") -> Callable[[object], UnitKey]:
    """A validator for keys that are a unit id or a range of unit ids."""
    allowed = f"a unit id from {least} to {most}, or a range, as in {EXAMPLE}{note}"

    def key(value: object) -> UnitKey:
        parsed = parse_unit_key(value, least, most)
        if parsed is None:
            raise ValueError(f"found {show(value)}, allowed: {allowed}{_unquoted(value)}")
        return parsed

    return key


def _unquoted(value: object) -> str:
    """A hint for an integer that is text, as in `"1": plant`."""
    is_integer = isinstance(value, str) and re.fullmatch("[0-9]{1,5}", value)
    return f"; write {value} without quotes" if is_integer else ""


def _quotable(value: object) -> str:
    """A hint for text without quotes that YAML takes for a number or a boolean, as in `1.10`.

    It does not repeat the value, which is no longer as it was written.
    """
    return "; quote it to make it text" if isinstance(value, int | float) else ""


def _sparkplug_id(value: object) -> str:
    text = _text_of(MAX_SPARKPLUG_ID)(value)
    for character in "+/#":
        if character in text:
            raise ValueError(f"found {show(value)}, allowed: text without +, / and #")
    return text


def is_measurement(text: str) -> bool:
    """Whether line protocol can have the measurement: a line that begins with # is a comment."""
    return re.fullmatch(_MEASUREMENT, text) is not None


def is_point_tag(text: str) -> bool:
    """Whether line protocol can have the text as the value of a tag.

    Nothing escapes a backslash there, and receivers differ in what it escapes.
    """
    return re.fullmatch(_POINT_TAG, text) is not None


def _measurement(text: str) -> str:
    if not is_measurement(text):
        raise ValueError(f"found {show(text)}, allowed: {MEASUREMENT_FORM}")
    return text


def _point_tag(text: str) -> str:
    if not is_point_tag(text):
        raise ValueError(f"found {show(text)}, allowed: {POINT_TAG_FORM}")
    return text


def _text_of(most: int, least: int = 1) -> Callable[[object], str]:
    """A validator for text of `least` to `most` bytes."""
    allowed = f"allowed: text of {least} to {most} bytes"

    def text(value: object) -> str:
        if not isinstance(value, str):
            raise ValueError(f"found {show(value)}, {allowed}{_quotable(value)}")
        for character in value:
            if unicodedata.category(character) in ("Cc", "Cs"):
                raise ValueError(f"found {show(value)}, allowed: text without {character!r}")
        size = len(value.encode())
        if not least <= size <= most:
            raise ValueError(f"found text of {size} bytes, {allowed}")
        return value

    return text


def _status_name(value: object) -> str:
    if isinstance(value, str) and re.fullmatch(_STATUS_NAME, value):
        return value
    raise ValueError(f"found {show(value)}, allowed: up to 16 printable ASCII characters")


def _no_instant(value: float) -> float:
    if 0 < value < MIN_TIME:
        raise ValueError(f"found {value}, allowed: 0, or {MIN_TIME} to {MAX_TIME} seconds")
    return value


def _not_null(value: object) -> object:
    if value is None:
        raise PydanticCustomError("null", "nothing")
    return value


def whole(value: int | float) -> int | float:
    """A float without a fraction as the integer that its digits are."""
    is_whole = isinstance(value, float) and value.is_integer()
    return int(Decimal(repr(value))) if is_whole else value


def exact_number(value: int | float) -> int | float:
    """A float; an integer stays one if no float has its digits, as beyond 2^53."""
    number = float(value)
    return number if whole(number) == value else value


def _exact(value: object, check: ValidatorFunctionWrapHandler) -> int | float:
    number: float = check(value)
    return exact_number(value) if type(value) is int else number


class NotNull:
    """Marks a key that is optional but not nullable: omitted is `None`, an empty value fails."""

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_before_validator_function(_not_null, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        made = handler(schema)
        kinds = [kind for kind in made.get("anyOf", []) if kind != {"type": "null"}]
        if len(kinds) == 1:
            del made["anyOf"]
            made.update(kinds[0])
        elif kinds:
            made["anyOf"] = kinds
        return made


class Parsed:
    """Marks a value that a function checks, or parses. It raises `ValueError` with its message.

    The JSON Schema is text with these examples, unless `schema` has other keys.
    """

    def __init__(
        self,
        parse: Callable[..., object],
        *examples: str,
        written: Callable[[Any], str] | None = None,
        **schema: object,
    ) -> None:
        self._parse = parse
        self._written = written
        self._schema = {
            "type": "string",
            **({"examples": [*examples]} if examples else {}),
        } | schema

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        schema = PlainValidator(self._parse).__get_pydantic_core_schema__(source, handler)
        if self._written is None:
            return schema
        text = core_schema.str_schema()
        written = core_schema.plain_serializer_function_ser_schema(
            self._written, return_schema=text
        )
        return {**schema, "serialization": written}

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        return dict(self._schema)


Name = Annotated[str, Parsed(_name, pattern=f"^{_NAME}$")]
RawTarget = Annotated[str, Parsed(_raw_target, pattern=f"^{_NAME}$")]
"""The memory behind a unit id of raw ingest packets."""
UnreservedName = Annotated[str, Parsed(_unreserved_name, pattern=f"^{_NAME}$")]
TokenName = Annotated[str, Parsed(_token_name, pattern=f"^{_TOKEN_NAME}$")]
OptionName = Annotated[str, Parsed(_option_name)]
UnitId = Annotated[
    int, Parsed(_id_of("a unit id", 0, MAX_UNIT), type="integer", minimum=0, maximum=MAX_UNIT)
]
UnitIds = Annotated[int | str, Parsed(_key_of(0, MAX_UNIT))]
SerialUnitIds = Annotated[int | str, Parsed(_key_of(1, MAX_SERIAL_UNIT, NOT_ON_A_LINE))]
RawUnitId = Annotated[int, Parsed(_id_of("a unit id", 0, MAX_WORD), type="integer")]
ObjectId = Annotated[
    int, Parsed(_id_of("an object id", PRIVATE_OBJECTS[0], PRIVATE_OBJECTS[-1]), type="integer")
]
FileNumber = Annotated[int, Parsed(_id_of("a file number", 1, MAX_WORD), type="integer")]
FunctionCode = Annotated[
    int, Parsed(_id_of("a function code", 1, MAX_CODE), type="integer", minimum=1, maximum=MAX_CODE)
]
Text = Annotated[str, Parsed(_text_of(MAX_BYTES), minLength=1, maxLength=MAX_BYTES)]
Role = Annotated[str, Parsed(_text_of(MAX_ROLE, least=0), "operator", maxLength=MAX_ROLE)]
Roles = Annotated[Annotated[tuple[Role, ...], Strict(False), Field(min_length=1)] | None, NotNull()]
DeviceName = Annotated[str, Parsed(_text_of(MAX_DEVICE), "/dev/ttyUSB0", "COM3", minLength=1)]
StatusName = Annotated[str, Parsed(_status_name, pattern=f"^{_STATUS_NAME}$")]
MqttText = Annotated[str, Parsed(_text_of(MAX_TEXT), minLength=1, maxLength=MAX_TEXT)]
FilePath = Annotated[Path, BeforeValidator(_in_folder, json_schema_input_type=str)]
TokenHash = Annotated[str, Parsed(parse_token_hash, pattern="^[0-9a-fA-F]{64}$")]
BrokerUrl = Annotated[
    str, Parsed(_checked(parse_broker), "mqtt://127.0.0.1:1883", "mqtts://broker.example")
]
HttpUrl = Annotated[str, Parsed(_checked(parse_http), "http://10.0.0.9:8086", "https://db.example")]
SyslogUrl = Annotated[
    str, Parsed(_syslog_url, "udp://10.0.0.9:514", "tcp://log.example:601", "unix:///dev/log")
]
NatsUrl = Annotated[
    str, Parsed(_checked(parse_server), "nats://127.0.0.1:4222", "tls://nats.example")
]
FleetName = Annotated[str, Parsed(parse_fleet, pattern="^(?!.*_wants$)[A-Za-z0-9_-]{1,32}$")]
FleetMember = Annotated[str, Parsed(parse_member, pattern="^[A-Za-z0-9_-]{1,32}$")]
SubjectPrefix = Annotated[str, Parsed(parse_prefix, PREFIX, "plant.modbus")]
PollableEntry = Annotated[
    AllowEntry,
    Parsed(parse_pollable, "10.0.0.0/24", "10.0.0.7", "/dev/ttyUSB0", written=written_pollable),
]
EgressEntry = Annotated[
    AllowedNetwork,
    Parsed(parse_allowed, "10.0.0.0/24", "10.0.0.7:5020", "[fd00::]/64", written=str),
]
HostName = Annotated[str, Parsed(parse_host_name, "gateway.plant.example")]
DeviceUrl = Annotated[
    str, Parsed(_device_url, "tcp://10.0.0.9:502", "rtu:///dev/ttyUSB0?baud=9600")
]
ReceiverUrl = Annotated[
    str, Parsed(_receiver_url, "raw://10.0.2.9:9000", "raw+tls://10.0.2.9:9000?ca=ca.pem")
]
TopicFilter = Annotated[str, Parsed(parse_topic_filter, minLength=1, maxLength=MAX_TEXT)]
TopicName = Annotated[str, Parsed(parse_topic_name, minLength=1, maxLength=MAX_TEXT)]
TopicTemplate = Annotated[str, Parsed(parse_topic_template, "plant/{device}/{tag}")]
Measurement = Annotated[
    str,
    Field(min_length=1, json_schema_extra={"pattern": f"^{_MEASUREMENT}$"}),
    AfterValidator(_measurement),
]
PointTag = Annotated[
    str,
    Field(min_length=1, json_schema_extra={"pattern": f"^{_POINT_TAG}$"}),
    AfterValidator(_point_tag),
]
SparkplugId = Annotated[str, Parsed(_sparkplug_id, pattern="^[^+/#]{1,255}$")]
PeerAddress = Annotated[str, Parsed(parse_peer)]
Source = Annotated[
    Network, Parsed(parse_source, "10.0.0.0/24", "10.0.0.7", "fd00::/64", written=str)
]
BindAddress = Annotated[
    Bind, Parsed(parse_bind, "0.0.0.0:502", "127.0.0.1:5020", "[::]:502", written=str)
]
MqttVersion = Annotated[
    Literal["5", "3.1.1"],
    BeforeValidator(_version, json_schema_input_type=Literal["5", "3.1.1", 5]),
]
QualityOfService = Annotated[Literal[0, 1, 2], BeforeValidator(integral)]
StopBits = Annotated[Literal[1, 2], BeforeValidator(integral)]
DataBits = Annotated[Literal[7, 8], BeforeValidator(integral)]
Connections = Annotated[int, Field(ge=1, le=MAX_CONNECTIONS)]
whole_number = PlainSerializer(whole, return_type=int | float)
"""Writes `1.0` as `1`."""
Number = Annotated[float, Field(allow_inf_nan=False), WrapValidator(_exact), whole_number]
SECONDS: JsonDict = {"$comment": "seconds"}
MILLISECONDS: JsonDict = {"$comment": "milliseconds"}
"""JSON Schema keys for the units of times, which messages name."""


def seconds(least: float, most: float) -> Any:
    """The constraints of a time."""
    return Field(ge=least, le=most, allow_inf_nan=False, json_schema_extra=SECONDS)


Duration = Annotated[float, seconds(MIN_TIME, MAX_TIME), whole_number]
DurationOrZero = Annotated[float, seconds(0, MAX_TIME), AfterValidator(_no_instant), whole_number]
Codes = Annotated[
    tuple[FunctionCode, ...], Strict(False), Field(json_schema_extra={"uniqueItems": True})
]

Sources = Annotated[tuple[Source, ...], Strict(False), Field(min_length=1)]
MemoryNames = Annotated[
    tuple[Name, ...], Strict(False), Field(min_length=1, json_schema_extra={"uniqueItems": True})
]
Areas = Annotated[
    tuple[Area, ...], Strict(False), Field(min_length=1, json_schema_extra={"uniqueItems": True})
]

NAME_KEYS: JsonDict = {"propertyNames": {"pattern": f"^{_NAME}$"}}
UNIT_KEYS: JsonDict = {"propertyNames": {"pattern": f"^{_BYTE}$"}}
UNITS_KEYS: JsonDict = {"propertyNames": {"pattern": f"^{_BYTE}(-{_BYTE})?$"}}
SERIAL_UNITS_KEYS: JsonDict = {"propertyNames": {"pattern": f"^{_SERIAL}(-{_SERIAL})?$"}}
RAW_UNIT_KEYS: JsonDict = {"propertyNames": {"pattern": f"^{_WORD}$"}}
FILE_KEYS: JsonDict = {"propertyNames": {"pattern": f"^(?!0$){_WORD}$"}}
PEER_KEYS: JsonDict = {"propertyNames": {"pattern": "^[0-9a-fA-F.:]+$"}}
OBJECT_KEYS: JsonDict = {"propertyNames": {"pattern": f"^{_HIGH_BYTE}$"}}
UNRESERVED_KEYS: JsonDict = {
    "propertyNames": {"pattern": f"^{_NAME}$", "not": {"enum": list(RESERVED)}}
}
"""JSON Schema patterns for the keys of mappings, which JSON Schema treats as text."""

"""What entities of Home Assistant's `modbus` section become: tags, by the kind of the entity."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.config.text.messages import show
from holdfast.config.values.home_assistant_classes import KNOWN, flaws, is_class_word
from holdfast.config.values.scalars import check_state_name
from holdfast.importing.key_reader import Section
from holdfast.importing.names import MAX_LENGTH
from holdfast.protocol import ADDRESSES, LAST_ADDRESS
from holdfast.tags import Tag
from holdfast.values import encode, register_count
from holdfast.values.digits import FLOATS
from holdfast.values.errors import DoesNotFit
from holdfast.values.numeric import INTEGERS
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.importing.notes import Desk
    from holdfast.types import Area

_AREAS: dict[str, Area] = {
    "coil": "coils",
    "coils": "coils",
    "discrete_input": "discrete_inputs",
    "holding": "holding_registers",
    "holdings": "holding_registers",
    "input": "input_registers",
}
_REGISTERS = ("holding", "input")
_BITS = ("coils", "discrete_inputs")

_TYPES = (*INTEGERS, *FLOATS)
_FORMER_TYPES = ("int", "uint", "float")
"""Types of former versions, whose `count` is their size in registers."""

_ORDERS = {"none": None, "word": "CDAB", "byte": "BADC", "word_byte": "DCBA"}
_LITTLE_ORDERS = {"none": "DCBA", "word": "BADC", "byte": "CDAB", "word_byte": None}
"""The byte orders by `swap`; of structures whose values have their last byte first."""

_NAME_FORM = "a name has letters from a to z, digits and '_'"

_UTF_8 = {"encoding": "utf-8"}
"""The source decoded every text as UTF-8."""

_STRUCTURE = re.compile(r"([@=<>!]?)(\d{0,3})([hHiIlLqQefds])")
_CODES = {code: kind for kind, code in (INTEGERS | FLOATS).items()} | {"l": "int32", "L": "uint32"}
"""The types of one value of a structure, by its code."""

_PREFIX = re.compile(r"^(swing_mode_)?(state_|action_)(fan_(?!only))?")
"""What the name of a mode begins with."""

_ACTIONS = ("cooling", "defrosting", "drying", "fan", "heating", "idle")
_SEARCHED = (*_ACTIONS, "off", "heat", "cool", "heat_cool", "auto", "dry", "fan_only", "preheating")
"""The order in which the source looked for the action or the mode of a number."""

_TARGET_MODES = ("auto", "cool", "dry", "fan_only", "heat", "heat_cool", "off")
"""The modes that the registers of a list of setpoints are for."""

_MODES = ("hvac_mode_register", "fan_mode_register", "swing_mode_register")


@dataclass
class Wanted:
    """A tag whose name is chosen when all tags of its unit are known."""

    name: str
    """As an entity id, so without a hyphen; empty if that can't spell it."""
    place: str
    """Area, address and platform with hyphens: the name if its own is empty, or another one's."""
    tag: dict[str, Any]
    description: str
    at: KeyPath
    interval: int


@dataclass
class Places:
    """The tags of one unit so far."""

    desk: Desk
    tags: list[Wanted] = field(default_factory=list)
    at: KeyPath = ()
    """The place of the entity that is being read."""
    name: str = ""
    platform: str = ""
    interval: int = 0
    """All three of that entity."""
    written: dict[bool, list[KeyPath]] = field(default_factory=lambda: {False: [], True: []})
    """What writes one coil or register, with functions 5 and 6, or (`True`) with 15 and 16."""

    def begin(self, entity: Section, platform: str, interval: int) -> None:
        """The tags that are added from now on are those of this entity."""
        self.at, self.name, self.interval = entity.path, _name(entity), interval
        self.platform = platform.removesuffix("es" if platform == "switches" else "s")

    def add(self, name: str, area: Area, address: int, **settings: Any) -> None:
        """Adds a tag; its name is that of an entity id, and `name` its description."""
        tag = {"area": area, "address": address, **settings}
        size = register_count(settings["type"]) if "type" in settings else 1
        if address + size > ADDRESSES:
            message = f"{name} is at {address} to {address + size - 1}"
            self.desk.problem(self.at, f"{message}, allowed: up to {LAST_ADDRESS}")
        part = _spelt(f"{self.platform}{name.removeprefix(self.name)}")
        place = f"{area.removesuffix('s')}-{address}-{part}"[: MAX_LENGTH - len("-9999-of-9999")]
        self.tags.append(Wanted(_spelt(name), place, tag, name, self.at, self.interval))

    def named(self) -> dict[str, Wanted]:
        """The tags by name.

        A name is a topic to write to: when an entity is removed, none may get its name. So equal
        places have their number in theirs, too.
        """
        own = Counter(each.name for each in self.tags if each.name)
        places = Counter(each.place for each in self.tags if own[each.name] != 1)
        numbers = Counter[str]()
        tags: dict[str, Wanted] = {}
        for each in self.tags:
            name = each.name
            if own[name] != 1:
                name = each.place
                if places[name] > 1:
                    numbers[name] += 1
                    name = f"{name}-{numbers[name]}-of-{places[name]}"
                reason = "another entity has its name" if each.name else _NAME_FORM
                self.desk.changed((*each.at, "name"), f"renamed to {name}: {reason}")
            if name != each.description:
                each.tag["description"] = each.description
            tags[name] = each
        return tags


def _spelt(text: str) -> str:
    """The text as an entity id; empty if a letter would be missing."""
    plain = unicodedata.normalize("NFKD", text.casefold())
    if any(each.isalnum() and not each.isascii() for each in plain):
        return ""
    plain = plain.encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9]+", "_", plain).strip("_")[:MAX_LENGTH]


Entities: TypeAlias = Callable[[Places, "Section"], None]
"""Adds the tags of one entity."""


def _name(entity: Section) -> str:
    return entity.name("name") or "entity"


def _address(entity: Section, key: str = "address", *, required: bool = True) -> int | None:
    return entity.integer(key, 0, LAST_ADDRESS, required=required, what="an address")


def _register(entity: Section, key: str, usual: int) -> int:
    """What a register holds."""
    found = entity.integer(key, 0, 65535)
    return usual if found is None else found


def _area(entity: Section, key: str, default: str, allowed: tuple[str, ...]) -> Area:
    return _AREAS[entity.word(key, allowed) or default]


def _sensor(places: Places, entity: Section) -> None:
    """Registers with a type."""
    area = _area(entity, "input_type", "holding", _REGISTERS)
    address, settings = _address(entity), _typed(entity)
    if address is None or settings is None:
        return
    scaled = _scaled(entity)
    if settings["type"].startswith("string"):
        for key in [key for key, value in scaled.items() if value is not None]:
            entity.left_out(key, "a text has none")
            scaled[key] = None
    if _is_constant(entity, scaled):
        return
    found = parsed(settings["type"])
    if found.count is not None:
        entity.desk.changed(entity.path, "a sensor for each value; the source had one text")
    settings |= {"type": found.element, **scaled}
    settings["unit"] = entity.text("unit_of_measurement")
    settings["null"] = _null(entity, found.element)
    settings |= _classes(entity, area, type=found.element, unit=settings["unit"] or "")
    size = register_count(found.element)
    for index in range((_copies(entity) + 1) * (found.count or 1)):
        name = f"{_name(entity)} {index}" if index else _name(entity)
        places.add(name, area, address + index * size, **_given(settings))


def _number(places: Places, entity: Section) -> None:
    """Holding registers with a number that is written, too."""
    entity.word("input_type", ("holding",))
    entity.word("data_type", _TYPES)
    limits = _limits(entity, "min_value", "max_value", (0, 100))
    is_multiple = entity.word("write_type", ("holding", "holdings")) == "holdings"
    known = len(places.tags)
    _sensor(places, entity)
    for each in places.tags[known:]:
        each.tag |= {"writable": True, **limits}
        if each.tag["type"] in INTEGERS:
            each.tag["round"] = "nearest"
        if register_count(each.tag["type"]) == 1:
            places.written[is_multiple].append(entity.path)


def _classes(entity: Section, area: Area, **settings: Any) -> dict[str, Any]:
    """The classes of an entity, but for those that its tag can't have."""
    classes: dict[str, Any] = {}
    for key in KNOWN:
        given = entity.get(key)
        word = given.strip().lower() if isinstance(given, str) else ""
        if is_class_word(word):
            classes[key] = word
        elif given is not None:
            entity.left_out(key, f"found {show(given)}, which is no class of Home Assistant")
    for key, flaw in list(flaws(Tag("tag", area, 0, **settings, **classes))):
        if classes[key] in KNOWN[key]:
            entity.left_out(key, flaw)
            del classes[key]
    return classes


def _copies(entity: Section) -> int:
    """How many sensors follow the first, each behind the one before it."""
    key = "virtual_count" if entity.get("virtual_count") is not None else "slave_count"
    return entity.integer(key, 0, 2000) or 0


def _given(settings: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in settings.items() if value not in (None, [], 0, "")}


def _scaled(entity: Section, prefix: str = "") -> dict[str, Any]:
    """Scale and offset, those of this value or those of the entity."""
    found: dict[str, Any] = {}
    for key, plain in (("scale", 1), ("offset", 0)):
        own = entity.number(f"{prefix}{key}") if prefix else None
        value = entity.number(key) if own is None else own
        found[key] = None if value == plain else value
    return found


def _is_constant(entity: Section, *scaled: dict[str, Any]) -> bool:
    """Whether a scale is 0, which no tag can have: such an entity is left out."""
    if all(each["scale"] != 0 for each in scaled):
        return False
    message = f"{_name(entity)} has a scale of 0, with which all numbers are one value: add a tag"
    entity.leave_out_all(message)
    return True


def _typed(entity: Section) -> dict[str, Any] | None:
    """Type, byte order and encoding; `None` if there is no such type here."""
    kinds = (*_TYPES, *_FORMER_TYPES, "string", "custom")
    count = entity.integer("count", 1, 125)
    kind = entity.word("data_type", kinds) or ("int16" if count is None else "int")
    structure = entity.text("structure")
    swap = entity.word("swap", tuple(_ORDERS)) or "none"
    if entity.flag("reverse_order"):
        swap = "word"
    if kind == "custom":
        return _structure(entity, structure, count, swap)
    if kind == "string":
        if count is None:
            message = "missing, allowed: the number of registers with the text"
            entity.problem_of_key("count", message)
            return None
        return {"type": f"string:{2 * count}", "order": _ORDERS[swap], **_UTF_8}
    if kind in _FORMER_TYPES and f"{kind}{16 * (count or 1)}" in _TYPES:
        kind = f"{kind}{16 * (count or 1)}"
    if kind not in _TYPES:
        entity.problem("count", f"found {count} with data_type {kind}, allowed: 1, 2 or 4")
        return None
    if count not in (None, register_count(kind)):
        message = f"found {count} with data_type {kind}, allowed: {register_count(kind)}"
        entity.problem("count", message)
    return {"type": kind, "order": _ORDERS[swap]}


def _structure(
    entity: Section, structure: str | None, count: int | None, swap: str
) -> dict[str, Any] | None:
    """The type of a structure with values of one kind."""
    found = _STRUCTURE.fullmatch(structure or "")
    number = int(found[2] or 1) if found else 0
    if found is None or not number:
        message = f"{_name(entity)} has the structure {show(structure)}, which is no type here"
        entity.leave_out_all(f"{message}: add a tag for each value")
        return None
    kind = _kind(found, number, count)
    if count not in (None, register_count(kind)):
        message = f"found {count} with this structure, allowed: {register_count(kind)}"
        entity.problem("count", message)
    if number > 1 and swap in ("word", "word_byte") and found[3] != "s":
        message = f"found {swap} with several values, whose order it changes, allowed: none or byte"
        entity.problem("swap", message)
    if found[3] == "s":
        return {"type": kind, "order": _ORDERS[swap], **_UTF_8}
    # Without a sign, the source used the order of its processor, which is the little one.
    orders = _ORDERS if found[1] in (">", "!") else _LITTLE_ORDERS
    return {"type": kind, "order": orders[swap]}


def _kind(found: re.Match[str], number: int, count: int | None) -> str:
    """The type of so many values of a structure."""
    if found[3] == "s":
        return f"string:{number}"
    kind = _CODES[found[3]]
    # Without a sign, a long is that of the processor: the count tells whether it has 64 bits.
    if found[3] in "lL" and found[1] in ("", "@") and count == 4 * number:
        kind = kind.replace("32", "64")
    return kind if number == 1 else f"{kind}[{number}]"


def _null(entity: Section, kind: str) -> list[int | float]:
    """The numbers that mean no value: the one given, and its negative, as in the source."""
    given = entity.get("nan_value")
    if given is None:
        return []
    try:
        number = int(given) if isinstance(given, str) else given
    except ValueError:
        number = _hexadecimal(given)
    if type(number) is not int:
        entity.problem("nan_value", f"found {show(given)}, allowed: an integer")
        return []
    if kind not in _TYPES:
        entity.left_out("nan_value", f"values of type {kind} have none")
        return []
    candidates = sorted({number, -number})
    if number == 0:
        entity.check("nan_value", "0 is no value, as in newer versions")
    return [each for each in candidates if _fits(each, kind)]


def _fits(number: int, kind: str) -> bool:
    try:
        encode(number, kind)
    except DoesNotFit:
        return False
    return True


def _hexadecimal(text: str) -> int | None:
    try:
        return int(text, 16)
    except ValueError:
        return None


def _binary_sensor(places: Places, entity: Section) -> None:
    """A bit, or the lowest bit of a register, and those that follow it."""
    kinds = ("coil", "discrete_input", *_REGISTERS)
    area = _area(entity, "input_type", "coil", kinds)
    address = _address(entity)
    if address is None:
        return
    settings = {} if area in _BITS else {"type": "bit:0"}
    settings |= _classes(entity, area, **settings)
    for index in range(_copies(entity) + 1):
        name = f"{_name(entity)} {index}" if index else _name(entity)
        places.add(name, area, address + index, **settings)


def _switch(places: Places, entity: Section) -> None:
    """A coil, or a register with a number for on and one for off; and where its state is read."""
    kinds = ("holding", "holdings", "coil", "coils")
    area = _area(entity, "write_type", "holding", kinds)
    address = _address(entity)
    on, off = _register(entity, "command_on", 1), _register(entity, "command_off", 0)
    verify = entity.mapping("verify")
    if address is None:
        return
    settings = _commands(entity, area, on, off)
    if settings is None:
        return
    places.written[entity.get("write_type") in ("holdings", "coils")].append(entity.path)
    classes = _classes(entity, area, **settings)
    places.add(_name(entity), area, address, **settings, **classes, writable=True)
    if "verify" not in entity.data:
        message = "its state is read from its address; the source did not read it"
        entity.desk.check(entity.path, message)
        return
    # An empty key reads the state, too.
    verify = verify or Section(entity.desk, entity.at("verify"), {})
    kind = verify.word("input_type", tuple(_AREAS))
    its_area = _AREAS[kind] if kind else area
    its_address = _address(verify, required=False)
    its_address = address if its_address is None else its_address
    its_on, its_off = _numbers(verify, "state_on") or [on], _numbers(verify, "state_off") or [off]
    if its_area in _BITS:
        its_on, its_off = [1], [0]  # The source read 1 as on, whatever it wrote.
    verify.integer("delay", 0, 86_400)  # A write that is confirmed is read back at once.
    verify.close()
    its_settings = _two_states(entity, its_area, its_on, its_off)
    if (its_area, its_address, its_settings) != (area, address, settings):
        places.add(f"{_name(entity)} state", its_area, its_address, **its_settings)
        entity.desk.changed(verify.path, "the state that is read is an entity of its own")


def _commands(entity: Section, area: Area, on: int, off: int) -> dict[str, Any] | None:
    """The settings of a tag that is written on and off; `None` if both are the same."""
    if area in _BITS:  # The source wrote every number but 0 as 1.
        on, off = min(on, 1), min(off, 1)
    if on == off:
        message = f"{_name(entity)} writes {on} for on and for off: add a tag"
        entity.desk.left_out(entity.path, message)
        return None
    return _two_states(entity, area, [on], [off])


def _numbers(entity: Section, key: str) -> list[int]:
    """An integer, or a list of them."""
    given = entity.get(key)
    values = given if isinstance(given, list) else [] if given is None else [given]
    values = [entity.as_number(value) for value in values]
    if all(type(value) is int and 0 <= value <= 65535 for value in values):
        return values
    entity.problem(key, f"found {show(given)}, allowed: integers from 0 to 65535")
    return []


def _two_states(entity: Section, area: Area, on: list[int], off: list[int]) -> dict[str, Any]:
    """A bit, or names for the numbers: all others of a register are neither on nor off."""
    if area in _BITS and (on, off) == ([1], [0]):
        return {}
    names = [*((number, "on") for number in on), *((number, "off") for number in off)]
    return _states(entity.desk, ((number, name, entity.path) for number, name in names))


def _states(desk: Desk, names: Iterable[tuple[int, str, KeyPath]]) -> dict[str, Any]:
    """Names for the numbers of a register; a number with several has the first."""
    states: dict[int, str] = {}
    for number, name, path in names:
        if number in states:
            desk.left_out(path, f"{name} is {number}, as {states[number]}")
        else:
            states[number] = f"{name} ({number})" if name in states.values() else name
    return {"states": dict(sorted(states.items()))}


def _cover(places: Places, entity: Section) -> None:
    """A coil, or a register with the numbers of open and closed."""
    area = _area(entity, "input_type", "holding", ("holding", "coil"))
    address = _address(entity)
    # closed and open are first: the source wrote them, and only them.
    defaults = {"closed": 0, "open": 1, "opening": 2, "closing": 3}
    numbers = [
        (_register(entity, f"state_{name}", usual), name, entity.at(f"state_{name}"))
        for name, usual in defaults.items()
    ]
    status = _address(entity, "status_register", required=False)
    status_area = _area(entity, "status_register_type", "holding", _REGISTERS)
    if address is None:
        return
    if status is None and area not in _BITS:
        status_area, status = area, address
    kind = "switch" if area in _BITS else "select"
    more = "" if status is None else " and a sensor"
    entity.desk.changed(entity.path, f"a {kind}{more} instead of a cover")
    settings: dict[str, Any] | None = {}
    if area not in _BITS:
        settings = _states(entity.desk, numbers[:2])
    elif status is not None:  # Without one, the source wrote 1 to open, whatever is given.
        settings = _commands(entity, area, on=numbers[1][0], off=numbers[0][0])
    if settings is not None:
        places.written[False].append(entity.path)
        places.add(_name(entity), area, address, **settings, writable=True)
    if status is not None:
        states = _states(entity.desk, numbers)
        places.add(f"{_name(entity)} status", status_area, status, **states)


def _climate(places: Places, entity: Section) -> None:
    """The temperature, its setpoint, and registers with modes."""
    area = _area(entity, "input_type", "holding", _REGISTERS)
    address, settings = _address(entity), _typed(entity)
    target = _numbers(entity, "target_temp_register")
    unit = {"F": "°F", "K": "K"}.get(entity.text("temperature_unit") or "C", "°C")
    limits = _limits(entity, "min_temp", "max_temp", (5, 35))
    current = _scaled(entity, "current_temp_")
    aim = _scaled(entity, "target_temp_")
    if not target:
        message = "missing, allowed: the address of the setpoint"
        entity.problem_of_key("target_temp_register", message)
    elif len(target) not in (1, len(_TARGET_MODES)):
        allowed = f"allowed: 1, or {len(_TARGET_MODES)}, for {', '.join(_TARGET_MODES)}"
        entity.problem("target_temp_register", f"found {len(target)} registers, {allowed}")
    for key in _MODES:
        _mode(places, entity, key, writable=True)
    _mode(places, entity, "hvac_action_register", writable=False)
    _power(places, entity)
    if settings is not None and settings["type"] not in _TYPES:
        message = f"values of type {settings['type']} are no temperatures: add a tag"
        entity.desk.left_out(entity.path, message)
        return
    if _is_constant(entity, current, aim) or address is None or settings is None or not target:
        return
    entity.desk.changed(entity.path, "a sensor, a number and selects instead of a thermostat")
    modes: dict[int, list[str]] = {}
    for mode, register in zip(_TARGET_MODES, target, strict=False):
        modes.setdefault(register, []).append(mode)
    if len(modes) > 1:
        message = "a number for each register, with its modes; the source used that of the mode"
        entity.changed("target_temp_register", message)
    places.add(_name(entity), area, address, **_given({**settings, **current, "unit": unit}))
    if register_count(settings["type"]) == 1:
        is_multiple = entity.flag("target_temp_write_registers") or False
        places.written[is_multiple].append(entity.at("target_temp_register"))
    written = {**_given({**settings, **aim, "unit": unit}), "writable": True, **limits}
    for register, names in modes.items():
        title = " ".join([_name(entity), "setpoint", *(names if len(modes) > 1 else ())])
        places.add(title, "holding_registers", register, **written)


def _limits(entity: Section, low: str, high: str, usual: tuple[float, float]) -> dict[str, float]:
    """The least and the greatest value that may be written."""
    least, most = entity.number(low), entity.number(high)
    limits = {
        "min": usual[0] if least is None else least,
        "max": usual[1] if most is None else most,
    }
    if limits["min"] > limits["max"]:
        if most is None:
            entity.problem(low, f"found {least}, allowed: up to {high}, {limits['max']}")
        else:
            entity.problem(high, f"found {most}, allowed: at least {low}, {limits['min']}")
    return limits


def _mode(places: Places, entity: Section, key: str, *, writable: bool) -> None:
    """A register with a number for each mode."""
    register = entity.mapping(key)
    if register is None:
        return
    given = _numbers(register, "address")
    values = register.mapping("values")
    area = _area(register, "input_type", "holding", _REGISTERS)
    if writable:
        # The source wrote with function 16 if the address of a fan or swing mode was a list.
        is_multiple = register.flag("write_registers") or isinstance(register.get("address"), list)
        places.written[is_multiple].append(register.path)
    register.close()
    if not given or values is None:
        entity.problem(key, "without address and values, allowed: with both")
        return
    names: list[tuple[str, Any]] = []
    for mode in values.data:
        try:
            names.append((check_state_name(_PREFIX.sub("", str(mode))), mode))
        except ValueError as error:
            values.problem(mode, str(error))
    names.sort(key=lambda each: _SEARCHED.index(each[0]) if each[0] in _SEARCHED else 99)
    found = [(_numbers(values, mode), name, values.at(mode)) for name, mode in names]
    read = _states(
        entity.desk, ((number, name, path) for numbers, name, path in found for number in numbers)
    )
    kind = key.removesuffix("_register").removeprefix("hvac_").replace("_", " ")
    title = f"{_name(entity)} {kind}"
    if not writable:
        places.add(title, area, given[0], **read)
        return
    firsts = ((numbers[0], name, path) for numbers, name, path in found if numbers)
    written = _states(entity.desk, firsts)
    places.add(title, area, given[0], **written, writable=True)
    if read != written:
        message = "the select has the first number of each mode, which the source wrote"
        entity.desk.changed(register.path, f"{message}; a sensor has all")
        places.add(f"{title} state", area, given[0], **read)


def _power(places: Places, entity: Section) -> None:
    """A register or a coil that turns a thermostat on."""
    coil = _address(entity, "hvac_onoff_coil", required=False)
    register = _address(entity, "hvac_onoff_register", required=False)
    on, off = _register(entity, "hvac_on_value", 1), _register(entity, "hvac_off_value", 0)
    name, is_multiple = f"{_name(entity)} power", entity.flag("write_registers") or False
    if coil is not None:
        places.written[False].append(entity.at("hvac_onoff_coil"))
        places.add(name, "coils", coil, writable=True)
    if register is not None:
        places.written[is_multiple].append(entity.at("hvac_onoff_register"))
        settings: dict[str, Any] = {"type": "bool"}  # Only 0 was off.
        if (on, off) != (1, 0):
            settings = _two_states(entity, "holding_registers", [on], [off])
        places.add(name, "holding_registers", register, **settings, writable=True)


PLATFORMS: dict[str, Entities] = {
    "sensors": _sensor,
    "numbers": _number,
    "binary_sensors": _binary_sensor,
    "switches": _switch,
    "lights": _switch,
    "fans": _switch,
    "covers": _cover,
    "climates": _climate,
}
"""The lists of a hub, and what their entities become."""

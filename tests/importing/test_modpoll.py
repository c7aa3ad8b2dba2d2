"""Importing modpoll: its references become tags that have the values that it had.

The values are those that modpoll 1.6.0 printed for the same registers and coils.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.config import load
from holdfast.importing import NotImportable, read_modpoll
from support import cli

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from holdfast.importing import Imported

NO_OUTPUT = (
    "1: : check: values are not published: add outputs for what the command line of modpoll says"
)

COILS = [int(each) for each in "10000000110000001110000011110000"]
REGISTERS = {
    **{0: 1000, 2: 0x0001, 3: 0x0203, 4: 0x3FC0, 6: 0x0201, 9: 0x8105},
    **{
        12: 0x4142,
        13: 0x4344,
        14: 0x4500,
        20: 0x3E00,
        23: 7,
        30: 1030,
        31: 1031,
        32: 1032,
        33: 1033,
    },
}

BITS = """\
device,plant,0x1,,
poll,coil,0,32,BE_BE
ref,c0,0,bool,rw
ref,c1,1,bool8,rw
ref,c2,2,bool16,r
poll,coil,3,20,LE_LE
ref,d0,3,bool,rw
ref,d1,4,bool16,r
poll,holding_register,0,40,LE_BE
ref,list,9,bool16,r
ref,swapped,6:0,bool,rw
poll,holding_register,0,40,BE_BE
ref,first,6:0,bool,rw
"""

NUMBERS = """\
device,plant,1,,
poll,holding_register,0,40,{order}
ref,n16,0,uint16,rw,V,0.1
ref,n32,0x2,int32,r
ref,real,4,float32,rw
ref,text,12,string5,r
ref,half,20,float16,r
ref,my power,23,uint16,,kW
ref,n64,30,uint64,r,
"""


@pytest.fixture(scope="module")
def server() -> Iterator[holdfast.Server]:
    memory = holdfast.Memory(coils=64, holding_registers=64)
    with holdfast.Server(bind="127.0.0.1:0", units={1: memory}, access="read-write") as server:
        with holdfast.SyncClient(cli.url(server)) as client:
            client.write_coils(0, COILS)
            for address, value in REGISTERS.items():
                client.write_register(address, value)
        yield server


@pytest.fixture
def read(tmp_path: Path, server: holdfast.Server) -> Callable[[str], Imported]:
    """Imports text; the result must be a valid configuration."""

    def imported(text: str) -> Imported:
        file = tmp_path / "plant.csv"
        file.write_text(text)
        found = read_modpoll(file, cli.url(server), 5)
        (tmp_path / "made.yaml").write_text(found.to_yaml())
        assert load(tmp_path / "made.yaml").warnings == ()
        return found

    return imported


def values(tmp_path: Path) -> list[Any]:
    """The values of the tags, read from the server."""
    found = cli.answer("read", "plant", "--config", str(tmp_path / "made.yaml"))["values"]
    assert isinstance(found, dict)
    return list(found.values())


def notes(found: Imported) -> list[str]:
    told = [f"{each.line}: {each.key}: {each.kind}: {each.message}" for each in found.notes]
    assert told[0] == NO_OUTPUT
    return told[1:]


def refusals(read: Callable[[str], Imported], text: str) -> list[str]:
    with pytest.raises(NotImportable) as refused:
        read(text)
    return [f"{each.line}: {each.message}" for each in refused.value.problems]


def test_a_device_is_polled_as_before(read: Callable[[str], Imported]) -> None:
    device = read(NUMBERS.format(order="BE_BE")).data["devices"]["plant"]
    assert {**device, "url": "", "tags": {}} == {
        **{"url": "", "unit": 1, "interval": 5, "timeout": 3, "max_gap": 6, "tags": {}}
    }
    area = {"area": "holding_registers"}
    scaled = {"scale": 0.1, "unit": "V", "writable": True}
    assert device["tags"]["n16"] == {**area, "address": 0, "type": "uint16", **scaled}
    assert device["tags"]["my_power"] == {**area, "address": 23, "type": "uint16", "unit": "kW"}


def test_a_tag_that_is_renamed_has_its_name_as_description(
    read: Callable[[str], Imported],
) -> None:
    text = "device,plant,1\npoll,coil,0,32,BE_BE\nref,Größe L1 °C,0,bool8,r\n"
    tags = read(text).data["devices"]["plant"]["tags"]
    assert (min(tags), tags[min(tags)]["description"]) == ("Gr__e_L1__C_0", "Größe_L1_°C_0")


@pytest.mark.parametrize(
    ("order", "expected"),
    [
        ("BE_BE", (100.0, 66051, 1.5, "ABCDE", 1.5, 7, 289923654190892041)),
        ("be_le", (100.0, 33751041, 0.0, "ABCDE", 1.5, 7, 290768083415925766)),
        ("LE_BE", (5939.5, 16777986, -2.984, "ABCDE", 0.0, 1792, 433479178030156036)),
        ("LE_LE", (5939.5, 50462976, 0.0, "ABCDE", 0.0, 1792, 649653059638789636)),
        (" BE_BE", (100.0, 33751041, 0.0, "ABCDE", 1.5, 7, 290768083415925766)),
    ],
)
def test_numbers_have_the_same_values(
    read: Callable[[str], Imported], tmp_path: Path, order: str, expected: tuple[Any, ...]
) -> None:
    found = read(NUMBERS.format(order=order))
    got = [round(each, 3) if isinstance(each, float) else each for each in values(tmp_path)]
    assert tuple(got) == expected
    told = "' BE_BE' is none of BE_BE, BE_LE, LE_BE, LE_LE: read as BE_LE, as in modpoll"
    assert notes(found) == [f"2: plant.poll: check: {told}"] * (order == " BE_BE")


def test_lists_of_bits_become_tags_with_the_same_values(
    read: Callable[[str], Imported], tmp_path: Path
) -> None:
    found = read(BITS)
    elements = "".join(str(int(each)) for each in values(tmp_path))
    c2, d1 = "0000011100001111", "111000000000"  # Without the last coils, which no poll reads.
    registers = "100000011010000001"
    assert elements == "0000000100000011" + c2 + "01100000" + d1 + registers
    assert notes(found)[0] == (
        "3: plant.c0: changed: a list of bits, the last bit of each byte first: c0_0 to c0_7, "
        "one tag for each"
    )
    tags = found.data["devices"]["plant"]["tags"]
    assert tags["c0_7"] == {"area": "coils", "address": 0, "type": "bool", "writable": True}
    assert "writable" not in tags["c2_0"]


def test_types_of_registers_take_more_bytes_of_coils_than_they_count(
    read: Callable[[str], Imported],
) -> None:
    rows = "ref,a,0,bool,r\nref,b,1,int32,r\nref,c,3,bool8,r\nref,u,4,uint8,r\nref,d,6,bool,r\n"
    found = read(f"device,plant,1\npoll,coil,0,64,BE_BE\n{rows}")
    tags = found.data["devices"]["plant"]["tags"]
    assert [tags[name]["address"] for name in ("a_7", "c_7", "d_7")] == [0, 40, 56]


@pytest.mark.parametrize(
    ("order", "expected", "left_out"),
    [
        ("BE_BE", "0000001111", ["late", "last"]),
        ("BE_LE", "0000001111", ["late", "last"]),
        ("LE_BE", "10000011100", ["late"]),
        ("LE_LE", "10000011100", ["late"]),
    ],
)
def test_one_bit_of_coils_is_that_of_two_bytes(
    read: Callable[[str], Imported],
    tmp_path: Path,
    order: str,
    expected: str,
    left_out: list[str],
) -> None:
    found = read(
        f"device,plant,1\npoll,coil,0,32,{order}\n"
        "ref,a,0:14,bool,rw\nref,list,1,bool8,r\nref,late,2:0,bool,r\n"
        f"poll,coil,0,32,{order}\nref,b,0:6,bool,r\n"
        f"poll,coil,8,12,{order}\nref,last,8:0,bool,r\n"
    )
    assert "".join(str(int(each)) for each in values(tmp_path)) == expected
    assert found.data["devices"]["plant"]["tags"]["a"]["writable"] is True
    told = {
        "late": "5: plant.late: left out: the reply ended before its byte; modpoll had no value",
        "last": "9: plant.last: left out: not in its poll, coil 23; modpoll had false",
    }
    assert [each for each in notes(found) if "left out" in each] == [told[it] for it in left_out]


def test_a_list_of_bits_ends_with_the_reply(read: Callable[[str], Imported]) -> None:
    found = read(
        "device,plant,1\npoll,coil,0,24,BE_BE\nref,a,0,bool16,r\nref,b,2,bool16,r\nref,c,4,bool16,r\n"
    )
    tags = found.data["devices"]["plant"]["tags"]
    assert [tag["address"] for name, tag in tags.items() if name.startswith("b_")] == [
        *range(23, 15, -1)
    ]
    told = "c: left out: the reply ended before its byte; modpoll had no value"
    assert [each for each in notes(found) if "left out" in each] == [f"5: plant.{told}"]


def test_what_the_source_did_not_read_is_left_out(read: Callable[[str], Imported]) -> None:
    found = read(
        "# plant of 2024\n"
        "ref,early,0,int16,r\n"
        "device,plant,1,,\n"
        "ref,early,0,int16,r\n"
        "poll,holding_register,0,10,BE_BE\n"
        "ref,one,0,int16,r\n"
        "ref,same,0,uint16,r\n"
        f"ref,far,9,string{'9' * 5000},r\n"
        "ref,set,2,int16,w\n"
        "ref,byte,3,uint8,r\n"
        "ref,short,4,int16\n"
        "#ref,two,5,int16,r,,2 %\n"
        "poll,holding,0,10,BE_BE\n"
        "ref,none,0,int16,r\n"
        "poll,coil,0,16,BE_BE\n"
        "ref,number,0,uint16,r\n"
        "ref,late,2,bool,r\n"
        "device,idle,2,,\n"
    )
    plant = found.data["devices"]["plant"]
    assert (list(found.data["devices"]), list(plant["tags"])) == (["plant"], ["one", "two"])
    assert notes(found) == [
        "2: early: left out: no device is above it",
        "4: plant.early: left out: no poll that is read is above it",
        "7: plant.same: left out: one has this address; modpoll read only the first reference",
        "8: plant.far: left out: not in its poll, holding_registers 0 to 9",
        "9: plant.set: left out: a reference that is not read; tags are",
        "10: plant.byte: left out: 'uint8' is no type; modpoll had no value",
        "11: plant.short: left out: a row of 4 cells, allowed: at least 5",
        "12: plant.two: check: '#ref' is a ref, as in modpoll",
        "12: plant.two: left out: '2 %' is no scale; modpoll ignored it",
        "13: plant.poll-2: left out: found 'holding', allowed: coil, discrete_input, "
        "holding_register, input_register; modpoll ignored it",
        "14: plant.none: left out: no poll that is read is above it",
        "16: plant.number: left out: 'uint16' is no type of coils here, allowed: bool, bool8, "
        "bool16",
        "17: plant.late: left out: the reply ended before its byte; modpoll had no value",
        "18: idle: left out: no reference of it is read",
    ]


def test_a_comment_that_is_no_device_ends_neither_device_nor_poll(
    read: Callable[[str], Imported],
) -> None:
    form = "# device,<device_name>,<device_id>\n"
    found = read(
        "# plant of 2024\n# device,typical,1 <- the first one\ndevice,plant,1\n"
        f"poll,holding_register,0,10,BE_BE\n{form}ref,one,0,int16,r\n#device,spare,2\n"
    )
    assert {name: list(each["tags"]) for name, each in found.data["devices"].items()} == {
        "plant": ["one"]
    }
    assert notes(found) == [
        "2: typical: left out: found '1 <- the first one', no unit id; modpoll ignored it",
        "5: '<device_name>': left out: found '<device_id>', no unit id; modpoll ignored it",
        "7: spare: check: '#device' is a device, as in modpoll",
        "7: spare: left out: no reference of it is read",
    ]


@pytest.mark.parametrize(
    ("second", "gap"),
    [(10, 7), (11, 1), (16, 6), (17, 7), (40, 7)],
    ids=["adjacent", "one between", "near", "as near as tags", "far"],
)
def test_addresses_that_no_poll_read_are_not_read(
    read: Callable[[str], Imported], second: int, gap: int
) -> None:
    found = read(
        "device,plant,1,,\npoll,holding_register,0,10,BE_BE\n"
        "ref,a,0,int16,r\nref,b,8,int16,r\n"
        f"poll,holding_register,{second},10,BE_BE\nref,c,{second},int16,r\n"
    )
    assert found.data["devices"]["plant"]["max_gap"] == gap


@pytest.mark.parametrize(
    ("second", "limits"),
    [
        ("holding_register,8,20", {"max_registers": 20}),
        ("holding_register,10,123", {"max_registers": 123}),
        ("holding_register,11,20", {}),
        ("holding_register,2,8", {}),
        ("input_register,10,20", {}),
        ("coil,20,40", {"max_bits": 40}),
    ],
    ids=["overlapping", "adjacent", "apart", "inside", "of another area", "bits"],
)
def test_requests_are_no_longer_than_those_of_the_source(
    read: Callable[[str], Imported], second: str, limits: dict[str, int]
) -> None:
    """A device may answer longer ones with exception 04, or not at all."""
    kind = "bool16" if "coil" in second else "uint16"
    start = second.split(",")[1]
    found = read(
        "device,plant,1\npoll,coil,0,20,BE_BE\nref,a,0,bool,r\n"
        "poll,holding_register,0,10,BE_BE\nref,b,9,uint16,r\n"
        f"poll,{second},BE_BE\nref,c,{start},{kind},r\n"
    )
    device = found.data["devices"]["plant"]
    assert {key: device[key] for key in ("max_registers", "max_bits") if key in device} == limits


def test_of_equal_names_in_a_device_the_last_one_has_the_value(
    read: Callable[[str], Imported], tmp_path: Path
) -> None:
    found = read(
        "device,plant,1\n"
        "poll,coil,0,32,BE_BE\nref,power,0,bool,rw\nref,run,1,bool8,r\n"
        "poll,holding_register,0,40,BE_BE\nref,power,30,uint16,r\nref,my power,31,uint16,r\n"
        "poll,holding_register,20,20,BE_BE\nref,power,33,uint16,rw\nref,my_power,32,uint16,r\n"
    )
    run, numbers = [False] * 6 + [True] * 2, [1033, 1032]
    assert values(tmp_path) == [*run, *numbers]
    tags = found.data["devices"]["plant"]["tags"]
    assert [name for name in tags if not name.startswith("run")] == ["power", "my_power"]
    told = "left out: line {} has this name, too: the last counts, as in modpoll"
    assert [each for each in notes(found) if "left out" in each] == [
        f"3: plant.power: {told.format(9)}",
        f"6: plant.power-2: {told.format(9)}",
        f"7: plant.'my power': {told.format(10)}",
    ]


def test_names_are_unique(read: Callable[[str], Imported]) -> None:
    rows = "poll,holding_register,0,10,BE_BE\nref,a#b,0,int16,r\nref,a_b,1,int16,r\n"
    found = read(f"device,plant,1,,\n{rows}device,plant,2,,\n{rows}device,1. Stock,3,,\n{rows}")
    devices = found.data["devices"]
    assert list(devices) == ["plant", "plant-2", "1._Stock"]
    assert [list(each["tags"]) for each in devices.values()] == [["a_b-2", "a_b"]] * 3
    assert [each["unit"] for each in devices.values()] == [1, 2, 3]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "1: no device with a reference that is read, allowed: at least one"),
        ("device,plant,1,,\n", "1: no device with a reference that is read, allowed: at least one"),
        (
            "device,plant,300,,\n",
            "1: found '300', allowed: device,NAME,UNIT, with a unit id from 0 to 255",
        ),
        (
            "device,plant\n",
            "1: found 2 cells, allowed: device,NAME,UNIT, with a unit id from 0 to 255",
        ),
        (
            "device,a,1\npoll,coil,0,8,BE_BE\nref,x,0:16,bool,r\n",
            "3: found '0:16' of type 'bool', allowed: an address, or with the type bool "
            "address:bit, bit 0 to 15",
        ),
        (
            "device,a,1\npoll,holding_register,0,8,BE_BE\nref,x,0:1,int16,r\n",
            "3: found '0:1' of type 'int16', allowed: an address, or with the type bool "
            "address:bit, bit 0 to 15",
        ),
        (
            "device,a,1\npoll,holding_register,0,8,BE_BE\nref,x,0,int16,r,,inf\n",
            "3: found the scale 'inf', allowed: a number",
        ),
    ],
)
def test_mistakes_are_refused(read: Callable[[str], Imported], text: str, told: str) -> None:
    assert refusals(read, text) == [told]


def test_the_command_takes_what_the_command_line_of_the_source_says(
    tmp_path: Path,
) -> None:
    (tmp_path / "plant.csv").write_text(NUMBERS.format(order="BE_BE"))
    call = ("import", "modpoll", str(tmp_path / "plant.csv"))
    config = cli.answer(*call, "--url", "10.0.0.5", "--interval", "2")["config"]
    assert isinstance(config, dict)
    device = config["devices"]["plant"]
    assert (device["url"], device["interval"]) == ("tcp://10.0.0.5", 2)
    assert "Missing option '--url'." in cli.usage_error(*call)

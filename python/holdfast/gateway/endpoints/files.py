"""The endpoints for records of files, and for queues."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.gateway.endpoint import EXAMPLE, REGISTERS, Endpoint, always
from holdfast.gateway.fields import ADDRESS, ADDRESS_SCHEMA, REGISTER, WRITE_TIMEOUT_MS
from holdfast.net.http.fields import Field, malformed
from holdfast.net.http.schemas import array, integer
from holdfast.protocol import LAST_RECORD, MAX_WORD, READ_RECORDS, WRITE_RECORDS

if TYPE_CHECKING:
    from holdfast.gateway.device import RequestedDevice
    from holdfast.gateway.endpoint import Answer, Given

_FILE = Field("file", integer(1, MAX_WORD), "The number of the file")
_RECORD = Field("record", integer(0, LAST_RECORD), "The first record")
_QUANTITY = Field("quantity", integer(1, READ_RECORDS), "The number of records", 1)
_PLACE = {_FILE.name: _FILE.schema, _RECORD.name: _RECORD.schema}


async def _read(given: Given, device: RequestedDevice) -> Answer:
    file, record, quantity = given["file"], given["record"], given["quantity"]
    _check_end(record, quantity)
    found = await device.ask(lambda client: client.read_file_record(file, record, quantity))
    return {"file": file, "record": record, "values": found}


async def _write(given: Given, device: RequestedDevice) -> Answer:
    file, record, values = given["file"], given["record"], given["values"]
    _check_end(record, len(values))
    await device.ask(lambda client: client.write_file_record(file, record, values))
    return {"file": file, "record": record, "quantity": len(values)}


async def _queue(given: Given, device: RequestedDevice) -> Answer:
    address = given["address"]
    found = await device.ask(lambda client: client.read_fifo_queue(address))
    return {"address": address, "values": found}


def _check_end(record: int, count: int) -> None:
    if record + count > LAST_RECORD + 1:
        raise malformed(f"{count} from record {record}: the last record is {LAST_RECORD}")


ENDPOINTS = (
    Endpoint(
        path="/api/modbus/read/file",
        name="readFile",
        summary="Read records of a file",
        description="Function 20. A record is one register.",
        fields=(_FILE, _RECORD, _QUANTITY),
        execute=_read,
        properties={**_PLACE, "values": REGISTERS},
        examples={"Two records": {**EXAMPLE, "file": 4, "record": 1, "quantity": 2}},
        answer={"file": 4, "record": 1, "values": [3582, 32]},
    ),
    Endpoint(
        path="/api/modbus/write/file",
        name="writeFile",
        summary="Write records of a file",
        description="Function 21. A record is one register.",
        fields=(
            _FILE,
            _RECORD,
            Field("values", array(REGISTER, WRITE_RECORDS), f"Up to {WRITE_RECORDS} records"),
        ),
        execute=_write,
        properties={**_PLACE, "quantity": integer(1, WRITE_RECORDS)},
        examples={"Two records": {**EXAMPLE, "file": 4, "record": 7, "values": [1711, 1214]}},
        answer={"file": 4, "record": 7, "quantity": 2},
        writes=always,
        broadcast=True,
        timeout_ms=WRITE_TIMEOUT_MS,
    ),
    Endpoint(
        path="/api/modbus/read/fifo",
        name="readFifo",
        summary="Read a queue",
        description="Function 24. The registers stay in the queue.",
        fields=(ADDRESS,),
        execute=_queue,
        properties={"address": ADDRESS_SCHEMA, "values": REGISTERS},
        examples={"The queue at 1246": {**EXAMPLE, "address": 1246}},
        answer={"address": 1246, "values": [440, 4740]},
    ),
)

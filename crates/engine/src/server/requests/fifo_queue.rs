//! Function 24: a queue in the holding registers of a memory (V1.1b3, 6.18). The register of the queue
//! contains the number of those after it that belong to the queue.

use holdfast_memory::{Access, Area, Memory, Read};
use holdfast_protocol::pdu::{Buffer, ExceptionCode, limit, reply};

use crate::items::Items;
use crate::server::requests::exceptions::{exception_of, out_of_ranges};
use crate::server::rights::peer_rights::PeerRights;

/// The most registers of a queue, with that of the count.
const MAX_REGISTERS: usize = 1 + limit::QUEUE_REGISTERS as usize;

/// Reads all registers that the queue may have at one moment, under the checks of any other read.
pub(in crate::server) fn read(
    rights: &PeerRights,
    unit_id: u8,
    memory: &Memory,
    address: u16,
    reply: &mut Buffer,
) -> Result<usize, ExceptionCode> {
    let area = Area::HoldingRegisters;
    let behind = memory.span(area).end().saturating_sub(address.into());
    let count = MAX_REGISTERS.min(behind as usize);
    let items = Items { area, address, count: count as u32 };
    let is_allowed = rights.ranges(unit_id).is_none_or(|ranges| ranges.allow_read(items));
    if count == 0 || !is_allowed || !rights.has_queue(unit_id, address) {
        return Err(out_of_ranges(memory));
    }
    let mut bytes = [0; 2 * MAX_REGISTERS];
    let read = Read { area, address, count, out: &mut bytes[..2 * count] };
    memory.read(Access::Client, read).map_err(exception_of)?;
    let registers: [u16; MAX_REGISTERS] =
        std::array::from_fn(|at| u16::from_be_bytes([bytes[2 * at], bytes[2 * at + 1]]));
    match registers[1..].get(..usize::from(registers[0])) {
        None => Err(ExceptionCode::IllegalDataValue),
        Some(queue) if queue.len() >= count => Err(ExceptionCode::IllegalDataAddress),
        Some(queue) => reply::read_fifo_queue(queue, reply).ok_or(ExceptionCode::IllegalDataValue),
    }
}

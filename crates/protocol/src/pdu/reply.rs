//! Replies, written by a server at the start of the buffer that is sent. Each function returns the
//! length of the PDU. The arguments are the parts of the request that the reply repeats.

use super::request::{coil, put_words};
use super::{
    BitRange, Bits, Buffer, Diagnostics, ExceptionCode, FileRange, FileRanges, FileRecords,
    Function, MAX_LEN, RegisterRange, Registers, Request, SubFunction, limit, pack_registers,
};

/// The most bytes of a [`server_id`].
pub const MAX_SERVER_ID_LEN: usize = MAX_LEN - HEAD_LEN;

/// Function code and byte count.
const HEAD_LEN: usize = 2;

/// Refuses a request: the function code with its high bit set, and the exception code (V1.1b3, 7).
///
/// ```
/// use holdfast_protocol::pdu::{self, ExceptionCode, reply};
///
/// let mut pdu = [0; pdu::MAX_LEN];
/// let len = reply::exception(3, ExceptionCode::IllegalDataAddress, &mut pdu);
/// assert_eq!(pdu[..len], [0x83, 2]);
/// ```
pub fn exception(function_code: u8, code: ExceptionCode, pdu: &mut Buffer) -> usize {
    pdu[0] = function_code | 0x80;
    pdu[1] = code.code();
    2
}

/// Answers function 1. Returns the place for the coils, which the caller must fill, and the length
/// of the reply.
///
/// The place has [`BitRange::byte_len`] bytes, and the bytes have no defined value: write all of
/// them, with unused bits 0. [`pack_bits`](super::pack_bits) does that.
///
/// ```
/// use holdfast_protocol::pdu::{self, BitRange, pack_bits, reply};
///
/// let mut pdu = [0; pdu::MAX_LEN];
/// let (room, len) = reply::read_coils(BitRange::new(0, 3).unwrap(), &mut pdu);
/// pack_bits(&[true, false, true], room);
/// assert_eq!(pdu[..len], [1, 1, 0b101]);
/// ```
#[inline]
pub fn read_coils(range: BitRange, pdu: &mut Buffer) -> (&mut [u8], usize) {
    counted(Function::ReadCoils, range.byte_len(), pdu)
}

/// Answers function 2, as [`read_coils`] does function 1.
#[inline]
pub fn read_discrete_inputs(range: BitRange, pdu: &mut Buffer) -> (&mut [u8], usize) {
    counted(Function::ReadDiscreteInputs, range.byte_len(), pdu)
}

/// Answers function 3. Returns the place for the registers, which the caller must fill, and the
/// length of the reply.
///
/// The place has [`RegisterRange::byte_len`] bytes, two for each register, the high byte first. The
/// bytes have no defined value: write all of them. [`pack_registers`] does
/// that.
///
/// ```
/// use holdfast_protocol::pdu::{self, RegisterRange, pack_registers, reply};
///
/// let mut pdu = [0; pdu::MAX_LEN];
/// let range = RegisterRange::new(0, 2).unwrap();
/// let (room, len) = reply::read_holding_registers(range, &mut pdu);
/// pack_registers(&[10, 258], room);
/// assert_eq!(pdu[..len], [3, 4, 0, 10, 1, 2]);
/// ```
#[inline]
pub fn read_holding_registers(range: RegisterRange, pdu: &mut Buffer) -> (&mut [u8], usize) {
    counted(Function::ReadHoldingRegisters, range.byte_len(), pdu)
}

/// Answers function 4, as [`read_holding_registers`] does function 3.
#[inline]
pub fn read_input_registers(range: RegisterRange, pdu: &mut Buffer) -> (&mut [u8], usize) {
    counted(Function::ReadInputRegisters, range.byte_len(), pdu)
}

/// Answers function 23, as [`read_holding_registers`] does function 3. `range` is the range to read.
#[inline]
pub fn read_write_multiple_registers(range: RegisterRange, pdu: &mut Buffer) -> (&mut [u8], usize) {
    counted(Function::ReadWriteMultipleRegisters, range.byte_len(), pdu)
}

/// Answers function 5 with the address and value of its request.
///
/// ```
/// use holdfast_protocol::pdu::{self, Request, reply};
///
/// let request = [5, 0, 172, 0xFF, 0];
/// let Ok(Request::WriteSingleCoil { address, value }) = Request::parse(&request) else {
///     unreachable!()
/// };
/// let mut pdu = [0; pdu::MAX_LEN];
/// let len = reply::write_single_coil(address, value, &mut pdu);
/// assert_eq!(pdu[..len], request);
/// ```
#[inline]
pub fn write_single_coil(address: u16, value: bool, pdu: &mut Buffer) -> usize {
    words(Function::WriteSingleCoil, [address, coil(value)], pdu)
}

/// Answers function 6 with the address and value of its request.
#[inline]
pub fn write_single_register(address: u16, value: u16, pdu: &mut Buffer) -> usize {
    words(Function::WriteSingleRegister, [address, value], pdu)
}

/// Answers function 15 with the address and quantity of its request.
///
/// ```
/// use holdfast_protocol::pdu::{self, Request, reply};
///
/// let request = [15, 0, 19, 0, 10, 2, 0xCD, 0x01];
/// let Ok(Request::WriteMultipleCoils { address, bits }) = Request::parse(&request) else {
///     unreachable!()
/// };
/// let mut pdu = [0; pdu::MAX_LEN];
/// let len = reply::write_multiple_coils(address, bits, &mut pdu);
/// assert_eq!(pdu[..len], [15, 0, 19, 0, 10]);
/// ```
#[inline]
pub fn write_multiple_coils(
    address: u16,
    bits: Bits<'_, { limit::WRITE_BITS }>,
    pdu: &mut Buffer,
) -> usize {
    words(Function::WriteMultipleCoils, [address, bits.quantity()], pdu)
}

/// Answers function 16 with the address and quantity of its request.
#[inline]
pub fn write_multiple_registers(
    address: u16,
    registers: Registers<'_, { limit::WRITE_REGISTERS }>,
    pdu: &mut Buffer,
) -> usize {
    words(Function::WriteMultipleRegisters, [address, registers.quantity()], pdu)
}

/// Answers function 22 with the address and masks of its request.
#[inline]
pub fn mask_write_register(address: u16, and_mask: u16, or_mask: u16, pdu: &mut Buffer) -> usize {
    words(Function::MaskWriteRegister, [address, and_mask, or_mask], pdu)
}

/// Answers a sub-function of Diagnostics that sends the request back (function 8).
///
/// ```
/// use holdfast_protocol::pdu::{self, Request, reply};
///
/// let request = [8, 0, 0, 0xA5, 0x37];
/// let Ok(Request::Diagnostics(query)) = Request::parse(&request) else { unreachable!() };
/// let mut pdu = [0; pdu::MAX_LEN];
/// let len = reply::diagnostics_echo(query, &mut pdu);
/// assert_eq!(pdu[..len], request);
/// ```
pub fn diagnostics_echo(query: Diagnostics<'_>, pdu: &mut Buffer) -> usize {
    Request::Diagnostics(query).encode(pdu)
}

/// Answers a sub-function of Diagnostics that reads a counter or register (function 8).
///
/// ```
/// use holdfast_protocol::pdu::{self, SubFunction, reply};
///
/// let mut pdu = [0; pdu::MAX_LEN];
/// let len = reply::diagnostics(SubFunction::ReturnBusMessageCount, 258, &mut pdu);
/// assert_eq!(pdu[..len], [8, 0, 0x0B, 1, 2]);
/// ```
pub fn diagnostics(sub_function: SubFunction, data: u16, pdu: &mut Buffer) -> usize {
    words(Function::Diagnostics, [sub_function.code(), data], pdu)
}

/// Answers function 11: status and event count. `busy` says whether the server still processes a
/// program command.
///
/// ```
/// use holdfast_protocol::pdu::{self, reply};
///
/// let mut pdu = [0; pdu::MAX_LEN];
/// let len = reply::event_counter(false, 264, &mut pdu);
/// assert_eq!(pdu[..len], [11, 0, 0, 1, 8]);
/// ```
pub fn event_counter(busy: bool, events: u16, pdu: &mut Buffer) -> usize {
    words(Function::GetCommEventCounter, [if busy { 0xFFFF } else { 0 }, events], pdu)
}

/// Answers function 7: eight outputs, the lowest bit first.
///
/// ```
/// use holdfast_protocol::pdu::{self, reply};
///
/// let mut pdu = [0; pdu::MAX_LEN];
/// let len = reply::exception_status(0b0110_1101, &mut pdu);
/// assert_eq!(pdu[..len], [7, 0x6D]);
/// ```
pub fn exception_status(outputs: u8, pdu: &mut Buffer) -> usize {
    pdu[0] = Function::ReadExceptionStatus.code();
    pdu[1] = outputs;
    2
}

/// Answers function 12: status, event count, message count and one byte for each event, the latest
/// first. `None` for more than [`limit::LOG_EVENTS`] events.
///
/// ```
/// use holdfast_protocol::pdu::{self, reply};
///
/// let mut pdu = [0; pdu::MAX_LEN];
/// let len = reply::event_log(false, 264, 289, &[0x20, 0x00], &mut pdu).unwrap();
/// assert_eq!(pdu[..len], [12, 8, 0, 0, 0x01, 0x08, 0x01, 0x21, 0x20, 0x00]);
/// assert_eq!(reply::event_log(false, 264, 289, &[0; 65], &mut pdu), None);
/// ```
pub fn event_log(
    busy: bool,
    events: u16,
    messages: u16,
    log: &[u8],
    pdu: &mut Buffer,
) -> Option<usize> {
    if log.len() > usize::from(limit::LOG_EVENTS) {
        return None;
    }
    let (room, len) = counted(Function::GetCommEventLog, 6 + log.len(), pdu);
    let (counts, rest) = room.split_at_mut(6);
    pack_registers(&[if busy { 0xFFFF } else { 0 }, events, messages], counts);
    rest.copy_from_slice(log);
    Some(len)
}

/// Answers function 20. `fill` writes the records of each range, two bytes each, the high byte first.
/// The bytes have no defined value before: write all of them.
///
/// ```
/// use holdfast_protocol::pdu::{self, Request, pack_registers, reply};
///
/// let request = [20, 7, 6, 0, 4, 0, 1, 0, 2];
/// let Ok(Request::ReadFileRecord(ranges)) = Request::parse(&request) else { unreachable!() };
/// let mut pdu = [0; pdu::MAX_LEN];
/// let fill = |_, records: &mut [u8]| pack_registers(&[0x0DFE, 0x0020], records);
/// let len = reply::read_file_record(ranges, fill, &mut pdu);
/// assert_eq!(pdu[..len], [20, 6, 5, 6, 0x0D, 0xFE, 0x00, 0x20]);
/// ```
pub fn read_file_record(
    ranges: FileRanges<'_>,
    fill: impl FnMut(FileRange, &mut [u8]),
    pdu: &mut Buffer,
) -> usize {
    let (room, len) = counted(Function::ReadFileRecord, ranges.reply_len(), pdu);
    ranges.reply(room, fill);
    len
}

/// Answers function 21 with the whole request.
pub fn write_file_record(records: FileRecords<'_>, pdu: &mut Buffer) -> usize {
    Request::WriteFileRecord(records).encode(pdu)
}

/// Answers function 24 with the registers of the queue, in its order. `None` for more than
/// [`limit::QUEUE_REGISTERS`]: exception 03 is the answer then.
///
/// ```
/// use holdfast_protocol::pdu::{self, reply};
///
/// let mut pdu = [0; pdu::MAX_LEN];
/// let len = reply::read_fifo_queue(&[0x01B8, 0x1284], &mut pdu).unwrap();
/// assert_eq!(pdu[..len], [24, 0, 6, 0, 2, 0x01, 0xB8, 0x12, 0x84]);
/// assert_eq!(reply::read_fifo_queue(&[0; 32], &mut pdu), None);
/// ```
pub fn read_fifo_queue(registers: &[u16], pdu: &mut Buffer) -> Option<usize> {
    let quantity = u16::try_from(registers.len()).ok().filter(|n| *n <= limit::QUEUE_REGISTERS)?;
    let head = words(Function::ReadFifoQueue, [2 + 2 * quantity, quantity], pdu);
    let len = head + registers.len() * 2;
    pack_registers(registers, &mut pdu[head..len]);
    Some(len)
}

/// Answers function 17: server id, run indicator and additional data. `None` when `id` and `additional`
/// together, with one byte for the run indicator, are longer than [`MAX_SERVER_ID_LEN`].
///
/// ```
/// use holdfast_protocol::pdu::{self, reply};
///
/// let mut pdu = [0; pdu::MAX_LEN];
/// let len = reply::server_id(&[7], true, b"pump", &mut pdu).unwrap();
/// assert_eq!(&pdu[..len], b"\x11\x06\x07\xFFpump");
/// assert_eq!(reply::server_id(&[7], true, &[0; 250], &mut pdu), None);
/// ```
pub fn server_id(id: &[u8], running: bool, additional: &[u8], pdu: &mut Buffer) -> Option<usize> {
    let count = id.len().checked_add(1)?.checked_add(additional.len())?;
    if count > MAX_SERVER_ID_LEN {
        return None;
    }
    let (room, len) = counted(Function::ReportServerId, count, pdu);
    let (before, after) = room.split_at_mut(id.len());
    before.copy_from_slice(id);
    if let [indicator, rest @ ..] = after {
        *indicator = if running { 0xFF } else { 0x00 };
        rest.copy_from_slice(additional);
    }
    Some(len)
}

/// A reply that is a function code and some words.
#[inline]
fn words<const N: usize>(function: Function, words: [u16; N], pdu: &mut Buffer) -> usize {
    pdu[0] = function.code();
    put_words(pdu, words)
}

/// The head of a reply that carries `count` bytes, and the place for them.
#[inline]
fn counted(function: Function, count: usize, pdu: &mut Buffer) -> (&mut [u8], usize) {
    debug_assert!(count <= MAX_SERVER_ID_LEN);
    let len = HEAD_LEN + count;
    pdu[0] = function.code();
    pdu[1] = count as u8;
    (&mut pdu[HEAD_LEN..len], len)
}

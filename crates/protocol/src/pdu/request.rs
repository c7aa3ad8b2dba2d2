//! Requests: parsed by a server, encoded by a client (V1.1b3, 6).
//!
//! Parsing makes the first two checks of the order that the standard draws: the function must be
//! known (exception 01), then form, quantity and value must be right (exception 03).

use super::identification::{self, ReadCode};
use super::{Buffer, Diagnostics, ExceptionCode, Function, limit};

/// `quantity` items from `address`. The quantity is within the limits of its function; the end may
/// be beyond the last address, which is for the memory to say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Range {
    pub address: u16,
    pub quantity: u16,
}

/// One request. Registers are big-endian bytes, bits packed least significant bit first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Request<'a> {
    ReadCoils(Range),
    ReadDiscreteInputs(Range),
    ReadHoldingRegisters(Range),
    ReadInputRegisters(Range),
    WriteSingleCoil { address: u16, value: bool },
    WriteSingleRegister { address: u16, value: u16 },
    Diagnostics(Diagnostics<'a>),
    GetCommEventCounter,
    WriteMultipleCoils { range: Range, bits: &'a [u8] },
    WriteMultipleRegisters { range: Range, registers: &'a [u8] },
    ReportServerId,
    MaskWriteRegister { address: u16, and_mask: u16, or_mask: u16 },
    ReadWriteMultipleRegisters { read: Range, write: Range, registers: &'a [u8] },
    ReadDeviceIdentification { code: ReadCode, object_id: u8 },
}

impl<'a> Request<'a> {
    /// # Errors
    /// [`ExceptionCode::IllegalFunction`] for a function or sub-function that is not known here,
    /// [`ExceptionCode::IllegalDataValue`] for a PDU that is too short or too long, a quantity out
    /// of its limits, a byte count that does not agree with it, or a value that can't be.
    #[inline]
    pub fn parse(pdu: &'a [u8]) -> Result<Request<'a>, ExceptionCode> {
        let (&code, body) = pdu.split_first().ok_or(ExceptionCode::IllegalDataValue)?;
        let function = Function::from_code(code).ok_or(ExceptionCode::IllegalFunction)?;
        Ok(match function {
            Function::ReadCoils => Request::ReadCoils(range(body, limit::READ_BITS)?),
            Function::ReadDiscreteInputs => {
                Request::ReadDiscreteInputs(range(body, limit::READ_BITS)?)
            }
            Function::ReadHoldingRegisters => {
                Request::ReadHoldingRegisters(range(body, limit::READ_REGISTERS)?)
            }
            Function::ReadInputRegisters => {
                Request::ReadInputRegisters(range(body, limit::READ_REGISTERS)?)
            }
            Function::WriteSingleCoil => {
                let [address, value] = words(body)?;
                let value = match value {
                    0xFF00 => true,
                    0x0000 => false,
                    _ => return Err(ExceptionCode::IllegalDataValue),
                };
                Request::WriteSingleCoil { address, value }
            }
            Function::WriteSingleRegister => {
                let [address, value] = words(body)?;
                Request::WriteSingleRegister { address, value }
            }
            Function::Diagnostics => Request::Diagnostics(Diagnostics::parse(body)?),
            Function::GetCommEventCounter => {
                empty(body)?;
                Request::GetCommEventCounter
            }
            Function::WriteMultipleCoils => {
                let (head, bits) = counted(body)?;
                let range = range(head, limit::WRITE_BITS)?;
                agree(bits, usize::from(range.quantity).div_ceil(8))?;
                Request::WriteMultipleCoils { range, bits }
            }
            Function::WriteMultipleRegisters => {
                let (head, registers) = counted(body)?;
                let range = range(head, limit::WRITE_REGISTERS)?;
                agree(registers, usize::from(range.quantity) * 2)?;
                Request::WriteMultipleRegisters { range, registers }
            }
            Function::ReportServerId => {
                empty(body)?;
                Request::ReportServerId
            }
            Function::MaskWriteRegister => {
                let [address, and_mask, or_mask] = words(body)?;
                Request::MaskWriteRegister { address, and_mask, or_mask }
            }
            Function::ReadWriteMultipleRegisters => {
                let (read, rest) =
                    body.split_at_checked(4).ok_or(ExceptionCode::IllegalDataValue)?;
                let (head, registers) = counted(rest)?;
                let read = range(read, limit::READ_REGISTERS)?;
                let write = range(head, limit::READ_WRITE_REGISTERS)?;
                agree(registers, usize::from(write.quantity) * 2)?;
                Request::ReadWriteMultipleRegisters { read, write, registers }
            }
            Function::EncapsulatedInterface => {
                let (code, object_id) = identification::parse_request(body)?;
                Request::ReadDeviceIdentification { code, object_id }
            }
        })
    }

    /// Writes the request at the start of `pdu` and returns its length, 1 to [`super::MAX_LEN`].
    /// `None` when a quantity is out of the function's limits, or the data does not agree with it.
    pub fn encode(&self, pdu: &mut Buffer) -> Option<usize> {
        let mut out = Out { pdu, len: 0 };
        out.byte(self.function().code())?;
        match *self {
            Request::ReadCoils(range)
            | Request::ReadDiscreteInputs(range)
            | Request::ReadHoldingRegisters(range)
            | Request::ReadInputRegisters(range) => out.words(&[range.address, range.quantity])?,
            Request::WriteSingleCoil { address, value } => {
                out.words(&[address, if value { 0xFF00 } else { 0x0000 }])?;
            }
            Request::WriteSingleRegister { address, value } => out.words(&[address, value])?,
            Request::Diagnostics(Diagnostics { sub_function, data }) => {
                out.words(&[sub_function.code()])?;
                out.bytes(data)?;
            }
            Request::GetCommEventCounter | Request::ReportServerId => {}
            Request::WriteMultipleCoils { range, bits: data }
            | Request::WriteMultipleRegisters { range, registers: data } => {
                out.words(&[range.address, range.quantity])?;
                out.byte(u8::try_from(data.len()).ok()?)?;
                out.bytes(data)?;
            }
            Request::MaskWriteRegister { address, and_mask, or_mask } => {
                out.words(&[address, and_mask, or_mask])?;
            }
            Request::ReadWriteMultipleRegisters { read, write, registers } => {
                out.words(&[read.address, read.quantity, write.address, write.quantity])?;
                out.byte(u8::try_from(registers.len()).ok()?)?;
                out.bytes(registers)?;
            }
            Request::ReadDeviceIdentification { code, object_id } => {
                out.bytes(&[identification::MEI_TYPE, code.code(), object_id])?;
            }
        }
        let len = out.len;
        // The checks of a server are those of a client: what it would refuse is not sent.
        (Request::parse(pdu.get(..len)?) == Ok(*self)).then_some(len)
    }

    pub const fn function(&self) -> Function {
        match self {
            Request::ReadCoils(_) => Function::ReadCoils,
            Request::ReadDiscreteInputs(_) => Function::ReadDiscreteInputs,
            Request::ReadHoldingRegisters(_) => Function::ReadHoldingRegisters,
            Request::ReadInputRegisters(_) => Function::ReadInputRegisters,
            Request::WriteSingleCoil { .. } => Function::WriteSingleCoil,
            Request::WriteSingleRegister { .. } => Function::WriteSingleRegister,
            Request::Diagnostics(_) => Function::Diagnostics,
            Request::GetCommEventCounter => Function::GetCommEventCounter,
            Request::WriteMultipleCoils { .. } => Function::WriteMultipleCoils,
            Request::WriteMultipleRegisters { .. } => Function::WriteMultipleRegisters,
            Request::ReportServerId => Function::ReportServerId,
            Request::MaskWriteRegister { .. } => Function::MaskWriteRegister,
            Request::ReadWriteMultipleRegisters { .. } => Function::ReadWriteMultipleRegisters,
            Request::ReadDeviceIdentification { .. } => Function::EncapsulatedInterface,
        }
    }
}

/// Exactly `N` big-endian words.
#[inline]
fn words<const N: usize>(body: &[u8]) -> Result<[u16; N], ExceptionCode> {
    let (pairs, rest) = body.as_chunks::<2>();
    match <&[[u8; 2]; N]>::try_from(pairs) {
        Ok(pairs) if rest.is_empty() => Ok(pairs.map(u16::from_be_bytes)),
        _ => Err(ExceptionCode::IllegalDataValue),
    }
}

/// Exactly an address and a quantity of 1 to `most`.
#[inline]
fn range(body: &[u8], most: u16) -> Result<Range, ExceptionCode> {
    let [address, quantity] = words(body)?;
    if (1..=most).contains(&quantity) {
        Ok(Range { address, quantity })
    } else {
        Err(ExceptionCode::IllegalDataValue)
    }
}

/// Four bytes of address and quantity, a byte count, and as many bytes as it says.
#[inline]
fn counted(body: &[u8]) -> Result<(&[u8], &[u8]), ExceptionCode> {
    match body.split_at_checked(4) {
        Some((head, [count, data @ ..])) if usize::from(*count) == data.len() => Ok((head, data)),
        _ => Err(ExceptionCode::IllegalDataValue),
    }
}

#[inline]
fn agree(data: &[u8], len: usize) -> Result<(), ExceptionCode> {
    if data.len() == len { Ok(()) } else { Err(ExceptionCode::IllegalDataValue) }
}

fn empty(body: &[u8]) -> Result<(), ExceptionCode> {
    agree(body, 0)
}

/// Appends to a PDU; `None` when it is full.
struct Out<'b> {
    pdu: &'b mut Buffer,
    len: usize,
}

impl Out<'_> {
    fn bytes(&mut self, bytes: &[u8]) -> Option<()> {
        let end = self.len.checked_add(bytes.len())?;
        self.pdu.get_mut(self.len..end)?.copy_from_slice(bytes);
        self.len = end;
        Some(())
    }

    fn byte(&mut self, byte: u8) -> Option<()> {
        self.bytes(&[byte])
    }

    fn words(&mut self, words: &[u16]) -> Option<()> {
        words.iter().try_for_each(|word| self.bytes(&word.to_be_bytes()))
    }
}

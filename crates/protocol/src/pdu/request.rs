//! Requests: parsed by a server, encoded by a client (V1.1b3, 6).
//!
//! Parsing makes the first two checks of the standard, in its order: the function must be known
//! (exception 01), then form, quantity and value must be right (exception 03). The types of a
//! request enforce the same checks, so encoding cannot fail.

use super::identification::{self, ReadCode};
use super::{
    BitRange, Bits, Buffer, Diagnostics, ExceptionCode, FileRanges, FileRecords, Function, Range,
    RegisterRange, Registers, limit,
};

/// One request. Registers are big-endian bytes, bits packed least significant bit first.
///
/// ```
/// use holdfast_protocol::pdu::{ExceptionCode, Range, Request, RequestError};
///
/// assert_eq!(Request::parse(&[1, 0, 19, 0, 37]), Ok(Request::ReadCoils(Range::new(19, 37)?)));
/// assert_eq!(Request::parse(&[1, 0, 19, 0, 0]), Err(ExceptionCode::IllegalDataValue));
/// assert_eq!(Request::parse(&[99]), Err(ExceptionCode::IllegalFunction));
/// # Ok::<(), RequestError>(())
/// ```
///
/// A server answers [`ExceptionCode::IllegalFunction`] in the wildcard arm of its `match`, for each
/// function that it does not serve.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(not(feature = "exhaustive"), non_exhaustive)]
pub enum Request<'a> {
    /// Function 1.
    ReadCoils(BitRange),
    /// Function 2.
    ReadDiscreteInputs(BitRange),
    /// Function 3.
    ReadHoldingRegisters(RegisterRange),
    /// Function 4.
    ReadInputRegisters(RegisterRange),
    /// Function 5.
    WriteSingleCoil {
        /// The coil to write.
        address: u16,
        /// `true` for `FF00`, `false` for `0000`.
        value: bool,
    },
    /// Function 6.
    WriteSingleRegister {
        /// The register to write.
        address: u16,
        /// Its new value.
        value: u16,
    },
    /// Function 7.
    ReadExceptionStatus,
    /// Function 8.
    Diagnostics(Diagnostics<'a>),
    /// Function 11.
    GetCommEventCounter,
    /// Function 12.
    GetCommEventLog,
    /// Function 15.
    WriteMultipleCoils {
        /// The first coil to write.
        address: u16,
        /// New values of this coil and those after it.
        bits: Bits<'a, { limit::WRITE_BITS }>,
    },
    /// Function 16.
    WriteMultipleRegisters {
        /// The first register to write.
        address: u16,
        /// New values of this register and those after it.
        registers: Registers<'a, { limit::WRITE_REGISTERS }>,
    },
    /// Function 17.
    ReportServerId,
    /// Function 20.
    ReadFileRecord(FileRanges<'a>),
    /// Function 21.
    WriteFileRecord(FileRecords<'a>),
    /// Function 22: the register becomes `(value & and_mask) | (or_mask & !and_mask)`.
    MaskWriteRegister {
        /// The register to change.
        address: u16,
        /// Bits that keep their value.
        and_mask: u16,
        /// New values of the other bits.
        or_mask: u16,
    },
    /// Function 23. The write comes first.
    ReadWriteMultipleRegisters {
        /// The registers to read.
        read: RegisterRange,
        /// The first register to write.
        write_address: u16,
        /// New values of this register and those after it.
        registers: Registers<'a, { limit::READ_WRITE_REGISTERS }>,
    },
    /// Function 24. It does not empty the queue.
    ReadFifoQueue {
        /// The register of the queue.
        address: u16,
    },
    /// Function 43 with MEI type 14.
    ReadDeviceIdentification {
        /// The objects to read.
        code: ReadCode,
        /// The object, or the first object of a stream.
        object_id: u8,
    },
}

impl<'a> Request<'a> {
    /// Parses the PDU of a request.
    ///
    /// # Errors
    /// [`ExceptionCode::IllegalFunction`] for an unknown function, sub-function or MEI type.
    /// [`ExceptionCode::IllegalDataValue`] for a PDU that is too short or too long, a quantity out
    /// of its limits, a byte count that does not agree with it, or a value that is not allowed.
    /// [`ExceptionCode::IllegalDataAddress`] for a file or record that no file can have. A server
    /// sends the code as it is, see [`reply::exception`](super::reply::exception).
    #[inline]
    pub fn parse(pdu: &'a [u8]) -> Result<Request<'a>, ExceptionCode> {
        let (&code, body) = pdu.split_first().ok_or(ExceptionCode::IllegalDataValue)?;
        let function = Function::from_code(code).ok_or(ExceptionCode::IllegalFunction)?;
        Ok(match function {
            Function::ReadCoils => Request::ReadCoils(range(body)?),
            Function::ReadDiscreteInputs => Request::ReadDiscreteInputs(range(body)?),
            Function::ReadHoldingRegisters => Request::ReadHoldingRegisters(range(body)?),
            Function::ReadInputRegisters => Request::ReadInputRegisters(range(body)?),
            Function::WriteSingleCoil => {
                let [address, value] = words(body)?;
                let value = match value {
                    ON => true,
                    OFF => false,
                    _ => return Err(ExceptionCode::IllegalDataValue),
                };
                Request::WriteSingleCoil { address, value }
            }
            Function::WriteSingleRegister => {
                let [address, value] = words(body)?;
                Request::WriteSingleRegister { address, value }
            }
            Function::ReadExceptionStatus => empty(body, Request::ReadExceptionStatus)?,
            Function::Diagnostics => Request::Diagnostics(Diagnostics::parse(body)?),
            Function::GetCommEventCounter => empty(body, Request::GetCommEventCounter)?,
            Function::GetCommEventLog => empty(body, Request::GetCommEventLog)?,
            Function::WriteMultipleCoils => {
                let ([address, quantity], data) = counted(body)?;
                let bits = Bits::new(quantity, data).or(Err(ExceptionCode::IllegalDataValue))?;
                Request::WriteMultipleCoils { address, bits }
            }
            Function::WriteMultipleRegisters => {
                let ([address, quantity], data) = counted(body)?;
                Request::WriteMultipleRegisters { address, registers: registers(quantity, data)? }
            }
            Function::ReportServerId => empty(body, Request::ReportServerId)?,
            Function::ReadFileRecord => Request::ReadFileRecord(FileRanges::parse(body)?),
            Function::WriteFileRecord => Request::WriteFileRecord(FileRecords::parse(body)?),
            Function::MaskWriteRegister => {
                let [address, and_mask, or_mask] = words(body)?;
                Request::MaskWriteRegister { address, and_mask, or_mask }
            }
            Function::ReadWriteMultipleRegisters => {
                let (read, rest) =
                    body.split_at_checked(4).ok_or(ExceptionCode::IllegalDataValue)?;
                let read = range(read)?;
                let ([write_address, quantity], data) = counted(rest)?;
                let registers = registers(quantity, data)?;
                Request::ReadWriteMultipleRegisters { read, write_address, registers }
            }
            Function::ReadFifoQueue => {
                let [address] = words(body)?;
                Request::ReadFifoQueue { address }
            }
            Function::EncapsulatedInterface => {
                let (code, object_id) = identification::parse_request(body)?;
                Request::ReadDeviceIdentification { code, object_id }
            }
        })
    }

    /// Writes the request at the start of `pdu` and returns its length, 1 to [`super::MAX_LEN`].
    ///
    /// [`Request::parse`] accepts every encoded request: a server that follows the standard does not
    /// refuse it for its form, quantity or value.
    ///
    /// ```
    /// use holdfast_protocol::pdu::{self, Request};
    ///
    /// let request = Request::WriteSingleCoil { address: 172, value: true };
    /// let mut pdu = [0; pdu::MAX_LEN];
    /// let len = request.encode(&mut pdu);
    /// assert_eq!(pdu[..len], [5, 0, 172, 0xFF, 0]);
    /// assert_eq!(Request::parse(&pdu[..len]), Ok(request));
    /// ```
    pub fn encode(&self, pdu: &mut Buffer) -> usize {
        pdu[0] = self.function().code();
        let len = match *self {
            Request::ReadCoils(range) | Request::ReadDiscreteInputs(range) => {
                put_words(pdu, [range.address(), range.quantity()])
            }
            Request::ReadHoldingRegisters(range) | Request::ReadInputRegisters(range) => {
                put_words(pdu, [range.address(), range.quantity()])
            }
            Request::WriteSingleCoil { address, value } => put_words(pdu, [address, coil(value)]),
            Request::WriteSingleRegister { address, value } => put_words(pdu, [address, value]),
            Request::Diagnostics(query) => {
                let head = put_words(pdu, [query.sub_function().code()]);
                put(pdu, head, query.data())
            }
            Request::ReadExceptionStatus
            | Request::GetCommEventCounter
            | Request::GetCommEventLog
            | Request::ReportServerId => 1,
            Request::WriteMultipleCoils { address, bits } => {
                let head = put_words(pdu, [address, bits.quantity()]);
                put_counted(pdu, head, bits.as_bytes())
            }
            Request::WriteMultipleRegisters { address, registers } => {
                let head = put_words(pdu, [address, registers.quantity()]);
                put_counted(pdu, head, registers.as_bytes())
            }
            Request::ReadFileRecord(ranges) => put_counted(pdu, 1, ranges.as_bytes()),
            Request::WriteFileRecord(records) => put_counted(pdu, 1, records.as_bytes()),
            Request::MaskWriteRegister { address, and_mask, or_mask } => {
                put_words(pdu, [address, and_mask, or_mask])
            }
            Request::ReadWriteMultipleRegisters { read, write_address, registers } => {
                let words = [read.address(), read.quantity(), write_address, registers.quantity()];
                let head = put_words(pdu, words);
                put_counted(pdu, head, registers.as_bytes())
            }
            Request::ReadFifoQueue { address } => put_words(pdu, [address]),
            Request::ReadDeviceIdentification { code, object_id } => {
                put(pdu, 1, &[identification::MEI_TYPE, code.code(), object_id])
            }
        };
        debug_assert_eq!(Request::parse(&pdu[..len]), Ok(*self), "an encoded request parses");
        len
    }

    /// Whether the request only reads: repeating it changes nothing.
    pub const fn is_read(&self) -> bool {
        match self {
            Request::Diagnostics(query) => !query.sub_function().changes_state(),
            _ => !self.function().is_write(),
        }
    }

    /// The function of the request.
    pub const fn function(&self) -> Function {
        match self {
            Request::ReadCoils(_) => Function::ReadCoils,
            Request::ReadDiscreteInputs(_) => Function::ReadDiscreteInputs,
            Request::ReadHoldingRegisters(_) => Function::ReadHoldingRegisters,
            Request::ReadInputRegisters(_) => Function::ReadInputRegisters,
            Request::WriteSingleCoil { .. } => Function::WriteSingleCoil,
            Request::WriteSingleRegister { .. } => Function::WriteSingleRegister,
            Request::ReadExceptionStatus => Function::ReadExceptionStatus,
            Request::Diagnostics(_) => Function::Diagnostics,
            Request::GetCommEventCounter => Function::GetCommEventCounter,
            Request::GetCommEventLog => Function::GetCommEventLog,
            Request::WriteMultipleCoils { .. } => Function::WriteMultipleCoils,
            Request::WriteMultipleRegisters { .. } => Function::WriteMultipleRegisters,
            Request::ReportServerId => Function::ReportServerId,
            Request::ReadFileRecord(_) => Function::ReadFileRecord,
            Request::WriteFileRecord(_) => Function::WriteFileRecord,
            Request::MaskWriteRegister { .. } => Function::MaskWriteRegister,
            Request::ReadWriteMultipleRegisters { .. } => Function::ReadWriteMultipleRegisters,
            Request::ReadFifoQueue { .. } => Function::ReadFifoQueue,
            Request::ReadDeviceIdentification { .. } => Function::EncapsulatedInterface,
        }
    }
}

/// A coil that is on, in function 5.
const ON: u16 = 0xFF00;
/// A coil that is off, in function 5.
const OFF: u16 = 0x0000;

/// A coil value of function 5.
pub(super) const fn coil(value: bool) -> u16 {
    if value { ON } else { OFF }
}

/// Parses exactly `N` big-endian words.
#[inline]
fn words<const N: usize>(body: &[u8]) -> Result<[u16; N], ExceptionCode> {
    let (pairs, rest) = body.as_chunks::<2>();
    match <&[[u8; 2]; N]>::try_from(pairs) {
        Ok(pairs) if rest.is_empty() => Ok(pairs.map(u16::from_be_bytes)),
        _ => Err(ExceptionCode::IllegalDataValue),
    }
}

/// Parses exactly an address and a quantity of 1 to `MAX`.
#[inline]
fn range<const MAX: u16>(body: &[u8]) -> Result<Range<MAX>, ExceptionCode> {
    let [address, quantity] = words(body)?;
    Range::new(address, quantity).or(Err(ExceptionCode::IllegalDataValue))
}

/// Parses address, quantity, byte count, and exactly that many bytes.
#[inline]
fn counted(body: &[u8]) -> Result<([u16; 2], &[u8]), ExceptionCode> {
    match body {
        &[a0, a1, q0, q1, count, ref data @ ..] if usize::from(count) == data.len() => {
            Ok(([u16::from_be_bytes([a0, a1]), u16::from_be_bytes([q0, q1])], data))
        }
        _ => Err(ExceptionCode::IllegalDataValue),
    }
}

/// Parses 1 to `MAX` registers, as many as the quantity says.
#[inline]
fn registers<const MAX: u16>(
    quantity: u16,
    data: &[u8],
) -> Result<Registers<'_, MAX>, ExceptionCode> {
    match Registers::new(data) {
        Ok(registers) if registers.quantity() == quantity => Ok(registers),
        _ => Err(ExceptionCode::IllegalDataValue),
    }
}

/// The request of a function whose body is empty.
fn empty<'a>(body: &[u8], request: Request<'a>) -> Result<Request<'a>, ExceptionCode> {
    if body.is_empty() { Ok(request) } else { Err(ExceptionCode::IllegalDataValue) }
}

/// Writes words after the function code. Returns the length of the PDU so far.
#[inline]
pub(super) fn put_words<const N: usize>(pdu: &mut Buffer, words: [u16; N]) -> usize {
    let (pairs, _) = pdu[1..].as_chunks_mut::<2>();
    for (pair, word) in pairs.iter_mut().zip(words) {
        *pair = word.to_be_bytes();
    }
    1 + 2 * N
}

/// Writes bytes at `at`. Returns the length of the PDU so far.
#[inline]
fn put(pdu: &mut Buffer, at: usize, bytes: &[u8]) -> usize {
    let end = at + bytes.len();
    pdu[at..end].copy_from_slice(bytes);
    end
}

/// Writes a byte count and the bytes at `at`. Returns the length of the PDU so far.
#[inline]
fn put_counted(pdu: &mut Buffer, at: usize, bytes: &[u8]) -> usize {
    pdu[at] = bytes.len() as u8;
    put(pdu, at + 1, bytes)
}

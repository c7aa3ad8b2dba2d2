//! Responses. A client parses a response against the request that it answers.

use thiserror::Error;

use super::identification::Answer;
use super::request::coil;
use super::{Bits, ExceptionCode, FileAnswer, Registers, Request, limit};

/// A response. Bits and registers are exactly as many as the request asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(not(feature = "exhaustive"), non_exhaustive)]
pub enum Response<'a> {
    /// Coils or discrete inputs (functions 1 and 2).
    Bits(Bits<'a, { limit::READ_BITS }>),
    /// Registers (functions 3, 4 and 23).
    Registers(Registers<'a, { limit::READ_REGISTERS }>),
    /// The write was carried out: the response repeats what the standard requires (functions 5, 6,
    /// 15, 16, 21 and 22).
    Written,
    /// Eight outputs, the lowest bit first, whose meaning depends on the device (function 7).
    ExceptionStatus(u8),
    /// The data field of Diagnostics (function 8).
    Diagnostics(&'a [u8]),
    /// Status and event count (function 11).
    EventCounter {
        /// Whether the server still processes a program command.
        busy: bool,
        /// Requests that the server has carried out.
        events: u16,
    },
    /// The same, the message count and the log of events (function 12).
    EventLog {
        /// Whether the server still processes a program command.
        busy: bool,
        /// Requests that the server has carried out.
        events: u16,
        /// Messages that the server has received.
        messages: u16,
        /// One byte for each event, the latest first, at most [`limit::LOG_EVENTS`].
        log: &'a [u8],
    },
    /// The records of each range (function 20).
    FileRecords(FileAnswer<'a>),
    /// The registers of a FIFO queue, in its order (function 24); `None` if it is empty.
    Queue(Option<Registers<'a, { limit::QUEUE_REGISTERS }>>),
    /// Server id, run indicator and additional data (function 17). Their layout depends on the
    /// device.
    ServerId(&'a [u8]),
    /// Identification objects (function 43 with MEI type 14).
    Identification(Answer<'a>),
    /// What follows the function code, in the answer to a request that was encoded elsewhere.
    Opaque(&'a [u8]),
}

/// Why a PDU is not a response to the request, or its exception.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Error)]
#[cfg_attr(not(feature = "exhaustive"), non_exhaustive)]
pub enum ResponseError {
    /// The server refused the request.
    #[error("{0}")]
    Exception(ExceptionCode),
    /// The server refused the request with a code that is not in the standard.
    #[error("exception with the unknown code {0:#04x}")]
    UnknownException(u8),
    /// The response belongs to another function.
    #[error("function code {found:#04x}, expected {expected:#04x}")]
    Function {
        /// The function code of the request.
        expected: u8,
        /// The function code of the response.
        found: u8,
    },
    /// The response does not have the length or count that the request requires.
    #[error("the length or a count does not match the request")]
    Length,
    /// The response does not repeat the values of the request.
    #[error("the response does not repeat the values of the request")]
    Echo,
}

impl Request<'_> {
    /// Parses the PDU that answers this request.
    ///
    /// ```
    /// use holdfast_protocol::pdu::{ExceptionCode, Range, Request, Response, ResponseError};
    ///
    /// let request = Request::ReadCoils(Range::new(0, 3)?);
    /// let Response::Bits(bits) = request.response(&[1, 1, 0b101])? else { unreachable!() };
    /// assert!(bits.iter().eq([true, false, true]));
    ///
    /// let refused = ResponseError::Exception(ExceptionCode::IllegalDataAddress);
    /// assert_eq!(request.response(&[0x81, 2]), Err(refused));
    /// assert_eq!(request.response(&[1, 2, 0, 0]), Err(ResponseError::Length));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`ResponseError`]: an exception, or why the PDU cannot be the answer to this request.
    pub fn response<'p>(&self, pdu: &'p [u8]) -> Result<Response<'p>, ResponseError> {
        let body = body(pdu, self.function().code())?;
        match *self {
            Request::ReadCoils(range) | Request::ReadDiscreteInputs(range) => {
                let data = counted(body, range.byte_len())?;
                Ok(Response::Bits(Bits::in_range(range, data)))
            }
            Request::ReadHoldingRegisters(range)
            | Request::ReadInputRegisters(range)
            | Request::ReadWriteMultipleRegisters { read: range, .. } => {
                let data = counted(body, range.byte_len())?;
                Ok(Response::Registers(Registers::in_range(range, data)))
            }
            Request::WriteSingleCoil { address, value } => echoed(body, &[address, coil(value)]),
            Request::WriteSingleRegister { address, value } => echoed(body, &[address, value]),
            Request::WriteMultipleCoils { address, bits } => {
                echoed(body, &[address, bits.quantity()])
            }
            Request::WriteMultipleRegisters { address, registers } => {
                echoed(body, &[address, registers.quantity()])
            }
            Request::MaskWriteRegister { address, and_mask, or_mask } => {
                echoed(body, &[address, and_mask, or_mask])
            }
            Request::ReadExceptionStatus => match *body {
                [status] => Ok(Response::ExceptionStatus(status)),
                _ => Err(ResponseError::Length),
            },
            Request::Diagnostics(query) => match body {
                [high, low, data @ ..] if data.len() == query.data().len() => {
                    if u16::from_be_bytes([*high, *low]) == query.sub_function().code() {
                        Ok(Response::Diagnostics(data))
                    } else {
                        Err(ResponseError::Echo)
                    }
                }
                _ => Err(ResponseError::Length),
            },
            Request::GetCommEventCounter => match *body {
                [a, b, c, d] => Ok(Response::EventCounter {
                    busy: [a, b] == [0xFF, 0xFF],
                    events: u16::from_be_bytes([c, d]),
                }),
                _ => Err(ResponseError::Length),
            },
            Request::GetCommEventLog => match *body {
                [count, a, b, c, d, e, f, ref log @ ..]
                    if usize::from(count) == 6 + log.len()
                        && log.len() <= usize::from(limit::LOG_EVENTS) =>
                {
                    Ok(Response::EventLog {
                        busy: [a, b] == [0xFF, 0xFF],
                        events: u16::from_be_bytes([c, d]),
                        messages: u16::from_be_bytes([e, f]),
                        log,
                    })
                }
                _ => Err(ResponseError::Length),
            },
            Request::ReadFileRecord(ranges) => {
                let data = counted(body, ranges.reply_len())?;
                if ranges.are_answered_by(data) {
                    Ok(Response::FileRecords(FileAnswer::new(data)))
                } else {
                    Err(ResponseError::Length)
                }
            }
            Request::WriteFileRecord(records) => {
                let data = counted(body, records.as_bytes().len())?;
                if data == records.as_bytes() {
                    Ok(Response::Written)
                } else {
                    Err(ResponseError::Echo)
                }
            }
            Request::ReadFifoQueue { .. } => queue(body),
            Request::ReportServerId => match body {
                [count, data @ ..] if usize::from(*count) == data.len() => {
                    Ok(Response::ServerId(data))
                }
                _ => Err(ResponseError::Length),
            },
            Request::ReadDeviceIdentification { code, .. } => {
                Answer::parse(code, body).map(Response::Identification).ok_or(ResponseError::Length)
            }
        }
    }
}

/// Returns what follows the function code `expected`.
pub(super) fn body(pdu: &[u8], expected: u8) -> Result<&[u8], ResponseError> {
    match pdu {
        [found, body @ ..] if *found == expected => Ok(body),
        [found, code] if *found & 0x7F == expected => Err(ExceptionCode::from_code(*code)
            .map_or(ResponseError::UnknownException(*code), ResponseError::Exception)),
        [found, ..] if *found & 0x7F != expected => {
            Err(ResponseError::Function { expected, found: *found })
        }
        _ => Err(ResponseError::Length),
    }
}

/// Returns the data after a byte count, if both have the length `len`.
fn counted(body: &[u8], len: usize) -> Result<&[u8], ResponseError> {
    match body {
        [count, data @ ..] if usize::from(*count) == len && data.len() == len => Ok(data),
        _ => Err(ResponseError::Length),
    }
}

/// Parses the byte count, which covers what follows it, the number of registers, and these.
fn queue(body: &[u8]) -> Result<Response<'_>, ResponseError> {
    match *body {
        [a, b, c, d, ref data @ ..]
            if usize::from(u16::from_be_bytes([a, b])) == 2 + data.len()
                && usize::from(u16::from_be_bytes([c, d])) * 2 == data.len() =>
        {
            if data.is_empty() {
                return Ok(Response::Queue(None));
            }
            let registers = Registers::new(data).or(Err(ResponseError::Length))?;
            Ok(Response::Queue(Some(registers)))
        }
        _ => Err(ResponseError::Length),
    }
}

/// Checks that the body is exactly these words.
fn echoed(body: &[u8], words: &[u16]) -> Result<Response<'static>, ResponseError> {
    if body.len() != words.len() * 2 {
        return Err(ResponseError::Length);
    }
    let same = words.iter().flat_map(|word| word.to_be_bytes()).eq(body.iter().copied());
    if same { Ok(Response::Written) } else { Err(ResponseError::Echo) }
}

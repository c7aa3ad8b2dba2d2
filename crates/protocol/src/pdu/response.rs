//! Responses, as a client parses them: against the request they answer.

use thiserror::Error;

use super::identification::Answer;
use super::{ExceptionCode, Range, Request};

/// What a server answered. Registers are big-endian bytes, bits packed least significant bit first;
/// both have exactly the length that the request asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Response<'a> {
    Bits(&'a [u8]),
    Registers(&'a [u8]),
    /// The write was carried out: the server sent back what the standard asks for.
    Written,
    /// The data field of Diagnostics.
    Diagnostics(&'a [u8]),
    EventCounter {
        busy: bool,
        events: u16,
    },
    /// Server id, run indicator and additional data: how they are laid out, the device says.
    ServerId(&'a [u8]),
    Identification(Answer<'a>),
}

/// Why a PDU is not the response to a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum ResponseError {
    #[error("{0}")]
    Exception(ExceptionCode),
    #[error("exception with the unknown code {0:#04x}")]
    UnknownException(u8),
    #[error("function code {found:#04x} instead of {expected:#04x}")]
    Function { expected: u8, found: u8 },
    #[error("the length or a count does not fit the request")]
    Length,
    #[error("what the server sent back is not what was sent")]
    Echo,
}

impl Request<'_> {
    /// Parses the PDU that answers this request.
    ///
    /// # Errors
    /// [`ResponseError`]: an exception, or why the PDU can't be the answer to this request.
    pub fn response<'p>(&self, pdu: &'p [u8]) -> Result<Response<'p>, ResponseError> {
        let expected = self.function().code();
        let body = match pdu {
            [found, body @ ..] if *found == expected => body,
            [found, code] if *found == expected | 0x80 => {
                return Err(ExceptionCode::from_code(*code)
                    .map_or(ResponseError::UnknownException(*code), ResponseError::Exception));
            }
            [found, ..] if *found | 0x80 != expected | 0x80 => {
                return Err(ResponseError::Function { expected, found: *found });
            }
            _ => return Err(ResponseError::Length),
        };
        match *self {
            Request::ReadCoils(range) | Request::ReadDiscreteInputs(range) => {
                counted(body, usize::from(range.quantity).div_ceil(8)).map(Response::Bits)
            }
            Request::ReadHoldingRegisters(range)
            | Request::ReadInputRegisters(range)
            | Request::ReadWriteMultipleRegisters { read: range, .. } => {
                counted(body, usize::from(range.quantity) * 2).map(Response::Registers)
            }
            Request::WriteSingleCoil { address, value } => {
                echoed(body, &[address, if value { 0xFF00 } else { 0x0000 }])
            }
            Request::WriteSingleRegister { address, value } => echoed(body, &[address, value]),
            Request::WriteMultipleCoils { range: Range { address, quantity }, .. }
            | Request::WriteMultipleRegisters { range: Range { address, quantity }, .. } => {
                echoed(body, &[address, quantity])
            }
            Request::MaskWriteRegister { address, and_mask, or_mask } => {
                echoed(body, &[address, and_mask, or_mask])
            }
            Request::Diagnostics(asked) => match body {
                [high, low, data @ ..] if data.len() == asked.data.len() => {
                    if u16::from_be_bytes([*high, *low]) == asked.sub_function.code() {
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

/// A byte count and exactly `len` bytes.
fn counted(body: &[u8], len: usize) -> Result<&[u8], ResponseError> {
    match body {
        [count, data @ ..] if usize::from(*count) == len && data.len() == len => Ok(data),
        _ => Err(ResponseError::Length),
    }
}

/// Exactly these words.
fn echoed(body: &[u8], words: &[u16]) -> Result<Response<'static>, ResponseError> {
    if body.len() != words.len() * 2 {
        return Err(ResponseError::Length);
    }
    let same = body
        .as_chunks::<2>()
        .0
        .iter()
        .map(|pair| u16::from_be_bytes(*pair))
        .eq(words.iter().copied());
    if same { Ok(Response::Written) } else { Err(ResponseError::Echo) }
}

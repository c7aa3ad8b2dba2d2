//! RTU frames (Modbus over Serial Line V1.02, 2.5.1): unit id, PDU, CRC-16 low byte first.
//!
//! On a serial line, a silence ends a frame: the caller measures it and calls [`decode`] with the
//! bytes before it. RTU over TCP has no silence between frames: a server uses
//! [`rtu_stream`](super::rtu_stream), a client [`response_len`].
//!
//! ```
//! use holdfast_protocol::frame::rtu;
//!
//! let mut frame = [0; rtu::MAX_LEN];
//! let len = rtu::encode(17, &[3, 0, 107, 0, 3], &mut frame).unwrap();
//! assert_eq!(frame[..len], [17, 3, 0, 107, 0, 3, 0x76, 0x87]);
//! assert_eq!(rtu::decode(&frame[..len]), Ok((17, &[3, 0, 107, 0, 3][..])));
//! ```

use super::{FrameError, split};
use crate::pdu;

/// The longest frame, in bytes.
pub const MAX_LEN: usize = 1 + pdu::MAX_LEN + 2;

/// Writes a frame at the start of `frame` and returns its length; `None` for a PDU that is empty or
/// longer than [`pdu::MAX_LEN`].
pub fn encode(unit_id: u8, pdu: &[u8], frame: &mut [u8; MAX_LEN]) -> Option<usize> {
    if pdu.is_empty() {
        return None;
    }
    let body = 1 + pdu.len();
    frame[0] = unit_id;
    frame.get_mut(1..body)?.copy_from_slice(pdu);
    let crc = crc(frame.get(..body)?);
    frame.get_mut(body..body + 2)?.copy_from_slice(&crc.to_le_bytes());
    Some(body + 2)
}

/// The unit id and PDU of a complete frame.
///
/// # Errors
/// [`FrameError::Length`] unless the frame has 4 to 256 bytes, [`FrameError::CheckSum`] for a wrong
/// CRC.
pub fn decode(frame: &[u8]) -> Result<(u8, &[u8]), FrameError> {
    let (body, sent) = frame.split_last_chunk::<2>().ok_or(FrameError::Length)?;
    let parts = split(body)?;
    if u16::from_le_bytes(*sent) == crc(body) { Ok(parts) } else { Err(FrameError::CheckSum) }
}

/// CRC-16/MODBUS: polynomial 0xA001 reflected, start 0xFFFF.
///
/// ```
/// assert_eq!(holdfast_protocol::frame::rtu::crc(b"123456789"), 0x4B37);
/// ```
pub fn crc(bytes: &[u8]) -> u16 {
    bytes.iter().fold(CRC_START, |crc, byte| extended(crc, *byte))
}

pub(super) const CRC_START: u16 = 0xFFFF;

/// The CRC after one more byte. After a frame with the right CRC, it is 0.
pub(super) fn extended(crc: u16, byte: u8) -> u16 {
    #[cfg(test)]
    super::rtu_stream::tests::count();
    (crc >> 8) ^ TABLE[usize::from((crc as u8) ^ byte)]
}

const TABLE: [u16; 256] = {
    let mut table = [0; 256];
    let mut index = 0;
    while index < 256 {
        let mut crc = index as u16;
        let mut bit = 0;
        while bit < 8 {
            crc = if crc & 1 == 1 { (crc >> 1) ^ 0xA001 } else { crc >> 1 };
            bit += 1;
        }
        table[index] = crc;
        index += 1;
    }
    table
};

/// The length of the frame at the start of `bytes`, according to its function code. The frame
/// answers a request whose PDU has `request_len` bytes. `None` while more bytes are required.
///
/// ```
/// use holdfast_protocol::frame::rtu;
///
/// assert_eq!(rtu::response_len(&[17, 3], 5), Ok(None));
/// assert_eq!(rtu::response_len(&[17, 3, 6], 5), Ok(Some(11)));
/// assert_eq!(rtu::response_len(&[17, 0x83], 5), Ok(Some(5)));
/// ```
///
/// # Errors
/// [`FrameError::Length`] for an unknown function, or an invalid count.
pub fn response_len(bytes: &[u8], request_len: usize) -> Result<Option<usize>, FrameError> {
    let pdu = bytes.get(1..bytes.len().min(MAX_LEN)).unwrap_or_default();
    match response_pdu_len(pdu, request_len)?.map(|len| 1 + len + 2) {
        Some(len) if len > MAX_LEN => Err(FrameError::Length),
        len => Ok(len),
    }
}

/// The length of the PDU at the start of `bytes`, in the same way.
pub(crate) fn response_pdu_len(
    bytes: &[u8],
    request_len: usize,
) -> Result<Option<usize>, FrameError> {
    let Some((function_code, data)) = bytes.split_first() else { return Ok(None) };
    let data_len = match *function_code {
        0x80.. => Some(1),
        1..=4 | 12 | 17 | 20 | 21 | 23 => data.first().map(|count| 1 + usize::from(*count)),
        7 => Some(1),
        5 | 6 | 11 | 15 | 16 => Some(4),
        8 => Some(request_len.saturating_sub(1)),
        22 => Some(6),
        24 => data.first_chunk().map(|count| 2 + usize::from(u16::from_be_bytes(*count))),
        43 => identification_len(data),
        _ => return Err(FrameError::Length),
    };
    Ok(data_len.map(|len| 1 + len))
}

/// MEI type, read code, conformity, more, next, number of objects, then the objects.
fn identification_len(data: &[u8]) -> Option<usize> {
    let mut len = 6;
    for _ in 0..*data.get(5)? {
        len += 2 + usize::from(*data.get(len + 1)?);
    }
    Some(len)
}

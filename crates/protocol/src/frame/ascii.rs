//! ASCII frames (Modbus over Serial Line V1.02, 2.5.2): a colon, unit id, PDU and LRC as pairs of
//! hexadecimal digits, CR and LF.
//!
//! ```
//! use holdfast_protocol::frame::ascii;
//!
//! let mut frame = [0; ascii::MAX_LEN];
//! let len = ascii::encode(17, &[3, 0, 107, 0, 3], &mut frame).unwrap();
//! assert_eq!(&frame[..len], b":1103006B00037E\r\n");
//!
//! let mut body = [0; ascii::MAX_BODY_LEN];
//! assert_eq!(ascii::decode(&frame[..len], &mut body), Ok((17, &[3, 0, 107, 0, 3][..])));
//! ```

use super::{FrameError, split};
use crate::pdu;

/// The longest frame, in characters.
pub const MAX_LEN: usize = 1 + 2 * MAX_BODY_LEN + 2;

/// The most bytes that a frame encodes: unit id, PDU, LRC.
pub const MAX_BODY_LEN: usize = 1 + pdu::MAX_LEN + 1;

/// Writes a frame at the start of `frame` and returns its length; `None` for a PDU that is empty or
/// longer than [`pdu::MAX_LEN`].
pub fn encode(unit_id: u8, pdu: &[u8], frame: &mut [u8; MAX_LEN]) -> Option<usize> {
    if !(1..=pdu::MAX_LEN).contains(&pdu.len()) {
        return None;
    }
    let lrc = [lrc(pdu).wrapping_sub(unit_id)];
    let body = [unit_id].into_iter().chain(pdu.iter().copied()).chain(lrc);
    frame[0] = b':';
    let mut len = 1;
    for byte in body {
        frame[len] = DIGITS[usize::from(byte >> 4)];
        frame[len + 1] = DIGITS[usize::from(byte & 0x0F)];
        len += 2;
    }
    frame.get_mut(len..len + 2)?.copy_from_slice(b"\r\n");
    Some(len + 2)
}

/// The unit id and PDU of a complete frame, decoded into `body`. Digits above 9 may be uppercase or
/// lowercase letters.
///
/// # Errors
/// [`FrameError::Length`] for a frame that is too short or too long, [`FrameError::Character`] when
/// it is not made of a colon, digits, CR and LF, [`FrameError::CheckSum`] for a wrong LRC.
pub fn decode<'b>(
    frame: &[u8],
    body: &'b mut [u8; MAX_BODY_LEN],
) -> Result<(u8, &'b [u8]), FrameError> {
    let digits = frame.strip_prefix(b":").and_then(|rest| rest.strip_suffix(b"\r\n"));
    let (pairs, rest) = digits.ok_or(FrameError::Character)?.as_chunks::<2>();
    let bytes = body.get_mut(..pairs.len()).ok_or(FrameError::Length)?;
    if !rest.is_empty() {
        return Err(FrameError::Length);
    }
    for (byte, [high, low]) in bytes.iter_mut().zip(pairs) {
        *byte = digit(*high)? << 4 | digit(*low)?;
    }
    let (sent, bytes) = bytes.split_last().ok_or(FrameError::Length)?;
    let parts = split(bytes)?;
    if *sent == lrc(bytes) { Ok(parts) } else { Err(FrameError::CheckSum) }
}

/// The two's complement of the sum of all bytes.
///
/// ```
/// assert_eq!(holdfast_protocol::frame::ascii::lrc(&[17, 3, 0, 107, 0, 3]), 0x7E);
/// ```
pub fn lrc(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0u8, |sum, byte| sum.wrapping_sub(*byte))
}

const DIGITS: &[u8; 16] = b"0123456789ABCDEF";

fn digit(character: u8) -> Result<u8, FrameError> {
    match character {
        b'0'..=b'9' => Ok(character - b'0'),
        b'A'..=b'F' => Ok(character - b'A' + 10),
        b'a'..=b'f' => Ok(character - b'a' + 10),
        _ => Err(FrameError::Character),
    }
}

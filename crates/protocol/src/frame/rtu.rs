//! RTU frames (Modbus over Serial Line V1.02, 2.5.1): unit id, PDU, CRC-16 low byte first.

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

/// The unit id and PDU of a whole frame.
///
/// # Errors
/// [`FrameError::Length`] outside 4 to 256 bytes, [`FrameError::CheckSum`].
pub fn decode(frame: &[u8]) -> Result<(u8, &[u8]), FrameError> {
    let (body, sent) = frame.split_last_chunk::<2>().ok_or(FrameError::Length)?;
    let parts = split(body)?;
    if u16::from_le_bytes(*sent) == crc(body) { Ok(parts) } else { Err(FrameError::CheckSum) }
}

/// CRC-16/MODBUS: polynomial 0xA001 reflected, start 0xFFFF.
pub fn crc(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |crc, byte| (crc >> 8) ^ TABLE[usize::from((crc as u8) ^ byte)])
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

//! Frames: a unit id and a PDU, as each transport wraps them.

pub mod ascii;
pub mod mbap;
pub mod rtu;

use crate::pdu;

/// A frame of a serial line that is not one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    #[error("the frame is too short or too long")]
    Length,
    #[error("the check sum is wrong")]
    CheckSum,
    #[error("the frame has a character that does not belong there")]
    Character,
}

/// Unit id and PDU, when there is one of 1 to [`pdu::MAX_LEN`] bytes.
fn split(body: &[u8]) -> Result<(u8, &[u8]), FrameError> {
    match body.split_first() {
        Some((unit, pdu)) if (1..=pdu::MAX_LEN).contains(&pdu.len()) => Ok((*unit, pdu)),
        _ => Err(FrameError::Length),
    }
}

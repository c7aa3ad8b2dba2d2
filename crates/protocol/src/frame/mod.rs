//! Frames: a unit id and a PDU, as each transport wraps them.
//!
//! | transport | encode | decode |
//! | --- | --- | --- |
//! | TCP, UDP | [`mbap::encode`] | [`mbap::next`] |
//! | serial line, RTU mode | [`rtu::encode`] | [`rtu::decode`] |
//! | RTU over TCP | [`rtu::encode`] | [`rtu_stream::Requests`], [`rtu::response_len`] |
//! | serial line, ASCII mode | [`ascii::encode`] | [`ascii::decode`] |

pub mod ascii;
pub mod mbap;
pub mod rtu;
pub mod rtu_stream;

use crate::pdu;

/// Why bytes are not a valid frame of a serial line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
#[cfg_attr(not(feature = "exhaustive"), non_exhaustive)]
pub enum FrameError {
    /// The frame is too short or too long.
    #[error("the frame is too short or too long")]
    Length,
    /// The CRC or LRC does not match the bytes before it.
    #[error("the checksum is wrong")]
    CheckSum,
    /// An ASCII frame has no colon, no CR LF, or something other than digits between them.
    #[error("the frame has an invalid character")]
    Character,
}

/// Splits unit id and PDU, if the PDU has 1 to [`pdu::MAX_LEN`] bytes.
fn split(body: &[u8]) -> Result<(u8, &[u8]), FrameError> {
    match body.split_first() {
        Some((unit, pdu)) if (1..=pdu::MAX_LEN).contains(&pdu.len()) => Ok((*unit, pdu)),
        _ => Err(FrameError::Length),
    }
}

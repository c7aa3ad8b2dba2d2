//! The MBAP header of Modbus TCP and UDP (Messaging on TCP/IP Implementation Guide V1.0b, 3.1.3):
//! transaction id, protocol id 0, length of all that follows, unit id. Big-endian.
//!
//! A stream is read frame by frame. Bytes that [`next`] leaves over are the start of a frame: keep
//! them until more bytes arrive:
//!
//! ```
//! use holdfast_protocol::frame::mbap::{self, Next};
//!
//! let received = [0, 1, 0, 0, 0, 6, 17, 3, 0, 107, 0, 2, 0, 2, 0, 0, 0];
//! let mut rest = &received[..];
//! let mut pdus = Vec::new();
//! loop {
//!     match mbap::next(rest) {
//!         Next::Frame { pdu, len, .. } => {
//!             pdus.push(pdu);
//!             rest = &rest[len..];
//!         }
//!         Next::Foreign { len, .. } => rest = &rest[len..],
//!         Next::Incomplete => break,
//!         Next::Broken { .. } => panic!("close the connection"),
//!     }
//! }
//! assert_eq!(pdus, [&[3, 0, 107, 0, 2]]);
//! assert_eq!(rest, [0, 2, 0, 0, 0]);
//! ```

use crate::pdu;

/// Bytes before the PDU.
pub const HEADER_LEN: usize = 7;

/// The longest frame, in bytes.
pub const MAX_LEN: usize = HEADER_LEN + pdu::MAX_LEN;

/// Transaction id, protocol id and the length field itself: the length counts the bytes behind them.
const LEN_OF_UNCOUNTED_FIELDS: usize = 6;

/// What is at the start of received bytes. A caller must handle each case, so this enum is
/// exhaustive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Next<'a> {
    /// The start of a frame: wait for more bytes.
    Incomplete,
    /// A complete frame.
    Frame {
        /// Pairs a response with its request.
        transaction_id: u16,
        /// The unit that the frame is for.
        unit_id: u8,
        /// The PDU, 1 to [`pdu::MAX_LEN`] bytes.
        pdu: &'a [u8],
        /// Bytes of the frame.
        len: usize,
    },
    /// A frame of another protocol: discard it.
    Foreign {
        /// The protocol id, not 0.
        protocol_id: u16,
        /// Bytes of the frame.
        len: usize,
    },
    /// An invalid length. The start of the next frame is unknown: close the connection.
    Broken {
        /// The length field.
        length: u16,
    },
}

/// Looks at the start of `bytes`, which may end anywhere.
#[inline]
pub fn next(bytes: &[u8]) -> Next<'_> {
    let &[t0, t1, p0, p1, l0, l1, ref rest @ ..] = bytes else {
        return Next::Incomplete;
    };
    let length = u16::from_be_bytes([l0, l1]);
    if !(2..=1 + pdu::MAX_LEN).contains(&usize::from(length)) {
        return Next::Broken { length };
    }
    let Some((unit_id, pdu)) = rest.get(..usize::from(length)).and_then(<[u8]>::split_first) else {
        return Next::Incomplete;
    };
    let len = LEN_OF_UNCOUNTED_FIELDS + usize::from(length);
    match u16::from_be_bytes([p0, p1]) {
        0 => {
            let transaction_id = u16::from_be_bytes([t0, t1]);
            Next::Frame { transaction_id, unit_id: *unit_id, pdu, len }
        }
        protocol_id => Next::Foreign { protocol_id, len },
    }
}

/// Writes a frame at the start of `frame` and returns its length; `None` for a PDU that is empty or
/// longer than [`pdu::MAX_LEN`].
///
/// ```
/// use holdfast_protocol::frame::mbap;
///
/// let mut frame = [0; mbap::MAX_LEN];
/// let len = mbap::encode(1, 17, &[3, 0, 107, 0, 2], &mut frame).unwrap();
/// assert_eq!(frame[..len], [0, 1, 0, 0, 0, 6, 17, 3, 0, 107, 0, 2]);
/// ```
pub fn encode(
    transaction_id: u16,
    unit_id: u8,
    pdu: &[u8],
    frame: &mut [u8; MAX_LEN],
) -> Option<usize> {
    if pdu.is_empty() {
        return None;
    }
    let len = HEADER_LEN + pdu.len();
    frame.get_mut(HEADER_LEN..len)?.copy_from_slice(pdu);
    frame[..HEADER_LEN].copy_from_slice(&header(transaction_id, unit_id, pdu.len()));
    Some(len)
}

/// The header of a frame whose PDU has `pdu_len` bytes, for PDUs that are written in place after
/// the header.
///
/// # Panics
/// Unless `pdu_len` is 1 to [`pdu::MAX_LEN`].
#[inline]
pub fn header(transaction_id: u16, unit_id: u8, pdu_len: usize) -> [u8; HEADER_LEN] {
    assert!((1..=pdu::MAX_LEN).contains(&pdu_len), "a PDU has 1 to 253 bytes");
    let [t0, t1] = transaction_id.to_be_bytes();
    let [l0, l1] = (pdu_len as u16 + 1).to_be_bytes();
    [t0, t1, 0, 0, l0, l1, unit_id]
}

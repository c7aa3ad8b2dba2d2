//! The MBAP header of Modbus TCP and UDP (Messaging on TCP/IP Implementation Guide V1.0b, 3.1.3):
//! transaction id, protocol id 0, length of all that follows, unit id. Big-endian.

use crate::pdu;

/// Bytes before the PDU.
pub const HEADER_LEN: usize = 7;

/// The longest frame, in bytes.
pub const MAX_LEN: usize = HEADER_LEN + pdu::MAX_LEN;

/// The bytes that the length field does not count.
const UNCOUNTED: usize = 6;

/// What stands at the start of received bytes.
#[derive(Debug, PartialEq, Eq)]
pub enum Next<'a> {
    /// Not a whole frame yet.
    Incomplete,
    /// A frame of `len` bytes.
    Frame { transaction_id: u16, unit_id: u8, pdu: &'a [u8], len: usize },
    /// A frame of `len` bytes with a protocol id other than 0: to be discarded.
    Foreign { protocol_id: u16, len: usize },
    /// A length that no frame has: where the next one starts can't be known.
    Broken { length: u16 },
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
    let len = UNCOUNTED + usize::from(length);
    match u16::from_be_bytes([p0, p1]) {
        0 => {
            let transaction_id = u16::from_be_bytes([t0, t1]);
            Next::Frame { transaction_id, unit_id: *unit_id, pdu, len }
        }
        protocol_id => Next::Foreign { protocol_id, len },
    }
}

/// The header of a frame whose PDU has `pdu_len` bytes, 1 to [`pdu::MAX_LEN`].
#[inline]
pub fn header(transaction_id: u16, unit_id: u8, pdu_len: usize) -> [u8; HEADER_LEN] {
    debug_assert!((1..=pdu::MAX_LEN).contains(&pdu_len));
    let [t0, t1] = transaction_id.to_be_bytes();
    let [l0, l1] = (pdu_len as u16 + 1).to_be_bytes();
    [t0, t1, 0, 0, l0, l1, unit_id]
}

//! The framings of streams and datagrams: an MBAP header, or RTU frames.

use holdfast_protocol::frame::{mbap, rtu};
use holdfast_protocol::pdu;

/// What is at the start of received bytes.
pub(crate) enum Next<'a> {
    Incomplete,
    /// `tag` is returned with the reply.
    Request {
        tag: u16,
        unit_id: u8,
        pdu: &'a [u8],
        len: usize,
    },
    /// A frame of another protocol: discard it.
    Foreign {
        len: usize,
    },
    /// A frame with a wrong checksum: discard it.
    Damaged {
        len: usize,
    },
    /// The start of the next frame is unknown: close the connection.
    Broken,
}

pub(crate) trait Framing: Send + Sync + 'static {
    /// Bytes of a frame before and after the PDU.
    const HEADER_LEN: usize;
    const TRAILER_LEN: usize;
    /// The shortest request.
    const SHORTEST: usize;

    const MAX_LEN: usize = Self::HEADER_LEN + pdu::MAX_LEN + Self::TRAILER_LEN;

    fn next(bytes: &[u8]) -> Next<'_>;

    /// Where the next request starts if an incomplete one before it never ends.
    fn resync(_bytes: &[u8]) -> Option<usize> {
        None
    }

    /// Completes a frame with a PDU of `pdu_len` bytes in place. Returns the length of the frame.
    fn complete(frame: &mut [u8], tag: u16, unit_id: u8, pdu_len: usize) -> usize;
}

/// A framing whose frames are also sent one a datagram.
pub(crate) trait Datagram: Framing {
    /// The request that a datagram consists of. Anything else is never [`Next::Request`], nor
    /// [`Next::Incomplete`]: nothing follows a datagram.
    fn only(datagram: &[u8]) -> Next<'_>;
}

/// Frames with an MBAP header.
pub(crate) struct Mbap;

impl Framing for Mbap {
    const HEADER_LEN: usize = mbap::HEADER_LEN;
    const TRAILER_LEN: usize = 0;
    const SHORTEST: usize = mbap::HEADER_LEN + 1;

    #[inline]
    fn next(bytes: &[u8]) -> Next<'_> {
        match mbap::next(bytes) {
            mbap::Next::Incomplete => Next::Incomplete,
            mbap::Next::Frame { transaction_id, unit_id, pdu, len } => {
                Next::Request { tag: transaction_id, unit_id, pdu, len }
            }
            mbap::Next::Foreign { len, .. } => Next::Foreign { len },
            mbap::Next::Broken { .. } => Next::Broken,
        }
    }

    #[inline]
    fn complete(frame: &mut [u8], tag: u16, unit_id: u8, pdu_len: usize) -> usize {
        let header = mbap::header(tag, unit_id, pdu_len);
        frame[..header.len()].copy_from_slice(&header);
        header.len() + pdu_len
    }
}

impl Datagram for Mbap {
    #[inline]
    fn only(datagram: &[u8]) -> Next<'_> {
        match Mbap::next(datagram) {
            Next::Request { len, .. } if len < datagram.len() => Next::Broken,
            Next::Incomplete => Next::Broken,
            next => next,
        }
    }
}

/// RTU frames.
pub(crate) struct Rtu;

impl Framing for Rtu {
    const HEADER_LEN: usize = 1;
    const TRAILER_LEN: usize = 2;
    const SHORTEST: usize = 4;

    fn next(bytes: &[u8]) -> Next<'_> {
        match rtu::next_request(bytes) {
            rtu::Next::Incomplete => Next::Incomplete,
            rtu::Next::Frame { unit_id, pdu, len } => Next::Request { tag: 0, unit_id, pdu, len },
            rtu::Next::Damaged { .. } | rtu::Next::Broken => match rtu::resync(bytes) {
                Some(len) => Next::Damaged { len },
                // The next frame shows where frames start.
                None if bytes.len() < rtu::MAX_LEN => Next::Incomplete,
                None => Next::Damaged { len: bytes.len() },
            },
        }
    }

    fn resync(bytes: &[u8]) -> Option<usize> {
        rtu::resync(bytes)
    }

    fn complete(frame: &mut [u8], _tag: u16, unit_id: u8, pdu_len: usize) -> usize {
        frame[0] = unit_id;
        let body = 1 + pdu_len;
        let crc = rtu::crc(&frame[..body]);
        frame[body..body + 2].copy_from_slice(&crc.to_le_bytes());
        body + 2
    }
}

impl Datagram for Rtu {
    /// The end of the datagram is the end of the frame, whatever its function code.
    fn only(datagram: &[u8]) -> Next<'_> {
        match rtu::decode(datagram) {
            Ok((unit_id, pdu)) => Next::Request { tag: 0, unit_id, pdu, len: datagram.len() },
            Err(_) => Next::Damaged { len: datagram.len() },
        }
    }
}

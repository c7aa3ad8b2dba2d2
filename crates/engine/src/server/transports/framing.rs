//! The framings of streams and datagrams: an MBAP header, RTU frames, or ASCII frames.

use holdfast_protocol::frame::{ascii, mbap, rtu, rtu_stream};
use holdfast_protocol::pdu;

use crate::server::transports::shared_port::Beginning;

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
    /// Characters that do not belong to a frame: discard them.
    Stray {
        len: usize,
    },
    /// The start of the next frame is unknown: close the connection.
    Broken,
}

pub(crate) trait Framing: Send + Sync + 'static {
    /// Where [`Framing::complete`] takes the PDU from: bytes before it.
    const HEADER_LEN: usize;
    /// The length of the shortest request.
    const MIN_FRAME_LEN: usize;
    /// The length of the longest frame.
    const MAX_LEN: usize;
    /// Whether a reply names its request. Otherwise, a late one is taken for the reply to the next request.
    const HAS_IDS: bool;
    /// Whether unit id 0 is the broadcast, as on a serial line.
    const HAS_BROADCASTS: bool;

    /// What is remembered of the bytes before those that are looked at.
    type ParserState: Default + Send;

    /// A buffer for a decoded frame, where the PDU is not in the frame as it is.
    type Decoded;
    const EMPTY_DECODED: Self::Decoded;

    /// Looks at the start of `bytes`. An incomplete frame is never longer than
    /// [`Framing::MAX_LEN`]. `delimiter` returns the last character of an ASCII frame.
    fn next<'a>(
        state: &mut Self::ParserState,
        bytes: &'a [u8],
        delimiter: impl FnOnce() -> u8,
        decoded: &'a mut Self::Decoded,
    ) -> Next<'a>;

    /// Whether the next byte starts a frame, even if no silence precedes it.
    fn is_at_start(_state: &Self::ParserState) -> bool {
        true
    }

    /// Completes a frame with a PDU of `pdu_len` bytes in place: `frame` has room for
    /// [`Framing::MAX_LEN`] bytes. Returns the length of the frame.
    fn complete(frame: &mut [u8], tag: u16, unit_id: u8, pdu_len: usize) -> usize;
}

/// A framing whose frames are also sent one a datagram.
pub(crate) trait Datagram: Framing {
    /// The request that a datagram consists of. Anything else is never [`Next::Request`], nor
    /// [`Next::Incomplete`]: nothing follows a datagram.
    fn single_request(datagram: &[u8]) -> Next<'_>;
}

/// Frames with an MBAP header.
pub(crate) type Mbap = MbapOnPort<false>;

/// The same on a port that also accepts Raw Ingest packets. A packet among frames is broken: read as a
/// frame of another protocol, it would end too early, and its payload would follow as Modbus requests.
pub(crate) type MbapBesidePackets = MbapOnPort<true>;

pub(crate) struct MbapOnPort<const HAS_PACKETS: bool>;

impl<const HAS_PACKETS: bool> Framing for MbapOnPort<HAS_PACKETS> {
    const HEADER_LEN: usize = mbap::HEADER_LEN;
    const MIN_FRAME_LEN: usize = mbap::HEADER_LEN + 1;
    const MAX_LEN: usize = mbap::MAX_LEN;
    const HAS_IDS: bool = true;
    const HAS_BROADCASTS: bool = false;

    type ParserState = ();

    type Decoded = ();
    const EMPTY_DECODED: () = ();

    #[inline]
    fn next<'a>(
        _state: &mut (),
        bytes: &'a [u8],
        _delimiter: impl FnOnce() -> u8,
        _decoded: &'a mut (),
    ) -> Next<'a> {
        if HAS_PACKETS && matches!(Beginning::of(bytes), Beginning::Packet) {
            return Next::Broken;
        }
        mbap_next(bytes)
    }

    #[inline]
    fn complete(frame: &mut [u8], tag: u16, unit_id: u8, pdu_len: usize) -> usize {
        let header = mbap::header(tag, unit_id, pdu_len);
        frame[..header.len()].copy_from_slice(&header);
        header.len() + pdu_len
    }
}

#[inline]
fn mbap_next(bytes: &[u8]) -> Next<'_> {
    match mbap::next(bytes) {
        mbap::Next::Incomplete => Next::Incomplete,
        mbap::Next::Frame { transaction_id, unit_id, pdu, len } => {
            Next::Request { tag: transaction_id, unit_id, pdu, len }
        }
        mbap::Next::Foreign { len, .. } => Next::Foreign { len },
        mbap::Next::Broken { .. } => Next::Broken,
    }
}

impl Datagram for Mbap {
    #[inline]
    fn single_request(datagram: &[u8]) -> Next<'_> {
        match mbap_next(datagram) {
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
    const MIN_FRAME_LEN: usize = 4;
    const MAX_LEN: usize = rtu::MAX_LEN;
    const HAS_IDS: bool = false;
    const HAS_BROADCASTS: bool = true;

    type ParserState = rtu_stream::Requests;

    type Decoded = ();
    const EMPTY_DECODED: () = ();

    fn next<'a>(
        state: &mut rtu_stream::Requests,
        bytes: &'a [u8],
        _delimiter: impl FnOnce() -> u8,
        _decoded: &'a mut (),
    ) -> Next<'a> {
        match state.next(bytes) {
            rtu_stream::Next::Incomplete => Next::Incomplete,
            rtu_stream::Next::Frame { unit_id, pdu, len } => {
                Next::Request { tag: 0, unit_id, pdu, len }
            }
            rtu_stream::Next::Damaged { len } => Next::Damaged { len },
            rtu_stream::Next::Stray { len } => Next::Stray { len },
        }
    }

    fn is_at_start(state: &rtu_stream::Requests) -> bool {
        state.is_at_start()
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
    fn single_request(datagram: &[u8]) -> Next<'_> {
        match rtu::decode(datagram) {
            Ok((unit_id, pdu)) => Next::Request { tag: 0, unit_id, pdu, len: datagram.len() },
            Err(_) => Next::Damaged { len: datagram.len() },
        }
    }
}

/// ASCII frames in a stream. A colon starts a frame, also within another one.
pub(crate) struct Ascii;

impl Framing for Ascii {
    /// The colon and the digits of the unit id.
    const HEADER_LEN: usize = 3;
    /// A function code without data.
    const MIN_FRAME_LEN: usize = 1 + 2 * 3 + 2;
    const MAX_LEN: usize = ascii::MAX_LEN;
    const HAS_IDS: bool = false;
    const HAS_BROADCASTS: bool = true;

    type ParserState = ();

    type Decoded = [u8; ascii::MAX_BODY_LEN];
    const EMPTY_DECODED: Self::Decoded = [0; ascii::MAX_BODY_LEN];

    fn next<'a>(
        _state: &mut (),
        bytes: &'a [u8],
        delimiter: impl FnOnce() -> u8,
        decoded: &'a mut Self::Decoded,
    ) -> Next<'a> {
        match bytes.iter().position(|character| *character == b':') {
            Some(0) => {}
            None if bytes.is_empty() => return Next::Incomplete,
            start => return Next::Stray { len: start.unwrap_or(bytes.len()) },
        }
        let delimiter = delimiter();
        let mut frame = [0; ascii::MAX_LEN];
        frame[0] = b':';
        for at in 1..ascii::MAX_LEN {
            let Some(&character) = bytes.get(at) else { return Next::Incomplete };
            if character == delimiter && frame[at - 1] == b'\r' {
                // The standard's delimiter, whatever it was changed to.
                frame[at] = b'\n';
                let len = at + 1;
                return match ascii::decode(&frame[..len], decoded) {
                    Ok((unit_id, pdu)) => Next::Request { tag: 0, unit_id, pdu, len },
                    Err(_) => Next::Damaged { len },
                };
            }
            if character == b':' {
                return Next::Damaged { len: at };
            }
            frame[at] = character;
        }
        Next::Damaged { len: ascii::MAX_LEN }
    }

    fn complete(frame: &mut [u8], _tag: u16, unit_id: u8, pdu_len: usize) -> usize {
        let mut reply = [0; pdu::MAX_LEN];
        let reply = &mut reply[..pdu_len];
        reply.copy_from_slice(&frame[Self::HEADER_LEN..][..pdu_len]);
        let room = frame
            .first_chunk_mut::<{ ascii::MAX_LEN }>()
            .expect("there is room for the longest frame");
        ascii::encode(unit_id, reply, room).expect("a reply is a PDU")
    }
}

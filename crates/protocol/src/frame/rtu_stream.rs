//! Requests in a stream of RTU frames, as RTU over TCP carries them: where each ends, and what follows a
//! damaged one.

use super::rtu::{CRC_START, MAX_LEN, decode, extended};
use crate::pdu::{DataLen, request_data_len};

/// What is at the start of a stream of requests. A caller must handle each case, so this enum is
/// exhaustive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Next<'a> {
    /// The start of a frame: wait for more bytes.
    Incomplete,
    /// A complete frame.
    Frame {
        /// The device that the request is for.
        unit_id: u8,
        /// The PDU, 1 to [`pdu::MAX_LEN`](crate::pdu::MAX_LEN) bytes.
        pdu: &'a [u8],
        /// Bytes of the frame.
        len: usize,
    },
    /// A frame with a wrong CRC, or longer than any frame: discard it.
    Damaged {
        /// Bytes of the frame that have arrived.
        len: usize,
    },
    /// Bytes that do not belong to a frame: discard them.
    Stray {
        /// Their number.
        len: usize,
    },
}

/// Finds requests in a stream that may be cut anywhere: what it finds depends on the bytes only, not on
/// how many of them arrive together.
///
/// The length of a request follows from its function code. A frame of an unknown function ends where the
/// CRC first matches. After a damaged frame, one of a known function is believed if it follows directly.
/// Otherwise no more frames are found: bytes that look like a request may be data of a damaged write.
///
/// After a silence, the next byte starts a frame: discard the bytes that were left over, and begin again
/// with [`Requests::default`].
///
/// ```
/// use holdfast_protocol::frame::rtu_stream::{Next, Requests};
///
/// let received = [17, 3, 0, 107, 0, 3, 0x76, 0x87, 17, 3];
/// let mut requests = Requests::default();
/// let pdu = &received[1..6];
/// assert_eq!(requests.next(&received), Next::Frame { unit_id: 17, pdu, len: 8 });
/// assert_eq!(requests.next(&received[8..]), Next::Incomplete);
/// ```
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Requests {
    place: Place,
}

/// What the next byte of a stream is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum Place {
    /// The first byte of a frame.
    #[default]
    Start,
    /// The byte behind a frame of an unknown function: its last one, if that is 0, or the first of the
    /// next.
    AfterUnknown,
    /// The byte behind a damaged frame, whose length may be damaged too.
    AfterDamaged,
    /// Unknown.
    Lost,
}

impl Requests {
    /// Looks at the start of `bytes`, which may end anywhere. Bytes that are not part of
    /// the result are expected again at the start of the next call.
    pub fn next<'a>(&mut self, bytes: &'a [u8]) -> Next<'a> {
        if bytes.is_empty() {
            return Next::Incomplete;
        }
        match self.place {
            Place::Start => self.found(request(bytes), bytes.len()),
            Place::AfterUnknown if bytes[0] == 0 => self.after_unknown(bytes),
            Place::AfterUnknown => {
                self.place = Place::Start;
                self.next(bytes)
            }
            Place::AfterDamaged => match known(bytes) {
                Some(found @ (Found::Frame { .. } | Found::Incomplete)) => {
                    self.found(found, bytes.len())
                }
                Some(Found::Damaged { .. } | Found::Endless) | None => {
                    self.place = Place::Lost;
                    Next::Stray { len: bytes.len() }
                }
            },
            Place::Lost => Next::Stray { len: bytes.len() },
        }
    }

    /// Whether the next byte is known to start a frame. Otherwise it would do so only after a silence.
    pub fn is_at_start(&self) -> bool {
        self.place == Place::Start
    }

    fn found<'a>(&mut self, found: Found<'a>, received: usize) -> Next<'a> {
        let (place, next) = match found {
            Found::Incomplete => return Next::Incomplete,
            Found::Frame { unit_id, pdu, len } => {
                let place = match request_data_len(pdu[0], &pdu[1..]) {
                    DataLen::Known(_) => Place::Start,
                    DataLen::Incomplete | DataLen::Unknown => Place::AfterUnknown,
                };
                (place, Next::Frame { unit_id, pdu, len })
            }
            Found::Damaged { len } => (Place::AfterDamaged, Next::Damaged { len }),
            Found::Endless => (Place::Lost, Next::Damaged { len: received }),
        };
        self.place = place;
        next
    }

    /// When the last byte of the data of an unknown function equals the first byte of the CRC of the
    /// bytes before it, the CRC matches one byte too early. The remaining byte is 0. But the 0 may
    /// also be the unit id of the next frame. Both readings are tried; the one whose frame is complete first
    /// is right.
    fn after_unknown<'a>(&mut self, bytes: &'a [u8]) -> Next<'a> {
        let (here, behind) = (known(bytes), known(&bytes[1..]));
        match (here, behind) {
            (Some(Found::Frame { len, .. }), Some(Found::Frame { len: other, .. }))
                if 1 + other < len =>
            {
                self.stray_zero()
            }
            (Some(found @ Found::Frame { .. }), _) => self.found(found, bytes.len()),
            (_, Some(Found::Frame { .. })) => self.stray_zero(),
            (Some(Found::Incomplete), _) | (_, Some(Found::Incomplete)) => Next::Incomplete,
            _ => self.found(Found::Endless, bytes.len()),
        }
    }

    fn stray_zero(&mut self) -> Next<'static> {
        self.place = Place::Start;
        Next::Stray { len: 1 }
    }
}

/// What bytes start with, if they start with a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Found<'a> {
    Incomplete,
    Frame {
        unit_id: u8,
        pdu: &'a [u8],
        len: usize,
    },
    Damaged {
        len: usize,
    },
    /// Longer than any frame, or no frame at all.
    Endless,
}

fn request(bytes: &[u8]) -> Found<'_> {
    known(bytes).unwrap_or_else(|| first_fit(bytes))
}

/// `None` for a function of unknown length.
fn known(bytes: &[u8]) -> Option<Found<'_>> {
    let [_, function_code, data @ ..] = bytes else { return Some(Found::Incomplete) };
    let len = match request_data_len(*function_code, data) {
        DataLen::Known(len) => 2 + len + 2,
        DataLen::Incomplete => return Some(Found::Incomplete),
        DataLen::Unknown => return None,
    };
    Some(match bytes.get(..len) {
        _ if len > MAX_LEN => Found::Endless,
        None => Found::Incomplete,
        Some(frame) => whole(frame),
    })
}

/// A frame of an unknown function: it ends where the CRC first matches.
fn first_fit(bytes: &[u8]) -> Found<'_> {
    let longest = bytes.len().min(MAX_LEN);
    let mut crc = CRC_START;
    let ends_here = |len: &usize| {
        crc = extended(crc, bytes[len - 1]);
        *len >= 4 && crc == 0
    };
    match (1..=longest).find(ends_here) {
        Some(len) => whole(&bytes[..len]),
        None if longest == MAX_LEN => Found::Endless,
        None => Found::Incomplete,
    }
}

fn whole(frame: &[u8]) -> Found<'_> {
    let len = frame.len();
    match decode(frame) {
        Ok((unit_id, pdu)) => Found::Frame { unit_id, pdu, len },
        Err(_) => Found::Damaged { len },
    }
}

#[cfg(test)]
pub(super) mod tests {
    extern crate std;

    use std::cell::Cell;
    use std::vec::Vec;

    use proptest::prelude::*;

    use super::super::rtu::encode;
    use super::*;

    std::thread_local! {
        static STEPS: Cell<usize> = const { Cell::new(0) };
    }

    pub(in crate::frame) fn count() {
        STEPS.set(STEPS.get() + 1);
    }

    /// How many bytes the CRC ran over meanwhile.
    fn steps<T>(work: impl FnOnce() -> T) -> usize {
        STEPS.set(0);
        work();
        STEPS.get()
    }

    /// The search for the end of a frame with a CRC of its own for each length.
    fn plain_first_fit(bytes: &[u8]) -> Found<'_> {
        let longest = bytes.len().min(MAX_LEN);
        match (4..=longest).find(|len| decode(&bytes[..*len]).is_ok()) {
            Some(len) => whole(&bytes[..len]),
            None if longest == MAX_LEN => Found::Endless,
            None => Found::Incomplete,
        }
    }

    fn frame(unit_id: u8, pdu: &[u8]) -> Vec<u8> {
        let mut frame = [0; MAX_LEN];
        let len = encode(unit_id, pdu, &mut frame).unwrap();
        frame[..len].to_vec()
    }

    proptest! {
        #[test]
        fn the_search_for_an_end_finds_what_a_plain_search_finds(
            unit_id: u8,
            code: u8,
            data in prop::collection::vec(any::<u8>(), 0..300),
        ) {
            let framed = frame(unit_id, &[&[code], &data[..data.len().min(252)]].concat());
            for bytes in [&framed, &framed[..framed.len() - 1], &data] {
                prop_assert_eq!(first_fit(bytes), plain_first_fit(bytes));
            }
        }
    }

    #[test]
    fn the_search_for_an_end_looks_at_each_byte_once() {
        let garbage = [0x64; 4096];
        assert_eq!(plain_first_fit(&garbage), Found::Endless);
        assert_eq!(request(&garbage), Found::Endless);
        assert_eq!(steps(|| request(&garbage)), MAX_LEN);
        // Each length with a CRC of its own: 2 to 254 bytes.
        assert_eq!(steps(|| plain_first_fit(&garbage)), (2..=254).sum());
    }
}

//! RTU frames (Modbus over Serial Line V1.02, 2.5.1): unit id, PDU, CRC-16 low byte first.
//!
//! On a serial line, a silence ends a frame: the caller measures it and calls [`decode`] with the
//! bytes before it. RTU over TCP has no silence between frames: a server calls [`next_request`], a
//! client [`response_len`].
//!
//! ```
//! use holdfast_protocol::frame::rtu;
//!
//! let mut frame = [0; rtu::MAX_LEN];
//! let len = rtu::encode(17, &[3, 0, 107, 0, 3], &mut frame).unwrap();
//! assert_eq!(frame[..len], [17, 3, 0, 107, 0, 3, 0x76, 0x87]);
//! assert_eq!(rtu::decode(&frame[..len]), Ok((17, &[3, 0, 107, 0, 3][..])));
//! ```

use core::mem;

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

const CRC_START: u16 = 0xFFFF;

/// The CRC after one more byte. After a frame with the right CRC, it is 0.
fn extended(crc: u16, byte: u8) -> u16 {
    #[cfg(test)]
    tests::count();
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

/// What is at the start of a stream of requests, as RTU over TCP carries them. A caller must handle
/// each case, so this enum is exhaustive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Next<'a> {
    /// The start of a frame: wait for more bytes.
    Incomplete,
    /// A complete frame.
    Frame {
        /// The device that the request is for.
        unit_id: u8,
        /// The PDU, 1 to [`pdu::MAX_LEN`] bytes.
        pdu: &'a [u8],
        /// Bytes of the frame.
        len: usize,
    },
    /// A frame with a wrong CRC: discard it.
    Damaged {
        /// Bytes of the frame.
        len: usize,
    },
    /// Longer than any frame. The start of the next frame is unknown: close the connection.
    Broken,
}

/// Looks at the start of `bytes`, which may end anywhere. A stream has no silence between frames:
/// the length of a request follows from its function code. A frame of an unknown function ends
/// where the CRC first matches.
///
/// ```
/// use holdfast_protocol::frame::rtu::{self, Next};
///
/// let received = [17, 3, 0, 107, 0, 3, 0x76, 0x87, 17, 3];
/// let pdu = &received[1..6];
/// assert_eq!(rtu::next_request(&received), Next::Frame { unit_id: 17, pdu, len: 8 });
/// assert_eq!(rtu::next_request(&received[8..]), Next::Incomplete);
/// ```
pub fn next_request(bytes: &[u8]) -> Next<'_> {
    let Some(&[_, function_code, ref data @ ..]) = bytes.get(..bytes.len().min(MAX_LEN)) else {
        return Next::Incomplete;
    };
    let len = match request_data_len(function_code, data) {
        DataLen::Known(len) => 2 + len + 2,
        DataLen::Incomplete => return Next::Incomplete,
        DataLen::Unknown => return first_fit(bytes),
    };
    match bytes.get(..len) {
        _ if len > MAX_LEN => Next::Broken,
        None => Next::Incomplete,
        Some(frame) => match decode(frame) {
            Ok((unit_id, pdu)) => Next::Frame { unit_id, pdu, len },
            Err(_) => Next::Damaged { len },
        },
    }
}

/// After a damaged frame: where the next frames start, if `bytes` end with complete frames of known
/// functions. They must fill the bytes to the end: data of a damaged frame that look like a frame
/// are not a request.
///
/// ```
/// use holdfast_protocol::frame::rtu;
///
/// let received = [0, 17, 3, 0, 107, 0, 3, 0x76, 0x87];
/// assert_eq!(rtu::resync(&received), Some(1));
/// assert_eq!(rtu::resync(&received[..8]), None);
/// ```
pub fn resync(bytes: &[u8]) -> Option<usize> {
    // Where earlier attempts came by: all of them failed.
    let mut tried = [false; 2 * MAX_LEN];
    (1..bytes.len().min(MAX_LEN + 1)).find(|start| {
        let mut at = *start;
        while at < bytes.len() {
            if tried.get_mut(at).is_some_and(|tried| mem::replace(tried, true)) {
                return false;
            }
            let Some(len) = known_and_whole(&bytes[at..]) else { return false };
            at += len;
        }
        true
    })
}

enum DataLen {
    Known(usize),
    /// The length is in a later byte.
    Incomplete,
    Unknown,
}

/// Returns the length of the data between function code and CRC (V1.1b3, 6).
fn request_data_len(function_code: u8, data: &[u8]) -> DataLen {
    let counted = |at: usize| {
        data.get(at)
            .map_or(DataLen::Incomplete, |count| DataLen::Known(at + 1 + usize::from(*count)))
    };
    match function_code {
        1..=6 | 8 => DataLen::Known(4),
        7 | 11 | 12 | 17 => DataLen::Known(0),
        15 | 16 => counted(4),
        20 | 21 => counted(0),
        22 => DataLen::Known(6),
        23 => counted(8),
        24 => DataLen::Known(2),
        43 => match data.first() {
            None => DataLen::Incomplete,
            Some(14) => DataLen::Known(3),
            Some(_) => DataLen::Unknown,
        },
        _ => DataLen::Unknown,
    }
}

fn first_fit(bytes: &[u8]) -> Next<'_> {
    let longest = bytes.len().min(MAX_LEN);
    let mut crc = CRC_START;
    let ends_here = |len: &usize| {
        crc = extended(crc, bytes[len - 1]);
        *len >= 4 && crc == 0
    };
    let Some(first) = (1..=longest).find(ends_here) else {
        return if longest == MAX_LEN { Next::Broken } else { Next::Incomplete };
    };
    // When the last byte of the data equals the first byte of the CRC of the bytes before it, the
    // CRC matches one byte too early. The remaining byte is 0, and no frame for unit 0 starts with
    // it.
    let longer = first < longest && bytes[first] == 0 && known_and_whole(&bytes[first..]).is_none();
    let len = first + usize::from(longer);
    match decode(&bytes[..len]) {
        Ok((unit_id, pdu)) => Next::Frame { unit_id, pdu, len },
        Err(_) => Next::Damaged { len },
    }
}

/// The length of the complete frame of a known function that bytes start with.
fn known_and_whole(bytes: &[u8]) -> Option<usize> {
    let [_, function_code, data @ ..] = bytes else { return None };
    let DataLen::Known(len) = request_data_len(*function_code, data) else { return None };
    let len = 2 + len + 2;
    decode(bytes.get(..len)?).is_ok().then_some(len)
}

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
        1..=4 | 17 | 23 => data.first().map(|count| 1 + usize::from(*count)),
        5 | 6 | 11 | 15 | 16 => Some(4),
        8 => Some(request_len.saturating_sub(1)),
        22 => Some(6),
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

#[cfg(test)]
mod tests {
    extern crate std;

    use std::cell::Cell;
    use std::vec;
    use std::vec::Vec;

    use proptest::prelude::*;

    use super::*;

    std::thread_local! {
        static STEPS: Cell<usize> = const { Cell::new(0) };
    }

    pub(super) fn count() {
        STEPS.set(STEPS.get() + 1);
    }

    /// How many bytes the CRC ran over meanwhile.
    fn steps<T>(work: impl FnOnce() -> T) -> usize {
        STEPS.set(0);
        work();
        STEPS.get()
    }

    /// The search for the end of a frame with a CRC of its own for each length.
    fn plain_first_fit(bytes: &[u8]) -> Next<'_> {
        let longest = bytes.len().min(MAX_LEN);
        let Some(first) = (4..=longest).find(|len| decode(&bytes[..*len]).is_ok()) else {
            return if longest == MAX_LEN { Next::Broken } else { Next::Incomplete };
        };
        let longer =
            first < longest && bytes[first] == 0 && known_and_whole(&bytes[first..]).is_none();
        let len = first + usize::from(longer);
        match decode(&bytes[..len]) {
            Ok((unit_id, pdu)) => Next::Frame { unit_id, pdu, len },
            Err(_) => Next::Damaged { len },
        }
    }

    /// The search for frames after a damaged one that tries every start without a memory.
    fn plain_resync(bytes: &[u8]) -> Option<usize> {
        (1..bytes.len().min(MAX_LEN + 1)).find(|start| {
            let mut rest = &bytes[*start..];
            while let Some(len) = known_and_whole(rest) {
                rest = &rest[len..];
            }
            rest.is_empty()
        })
    }

    fn frame(unit_id: u8, pdu: &[u8]) -> Vec<u8> {
        let mut frame = [0; MAX_LEN];
        let len = encode(unit_id, pdu, &mut frame).unwrap();
        frame[..len].to_vec()
    }

    /// Garbage and frames in any order, of known and unknown functions, and frames cut short.
    fn stream() -> impl Strategy<Value = Vec<u8>> {
        let code = prop_oneof![prop::sample::select(vec![3, 7, 16, 17, 23, 24, 43]), any::<u8>()];
        let data = prop::collection::vec(any::<u8>(), 0..12);
        let framed = (any::<u8>(), code, data)
            .prop_map(|(unit, code, data)| frame(unit, &[&[code], &data[..]].concat()));
        let known = any::<u8>().prop_map(|unit| frame(unit, &[3, 0, 0, 0, 1]));
        let cut = framed.clone().prop_map(|frame| frame[..frame.len() - 1].to_vec());
        let garbage = prop::collection::vec(any::<u8>(), 0..300);
        let same = (any::<u8>(), 0..300_usize).prop_map(|(byte, count)| vec![byte; count]);
        let parts = prop_oneof![4 => known, 4 => framed, 1 => cut, 1 => garbage, 1 => same];
        prop::collection::vec(parts, 0..12).prop_map(|parts| parts.concat())
    }

    proptest! {
        #[test]
        fn the_searches_find_what_plain_searches_find(bytes in stream()) {
            prop_assert_eq!(resync(&bytes), plain_resync(&bytes));
            for start in 0..bytes.len().min(5) {
                prop_assert_eq!(first_fit(&bytes[start..]), plain_first_fit(&bytes[start..]));
            }
        }
    }

    #[test]
    fn the_search_for_an_end_looks_at_each_byte_once() {
        let garbage = [0x64; 4096];
        assert_eq!(plain_first_fit(&garbage), Next::Broken);
        assert_eq!(next_request(&garbage), Next::Broken);
        assert_eq!(steps(|| next_request(&garbage)), MAX_LEN);
        // Each length with a CRC of its own: 2 to 254 bytes.
        assert_eq!(steps(|| plain_first_fit(&garbage)), (2..=254).sum());
    }

    #[test]
    fn frames_that_do_not_reach_the_end_are_looked_at_once() {
        let frames = frame(1, &[17]).repeat(1000);
        let bytes = [&[0x64][..], &frames, &[1]].concat();
        assert_eq!(resync(&bytes), plain_resync(&bytes));
        // One pass over the frames, of whose bytes a CRC covers two.
        assert!(steps(|| resync(&bytes)) <= frames.len());
        assert!(steps(|| plain_resync(&bytes)) > 30 * frames.len());
    }
}

//! A stream of RTU frames: [lengths of the pieces] parts. A fuzzer does not find checksums: an even first byte
//! makes a part the content of a frame.

use holdfast_protocol::frame::rtu;
use holdfast_protocol::frame::rtu_stream::{Next, Requests};
use holdfast_protocol::pdu::Request;

/// The requests that are found in a stream do not depend on how it is cut, and those of a good stream are all
/// found. A frame is the encoding of its parts, and a reply has at most the longest length.
pub fn check(data: &[u8]) {
    let (lengths, mut parts) = crate::counted(data);
    let (mut stream, mut good) = (Vec::new(), Some(Vec::new()));
    while !parts.is_empty() {
        let (part, rest) = crate::counted(parts);
        parts = rest;
        match part {
            [kind, unit_id, pdu @ ..] if kind % 2 == 0 => {
                let mut frame = [0; rtu::MAX_LEN];
                let len = rtu::encode(*unit_id, pdu, &mut frame).unwrap_or(0);
                is_reply(&frame[..len], lengths.len());
                stream.extend_from_slice(&frame[..len]);
                good = good.filter(|_| is_known(pdu));
                good.iter_mut().for_each(|good| good.push((*unit_id, pdu.to_vec())));
            }
            [_, bytes @ ..] => {
                is_reply(bytes, lengths.len());
                stream.extend_from_slice(bytes);
                good = good.filter(|_| bytes.is_empty());
            }
            [] => {}
        }
    }
    let whole = found(&[&stream]);
    assert_eq!(found(&crate::pieces(lengths, &stream)), whole, "cut into {lengths:?}");
    if let Some(good) = good {
        assert_eq!((whole.frames, whole.dropped, whole.rest), (good, 0, Vec::new()));
    }
}

/// Whether the length of a request follows from its function code.
fn is_known(pdu: &[u8]) -> bool {
    match Request::parse(pdu) {
        Ok(Request::Diagnostics(asked)) => asked.data().len() == 2,
        parsed => parsed.is_ok(),
    }
}

/// Checks what a client makes of the beginning of a reply.
fn is_reply(bytes: &[u8], request_len: usize) {
    if let Ok((unit_id, pdu)) = rtu::decode(bytes) {
        is_encoded(unit_id, pdu, bytes);
    }
    if let Ok(Some(len)) = rtu::response_len(bytes, request_len) {
        assert!((4..=rtu::MAX_LEN).contains(&len));
        // More bytes do not change it.
        for end in 0..=bytes.len() {
            let known = rtu::response_len(&bytes[..end], request_len);
            assert!(known == Ok(None) || known == Ok(Some(len)), "{known:?}, then {len}");
        }
    }
}

fn is_encoded(unit_id: u8, pdu: &[u8], expected: &[u8]) {
    let mut frame = [0; rtu::MAX_LEN];
    let len = rtu::encode(unit_id, pdu, &mut frame).expect("a PDU of a frame can be encoded");
    assert_eq!(&frame[..len], expected);
}

/// What is found in a stream.
#[derive(Debug, Default, PartialEq, Eq)]
struct Found {
    /// Unit ids and PDUs.
    frames: Vec<(u8, Vec<u8>)>,
    /// Where each frame ends.
    ends: Vec<usize>,
    /// The number of bytes that are no part of one.
    dropped: usize,
    /// What may be the beginning of one.
    rest: Vec<u8>,
    is_at_start: bool,
}

fn found(pieces: &[&[u8]]) -> Found {
    let (mut requests, mut found, mut end) = (Requests::default(), Found::default(), 0);
    for piece in pieces {
        found.rest.extend_from_slice(piece);
        loop {
            let len = match requests.next(&found.rest) {
                Next::Incomplete => break,
                Next::Frame { unit_id, pdu, len } => {
                    is_encoded(unit_id, pdu, &found.rest[..len]);
                    found.frames.push((unit_id, pdu.to_vec()));
                    found.ends.push(end + len);
                    len
                }
                Next::Damaged { len } | Next::Stray { len } => {
                    found.dropped += len;
                    len
                }
            };
            assert!((1..=found.rest.len()).contains(&len));
            found.rest.drain(..len);
            end += len;
        }
        assert!(found.rest.len() <= rtu::MAX_LEN);
    }
    found.is_at_start = requests.is_at_start();
    found
}

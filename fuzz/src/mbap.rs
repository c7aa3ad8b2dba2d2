//! A stream of MBAP frames, as a server reads it: [lengths of the pieces] stream.

use holdfast_protocol::frame::mbap::{self, Next};

/// What is found does not depend on how the stream is cut, and a frame is the encoding of its parts.
pub fn check(data: &[u8]) {
    let (lengths, stream) = crate::counted(data);
    let whole = found(&[stream]);
    assert_eq!(found(&crate::pieces(lengths, stream)), whole, "cut into {lengths:?}");
}

/// The frames of a stream, then what follows them.
fn found(pieces: &[&[u8]]) -> (Vec<String>, Vec<u8>) {
    let (mut found, mut rest) = (Vec::new(), Vec::new());
    for piece in pieces {
        rest.extend_from_slice(piece);
        loop {
            let next = mbap::next(&rest);
            let len = match next {
                Next::Incomplete => {
                    assert!(rest.len() < mbap::MAX_LEN);
                    break;
                }
                Next::Frame { transaction_id, unit_id, pdu, len } => {
                    let mut frame = [0; mbap::MAX_LEN];
                    let encoded = mbap::encode(transaction_id, unit_id, pdu, &mut frame);
                    assert_eq!((encoded, &frame[..len]), (Some(len), &rest[..len]));
                    len
                }
                Next::Foreign { protocol_id, len } => {
                    assert_ne!(protocol_id, 0);
                    len
                }
                Next::Broken { length } => {
                    assert!(!(2..=254).contains(&length));
                    // The connection ends: what follows is not read.
                    found.push(format!("{next:?}"));
                    return (found, Vec::new());
                }
            };
            assert!((mbap::HEADER_LEN + 1..=mbap::MAX_LEN).contains(&len));
            found.push(format!("{next:?}"));
            rest.drain(..len);
        }
    }
    (found, rest)
}

//! An ASCII frame.

use holdfast_protocol::frame::ascii;

/// What is decoded is the encoding of its parts, but for small letters.
pub fn check(data: &[u8]) {
    if let Ok((unit_id, pdu)) = ascii::decode(data, &mut [0; ascii::MAX_BODY_LEN]) {
        is_encoded(unit_id, pdu, data);
    }
    // A fuzzer does not find checksums: the same bytes as the content of a frame.
    let Some((unit_id, pdu)) = data.split_first() else { return };
    let mut frame = [0; ascii::MAX_LEN];
    match ascii::encode(*unit_id, pdu, &mut frame) {
        None => assert!(pdu.is_empty() || pdu.len() > 253),
        Some(len) => {
            for frame in [&frame[..len], &frame[..len].to_ascii_lowercase()] {
                let mut body = [0; ascii::MAX_BODY_LEN];
                assert_eq!(ascii::decode(frame, &mut body), Ok((*unit_id, pdu)));
            }
        }
    }
}

fn is_encoded(unit_id: u8, pdu: &[u8], expected: &[u8]) {
    let mut frame = [0; ascii::MAX_LEN];
    let len = ascii::encode(unit_id, pdu, &mut frame).expect("a PDU of a frame can be encoded");
    assert!(frame[..len].eq_ignore_ascii_case(expected));
}

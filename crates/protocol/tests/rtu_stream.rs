//! Tests RTU requests in a stream, as in RTU over TCP.

use holdfast_protocol::frame::rtu::{self, Next, next_request};
use proptest::prelude::*;

fn frame(unit_id: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = [0; rtu::MAX_LEN];
    let len = rtu::encode(unit_id, pdu, &mut frame).unwrap();
    frame[..len].to_vec()
}

/// A PDU of an unknown function. Its last byte equals the first byte of the CRC of the bytes before
/// it.
fn misleading(unit_id: u8, function_code: u8, data: &[u8]) -> Vec<u8> {
    let head = [&[unit_id, function_code], data].concat();
    let [low, _] = rtu::crc(&head).to_le_bytes();
    [&head[1..], &[low]].concat()
}

#[test]
fn an_unknown_function_whose_crc_matches_too_early_has_the_right_length() {
    let pdu = misleading(7, 0x63, &[1, 2, 3]);
    for next in [frame(1, &[3, 0, 0, 0, 1]), frame(0, &[17]), vec![]] {
        let sent = [frame(7, &pdu), next].concat();
        let len = pdu.len() + 3;
        assert_eq!(next_request(&sent), Next::Frame { unit_id: 7, pdu: &pdu, len });
    }
}

#[test]
fn a_frame_for_unit_0_after_an_unknown_function_keeps_its_first_byte() {
    let (unknown, next) = (frame(7, &[0x63]), frame(0, &[3, 0, 0, 0, 1]));
    let sent = [&unknown[..], &next].concat();
    let len = unknown.len();
    assert_eq!(next_request(&sent), Next::Frame { unit_id: 7, pdu: &[0x63], len });
}

proptest! {
    #[test]
    fn a_frame_never_exceeds_the_received_bytes(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        match next_request(&bytes) {
            Next::Frame { len, .. } | Next::Damaged { len } => {
                prop_assert!((4..=bytes.len().min(rtu::MAX_LEN)).contains(&len));
            }
            Next::Incomplete => prop_assert!(bytes.len() < rtu::MAX_LEN),
            Next::Broken => {}
        }
    }
}

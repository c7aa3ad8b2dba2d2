//! Tests RTU requests in a stream, as in RTU over TCP.

use holdfast_protocol::frame::FrameError;
use holdfast_protocol::frame::rtu;
use holdfast_protocol::frame::rtu_stream::{Next, Requests};
use proptest::prelude::*;

fn frame(unit_id: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = [0; rtu::MAX_LEN];
    let len = rtu::encode(unit_id, pdu, &mut frame).unwrap();
    frame[..len].to_vec()
}

fn damaged(unit_id: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = frame(unit_id, pdu);
    *frame.last_mut().unwrap() ^= 1;
    frame
}

/// A PDU of an unknown function. Its last byte equals the first byte of the CRC of the bytes before
/// it.
fn misleading(unit_id: u8, function_code: u8, data: &[u8]) -> Vec<u8> {
    let head = [&[unit_id, function_code], data].concat();
    let [low, _] = rtu::crc(&head).to_le_bytes();
    [&head[1..], &[low]].concat()
}

/// What is found in a stream.
#[derive(Debug, Default, PartialEq, Eq)]
struct Seen {
    /// Unit ids and function codes, and where their frames end.
    frames: Vec<(u8, u8, usize)>,
    damaged: usize,
    rest: Vec<u8>,
    is_at_start: bool,
}

fn seen<'p>(pieces: impl IntoIterator<Item = &'p [u8]>) -> Seen {
    let (mut requests, mut seen, mut end) = (Requests::default(), Seen::default(), 0);
    for piece in pieces {
        seen.rest.extend_from_slice(piece);
        loop {
            let len = match requests.next(&seen.rest) {
                Next::Incomplete => break,
                Next::Frame { unit_id, pdu, len } => {
                    seen.frames.push((unit_id, pdu[0], end + len));
                    len
                }
                Next::Damaged { len } => {
                    seen.damaged += 1;
                    len
                }
                Next::Stray { len } => len,
            };
            seen.rest.drain(..len);
            end += len;
        }
        assert!(seen.rest.len() <= rtu::MAX_LEN);
    }
    seen.is_at_start = requests.is_at_start();
    seen
}

/// What is found, however the stream is cut.
fn seen_however_cut(stream: &[u8]) -> Seen {
    let whole = seen([stream]);
    assert_eq!(seen(stream.chunks(1)), whole, "byte by byte");
    for cut in 1..stream.len() {
        assert_eq!(seen([&stream[..cut], &stream[cut..]]), whole, "cut at {cut}");
    }
    whole
}

fn units(seen: &Seen) -> Vec<u8> {
    seen.frames.iter().map(|(unit_id, ..)| *unit_id).collect()
}

#[test]
fn an_unknown_function_whose_crc_matches_too_early_does_not_upset_the_next_frame() {
    let pdu = misleading(7, 0x63, &[1, 2, 3]);
    for next in [frame(1, &[3, 0, 0, 0, 1]), frame(16, &[3, 0, 0, 0, 1]), frame(0, &[17])] {
        let seen = seen_however_cut(&[frame(7, &pdu), next.clone()].concat());
        assert_eq!(units(&seen), [7, next[0]]);
        assert_eq!((seen.damaged, seen.is_at_start), (0, true));
    }
}

#[test]
fn a_frame_for_unit_0_after_an_unknown_function_keeps_its_first_byte() {
    let sent = [frame(7, &[0x63]), frame(0, &[3, 0, 0, 0, 1])].concat();
    assert_eq!(units(&seen_however_cut(&sent)), [7, 0]);
}

#[test]
fn a_zero_after_an_unknown_function_that_starts_no_frame_is_not_searched_behind() {
    let noise = [0, 3, 0, 0, 0, 1, 0, 0, 0, 0];
    let sent = [&frame(7, &[0x63])[..], &noise, &frame(1, &[17])].concat();
    let seen = seen_however_cut(&sent);
    assert_eq!((units(&seen), seen.is_at_start), (vec![7], false));
}

#[test]
fn a_frame_directly_behind_a_damaged_one_is_found() {
    let read = frame(1, &[3, 0, 0, 0, 1]);
    let seen = seen_however_cut(&[damaged(2, &[3, 0, 0, 0, 1]), read.clone(), read].concat());
    assert_eq!((units(&seen), seen.damaged, seen.is_at_start), (vec![1, 1], 1, true));
}

#[test]
fn data_of_a_damaged_write_are_no_request_however_they_are_cut() {
    let inner = frame(1, &[6, 0, 0, 0x12, 0x34]);
    let write = [&[16, 0, 5, 0, 4, 8][..], &inner].concat();
    let read = frame(2, &[3, 0, 0, 0, 1]);
    // Damage to each byte in turn, also to the function code and the byte count.
    for at in 0..write.len() + 3 {
        for flipped in [1, 0x80, 0xFF] {
            let mut sent = frame(1, &write);
            sent[at] ^= flipped;
            let seen = seen_however_cut(&[sent, read.clone()].concat());
            assert!(!units(&seen).contains(&1), "byte {at} ^ {flipped}");
        }
    }
}

#[test]
fn what_an_incomplete_write_swallows_is_never_found() {
    // 123 registers are announced.
    let begun = [1, 16, 0, 0, 0, 0x7B, 0xF6];
    let read = frame(1, &[3, 0, 0, 0, 1]);
    let seen = seen_however_cut(&[&begun[..], &read].concat());
    assert_eq!((seen.frames.len(), seen.rest.len()), (0, 7 + 8));
    // The announced length ends between two requests: the next one is current.
    let seen = seen_however_cut(&[&begun[..], &read.repeat(32)].concat());
    assert_eq!((seen.frames, seen.damaged), (vec![(1, 3, 7 + 32 * 8)], 1));
    // Here it ends within one.
    let seen = seen_however_cut(&[&begun[..], &[0], &read.repeat(40)].concat());
    assert_eq!((seen.frames, seen.damaged, seen.is_at_start), (vec![], 1, false));
}

#[test]
fn behind_a_request_of_known_length_the_next_one_begins() {
    for (pdu, is_at_start) in [
        (&[3, 0, 0, 0, 1][..], true),
        (&[8, 0, 0, 1, 2], true),
        (&[17], true),
        (&[16, 0, 0, 0, 1, 2, 0, 7], true),
        (&[20, 7, 6, 0, 1, 0, 0, 0, 1], true),
        (&[21, 9, 6, 0, 1, 0, 0, 0, 1, 0, 7], true),
        (&[22, 0, 0, 0, 1, 0, 2], true),
        (&[23, 0, 0, 0, 1, 0, 0, 0, 1, 2, 0, 7], true),
        (&[24, 0, 0], true),
        (&[43, 14, 1, 0], true),
        (&[43, 13, 1, 0], false),
        (&[0x41, 1], false),
    ] {
        let mut requests = Requests::default();
        let frame = frame(7, pdu);
        let next = Next::Frame { unit_id: 7, pdu, len: frame.len() };
        assert_eq!(requests.next(&frame), next);
        assert_eq!(requests.is_at_start(), is_at_start, "{pdu:?}");
    }
}

#[test]
fn a_byte_other_than_0_after_an_unknown_function_begins_a_frame() {
    let stream = [&frame(7, &[0x41, 1])[..], &[9], &frame(7, &[3, 0, 0, 0, 1])].concat();
    assert_eq!(units(&seen_however_cut(&stream)), [7]);
}

#[test]
fn of_two_frames_after_an_unknown_function_the_one_that_ends_first_is_found() {
    // The zero begins a write to unit 0, and is followed by a read of unit 16.
    let mut both = [&[0][..], &frame(16, &[3, 0, 0, 0, 4]), &[1, 2]].concat();
    both.extend(rtu::crc(&both).to_le_bytes());
    let seen = seen_however_cut(&[frame(7, &[0x41, 1]), both].concat());
    assert_eq!(units(&seen), [7, 16]);

    // A write to unit 0, in which a write to unit 16 begins that ends later.
    let zero = frame(0, &[16, 16, 0, 0, 1, 1, 4]);
    let mut later = [&zero[1..], &[1, 7]].concat();
    later.extend(rtu::crc(&later).to_le_bytes());
    let seen = seen_however_cut(&[frame(7, &[0x41, 1]), vec![0], later].concat());
    assert_eq!(units(&seen), [7, 0]);
}

#[test]
fn a_request_of_more_than_256_bytes_is_not_waited_for() {
    let next = |count| Requests::default().next(&[1, 16, 0, 0, 0, 1, count]) == Next::Incomplete;
    assert_eq!([247, 248, 255].map(next), [true, false, false]);
}

#[test]
fn a_reply_has_at_most_256_bytes() {
    assert_eq!(rtu::response_len(&[1, 20, 251], 9), Ok(Some(256)));
    assert_eq!(rtu::response_len(&[1, 20, 252], 9), Err(FrameError::Length));
}

fn stream() -> impl Strategy<Value = Vec<u8>> {
    let code = prop_oneof![prop::sample::select(vec![3, 7, 16, 17, 23, 24, 43]), any::<u8>()];
    let unit = prop_oneof![0..3_u8, any::<u8>()];
    let data = prop::collection::vec(any::<u8>(), 0..12);
    let framed = (unit.clone(), code.clone(), data)
        .prop_map(|(unit, code, data)| frame(unit, &[&[code], &data[..]].concat()));
    let misled = (unit.clone(), prop::collection::vec(any::<u8>(), 0..4))
        .prop_map(|(unit, data)| frame(unit, &misleading(unit, 0x63, &data)));
    let known = unit.prop_map(|unit| frame(unit, &[3, 0, 0, 0, 1]));
    let cut = framed.clone().prop_map(|frame| frame[..frame.len() - 1].to_vec());
    let broken = known.clone().prop_map(|mut frame| {
        frame[7] ^= 1;
        frame
    });
    let noise = prop::collection::vec(any::<u8>(), 0..300);
    let same = (any::<u8>(), 0..300_usize).prop_map(|(byte, count)| vec![byte; count]);
    let parts = prop_oneof![
        4 => known, 3 => framed, 2 => misled, 1 => cut, 1 => broken, 1 => noise, 1 => same
    ];
    prop::collection::vec(parts, 0..6).prop_map(|parts| parts.concat())
}

proptest! {
    #[test]
    fn what_is_found_does_not_depend_on_the_cuts(bytes in stream(), size in 1..40_usize) {
        let whole = seen([&bytes[..]]);
        prop_assert_eq!(&seen(bytes.chunks(1)), &whole);
        prop_assert_eq!(&seen(bytes.chunks(size)), &whole);
    }

    #[test]
    fn a_frame_never_exceeds_the_received_bytes(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        match Requests::default().next(&bytes) {
            Next::Frame { len, .. } => {
                prop_assert!((4..=bytes.len().min(rtu::MAX_LEN)).contains(&len));
            }
            Next::Damaged { len } => prop_assert!((3..=bytes.len()).contains(&len)),
            Next::Incomplete => prop_assert!(bytes.len() < rtu::MAX_LEN),
            Next::Stray { .. } => prop_assert!(false, "the first byte starts a frame"),
        }
    }
}

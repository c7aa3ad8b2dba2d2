//! Tests Raw Ingest packets with any content.

use std::num::NonZeroU16;

use holdfast_protocol::raw_ingest::{Area, EncodeError, Format, Header, Refusal};
use proptest::prelude::*;

fn a_format() -> impl Strategy<Value = Format> {
    prop_oneof![Just(Format::V1), any::<bool>().prop_map(|required| Format::Crc { required })]
}

fn a_packet() -> impl Strategy<Value = (Header, Vec<u8>)> {
    let fields = (prop::sample::select(Area::ALL), any::<(u16, u16)>(), 1..600u16);
    fields.prop_flat_map(|(area, (target, address), count)| {
        let header = Header { area, target, address, count: NonZeroU16::new(count).unwrap() };
        let payload = prop::collection::vec(any::<u8>(), header.payload_len());
        payload.prop_map(move |payload| (header, payload))
    })
}

fn encoded(format: Format, header: &Header, payload: &[u8]) -> Vec<u8> {
    let mut packet = vec![0; format.packet_len(header)];
    assert_eq!(format.encode_to_slice(header, payload, &mut packet), Ok(packet.len()));
    packet
}

proptest! {
    #[test]
    fn what_is_encoded_decodes_to_the_same((header, payload) in a_packet(), format in a_format()) {
        let packet = encoded(format, &header, &payload);
        prop_assert_eq!(format.header(&packet), Ok(Some(header)));
        prop_assert_eq!(format.payload(&header, &packet), Ok(&payload[..]));
        #[cfg(feature = "alloc")]
        {
            let mut appended = vec![1, 2, 3];
            prop_assert_eq!(format.encode(&header, &payload, &mut appended), Ok(()));
            prop_assert_eq!(&appended[..3], [1, 2, 3]);
            prop_assert_eq!(&appended[3..], packet);
        }
    }

    #[test]
    fn what_follows_a_packet_does_not_change_it(
        (header, payload) in a_packet(),
        format in a_format(),
        behind in prop::collection::vec(any::<u8>(), 0..20),
    ) {
        let bytes = [encoded(format, &header, &payload), behind].concat();
        prop_assert_eq!(format.header(&bytes), Ok(Some(header)));
        prop_assert_eq!(format.payload(&header, &bytes), Ok(&payload[..]));
    }

    #[test]
    fn a_header_is_judged_the_same_however_many_of_its_bytes_have_arrived(
        (header, payload) in a_packet(),
        format in a_format(),
        damage in prop::collection::vec((0..12_usize, any::<u8>()), 0..4),
    ) {
        let mut packet = encoded(format, &header, &payload);
        for (at, byte) in damage {
            packet[at] = byte;
        }
        for judged in [Format::header, Format::header_with_any_flags] {
            let mut outcome = Ok(None);
            for len in 0..=packet.len() {
                let now = judged(format, &packet[..len]);
                prop_assert!(outcome == Ok(None) || now == outcome, "{outcome:?}, then {now:?}");
                outcome = now;
            }
        }
    }

    #[test]
    fn a_flipped_bit_does_not_pass_the_crc(
        (header, payload) in a_packet(),
        flip: prop::sample::Index,
        bit in 0..8,
    ) {
        let format = Format::Crc { required: true };
        let mut packet = encoded(format, &header, &payload);
        packet[flip.index(payload.len()) + format.header_len()] ^= 1u8 << bit;
        prop_assert_eq!(format.payload(&header, &packet), Err(Refusal::Crc));
    }

    #[test]
    fn flags_matter_only_where_they_are_checked(
        (header, payload) in a_packet(),
        flags: u8,
        reserved: u8,
        required: bool,
    ) {
        let format = Format::Crc { required };
        let mut packet = encoded(format, &header, &payload);
        (packet[3], packet[5]) = (flags, reserved);
        let strict = if (flags, reserved) == (0, 0) { Ok(Some(header)) } else { Err(Refusal::Flags) };
        prop_assert_eq!(format.header(&packet), strict);
        for len in 0..packet.len() {
            let known = (len >= format.header_len()).then_some(header);
            prop_assert_eq!(format.header_with_any_flags(&packet[..len]), Ok(known));
        }
        // The version is never ignored: it is what tells a packet from a Modbus frame.
        packet[2] = 0;
        prop_assert_eq!(format.header_with_any_flags(&packet), Err(Refusal::Version));
    }

    #[test]
    fn any_bytes_are_a_header_incomplete_or_refused(
        bytes in prop::collection::vec(prop_oneof![Just(0), Just(1), any::<u8>()], 0..40),
        format in a_format(),
        starts_well: bool,
    ) {
        let start: &[u8] = if starts_well { b"RI\x01" } else { &[] };
        let packet = [start, &bytes].concat();
        match format.header(&packet) {
            Ok(Some(header)) => {
                prop_assert!(packet.len() >= format.header_len());
                let _ = format.payload(&header, &packet);
            }
            Ok(None) => prop_assert!(packet.len() < format.header_len()),
            Err(refusal) => prop_assert!(matches!(
                refusal,
                Refusal::Magic | Refusal::Version | Refusal::Flags | Refusal::Area | Refusal::Count
            )),
        }
    }
}

#[test]
fn a_packet_that_its_header_does_not_describe_is_not_encoded() {
    let count = NonZeroU16::new(2).unwrap();
    let header = Header { area: Area::HoldingRegisters, target: 1, address: 0, count };
    let mut packet = [0; 16];
    for payload in [&[0; 3][..], &[0; 5]] {
        let refused = EncodeError::Payload { found: payload.len(), expected: 4 };
        assert_eq!(Format::V1.encode_to_slice(&header, payload, &mut packet), Err(refused));
        #[cfg(feature = "alloc")]
        {
            let mut appended = vec![1, 2, 3];
            assert_eq!(Format::V1.encode(&header, payload, &mut appended), Err(refused));
            assert_eq!(appended, [1, 2, 3]);
        }
    }
    let refused = EncodeError::Room { found: 13, expected: 14 };
    assert_eq!(Format::V1.encode_to_slice(&header, &[0; 4], &mut packet[..13]), Err(refused));
}

#[cfg(feature = "alloc")]
#[test]
fn both_bytes_of_the_magic_number_are_checked() {
    let header = Header { area: Area::ALL[0], target: 0, address: 0, count: NonZeroU16::MIN };
    let mut packet = Vec::new();
    Format::V1.encode(&header, &vec![0; header.payload_len()], &mut packet).unwrap();
    for at in [0, 1] {
        let mut wrong = packet.clone();
        wrong[at] ^= 1;
        assert_eq!(Format::V1.header(&wrong), Err(Refusal::Magic));
    }
}

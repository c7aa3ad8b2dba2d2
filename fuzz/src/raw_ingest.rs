//! A Raw Ingest packet, in every format.

use holdfast_protocol::raw_ingest::{Format, Refusal};

const FORMATS: [Format; 3] =
    [Format::V1, Format::Crc { required: false }, Format::Crc { required: true }];

/// A header is judged the same however many of its bytes have arrived, and a packet is the encoding of its
/// header and payload.
pub fn check(data: &[u8]) {
    for format in FORMATS {
        for judged in [Format::header, Format::header_with_any_flags] {
            let mut outcome = Ok(None);
            for len in 0..=data.len().min(2 * format.header_len()) {
                let now = judged(format, &data[..len]);
                assert!(outcome == Ok(None) || now == outcome, "{outcome:?}, then {now:?}");
                outcome = now;
            }
        }
        let Ok(Some(header)) = format.header(data) else { continue };
        let expected = format.packet_len(&header);
        let payload = match format.payload(&header, data) {
            Ok(payload) => payload,
            Err(Refusal::Short) => {
                assert!(data.len() < expected);
                continue;
            }
            // A fuzzer does not find checksums: the packet with the right one.
            Err(Refusal::Crc) => &data[format.header_len()..][..header.payload_len()],
            Err(refusal) => panic!("{refusal:?} of a payload"),
        };
        let mut packet = Vec::new();
        format.encode(&header, payload, &mut packet).expect("the payload has the right length");
        let body = expected - format.trailer_len();
        assert_eq!(packet.len(), expected);
        assert_eq!(packet[..body], data[..body]);
        assert_eq!(format.payload(&header, &packet), Ok(payload));
        assert_eq!(format.payload(&header, data).is_ok(), data.starts_with(&packet));
    }
}

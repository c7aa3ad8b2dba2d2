//! Tests the shared vectors, except for what depends on a memory.

use std::path::Path;

use holdfast_protocol::frame::{ascii, mbap, rtu};
use holdfast_protocol::pdu::{self, ExceptionCode, Request, ResponseError};
use holdfast_protocol::raw_ingest::{Format, Refusal};
use serde::Deserialize;

#[derive(Deserialize)]
struct Vectors<T> {
    cases: Vec<T>,
}

#[derive(Deserialize)]
struct FrameCase {
    unit: u8,
    pdu: String,
    mbap: String,
    rtu: String,
    ascii: String,
}

#[derive(Deserialize)]
struct PduCase {
    name: String,
    request: String,
    response: String,
}

fn cases<T: for<'de> Deserialize<'de>>(name: &str) -> Vec<T> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/vectors").join(name);
    let vectors: Vectors<T> = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    assert!(!vectors.cases.is_empty());
    vectors.cases
}

fn unhex(text: &str) -> Vec<u8> {
    (0..text.len())
        .step_by(2)
        .map(|at| u8::from_str_radix(&text[at..at + 2], 16).unwrap())
        .collect()
}

#[test]
fn frames_encode_and_decode_as_the_vectors_say() {
    for case in cases::<FrameCase>("frames.json") {
        let (unit, pdu) = (case.unit, unhex(&case.pdu));

        let frame = unhex(&case.mbap);
        let header = mbap::header(0x1A2B, unit, pdu.len());
        assert_eq!([&header[..], &pdu].concat(), frame);
        let mut buffer = [0; mbap::MAX_LEN];
        let len = mbap::encode(0x1A2B, unit, &pdu, &mut buffer).unwrap();
        assert_eq!(buffer[..len], frame);
        let expected = mbap::Next::Frame {
            transaction_id: 0x1A2B,
            unit_id: unit,
            pdu: &pdu,
            len: frame.len(),
        };
        assert_eq!(mbap::next(&frame), expected);

        let mut buffer = [0; rtu::MAX_LEN];
        let len = rtu::encode(unit, &pdu, &mut buffer).unwrap();
        assert_eq!(buffer[..len], unhex(&case.rtu));
        assert_eq!(rtu::decode(&buffer[..len]), Ok((unit, &pdu[..])));

        let mut buffer = [0; ascii::MAX_LEN];
        let len = ascii::encode(unit, &pdu, &mut buffer).unwrap();
        assert_eq!(&buffer[..len], case.ascii.as_bytes());
        assert_eq!(ascii::decode(&buffer[..len], &mut [0; 255]), Ok((unit, &pdu[..])));
    }
}

#[test]
fn requests_parse_encode_and_answer_as_the_vectors_say() {
    let served = cases::<PduCase>("pdu.json");
    for case in served.into_iter().chain(cases("device_pdu.json")) {
        let (request, response) = (unhex(&case.request), unhex(&case.response));
        let parsed = Request::parse(&request);
        match (response[0] & 0x80 != 0).then(|| ExceptionCode::from_code(response[1]).unwrap()) {
            None => {
                let parsed = parsed.unwrap_or_else(|error| panic!("{}: {error}", case.name));
                let mut buffer = [0; pdu::MAX_LEN];
                let len = parsed.encode(&mut buffer);
                assert_eq!(buffer[..len], request, "{}", case.name);
                assert!(parsed.response(&response).is_ok(), "{}", case.name);
            }
            // A memory decides whether an address exists.
            Some(code @ ExceptionCode::IllegalDataAddress) => {
                let answer = parsed.unwrap().response(&response);
                assert_eq!(answer, Err(ResponseError::Exception(code)), "{}", case.name);
            }
            Some(code) => assert_eq!(parsed, Err(code), "{}", case.name),
        }
    }
}

#[derive(Deserialize)]
struct RawCases {
    accepted: Vec<RawCase>,
    followed: Vec<RawCase>,
    refused: Vec<RawCase>,
}

#[derive(Deserialize)]
struct RawCase {
    name: String,
    v1: Option<String>,
    crc: Option<String>,
    /// Bytes behind the packet.
    #[serde(default)]
    surplus: usize,
}

fn raw_cases() -> RawCases {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/vectors/raw_ingest.json");
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn raw_packets(case: &RawCase) -> impl Iterator<Item = (Format, Vec<u8>)> {
    let crc = Format::Crc { required: true };
    let packets = [(Format::V1, &case.v1), (crc, &case.crc)];
    packets.into_iter().filter_map(|(format, hex)| Some((format, unhex(hex.as_ref()?))))
}

#[test]
fn raw_packets_decode_and_encode_as_the_vectors_say() {
    let cases = raw_cases();
    for case in cases.accepted.iter().chain(&cases.followed) {
        for (format, bytes) in raw_packets(case) {
            let packet = &bytes[..bytes.len() - case.surplus];
            let header = format.header(&bytes).unwrap().unwrap();
            let payload = format.payload(&header, &bytes).unwrap();
            let mut encoded = vec![0; format.packet_len(&header)];
            assert_eq!(
                format.encode_to_slice(&header, payload, &mut encoded),
                Ok(packet.len()),
                "{}",
                case.name
            );
            assert_eq!(encoded, packet, "{}", case.name);
            for cut in 0..packet.len() {
                let header = format.header(&packet[..cut]).unwrap();
                let whole = header.map(|header| format.payload(&header, &packet[..cut]));
                assert!(matches!(whole, None | Some(Err(Refusal::Short))), "{}", case.name);
            }
        }
    }
}

#[test]
fn raw_packets_are_refused_as_the_vectors_say() {
    for case in raw_cases().refused {
        for (format, packet) in raw_packets(&case) {
            let found = match format.header(&packet) {
                Ok(Some(header)) => format.payload(&header, &packet).err(),
                Ok(None) => Some(Refusal::Short),
                Err(refusal) => Some(refusal),
            };
            let expected = match case.name.as_str() {
                "magic" => Some(Refusal::Magic),
                "version 2" => Some(Refusal::Version),
                "area 0" | "area 5" => Some(Refusal::Area),
                "count 0" => Some(Refusal::Count),
                "payload one byte short" | "header cut" | "nothing at all" => Some(Refusal::Short),
                "the other format" if format == Format::V1 => Some(Refusal::Area),
                "the other format" | "flags not zero" | "reserved not zero" => Some(Refusal::Flags),
                "wrong CRC" => Some(Refusal::Crc),
                // Only a listener can check these: units, memories, ranges.
                _ => None,
            };
            assert_eq!(found, expected, "{} {format:?}", case.name);
        }
    }
}

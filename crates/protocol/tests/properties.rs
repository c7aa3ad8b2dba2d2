//! What holds for all bytes and all requests.

use holdfast_protocol::frame::{ascii, mbap, rtu};
use holdfast_protocol::pdu::identification::{Objects, ReadCode};
use holdfast_protocol::pdu::{
    self, Diagnostics, ExceptionCode, Function, Range, Request, Response, ResponseError,
    SubFunction, limit, reply,
};
use proptest::prelude::*;

fn a_range(most: u16) -> impl Strategy<Value = Range> {
    (any::<u16>(), 1..=most).prop_map(|(address, quantity)| Range { address, quantity })
}

/// A request as parts that own their data.
#[derive(Debug, Clone)]
enum Parts {
    Whole(Request<'static>),
    Bits(Range, Vec<u8>),
    Registers(Range, Vec<u8>),
    ReadWrite(Range, Range, Vec<u8>),
    Query(Vec<u8>),
}

impl Parts {
    fn request(&self) -> Request<'_> {
        match self {
            Parts::Whole(request) => *request,
            Parts::Bits(range, bits) => Request::WriteMultipleCoils { range: *range, bits },
            Parts::Registers(range, registers) => {
                Request::WriteMultipleRegisters { range: *range, registers }
            }
            Parts::ReadWrite(read, write, registers) => {
                Request::ReadWriteMultipleRegisters { read: *read, write: *write, registers }
            }
            Parts::Query(data) => Request::Diagnostics(Diagnostics {
                sub_function: SubFunction::ReturnQueryData,
                data,
            }),
        }
    }
}

fn data(len: usize) -> impl Strategy<Value = Vec<u8>> {
    prop::collection::vec(any::<u8>(), len)
}

fn a_request() -> impl Strategy<Value = Parts> {
    let code = prop::sample::select(vec![
        ReadCode::Basic,
        ReadCode::Regular,
        ReadCode::Extended,
        ReadCode::Individual,
    ]);
    let whole = prop_oneof![
        a_range(limit::READ_BITS).prop_map(Request::ReadCoils),
        a_range(limit::READ_BITS).prop_map(Request::ReadDiscreteInputs),
        a_range(limit::READ_REGISTERS).prop_map(Request::ReadHoldingRegisters),
        a_range(limit::READ_REGISTERS).prop_map(Request::ReadInputRegisters),
        any::<(u16, bool)>()
            .prop_map(|(address, value)| Request::WriteSingleCoil { address, value }),
        any::<(u16, u16)>()
            .prop_map(|(address, value)| Request::WriteSingleRegister { address, value }),
        any::<(u16, u16, u16)>().prop_map(|(address, and_mask, or_mask)| {
            Request::MaskWriteRegister { address, and_mask, or_mask }
        }),
        (code, any::<u8>())
            .prop_map(|(code, object_id)| Request::ReadDeviceIdentification { code, object_id }),
        Just(Request::GetCommEventCounter),
        Just(Request::ReportServerId),
    ];
    prop_oneof![
        whole.prop_map(Parts::Whole),
        a_range(limit::WRITE_BITS).prop_flat_map(|range| {
            data(usize::from(range.quantity).div_ceil(8))
                .prop_map(move |bits| Parts::Bits(range, bits))
        }),
        a_range(limit::WRITE_REGISTERS).prop_flat_map(|range| {
            data(usize::from(range.quantity) * 2)
                .prop_map(move |registers| Parts::Registers(range, registers))
        }),
        (a_range(limit::READ_REGISTERS), a_range(limit::READ_WRITE_REGISTERS))
            .prop_flat_map(|(read, write)| data(usize::from(write.quantity) * 2)
                .prop_map(move |registers| Parts::ReadWrite(read, write, registers))),
        (1..=124usize).prop_flat_map(|words| data(words * 2).prop_map(Parts::Query)),
    ]
}

/// Mostly known functions, so that the checks behind the first byte are reached.
fn bytes_like_a_pdu() -> impl Strategy<Value = Vec<u8>> {
    let code = prop_oneof![
        9 => prop::sample::select(vec![1, 2, 3, 4, 5, 6, 8, 11, 15, 16, 17, 22, 23, 43]),
        1 => any::<u8>()
    ];
    (code, prop::collection::vec(prop_oneof![Just(0), any::<u8>()], 0..253))
        .prop_map(|(code, body)| std::iter::once(code).chain(body).collect())
}

proptest! {
    #[test]
    fn what_is_encoded_parses_to_the_same_request(parts in a_request()) {
        let request = parts.request();
        let mut buffer = [0; pdu::MAX_LEN];
        let len = request.encode(&mut buffer).unwrap();
        prop_assert_eq!(Request::parse(&buffer[..len]), Ok(request));
    }

    #[test]
    fn a_pdu_cut_or_stretched_is_never_carried_out(parts in a_request(), more in 1..5usize) {
        let mut buffer = [0; pdu::MAX_LEN];
        let len = parts.request().encode(&mut buffer).unwrap();
        let refused = Err(ExceptionCode::IllegalDataValue);
        let any_even = matches!(parts, Parts::Query(_));
        for cut in 1..len {
            let parsed = Request::parse(&buffer[..cut]);
            prop_assert!(parsed == refused || (any_even && cut > 3 && cut % 2 == 1));
        }
        if len + more <= buffer.len() && !any_even {
            prop_assert_eq!(Request::parse(&buffer[..len + more]), refused);
        }
    }

    #[test]
    fn any_bytes_parse_or_are_refused_and_what_parses_encodes_to_the_same_bytes(
        bytes in bytes_like_a_pdu(),
    ) {
        let mut buffer = [0; pdu::MAX_LEN];
        match Request::parse(&bytes) {
            Ok(request) => {
                let len = request.encode(&mut buffer).unwrap();
                prop_assert_eq!(&buffer[..len], &bytes[..]);
            }
            Err(code) => {
                let known = Function::from_code(bytes[0]).is_some();
                let sub_function = bytes[0] == 8 || bytes[0] == 43;
                prop_assert!(known || code == ExceptionCode::IllegalFunction);
                prop_assert!(!known || sub_function || code == ExceptionCode::IllegalDataValue);
            }
        }
    }

    #[test]
    fn any_bytes_as_a_response_are_taken_only_when_they_fit_the_request(
        parts in a_request(),
        bytes in prop::collection::vec(any::<u8>(), 0..260),
    ) {
        let request = parts.request();
        if request.response(&bytes).is_ok() {
            prop_assert_eq!(bytes[0], request.function().code());
        }
    }

    #[test]
    fn the_reply_to_a_read_is_read_back(range in a_range(limit::READ_REGISTERS), seed: u8) {
        let request = Request::ReadHoldingRegisters(range);
        let mut buffer = [0; pdu::MAX_LEN];
        let bytes = range.quantity as u8 * 2;
        let (payload, len) = reply::counted(request.function(), bytes, &mut buffer);
        payload.fill(seed);
        let expected = vec![seed; usize::from(bytes)];
        prop_assert_eq!(request.response(&buffer[..len]), Ok(Response::Registers(&expected)));
        let other = Range { quantity: range.quantity % 125 + 1, ..range };
        let answer = Request::ReadHoldingRegisters(other).response(&buffer[..len]);
        prop_assert_eq!(answer, Err(ResponseError::Length));
    }

    #[test]
    fn any_bytes_end_in_a_frame_a_wait_or_an_end(
        bytes in prop::collection::vec(prop_oneof![Just(0), Just(6), any::<u8>()], 0..300),
    ) {
        match mbap::next(&bytes) {
            mbap::Next::Incomplete => prop_assert!(bytes.len() < mbap::MAX_LEN),
            mbap::Next::Frame { pdu, len, .. } => {
                prop_assert_eq!(pdu.len() + mbap::HEADER_LEN, len);
                prop_assert!(len <= bytes.len());
            }
            mbap::Next::Foreign { protocol_id, len } => {
                prop_assert_ne!(protocol_id, 0);
                prop_assert!(len <= bytes.len());
            }
            mbap::Next::Broken { length } => prop_assert!(!(2..=254).contains(&length)),
        }
        let _ = rtu::decode(&bytes);
        let _ = ascii::decode(&bytes, &mut [0; 255]);
    }

    #[test]
    fn serial_frames_carry_any_pdu_and_lose_no_flipped_bit(
        unit: u8,
        pdu in prop::collection::vec(any::<u8>(), 1..=pdu::MAX_LEN),
        flip: prop::sample::Index,
        bit in 0..8,
    ) {
        let mut frame = [0; rtu::MAX_LEN];
        let len = rtu::encode(unit, &pdu, &mut frame).unwrap();
        prop_assert_eq!(rtu::decode(&frame[..len]), Ok((unit, &pdu[..])));
        frame[flip.index(len)] ^= 1u8 << bit;
        prop_assert!(rtu::decode(&frame[..len]).is_err());

        let mut frame = [0; ascii::MAX_LEN];
        let len = ascii::encode(unit, &pdu, &mut frame).unwrap();
        let mut body = [0; 255];
        prop_assert_eq!(ascii::decode(&frame[..len], &mut body), Ok((unit, &pdu[..])));
        let digit = 1 + flip.index(len - 3);
        frame[digit] = if frame[digit] == b'0' { b'1' } else { b'0' };
        prop_assert!(ascii::decode(&frame[..len], &mut [0; 255]).is_err());
    }

    #[test]
    fn a_stream_of_identification_objects_is_read_whole(
        values in prop::collection::btree_map(
            prop_oneof![0..7u8, 0x80..=0xFFu8],
            prop::collection::vec(any::<u8>(), 0..=244),
            1..20,
        ),
    ) {
        let mut values = values;
        for id in 0..3 {
            values.entry(id).or_default();
        }
        let objects = values.iter().map(|(id, value)| (*id, value.clone().into_boxed_slice()));
        let objects = Objects::new(objects).unwrap();
        let (mut read, mut next) = (Vec::new(), Some(0));
        while let Some(object_id) = next {
            let code = ReadCode::Extended;
            let mut buffer = [0; pdu::MAX_LEN];
            let len = objects.reply(code, object_id, &mut buffer).unwrap();
            let request = Request::ReadDeviceIdentification { code, object_id };
            let Ok(Response::Identification(answer)) = request.response(&buffer[..len]) else {
                panic!("not an identification");
            };
            read.extend(answer.iter().map(|(id, value)| (id, value.to_vec())));
            next = answer.next;
        }
        prop_assert_eq!(read, values.into_iter().collect::<Vec<_>>());
    }
}

#[test]
fn a_request_that_a_server_would_refuse_is_not_encoded() {
    let range = |quantity| Range { address: 0, quantity };
    let mut buffer = [0; pdu::MAX_LEN];
    for request in [
        Request::ReadCoils(range(0)),
        Request::ReadCoils(range(2001)),
        Request::ReadHoldingRegisters(range(126)),
        Request::WriteMultipleRegisters { range: range(2), registers: &[0; 3] },
        Request::WriteMultipleRegisters { range: range(124), registers: &[0; 248] },
        Request::WriteMultipleCoils { range: range(9), bits: &[0; 300] },
    ] {
        assert_eq!(request.encode(&mut buffer), None);
    }
}

#[test]
fn identification_without_a_mandatory_object_is_refused() {
    let objects = |ids: &[u8]| ids.iter().map(|id| (*id, Box::from(&b"x"[..]))).collect::<Vec<_>>();
    assert!(Objects::new(objects(&[0, 1])).is_err());
    assert!(Objects::new(objects(&[0, 1, 2, 2])).is_err());
    assert!(Objects::new(objects(&[0, 1, 2, 7])).is_err());
    assert!(Objects::new(objects(&[2, 1, 0])).is_ok());
}

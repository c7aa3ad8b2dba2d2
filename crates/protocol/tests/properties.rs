//! Tests properties that hold for all bytes and all requests.

mod support;

use holdfast_protocol::frame::{ascii, mbap, rtu};
use holdfast_protocol::pdu::{
    self, BitRange, Bits, Diagnostics, ExceptionCode, FileRange, FileRanges, FileRecords, Function,
    Range, RegisterRange, Registers, Request, RequestError, SubFunction, limit,
};
use proptest::prelude::*;
use proptest::strategy::ValueTree;
use proptest::test_runner::TestRunner;
use support::{a_request, bytes_like_a_pdu};

proptest! {
    #[test]
    fn what_is_encoded_parses_to_the_same_request(parts in a_request()) {
        let request = parts.request();
        let mut buffer = [0; pdu::MAX_LEN];
        let len = request.encode(&mut buffer);
        prop_assert_eq!(Request::parse(&buffer[..len]), Ok(request));
        prop_assert!(buffer[len..].iter().all(|byte| *byte == 0), "nothing after the PDU");
    }

    #[test]
    fn a_pdu_that_is_too_short_or_too_long_is_never_carried_out(parts in a_request(), more in 1..5usize) {
        let mut buffer = [0; pdu::MAX_LEN];
        let request = parts.request();
        let len = request.encode(&mut buffer);
        let refused = Err(ExceptionCode::IllegalDataValue);
        // Return Query Data may have any number of words.
        let any_even = matches!(
            request,
            Request::Diagnostics(asked) if asked.sub_function() == SubFunction::ReturnQueryData
        );
        for cut in 1..len {
            let parsed = Request::parse(&buffer[..cut]);
            prop_assert!(parsed == refused || (any_even && cut > 3 && cut % 2 == 1));
        }
        if !any_even {
            let stretched = [&buffer[..len], &vec![0; more]].concat();
            prop_assert_eq!(Request::parse(&stretched), refused);
            prop_assert!(pdu::is_one_request(&buffer[..len]));
            prop_assert!(!pdu::is_one_request(&stretched), "the length of a request is known");
        }
    }

    #[test]
    fn any_bytes_parse_or_are_refused_and_what_parses_encodes_to_the_same_bytes(
        bytes in bytes_like_a_pdu(),
    ) {
        let mut buffer = [0; pdu::MAX_LEN];
        match Request::parse(&bytes) {
            Ok(request) => {
                let len = request.encode(&mut buffer);
                prop_assert_eq!(&buffer[..len], &bytes[..]);
            }
            Err(code) => {
                let known = Function::from_code(bytes[0]).is_some();
                let sub_function = bytes[0] == 8 || bytes[0] == 43;
                prop_assert!(known || code == ExceptionCode::IllegalFunction);
                let of_file = code == ExceptionCode::IllegalDataAddress && [20, 21].contains(&bytes[0]);
                let form = of_file || code == ExceptionCode::IllegalDataValue;
                prop_assert!(!known || sub_function || form);
            }
        }
    }

    #[test]
    fn bytes_of_any_length_parse_without_a_panic(
        code in prop_oneof![prop::sample::select(Function::ALL).prop_map(Function::code), any::<u8>()],
        body in prop::collection::vec(any::<u8>(), 0..600),
    ) {
        let pdu = [&[code], &body[..]].concat();
        if let Ok(request) = Request::parse(&pdu) {
            prop_assert!(pdu.len() <= pdu::MAX_LEN);
            prop_assert_eq!(request.function().code(), code);
        }
        let _ = SubFunction::from_pdu(&body);
        let _ = Request::parse(&body);
    }

    #[test]
    fn any_bytes_are_a_frame_incomplete_or_broken(
        bytes in prop::collection::vec(prop_oneof![Just(0), Just(6), any::<u8>()], 0..300),
    ) {
        match mbap::next(&bytes) {
            mbap::Next::Incomplete => prop_assert!(bytes.len() < mbap::MAX_LEN),
            mbap::Next::Frame { transaction_id, unit_id, pdu, len } => {
                let mut frame = [0; mbap::MAX_LEN];
                prop_assert_eq!(mbap::encode(transaction_id, unit_id, pdu, &mut frame), Some(len));
                prop_assert_eq!(&frame[..len], &bytes[..len]);
            }
            mbap::Next::Foreign { protocol_id, len } => {
                prop_assert_ne!(protocol_id, 0);
                prop_assert!(len <= bytes.len());
            }
            mbap::Next::Broken { length } => prop_assert!(!(2..=254).contains(&length)),
        }
        let _ = rtu::decode(&bytes);
        let _ = ascii::decode(&bytes, &mut [0; ascii::MAX_BODY_LEN]);
        if let Ok(Some(len)) = rtu::response_len(&bytes, bytes.len()) {
            prop_assert!((4..=rtu::MAX_LEN).contains(&len));
        }
    }

    #[test]
    fn frames_carry_any_pdu_and_serial_frames_detect_a_flipped_bit(
        transaction_id: u16,
        unit: u8,
        pdu in prop::collection::vec(any::<u8>(), 1..=pdu::MAX_LEN),
        flip: prop::sample::Index,
        bit in 0..8,
    ) {
        let mut frame = [0; mbap::MAX_LEN];
        let len = mbap::encode(transaction_id, unit, &pdu, &mut frame).unwrap();
        let expected = mbap::Next::Frame { transaction_id, unit_id: unit, pdu: &pdu, len };
        prop_assert_eq!(mbap::next(&frame), expected);

        let mut frame = [0; rtu::MAX_LEN];
        let len = rtu::encode(unit, &pdu, &mut frame).unwrap();
        prop_assert_eq!(rtu::decode(&frame[..len]), Ok((unit, &pdu[..])));
        frame[flip.index(len)] ^= 1u8 << bit;
        prop_assert!(rtu::decode(&frame[..len]).is_err());

        let mut frame = [0; ascii::MAX_LEN];
        let len = ascii::encode(unit, &pdu, &mut frame).unwrap();
        let mut body = [0; ascii::MAX_BODY_LEN];
        prop_assert_eq!(ascii::decode(&frame[..len], &mut body), Ok((unit, &pdu[..])));
        let digit = 1 + flip.index(len - 3);
        frame[digit] = if frame[digit] == b'0' { b'1' } else { b'0' };
        prop_assert!(ascii::decode(&frame[..len], &mut [0; ascii::MAX_BODY_LEN]).is_err());
    }

    #[test]
    fn packed_values_are_read_back(
        bits in prop::collection::vec(any::<bool>(), 1..=usize::from(limit::WRITE_BITS)),
        registers in prop::collection::vec(any::<u16>(), 1..=usize::from(limit::WRITE_REGISTERS)),
    ) {
        let mut room = [0xFF; pdu::MAX_LEN];
        let packed = Bits::<{ limit::WRITE_BITS }>::pack(&bits, &mut room).unwrap();
        prop_assert_eq!(packed.iter().collect::<Vec<_>>(), &bits[..]);
        let each = (0..=packed.quantity()).map_while(|index| packed.get(index));
        prop_assert_eq!(each.collect::<Vec<_>>(), &bits[..]);
        prop_assert_eq!(packed.get(u16::MAX), None);
        let last = *packed.as_bytes().last().unwrap();
        prop_assert!(u32::from(last) < 1 << ((bits.len() - 1) % 8 + 1), "unused bits are 0");

        let packed = Registers::<{ limit::WRITE_REGISTERS }>::pack(&registers, &mut room).unwrap();
        prop_assert_eq!(packed.iter().collect::<Vec<_>>(), &registers[..]);
        let each = (0..=packed.quantity()).map_while(|index| packed.get(index));
        prop_assert_eq!(each.collect::<Vec<_>>(), &registers[..]);
        prop_assert_eq!(packed.get(u16::MAX), None);
    }
}

/// Checks for each quantity whether it makes a valid range, bits and registers.
fn is_limited_to<const MAX: u16>() {
    let bytes = [0; 2 * 65_536];
    for quantity in 0..=u16::MAX {
        let allowed = (1..=MAX).contains(&quantity);
        let refused = RequestError::Quantity { found: quantity.into(), max: MAX };
        let expected = (!allowed).then_some(refused);
        assert_eq!(Range::<MAX>::new(65_535, quantity).err(), expected);
        let packed = &bytes[..usize::from(quantity).div_ceil(8)];
        assert_eq!(Bits::<MAX>::new(quantity, packed).err(), expected);
        let words = &bytes[..usize::from(quantity) * 2];
        assert_eq!(Registers::<MAX>::new(words).err(), expected);
    }
}

#[test]
fn a_quantity_of_0_or_beyond_the_limit_is_refused() {
    is_limited_to::<{ limit::READ_BITS }>();
    is_limited_to::<{ limit::READ_REGISTERS }>();
    is_limited_to::<{ limit::WRITE_BITS }>();
    is_limited_to::<{ limit::WRITE_REGISTERS }>();
    is_limited_to::<{ limit::READ_WRITE_REGISTERS }>();
}

#[test]
fn data_that_does_not_agree_with_its_quantity_is_refused() {
    let length = |found, expected| RequestError::Length { found, expected };
    assert_eq!(Bits::<2000>::new(9, &[0]), Err(length(1, 2)));
    assert_eq!(Bits::<2000>::new(8, &[0, 0]), Err(length(2, 1)));
    assert_eq!(Registers::<125>::new(&[0; 3]), Err(length(3, 4)));
    let mut room = [0; pdu::MAX_LEN];
    let quantity = |found, max| RequestError::Quantity { found, max };
    assert_eq!(Bits::<1968>::pack(&[], &mut room), Err(quantity(0, 1968)));
    assert_eq!(Bits::<1968>::pack(&[true; 1969], &mut room), Err(quantity(1969, 1968)));
    assert_eq!(Registers::<123>::pack(&[0; 70_000], &mut room), Err(quantity(70_000, 123)));
}

#[test]
fn a_data_field_that_diagnostics_does_not_allow_is_refused() {
    for sub_function in SubFunction::ALL.iter().copied() {
        let refused = Err(RequestError::Data(sub_function));
        for data in [&[][..], &[0], &[0; 3], &[0; 252]] {
            assert_eq!(Diagnostics::new(sub_function, data), refused);
        }
        if sub_function != SubFunction::ReturnQueryData {
            assert_eq!(Diagnostics::new(sub_function, &[0x80, 0]), refused);
            assert_eq!(Diagnostics::new(sub_function, &[0; 4]), refused);
        }
    }
}

#[test]
fn ranges_of_files_are_limited_to_what_a_pdu_holds() {
    let mut room = [0; pdu::MAX_LEN];
    let range = |quantity| FileRange::new(4, 9, quantity).unwrap();
    let space = |found, max| RequestError::Space { found, max };
    assert!(FileRanges::pack(&[range(limit::READ_RECORDS)], &mut room).is_ok());
    assert!(FileRanges::pack(&[range(1); 35], &mut room).is_ok());
    for (ranges, found) in
        [(vec![], 0), (vec![range(122)], 246), (vec![range(1); 36], 252), (vec![range(40); 4], 328)]
    {
        let packed = FileRanges::pack(&ranges, &mut room);
        assert_eq!(packed, Err(space(found, limit::READ_FILE_BYTES)));
    }
    let most = [7; limit::WRITE_RECORDS as usize];
    assert!(FileRecords::pack(&[(4, 9, &most)], &mut room).is_ok());
    assert!(FileRecords::pack(&[(4, 9, &[7][..]); 27], &mut room).is_ok());
    assert_eq!(FileRecords::pack(&[], &mut room), Err(space(0, limit::WRITE_FILE_BYTES)));
    let two = FileRecords::pack(&[(4, 9, &most[..]), (4, 9, &most[..1])], &mut room);
    assert_eq!(two, Err(space(260, limit::WRITE_FILE_BYTES)));
    let quantity = |found| RequestError::Quantity { found, max: limit::WRITE_RECORDS };
    assert_eq!(FileRecords::pack(&[(4, 9, &[])], &mut room), Err(quantity(0)));
    assert_eq!(FileRecords::pack(&[(4, 9, &[7; 123])], &mut room), Err(quantity(123)));
    assert_eq!(FileRecords::pack(&[(0, 9, &[7])], &mut room), Err(RequestError::File));
    assert_eq!(
        FileRecords::pack(&[(4, 10_000, &[7])], &mut room),
        Err(RequestError::Record(10_000))
    );
}

#[test]
fn a_file_that_no_device_can_have_is_an_address_and_a_wrong_count_is_a_value() {
    let (address, value) = (ExceptionCode::IllegalDataAddress, ExceptionCode::IllegalDataValue);
    for (pdu, code) in [
        (&[20, 7, 5, 0, 4, 0, 1, 0, 2][..], address),
        (&[20, 7, 6, 0, 0, 0, 1, 0, 2], address),
        (&[20, 7, 6, 0, 4, 0x27, 0x10, 0, 2], address),
        (&[20, 7, 6, 0, 4, 0, 1, 0, 0], address),
        (&[20, 7, 6, 0, 4, 0, 1, 0, 122], value),
        (&[20, 8, 6, 0, 4, 0, 1, 0, 2, 0], value),
        (&[20, 8, 6, 0, 4, 0, 1, 0, 2], value),
        (&[20, 0], value),
        (&[21, 9, 5, 0, 4, 0, 1, 0, 1, 0, 7], address),
        (&[21, 9, 6, 0, 0, 0, 1, 0, 1, 0, 7], address),
        (&[21, 7, 6, 0, 4, 0, 1, 0, 0], value),
        (&[21, 16, 6, 0, 4, 0, 1, 0, 0, 6, 0, 4, 0, 1, 0, 1, 0, 7], address),
        (&[21, 9, 6, 0, 4, 0, 1, 0, 2, 0, 7], value),
        (&[21, 10, 6, 0, 4, 0, 1, 0, 1, 0, 7, 6], value),
        (&[21, 0], value),
    ] {
        assert_eq!(Request::parse(pdu), Err(code), "{pdu:?}");
    }
}

#[test]
fn a_range_that_ends_beyond_the_last_address_parses_for_the_memory_to_refuse() {
    let request = Request::parse(&[3, 0xFF, 0xFF, 0, 125]).unwrap();
    let Request::ReadHoldingRegisters(range) = request else { panic!("{request:?}") };
    assert_eq!(range, RegisterRange::new(65_535, 125).unwrap());
    assert_eq!(range.end(), 65_660);
    assert_eq!([0u16; 65_536].get(range.indices()), None);
    assert_eq!(BitRange::new(65_535, 1).unwrap().end(), 65_536);
}

#[test]
fn every_function_is_among_the_requests_that_these_tests_generate() {
    let mut runner = TestRunner::deterministic();
    let mut generated = || a_request().new_tree(&mut runner).unwrap().current();
    let found: Vec<_> = (0..1_000).map(|_| generated().request().function()).collect();
    let missing: Vec<_> = Function::ALL.iter().filter(|each| !found.contains(each)).collect();
    assert_eq!(missing, Vec::<&Function>::new());
}

#[test]
fn every_code_of_an_enum_is_in_all() {
    let functions = (0..=u8::MAX).filter_map(Function::from_code).collect::<Vec<_>>();
    assert_eq!(functions, Function::ALL);
    let sub_functions = (0..=u16::MAX).filter_map(SubFunction::from_code).collect::<Vec<_>>();
    assert_eq!(sub_functions, SubFunction::ALL);
    let codes = (0..=u8::MAX).filter_map(ExceptionCode::from_code).collect::<Vec<_>>();
    assert_eq!(codes, ExceptionCode::ALL);
}

#[test]
#[should_panic(expected = "a PDU has 1 to 253 bytes")]
fn a_header_of_a_pdu_that_is_too_long_panics() {
    let _ = mbap::header(1, 1, pdu::MAX_LEN + 1);
}

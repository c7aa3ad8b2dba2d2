//! Tests that the replies of a server parse as responses to their requests.

mod support;

use holdfast_protocol::frame::rtu;
use holdfast_protocol::pdu::{
    self, EncodedRequest, ExceptionCode, FileRange, FileRanges, FileRecords, Function,
    RegisterRange, Registers, Request, RequestError, Response, ResponseError, SubFunction, reply,
};
use proptest::prelude::*;
use support::a_request;

/// A reply from a memory with the same byte everywhere; `None` for Read Device Identification,
/// which has a test of its own.
#[allow(unreachable_patterns, reason = "the feature `exhaustive` ends the need for a wildcard")]
fn a_reply(request: &Request<'_>, byte: u8) -> Option<Vec<u8>> {
    let mut pdu = [0; pdu::MAX_LEN];
    let filled = |(room, len): (&mut [u8], usize)| {
        room.fill(byte);
        len
    };
    let len = match *request {
        Request::ReadCoils(range) => filled(reply::read_coils(range, &mut pdu)),
        Request::ReadDiscreteInputs(range) => filled(reply::read_discrete_inputs(range, &mut pdu)),
        Request::ReadHoldingRegisters(range) => {
            filled(reply::read_holding_registers(range, &mut pdu))
        }
        Request::ReadInputRegisters(range) => filled(reply::read_input_registers(range, &mut pdu)),
        Request::ReadWriteMultipleRegisters { read, .. } => {
            filled(reply::read_write_multiple_registers(read, &mut pdu))
        }
        Request::WriteSingleCoil { address, value } => {
            reply::write_single_coil(address, value, &mut pdu)
        }
        Request::WriteSingleRegister { address, value } => {
            reply::write_single_register(address, value, &mut pdu)
        }
        Request::WriteMultipleCoils { address, bits } => {
            reply::write_multiple_coils(address, bits, &mut pdu)
        }
        Request::WriteMultipleRegisters { address, registers } => {
            reply::write_multiple_registers(address, registers, &mut pdu)
        }
        Request::MaskWriteRegister { address, and_mask, or_mask } => {
            reply::mask_write_register(address, and_mask, or_mask, &mut pdu)
        }
        Request::ReadExceptionStatus => reply::exception_status(byte, &mut pdu),
        Request::GetCommEventLog => {
            let log = [byte; 64];
            let log = &log[..usize::from(byte) % 65];
            let (events, messages) = (byte.into(), u16::from(byte) + 1);
            reply::event_log(byte.is_multiple_of(2), events, messages, log, &mut pdu).unwrap()
        }
        Request::ReadFileRecord(ranges) => {
            reply::read_file_record(ranges, |_, records| records.fill(byte), &mut pdu)
        }
        Request::WriteFileRecord(records) => reply::write_file_record(records, &mut pdu),
        Request::ReadFifoQueue { .. } => {
            let registers = [u16::from_be_bytes([byte; 2]); 31];
            reply::read_fifo_queue(&registers[..usize::from(byte) % 32], &mut pdu).unwrap()
        }
        Request::Diagnostics(asked) if asked.data().len() > 2 || byte.is_multiple_of(2) => {
            reply::diagnostics_echo(asked, &mut pdu)
        }
        Request::Diagnostics(asked) => {
            reply::diagnostics(asked.sub_function(), u16::from_be_bytes([byte; 2]), &mut pdu)
        }
        Request::GetCommEventCounter => {
            reply::event_counter(byte.is_multiple_of(2), byte.into(), &mut pdu)
        }
        Request::ReportServerId => {
            let additional = vec![byte; usize::from(byte) % (reply::MAX_SERVER_ID_LEN - 1)];
            reply::server_id(&[7], true, &additional, &mut pdu).unwrap()
        }
        Request::ReadDeviceIdentification { .. } => return None,
        _ => panic!("no reply to {request:?}"),
    };
    Some(pdu[..len].to_vec())
}

/// The PDU, and the length of its frame as it is known from each beginning of it.
fn lengths(pdu: &[u8], request: &Request<'_>) -> (Vec<u8>, Vec<Option<usize>>) {
    let (mut frame, mut encoded) = ([0; rtu::MAX_LEN], [0; pdu::MAX_LEN]);
    let len = rtu::encode(1, pdu, &mut frame).unwrap();
    let request_len = request.encode(&mut encoded);
    let known = (0..=len).map(|end| rtu::response_len(&frame[..end], request_len).unwrap());
    (frame[..len].to_vec(), known.collect())
}

proptest! {
    #[test]
    fn the_length_of_an_rtu_reply_is_known_before_its_end(parts in a_request(), byte: u8) {
        let request = parts.request();
        let Some(reply) = a_reply(&request, byte) else { return Ok(()) };
        let (frame, known) = lengths(&reply, &request);
        prop_assert!(known.iter().flatten().all(|len| *len == frame.len()), "{:?}", known);
        prop_assert!(known[frame.len() - 2].is_some());
    }

    #[test]
    fn a_reply_is_the_response_to_its_request(parts in a_request(), byte: u8) {
        let request = parts.request();
        let Some(reply) = a_reply(&request, byte) else { return Ok(()) };
        let response = request.response(&reply).unwrap();
        let has_no_values = response == Response::Written;
        prop_assert_eq!(has_no_values, request.function().can_be_broadcast());
        match response {
            Response::Bits(bits) => {
                prop_assert!(bits.as_bytes().iter().all(|each| *each == byte));
                prop_assert_eq!(bits.iter().count(), usize::from(bits.quantity()));
                prop_assert_eq!(bits.as_bytes().len(), usize::from(bits.quantity()).div_ceil(8));
            }
            Response::Registers(registers) => {
                prop_assert!(registers.iter().all(|each| each == u16::from_be_bytes([byte; 2])));
                prop_assert_eq!(registers.as_bytes().len(), reply.len() - 2);
            }
            Response::Written => prop_assert!(request.function().is_write()),
            Response::Diagnostics(data) => prop_assert_eq!(data, &reply[3..]),
            Response::EventCounter { busy, events } => {
                prop_assert_eq!((busy, events), (byte.is_multiple_of(2), u16::from(byte)));
            }
            Response::ExceptionStatus(outputs) => prop_assert_eq!(outputs, byte),
            Response::EventLog { busy, events, messages, log } => {
                prop_assert_eq!((busy, events), (byte.is_multiple_of(2), u16::from(byte)));
                prop_assert_eq!((messages, log), (u16::from(byte) + 1, &reply[8..]));
            }
            Response::FileRecords(answer) => {
                let Request::ReadFileRecord(ranges) = request else { panic!("{request:?}") };
                let lengths = ranges.iter().map(|range| usize::from(range.quantity()) * 2);
                prop_assert!(answer.iter().map(<[u8]>::len).eq(lengths));
                prop_assert!(answer.iter().flatten().all(|each| *each == byte));
            }
            Response::Queue(registers) => {
                let found = registers.map_or(0, |registers| registers.quantity());
                prop_assert_eq!(found, u16::from(byte) % 32);
            }
            Response::ServerId(id) => prop_assert_eq!(&id[..2], [7, 0xFF]),
            other => panic!("{other:?} from {request:?}"),
        }
    }

    #[test]
    fn a_reply_that_is_too_short_or_too_long_is_never_accepted(
        parts in a_request(),
        byte: u8,
        more in 1..5usize,
    ) {
        let request = parts.request();
        let Some(reply) = a_reply(&request, byte) else { return Ok(()) };
        for cut in 0..reply.len() {
            prop_assert_eq!(request.response(&reply[..cut]), Err(ResponseError::Length));
        }
        let stretched = [&reply[..], &vec![0; more]].concat();
        prop_assert_eq!(request.response(&stretched), Err(ResponseError::Length));
    }

    #[test]
    fn a_reply_is_accepted_for_another_request_only_if_both_ask_the_same(
        parts in a_request(),
        other in a_request(),
        byte: u8,
    ) {
        let (request, other) = (parts.request(), other.request());
        let Some(reply) = a_reply(&request, byte) else { return Ok(()) };
        if other.function() != request.function() {
            let expected = other.function().code();
            let found = request.function().code();
            let error = ResponseError::Function { expected, found };
            prop_assert_eq!(other.response(&reply), Err(error));
        } else if other.response(&reply).is_ok() {
            prop_assert_eq!(other.response(&reply), request.response(&reply));
        }
    }

    #[test]
    fn an_exception_is_read_back(parts in a_request(), code: u8) {
        let request = parts.request();
        let function_code = request.function().code();
        let expected = match ExceptionCode::from_code(code) {
            Some(known) => {
                let mut pdu = [0; pdu::MAX_LEN];
                let len = reply::exception(function_code, known, &mut pdu);
                prop_assert_eq!(&pdu[..len], [function_code | 0x80, code]);
                ResponseError::Exception(known)
            }
            None => ResponseError::UnknownException(code),
        };
        let reply = [function_code | 0x80, code];
        prop_assert_eq!(request.response(&reply), Err(expected));
    }

    #[test]
    fn any_bytes_are_accepted_only_if_they_match_the_request(
        parts in a_request(),
        same_function: bool,
        body in prop::collection::vec(prop_oneof![Just(0), Just(2), any::<u8>()], 0..260),
    ) {
        let request = parts.request();
        let code = request.function().code();
        let bytes = if same_function { [&[code], &body[..]].concat() } else { body };
        if request.response(&bytes).is_ok() {
            prop_assert_eq!(bytes[0], code);
        }
    }
}

#[test]
fn an_echo_of_other_values_is_refused() {
    let request = Request::WriteSingleRegister { address: 1, value: 2 };
    for reply in [[6, 0, 1, 0, 3], [6, 0, 2, 0, 2]] {
        assert_eq!(request.response(&reply), Err(ResponseError::Echo));
    }
    let request = Request::MaskWriteRegister { address: 4, and_mask: 0xF2, or_mask: 0x25 };
    let reply = [22, 0, 4, 0, 0xF2, 0, 0x26];
    assert_eq!(request.response(&reply), Err(ResponseError::Echo));
}

#[test]
fn registers_of_another_quantity_are_refused() {
    let request = Request::ReadInputRegisters(RegisterRange::new(0, 2).unwrap());
    for reply in [&[4, 2, 0, 1][..], &[4, 4, 0, 1], &[4, 2, 0, 1, 0, 2], &[4, 6, 0, 1, 0, 2, 0, 3]]
    {
        assert_eq!(request.response(reply), Err(ResponseError::Length));
    }
}

#[test]
fn an_answer_of_another_sub_function_is_refused() {
    let asked = pdu::Diagnostics::new(SubFunction::ReturnBusMessageCount, &[0, 0]).unwrap();
    let request = Request::Diagnostics(asked);
    let mut pdu = [0; pdu::MAX_LEN];
    let len = reply::diagnostics(SubFunction::ReturnServerBusyCount, 1, &mut pdu);
    assert_eq!(request.response(&pdu[..len]), Err(ResponseError::Echo));
}

#[test]
fn a_server_id_that_does_not_fit_is_not_written() {
    let mut pdu = [0; pdu::MAX_LEN];
    let longest = [9; reply::MAX_SERVER_ID_LEN - 2];
    assert_eq!(reply::server_id(&[1], false, &longest, &mut pdu), Some(pdu::MAX_LEN));
    assert_eq!(reply::server_id(&[1, 2], false, &longest, &mut pdu), None);
}

#[test]
fn records_of_other_ranges_are_refused() {
    let ranges = [FileRange::new(4, 1, 2).unwrap(), FileRange::new(3, 9, 1).unwrap()];
    let mut room = [0; pdu::MAX_LEN];
    let request = Request::ReadFileRecord(FileRanges::pack(&ranges, &mut room).unwrap());
    let reply = [20, 10, 5, 6, 1, 2, 3, 4, 3, 6, 5, 6];
    let Ok(Response::FileRecords(answer)) = request.response(&reply) else { panic!() };
    assert!(answer.iter().eq([&[1, 2, 3, 4][..], &[5, 6]]));
    for wrong in [
        [20, 10, 3, 6, 5, 6, 5, 6, 1, 2, 3, 4],
        [20, 10, 5, 7, 1, 2, 3, 4, 3, 6, 5, 6],
        [20, 10, 5, 6, 1, 2, 3, 4, 4, 6, 5, 6],
        [20, 10, 9, 6, 1, 2, 3, 4, 3, 6, 5, 6],
        [20, 10, 0, 6, 1, 2, 3, 4, 3, 6, 5, 6],
    ] {
        assert_eq!(request.response(&wrong), Err(ResponseError::Length), "{wrong:?}");
    }
}

#[test]
fn an_echo_of_other_records_is_refused() {
    let mut room = [0; pdu::MAX_LEN];
    let records = FileRecords::pack(&[(4, 7, &[1, 2])], &mut room).unwrap();
    let request = Request::WriteFileRecord(records);
    let reply = [21, 11, 6, 0, 4, 0, 7, 0, 2, 0, 1, 0, 2];
    assert_eq!(request.response(&reply), Ok(Response::Written));
    for at in 2..reply.len() {
        let mut wrong = reply;
        wrong[at] ^= 1;
        assert_eq!(request.response(&wrong), Err(ResponseError::Echo), "byte {at}");
    }
}

#[test]
fn a_queue_of_more_than_31_registers_or_with_a_wrong_count_is_refused() {
    let request = Request::ReadFifoQueue { address: 1246 };
    let longest = [&[24, 0, 64, 0, 31][..], &[7; 62]].concat();
    assert!(request.response(&longest).is_ok());
    for wrong in [
        [&[24, 0, 66, 0, 32][..], &[7; 64]].concat(),
        [&[24, 0, 64, 0, 30][..], &[7; 62]].concat(),
        [&[24, 0, 62, 0, 31][..], &[7; 62]].concat(),
        vec![24, 0, 3, 0, 0, 7],
    ] {
        assert_eq!(request.response(&wrong), Err(ResponseError::Length), "{wrong:?}");
    }
}

#[test]
fn a_log_of_more_than_64_events_is_refused() {
    let reply = |events: usize| [&[12, 6 + events as u8][..], &vec![0; 6 + events]].concat();
    assert!(Request::GetCommEventLog.response(&reply(64)).is_ok());
    assert_eq!(Request::GetCommEventLog.response(&reply(65)), Err(ResponseError::Length));
}

#[test]
fn the_length_of_an_identification_in_rtu_is_known_with_the_length_of_its_last_object() {
    let code = pdu::identification::ReadCode::Basic;
    let request = Request::ReadDeviceIdentification { code, object_id: 0 };
    let objects = [&[0, 2, b'a', b'b'][..], &[1, 0], &[2, 3, b'c', b'd', b'e']].concat();
    let reply = [&[43, 14, 1, 0x81, 0, 0, 3][..], &objects].concat();
    let (frame, known) = lengths(&reply, &request);
    // What remains are the three bytes of the last object, and the CRC.
    let (unknown, whole) = known.split_at(frame.len() - 5);
    assert!(unknown.iter().all(Option::is_none), "{known:?}");
    assert_eq!(whole, [Some(frame.len()); 6]);
}

#[test]
fn a_reply_of_another_function_or_length_is_told_apart_from_an_exception() {
    let range = RegisterRange::new(3, 1).unwrap();
    let request = Request::ReadHoldingRegisters(range);
    let function = |found| Err(ResponseError::Function { expected: 3, found });
    for (pdu, expected) in [
        (&[][..], Err(ResponseError::Length)),
        (&[0x83], Err(ResponseError::Length)),
        (&[0x83, 2, 0], Err(ResponseError::Length)),
        (&[0x83, 2], Err(ResponseError::Exception(ExceptionCode::IllegalDataAddress))),
        (&[0x83, 99], Err(ResponseError::UnknownException(99))),
        (&[4, 2, 0, 7], function(4)),
        (&[0x84, 2], function(0x84)),
    ] {
        assert_eq!(request.response(pdu), expected, "{pdu:?}");
        // The same holds for one that a server would refuse.
        let opaque = EncodedRequest::opaque(&[3, 0]).unwrap();
        assert_eq!(opaque.request(), None);
        assert_eq!(opaque.response(pdu), expected, "{pdu:?}");
    }
    let opaque = EncodedRequest::opaque(&[3, 0]).unwrap();
    assert_eq!(opaque.response(&[3, 1, 2]), Ok(Response::Opaque(&[1, 2])));
    assert_eq!(opaque.response(&[3]), Ok(Response::Opaque(&[])));
}

#[test]
fn an_opaque_request_has_a_function_below_128_and_at_most_253_bytes() {
    for pdu in [&[][..], &[0x80], &[0xFF, 1], &[1; 254]] {
        assert!(EncodedRequest::opaque(pdu).is_none(), "{pdu:?}");
    }
    for pdu in [&[0x7F][..], &[0], &[1; 253]] {
        assert_eq!(EncodedRequest::opaque(pdu).unwrap().pdu(), pdu);
    }
}

#[test]
fn an_identification_whose_count_or_length_does_not_fit_is_refused() {
    let code = pdu::identification::ReadCode::Basic;
    let request = Request::ReadDeviceIdentification { code, object_id: 0 };
    let reply = |count, objects: &[u8]| [&[43, 14, 1, 0x81, 0, 0, count][..], objects].concat();
    assert!(request.response(&reply(1, &[0, 1, b'a'])).is_ok());
    for (count, objects) in [
        (2, &[0, 1, b'a'][..]),
        (0, &[0, 1, b'a']),
        (1, &[0, 1, b'a', 1]),
        (1, &[0, 2, b'a']),
        (2, &[0, 1, b'a', 1, 1]),
    ] {
        assert_eq!(request.response(&reply(count, objects)), Err(ResponseError::Length));
    }
    let other = [43, 14, 2, 0x81, 0, 0, 1, 0, 1, b'a'];
    assert_eq!(request.response(&other), Err(ResponseError::Length), "another read code");
}

#[test]
fn diagnostics_that_change_a_device_are_no_reads() {
    for code in SubFunction::ALL {
        let pdu = [8, 0, code.code() as u8, 0, 0];
        let request = Request::parse(&pdu).unwrap();
        assert_eq!(request.is_read(), !code.changes_state(), "{code:?}");
    }
    assert!(SubFunction::ClearCounters.changes_state());
    assert!(!SubFunction::ReturnQueryData.changes_state());
}

#[test]
fn a_range_of_a_file_has_its_parts_and_a_pdu_its_function() {
    let range = FileRange::new(4, 700, 9).unwrap();
    assert_eq!((range.file(), range.record(), range.quantity()), (4, 700, 9));
    assert_eq!(Function::from_pdu(&[3, 0]), Some(Function::ReadHoldingRegisters));
    assert_eq!(Function::from_pdu(&[0x83, 1]), None);
    assert_eq!(Function::from_pdu(&[]), None);
    let echo = Some(SubFunction::ReturnQueryData);
    assert_eq!(SubFunction::from_pdu(&[8, 0, 0]), echo);
    assert_eq!(SubFunction::from_pdu(&[8, 0]), None);
}

#[test]
fn a_write_whose_byte_count_or_quantity_does_not_fit_is_an_illegal_value() {
    assert!(Request::parse(&[16, 0, 0, 0, 1, 2, 0, 7]).is_ok());
    for pdu in [
        &[16, 0, 0, 0, 1, 2, 0, 7, 0][..],
        &[16, 0, 0, 0, 1, 2, 0],
        &[16, 0, 0, 0, 1, 4, 0, 7],
        &[16, 0, 0, 0, 2, 2, 0, 7],
        &[16, 0, 0, 0, 0, 0],
    ] {
        assert_eq!(Request::parse(pdu), Err(ExceptionCode::IllegalDataValue), "{pdu:?}");
    }
}

#[test]
fn more_values_than_a_request_holds_are_not_packed() {
    let mut room = [0; pdu::MAX_LEN];
    let refused = |found| RequestError::Quantity { found, max: 123 };
    for found in [0, 124, 1000] {
        let packed = Registers::<123>::pack(&vec![7; found], &mut room);
        assert_eq!(packed.unwrap_err(), refused(found));
    }
}

#[test]
fn an_encoded_request_is_shown_as_its_parts_or_its_bytes() {
    let opaque = EncodedRequest::opaque(&[66, 1]).unwrap();
    assert_eq!(format!("{opaque:?}"), "EncodedRequest([66, 1])");
    let known = EncodedRequest::new(&Request::ReadExceptionStatus);
    assert_eq!(format!("{known:?}"), "EncodedRequest(ReadExceptionStatus)");
}

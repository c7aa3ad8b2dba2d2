//! Tests Read Device Identification, from the objects of a server to the client.
#![cfg(feature = "alloc")]

use holdfast_protocol::pdu::identification::{MAX_VALUE_LEN, ObjectError, Objects, ReadCode};
use holdfast_protocol::pdu::{self, ExceptionCode, Request, Response};
use proptest::prelude::*;

proptest! {
    #[test]
    fn a_stream_of_objects_is_read_completely(
        values in prop::collection::btree_map(
            prop_oneof![0..7u8, 0x80..=0xFFu8],
            prop::collection::vec(any::<u8>(), 0..=MAX_VALUE_LEN),
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

fn objects(ids: &[u8]) -> Result<Objects, ObjectError> {
    Objects::new(ids.iter().map(|id| (*id, Box::from(&b"x"[..]))))
}

#[test]
fn invalid_objects_are_refused() {
    assert_eq!(objects(&[0, 1]), Err(ObjectError::Missing(2)));
    assert_eq!(objects(&[0, 1, 2, 2]), Err(ObjectError::Twice(2)));
    assert_eq!(objects(&[0, 1, 2, 7]), Err(ObjectError::Reserved(7)));
    let long = [(0, 1), (1, 1), (2, MAX_VALUE_LEN + 1)];
    let long = Objects::new(long.map(|(id, len)| (id, vec![0; len].into_boxed_slice())));
    assert_eq!(long, Err(ObjectError::TooLong { id: 2, len: MAX_VALUE_LEN + 1 }));
    assert!(objects(&[2, 1, 0]).is_ok());
}

#[test]
fn an_individual_object_that_is_unknown_is_an_illegal_address() {
    let mut pdu = [0; pdu::MAX_LEN];
    let reply = objects(&[0, 1, 2]).unwrap().reply(ReadCode::Individual, 3, &mut pdu);
    assert_eq!(reply, Err(ExceptionCode::IllegalDataAddress));
}

#[test]
fn an_object_has_its_value() {
    let values = [(0, &b"vendor"[..]), (1, b"code"), (2, b"1.2"), (0x80, b"")];
    let objects = Objects::new(values.map(|(id, value)| (id, Box::from(value)))).unwrap();
    for (id, value) in values {
        assert_eq!(objects.get(id), Some(value));
    }
    assert_eq!(objects.get(3), None);
}

/// The ids of the objects in the first reply.
fn first_ids(objects: &Objects, code: ReadCode, object_id: u8) -> Result<Vec<u8>, ExceptionCode> {
    let mut buffer = [0; pdu::MAX_LEN];
    let len = objects.reply(code, object_id, &mut buffer)?;
    let request = Request::ReadDeviceIdentification { code, object_id };
    let Ok(Response::Identification(answer)) = request.response(&buffer[..len]) else {
        panic!("not an identification");
    };
    Ok(answer.iter().map(|(id, _)| id).collect())
}

#[test]
fn each_read_code_ends_at_its_last_object() {
    let ids = [0x00, 0x01, 0x02, 0x05, 0x06, 0x80, 0xFF];
    let objects = Objects::new(ids.map(|id| (id, vec![id].into_boxed_slice()))).unwrap();
    assert_eq!(first_ids(&objects, ReadCode::Basic, 0), Ok(ids[..3].to_vec()));
    assert_eq!(first_ids(&objects, ReadCode::Regular, 0), Ok(ids[..5].to_vec()));
    assert_eq!(first_ids(&objects, ReadCode::Extended, 0), Ok(ids.to_vec()));
    assert_eq!(first_ids(&objects, ReadCode::Individual, 0x80), Ok(vec![0x80]));
    let unknown = first_ids(&objects, ReadCode::Individual, 0x81);
    assert_eq!(unknown, Err(ExceptionCode::IllegalDataAddress));
    assert_eq!(first_ids(&objects, ReadCode::Basic, 0x05), Ok(ids[..3].to_vec()), "from the first");
}

#[test]
fn an_identification_that_neither_ends_nor_goes_on_is_malformed() {
    let request = Request::ReadDeviceIdentification { code: ReadCode::Basic, object_id: 0 };
    let reply = |more| [0x2B, 0x0E, 0x01, 0x81, more, 0, 1, 0, 1, b'a'];
    assert!(request.response(&reply(0x00)).is_ok());
    assert!(request.response(&reply(0x01)).is_err());
}

//! The PDU of a request.

use holdfast_protocol::pdu::{self, EncodedRequest, FileRanges, Function, Request, SubFunction};

/// A request that a server accepts is encoded to the same bytes.
pub fn check(data: &[u8]) {
    let _ = SubFunction::from_pdu(data);
    let parsed = Request::parse(data);
    let passed_on = EncodedRequest::parse(data);
    assert_eq!(passed_on.as_ref().err(), parsed.as_ref().err());
    let Ok(request) = parsed else { return };
    let mut buffer = [0; pdu::MAX_LEN];
    let len = request.encode(&mut buffer);
    assert_eq!(&buffer[..len], data);
    assert_eq!(Some(request.function()), Function::from_code(data[0]));
    match request {
        Request::ReadFileRecord(ranges) => {
            let ranges: Vec<_> = ranges.iter().collect();
            let packed = FileRanges::pack(&ranges, &mut buffer).expect("they were in a request");
            assert_eq!(Request::ReadFileRecord(packed), request);
        }
        Request::WriteFileRecord(records) => {
            let written = records.iter().map(|(_, records)| 7 + records.as_bytes().len());
            assert_eq!(written.sum::<usize>(), data.len() - 2);
        }
        _ => {}
    }
    assert_eq!(passed_on.map(|passed_on| passed_on.pdu().to_vec()), Ok(data.to_vec()));
}

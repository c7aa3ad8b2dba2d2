//! A PDU as the response to a request: [request] response.

use holdfast_protocol::pdu::{EncodedRequest, Request, Response, limit};

/// A response that a client accepts is exactly what its request asked for.
pub fn check(data: &[u8]) {
    let (asked, reply) = crate::counted(data);
    let Some(opaque) = EncodedRequest::opaque(asked) else { return };
    let encoded = EncodedRequest::parse(asked).unwrap_or_else(|_| opaque.clone());
    let found = encoded.response(reply);
    let whole = reply.get(1..).unwrap_or_default();
    assert_eq!(opaque.response(reply), found.map(|_| Response::Opaque(whole)));
    if let Some(request) = encoded.request() {
        assert_eq!(request.response(reply), found);
    }
    if let Ok(response) = found {
        is_answer(&encoded, reply, &response);
    }
}

/// Checks that the response is what the request asked for, and the one that the PDU has.
pub(crate) fn is_answer(asked: &EncodedRequest, pdu: &[u8], response: &Response<'_>) {
    assert_eq!(pdu[0], asked.pdu()[0], "the function");
    let Some(request) = asked.request() else {
        return assert_eq!(*response, Response::Opaque(&pdu[1..]));
    };
    match (request, *response) {
        (Request::ReadCoils(range) | Request::ReadDiscreteInputs(range), Response::Bits(bits)) => {
            assert_eq!(bits.quantity(), range.quantity());
            assert_eq!(bits.iter().count(), usize::from(range.quantity()));
            assert_eq!(bits.as_bytes(), &pdu[2..]);
        }
        (
            Request::ReadHoldingRegisters(range)
            | Request::ReadInputRegisters(range)
            | Request::ReadWriteMultipleRegisters { read: range, .. },
            Response::Registers(registers),
        ) => {
            assert_eq!(registers.quantity(), range.quantity());
            assert_eq!(registers.iter().len(), usize::from(range.quantity()));
            assert_eq!(registers.as_bytes(), &pdu[2..]);
        }
        (
            Request::WriteSingleCoil { .. }
            | Request::WriteSingleRegister { .. }
            | Request::MaskWriteRegister { .. }
            | Request::WriteFileRecord(_),
            Response::Written,
        ) => assert_eq!(pdu, asked.pdu()),
        (
            Request::WriteMultipleCoils { .. } | Request::WriteMultipleRegisters { .. },
            Response::Written,
        ) => assert_eq!(pdu, &asked.pdu()[..5]),
        (Request::Diagnostics(diagnostics), Response::Diagnostics(data)) => {
            assert_eq!(data.len(), diagnostics.data().len());
            assert_eq!(pdu[1..3], asked.pdu()[1..3], "the sub-function");
            assert_eq!(data, &pdu[3..]);
        }
        (Request::GetCommEventCounter, Response::EventCounter { events, .. }) => {
            assert_eq!(pdu.len(), 5);
            assert_eq!(events.to_be_bytes(), pdu[3..]);
        }
        (Request::GetCommEventLog, Response::EventLog { events, messages, log, .. }) => {
            assert_eq!((usize::from(pdu[1]), log), (6 + log.len(), &pdu[8..]));
            assert!(log.len() <= usize::from(limit::LOG_EVENTS));
            assert_eq!([events, messages].map(u16::to_be_bytes).as_flattened(), &pdu[4..8]);
        }
        (Request::ReadExceptionStatus, Response::ExceptionStatus(status)) => {
            assert_eq!(pdu[1..], [status]);
        }
        (Request::ReadFileRecord(ranges), Response::FileRecords(answer)) => {
            let lens = ranges.iter().map(|range| usize::from(range.quantity()) * 2);
            assert!(answer.iter().map(<[u8]>::len).eq(lens));
            let listed: Vec<u8> = answer
                .iter()
                .flat_map(|records| [&[records.len() as u8 + 1, 6], records].concat())
                .collect();
            assert_eq!(listed, &pdu[2..]);
        }
        (Request::ReadFifoQueue { .. }, Response::Queue(registers)) => {
            let bytes = registers.map_or(&[][..], |registers| registers.as_bytes());
            assert_eq!(bytes, &pdu[5..]);
            assert!(bytes.len() / 2 <= usize::from(limit::QUEUE_REGISTERS));
            let counts =
                [bytes.len() + 2, bytes.len() / 2].map(|count| (count as u16).to_be_bytes());
            assert_eq!(counts.as_flattened(), &pdu[1..5]);
        }
        (Request::ReportServerId, Response::ServerId(id)) => {
            assert_eq!((usize::from(pdu[1]), id), (id.len(), &pdu[2..]));
        }
        (Request::ReadDeviceIdentification { code, .. }, Response::Identification(answer)) => {
            assert_eq!(pdu[2], code.code());
            assert_eq!(answer.iter().count(), usize::from(pdu[6]));
            let listed: Vec<u8> = answer
                .iter()
                .flat_map(|(id, value)| [&[id, value.len() as u8], value].concat())
                .collect();
            assert_eq!(listed, &pdu[7..]);
        }
        (request, response) => panic!("{response:?} to {request:?}"),
    }
}

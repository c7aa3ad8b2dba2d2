//! Tests that what a client makes of received bytes does not depend on how they were cut.

#![cfg(feature = "alloc")]

use std::time::Duration;

use holdfast_protocol::client::{Connection, Done, Tolerance, Transport};
use holdfast_protocol::frame::{ascii, mbap, rtu};
use holdfast_protocol::pdu::{EncodedRequest, Range, Request};

const SECOND: Duration = Duration::from_secs(1);
const SILENCE: Duration = Duration::from_millis(2);
const UNIT: u8 = 7;
const STREAMS: [Transport; 5] = [
    Transport::Tcp,
    Transport::RtuOverTcp,
    Transport::AsciiOverTcp,
    Transport::SerialRtu { silence: SILENCE },
    Transport::SerialAscii { silence: SILENCE },
];

/// A frame of a transport; `id` is the transaction id of Modbus TCP.
fn frame(transport: Transport, id: u16, unit_id: u8, pdu: &[u8]) -> Vec<u8> {
    match transport {
        Transport::Tcp => [&mbap::header(id, unit_id, pdu.len())[..], pdu].concat(),
        Transport::AsciiOverTcp | Transport::SerialAscii { .. } => {
            let mut frame = [0; ascii::MAX_LEN];
            let len = ascii::encode(unit_id, pdu, &mut frame).unwrap();
            frame[..len].to_vec()
        }
        _ => {
            let mut frame = [0; rtu::MAX_LEN];
            let len = rtu::encode(unit_id, pdu, &mut frame).unwrap();
            frame[..len].to_vec()
        }
    }
}

/// What a client makes of these pieces, and of the silence behind them: its results, and if nothing
/// follows the reply also the end of the connection and what nobody requested.
fn outcome(
    transport: Transport,
    request: &Request<'_>,
    pieces: &[&[u8]],
    is_alone: bool,
) -> String {
    let mut connection = Connection::tolerant(transport, Tolerance::default(), SECOND);
    let (mut results, mut now) = (Vec::new(), 2 * SECOND);
    connection.advance(now, |_| unreachable!());
    let request = EncodedRequest::new(request);
    // Modbus TCP has two requests on their way, a line one after the other.
    let count = if transport == Transport::Tcp { 2 } else { 1 };
    let tickets: Vec<_> =
        (0..count).map(|_| connection.send(UNIT, &request, SECOND, now).unwrap()).collect();
    connection.sent(connection.outgoing().len());
    let mut note = |done: Done<'_>| {
        let number = tickets.iter().position(|ticket| *ticket == done.ticket);
        results.push(format!("{number:?} {:?}", done.outcome));
    };
    for piece in pieces {
        connection.receive(piece, now, &mut note);
    }
    now += 2 * SECOND;
    connection.advance(now, &mut note);
    if !is_alone {
        return format!("{results:?}");
    }
    // Bytes behind the end of a connection are counted if they are received with it.
    let strays = connection.closed().is_none().then(|| connection.take_strays());
    let (closed, late) = (connection.closed(), connection.late());
    format!("{results:?} {closed:?} {strays:?} late {late}")
}

const READ_FILES: [u8; 16] = [20, 14, 6, 0, 4, 0, 1, 0, 2, 6, 0, 3, 0, 9, 0, 1];
const WRITE_FILE: [u8; 11] = [21, 9, 6, 0, 4, 0, 7, 0, 1, 6, 0xAF];

/// Requests, and replies to them.
fn exchanges() -> Vec<(Request<'static>, Vec<u8>)> {
    let range = |quantity| Range::new(3, quantity).unwrap();
    vec![
        (Request::ReadCoils(Range::new(3, 9).unwrap()), vec![1, 2, 0xFF, 1]),
        (Request::ReadHoldingRegisters(range(1)), vec![3, 2, 0, 42]),
        (Request::ReadHoldingRegisters(range(1)), vec![0x83, 2]),
        (Request::ReadInputRegisters(range(2)), vec![4, 4, 0x3A, 0x3A, 0x0D, 0x0A]),
        (Request::ReadInputRegisters(range(125)), [&[4, 250][..], &[0x07; 250]].concat()),
        (Request::WriteSingleRegister { address: 3, value: 7 }, vec![6, 0, 3, 0, 7]),
        (Request::WriteSingleCoil { address: 3, value: true }, vec![5, 0, 3, 0xFF, 0]),
        (Request::ReadExceptionStatus, vec![7, 0x6D]),
        (Request::GetCommEventLog, vec![12, 8, 0, 0, 1, 8, 1, 0x21, 0x20, 0]),
        (Request::ReadFifoQueue { address: 3 }, vec![24, 0, 6, 0, 2, 1, 0xB8, 0x12, 0x84]),
        (Request::parse(&READ_FILES).unwrap(), vec![20, 10, 5, 6, 1, 2, 3, 4, 3, 6, 0x3A, 0x0D]),
        (Request::parse(&WRITE_FILE).unwrap(), WRITE_FILE.to_vec()),
        (Request::ReportServerId, vec![17, 3, b'a', b'b', 0xFF]),
    ]
}

/// Streams that answer a request, disturbed in every way, and whether nothing follows the reply. Where
/// frames have no transaction ids, what comes with a reply is a disturbance of its line, what comes later
/// belongs to no request: it ends a stream.
fn streams(transport: Transport, reply: &[u8]) -> Vec<(Vec<u8>, bool)> {
    let first = frame(transport, 0, UNIT, reply);
    let second = frame(transport, 1, UNIT, reply);
    let other_unit = frame(transport, 0, UNIT + 1, reply);
    let other_function = frame(transport, 0, UNIT, &[0x2B, 14, 1]);
    let mut damaged = first.clone();
    let last = damaged.len() - 3;
    damaged[last] ^= 1;
    let stray = match transport {
        Transport::Tcp => frame(transport, 9, UNIT, &[3, 2, 0, 1]),
        Transport::AsciiOverTcp | Transport::SerialAscii { .. } => b"x\0:01".to_vec(),
        _ => vec![0, 0xFF, 0],
    };
    let has_ids = transport == Transport::Tcp;
    let mut streams = vec![
        (first.clone(), true),
        ([&first[..], &second].concat(), has_ids),
        ([&second[..], &first].concat(), has_ids),
        ([&first[..], &first].concat(), has_ids),
        ([&stray[..], &first].concat(), true),
        ([&first[..], &stray].concat(), has_ids),
        (other_unit.clone(), true),
        (damaged.clone(), true),
        (other_function, true),
        (first[..first.len() - 1].to_vec(), true),
        (vec![0xFF; 9], true),
        ([&first[..], &[0xFF; 9]].concat(), has_ids),
    ];
    if has_ids {
        // Elsewhere, two frames that contradict each other are both refused if they come together, and
        // a reply is found behind a damaged one that has come with it.
        streams.push(([&other_unit[..], &first].concat(), true));
        streams.push(([&damaged[..], &first].concat(), true));
    }
    streams
}

#[test]
fn replies_have_the_same_outcome_however_they_are_cut() {
    for transport in STREAMS {
        for (request, reply) in exchanges() {
            for (stream, is_alone) in streams(transport, &reply) {
                let outcome = |pieces: &[&[u8]]| outcome(transport, &request, pieces, is_alone);
                let whole = outcome(&[&stream]);
                let about = format!("{transport:?} {request:?} {stream:02x?}");
                for cut in 1..stream.len() {
                    let halves = outcome(&[&stream[..cut], &stream[cut..]]);
                    assert_eq!(halves, whole, "{about}, cut at {cut}");
                }
                let bytes: Vec<&[u8]> = stream.chunks(1).collect();
                assert_eq!(outcome(&bytes), whole, "{about}, byte by byte");
            }
        }
    }
}

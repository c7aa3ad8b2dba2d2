//! Tests the client side of a connection: what it sends, how it handles received bytes, and when it
//! ends.

#![cfg(feature = "alloc")]

use std::time::Duration;

use holdfast_protocol::client::{
    Closed, Connection, Done, Failure, InvalidResponse, Line, TURNAROUND, Ticket, Transport,
};
use holdfast_protocol::frame::{FrameError, ascii, mbap, rtu};
use holdfast_protocol::pdu::{self, EncodedRequest, Range, Request, Response, ResponseError};
use proptest::prelude::*;

fn read() -> Request<'static> {
    Request::ReadHoldingRegisters(Range::new(3, 1).unwrap())
}

const WRITE: Request<'_> = Request::WriteSingleRegister { address: 3, value: 7 };
const SECOND: Duration = Duration::from_secs(1);
const SILENCE: Duration = Duration::from_millis(2);
const LINE: Line = Line { silence: SILENCE, echo: false };

/// The result of a request: registers as bytes, empty for a write.
type Got = (Ticket, Result<Vec<u8>, Failure>);

fn noted(got: &mut Vec<Got>, done: &Done<'_>) {
    let outcome = done.outcome.map(|response| match response {
        Response::Registers(registers) => registers.as_bytes().to_vec(),
        Response::Bits(bits) => bits.as_bytes().to_vec(),
        _ => Vec::new(),
    });
    got.push((done.ticket, outcome));
}

/// A connection, the time, and the results of its requests.
struct Client {
    connection: Connection,
    now: Duration,
    got: Vec<Got>,
}

impl Client {
    fn new(transport: Transport) -> Client {
        Client { connection: Connection::new(transport), now: SECOND, got: Vec::new() }
    }

    fn try_send(&mut self, request: Request<'_>) -> Result<Ticket, Closed> {
        let request = EncodedRequest::new(&request);
        self.connection.send(7, &request, SECOND, self.now)
    }

    fn send(&mut self, request: Request<'_>) -> Ticket {
        self.try_send(request).unwrap()
    }

    fn outgoing(&mut self) -> Vec<u8> {
        let bytes = self.connection.outgoing().to_vec();
        self.connection.sent(bytes.len());
        bytes
    }

    fn receive(&mut self, bytes: &[u8]) {
        let got = &mut self.got;
        self.connection.receive(bytes, self.now, |done| noted(got, &done));
    }

    fn after(&mut self, time: Duration) {
        self.now += time;
        let got = &mut self.got;
        self.connection.advance(self.now, |done| noted(got, &done));
    }

    fn got(&mut self) -> Vec<Got> {
        std::mem::take(&mut self.got)
    }
}

fn mbap_frame(id: u16, unit_id: u8, pdu: &[u8]) -> Vec<u8> {
    [&mbap::header(id, unit_id, pdu.len())[..], pdu].concat()
}

fn rtu_frame(unit_id: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = [0; rtu::MAX_LEN];
    let len = rtu::encode(unit_id, pdu, &mut frame).unwrap();
    frame[..len].to_vec()
}

fn ascii_frame(unit_id: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = [0; ascii::MAX_LEN];
    let len = ascii::encode(unit_id, pdu, &mut frame).unwrap();
    frame[..len].to_vec()
}

#[test]
fn replies_in_any_order_and_pieces_match_their_requests() {
    let mut client = Client::new(Transport::Tcp);
    let tickets = [(); 3].map(|()| client.send(read()));
    assert_eq!(client.outgoing().len(), 36);
    let stream = [
        mbap_frame(2, 7, &[3, 2, 0, 30]),
        mbap_frame(0, 7, &[3, 2, 0, 10]),
        mbap_frame(1, 7, &[0x83, 2]),
    ];
    for byte in stream.concat() {
        client.receive(&[byte]);
    }
    let expected = [
        (tickets[2], Ok(vec![0, 30])),
        (tickets[0], Ok(vec![0, 10])),
        (tickets[1], Err(Failure::Exception(2))),
    ];
    assert_eq!(client.got(), expected);
    assert_eq!((client.connection.in_flight(), client.connection.closed()), (0, None));
}

#[test]
fn a_late_reply_is_dropped_and_counted_and_a_second_one_is_an_error() {
    let mut client = Client::new(Transport::Tcp);
    let [first, second] = [(); 2].map(|()| client.send(read()));
    client.connection.cancel(first);
    let late = mbap_frame(0, 7, &[3, 2, 0, 1]);
    client.receive(&late);
    assert_eq!((client.got(), client.connection.late()), (vec![], 1));
    client.receive(&late);
    let invalid = InvalidResponse::TransactionId(0);
    assert_eq!(client.got(), [(second, Err(Failure::Invalid(invalid)))]);
    assert_eq!(client.connection.closed(), Some(Closed::Invalid(invalid)));
}

#[test]
fn an_invalid_reply_ends_the_connection() {
    let cases: [(Vec<u8>, InvalidResponse); 6] = [
        (mbap_frame(9, 7, &[3, 2, 0, 1]), InvalidResponse::TransactionId(9)),
        (mbap_frame(0, 8, &[3, 2, 0, 1]), InvalidResponse::UnitId { expected: 7, found: 8 }),
        (mbap_frame(0, 7, &[3, 4, 0, 1, 0, 1]), InvalidResponse::Pdu(ResponseError::Length)),
        (
            mbap_frame(0, 7, &[4, 2, 0, 1]),
            InvalidResponse::Pdu(ResponseError::Function { expected: 3, found: 4 }),
        ),
        (vec![0, 0, 0, 1, 0, 3, 7, 3, 0], InvalidResponse::ProtocolId(1)),
        (vec![0, 0, 0, 0, 0, 1, 7], InvalidResponse::Length(1)),
    ];
    for (bytes, invalid) in cases {
        let mut client = Client::new(Transport::Tcp);
        let [first, second] = [(); 2].map(|()| client.send(read()));
        client.receive(&bytes);
        let failure = Err(Failure::Invalid(invalid));
        assert_eq!(client.got(), [(first, failure.clone()), (second, failure)]);
        assert_eq!(client.connection.closed(), Some(Closed::Invalid(invalid)));
        assert_eq!(client.try_send(read()), Err(Closed::Invalid(invalid)));
    }
}

#[test]
fn an_error_after_a_reply_does_not_affect_the_reply() {
    let mut client = Client::new(Transport::Tcp);
    let ticket = client.send(read());
    client.receive(&[mbap_frame(0, 7, &[3, 2, 0, 1]), vec![0xFF; 9]].concat());
    assert_eq!(client.got(), [(ticket, Ok(vec![0, 1]))]);
    assert!(client.connection.closed().is_some());
}

#[test]
fn transaction_ids_in_use_are_not_reused() {
    let mut client = Client::new(Transport::Tcp);
    for _ in 0..65_536 {
        let ticket = client.send(read());
        client.connection.cancel(ticket);
    }
    assert_eq!(client.try_send(read()), Err(Closed::NoTransactionId));
    client.receive(&mbap_frame(4711, 7, &[3, 2, 0, 1]));
    client.outgoing();
    client.send(read());
    assert_eq!(client.outgoing()[..2], 4711u16.to_be_bytes());
}

#[test]
fn a_timeout_ends_one_request_and_not_the_connection() {
    let mut client = Client::new(Transport::Tcp);
    let first = client.send(read());
    client.after(SECOND / 2);
    assert_eq!(client.connection.deadline(), Some(2 * SECOND));
    let second = client.send(read());
    client.after(SECOND / 2);
    assert_eq!(client.got(), [(first, Err(Failure::Timeout))]);
    assert!(client.connection.is_waiting_for(second) && !client.connection.is_waiting_for(first));
    client.receive(&mbap_frame(1, 7, &[3, 2, 0, 2]));
    assert_eq!(client.got(), [(second, Ok(vec![0, 2]))]);
    assert_eq!(client.connection.deadline(), None);
}

#[test]
fn a_silent_connection_ends_after_three_timeouts() {
    let mut client = Client::new(Transport::Tcp);
    for round in 0..3 {
        assert_eq!(client.connection.closed(), None);
        // Requests in flight at the same time count as one.
        client.send(read());
        client.send(read());
        client.after(SECOND);
        assert_eq!(client.got().len(), 2, "{round}");
    }
    assert_eq!(client.connection.closed(), Some(Closed::Silent));
}

#[test]
fn any_received_byte_resets_the_timeouts() {
    let mut client = Client::new(Transport::Tcp);
    for round in 0..10 {
        client.send(read());
        client.after(SECOND);
        assert_eq!(client.got().len(), 1);
        client.receive(&mbap_frame(round, 7, &[3, 2, 0, 1]));
    }
    assert_eq!((client.connection.late(), client.connection.closed()), (10, None));
}

#[test]
fn a_timeout_in_the_middle_of_its_reply_ends_the_connection() {
    for len in 1..10 {
        let mut client = Client::new(Transport::Tcp);
        client.send(read());
        client.receive(&mbap_frame(0, 7, &[3, 2, 0, 1])[..len]);
        client.after(SECOND);
        assert_eq!(client.connection.closed(), Some(Closed::BrokenOff), "{len} bytes");
    }
}

#[test]
fn a_timeout_in_the_middle_of_another_reply_does_not_end_the_connection() {
    let mut client = Client::new(Transport::Tcp);
    let first = client.send(read());
    client.after(SECOND / 2);
    let second = client.send(read());
    let reply = mbap_frame(1, 7, &[3, 2, 0, 2]);
    client.receive(&reply[..9]);
    client.after(SECOND / 2);
    assert_eq!(client.got(), [(first, Err(Failure::Timeout))]);
    client.receive(&reply[9..]);
    assert_eq!(client.got(), [(second, Ok(vec![0, 2]))]);
}

#[test]
fn closing_fails_every_request_in_flight() {
    for why in [Closed::ByPeer, Closed::BySelf] {
        let mut client = Client::new(Transport::Tcp);
        let ticket = client.send(read());
        let got = &mut client.got;
        client.connection.close(why, |done| noted(got, &done));
        assert_eq!(client.got(), [(ticket, Err(Failure::Closed(why)))]);
        client.receive(&mbap_frame(0, 7, &[3, 2, 0, 1]));
        client.after(SECOND);
        assert_eq!((client.got(), client.connection.outgoing()), (vec![], &[][..]));
    }
}

#[test]
fn a_read_is_sent_three_times_as_a_datagram_and_a_write_once() {
    for (request, times) in [(read(), 3), (WRITE, 1)] {
        let mut client = Client::new(Transport::Udp);
        let ticket = client.send(request);
        let first = client.outgoing();
        let mut sent = 1;
        while client.got.is_empty() {
            assert!(client.connection.deadline().unwrap() > client.now);
            client.after(client.connection.deadline().unwrap() - client.now);
            let again = client.outgoing();
            if !again.is_empty() {
                assert_eq!(again, first);
                sent += 1;
            }
        }
        assert_eq!(sent, times);
        assert_eq!(client.got(), [(ticket, Err(Failure::Timeout))]);
        assert_eq!((client.now, client.connection.closed()), (2 * SECOND, None));
        client.receive(&mbap_frame(0, 7, &[3, 2, 0, 1]));
        assert_eq!(client.connection.late(), 1);
    }
}

#[test]
fn a_datagram_of_another_request_is_counted_and_a_malformed_one_ends_the_connection() {
    let mut client = Client::new(Transport::Udp);
    let ticket = client.send(read());
    client.receive(&mbap_frame(5, 7, &[3, 2, 0, 1]));
    client.receive(&mbap_frame(0, 8, &[3, 2, 0, 1]));
    assert_eq!((client.got(), client.connection.late()), (vec![], 2));
    client.receive(&mbap_frame(0, 7, &[3, 2, 0, 1]));
    assert_eq!(client.got(), [(ticket, Ok(vec![0, 1]))]);
    client.send(read());
    client.receive(&[mbap_frame(1, 7, &[3, 2, 0, 1]), vec![0]].concat());
    assert_eq!(client.connection.closed(), Some(Closed::Invalid(InvalidResponse::Datagram)));
}

#[test]
fn rtu_in_a_stream_carries_one_request_at_a_time() {
    let mut client = Client::new(Transport::RtuOverTcp);
    let ticket = client.send(read());
    assert!(!client.connection.has_room());
    assert_eq!(client.outgoing(), rtu_frame(7, &[3, 0, 3, 0, 1]));
    for byte in rtu_frame(7, &[3, 2, 0, 42]) {
        client.receive(&[byte]);
    }
    assert_eq!(client.got(), [(ticket, Ok(vec![0, 42]))]);
    assert!(client.connection.has_room());
    client.receive(&[0]);
    assert_eq!(client.connection.closed(), Some(Closed::Invalid(InvalidResponse::Unrequested)));
}

#[test]
fn an_error_ends_rtu_in_a_stream() {
    let other_unit = InvalidResponse::UnitId { expected: 7, found: 8 };
    let cases = [
        (rtu_frame(8, &[3, 2, 0, 1]), other_unit),
        (vec![7, 3, 2, 0, 1, 0, 0], InvalidResponse::Frame(FrameError::CheckSum)),
        (rtu_frame(7, &[3, 4, 0, 1, 0, 1]), InvalidResponse::Pdu(ResponseError::Length)),
    ];
    for (bytes, invalid) in cases {
        let mut client = Client::new(Transport::RtuOverTcp);
        let ticket = client.send(read());
        client.receive(&bytes);
        assert_eq!(client.got(), [(ticket, Err(Failure::Invalid(invalid)))]);
        assert_eq!(client.connection.closed(), Some(Closed::Invalid(invalid)));
    }
    let mut client = Client::new(Transport::RtuOverTcp);
    client.send(read());
    client.after(SECOND);
    assert_eq!(client.connection.closed(), Some(Closed::TimedOut));
    let mut client = Client::new(Transport::RtuOverTcp);
    let ticket = client.send(read());
    client.receive(&rtu_frame(7, &[0x83, 6]));
    assert_eq!(client.got(), [(ticket, Err(Failure::Exception(6)))]);
    assert_eq!(client.connection.closed(), None);
}

#[test]
fn a_serial_line_waits_for_silence_and_discards_earlier_bytes() {
    let mut client = Client::new(Transport::SerialRtu(LINE));
    client.receive(&[1, 2, 3]);
    let ticket = client.send(read());
    assert_eq!(client.outgoing(), []);
    assert_eq!(client.connection.deadline(), Some(client.now + SILENCE));
    client.after(SILENCE / 2);
    client.receive(&rtu_frame(7, &[3, 2, 0, 1]));
    client.after(SILENCE / 2);
    assert_eq!(client.outgoing(), []);
    client.after(SILENCE / 2);
    assert_eq!(client.outgoing(), rtu_frame(7, &[3, 0, 3, 0, 1]));
    client.receive(&rtu_frame(7, &[3, 2, 0, 42]));
    assert_eq!(client.got(), [(ticket, Ok(vec![0, 42]))]);
    client.send(read());
    assert_eq!(client.outgoing(), []);
}

#[test]
fn on_a_line_that_is_never_silent_a_request_times_out_unsent() {
    let mut client = Client::new(Transport::SerialRtu(LINE));
    client.receive(&[0]);
    let ticket = client.send(read());
    while client.got.is_empty() {
        client.receive(&[0]);
        client.after(SILENCE / 2);
        assert_eq!(client.outgoing(), []);
    }
    assert_eq!(client.got(), [(ticket, Err(Failure::Timeout))]);
    assert_eq!(client.connection.closed(), None);
}

#[test]
fn a_broadcast_on_a_serial_line_has_no_reply() {
    for transport in [Transport::SerialRtu(LINE), Transport::SerialAscii(LINE)] {
        let mut client = Client::new(transport);
        let request = EncodedRequest::new(&WRITE);
        let timeout = TURNAROUND / 10;
        let ticket = client.connection.send(0, &request, timeout, client.now).unwrap();
        assert!(!client.outgoing().is_empty());
        assert_eq!(client.connection.deadline(), Some(client.now + TURNAROUND));
        client.after(TURNAROUND / 2);
        assert_eq!(client.got(), []);
        client.after(TURNAROUND / 2);
        assert_eq!(client.got(), [(ticket, Ok(vec![]))]);
    }
}

#[test]
fn an_invalid_reply_does_not_end_a_serial_line() {
    for (transport, bad, good) in [
        (Transport::SerialRtu(LINE), rtu_frame(8, &[3, 2, 0, 1]), rtu_frame(7, &[3, 2, 0, 1])),
        (
            Transport::SerialAscii(LINE),
            ascii_frame(8, &[3, 2, 0, 1]),
            ascii_frame(7, &[3, 2, 0, 1]),
        ),
    ] {
        let mut client = Client::new(transport);
        let first = client.send(read());
        client.receive(&bad);
        let invalid = InvalidResponse::UnitId { expected: 7, found: 8 };
        assert_eq!(client.got(), [(first, Err(Failure::Invalid(invalid)))]);
        let second = client.send(read());
        client.after(SILENCE);
        client.receive(&good);
        assert_eq!(client.got(), [(second, Ok(vec![0, 1]))]);
        let third = client.send(read());
        client.after(SECOND);
        assert_eq!(client.got(), [(third, Err(Failure::Timeout))]);
        assert_eq!(client.connection.closed(), None);
    }
}

#[test]
fn an_echo_is_removed_if_it_is_expected_or_cannot_be_a_reply() {
    for (echo, request) in [(false, read()), (true, read()), (true, WRITE)] {
        let line = Line { silence: SILENCE, echo };
        for ascii in [false, true] {
            let frame = |pdu: &[u8]| if ascii { ascii_frame(7, pdu) } else { rtu_frame(7, pdu) };
            let transport =
                if ascii { Transport::SerialAscii(line) } else { Transport::SerialRtu(line) };
            let mut client = Client::new(transport);
            let ticket = client.send(request);
            let sent = client.outgoing();
            let reply: &[u8] = if request == read() { &[3, 2, 0, 5] } else { &[6, 0, 3, 0, 7] };
            let registers = if request == read() { vec![0, 5] } else { vec![] };
            for byte in [sent, frame(reply)].concat() {
                client.receive(&[byte]);
            }
            assert_eq!(client.got(), [(ticket, Ok(registers))], "{echo} {request:?} {ascii}");
        }
    }
}

#[test]
fn the_reply_to_a_dropped_request_on_a_line_is_not_taken_for_another() {
    let mut client = Client::new(Transport::RtuOverTcp);
    let ticket = client.send(read());
    client.connection.cancel(ticket);
    assert!(!client.connection.has_room());
    client.receive(&rtu_frame(7, &[3, 2, 0, 42]));
    assert_eq!(client.got(), []);
    assert!(client.connection.has_room());
}

fn transports() -> impl Strategy<Value = Transport> {
    prop_oneof![
        Just(Transport::Tcp),
        Just(Transport::Udp),
        Just(Transport::RtuOverTcp),
        Just(Transport::SerialRtu(LINE)),
        Just(Transport::SerialAscii(Line { silence: SILENCE, echo: true })),
    ]
}

proptest! {
    #[test]
    fn for_any_bytes_every_request_has_one_result_and_memory_is_bounded(
        transport in transports(),
        steps in prop::collection::vec(
            prop_oneof![
                prop::collection::vec(any::<u8>(), 1..300).prop_map(Some),
                // Bytes that could be the beginning of a frame.
                prop::sample::select(vec![0u8, 1, 3, 6, 7, 0x3A, 0x0D, 0x0A, 0x83])
                    .prop_map(|byte| Some(vec![0, 0, 0, 0, 0, 5, 7, 3, 2, byte])),
                Just(None),
            ],
            1..40,
        ),
    ) {
        let mut client = Client::new(transport);
        let mut tickets = Vec::new();
        for step in steps {
            if client.connection.has_room() && client.connection.closed().is_none() {
                tickets.push(client.send(read()));
            }
            match step {
                Some(bytes) => client.receive(&bytes),
                None => client.after(SECOND / 3),
            }
            prop_assert!(client.connection.outgoing().len() <= 12 * tickets.len() + 40);
        }
        for _ in 0..1000 {
            let Some(deadline) = client.connection.deadline() else { break };
            let now = deadline.max(client.now);
            client.after(now - client.now);
            // After `advance`, nothing is due: a driver that waits for the deadline never spins.
            prop_assert!(client.connection.deadline().is_none_or(|deadline| deadline > now));
        }
        prop_assert_eq!((client.connection.in_flight(), client.connection.deadline()), (0, None));
        let mut found: Vec<Ticket> = client.got.iter().map(|(ticket, _)| *ticket).collect();
        found.sort_unstable();
        prop_assert_eq!(found, tickets);
    }

    #[test]
    fn a_valid_reply_in_any_pieces_is_accepted(
        transport in transports(),
        registers in prop::collection::vec(any::<u16>(), 1..=125),
        cuts in prop::collection::vec(1usize..20, 0..200),
    ) {
        let mut client = Client::new(transport);
        let quantity = registers.len() as u16;
        let ticket = client.send(Request::ReadInputRegisters(Range::new(0, quantity).unwrap()));
        let sent = client.outgoing();
        let bytes: Vec<u8> = registers.iter().flat_map(|each| each.to_be_bytes()).collect();
        let mut reply = [0; pdu::MAX_LEN];
        reply[..2].copy_from_slice(&[4, bytes.len() as u8]);
        reply[2..2 + bytes.len()].copy_from_slice(&bytes);
        let reply = &reply[..2 + bytes.len()];
        let stream = match transport {
            Transport::Tcp | Transport::Udp => mbap_frame(0, 7, reply),
            Transport::SerialAscii(_) => [sent, ascii_frame(7, reply)].concat(),
            _ => rtu_frame(7, reply),
        };
        let mut rest = &stream[..];
        for cut in cuts {
            if transport == Transport::Udp {
                break;
            }
            let (piece, left) = rest.split_at(cut.min(rest.len()));
            client.receive(piece);
            rest = left;
        }
        client.receive(rest);
        prop_assert_eq!(client.got(), [(ticket, Ok(bytes))]);
    }
}

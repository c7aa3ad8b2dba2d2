//! Tests the client side of a connection: what it sends, how it handles received bytes, and when it
//! ends.

#![cfg(feature = "alloc")]

use std::time::Duration;

use holdfast_protocol::client::{
    AcceptUnit, Attempt, BUSY_PAUSE, Closed, Connection, Done, Echo, Failure, GUARD,
    InvalidResponse, MAX_READ_DELAY, MAX_STRAY_DATAGRAMS, Strays, TURNAROUND, Ticket, Tolerance,
    Transport,
};
use holdfast_protocol::frame::{FrameError, ascii, mbap, rtu};
use holdfast_protocol::pdu::{
    self, EncodedRequest, Range, Registers, Request, Response, ResponseError,
};
use proptest::prelude::*;

fn read() -> Request<'static> {
    Request::ReadHoldingRegisters(Range::new(3, 1).unwrap())
}

const WRITE: Request<'_> = Request::WriteSingleRegister { address: 3, value: 7 };
const SECOND: Duration = Duration::from_secs(1);
const SILENCE: Duration = Duration::from_millis(2);
const RTU: Transport = Transport::SerialRtu { silence: SILENCE };
const ASCII: Transport = Transport::SerialAscii { silence: SILENCE };
const STRICT: Tolerance = Tolerance {
    accept_unit: AcceptUnit::Requested,
    pad: false,
    echo: Echo::Auto,
    pause: Duration::ZERO,
    pause_after_connect: Duration::ZERO,
    retries: 0,
    retry_busy: false,
    close_after: 0,
    reconnect: Duration::ZERO,
    write_multiple: false,
};

type Framed = fn(u8, &[u8]) -> Vec<u8>;

/// The result of a request: registers as bytes, empty for a write.
type Got = (Ticket, Result<Vec<u8>, Failure>);

fn noted(got: &mut Vec<Got>, again: &mut Option<Attempt>, done: &Done<'_>) {
    *again = done.again;
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
    /// What the last result said of another attempt.
    again: Option<Attempt>,
}

impl Client {
    fn new(transport: Transport) -> Client {
        Client::tolerant(transport, Tolerance::default())
    }

    fn tolerant(transport: Transport, tolerance: Tolerance) -> Client {
        let connection = Connection::tolerant(transport, tolerance, SECOND);
        Client { connection, now: SECOND, got: Vec::new(), again: None }
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
        let (got, again) = (&mut self.got, &mut self.again);
        self.connection.receive(bytes, self.now, |done| noted(got, again, &done));
    }

    fn cancel(&mut self, ticket: Ticket) {
        self.connection.cancel(ticket, self.now);
    }

    fn after(&mut self, time: Duration) {
        self.now += time;
        let (got, again) = (&mut self.got, &mut self.again);
        self.connection.advance(self.now, |done| noted(got, again, &done));
    }

    fn close(&mut self, why: Closed) {
        let (got, again) = (&mut self.got, &mut self.again);
        self.connection.close(why, |done| noted(got, again, &done));
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
fn a_silent_connection_ends_however_many_requests_are_in_flight() {
    let mut client = Client::new(Transport::Tcp);
    let start = client.now;
    client.send(read());
    while client.connection.closed().is_none() {
        // Whoever had a timeout asks again at once, and another one has asked half a second before.
        client.after(SECOND / 2);
        if client.connection.closed().is_none() {
            client.send(read());
        }
        assert!(client.now < start + 10 * SECOND, "three timeouts are enough");
    }
    assert!(client.now >= start + 3 * SECOND);
    assert!(client.connection.closed() == Some(Closed::Silent));
}

#[test]
fn a_slow_request_is_not_ended_by_timeouts_of_others() {
    let mut client = Client::new(Transport::Tcp);
    let request = EncodedRequest::new(&read());
    let slow = client.connection.send(7, &request, 20 * SECOND, client.now).unwrap();
    for _ in 0..10 {
        client.send(read());
        client.after(SECOND);
    }
    client.got();
    client.receive(&mbap_frame(0, 7, &[3, 2, 0, 1]));
    assert_eq!(client.got(), [(slow, Ok(vec![0, 1]))]);
}

#[test]
fn a_request_that_is_cancelled_counts_for_the_pause_and_the_number_of_requests() {
    let tolerance = Tolerance { pause: SECOND, close_after: 2, ..STRICT };
    let mut client = Client::tolerant(Transport::Tcp, tolerance);
    let ticket = client.send(read());
    client.outgoing();
    client.cancel(ticket);
    let ticket = client.send(read());
    assert_eq!(client.outgoing(), [], "it waits for the pause");
    client.after(SECOND);
    assert_ne!(client.outgoing(), []);
    client.cancel(ticket);
    assert_eq!(client.connection.closed(), Some(Closed::BySelf));
}

#[test]
fn a_request_that_is_cancelled_before_it_is_sent_is_not_sent_on_a_line() {
    let mut client = Client::new(RTU);
    client.send(read());
    client.outgoing();
    client.receive(&rtu_frame(7, &[3, 2, 0, 42]));
    let ticket = client.send(WRITE);
    assert_eq!(client.outgoing(), [], "the line is not silent yet");
    client.cancel(ticket);
    assert!(client.connection.has_room());
    client.after(SECOND);
    assert_eq!(client.outgoing(), []);
}

#[test]
fn a_line_of_noise_before_the_echo_loses_no_ascii_reply() {
    let tolerance = Tolerance { echo: Echo::Always, ..STRICT };
    let mut client = Client::tolerant(Transport::AsciiOverTcp, tolerance);
    let ticket = client.send(read());
    let echo = client.outgoing();
    client.receive(&[b"\0\r\n", &echo[..], &ascii_frame(7, &[3, 2, 0, 42])].concat());
    assert_eq!(client.got(), [(ticket, Ok(vec![0, 42]))]);
}

#[test]
fn lines_without_a_colon_before_an_ascii_reply_are_skipped_and_counted() {
    for stray in [&b"\r\n"[..], b"x\r\n", b"3F\r\n\r\n"] {
        let mut client = Client::new(ASCII);
        let ticket = client.send(read());
        client.receive(&[stray, &ascii_frame(7, &[3, 2, 0, 42])].concat());
        assert_eq!(client.got(), [(ticket, Ok(vec![0, 42]))], "{stray:?}");
        let bytes = stray.len() as u64;
        assert_eq!(client.connection.take_strays(), Strays { replies: 0, bytes });
    }
}

#[test]
fn the_wait_for_a_second_reply_does_not_count_as_response_time() {
    let mut client = Client::new(Transport::RtuOverTcp);
    let ms = SECOND / 1000;
    for address in 0..8 {
        let range = Range::new(address, 1).unwrap();
        let before = client.now;
        let ticket = client.send(Request::ReadHoldingRegisters(range));
        while client.outgoing().is_empty() {
            client.after(ms);
        }
        client.after(5 * ms);
        client.receive(&rtu_frame(7, &[3, 2, 0, 0]));
        let mut got = client.got();
        while got.is_empty() {
            client.after(ms);
            got = client.got();
        }
        assert_eq!(got, [(ticket, Ok(vec![0, 0]))]);
        assert!(client.now - before <= 100 * ms, "{:?}", client.now - before);
    }
}

#[test]
fn a_late_reply_is_dropped_and_counted_and_a_second_one_is_an_error() {
    let mut client = Client::new(Transport::Tcp);
    let [first, second] = [(); 2].map(|()| client.send(read()));
    client.cancel(first);
    let late = mbap_frame(0, 7, &[3, 2, 0, 1]);
    client.receive(&late);
    assert_eq!((client.got(), client.connection.late()), (vec![], 1));
    client.receive(&late);
    let invalid = InvalidResponse::TransactionId(0);
    assert_eq!(client.got(), [(second, Err(Failure::Invalid(invalid)))]);
    assert_eq!(client.connection.closed(), Some(Closed::Invalid(invalid)));
}

/// As after a stop of the process.
#[test]
fn a_reply_that_is_read_long_after_its_timeout_is_late_however_early_it_came() {
    let pdu = [3, 2, 0, 42];
    let frames: [(Transport, Vec<u8>); 7] = [
        (Transport::Tcp, mbap_frame(0, 7, &pdu)),
        (Transport::Udp, mbap_frame(0, 7, &pdu)),
        (Transport::RtuOverTcp, rtu_frame(7, &pdu)),
        (Transport::RtuOverUdp, rtu_frame(7, &pdu)),
        (Transport::AsciiOverTcp, ascii_frame(7, &pdu)),
        (RTU, rtu_frame(7, &pdu)),
        (ASCII, ascii_frame(7, &pdu)),
    ];
    for (transport, reply) in frames {
        let read_after = |delay| {
            let mut client = Client::new(transport);
            client.send(read());
            client.outgoing();
            client.now += SECOND + delay;
            client.receive(&reply);
            client
        };
        let mut client = read_after(MAX_READ_DELAY - Duration::from_nanos(1));
        assert_eq!(client.got(), [(Ticket(0), Ok(vec![0, 42]))], "{transport:?}");
        for delay in [MAX_READ_DELAY, 60 * MAX_READ_DELAY] {
            let mut client = read_after(delay);
            assert_eq!(client.got(), [(Ticket(0), Err(Failure::Timeout))], "{transport:?}");
            let is_dropped = client.connection.closed() == Some(Closed::TimedOut);
            assert!(is_dropped || client.connection.late() == 1, "{transport:?}");
            assert_eq!(client.connection.take_strays(), Strays::default(), "{transport:?}");
        }
    }
}

#[test]
fn stops_of_the_process_raise_no_timeout() {
    for transport in [Transport::Tcp, Transport::Udp, RTU] {
        let mut client = Client::new(transport);
        for id in 0..4u16 {
            client.send(read());
            while client.outgoing().is_empty() {
                let wait = client.connection.deadline().unwrap() - client.now;
                client.after(wait);
            }
            // Before a timer, or after it.
            client.now += SECOND + MAX_READ_DELAY;
            if id % 2 == 0 {
                client.after(Duration::ZERO);
            }
            client.receive(&match transport {
                RTU => rtu_frame(7, &[3, 2, 0, 42]),
                _ => mbap_frame(id, 7, &[3, 2, 0, 42]),
            });
            assert!(client.got().iter().all(|(_, got)| *got == Err(Failure::Timeout)));
        }
        assert_eq!(client.connection.late(), 4, "{transport:?}");
        assert_eq!(client.connection.longest_late(), Duration::ZERO, "nobody knows");
        assert_eq!(client.connection.take_raised(), 0, "{transport:?}");
    }
}

#[test]
fn a_reply_that_is_read_soon_after_its_timeout_is_not_late_because_another_one_is() {
    let replies = [0, 1].map(|id| mbap_frame(id, 7, &[3, 2, 0, 42]));
    for stream in [replies[1].clone(), replies.concat()] {
        let mut client = Client::new(Transport::Tcp);
        let first = client.send(read());
        client.now += SECOND - SECOND / 10;
        let second = client.send(read());
        client.outgoing();
        client.now += SECOND / 10 + MAX_READ_DELAY;
        client.receive(&stream);
        let expected = [(first, Err(Failure::Timeout)), (second, Ok(vec![0, 42]))];
        assert_eq!(client.got(), expected);
    }
}

#[test]
fn a_reply_that_was_doubted_until_long_after_its_timeout_is_not_believed() {
    let reply = rtu_frame(7, &[3, 2, 0, 42]);
    for (held_up, outcome) in [(GUARD, Ok(vec![0, 42])), (2 * SECOND, Err(Failure::Timeout))] {
        let mut client = Client::new(RTU);
        client.send(read());
        client.outgoing();
        // Its reply never comes.
        client.after(SECOND);
        client.got();
        client.after(9 * SECOND);
        let ticket = client.send(read());
        assert!(!client.outgoing().is_empty());
        client.receive(&reply);
        assert_eq!(client.got(), [], "another one may follow");
        client.after(held_up);
        assert_eq!(client.got(), [(ticket, outcome)]);
    }
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
    // The first request stays in flight, the second one is given up.
    let [_, second] = [(); 2].map(|()| client.send(read()));
    client.cancel(second);
    for id in 2..=u16::MAX {
        client.send(read());
        client.outgoing();
        client.receive(&mbap_frame(id, 7, &[3, 2, 0, 1]));
        assert_eq!(client.got().len(), 1);
    }
    client.send(read());
    assert_eq!(client.outgoing()[..2], 2u16.to_be_bytes());
}

#[test]
fn of_any_number_of_requests_without_a_reply_those_given_up_last_are_remembered() {
    let mut client = Client::new(Transport::Tcp);
    let give_up_more = |client: &mut Client, number: u32| {
        for _ in 0..number {
            let ticket = client.send(read());
            client.outgoing();
            client.cancel(ticket);
        }
    };
    give_up_more(&mut client, 65_536);
    // Its id is 0 again. It is given up after all others.
    let first = client.send(read());
    assert_eq!(client.outgoing()[..2], 0u16.to_be_bytes());
    give_up_more(&mut client, 65_535);
    client.cancel(first);
    client.send(read());
    assert_eq!(client.outgoing()[..2], 1u16.to_be_bytes());
    for (late, id) in [0, u16::MAX, u16::MAX - 4094].into_iter().enumerate() {
        client.receive(&mbap_frame(id, 7, &[3, 2, 0, 1]));
        assert_eq!((client.connection.late(), client.connection.closed()), (late as u64 + 1, None));
    }
    let forgotten = u16::MAX - 4095;
    client.receive(&mbap_frame(forgotten, 7, &[3, 2, 0, 1]));
    let unknown = InvalidResponse::TransactionId(forgotten);
    assert_eq!(client.connection.closed(), Some(Closed::Invalid(unknown)));
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
    assert_eq!(client.connection.deadline_of(first), None);
    assert_eq!(client.connection.deadline_of(second), Some(client.now + SECOND / 2));
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
fn a_silent_connection_ends_also_if_no_caller_waits_until_the_timeout() {
    let mut client = Client::new(Transport::Tcp);
    let start = client.now;
    while client.connection.closed().is_none() {
        let tickets = [client.send(read()), client.send(read())];
        client.after(SECOND / 2);
        tickets.into_iter().for_each(|ticket| client.cancel(ticket));
        assert!(client.now < start + 10 * SECOND, "three timeouts are enough");
    }
    assert!(client.now >= start + 3 * SECOND);
    let silent = || Err(Failure::Closed(Closed::Silent));
    assert_eq!(
        client.got().into_iter().map(|(_, got)| got).collect::<Vec<_>>(),
        [silent(), silent()]
    );
}

#[test]
fn requests_that_are_cancelled_end_no_connection_on_which_anything_is_received() {
    let mut client = Client::new(Transport::Tcp);
    for round in 0..10 {
        let ticket = client.send(read());
        client.after(SECOND / 2);
        client.cancel(ticket);
        assert_eq!(client.connection.deadline(), Some(client.now + SECOND / 2));
        client.receive(&mbap_frame(round, 7, &[3, 2, 0, 1]));
        assert_eq!(client.connection.deadline(), None);
        client.after(SECOND);
    }
    assert_eq!((client.connection.late(), client.connection.closed()), (10, None));
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
        client.connection.close(why, |done| noted(got, &mut None, &done));
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
fn a_connection_of_datagrams_ends_after_three_timeouts_without_one() {
    let mut client = Client::new(Transport::Udp);
    for id in 0..5 {
        assert_eq!(client.connection.closed(), None);
        let ticket = client.send(WRITE);
        client.after(SECOND);
        assert_eq!(client.got(), [(ticket, Err(Failure::Timeout))]);
        if id == 1 {
            client.receive(&mbap_frame(id, 7, &[6, 0, 3, 0, 7]));
            assert_eq!(client.connection.late(), 1);
        }
    }
    assert_eq!(client.connection.closed(), Some(Closed::Silent));
}

#[test]
fn a_datagram_that_answers_no_request_is_counted_and_a_malformed_one_ends_the_connection() {
    let mut client = Client::new(Transport::Udp);
    let ticket = client.send(read());
    client.receive(&mbap_frame(5, 7, &[3, 2, 0, 1]));
    client.receive(&mbap_frame(0, 8, &[3, 2, 0, 1]));
    assert_eq!((client.got(), client.connection.late()), (vec![], 0));
    assert_eq!(client.connection.take_strays(), Strays { replies: 2, bytes: 22 });
    client.receive(&mbap_frame(0, 7, &[3, 2, 0, 1]));
    assert_eq!(client.got(), [(ticket, Ok(vec![0, 1]))]);
    client.send(read());
    client.receive(&[mbap_frame(1, 7, &[3, 2, 0, 1]), vec![0]].concat());
    assert_eq!(client.connection.closed(), Some(Closed::Invalid(InvalidResponse::Datagram)));
}

#[test]
fn late_datagrams_are_told_apart_from_those_that_no_request_asked_for() {
    let mut client = Client::new(Transport::Udp);
    let reply = |id| mbap_frame(id, 7, &[3, 2, 0, 1]);
    client.send(read());
    client.after(SECOND);
    client.send(read());
    client.receive(&reply(0));
    client.receive(&reply(1));
    assert_eq!((client.got().len(), client.connection.late()), (2, 1));
    // A read is sent up to three times, so a fourth reply is one too many.
    for _ in 0..3 {
        client.receive(&reply(1));
    }
    assert_eq!(client.connection.late(), 3);
    client.receive(&reply(2));
    assert_eq!(client.connection.take_strays(), Strays { replies: 2, bytes: 22 });
    assert_eq!(client.connection.take_strays(), Strays::default());
}

#[test]
fn a_flood_of_datagrams_ends_the_connection() {
    let mut client = Client::new(Transport::Udp);
    let ticket = client.send(read());
    for _ in 0..MAX_STRAY_DATAGRAMS {
        client.receive(&mbap_frame(9, 7, &[3, 2, 0, 1]));
    }
    assert_eq!((client.got(), client.connection.closed()), (vec![], None));
    client.receive(&mbap_frame(9, 7, &[3, 2, 0, 1]));
    let flood = InvalidResponse::Flood;
    assert_eq!(client.got(), [(ticket, Err(Failure::Invalid(flood)))]);
    assert_eq!(client.connection.closed(), Some(Closed::Invalid(flood)));
}

#[test]
fn unpredictable_transaction_ids_of_datagrams_do_not_repeat_soon_or_count_up() {
    let ids = |seed| -> Vec<u16> {
        let mut client = Client::new(Transport::Udp);
        client.connection = Connection::new(Transport::Udp).unpredictable(seed);
        let id = |_| {
            client.send(read());
            let sent = client.outgoing();
            let id = u16::from_be_bytes([sent[0], sent[1]]);
            client.receive(&mbap_frame(id, 7, &[3, 2, 0, 1]));
            assert_eq!(client.got().len(), 1);
            id
        };
        (0..10_000).map(id).collect()
    };
    let (first, second) = (ids(1), ids(2));
    assert_ne!(first[0], second[0]);
    assert!(first.windows(16).all(|last| (1..16).all(|at| last[at] != last[0])));
    let counted_up = first.windows(2).filter(|pair| pair[1] == pair[0].wrapping_add(1)).count();
    assert!(counted_up < 10, "{counted_up}");
}

#[test]
fn what_no_request_asked_for_is_counted_in_streams_and_on_lines() {
    let reply = mbap_frame(0, 7, &[3, 2, 0, 1]);
    let foreign = [vec![0, 0, 0, 9], vec![0; 20]].concat();
    for (sent, replies, bytes) in [
        (mbap_frame(5, 7, &[3, 2, 0, 1]), 1, 11),
        (foreign, 0, 24),
        ([&reply[..]; 3].concat(), 1, 22),
    ] {
        let mut client = Client::new(Transport::Tcp);
        client.send(read());
        client.receive(&sent);
        assert_eq!(client.connection.take_strays(), Strays { replies, bytes });
    }

    let reply = rtu_frame(7, &[3, 2, 0, 42]);
    let silence = SECOND / 100;
    for transport in [Transport::RtuOverTcp, Transport::SerialRtu { silence }] {
        let mut client = Client::new(transport);
        client.after(SECOND);
        client.send(read());
        client.receive(&[&[0, 0, 0][..], &reply, &reply].concat());
        assert_eq!(client.got().len(), 1);
        let bytes = 3 + reply.len() as u64;
        assert_eq!(client.connection.take_strays(), Strays { replies: 0, bytes });
        client.receive(&reply);
        let bytes = reply.len() as u64;
        assert_eq!(client.connection.take_strays(), Strays { replies: 0, bytes });
    }

    let mut client = Client::new(Transport::AsciiOverTcp);
    client.send(read());
    let reply = ascii_frame(7, &[3, 2, 0, 42]);
    client.receive(&[b"xy", &reply[..], &b"z"[..]].concat());
    assert_eq!(client.got().len(), 1);
    assert_eq!(client.connection.take_strays(), Strays { replies: 0, bytes: 3 });
}

#[test]
fn a_reply_that_is_expected_leaves_no_stray_bytes() {
    for transport in [Transport::Tcp, Transport::Udp] {
        let mut client = Client::new(transport);
        client.send(read());
        client.receive(&mbap_frame(0, 7, &[3, 2, 0, 1]));
        assert_eq!(client.connection.take_strays(), Strays::default());
    }
    let mut client = Client::new(Transport::Tcp);
    client.send(read());
    client.after(SECOND);
    client.receive(&mbap_frame(0, 7, &[3, 2, 0, 1]));
    assert_eq!(client.connection.late(), 1, "late is not stray");
    assert_eq!(client.connection.take_strays(), Strays::default());
    let mut client = Client::new(Transport::RtuOverTcp);
    client.send(read());
    let frame = rtu_frame(7, &[3, 2, 0, 42]);
    let echo = client.outgoing();
    client.receive(&[echo, frame].concat());
    assert_eq!(client.got().len(), 1);
    assert_eq!(client.connection.take_strays(), Strays::default(), "an echo is not stray");
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
fn a_serial_line_is_silent_before_a_request_and_what_came_before_is_thrown_away() {
    let mut client = Client::new(RTU);
    client.receive(&[1, 2, 3]);
    let ticket = client.send(read());
    assert_eq!(client.outgoing(), []);
    assert_eq!(client.connection.deadline(), Some(client.now + SILENCE));
    client.after(SILENCE / 2);
    client.receive(&rtu_frame(7, &[3, 2, 0, 1]));
    client.after(SILENCE / 2);
    assert_eq!(client.outgoing(), []);
    client.after(SILENCE / 2);
    assert_eq!(client.outgoing(), [], "this was a reply, and may come again");
    client.after(GUARD - SILENCE);
    assert_eq!(client.outgoing(), rtu_frame(7, &[3, 0, 3, 0, 1]));
    client.receive(&rtu_frame(7, &[3, 2, 0, 42]));
    assert_eq!(client.got(), [(ticket, Ok(vec![0, 42]))]);
    client.send(read());
    assert_eq!(client.outgoing(), []);
}

#[test]
fn on_a_serial_line_that_is_never_silent_a_request_ends_unsent_and_says_so() {
    // The second one is how its reply would begin.
    for byte in [0, 7] {
        let mut client = Client::new(RTU);
        client.receive(&[byte]);
        let request = EncodedRequest::new(&WRITE);
        client.connection.send(7, &request, SECOND, client.now).unwrap();
        let mut ended = Vec::new();
        while ended.is_empty() {
            client.receive(&[byte]);
            client.now += SILENCE / 2;
            let sink = |done: Done<'_>| ended.push((done.outcome.map(drop), done.maybe_sent));
            client.connection.advance(client.now, sink);
            assert_eq!(client.outgoing(), []);
        }
        assert_eq!(ended, [(Err(Failure::NoSilence), false)]);
        assert_eq!(client.connection.closed(), None);
    }
}

#[test]
fn a_repeated_request_that_finds_no_silence_has_timed_out() {
    let mut client = Client::tolerant(RTU, Tolerance { retries: 1, ..STRICT });
    client.send(read());
    client.outgoing();
    client.after(SECOND);
    let again = client.again.take().unwrap();
    client.got();
    client.receive(&[0]);
    let request = EncodedRequest::new(&read());
    let ticket = client.connection.send_again(7, &request, SECOND, again, client.now).unwrap();
    let mut got = Vec::new();
    while got.is_empty() {
        client.receive(&[0]);
        client.after(SILENCE / 2);
        assert_eq!(client.outgoing(), []);
        got = client.got();
    }
    assert_eq!(got, [(ticket, Err(Failure::Timeout))], "the first one was sent");
}

#[test]
fn a_request_whose_thread_wakes_up_late_is_sent_and_has_its_whole_timeout() {
    for transport in [RTU, ASCII] {
        let mut client = Client::new(transport);
        client.receive(&[0]);
        let ticket = client.send(read());
        client.after(SECOND * 2);
        assert!(!client.outgoing().is_empty());
        assert_eq!(client.connection.deadline(), Some(client.now + SECOND));
        client.after(SECOND);
        assert_eq!(client.got(), [(ticket, Err(Failure::Timeout))]);
    }
}

#[test]
fn nobody_replies_to_a_broadcast_of_a_serial_line() {
    // Typically 100 to 200 ms (Serial Line V1.02, 2.4.1).
    let turnaround = Duration::from_millis(100);
    for transport in [RTU, ASCII] {
        let mut client = Client::new(transport);
        let request = EncodedRequest::new(&WRITE);
        let ticket = client.connection.send(0, &request, turnaround / 10, client.now).unwrap();
        assert!(!client.outgoing().is_empty());
        assert_eq!(client.connection.deadline(), Some(client.now + turnaround));
        client.after(turnaround / 2);
        assert_eq!(client.got(), []);
        client.after(turnaround / 2);
        assert_eq!(client.got(), [(ticket, Ok(vec![]))]);
    }
}

/// A serial line whose broadcast of a write has just ended.
fn after_broadcast(transport: Transport) -> Client {
    let mut client = Client::new(transport);
    client.connection.send(0, &EncodedRequest::new(&WRITE), SECOND, client.now).unwrap();
    client.outgoing();
    client.after(TURNAROUND);
    assert_eq!(client.got().len(), 1);
    client
}

#[test]
fn no_request_begins_while_the_one_before_it_is_still_on_the_line() {
    // The frames take 8 and 17 characters, of 100 ms each.
    let character = Duration::from_millis(100);
    for (transport, carried) in [(RTU, 8 * character), (ASCII, 17 * character)] {
        for (unit_id, wait) in [(0, TURNAROUND), (7, SECOND)] {
            let mut client = Client::new(transport);
            client.connection = Connection::new(transport).on_line(character);
            let request = EncodedRequest::new(&WRITE);
            client.connection.send(unit_id, &request, SECOND, client.now).unwrap();
            assert!(!client.outgoing().is_empty());
            assert_eq!(client.connection.deadline(), Some(client.now + carried + wait));
            client.after(carried);
            assert_eq!(client.got(), []);
            client.after(wait);
            assert_eq!(client.got().len(), 1);
        }
        // Nor if the connection ends meanwhile.
        let mut client = Client::new(transport);
        client.connection = Connection::new(transport).on_line(character);
        client.send(read());
        let past = client.connection.take_past(client.now);
        client.connection = Connection::new(transport);
        client.connection.follow(past);
        client.send(WRITE);
        client.after(carried);
        assert_eq!(client.outgoing(), []);
        client.after(SILENCE);
        assert!(!client.outgoing().is_empty());
    }
}

#[test]
fn a_damaged_reply_on_a_line_that_is_faster_than_its_settings_may_be_followed_by_a_right_one() {
    let mut client = Client::new(RTU);
    client.connection = Connection::new(RTU).on_line(SECOND / 10);
    client.send(read());
    let mut damaged = rtu_frame(7, &[3, 2, 0, 42]);
    damaged[6] ^= 1;
    client.receive(&damaged);
    assert_eq!(client.got().len(), 1);
    client.receive(&rtu_frame(7, &[3, 2, 0, 42]));
    assert_eq!(client.connection.late(), 1);
}

#[test]
fn a_confirmation_of_a_broadcast_does_not_end_the_next_write() {
    let other = Request::WriteSingleRegister { address: 3, value: 8 };
    for unit_id in [0, 7] {
        for (transport, frame) in [(RTU, rtu_frame as Framed), (ASCII, ascii_frame)] {
            let mut client = after_broadcast(transport);
            let ticket = client.send(other);
            client.after(SILENCE);
            assert!(!client.outgoing().is_empty(), "no confirmation can be taken for its reply");
            client.after(SECOND / 2);
            client.receive(&frame(unit_id, &[6, 0, 3, 0, 7]));
            assert_eq!(client.got(), []);
            client.receive(&frame(7, &[6, 0, 3, 0, 8]));
            client.after(SECOND / 2);
            assert_eq!(client.got(), [(ticket, Ok(vec![]))]);
        }
    }
}

#[test]
fn a_write_with_the_confirmation_of_a_broadcast_waits_until_that_can_not_come() {
    for is_confirmed in [true, false] {
        for (transport, frame) in [(RTU, rtu_frame as Framed), (ASCII, ascii_frame)] {
            let mut client = after_broadcast(transport);
            client.send(WRITE);
            client.after(SECOND / 2);
            if is_confirmed {
                // Unit 7 may confirm it too.
                client.receive(&frame(8, &[6, 0, 3, 0, 7]));
            }
            client.after(SECOND / 2 - TURNAROUND - SILENCE);
            assert_eq!(client.outgoing(), []);
            client.after(SILENCE);
            assert_eq!(client.outgoing(), frame(7, &[6, 0, 3, 0, 7]));
            assert_eq!(client.got(), []);
        }
    }
}

#[test]
fn the_confirmation_of_a_broadcast_may_come_to_the_next_connection_and_after_a_shorter_one() {
    let write = EncodedRequest::new(&WRITE);
    let mut client = Client::new(RTU);
    client.connection.send(0, &write, SECOND, client.now).unwrap();
    client.outgoing();
    let past = client.connection.take_past(client.now);
    client.connection = Connection::new(RTU);
    client.connection.follow(past);
    client.connection.send(0, &write, SECOND / 10, client.now).unwrap();
    client.after(SILENCE);
    client.outgoing();
    client.after(TURNAROUND);
    client.send(WRITE);
    client.after(SECOND - TURNAROUND - 2 * SILENCE);
    assert_eq!(client.outgoing(), []);
    client.after(SILENCE);
    assert_eq!(client.outgoing(), rtu_frame(7, &[6, 0, 3, 0, 7]));
}

#[test]
fn confirmations_of_a_broadcast_do_not_keep_a_request_waiting_for_ever() {
    let mut client = after_broadcast(RTU);
    client.send(read());
    client.after(SILENCE);
    for waiting in [1, 1, 1, 0] {
        assert_eq!(client.connection.in_flight(), waiting);
        client.after(SECOND * 4 / 5);
        client.receive(&rtu_frame(8, &[6, 0, 3, 0, 7]));
    }
}

#[test]
fn the_confirmations_and_the_echo_of_a_broadcast_are_no_replies_that_nobody_asked_for() {
    let registers = Registers::new(&[0, 7]).unwrap();
    let values = Request::WriteMultipleRegisters { address: 3, registers };
    for (transport, frame) in [(RTU, rtu_frame as Framed), (ASCII, ascii_frame)] {
        for (timeout, broadcast, came) in [
            (SECOND, WRITE, frame(7, &[6, 0, 3, 0, 7])),
            (SECOND / 100, WRITE, frame(7, &[6, 0, 3, 0, 7])),
            (SECOND, WRITE, frame(7, &[0x86, 2])),
            (SECOND, values, frame(7, &[16, 0, 3, 0, 1])),
            (SECOND, values, frame(0, &[16, 0, 3, 0, 1, 2, 0, 7])),
        ] {
            let mut client = Client::new(transport);
            for value in 0..8 {
                client.send(read());
                client.after(GUARD);
                client.receive(&frame(7, &[3, 2, 0, value]));
            }
            let broadcast = EncodedRequest::new(&broadcast);
            client.connection.send(0, &broadcast, timeout, client.now).unwrap();
            client.after(SILENCE);
            client.outgoing();
            client.after(TURNAROUND / 2);
            client.receive(&came);
            client.after(TURNAROUND / 2);
            assert_eq!(client.got().len(), 9);
            assert_eq!(client.connection.take_strays(), Strays::default());
            client.send(read());
            client.after(SILENCE);
            assert!(!client.outgoing().is_empty(), "there is no guard time: {came:x?}");
        }
    }
}

#[test]
fn an_invalid_reply_does_not_end_a_serial_line() {
    for (transport, bad, good) in [
        (RTU, rtu_frame(8, &[3, 2, 0, 1]), rtu_frame(7, &[3, 2, 0, 1])),
        (ASCII, ascii_frame(8, &[3, 2, 0, 1]), ascii_frame(7, &[3, 2, 0, 1])),
    ] {
        let mut client = Client::new(transport);
        let first = client.send(read());
        client.outgoing();
        client.receive(&bad);
        let invalid = InvalidResponse::UnitId { expected: 7, found: 8 };
        assert_eq!(client.got(), [(first, Err(Failure::Invalid(invalid)))]);
        let second = client.send(read());
        client.after(SILENCE);
        assert_eq!(client.outgoing(), [], "the reply to the first may still come");
        client.after(SECOND / 2);
        client.receive(&good);
        assert_eq!(client.got(), [], "another one may follow");
        client.after(GUARD);
        assert_eq!(client.got(), [(second, Ok(vec![0, 1]))]);
        let third = client.send(read());
        client.after(GUARD);
        client.after(SECOND);
        assert_eq!(client.got(), [(third, Err(Failure::Timeout))]);
        assert_eq!(client.connection.closed(), None);
    }
}

#[test]
fn an_echo_is_removed_if_it_is_expected_or_cannot_be_a_reply() {
    for (echo, request) in [(Echo::Auto, read()), (Echo::Always, read()), (Echo::Always, WRITE)] {
        for ascii in [false, true] {
            let frame = |pdu: &[u8]| if ascii { ascii_frame(7, pdu) } else { rtu_frame(7, pdu) };
            let tolerance = Tolerance { echo, ..STRICT };
            let mut client = Client::tolerant(if ascii { ASCII } else { RTU }, tolerance);
            let ticket = client.send(request);
            let sent = client.outgoing();
            let reply: &[u8] = if request == read() { &[3, 2, 0, 5] } else { &[6, 0, 3, 0, 7] };
            let registers = if request == read() { vec![0, 5] } else { vec![] };
            for byte in [sent, frame(reply)].concat() {
                client.receive(&[byte]);
            }
            assert_eq!(client.got(), [(ticket, Ok(registers))], "{echo:?} {request:?} {ascii}");
        }
    }
}

#[test]
fn one_echo_makes_a_line_not_deaf() {
    for transport in [RTU, ASCII] {
        let frame =
            |pdu: &[u8]| if transport == RTU { rtu_frame(7, pdu) } else { ascii_frame(7, pdu) };
        let mut client = Client::new(transport);
        client.send(read());
        let echo = client.outgoing();
        client.receive(&echo);
        client.after(SECOND);
        assert_eq!(client.got().len(), 1);
        client.after(4 * SECOND);
        for request in [read(), WRITE, read(), WRITE] {
            client.send(request);
            client.after(SECOND / 10);
            client.outgoing();
            let reply: &[u8] = if request == WRITE { &[6, 0, 3, 0, 7] } else { &[3, 2, 0, 5] };
            client.receive(&frame(reply));
            client.after(SECOND / 10);
            assert!(matches!(client.got()[..], [(_, Ok(_))]), "{request:?}");
        }
    }
}

#[test]
fn an_echo_is_expected_of_writes_after_three_reads_until_a_read_without_one() {
    let mut client = Client::new(RTU);
    let answered = |client: &mut Client, request: Request<'_>, times: usize| {
        client.send(request);
        client.after(SECOND / 10);
        let echo = client.outgoing();
        let reply: &[u8] = if request == WRITE { &[6, 0, 3, 0, 7] } else { &[3, 2, 0, 5] };
        client.receive(&[echo.repeat(times), rtu_frame(7, reply)].concat());
        client.after(SECOND / 10);
        client.got()
    };
    for _ in 0..3 {
        assert!(matches!(answered(&mut client, read(), 1)[..], [(_, Ok(_))]));
    }
    assert_eq!(answered(&mut client, WRITE, 0), [], "this may be the echo");
    client.after(SECOND);
    assert!(matches!(client.got()[..], [(_, Err(Failure::Timeout))]));
    client.after(4 * SECOND);
    for _ in 0..3 {
        assert!(matches!(answered(&mut client, read(), 1)[..], [(_, Ok(_))]));
    }
    assert!(matches!(answered(&mut client, WRITE, 1)[..], [(_, Ok(_))]));
    assert!(matches!(answered(&mut client, read(), 0)[..], [(_, Ok(_))]), "it is unlearned");
    assert!(matches!(answered(&mut client, WRITE, 0)[..], [(_, Ok(_))]));
}

#[test]
fn an_echo_of_a_write_is_no_confirmation_after_reads_with_echoes() {
    for (reads, next_connection) in [(1, false), (2, false), (3, false), (3, true)] {
        for transport in [RTU, Transport::RtuOverTcp] {
            let mut client = Client::new(transport);
            for _ in 0..reads {
                client.send(read());
                client.after(SECOND / 10);
                let echo = client.outgoing();
                client.receive(&[echo, rtu_frame(7, &[3, 2, 0, 5])].concat());
                assert!(matches!(client.got()[..], [(_, Ok(_))]));
            }
            if next_connection {
                let mut next = Connection::new(transport);
                next.follow(client.connection.take_past(client.now));
                client.connection = next;
            }
            client.send(WRITE);
            client.after(SECOND / 10);
            let echo = client.outgoing();
            client.receive(&echo);
            client.after(SECOND / 2);
            assert_eq!(client.got(), [], "{reads} {next_connection}");
            client.after(SECOND);
            assert!(matches!(client.got()[..], [(_, Err(Failure::Timeout))]));
        }
    }
}

#[test]
fn an_echo_is_still_expected_after_a_write_that_got_nothing() {
    let mut client = Client::new(RTU);
    for _ in 0..3 {
        client.send(read());
        client.after(SECOND / 10);
        let echo = client.outgoing();
        client.receive(&[echo, rtu_frame(7, &[3, 2, 0, 5])].concat());
    }
    client.got();
    for echoes in [0, 1] {
        client.send(WRITE);
        while client.connection.outgoing().is_empty() {
            client.after(SECOND / 10);
        }
        let echo = client.outgoing();
        client.receive(&echo.repeat(echoes));
        client.after(SECOND);
        assert!(matches!(client.got()[..], [(_, Err(Failure::Timeout))]), "{echoes}");
    }
}

#[test]
fn without_an_echo_the_request_sent_back_is_no_reply() {
    let tolerance = Tolerance { echo: Echo::Never, ..STRICT };
    let mut client = Client::tolerant(RTU, tolerance);
    client.send(read());
    let echo = client.outgoing();
    client.receive(&echo);
    client.receive(&rtu_frame(7, &[3, 2, 0, 42]));
    client.after(SECOND);
    assert!(matches!(client.got()[..], [(_, Err(Failure::Invalid(_)))]));
}

#[test]
fn the_reply_to_a_dropped_request_on_a_line_is_not_taken_for_another() {
    let mut client = Client::new(Transport::RtuOverTcp);
    let ticket = client.send(read());
    client.cancel(ticket);
    assert!(!client.connection.has_room());
    client.receive(&rtu_frame(7, &[3, 2, 0, 42]));
    assert_eq!(client.got(), []);
    assert!(client.connection.has_room());
}

#[test]
fn the_timeout_of_a_request_runs_from_the_reply_before_it() {
    let mut client = Client::new(Transport::Tcp);
    let [first, second, third] = [(); 3].map(|()| client.send(read()));
    for (id, ticket) in [(0, first), (1, second)] {
        client.after(SECOND * 3 / 4);
        client.receive(&mbap_frame(id, 7, &[3, 2, 0, 1]));
        assert_eq!(client.got(), [(ticket, Ok(vec![0, 1]))]);
    }
    client.after(SECOND * 3 / 4);
    assert_eq!(client.got(), []);
    client.after(SECOND / 4);
    assert_eq!(client.got(), [(third, Err(Failure::Timeout))]);
}

#[test]
fn a_reply_to_a_later_request_gives_an_earlier_one_no_more_time() {
    let mut client = Client::new(Transport::Tcp);
    let [first, _] = [(); 2].map(|()| client.send(read()));
    client.after(SECOND / 2);
    client.receive(&mbap_frame(1, 7, &[3, 2, 0, 1]));
    client.got();
    client.after(SECOND / 2);
    assert_eq!(client.got(), [(first, Err(Failure::Timeout))]);
}

#[test]
fn a_late_reply_gives_later_requests_their_time() {
    let mut client = Client::new(Transport::Tcp);
    client.send(read());
    client.after(SECOND / 2);
    let second = client.send(read());
    client.after(SECOND / 2);
    client.after(SECOND / 4);
    client.receive(&mbap_frame(0, 7, &[3, 2, 0, 1]));
    assert_eq!(client.connection.deadline_of(second), Some(client.now + SECOND));
}

/// A connection that has carried a reply.
fn used(tolerance: Tolerance) -> Client {
    let mut client = Client::tolerant(Transport::Tcp, tolerance);
    client.send(read());
    client.receive(&mbap_frame(0, 7, &[3, 2, 0, 1]));
    client.got();
    client
}

#[test]
fn a_read_is_repeated_once_when_a_used_connection_ends_without_a_byte_of_its_reply() {
    let mut client = used(STRICT);
    let request = EncodedRequest::new(&read());
    client.send(read());
    client.close(Closed::ByPeer);
    let again = client.again.take().unwrap();
    assert!(again.pause().is_zero() && !again.has_own_timeout());
    let mut client = used(STRICT);
    client.connection.send_again(7, &request, SECOND, again, SECOND).unwrap();
    client.close(Closed::ByPeer);
    assert_eq!((client.got().len(), client.again), (1, None));
}

#[test]
fn nothing_else_is_repeated() {
    let lost = |mut client: Client, request, bytes: &[u8], why| {
        client.send(request);
        client.receive(bytes);
        client.close(why);
        assert_eq!(client.got().len(), 1);
        client.again
    };
    let fresh = Client::new(Transport::Tcp);
    assert_eq!(lost(fresh, read(), &[], Closed::ByPeer), None);
    assert_eq!(lost(used(STRICT), WRITE, &[], Closed::ByPeer), None);
    assert_eq!(lost(used(STRICT), read(), &[0], Closed::ByPeer), None);
    assert_eq!(lost(used(STRICT), read(), &[], Closed::BySelf), None);
    let retried = Tolerance { retries: 3, retry_busy: true, ..STRICT };
    assert_eq!(lost(used(retried), WRITE, &[], Closed::ByPeer), None);
    assert_eq!(lost(used(retried), read(), &[], Closed::BySelf), None);
}

#[test]
fn reads_are_retried_as_often_as_the_device_needs() {
    let busy = Tolerance { retries: 2, retry_busy: true, pause: SECOND / 100, ..STRICT };
    let exception = |code| {
        move |client: &mut Client| {
            let reply = mbap_frame(0, 7, &[0x83, code]);
            client.receive(&reply);
        }
    };
    type Case = (Tolerance, Box<dyn Fn(&mut Client)>, Option<Duration>);
    let cases: [Case; 6] = [
        (busy, Box::new(exception(6)), Some(BUSY_PAUSE)),
        (busy, Box::new(exception(5)), Some(BUSY_PAUSE)),
        (busy, Box::new(exception(2)), None),
        (busy, Box::new(|client| client.after(SECOND)), Some(SECOND / 100)),
        (Tolerance { retry_busy: false, ..busy }, Box::new(exception(6)), None),
        (Tolerance { retries: 0, ..busy }, Box::new(exception(6)), None),
    ];
    for (tolerance, fail, pause) in cases {
        let request = EncodedRequest::new(&read());
        let mut attempt = Attempt::default();
        for retry in 0..=tolerance.retries {
            let mut client = Client::tolerant(Transport::Tcp, tolerance);
            client.connection.send_again(7, &request, SECOND, attempt, SECOND).unwrap();
            fail(&mut client);
            let expected = pause.filter(|_| retry < tolerance.retries);
            assert_eq!(client.again.map(|again| again.pause()), expected);
            let Some(again) = client.again else { break };
            assert!(again.has_own_timeout());
            attempt = again;
        }
    }
}

#[test]
fn a_unit_id_is_accepted_where_the_device_may_send_it() {
    for (accept_unit, found, accepted) in [
        (AcceptUnit::Also(0), 0, true),
        (AcceptUnit::Also(0), 7, true),
        (AcceptUnit::Also(0), 1, false),
        (AcceptUnit::Any, 255, true),
        (AcceptUnit::Requested, 0, false),
    ] {
        let tolerance = Tolerance { accept_unit, ..STRICT };
        let pdu = [3, 2, 0, 1];
        for (transport, frame) in [
            (Transport::Tcp, mbap_frame(0, found, &pdu)),
            (Transport::Udp, mbap_frame(0, found, &pdu)),
            (Transport::RtuOverTcp, rtu_frame(found, &pdu)),
            (ASCII, ascii_frame(found, &pdu)),
        ] {
            let mut client = Client::tolerant(transport, tolerance);
            client.send(read());
            client.receive(&frame);
            client.after(SECOND);
            let outcome = client.got().remove(0).1;
            assert_eq!(outcome.is_ok(), accepted, "{transport:?} {accept_unit:?} {found}");
        }
    }
}

#[test]
fn padding_is_ignored_where_the_device_may_send_some() {
    let tolerance = Tolerance { pad: true, ..STRICT };
    for transport in [Transport::Tcp, Transport::Udp] {
        let mut client = Client::tolerant(transport, tolerance);
        let first = client.send(read());
        client.receive(&mbap_frame(0, 7, &[3, 2, 0, 1, 0, 0, 0]));
        assert_eq!(client.got(), [(first, Ok(vec![0, 1]))]);
        let second = client.send(read());
        client.receive(&[0, 1, 0, 0, 0, 4, 7, 0x83, 3]);
        assert_eq!(client.got(), [(second, Err(Failure::Exception(3)))]);
        let third = client.send(read());
        client.receive(&mbap_frame(2, 7, &[3, 2, 0, 3]));
        assert_eq!(client.got(), [(third, Ok(vec![0, 3]))]);
        // More registers than were asked for are no padding.
        client.send(read());
        client.receive(&mbap_frame(3, 7, &[3, 4, 0, 1, 0, 1]));
        assert!(matches!(client.got()[0].1, Err(Failure::Invalid(_))));
    }
    let mut client = Client::tolerant(Transport::RtuOverTcp, tolerance);
    let ticket = client.send(read());
    client.receive(&[rtu_frame(7, &[3, 2, 0, 1]), vec![0, 0]].concat());
    client.receive(&[0]);
    assert_eq!(client.got(), [(ticket, Ok(vec![0, 1]))]);
    assert_eq!(client.connection.closed(), None);
}

#[test]
fn what_a_header_counts_beyond_an_exception_may_come_later() {
    for surplus in [&[][..], &[0], &[1]] {
        let mut client = Client::tolerant(Transport::Tcp, Tolerance { pad: true, ..STRICT });
        client.send(read());
        client.receive(&[0, 0, 0, 0, 0, 4, 7, 0x83, 2]);
        let second = client.send(read());
        client.receive(&[surplus, &mbap_frame(1, 7, &[3, 2, 0, 3])].concat());
        assert_eq!(client.got()[1..], [(second, Ok(vec![0, 3]))], "{surplus:?}");
    }
}

#[test]
fn a_pause_separates_requests_and_does_not_count_as_waiting() {
    let tolerance = Tolerance { pause: SECOND * 2, pause_after_connect: SECOND * 3, ..STRICT };
    for (transport, reply) in [
        (Transport::Tcp, mbap_frame(0, 7, &[3, 2, 0, 1])),
        (Transport::RtuOverTcp, rtu_frame(7, &[3, 2, 0, 1])),
        (Transport::Udp, mbap_frame(0, 7, &[3, 2, 0, 1])),
    ] {
        let mut client = Client::tolerant(transport, tolerance);
        for (wait, answer) in [(3, true), (2, false)] {
            client.send(read());
            assert!(!client.connection.has_room());
            assert_eq!(client.outgoing(), []);
            assert_eq!(client.connection.deadline(), Some(client.now + SECOND * wait));
            client.after(SECOND * wait);
            assert!(!client.outgoing().is_empty());
            assert_eq!(client.got(), []);
            if answer {
                client.receive(&reply);
            } else {
                client.after(SECOND);
            }
            assert_eq!(client.got()[0].1.is_ok(), answer, "{transport:?}");
        }
    }
}

/// As where a thread wakes up late.
#[test]
fn after_a_pause_that_ends_late_requests_are_sent_late_and_have_their_whole_timeout() {
    let tolerance = Tolerance { pause_after_connect: SECOND, ..STRICT };
    for transport in [Transport::Tcp, Transport::Udp, Transport::RtuOverTcp, RTU] {
        let confirmation = match transport {
            Transport::Tcp | Transport::Udp => mbap_frame(0, 7, &[6, 0, 3, 0, 7]),
            _ => rtu_frame(7, &[6, 0, 3, 0, 7]),
        };
        let mut client = Client::tolerant(transport, tolerance);
        let ticket = client.send(WRITE);
        client.after(60 * SECOND);
        assert_eq!(client.got(), [], "{transport:?}: it was not sent yet");
        assert_eq!(client.outgoing(), confirmation, "the request is the same");
        assert_eq!(client.connection.deadline(), Some(client.now + SECOND));
        client.after(SECOND / 2);
        client.receive(&confirmation);
        assert_eq!(client.got(), [(ticket, Ok(Vec::new()))], "{transport:?}");
    }

    let mut client = Client::tolerant(Transport::Tcp, tolerance);
    let first = client.send(WRITE);
    client.now += 60 * SECOND;
    let second = client.send(read());
    client.after(Duration::ZERO);
    assert_eq!(client.got(), []);
    assert_eq!(client.outgoing().len(), 24);
    client.after(SECOND);
    assert_eq!(client.got(), [first, second].map(|ticket| (ticket, Err(Failure::Timeout))));
    assert_eq!(client.outgoing(), []);

    let mut client = Client::tolerant(Transport::Udp, tolerance);
    client.send(read());
    client.after(60 * SECOND);
    for _ in 0..3 {
        assert!(!client.outgoing().is_empty(), "a read is sent three times");
        client.after(SECOND / 3);
    }
}

#[test]
fn a_request_that_is_cancelled_during_a_pause_is_not_sent() {
    let tolerance = Tolerance { pause_after_connect: SECOND, ..STRICT };
    for cancelled in 0..3 {
        let mut client = Client::tolerant(Transport::Tcp, tolerance);
        let tickets = [client.send(read()), client.send(WRITE), client.send(read())];
        client.cancel(tickets[cancelled]);
        assert_eq!(client.outgoing(), []);
        client.after(SECOND);
        let pdus = [&[3, 0, 3, 0, 1][..], &[6, 0, 3, 0, 7], &[3, 0, 3, 0, 1]];
        let sent: Vec<u8> = (0..3)
            .filter(|index| *index != cancelled)
            .flat_map(|index| mbap_frame(index as u16, 7, pdus[index]))
            .collect();
        assert_eq!(client.outgoing(), sent);
        for index in (0..3).filter(|index| *index != cancelled) {
            let reply = if index == 1 { pdus[1] } else { &[3, 2, 0, 1] };
            client.receive(&mbap_frame(index as u16, 7, reply));
            assert_eq!(client.got()[0].0, tickets[index]);
        }
    }

    let mut client = Client::tolerant(Transport::Tcp, Tolerance { pause: SECOND, ..STRICT });
    client.send(read());
    client.receive(&mbap_frame(0, 7, &[3, 2, 0, 1]));
    client.outgoing();
    let ticket = client.send(WRITE);
    client.cancel(ticket);
    assert_eq!(client.connection.deadline(), None);
    client.send(read());
    client.after(SECOND);
    assert_eq!(client.outgoing(), mbap_frame(2, 7, &[3, 0, 3, 0, 1]));
}

#[test]
fn a_reply_to_a_request_that_was_not_sent_yet_ends_the_connection() {
    let mut client = Client::tolerant(Transport::Tcp, Tolerance { pause: SECOND, ..STRICT });
    client.send(read());
    client.receive(&mbap_frame(0, 7, &[3, 2, 0, 1]));
    client.got();
    client.send(WRITE);
    client.receive(&mbap_frame(1, 7, &[6, 0, 3, 0, 7]));
    let invalid = InvalidResponse::TransactionId(1);
    assert_eq!(client.connection.closed(), Some(Closed::Invalid(invalid)));
}

#[test]
fn a_device_without_functions_5_and_6_gets_15_and_16() {
    let tolerance = Tolerance { write_multiple: true, ..STRICT };
    let mut client = Client::tolerant(Transport::Tcp, tolerance);
    let coil = Request::WriteSingleCoil { address: 4, value: true };
    let tickets = [client.send(WRITE), client.send(coil)];
    let register = mbap_frame(0, 7, &[16, 0, 3, 0, 1, 2, 0, 7]);
    let coil = mbap_frame(1, 7, &[15, 0, 4, 0, 1, 1, 1]);
    assert_eq!(client.outgoing(), [register, coil].concat());
    client.receive(&mbap_frame(0, 7, &[16, 0, 3, 0, 1]));
    client.receive(&mbap_frame(1, 7, &[15, 0, 4, 0, 1]));
    assert_eq!(client.got(), tickets.map(|ticket| (ticket, Ok(Vec::new()))));
}

#[test]
fn a_request_that_is_passed_on_keeps_its_function() {
    let tolerance = Tolerance { write_multiple: true, ..STRICT };
    let passed_on = EncodedRequest::opaque(&[6, 0, 3, 0, 7]).unwrap();
    assert_eq!(tolerance.adapted(&passed_on), None);
}

#[test]
fn a_connection_ends_after_as_many_requests_as_the_device_allows() {
    let mut client = Client::tolerant(Transport::Tcp, Tolerance { close_after: 2, ..STRICT });
    for id in 0..2 {
        assert_eq!(client.connection.closed(), None);
        client.send(read());
        assert!(!client.connection.has_room());
        client.receive(&mbap_frame(id, 7, &[3, 2, 0, 1]));
        assert_eq!(client.got().len(), 1);
    }
    assert_eq!(client.connection.closed(), Some(Closed::BySelf));
}

#[test]
fn stray_bytes_before_an_rtu_reply_are_skipped() {
    let reply = rtu_frame(7, &[3, 2, 0, 42]);
    let strays: [&[u8]; 6] = [&[0], &[0xFF], &[7], &[7, 3], &[7, 7, 3, 1], &[0x55; 40]];
    for transport in [Transport::RtuOverTcp, Transport::RtuOverUdp, RTU] {
        for stray in strays {
            let mut client = Client::new(transport);
            let ticket = client.send(read());
            for byte in [stray, &reply].concat() {
                client.receive(&[byte]);
            }
            let expected = [(ticket, Ok(vec![0, 42]))];
            assert_eq!(client.got(), expected, "{transport:?} {stray:?}");
        }
    }
}

#[test]
fn a_damaged_reply_whose_values_look_like_the_start_of_a_reply_is_reported() {
    let damaged = Err(Failure::Invalid(InvalidResponse::Frame(FrameError::CheckSum)));
    // Behind the first one, no reply can have begun; behind the second one, an exception can.
    for (values, waits) in [([7, 3], false), ([7, 0x83], true)] {
        let mut client = Client::new(RTU);
        let ticket = client.send(read());
        let mut reply = rtu_frame(7, &[&[3, 2][..], &values].concat());
        reply[6] ^= 1;
        client.receive(&reply);
        if waits {
            assert_eq!(client.got(), []);
            client.after(SECOND);
        }
        assert_eq!(client.got(), [(ticket, damaged.clone())]);
    }
}

#[test]
fn a_late_reply_that_contains_a_reply_is_not_searched_for_it() {
    let mut client = Client::new(RTU);
    let four = Request::ReadHoldingRegisters(Range::new(3, 4).unwrap());
    client.send(four);
    client.after(SECOND);
    client.got();
    let ticket = client.send(read());
    client.after(SILENCE);
    let late = rtu_frame(7, &[&[3, 8, 9][..], &rtu_frame(7, &[3, 2, 0, 42])].concat());
    late.iter().for_each(|byte| client.receive(&[*byte]));
    assert_eq!((client.got(), client.connection.late()), (vec![], 1));
    client.receive(&rtu_frame(7, &[3, 2, 0, 1]));
    client.after(GUARD);
    assert_eq!(client.got(), [(ticket, Ok(vec![0, 1]))]);
}

#[test]
fn stray_bytes_alone_are_an_invalid_reply() {
    let mut client = Client::new(Transport::RtuOverTcp);
    let ticket = client.send(read());
    client.receive(&[0xFF; 9]);
    assert_eq!(client.got(), []);
    client.after(SECOND);
    let invalid = InvalidResponse::Frame(FrameError::CheckSum);
    assert_eq!(client.got(), [(ticket, Err(Failure::Invalid(invalid)))]);
}

#[test]
fn a_reply_that_is_cut_off_by_another_one_is_not_believed() {
    let reply = mbap_frame(0, 7, &[3, 4, 0, 1, 0, 2]);
    let request = Request::ReadHoldingRegisters(Range::new(3, 2).unwrap());
    for cut in mbap::HEADER_LEN + 2..reply.len() {
        let mut client = Client::new(Transport::Tcp);
        let ticket = client.send(request);
        client.receive(&[&reply[..cut], &reply].concat());
        let got = client.got();
        assert!(
            matches!(got[..], [(of, Err(Failure::Invalid(_)))] if of == ticket),
            "{cut} {got:?}"
        );
    }
    // Whatever the other reply answers, and however little of it shows that it is no frame.
    let late = mbap_frame(0, 7, &[6, 0, 5, 0x46, 0xD7]);
    let answered = mbap_frame(1, 7, &[3, 4, 0x11, 0x11, 0x22, 0x22]);
    for other in [&late, &answered] {
        for missing in 1..=4 {
            let mut client = Client::new(Transport::Tcp);
            client.send(request);
            client.after(SECOND);
            client.send(request);
            client.receive(&answered);
            let ticket = client.send(request);
            client.got();
            let cut_off = mbap_frame(2, 7, &[3, 4, 0, 1, 0, 2]);
            client.receive(&cut_off[..cut_off.len() - missing]);
            client.receive(other);
            let got = client.got();
            assert!(
                matches!(got[..], [(of, Err(Failure::Invalid(_)))] if of == ticket),
                "{missing} {got:?}"
            );
        }
    }
    // With nothing of another reply in it, what follows does not matter.
    let mut client = Client::new(Transport::Tcp);
    let ticket = client.send(request);
    client.receive(&[&reply[..], &[9; 20]].concat());
    assert_eq!(client.got(), [(ticket, Ok(vec![0, 1, 0, 2]))]);
    // Nor if the last values and the first of the other bytes are like a header of a wrong length.
    let mut client = Client::new(Transport::Tcp);
    let ticket = client.send(request);
    let values = mbap_frame(0, 7, &[3, 4, 0, 1, 0, 0]);
    client.receive(&[&values[..], &[0, 0, 0xFF, 0xFF, 9, 9]].concat());
    assert_eq!(client.got(), [(ticket, Ok(vec![0, 1, 0, 0]))]);
}

#[test]
fn an_echo_in_a_stream_is_taken_away() {
    for (tolerance, stray) in
        [(STRICT, &[][..]), (Tolerance { echo: Echo::Always, ..STRICT }, &[0])]
    {
        let mut client = Client::tolerant(Transport::RtuOverTcp, tolerance);
        let ticket = client.send(read());
        let echo = client.outgoing();
        client.receive(&[stray, &echo, &rtu_frame(7, &[3, 2, 0, 42])].concat());
        assert_eq!(client.got(), [(ticket, Ok(vec![0, 42]))]);
    }
}

#[test]
fn a_reply_that_equals_its_request_is_no_echo() {
    // 24 coils from address 0x03C8, whose reply has the three bytes C8 00 18.
    let request = Request::ReadCoils(Range::new(0x03C8, 24).unwrap());
    let mut client = Client::new(RTU);
    let ticket = client.send(request);
    let reply = client.outgoing();
    client.receive(&reply);
    assert_eq!(client.got(), [(ticket, Ok(vec![0xC8, 0, 24]))]);
}

fn tolerances() -> impl Strategy<Value = Tolerance> {
    let unit = prop_oneof![
        Just(AcceptUnit::Requested),
        any::<u8>().prop_map(AcceptUnit::Also),
        Just(AcceptUnit::Any)
    ];
    let flags = any::<[bool; 4]>();
    (unit, flags, 0..3u32, 0..3u32, 0..3u8, 0..3u32).prop_map(
        |(
            accept_unit,
            [pad, echo, retry_busy, write_multiple],
            pause,
            connect,
            retries,
            close_after,
        )| Tolerance {
            accept_unit,
            pad,
            echo: if echo { Echo::Always } else { Echo::Auto },
            pause: SECOND / 4 * pause,
            pause_after_connect: SECOND / 4 * connect,
            retries,
            retry_busy,
            close_after,
            reconnect: Duration::ZERO,
            write_multiple,
        },
    )
}

fn transports() -> impl Strategy<Value = Transport> {
    prop_oneof![
        Just(Transport::Tcp),
        Just(Transport::Udp),
        Just(Transport::RtuOverTcp),
        Just(RTU),
        Just(ASCII),
        Just(Transport::RtuOverUdp),
        Just(Transport::AsciiOverTcp),
    ]
}

proptest! {
    #[test]
    fn for_any_bytes_every_request_has_one_result_and_memory_is_bounded(
        transport in transports(),
        tolerance in tolerances(),
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
        let mut client = Client::tolerant(transport, tolerance);
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
            ASCII | Transport::AsciiOverTcp => [sent, ascii_frame(7, reply)].concat(),
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

#[test]
fn a_pause_lasts_beyond_the_end_of_a_connection() {
    let tolerance = Tolerance { pause: SECOND * 2, close_after: 1, ..STRICT };
    let read = EncodedRequest::new(&read());
    let mut first = Connection::tolerant(Transport::Tcp, tolerance, SECOND);
    first.send(1, &read, SECOND, SECOND).unwrap();
    let past = first.take_past(SECOND * 2);
    let mut next = Connection::tolerant(Transport::Tcp, tolerance, SECOND * 3);
    next.follow(past);
    next.send(1, &read, SECOND, SECOND * 3).unwrap();
    next.advance(SECOND * 3, |_| {});
    assert!(next.outgoing().is_empty(), "it waits for the pause");
    next.advance(SECOND * 4, |_| {});
    assert!(!next.outgoing().is_empty());
}

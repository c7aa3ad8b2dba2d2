//! What the client side of a connection counts, keeps and waits for, to the byte and the millisecond.

#![cfg(feature = "alloc")]

use std::time::Duration;

use holdfast_protocol::client::{
    Closed, Connection, Done, Echo, Failure, GUARD, InvalidResponse, Strays, Tolerance, Transport,
};
use holdfast_protocol::frame::{FrameError, ascii, mbap, rtu};
use holdfast_protocol::pdu::{EncodedRequest, Range, Request, Response};

const MS: Duration = Duration::from_millis(1);
const SECOND: Duration = Duration::from_secs(1);
const SILENCE: Duration = Duration::from_millis(2);
const RTU: Transport = Transport::SerialRtu { silence: SILENCE };
const WRITE: Request<'_> = Request::WriteSingleRegister { address: 3, value: 7 };
const COILS: [u8; 5] = [1, 0x03, 0xC8, 0, 24];

fn read(quantity: u16) -> EncodedRequest {
    EncodedRequest::new(&Request::ReadHoldingRegisters(Range::new(3, quantity).unwrap()))
}

fn coils(address: u16, quantity: u16) -> EncodedRequest {
    EncodedRequest::new(&Request::ReadCoils(Range::new(address, quantity).unwrap()))
}

fn mbap_frame(id: u16, pdu: &[u8]) -> Vec<u8> {
    [&mbap::header(id, 7, pdu.len())[..], pdu].concat()
}

fn rtu_frame(pdu: &[u8]) -> Vec<u8> {
    let mut frame = [0; rtu::MAX_LEN];
    let len = rtu::encode(7, pdu, &mut frame).unwrap();
    frame[..len].to_vec()
}

/// A connection to unit 7, the time, and the results of its requests: a PDU or a failure.
struct Client {
    connection: Connection,
    now: Duration,
    got: Vec<Result<Vec<u8>, Failure>>,
}

impl Client {
    fn new(transport: Transport, tolerance: Tolerance) -> Client {
        let connection = Connection::tolerant(transport, tolerance, SECOND);
        Client { connection, now: SECOND, got: Vec::new() }
    }

    fn send(&mut self, request: &EncodedRequest) {
        self.connection.send(7, request, SECOND, self.now).unwrap();
    }

    fn outgoing(&mut self) -> Vec<u8> {
        let bytes = self.connection.outgoing().to_vec();
        self.connection.sent(bytes.len());
        bytes
    }

    fn receive(&mut self, bytes: &[u8]) {
        let got = &mut self.got;
        self.connection.receive(bytes, self.now, |done| note(got, &done));
    }

    fn after(&mut self, time: Duration) {
        self.now += time;
        let got = &mut self.got;
        self.connection.advance(self.now, |done| note(got, &done));
    }

    fn close(&mut self) {
        let got = &mut self.got;
        self.connection.close(Closed::ByPeer, |done| note(got, &done));
    }

    fn got(&mut self) -> Vec<Result<Vec<u8>, Failure>> {
        std::mem::take(&mut self.got)
    }

    /// Sends a read of a register, and lets a line of this kind answer 30 ms later.
    fn read_in_time(&mut self, value: u8, with_echo: bool) {
        self.send(&read(1));
        while self.connection.outgoing().is_empty() {
            self.after(MS);
        }
        let echo = self.outgoing();
        self.after(30 * MS);
        self.receive(
            &[if with_echo { &echo } else { &[][..] }, &rtu_frame(&[3, 2, 0, value])].concat(),
        );
        assert_eq!(self.got(), [Ok(vec![3, 2, 0, value])]);
    }
}

fn note(got: &mut Vec<Result<Vec<u8>, Failure>>, done: &Done<'_>) {
    got.push(done.outcome.as_ref().map(|_| done.pdu.to_vec()).map_err(|failure| *failure));
}

#[test]
fn random_transaction_ids_depend_on_the_whole_seed() {
    let first = |transport, seed| {
        let mut connection = Connection::new(transport).unpredictable(seed);
        connection.send(7, &read(1), SECOND, SECOND).unwrap();
        let id = connection.outgoing()[..2].try_into().unwrap();
        u16::from_be_bytes(id)
    };
    for shift in [0, 16, 32, 48] {
        assert_eq!(first(Transport::Tcp, 0xABCD << shift), 0xABCD);
    }
    assert_eq!(first(Transport::Tcp, 0x0001_0003_0010_0030), 0x22);
    assert_eq!(first(Transport::Tcp, 0x0000_0003_0001_0003), 1);
    assert_eq!(first(Transport::Udp, 0), 0xE220, "SplitMix64");
}

#[test]
fn a_request_is_held_until_the_pause_is_over_and_time_alone_starts_none() {
    let tolerance = Tolerance { pause: SECOND, ..Tolerance::default() };
    let mut client = Client::new(Transport::Tcp, tolerance);
    client.send(&read(1));
    assert!(!client.connection.is_held());
    client.receive(&mbap_frame(0, &[3, 2, 0, 1]));
    client.after(SECOND / 2);
    client.send(&read(1));
    assert!(client.connection.is_held());
    client.after(SECOND / 2);
    assert!(!client.connection.is_held());
    client.receive(&mbap_frame(1, &[3, 2, 0, 1]));
    client.after(SECOND);
    client.after(SECOND);
    client.send(&read(1));
    assert!(!client.connection.is_held());
}

#[test]
fn bytes_of_a_stream_that_no_request_asked_for_are_counted() {
    for (sent, closed) in [
        ([0, 0, 0, 9, 0, 6, 7, 3, 2, 0, 1, 0].to_vec(), InvalidResponse::ProtocolId(9)),
        ([0, 0, 0, 0, 0, 0, 7, 3].to_vec(), InvalidResponse::Length(0)),
    ] {
        let mut client = Client::new(Transport::Tcp, Tolerance::default());
        client.send(&read(1));
        client.receive(&sent);
        assert_eq!(client.connection.closed(), Some(Closed::Invalid(closed)));
        let strays = Strays { replies: 0, bytes: sent.len() as u64 };
        assert_eq!(client.connection.take_strays(), strays);
    }
    let mut client = Client::new(Transport::Tcp, Tolerance::default());
    client.send(&read(2));
    let reply = mbap_frame(0, &[3, 4, 0, 1, 0, 2]);
    let cut_off = [&reply[..9], &reply].concat();
    client.receive(&cut_off);
    let unrequested = Closed::Invalid(InvalidResponse::Unrequested);
    assert_eq!(client.connection.closed(), Some(unrequested));
    let strays = Strays { replies: 0, bytes: cut_off.len() as u64 };
    assert_eq!(client.connection.take_strays(), strays);
}

#[test]
fn datagrams_that_no_request_asked_for_are_counted() {
    let mut client = Client::new(Transport::Udp, Tolerance::default());
    client.send(&read(1));
    client.receive(&mbap_frame(9, &[3, 2, 0, 1]));
    client.receive(&mbap_frame(8, &[3, 4, 0, 1, 0, 2]));
    assert_eq!(client.connection.take_strays(), Strays { replies: 2, bytes: 11 + 13 });
    client.receive(&[1, 2, 3]);
    assert_eq!(client.connection.take_strays(), Strays { replies: 0, bytes: 3 });
}

#[test]
fn bytes_that_a_line_brings_beside_a_reply_are_counted_however_many_they_are() {
    let mut client = Client::new(RTU, Tolerance::default());
    client.after(SECOND);
    client.send(&read(1));
    client.receive(&[rtu_frame(&[3, 2, 0, 1]), vec![0; 600]].concat());
    assert_eq!(client.got(), [Ok(vec![3, 2, 0, 1])]);
    assert_eq!(client.connection.take_strays(), Strays { replies: 0, bytes: 600 });
}

#[test]
fn only_as_many_bytes_are_skipped_as_an_exception_was_short_of() {
    let short = [0, 0, 0, 0, 0, 6, 7, 0x83, 2];
    for (surplus, is_ok) in [(0, true), (3, true), (4, false)] {
        let tolerance = Tolerance { pad: true, ..Tolerance::default() };
        let mut client = Client::new(Transport::Tcp, tolerance);
        client.send(&read(1));
        client.receive(&short);
        assert_eq!(client.got(), [Err(Failure::Exception(2))]);
        client.send(&read(1));
        client.receive(&[vec![1; surplus], mbap_frame(1, &[3, 2, 0, 3])].concat());
        assert_eq!(client.got()[0].is_ok(), is_ok, "{surplus}");
    }
    let mut strict = Client::new(Transport::Tcp, Tolerance::default());
    strict.send(&read(1));
    strict.receive(&short);
    assert_eq!(strict.got(), [], "it is not complete");
}

#[test]
fn a_late_reply_gives_the_requests_behind_it_their_time() {
    let mut client = Client::new(Transport::Tcp, Tolerance::default());
    client.send(&read(1));
    client.send(&read(1));
    client.after(SECOND);
    client.after(SECOND / 2);
    client.receive(&mbap_frame(0, &[3, 2, 0, 1]));
    client.after(SECOND / 10);
    client.receive(&mbap_frame(1, &[3, 2, 0, 1]));
    assert_eq!((client.connection.late(), client.connection.longest_late()), (2, SECOND * 3 / 2));

    let mut line = Client::new(RTU, Tolerance::default());
    line.send(&read(1));
    line.after(SECOND);
    line.send(&read(2));
    line.after(SILENCE);
    assert!(!line.outgoing().is_empty(), "their replies differ in length");
    line.after(SECOND / 2);
    let before = line.connection.deadline();
    line.receive(&[7]);
    assert_eq!(line.connection.deadline(), before, "a byte is no reply");
    line.receive(&rtu_frame(&[3, 2, 0, 1])[1..]);
    assert_eq!(line.connection.late(), 1);
    assert_eq!(line.connection.deadline(), Some(line.now + SECOND));
}

#[test]
fn a_late_reply_may_come_in_pieces_while_no_request_waits() {
    let mut client = Client::new(RTU, Tolerance::default());
    client.send(&read(1));
    client.after(SECOND);
    client.after(SECOND / 10);
    let reply = rtu_frame(&[3, 2, 0, 1]);
    reply.iter().for_each(|byte| client.receive(&[*byte]));
    assert_eq!(client.connection.late(), 1);
}

/// Lets the timeout of a request for four registers end after these bytes of its reply, each within a millisecond.
fn timed_out_within_its_reply(transport: Transport, received: usize) -> (Client, Vec<u8>) {
    let reply = frame_of(transport, &[3, 8, 0, 1, 0, 2, 0, 3, 0, 4]);
    let mut client = Client::new(transport, Tolerance::default());
    client.connection = Connection::new(transport).on_line(MS);
    client.send(&read(4));
    let ends = client.connection.deadline().unwrap();
    client.receive(&reply[..received]);
    client.after(ends - client.now);
    (client, reply)
}

#[test]
fn a_reply_that_has_begun_when_the_timeout_ends_has_the_time_that_its_rest_takes() {
    for transport in [RTU, Transport::SerialAscii { silence: SILENCE }] {
        let (mut client, reply) = timed_out_within_its_reply(transport, 9);
        assert_eq!(client.got(), []);
        let rest = MS * (reply.len() as u32 - 9);
        assert_eq!(client.connection.deadline(), Some(client.now + rest + GUARD));
        client.after(rest);
        client.receive(&reply[9..]);
        assert_eq!(client.got(), [Ok(vec![3, 8, 0, 1, 0, 2, 0, 3, 0, 4])]);
        // Not again, if it stops in the middle.
        let (mut client, _) = timed_out_within_its_reply(transport, 9);
        client.after(rest + GUARD);
        assert_eq!(client.got(), [Err(Failure::Incomplete)]);
        // Not without the start of a reply.
        let (mut client, _) = timed_out_within_its_reply(transport, 0);
        assert_eq!(client.got(), [Err(Failure::Timeout)]);
    }
}

#[test]
fn a_late_reply_may_begin_before_the_timeout_and_end_in_pieces_while_another_request_waits() {
    for transport in [RTU, Transport::SerialAscii { silence: SILENCE }] {
        let (mut client, reply) = timed_out_within_its_reply(transport, 9);
        client.after(SECOND);
        assert_eq!(client.got(), [Err(Failure::Incomplete)]);
        client.receive(&reply[9..10]);
        client.send(&coils(0, 1));
        client.receive(&reply[10..12]);
        client.receive(&reply[12..]);
        assert_eq!(client.connection.late(), 1);
        assert_eq!(client.connection.take_strays(), Strays::default());
    }
}

#[test]
fn the_longest_reply_fits_behind_an_echo() {
    let tolerance = Tolerance { echo: Echo::Always, ..Tolerance::default() };
    let mut client = Client::new(RTU, tolerance);
    client.after(SECOND);
    client.send(&read(125));
    let echo = client.outgoing();
    let reply = [vec![3, 250], vec![1; 250]].concat();
    client.receive(&[echo, rtu_frame(&reply)].concat());
    assert_eq!(client.got(), [Ok(reply)]);
}

#[test]
fn a_broadcast_waits_for_silence_and_no_guard_time() {
    let write = EncodedRequest::new(&WRITE);
    for (unit_id, wait) in [(0, SILENCE), (7, GUARD)] {
        let mut client = Client::new(RTU, Tolerance::default());
        client.read_in_time(1, false);
        client.connection.send(unit_id, &write, SECOND, client.now).unwrap();
        client.after(wait - MS);
        assert_eq!(client.outgoing(), []);
        client.after(MS);
        assert!(!client.outgoing().is_empty(), "{unit_id}");
    }
}

#[test]
fn after_a_doubled_reply_the_guard_time_is_kept_again() {
    for (times, wait) in [(1, SILENCE), (2, GUARD)] {
        let mut client = Client::new(RTU, Tolerance::default());
        (0..10).for_each(|number| client.read_in_time(number, false));
        client.send(&read(1));
        client.after(SILENCE);
        client.after(30 * MS);
        client.receive(&rtu_frame(&[3, 2, 0, 42]).repeat(times));
        assert_eq!(client.got(), [Ok(vec![3, 2, 0, 42])]);
        client.outgoing();
        client.send(&read(1));
        client.after(wait - MS);
        assert_eq!(client.outgoing(), []);
        client.after(MS);
        assert!(!client.outgoing().is_empty(), "{times}");
    }
}

#[test]
fn a_reply_whose_count_is_that_of_an_exception_of_a_gateway_is_no_exception() {
    let mut client = Client::new(RTU, Tolerance::default());
    (0..10).for_each(|number| client.read_in_time(number, false));
    client.send(&coils(0, 88));
    client.after(SILENCE);
    client.outgoing();
    client.after(30 * MS);
    let reply = [vec![1, 11], vec![0x55; 11]].concat();
    client.receive(&rtu_frame(&reply));
    assert_eq!(client.got(), [Ok(reply)]);
    client.send(&coils(0, 88));
    client.after(SILENCE);
    assert!(!client.outgoing().is_empty());
}

#[test]
fn only_behind_the_exception_of_a_gateway_without_a_reply_one_may_follow() {
    for (code, may_follow) in [(2, false), (11, true)] {
        let mut client = Client::new(RTU, Tolerance::default());
        (0..10).for_each(|number| client.read_in_time(number, false));
        client.send(&read(1));
        client.after(SILENCE);
        client.outgoing();
        client.after(30 * MS);
        client.receive(&rtu_frame(&[0x83, code]));
        assert_eq!(client.got(), [Err(Failure::Exception(code))]);
        client.send(&read(1));
        client.after(SILENCE);
        assert_eq!(client.outgoing().is_empty(), may_follow, "{code}");
    }
}

#[test]
fn another_frame_right_behind_a_reply_contradicts_it_unless_replies_are_padded() {
    let frames = [rtu_frame(&[3, 2, 0, 1]), rtu_frame(&[3, 2, 0, 2])].concat();
    let unrequested = Failure::Invalid(InvalidResponse::Unrequested);
    for (pad, expected) in [(false, Err(unrequested)), (true, Ok(vec![3, 2, 0, 1]))] {
        let mut client = Client::new(RTU, Tolerance { pad, ..Tolerance::default() });
        client.send(&read(1));
        client.receive(&frames);
        assert_eq!(client.got(), [expected]);
    }
}

#[test]
fn stray_bytes_that_look_like_a_longer_reply_of_another_unit_do_not_hide_one() {
    let mut client = Client::new(RTU, Tolerance::default());
    client.send(&read(1));
    client.receive(&[&[9, 3, 200][..], &rtu_frame(&[3, 2, 0, 1])].concat());
    assert_eq!(client.got(), [Ok(vec![3, 2, 0, 1])]);

    let mut client = Client::new(RTU, Tolerance::default());
    client.send(&read(1));
    let mut frame = [0; rtu::MAX_LEN];
    let len = rtu::encode(8, &[3, 2, 0, 1], &mut frame).unwrap();
    client.receive(&[&[0][..], &frame[..len]].concat());
    assert_eq!(client.got(), [], "behind a stray byte, the reply of another unit is stray too");
}

#[test]
fn more_characters_than_an_echo_and_a_reply_have_are_too_long() {
    let most = 2 * ascii::MAX_LEN;
    for (lens, bytes) in [([most - 1, 1], most), ([most - 1, 9], most + 8), ([most, 0], most)] {
        let mut client = Client::new(Transport::AsciiOverTcp, Tolerance::default());
        client.send(&read(1));
        client.receive(&vec![b'0'; lens[0]]);
        let is_closed = client.connection.closed().is_some();
        assert_eq!(is_closed, lens[0] == most);
        client.receive(&vec![b'0'; lens[1]]);
        let too_long = InvalidResponse::TooLong;
        assert_eq!(client.got(), [Err(Failure::Invalid(too_long))]);
        let strays = Strays { replies: 0, bytes: bytes as u64 };
        assert_eq!(client.connection.take_strays(), strays);
    }
}

#[test]
fn only_a_datagram_may_be_empty_and_it_is_malformed() {
    for (transport, closed) in [
        (Transport::Tcp, None),
        (RTU, None),
        (Transport::Udp, Some(Closed::Invalid(InvalidResponse::Datagram))),
    ] {
        let mut client = Client::new(transport, Tolerance::default());
        client.send(&read(1));
        assert_eq!(client.connection.in_flight(), 1);
        client.receive(&[]);
        assert_eq!(client.connection.closed(), closed);
        assert_eq!(client.connection.in_flight(), usize::from(closed.is_none()));
        client.close();
        client.got();
        client.receive(&mbap_frame(0, &[3, 2, 0, 1]));
        assert_eq!((client.got(), client.connection.take_strays()), (vec![], Strays::default()));
    }
}

#[test]
fn each_invalid_response_has_a_word_for_programs() {
    use holdfast_protocol::frame::FrameError;
    use holdfast_protocol::pdu::ResponseError;

    for (invalid, word) in [
        (InvalidResponse::ProtocolId(1), "protocol_id"),
        (InvalidResponse::Length(1), "length"),
        (InvalidResponse::TransactionId(1), "transaction_id"),
        (InvalidResponse::UnitId { expected: 1, found: 2 }, "unit_id"),
        (InvalidResponse::Pdu(ResponseError::Function { expected: 1, found: 2 }), "function"),
        (InvalidResponse::Pdu(ResponseError::Echo), "echo"),
        (InvalidResponse::Pdu(ResponseError::Length), "length"),
        (InvalidResponse::Frame(FrameError::CheckSum), "checksum"),
        (InvalidResponse::Frame(FrameError::Length), "frame"),
        (InvalidResponse::Datagram, "datagram"),
        (InvalidResponse::TooLong, "too_long"),
        (InvalidResponse::Unrequested, "unrequested"),
        (InvalidResponse::TooFast, "too_fast"),
    ] {
        assert_eq!(invalid.reason(), word);
    }
}

/// A connection that has had one echo, and now the bytes of one that may also be the reply, with others behind it.
fn with_what_may_be_an_echo(transport: Transport, behind: &[u8]) -> Client {
    let mut client = Client::new(transport, Tolerance::default());
    client.read_in_time(1, true);
    client.after(SECOND);
    client.send(&EncodedRequest::parse(&COILS).unwrap());
    client.after(SILENCE);
    assert_eq!(client.outgoing(), rtu_frame(&COILS));
    client.receive(&[&rtu_frame(&[1, 3, 0xC8, 0, 24]), behind].concat());
    client
}

#[test]
fn a_reply_that_follows_an_equal_echo_is_believed_when_it_is_complete() {
    let mut client = with_what_may_be_an_echo(RTU, &[]);
    let reply = rtu_frame(&[1, 3, 0xC8, 0, 24]);
    let (last, others) = reply.split_last().unwrap();
    for byte in others {
        client.receive(&[*byte]);
        assert_eq!(client.got(), []);
    }
    client.receive(&[*last]);
    assert_eq!(client.got(), [Ok(vec![1, 3, 0xC8, 0, 24])]);
}

#[test]
fn noise_between_an_echo_and_an_equal_reply_is_no_other_reply() {
    let reply = rtu_frame(&[1, 3, 0xC8, 0, 24]);
    for noise in [&[0][..], &[0xFF, 0], &[7], &[7, 1]] {
        for (behind, rest) in [
            (noise.to_vec(), vec![reply.clone()]),
            (vec![], vec![noise.to_vec(), reply.clone()]),
            (vec![], vec![[noise, &reply].concat()]),
            ([noise, &reply[..4]].concat(), vec![reply[4..].to_vec()]),
            ([noise, &reply].concat(), vec![]),
        ] {
            let mut client = with_what_may_be_an_echo(RTU, &behind);
            rest.iter().for_each(|bytes| client.receive(bytes));
            assert_eq!(client.got(), [Ok(vec![1, 3, 0xC8, 0, 24])], "{behind:?} {rest:?}");
        }
    }
}

#[test]
fn other_bytes_behind_what_may_be_an_echo_are_another_reply() {
    for behind in [&rtu_frame(&[1, 3, 0xC8, 0, 25])[..], &[0, 0, 0, 7, 1, 3, 0xC8, 0, 24]] {
        let mut client = with_what_may_be_an_echo(RTU, &[]);
        client.receive(behind);
        assert_eq!(client.got(), [Err(Failure::Invalid(InvalidResponse::Unrequested))]);
    }
}

#[test]
fn what_may_have_been_an_echo_is_no_reply_which_may_still_come() {
    let mut client = with_what_may_be_an_echo(RTU, &[]);
    client.after(SECOND);
    assert_eq!(client.got(), [Err(Failure::Timeout)]);
    client.send(&EncodedRequest::parse(&COILS).unwrap());
    client.after(GUARD);
    assert_eq!(client.outgoing(), []);
}

fn frame_of(transport: Transport, pdu: &[u8]) -> Vec<u8> {
    let mut frame = [0; ascii::MAX_LEN];
    match transport {
        Transport::SerialAscii { .. } => {
            let len = ascii::encode(7, pdu, &mut frame).unwrap();
            frame[..len].to_vec()
        }
        _ => rtu_frame(pdu),
    }
}

/// A connection that gets these bytes behind a reply, and more later. The reply equals the one before, to another
/// request: it is believed if no other follows.
fn with_what_follows_a_doubted_reply(transport: Transport, pad: bool, parts: [&[u8]; 2]) -> Client {
    let mut client = Client::new(transport, Tolerance { pad, ..Tolerance::default() });
    let reply = frame_of(transport, &[3, 2, 0, 1]);
    client.send(&read(1));
    client.after(30 * MS);
    client.receive(&reply);
    assert_eq!(client.got(), [Ok(vec![3, 2, 0, 1])]);
    client.after(SECOND / 10);
    let other = Request::ReadHoldingRegisters(Range::new(4, 1).unwrap());
    client.send(&EncodedRequest::new(&other));
    client.after(30 * MS);
    client.receive(&[&reply, parts[0]].concat());
    assert_eq!(client.got(), []);
    parts[1].iter().for_each(|byte| client.receive(&[*byte]));
    client
}

#[test]
fn noise_behind_a_reply_that_is_doubted_is_dropped_and_counted() {
    let noise = [0xFF, 0, 0xFE, 0x80, 0xFF, 7];
    let ascii = Transport::SerialAscii { silence: SILENCE };
    for (transport, pad, parts) in [
        (RTU, false, [&[][..], &[7, 3]]),
        (RTU, false, [&[], &noise]),
        (RTU, false, [&noise[..2], &noise[2..]]),
        (ascii, false, [&[], b"0123456789"]),
        (RTU, true, [&[], &[0; 20]]),
        (Transport::RtuOverTcp, true, [&[], &[0; 20]]),
    ] {
        let mut client = with_what_follows_a_doubted_reply(transport, pad, parts);
        client.after(SECOND / 10);
        assert_eq!(client.got(), [Ok(vec![3, 2, 0, 1])], "{transport:?} {parts:?}");
        let bytes = if pad { 0 } else { parts.concat().len() as u64 };
        assert_eq!(client.connection.take_strays(), Strays { replies: 0, bytes });
    }
}

#[test]
fn what_may_be_another_reply_contradicts_one_that_is_doubted() {
    let other = rtu_frame(&[3, 2, 0, 2]);
    let damaged = [&[0], &other[1..]].concat();
    let line = frame_of(Transport::SerialAscii { silence: SILENCE }, &[3, 2, 0, 2]);
    let mut of_another_unit = [0; rtu::MAX_LEN];
    let len = rtu::encode(9, &[0x83, 2], &mut of_another_unit).unwrap();
    for (transport, pad, parts) in [
        (RTU, false, [&[][..], &other[..3]]),
        (RTU, false, [&[], &[0xFF, 0, 7, 3]]),
        (RTU, true, [&[], &other[..3]]),
        (RTU, false, [&other[..5], &other[5..]]),
        (RTU, false, [&[], &damaged]),
        (RTU, false, [&[], &of_another_unit[..len]]),
        (Transport::SerialAscii { silence: SILENCE }, false, [&[], &line[..3]]),
        (Transport::RtuOverTcp, false, [&[], &[0; 3]]),
    ] {
        let mut client = with_what_follows_a_doubted_reply(transport, pad, parts);
        let unrequested = Failure::Invalid(InvalidResponse::Unrequested);
        assert_eq!(client.got(), [Err(unrequested)], "{transport:?} {parts:?}");
    }
}

#[test]
fn what_a_stream_has_brought_before_it_ends_is_a_reply_unless_it_may_be_an_echo() {
    let mut client = with_what_may_be_an_echo(Transport::RtuOverTcp, &[]);
    client.close();
    assert_eq!(client.got(), [Err(Failure::Closed(Closed::ByPeer))]);

    let mut client = Client::new(Transport::RtuOverTcp, Tolerance::default());
    client.read_in_time(1, false);
    client.after(SECOND / 10);
    let other = Request::ReadHoldingRegisters(Range::new(4, 1).unwrap());
    client.send(&EncodedRequest::new(&other));
    client.after(50 * MS);
    client.receive(&rtu_frame(&[3, 2, 0, 1]));
    assert_eq!(client.got(), [], "it may be a copy of the reply before");
    assert_eq!(client.connection.deadline(), Some(client.now + GUARD));
    client.close();
    assert_eq!(client.got(), [Ok(vec![3, 2, 0, 1])]);
}

#[test]
fn an_exception_without_the_expected_echo_shows_that_there_are_none() {
    let mut client = Client::new(RTU, Tolerance::default());
    for _ in 0..3 {
        client.read_in_time(1, true);
        client.after(SECOND);
    }
    let exception = rtu_frame(&[0x86, 2]);
    for expected in [Err(Failure::Timeout), Err(Failure::Exception(2))] {
        client.send(&EncodedRequest::new(&WRITE));
        while client.connection.outgoing().is_empty() {
            client.after(SECOND / 10);
        }
        client.outgoing();
        client.after(SECOND / 10);
        client.receive(&exception);
        client.after(SECOND);
        assert_eq!(client.got(), [expected]);
        client.after(SECOND * 4);
    }
}

#[test]
fn the_reply_to_an_opaque_request_ends_where_its_crc_fits() {
    for transport in [RTU, Transport::RtuOverTcp] {
        let mut client = Client::new(transport, Tolerance::default());
        client.after(SECOND);
        client.send(&EncodedRequest::opaque(&[0x41, 1]).unwrap());
        let (last, others) =
            rtu_frame(&[0x41, 9, 8, 7]).split_last().map(|(l, o)| (*l, o.to_vec())).unwrap();
        for byte in others {
            client.receive(&[byte]);
            assert_eq!(client.got(), []);
        }
        client.receive(&[last]);
        assert_eq!(client.got(), [Ok(vec![0x41, 9, 8, 7])]);
    }
    let request = EncodedRequest::opaque(&[3, 0, 3, 0, 1]).unwrap();
    assert_eq!(request.response(&[3, 2, 0, 7]), Ok(Response::Opaque(&[2, 0, 7])));
}

#[test]
fn a_reply_may_come_as_soon_as_the_line_can_have_carried_it_and_no_sooner() {
    // The characters of the request and the reply, 1 ms each.
    for (transport, least) in [(RTU, 8 + 7), (Transport::SerialAscii { silence: SILENCE }, 17 + 15)]
    {
        for (early, expected) in [(Duration::ZERO, vec![Ok(vec![3, 2, 0, 7])]), (MS, vec![])] {
            let frame = |value| {
                let mut frame = [0; ascii::MAX_LEN];
                let len = ascii::encode(7, &[3, 2, 0, value], &mut frame).unwrap();
                if transport == RTU { rtu_frame(&[3, 2, 0, value]) } else { frame[..len].to_vec() }
            };
            let mut client = Client::new(transport, Tolerance::default());
            client.connection = Connection::new(transport).on_line(MS);
            client.send(&read(1));
            client.after(50 * MS);
            client.receive(&frame(1));
            assert_eq!(client.got(), [Ok(vec![3, 2, 0, 1])]);
            // From now on, a fast reply does not show that the line is faster than its settings.
            client.after(SECOND);
            client.receive(&frame(2));
            client.after(SECOND);
            client.send(&read(1));
            client.after(MS * least - early);
            client.receive(&frame(7));
            assert_eq!(client.got(), expected, "{transport:?} {early:?}");
        }
    }
}

#[test]
fn a_line_of_characters_may_have_small_letters() {
    let mut body = [0; ascii::MAX_BODY_LEN];
    for line in [&b":0A03024AFAAD\r\n"[..], b":0a03024afaad\r\n"] {
        assert_eq!(ascii::decode(line, &mut body), Ok((10, &[3, 2, 0x4A, 0xFA][..])));
    }
    let length = Err(holdfast_protocol::frame::FrameError::Length);
    assert_eq!(ascii::decode(b":07F9\r\n", &mut body), length, "it has no PDU");
}

#[test]
fn an_exception_code_that_the_standard_does_not_have_reaches_the_caller() {
    for transport in [Transport::Tcp, Transport::Udp] {
        let mut client = Client::new(transport, Tolerance::default());
        client.send(&read(1));
        let id = u16::from_be_bytes(client.outgoing()[..2].try_into().unwrap());
        client.receive(&mbap_frame(id, &[0x83, 0x99]));
        assert_eq!(client.got(), [Err(Failure::Exception(0x99))]);
    }
}

#[test]
fn a_pdu_that_is_empty_or_too_long_has_no_frame() {
    for pdu in [&[][..], &[0; 254]] {
        assert_eq!(mbap::encode(1, 7, pdu, &mut [0; mbap::MAX_LEN]), None);
        assert_eq!(rtu::encode(7, pdu, &mut [0; rtu::MAX_LEN]), None);
        assert_eq!(ascii::encode(7, pdu, &mut [0; ascii::MAX_LEN]), None);
    }
}

/// Lets a request be sent on a line of 5 ms a character. Returns how long the line carries it.
fn send_on_a_slow_line(client: &mut Client, request: &EncodedRequest) -> Duration {
    client.send(request);
    while client.connection.outgoing().is_empty() {
        client.after(client.connection.deadline().unwrap() - client.now);
    }
    5 * MS * client.outgoing().len() as u32
}

fn write_of_100_registers() -> EncodedRequest {
    EncodedRequest::parse(&[&[16, 0, 0, 0, 100, 200][..], &[0; 200]].concat()).unwrap()
}

fn on_a_slow_line() -> Client {
    let mut client = Client::new(RTU, Tolerance::default());
    client.connection = Connection::new(RTU).on_line(5 * MS);
    client
}

#[test]
fn on_a_line_faster_than_its_settings_the_reply_after_a_damaged_one_answers_no_other_request() {
    let mut client = on_a_slow_line();
    let confirmation = rtu_frame(&[16, 0, 0, 0, 100]);
    for _ in 0..2 {
        send_on_a_slow_line(&mut client, &write_of_100_registers());
        client.after(60 * MS);
        client.receive(&confirmation);
        while client.got.is_empty() {
            client.after(client.connection.deadline().unwrap() - client.now);
        }
        assert_eq!(client.got().len(), 1);
    }
    send_on_a_slow_line(&mut client, &write_of_100_registers());
    client.after(MS);
    client.receive(&[7, 0x90, 1, 2, 3]);
    assert!(matches!(client.got()[..], [Err(Failure::Invalid(_))]));
    client.send(&write_of_100_registers());
    client.after(59 * MS);
    assert_eq!(client.outgoing(), []);
    client.receive(&confirmation);
    assert_eq!((client.got(), client.connection.late()), (vec![], 1));
}

#[test]
fn a_late_reply_does_not_shorten_the_time_of_a_request_that_the_line_still_carries() {
    let mut client = on_a_slow_line();
    client.send(&read(1));
    client.outgoing();
    client.after(client.connection.deadline().unwrap() - client.now);
    assert_eq!(client.got(), [Err(Failure::Timeout)]);
    let carried = send_on_a_slow_line(&mut client, &write_of_100_registers());
    let ends = client.now + carried + SECOND;
    client.after(MS);
    client.receive(&rtu_frame(&[3, 2, 0, 1]));
    assert_eq!((client.connection.late(), client.connection.deadline()), (1, Some(ends)));
}

#[test]
fn after_an_early_invalid_reply_the_next_request_waits_until_the_line_has_carried_the_one_before() {
    let mut client = on_a_slow_line();
    let carried = send_on_a_slow_line(&mut client, &write_of_100_registers());
    client.receive(&[7, 0x90, 1, 2, 3]);
    assert_eq!(client.got().len(), 1);
    client.send(&read(1));
    client.after(carried);
    assert_eq!(client.outgoing(), []);
}

#[test]
fn one_byte_can_be_noise_and_prolongs_no_further_than_the_reply_is_long() {
    for (bytes, expected) in [
        (&[7][..], Failure::Timeout),
        (&[0xFF, 7], Failure::Invalid(InvalidResponse::Frame(FrameError::CheckSum))),
    ] {
        let mut client = on_a_slow_line();
        let carried = send_on_a_slow_line(&mut client, &EncodedRequest::new(&WRITE));
        client.receive(bytes);
        client.after(carried + SECOND);
        // A confirmation has 8 bytes.
        assert_eq!(client.connection.deadline(), Some(client.now + 7 * 5 * MS + GUARD));
        client.after(7 * 5 * MS + GUARD);
        assert_eq!(client.got(), [Err(expected)]);
    }
}

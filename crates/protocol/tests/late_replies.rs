//! Devices whose replies come late, twice or in another order, on every transport, with a simulated
//! clock: no reply is ever taken for that of another request.

#![cfg(feature = "alloc")]

use std::time::Duration;

use holdfast_protocol::client::{
    Attempt, Closed, Connection, Done, Failure, InvalidResponse, Strays, Tolerance, Transport,
};
use holdfast_protocol::frame::{ascii, mbap, rtu};
use holdfast_protocol::pdu::{EncodedRequest, Range, Request, Response};

const MS: Duration = Duration::from_millis(1);
const TIMEOUT: Duration = Duration::from_millis(250);
const SILENCE: Duration = Duration::from_millis(2);

const SERIAL: [Transport; 2] =
    [Transport::SerialRtu { silence: SILENCE }, Transport::SerialAscii { silence: SILENCE }];
const TRANSPORTS: [Transport; 7] = [
    SERIAL[0],
    SERIAL[1],
    Transport::RtuOverTcp,
    Transport::AsciiOverTcp,
    Transport::RtuOverUdp,
    Transport::Tcp,
    Transport::Udp,
];

fn reading(address: u16, quantity: u16) -> Request<'static> {
    Request::ReadHoldingRegisters(Range::new(address, quantity).unwrap())
}

/// A fixed sequence of numbers that look random.
struct Numbers(u64);

impl Numbers {
    /// A number between these, in steps of a hundredth of their difference.
    fn between(&mut self, least: Duration, most: Duration) -> Duration {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        least + (most - least) * ((self.0 >> 33) % 101) as u32 / 100
    }
}

/// A reply that comes just before the next one.
const KEPT: Duration = Duration::MAX;

/// What a device does with its `number`th reply: when the copies of it come, after the request.
type Vice = fn(number: u32, &mut Numbers) -> Vec<Duration>;

/// A device behind a gateway that sends to whichever connection there is.
struct World {
    transport: Transport,
    tolerance: Tolerance,
    vice: Vice,
    connection: Connection,
    now: Duration,
    /// What is on its way to the client.
    coming: Vec<(Duration, Vec<u8>)>,
    kept: Vec<Vec<u8>>,
    numbers: Numbers,
    requests: u32,
    late: u64,
    /// Whether the driver reads between two requests.
    listens: bool,
}

#[derive(Debug, Default, PartialEq, Eq, Clone, Copy)]
struct Counts {
    right: u32,
    wrong: u32,
    failed: u32,
}

impl World {
    fn new(transport: Transport, vice: Vice) -> World {
        let connection = Connection::new(transport).unpredictable(7);
        let (now, coming) = (MS, Vec::new());
        World {
            transport,
            tolerance: Tolerance::default(),
            vice,
            connection,
            now,
            coming,
            kept: Vec::new(),
            numbers: Numbers(1),
            requests: 0,
            late: 0,
            listens: true,
        }
    }

    /// A new connection instead of the one that has ended.
    fn reconnect(&mut self) {
        self.late += self.connection.late();
        let past = self.connection.take_past(self.now);
        let connection = Connection::tolerant(self.transport, self.tolerance, self.now);
        self.connection = connection.unpredictable(u64::from(self.requests));
        self.connection.follow(past);
    }

    /// The next bytes that come until then.
    fn next(&mut self, until: Duration) -> Option<(Duration, Vec<u8>)> {
        let first = (0..self.coming.len()).min_by_key(|at| self.coming[*at].0)?;
        (self.coming[first].0 <= until).then(|| self.coming.swap_remove(first))
    }

    /// Lets time pass without a request.
    fn pass(&mut self, time: Duration) {
        let until = self.now + time;
        while let Some((at, bytes)) = self.next(until) {
            let now = if self.listens { at.max(self.now) } else { until };
            self.now = now;
            self.connection.receive(&bytes, now, |_| panic!("there is no request"));
            if self.connection.closed().is_some() {
                self.reconnect();
            }
        }
        self.now = until;
    }

    fn read(&mut self, unit_id: u8, address: u16) -> Result<u16, Failure> {
        self.read_some(unit_id, address, 1)
    }

    /// Reads this many registers. Returns the first one.
    fn read_some(&mut self, unit_id: u8, address: u16, quantity: u16) -> Result<u16, Failure> {
        self.read_within(TIMEOUT, unit_id, (address, quantity))
    }

    /// Reads, and again while the connection says so.
    fn read_within(
        &mut self,
        timeout: Duration,
        unit_id: u8,
        range: (u16, u16),
    ) -> Result<u16, Failure> {
        let mut attempt = Attempt::default();
        loop {
            let (found, again) = self.attempt((timeout, attempt), unit_id, range);
            let Some(again) = again else { return found };
            attempt = again;
        }
    }

    fn attempt(
        &mut self,
        (timeout, attempt): (Duration, Attempt),
        unit_id: u8,
        (address, quantity): (u16, u16),
    ) -> (Result<u16, Failure>, Option<Attempt>) {
        let request = EncodedRequest::new(&reading(address, quantity));
        self.connection.send_again(unit_id, &request, timeout, attempt, self.now).unwrap();
        let (mut found, mut again) = (None, None);
        loop {
            self.serve(unit_id, (address, quantity));
            let Some(deadline) = self.connection.deadline() else { break };
            let received = self.next(deadline);
            let sink = |done: Done<'_>| {
                again = done.again;
                found = Some(done.outcome.map(|response| match response {
                    Response::Registers(registers) => registers.iter().next().unwrap(),
                    _ => panic!("registers were read"),
                }));
            };
            match received {
                Some((at, bytes)) => {
                    self.now = self.now.max(at);
                    self.connection.receive(&bytes, self.now, sink);
                }
                None => {
                    self.now = self.now.max(deadline);
                    self.connection.advance(self.now, sink);
                }
            }
            if found.is_some() {
                break;
            }
        }
        if self.connection.closed().is_some() {
            self.reconnect();
        }
        (found.expect("every request has a result"), again)
    }

    /// Sends a request, whose frame or end comes from a test.
    fn send(&mut self, address: u16) {
        let request = EncodedRequest::new(&reading(address, 1));
        self.connection.send(1, &request, TIMEOUT, self.now).unwrap();
        self.pass_until_sent();
        self.serve(1, (address, 1));
    }

    fn pass_until_sent(&mut self) {
        while self.connection.outgoing().is_empty() {
            self.now = self.connection.deadline().unwrap();
            self.connection.advance(self.now, |_| panic!("it has not been sent"));
        }
    }

    /// Answers what the client has sent.
    fn serve(&mut self, unit_id: u8, (address, quantity): (u16, u16)) {
        let sent = self.connection.outgoing().to_vec();
        if sent.is_empty() {
            return;
        }
        self.connection.sent(sent.len());
        self.coming.extend(self.kept.drain(..).map(|kept| (self.now + 2 * MS, kept)));
        let registers = (address..address + quantity).flat_map(u16::to_be_bytes);
        let pdu: Vec<u8> = [3, 2 * quantity as u8].into_iter().chain(registers).collect();
        let reply = match self.transport {
            Transport::Tcp | Transport::Udp => {
                let id = u16::from_be_bytes([sent[0], sent[1]]);
                [&mbap::header(id, unit_id, pdu.len())[..], &pdu].concat()
            }
            Transport::AsciiOverTcp | Transport::SerialAscii { .. } => {
                let mut frame = [0; ascii::MAX_LEN];
                let len = ascii::encode(unit_id, &pdu, &mut frame).unwrap();
                frame[..len].to_vec()
            }
            _ => {
                let mut frame = [0; rtu::MAX_LEN];
                let len = rtu::encode(unit_id, &pdu, &mut frame).unwrap();
                frame[..len].to_vec()
            }
        };
        for after in (self.vice)(self.requests, &mut self.numbers) {
            match after {
                KEPT => self.kept.push(reply.clone()),
                after => self.coming.push((self.now + after, reply.clone())),
            }
        }
        self.requests += 1;
    }

    /// Reads different addresses, one after the other, with this pause, and 1 to `most` registers at each.
    fn run(&mut self, reads: u16, pause: Duration, most: u16) -> Counts {
        let mut counts = Counts::default();
        for number in 0..reads {
            self.pass(pause);
            let address = 100 + number % 7 * 100;
            match self.read_some(1, address, 1 + number % most) {
                Ok(value) if value == address => counts.right += 1,
                Ok(_) => counts.wrong += 1,
                Err(_) => counts.failed += 1,
            }
        }
        self.late += self.connection.late();
        counts
    }
}

const VICES: [(&str, Vice); 12] = [
    ("always 0.32 s", |_, _| vec![320 * MS]),
    ("once 0.32 s", |number, _| vec![if number == 5 { 320 * MS } else { 5 * MS }]),
    ("1.1 to 2.2 times the timeout", |_, numbers| vec![numbers.between(275 * MS, 550 * MS)]),
    ("0.5 to 1.5 times the timeout", |_, numbers| vec![numbers.between(125 * MS, 375 * MS)]),
    ("a fifth is late", |number, numbers| {
        vec![if number % 5 == 3 { numbers.between(260 * MS, 550 * MS) } else { 5 * MS }]
    }),
    ("all twice", |_, numbers| vec![3 * MS, 3 * MS + numbers.between(MS / 2, 10 * MS)]),
    ("all twice, late", |_, numbers| vec![320 * MS, 320 * MS + numbers.between(MS / 2, 10 * MS)]),
    ("twice at once", |_, _| vec![3 * MS, 3 * MS]),
    ("three times", |_, _| vec![3 * MS, 6 * MS, 12 * MS]),
    ("a fifth twice", |number, numbers| match number % 5 {
        3 => vec![3 * MS, 3 * MS + numbers.between(MS / 2, 10 * MS)],
        _ => vec![3 * MS],
    }),
    ("a fifth before the next", |number, _| vec![if number % 5 == 3 { KEPT } else { 3 * MS }]),
    ("a fifth behind the next", |number, _| match number % 5 {
        3 => vec![KEPT],
        _ => vec![MS],
    }),
];

#[test]
fn no_reply_is_taken_for_another() {
    let mut table = String::new();
    let mut wrong = 0;
    for (name, vice) in VICES {
        for transport in TRANSPORTS {
            for (pause, listens) in [(Duration::ZERO, true), (7 * MS, true), (7 * MS, false)] {
                for most in [1, 3] {
                    let mut world = World::new(transport, vice);
                    world.listens = listens;
                    let counts = world.run(250, pause, most);
                    wrong += counts.wrong;
                    table += &format!("{name}, {transport:?}, {pause:?}, {most}: {counts:?}\n");
                }
            }
        }
    }
    assert_eq!(wrong, 0, "{table}");
    println!("{table}");
}

/// The reads of a device that always takes this long.
fn constantly(transport: Transport, vice: Vice) -> (Counts, u64, u64) {
    let mut world = World::new(transport, vice);
    let counts = world.run(40, Duration::ZERO, 1);
    let raised = world.connection.take_raised();
    (counts, world.late, raised)
}

#[test]
fn a_device_that_is_always_late_gets_more_time_until_it_is_not() {
    for transport in SERIAL {
        let (counts, late, raised) = constantly(transport, |_, _| vec![320 * MS]);
        assert_eq!(counts, Counts { right: 38, wrong: 0, failed: 2 });
        assert_eq!((late, raised), (2, 38));
        // From then on it is fast: a while later, nothing is raised any more.
        let (counts, _, raised) =
            constantly(transport, |number, _| vec![if number < 3 { 320 * MS } else { 3 * MS }]);
        assert_eq!(counts, Counts { right: 38, wrong: 0, failed: 2 });
        assert_eq!(raised, 33);
    }
}

/// Transports with transaction ids, and the failed reads before the timeout is raised.
const WITH_IDS: [(Transport, u32); 2] = [(Transport::Tcp, 2), (Transport::Udp, 3)];

#[test]
fn a_device_that_is_always_late_gets_more_time_with_transaction_ids_too() {
    for (transport, failed) in WITH_IDS {
        let mut world = World::new(transport, |_, _| vec![320 * MS]);
        let counts = world.run(40, Duration::ZERO, 1);
        assert_eq!(counts, Counts { right: 40 - failed, wrong: 0, failed }, "{transport:?}");
        assert_eq!(world.connection.longest_late(), 320 * MS);
        assert!(world.connection.take_raised() >= 36);
        // The next connection knows it.
        world.reconnect();
        assert_eq!(world.run(40, Duration::ZERO, 1), Counts { right: 40, wrong: 0, failed: 0 });
        assert_eq!(world.connection.take_raised(), 40);
    }
}

#[test]
fn a_device_that_is_no_longer_late_has_its_timeout_again() {
    for (transport, failed) in WITH_IDS {
        let mut world =
            World::new(transport, |number, _| vec![if number < 12 { 320 * MS } else { 3 * MS }]);
        let counts = world.run(80, Duration::ZERO, 1);
        assert_eq!(counts, Counts { right: 80 - failed, wrong: 0, failed }, "{transport:?}");
        let raised = world.connection.take_raised();
        assert!((33..50).contains(&raised), "{transport:?}: {raised}");
        world.vice = |_, _| vec![];
        let began = world.now;
        assert_eq!(world.read(1, 100), Err(Failure::Timeout));
        assert_eq!(world.now - began, TIMEOUT);
    }
}

#[test]
fn a_timeout_is_raised_for_one_unit_and_to_four_times_at_most() {
    for (transport, _) in WITH_IDS {
        let mut world = World::new(transport, |_, _| vec![4 * TIMEOUT + 50 * MS]);
        world.listens = false;
        for _ in 0..3 {
            let _ = world.read(1, 100);
            world.pass(8 * TIMEOUT);
        }
        world.vice = |_, _| vec![];
        for (unit_id, waited) in [(1, 4 * TIMEOUT), (2, TIMEOUT)] {
            let began = world.now;
            assert_eq!(world.read(unit_id, 100), Err(Failure::Timeout));
            assert_eq!(world.now - began, waited, "{transport:?}, unit {unit_id}");
        }
    }
}

#[test]
fn replies_to_requests_that_their_callers_have_ended_raise_nothing() {
    let request = EncodedRequest::new(&Request::ReadHoldingRegisters(Range::new(1, 1).unwrap()));
    let mut connection = Connection::new(Transport::Tcp);
    let mut now = MS;
    for id in 0..3 {
        let ticket = connection.send(1, &request, TIMEOUT, now).unwrap();
        connection.sent(12);
        connection.cancel(ticket, now);
        let late = [&mbap::header(id, 1, 4)[..], &[3, 2, 0, 9]].concat();
        now += 200 * MS;
        connection.receive(&late, now, |_| panic!("nobody waits for it"));
    }
    assert_eq!((connection.late(), connection.take_raised()), (3, 0));
    let ticket = connection.send(1, &request, TIMEOUT, now).unwrap();
    assert_eq!(connection.deadline_of(ticket), Some(now + TIMEOUT));
}

#[test]
fn a_good_line_is_as_fast_as_before_after_its_first_replies() {
    for transport in [SERIAL[0], SERIAL[1], Transport::RtuOverTcp] {
        let mut world = World::new(transport, |_, _| vec![3 * MS]);
        world.run(20, Duration::ZERO, 1);
        let began = world.now;
        let counts = world.run(100, Duration::ZERO, 1);
        assert_eq!(counts, Counts { right: 100, wrong: 0, failed: 0 });
        let silence = if SERIAL.contains(&transport) { SILENCE } else { Duration::ZERO };
        assert_eq!(world.now - began, 100 * (3 * MS + silence));
    }
}

#[test]
fn a_unit_that_is_silent_holds_up_no_other_unit() {
    let mut world =
        World::new(SERIAL[0], |number, _| if number == 0 { vec![] } else { vec![3 * MS] });
    assert_eq!(world.read(9, 100), Err(Failure::Timeout));
    let began = world.now;
    assert_eq!(world.read(1, 200), Ok(200));
    assert!(world.now - began <= 50 * MS);
    // Its own reply may still come.
    assert_eq!(world.read(9, 300), Ok(300));
    assert!(world.now - began >= 2 * TIMEOUT);
}

#[test]
fn a_read_of_another_length_does_not_wait_for_a_late_reply() {
    for transport in SERIAL {
        let late: Vice = |number, _| vec![if number == 0 { 320 * MS } else { 30 * MS }];
        let mut world = World::new(transport, late);
        assert_eq!(world.read_some(1, 100, 2), Err(Failure::Timeout));
        let began = world.now;
        assert_eq!(world.read_some(1, 200, 3), Ok(200));
        assert!(world.now - began <= 60 * MS);
        // Its own length waits for the late reply.
        assert_eq!(world.read_some(1, 300, 2), Ok(300));
        assert!(world.now - began > 70 * MS);
        assert_eq!(world.connection.late(), 1);
    }
}

#[test]
fn the_length_of_a_reply_does_not_count_where_devices_pad_them() {
    let tolerance = Tolerance { pad: true, ..Tolerance::default() };
    let mut world =
        World::new(SERIAL[0], |number, _| if number == 0 { vec![] } else { vec![3 * MS] });
    world.connection = Connection::tolerant(SERIAL[0], tolerance, MS);
    assert_eq!(world.read_some(1, 100, 2), Err(Failure::Timeout));
    let began = world.now;
    assert_eq!(world.read_some(1, 200, 3), Ok(200));
    assert!(world.now - began >= 2 * TIMEOUT);
}

#[test]
fn a_late_reply_to_another_unit_does_not_end_a_request() {
    let mut world =
        World::new(SERIAL[0], |number, _| if number == 0 { vec![260 * MS] } else { vec![30 * MS] });
    assert_eq!(world.read(9, 100), Err(Failure::Timeout));
    assert_eq!(world.read(1, 200), Ok(200));
    assert_eq!(world.connection.late(), 1);
    assert_eq!(world.connection.take_strays().bytes, 0);
}

/// Reads of a device that is asked for `address`, on a line and in a stream, when something else has come or
/// happened instead of the reply. That comes later. Every read after it has its own value.
fn reads_after(happens: impl Fn(&mut World)) {
    for transport in [SERIAL[0], Transport::RtuOverTcp] {
        for late in 1..=TIMEOUT.as_millis() as u32 {
            let mut world = World::new(transport, |_, _| vec![3 * MS]);
            world.run(10, Duration::ZERO, 1);
            world.send(800);
            let [(_, reply)] = &mut world.coming[..] else { panic!("one reply is coming") };
            let reply = std::mem::take(reply);
            world.coming[0] = (world.now + late * MS, reply);
            happens(&mut world);
            if world.connection.closed().is_some() {
                world.reconnect();
            }
            let until = world.now + TIMEOUT;
            while world.now < until {
                let counts = world.run(1, Duration::ZERO, 1);
                assert_eq!(counts.wrong, 0, "{transport:?}, {late} ms");
            }
        }
    }
}

fn receive(world: &mut World, unit_id: u8, pdu: &[u8]) {
    let mut frame = [0; rtu::MAX_LEN];
    let len = rtu::encode(unit_id, pdu, &mut frame).unwrap();
    world.now += MS;
    world.connection.receive(&frame[..len], world.now, |done| {
        assert!(done.outcome.is_err());
    });
}

#[test]
fn the_reply_of_another_unit_does_not_end_the_wait_for_its_own() {
    reads_after(|world| receive(world, 9, &[3, 2, 0, 9]));
}

#[test]
fn a_reply_of_another_length_does_not_end_the_wait_for_its_own() {
    reads_after(|world| receive(world, 1, &[3, 4, 0, 9, 0, 9]));
}

#[test]
fn the_reply_of_a_device_may_follow_the_exception_of_a_gateway() {
    reads_after(|world| receive(world, 1, &[0x83, 0x0B]));
}

#[test]
fn a_reply_may_come_on_the_next_connection() {
    for why in [Closed::ByPeer, Closed::BySelf] {
        reads_after(|world| world.connection.close(why, |done| assert!(done.outcome.is_err())));
    }
}

#[test]
fn a_request_with_little_time_may_have_a_reply_as_late_as_others() {
    for transport in TRANSPORTS {
        for is_known in [false, true] {
            let mut world = World::new(transport, |_, _| vec![200 * MS]);
            if is_known {
                assert_eq!(world.read(1, 100), Ok(100));
            }
            for address in 2..20 {
                let timeout = if address % 3 == 0 { TIMEOUT } else { TIMEOUT / 50 };
                let found = world.read_within(timeout, 1, (address, 1));
                assert!(
                    found.is_err() || found == Ok(address),
                    "{transport:?} {address} {found:?}"
                );
            }
        }
    }
}

#[test]
fn the_replies_to_all_attempts_of_a_read_are_waited_for() {
    for transport in TRANSPORTS {
        let mut world = World::new(transport, |number, _| match number {
            // The second attempt gets the reply to the first one; its own comes later.
            0 => vec![19 * TIMEOUT / 10],
            1 => vec![22 * TIMEOUT / 10],
            _ => vec![150 * MS],
        });
        world.tolerance.retries = 1;
        world.reconnect();
        for address in 100..110 {
            let found = world.read(1, address);
            assert!(found.is_err() || found == Ok(address), "{transport:?} {address} {found:?}");
        }
    }
}

#[test]
fn a_copy_of_the_reply_to_one_attempt_is_not_that_to_another() {
    for transport in TRANSPORTS {
        let mut world = World::new(transport, |_, _| vec![13 * TIMEOUT / 10, 133 * TIMEOUT / 100]);
        world.tolerance.retries = 1;
        world.reconnect();
        for address in 100..130 {
            let found = world.read(1, address);
            assert!(found.is_err() || found == Ok(address), "{transport:?} {address} {found:?}");
        }
    }
}

#[test]
fn a_reply_that_may_be_a_copy_is_believed_if_the_unit_sends_no_other_in_its_usual_time() {
    let twice: Vice = |number, _| match number {
        // The second one comes when the next request has been sent.
        20 => vec![60 * MS, 63 * MS],
        _ => vec![60 * MS],
    };
    for transport in [SERIAL[0], Transport::RtuOverTcp] {
        let counts = World::new(transport, twice).run(40, Duration::ZERO, 1);
        assert_eq!((counts.wrong, counts.failed), (0, 1), "{transport:?}");
    }
}

/// The transaction ids of requests on a connection after another one that ended without a reply.
#[test]
fn a_late_reply_on_the_next_connection_is_known_by_its_transaction_id() {
    let request = EncodedRequest::new(&Request::ReadHoldingRegisters(Range::new(1, 1).unwrap()));
    for seed in 0..100 {
        let mut first = Connection::new(Transport::Tcp).unpredictable(seed);
        first.send(1, &request, TIMEOUT, MS).unwrap();
        let id = u16::from_be_bytes([first.outgoing()[0], first.outgoing()[1]]);
        first.close(Closed::ByPeer, |_| {});
        let mut next = Connection::new(Transport::Tcp).unpredictable(seed);
        next.follow(first.take_past(MS));
        next.send(1, &request, TIMEOUT, MS).unwrap();
        let late = [&mbap::header(id, 1, 4)[..], &[3, 2, 0, 9]].concat();
        next.receive(&late, MS, |_| panic!("the reply is not its own"));
        assert_eq!((next.late(), next.closed()), (1, None));
    }
}

#[test]
fn transaction_ids_begin_at_random() {
    let request = EncodedRequest::new(&Request::ReadHoldingRegisters(Range::new(1, 1).unwrap()));
    let first = |seed: u64| {
        let mut connection = Connection::new(Transport::Tcp).unpredictable(seed << 20);
        connection.send(1, &request, TIMEOUT, MS).unwrap();
        u16::from_be_bytes([connection.outgoing()[0], connection.outgoing()[1]])
    };
    let mut ids: Vec<u16> = (0..100).map(first).collect();
    ids.dedup();
    assert!(ids.len() > 90, "{ids:?}");
}

#[test]
fn a_reply_that_is_faster_than_the_line_is_not_believed() {
    // A request and a reply take 15 ms as bytes, 32 ms as characters.
    for (transport, bytes) in [(SERIAL[0], 7), (SERIAL[1], 15)] {
        let twice: Vice = |number, _| match number {
            // The second one comes when the next request has been sent.
            20 => vec![60 * MS, 63 * MS],
            _ => vec![60 * MS],
        };
        let mut world = World::new(transport, twice);
        world.connection = Connection::new(transport).on_line(MS);
        for number in 0..40 {
            assert_eq!(world.read(1, 100 + number), Ok(100 + number));
        }
        assert_eq!(world.connection.take_strays(), Strays { replies: 1, bytes });
    }
}

#[test]
fn a_line_that_is_faster_than_its_settings_is_believed() {
    let mut world = World::new(SERIAL[0], |_, _| vec![MS]);
    world.connection = Connection::new(SERIAL[0]).on_line(MS);
    let counts = world.run(40, Duration::ZERO, 1);
    assert_eq!(counts, Counts { right: 40, wrong: 0, failed: 0 });
}

#[test]
fn a_fast_copy_of_a_late_reply_is_not_believed() {
    let late_and_twice: Vice = |number, _| match number {
        // The next request is sent between the two.
        20 => vec![320 * MS, 323 * MS],
        _ => vec![30 * MS],
    };
    let mut world = World::new(SERIAL[0], late_and_twice);
    world.connection = Connection::new(SERIAL[0]).on_line(MS);
    for address in 1..=40 {
        let expected = if address == 21 { Err(Failure::Timeout) } else { Ok(address) };
        assert_eq!(world.read(1, address), expected);
    }
    assert_eq!(world.connection.take_strays().replies, 1);
}

#[test]
fn a_fast_reply_on_a_line_that_brings_others_is_not_believed() {
    // It answers what another master has asked.
    let mut world = World::new(SERIAL[0], |_, _| vec![30 * MS]);
    world.connection = Connection::new(SERIAL[0]).on_line(MS);
    assert_eq!(world.run(20, Duration::ZERO, 1).right, 20);
    receive(&mut world, 1, &[3, 2, 0xAB, 0xCD]);
    let mut frame = [0; rtu::MAX_LEN];
    let len = rtu::encode(1, &[3, 2, 0xAB, 0xCE], &mut frame).unwrap();
    world.send(100);
    world.coming.push((world.now + MS, frame[..len].to_vec()));
    let mut found = None;
    while found.is_none() {
        let (at, bytes) = world.next(world.now + TIMEOUT).unwrap();
        world.now = at;
        world.connection.receive(&bytes, at, |done| found = Some(done.pdu.to_vec()));
    }
    assert_eq!(found.unwrap(), [3, 2, 0, 100]);
}

const TOO_FAST: Failure = Failure::Invalid(InvalidResponse::TooFast);

/// The first reply of these is slow enough, so that it does not show that the line is fast, and comes twice.
const FIRST_SLOW_AND_TWICE: Vice =
    |number, _| if number == 0 { vec![30 * MS, 31 * MS] } else { vec![MS] };

#[test]
fn a_fast_reply_that_is_no_copy_shows_that_the_line_is_faster_than_its_settings() {
    let mut world = World::new(SERIAL[0], |number, _| vec![if number < 10 { 30 * MS } else { MS }]);
    world.connection = Connection::new(SERIAL[0]).on_line(MS);
    let addresses = 1..=40;
    assert!(addresses.into_iter().all(|address| world.read(1, address) == Ok(address)));
}

#[test]
fn equal_fast_replies_are_believed_after_two_requests_without_another() {
    let mut world = World::new(SERIAL[0], FIRST_SLOW_AND_TWICE);
    world.connection = Connection::new(SERIAL[0]).on_line(MS);
    let found: Vec<_> = (1..=5).map(|_| world.read(1, 100)).collect();
    let lost = Err(TOO_FAST);
    assert_eq!(found, [Ok(100), lost, lost, Ok(100), Ok(100)]);
}

/// A line of 1 ms for a character, which has brought eight replies in time, and then one late.
fn after_a_late_reply(vice: Vice) -> World {
    let mut world = World::new(SERIAL[0], vice);
    world.connection = Connection::new(SERIAL[0]).on_line(MS);
    assert!((0..8).all(|address| world.read(1, address) == Ok(address)));
    assert_eq!(world.read(1, 8), Err(Failure::Timeout));
    world
}

#[test]
fn shorter_reads_that_are_answered_do_not_hide_that_longer_ones_come_too_fast() {
    // 60 registers take 133 ms, the others 15 ms.
    let mut world = after_a_late_reply(|number, _| vec![if number == 8 { 320 } else { 40 } * MS]);
    let mut long = Vec::new();
    for _ in 0..4 {
        assert_eq!(world.read(1, 7), Ok(7));
        long.push(world.read_some(1, 100, 60));
    }
    assert_eq!(long, [Err(TOO_FAST), Err(TOO_FAST), Ok(100), Ok(100)]);
}

#[test]
fn a_read_that_is_as_long_and_takes_its_time_shows_that_the_line_is_not_faster() {
    let mut world = after_a_late_reply(|number, _| match number {
        8 => vec![320 * MS],
        10 | 12 | 14 => vec![30 * MS],
        _ => vec![140 * MS],
    });
    for _ in 0..3 {
        assert_eq!(world.read_some(1, 100, 60), Ok(100));
        assert_eq!(world.read_some(1, 100, 60), Err(TOO_FAST));
    }
}

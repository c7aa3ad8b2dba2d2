//! Listeners before memories with a journal. The journal of these tests carries out a step when it is
//! told to.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::{TcpStream, UdpSocket};
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use holdfast_engine::server::reports::audit::Unrecordable;
use holdfast_engine::server::reports::event::Verbosity;
use holdfast_engine::server::requests::unit_server::UnitSettings;
use holdfast_engine::server::rights::functions::{AccessMode, Functions};
use holdfast_engine::server::rights::rule::Rule;
use holdfast_engine::server::{
    AfterRefusal, ConnectionLimits, DatagramFraming, Engine, Flags, ListenerKind, ListenerSettings,
    Listening, PacketsPerConnection, RawRule, RawSettings, Settings, StreamFraming, StreamSettings,
    UdpSettings, WhenFull,
};
use holdfast_memory::{
    Access, Area, CarriedOut, Done, Journal, Layout, Memory, Read as Reading, Refusal, Refused,
    Span, Step,
};
use holdfast_protocol::frame::mbap;
use holdfast_protocol::raw_ingest::Format;

const TIMEOUT: Duration = Duration::from_secs(60);

/// Steps that wait for the test.
#[derive(Default)]
struct Manual {
    waiting: Mutex<VecDeque<(Step, Done)>>,
    arrived: Condvar,
}

impl std::fmt::Debug for Manual {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("Manual")
    }
}

impl Journal for Manual {
    fn submit(&self, step: Step, done: Done) {
        self.waiting.lock().unwrap().push_back((step, done));
        self.arrived.notify_all();
    }
}

impl Manual {
    fn wait_for(&self, count: usize) {
        let few = |waiting: &mut VecDeque<_>| waiting.len() < count;
        let waited =
            self.arrived.wait_timeout_while(self.waiting.lock().unwrap(), TIMEOUT, few).unwrap();
        assert!(!waited.1.timed_out(), "{} of {count} steps came", waited.0.len());
    }

    fn next(&self) -> (Step, Done) {
        self.wait_for(1);
        self.waiting.lock().unwrap().pop_front().unwrap()
    }

    fn waiting(&self) -> usize {
        self.waiting.lock().unwrap().len()
    }
}

struct Setup {
    engine: Engine,
    journal: Arc<Manual>,
    memory: Arc<Memory>,
}

impl Setup {
    /// Listeners for Modbus TCP, Modbus UDP, and Raw Ingest with one and with many packets.
    fn new() -> Setup {
        let span = Span::new(0, 100).unwrap();
        let layout =
            Area::ALL.into_iter().fold(Layout::default(), |layout, area| layout.with(area, span));
        let layout = layout.with(Area::File(4), span);
        let memory = Arc::new(Memory::new(layout, None).unwrap());
        let journal = Arc::<Manual>::default();
        memory.keep_in(Arc::clone(&journal) as Arc<dyn Journal>, 0);
        let rule = Rule {
            sources: vec!["127.0.0.1/32".parse().unwrap()],
            roles: None,
            units: vec![(1, Arc::clone(&memory))],
            destinations: Vec::new(),
            access: AccessMode::ReadWrite,
            functions: Functions::All,
            narrowed: Vec::new(),
        };
        let bind = "127.0.0.1:0".parse().unwrap();
        let limits = ConnectionLimits {
            max_connections: 100,
            max_connections_per_source: None,
            when_full: WhenFull::Refuse,
            max_handshakes: None,
            grace: std::time::Duration::ZERO,
        };
        let stream = StreamSettings {
            bind,
            framing: StreamFraming::Mbap,
            rules: vec![rule.clone()],
            limits,
            idle_timeout: None,
            request_timeout: TIMEOUT,
            frame_timeout: None,
            units: UnitSettings::default(),
            keepalive: Duration::from_secs(60),
            tls: None,
            raw_ingest: None,
        };
        let udp = UdpSettings {
            bind,
            framing: DatagramFraming::Mbap,
            rules: vec![rule],
            units: UnitSettings::default(),
        };
        let raw = |packets| RawSettings {
            bind,
            format: Format::V1,
            flags: Flags::Strict,
            rules: vec![RawRule {
                sources: vec!["127.0.0.1/32".parse().unwrap()],
                roles: None,
                targets: vec![(1, Arc::clone(&memory))],
                areas: Area::ALL.to_vec(),
            }],
            limits,
            request_timeout: TIMEOUT,
            packets,
            tls: None,
        };
        let many = PacketsPerConnection::Many { idle: TIMEOUT, after_refusal: AfterRefusal::Close };
        let kinds = [
            ListenerKind::ModbusStream(stream),
            ListenerKind::ModbusUdp(udp),
            ListenerKind::RawIngest(raw(PacketsPerConnection::One)),
            ListenerKind::RawIngest(raw(many)),
        ];
        let listeners = kinds.into_iter().enumerate();
        let listeners =
            listeners.map(|(at, kind)| ListenerSettings { name: at.to_string(), kind }).collect();
        let engine = Engine::start(Settings {
            listening: Listening {
                listeners,
                identity: vec![(0, b"a".to_vec()), (1, b"b".to_vec()), (2, b"c".to_vec())],
                unit_names: Vec::new(),
            },
            workers: 1,
            events: Verbosity::Nothing,
            audit: Some(Unrecordable::Write),
        });
        Setup { engine: engine.unwrap(), journal, memory }
    }

    fn connect(&self, listener: usize) -> TcpStream {
        let stream = TcpStream::connect(self.engine.addresses()[listener].unwrap()).unwrap();
        stream.set_nodelay(true).unwrap();
        stream.set_read_timeout(Some(TIMEOUT)).unwrap();
        stream
    }

    /// Carries out the next step.
    fn carry_out(&self) {
        self.carry_out_at(None);
    }

    /// Carries out the next step, at a sequence of a log.
    fn carry_out_at(&self, sequence: Option<u64>) {
        let (step, done) = self.journal.next();
        let carried_out = step.carry_out(std::slice::from_ref(&self.memory)).unwrap();
        done(Ok(CarriedOut { sequence, ..carried_out }));
    }

    /// The sequence in the record of the next write.
    fn recorded(&self) -> Option<u64> {
        let records = self.engine.next_writes(TIMEOUT, 1);
        records.first().expect("a write was recorded").log_sequence
    }

    fn refuse(&self, refusal: Refusal) {
        let (_, done) = self.journal.next();
        done(Err(Refused { index: 0, refusal }));
    }

    fn register(&self, address: u16) -> u16 {
        let mut out = [0; 2];
        let area = Area::HoldingRegisters;
        let read = Reading { area, address, count: 1, out: &mut out };
        self.memory.read(Access::Ingest, read).unwrap();
        u16::from_be_bytes(out)
    }
}

fn frame(tag: u16, pdu: &[u8]) -> Vec<u8> {
    [&mbap::header(tag, 1, pdu.len())[..], pdu].concat()
}

fn expect(stream: &mut TcpStream, tag: u16, pdu: &[u8]) {
    let mut found = vec![0; mbap::HEADER_LEN + pdu.len()];
    stream.read_exact(&mut found).unwrap();
    assert_eq!(found, frame(tag, pdu));
}

fn is_silent(stream: &TcpStream) -> bool {
    stream.set_nonblocking(true).unwrap();
    let peeked = stream.peek(&mut [0]);
    stream.set_nonblocking(false).unwrap();
    matches!(peeked, Err(error) if error.kind() == ErrorKind::WouldBlock)
}

fn packet(address: u16, value: u16) -> Vec<u8> {
    let head = [b'R', b'I', 1, 3, 0, 1];
    [&head[..], &address.to_be_bytes(), &[0, 1], &value.to_be_bytes()].concat()
}

#[test]
fn each_write_is_answered_when_it_is_carried_out() {
    let setup = Setup::new();
    let mut client = setup.connect(0);
    let cases: [(&[u8], &[u8]); 7] = [
        (&[5, 0, 1, 0xFF, 0], &[5, 0, 1, 0xFF, 0]),
        (&[6, 0, 1, 0, 0x12], &[6, 0, 1, 0, 0x12]),
        (&[15, 0, 2, 0, 9, 2, 0xFF, 1], &[15, 0, 2, 0, 9]),
        (&[16, 0, 2, 0, 2, 4, 1, 2, 3, 4], &[16, 0, 2, 0, 2]),
        (
            &[21, 18, 6, 0, 4, 0, 7, 0, 1, 1, 1, 6, 0, 4, 0, 9, 0, 1, 2, 2],
            &[21, 18, 6, 0, 4, 0, 7, 0, 1, 1, 1, 6, 0, 4, 0, 9, 0, 1, 2, 2],
        ),
        (&[22, 0, 1, 0, 0xF2, 0, 0x25], &[22, 0, 1, 0, 0xF2, 0, 0x25]),
        (&[23, 0, 1, 0, 2, 0, 2, 0, 1, 2, 9, 9], &[23, 4, 0, 0x17, 9, 9]),
    ];
    for (tag, (request, reply)) in (0..).zip(cases) {
        client.write_all(&frame(tag, request)).unwrap();
        setup.journal.wait_for(1);
        assert!(is_silent(&client));
        setup.carry_out();
        expect(&mut client, tag, reply);
    }
    setup.engine.stop();
}

#[test]
fn a_write_is_recorded_with_its_place_in_the_log() {
    let setup = Setup::new();
    let mut client = setup.connect(0);
    let request = [6, 0, 1, 0, 0x12];
    for sequence in [Some(41), None] {
        client.write_all(&frame(1, &request)).unwrap();
        setup.carry_out_at(sequence);
        expect(&mut client, 1, &request);
        assert_eq!(setup.recorded(), sequence);
    }
    client.write_all(&frame(2, &request)).unwrap();
    setup.refuse(Refusal::NotConfirmed);
    expect(&mut client, 2, &[0x86, 4]);
    assert_eq!(setup.recorded(), None);
    let datagrams = UdpSocket::bind("127.0.0.1:0").unwrap();
    datagrams.send_to(&frame(3, &request), setup.engine.addresses()[1].unwrap()).unwrap();
    setup.carry_out_at(Some(43));
    assert_eq!(setup.recorded(), Some(43));
    for listener in [2, 3] {
        let mut sender = setup.connect(listener);
        sender.write_all(&packet(5, 9)).unwrap();
        setup.carry_out_at(Some(44));
        sender.read_exact(&mut [0]).unwrap();
        assert_eq!(setup.recorded(), Some(44));
    }
    // The client leaves before its write is carried out.
    client.write_all(&frame(4, &request)).unwrap();
    setup.journal.wait_for(1);
    drop(client);
    setup.carry_out_at(Some(45));
    assert_eq!(setup.recorded(), Some(45));
    setup.engine.stop();
}

#[test]
fn pipelined_writes_do_not_wait_for_each_other_and_reads_wait_for_them() {
    let setup = Setup::new();
    let mut client = setup.connect(0);
    let requests: Vec<u8> = (0..40)
        .flat_map(|tag| frame(tag, &[6, 0, 7, 0, tag as u8]))
        .chain(frame(40, &[3, 0, 7, 0, 1]))
        .collect();
    client.write_all(&requests).unwrap();
    // As many as a connection may leave waiting.
    setup.journal.wait_for(16);
    for tag in 0..40 {
        assert_eq!(setup.register(7), u16::saturating_sub(tag, 1));
        assert!(is_silent(&client));
        setup.carry_out();
        expect(&mut client, tag, &[6, 0, 7, 0, tag as u8]);
    }
    expect(&mut client, 40, &[3, 2, 0, 39]);
    setup.engine.stop();
}

#[test]
fn a_write_that_is_not_kept_is_refused() {
    let setup = Setup::new();
    let mut client = setup.connect(0);
    let refusals = [
        (Refusal::Unavailable, 6),
        (Refusal::Busy, 6),
        (Refusal::NotStored, 4),
        (Refusal::TooLarge { bytes: 9, most: 8 }, 4),
        (Refusal::NotConfirmed, 4),
    ];
    for (refusal, code) in refusals {
        client.write_all(&frame(1, &[6, 0, 7, 0, 1])).unwrap();
        setup.refuse(refusal);
        expect(&mut client, 1, &[0x86, code]);
    }
    client.write_all(&frame(2, &[16, 0, 7, 0, 1, 2, 0, 1])).unwrap();
    drop(setup.journal.next());
    expect(&mut client, 2, &[0x90, 4]);
    // What is wrong by itself does not reach the journal.
    for (request, reply) in [
        (&[6, 0, 100, 0, 1][..], &[0x86, 2][..]),
        (&[16, 0, 99, 0, 2, 4, 0, 1, 0, 1], &[0x90, 2]),
        (&[5, 0, 7, 1, 1], &[0x85, 3]),
        (&[23, 0, 99, 0, 2, 0, 2, 0, 1, 2, 9, 9], &[0x97, 2]),
    ] {
        client.write_all(&frame(3, request)).unwrap();
        expect(&mut client, 3, reply);
    }
    assert_eq!((setup.journal.waiting(), setup.register(7)), (0, 0));
    setup.engine.stop();
}

#[test]
fn writes_of_a_client_that_has_left_are_carried_out() {
    let setup = Setup::new();
    let mut client = setup.connect(0);
    client.write_all(&frame(1, &[6, 0, 7, 0, 5])).unwrap();
    setup.journal.wait_for(1);
    drop(client);
    setup.carry_out();
    assert_eq!(setup.register(7), 5);
    setup.engine.stop();
}

#[test]
fn datagrams_are_answered_when_they_are_carried_out() {
    let setup = Setup::new();
    let client = UdpSocket::bind("127.0.0.1:0").unwrap();
    client.connect(setup.engine.addresses()[1].unwrap()).unwrap();
    client.set_read_timeout(Some(TIMEOUT)).unwrap();
    client.send(&frame(1, &[6, 0, 7, 0, 5])).unwrap();
    setup.carry_out();
    let mut found = [0; 300];
    let len = client.recv(&mut found).unwrap();
    assert_eq!(found[..len], frame(1, &[6, 0, 7, 0, 5]));
    setup.engine.stop();
}

#[test]
fn packets_are_confirmed_when_they_are_carried_out() {
    let setup = Setup::new();
    let mut reply = [9; 1];
    let mut one = setup.connect(2);
    one.write_all(&packet(7, 5)).unwrap();
    setup.journal.wait_for(1);
    assert!(is_silent(&one));
    setup.carry_out();
    one.read_exact(&mut reply).unwrap();
    assert_eq!((reply, setup.register(7)), ([0], 5));

    let mut many = setup.connect(3);
    for value in [6, 7] {
        many.write_all(&packet(7, value)).unwrap();
        setup.carry_out();
        many.read_exact(&mut reply).unwrap();
        assert_eq!((reply, setup.register(7)), ([0], value));
    }
    setup.engine.stop();
}

#[test]
fn a_packet_that_is_not_confirmed_gets_no_reply() {
    let setup = Setup::new();
    for listener in [2, 3] {
        for (refusal, reply) in [
            (Refusal::NotStored, &[1][..]),
            (Refusal::Unavailable, &[1]),
            (Refusal::Busy, &[1]),
            (Refusal::TooLarge { bytes: 9, most: 8 }, &[1]),
            (Refusal::NotConfirmed, &[]),
        ] {
            let mut sender = setup.connect(listener);
            sender.write_all(&packet(7, 5)).unwrap();
            setup.refuse(refusal);
            let mut found = Vec::new();
            sender.read_to_end(&mut found).unwrap();
            assert_eq!(found, reply, "{refusal:?}");
        }
    }
    assert_eq!(setup.register(7), 0);
    setup.engine.stop();
}

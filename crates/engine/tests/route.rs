//! Many masters on one device, through a route. `HOLDFAST_TORTURE=1` asks a million times.

use std::collections::VecDeque;
use std::env;
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Barrier, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use holdfast_engine::client::Place;
use holdfast_engine::link::{InFlight, LinkSettings, Route, SharedLink, Withdrawal};
use holdfast_engine::poller::Poller;
use holdfast_engine::server::reports::event::Verbosity;
use holdfast_engine::server::requests::unit_server::UnitSettings;
use holdfast_engine::server::rights::functions::{AccessMode, Functions};
use holdfast_engine::server::rights::rule::{RequestDestination, Rule};
use holdfast_engine::server::{
    ConnectionLimits, DatagramFraming, Engine, ListenerKind, ListenerSettings, Listening, Settings,
    StreamFraming, StreamSettings, UdpSettings, WhenFull,
};
use holdfast_protocol::frame::{mbap, rtu};
use holdfast_runtime::Retry;

const MASTERS: usize = 50;
const TIMEOUT: Duration = Duration::from_secs(60);

/// Bits of a character on a serial line.
const CHARACTER: u32 = 11;

fn is_torture() -> bool {
    env::var_os("HOLDFAST_TORTURE").is_some()
}

/// What a device has seen.
#[derive(Default)]
struct Seen {
    requests: AtomicU64,
    /// Bytes that arrived between a request and its reply.
    overlapping: AtomicU64,
}

/// A device of RTU frames over TCP: registers hold their address and its complement. With a baud rate,
/// request and reply take as long as on a line.
fn device(baud: Option<u32>) -> (SocketAddr, Arc<Seen>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let (address, seen) = (listener.local_addr().unwrap(), Arc::<Seen>::default());
    let shared = Arc::clone(&seen);
    thread::spawn(move || {
        for stream in listener.incoming() {
            let shared = Arc::clone(&shared);
            thread::spawn(move || answer(&mut stream.unwrap(), baud, &shared));
        }
    });
    (address, seen)
}

fn answer(stream: &mut TcpStream, baud: Option<u32>, seen: &Seen) {
    stream.set_nodelay(true).unwrap();
    let mut request = [0; 8];
    while stream.read_exact(&mut request).is_ok() {
        let reply = reply(address_of(&request));
        if let Some(baud) = baud {
            let characters = (request.len() + reply.len()) as u32 * CHARACTER;
            thread::sleep(Duration::from_secs(1) * characters / baud);
        }
        seen.requests.fetch_add(1, Ordering::Relaxed);
        stream.set_nonblocking(true).unwrap();
        match stream.peek(&mut [0]) {
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Ok(0) => return,
            _ => {
                seen.overlapping.fetch_add(1, Ordering::Relaxed);
            }
        }
        stream.set_nonblocking(false).unwrap();
        stream.write_all(&reply).unwrap();
    }
}

/// The address that an RTU frame reads.
fn address_of(request: &[u8]) -> u16 {
    let (_, pdu) = rtu::decode(request).expect("the link sends whole frames");
    u16::from_be_bytes([pdu[1], pdu[2]])
}

/// The RTU frame of unit 1 with two registers.
fn reply(address: u16) -> Vec<u8> {
    let mut frame = [0; rtu::MAX_LEN];
    let len = rtu::encode(1, &registers(address), &mut frame).unwrap();
    frame[..len].to_vec()
}

fn registers(address: u16) -> Vec<u8> {
    [&[3, 4], &address.to_be_bytes()[..], &(!address).to_be_bytes()].concat()
}

/// The same device, which sends no reply until the sender is dropped. It keeps the addresses in the order of
/// their requests.
fn held_device() -> (SocketAddr, Sender<()>, Arc<Mutex<Vec<u16>>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let (address, asked) = (listener.local_addr().unwrap(), Arc::<Mutex<Vec<u16>>>::default());
    let (release, held) = channel();
    let shared = Arc::clone(&asked);
    thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut request = [0; 8];
        while stream.read_exact(&mut request).is_ok() {
            let address = address_of(&request);
            shared.lock().unwrap().push(address);
            let _ = held.recv();
            stream.write_all(&reply(address)).unwrap();
        }
    });
    (address, release, asked)
}

/// Listeners for Modbus TCP and Modbus UDP whose unit 1 is the device.
struct Setup {
    engine: Engine,
    poller: Poller,
    link: Arc<SharedLink>,
    withdrawal: Arc<Withdrawal>,
}

impl Setup {
    fn new(device: SocketAddr) -> Setup {
        Setup::with(device, 1000, false)
    }

    fn with(device: SocketAddr, queue: usize, coalesce: bool) -> Setup {
        let poller = Poller::start(Vec::new()).unwrap();
        let place = Place::RtuOverTcp { host: "127.0.0.1".into(), port: device.port() };
        let link = LinkSettings {
            endpoint: place.into(),
            in_flight: InFlight::Fixed(1),
            retry: Retry::default(),
            queue,
            coalesce,
            cache: Duration::ZERO,
            preferred: Vec::new(),
        };
        let link = poller.link(link).unwrap();
        let withdrawal = Arc::<Withdrawal>::default();
        let route = Route {
            name: "device".into(),
            link: Arc::clone(&link),
            unit_id: None,
            timeout: TIMEOUT,
            withdrawal: Arc::clone(&withdrawal),
        };
        let rule = Rule {
            sources: vec!["127.0.0.0/8".parse().unwrap()],
            roles: None,
            units: Vec::new(),
            destinations: vec![(1, RequestDestination::Device(route))],
            access: AccessMode::ReadWrite,
            functions: Functions::All,
            narrowed: Vec::new(),
        };
        let bind = "127.0.0.1:0".parse().unwrap();
        let stream = StreamSettings {
            bind,
            framing: StreamFraming::Mbap,
            rules: vec![rule.clone()],
            limits: ConnectionLimits {
                max_connections: 100,
                max_connections_per_source: None,
                when_full: WhenFull::Refuse,
                max_handshakes: None,
                grace: std::time::Duration::ZERO,
            },
            idle_timeout: None,
            request_timeout: TIMEOUT,
            frame_timeout: None,
            units: UnitSettings::default(),
            keepalive: Duration::from_secs(60),
            tls: None,
            raw_ingest: None,
        };
        let datagrams = UdpSettings {
            bind,
            framing: DatagramFraming::Mbap,
            rules: vec![rule],
            units: UnitSettings::default(),
        };
        let listeners = [
            ("tcp", ListenerKind::ModbusStream(stream)),
            ("udp", ListenerKind::ModbusUdp(datagrams)),
        ];
        let listeners =
            listeners.map(|(name, kind)| ListenerSettings { name: name.into(), kind }).into();
        let engine = Engine::start(Settings {
            listening: Listening {
                listeners,
                identity: vec![(0, b"a".to_vec()), (1, b"b".to_vec()), (2, b"c".to_vec())],
                unit_names: Vec::new(),
            },
            workers: 2,
            events: Verbosity::Nothing,
            audit: None,
        });
        Setup { engine: engine.unwrap(), poller, link, withdrawal }
    }

    fn connect(&self) -> TcpStream {
        let address = self.engine.addresses()[0].unwrap();
        let stream = TcpStream::connect(address).unwrap();
        stream.set_nodelay(true).unwrap();
        stream.set_read_timeout(Some(TIMEOUT)).unwrap();
        stream
    }

    /// A client over UDP with a source address; `None` if the system does not have it.
    fn datagrams(&self, source: &str) -> Option<UdpSocket> {
        let socket = UdpSocket::bind((source, 0)).ok()?;
        socket.connect(self.engine.addresses()[1].unwrap()).unwrap();
        socket.set_read_timeout(Some(TIMEOUT)).unwrap();
        Some(socket)
    }

    fn stop(self) {
        self.engine.stop();
        self.poller.stop();
    }
}

/// A master that keeps `depth` requests in flight, and checks each reply.
struct Master {
    stream: TcpStream,
    number: u16,
    sent: u16,
    /// Transaction ids and addresses of requests without a reply.
    open: VecDeque<(u16, u16)>,
}

impl Master {
    fn ask(&mut self) {
        let (id, address) = (self.sent.wrapping_mul(7), self.number * 1000 + self.sent % 1000);
        self.sent = self.sent.wrapping_add(1);
        self.stream.write_all(&read(id, address)).unwrap();
        self.open.push_back((id, address));
    }

    fn receive(&mut self) {
        let mut reply = [0; 13];
        self.stream.read_exact(&mut reply).unwrap();
        let (id, address) = self.open.pop_front().unwrap();
        let expected = [&mbap::header(id, 1, 6)[..], &registers(address)].concat();
        assert_eq!(reply, expected[..], "master {}", self.number);
    }
}

/// A request for two registers.
fn read(id: u16, address: u16) -> Vec<u8> {
    let [high, low] = address.to_be_bytes();
    [&mbap::header(id, 1, 5)[..], &[3, high, low, 0, 2]].concat()
}

/// Asks until each master has asked `each` times, or until `enough`. Returns how often each was answered,
/// and its longest wait.
fn crowd(setup: &Setup, each: u64, enough: Option<u64>) -> Vec<(u64, Duration)> {
    let (start, all) = (Arc::new(Barrier::new(MASTERS)), Arc::new(AtomicU64::new(0)));
    let is_over = Arc::new(AtomicBool::new(false));
    let masters: Vec<_> = (0..MASTERS)
        .map(|number| {
            let (start, all, is_over) =
                (Arc::clone(&start), Arc::clone(&all), Arc::clone(&is_over));
            let stream = setup.connect();
            thread::spawn(move || {
                let mut master =
                    Master { stream, number: number as u16, sent: 0, open: VecDeque::new() };
                // Some masters ask for much more than their share.
                let depth = if number % 10 == 0 { 16 } else { 1 };
                let (mut answered, mut longest) = (0, Duration::ZERO);
                start.wait();
                (0..depth).for_each(|_| master.ask());
                while !is_over.load(Ordering::Relaxed) && answered < each {
                    let began = Instant::now();
                    master.receive();
                    longest = longest.max(began.elapsed());
                    answered += 1;
                    let total = all.fetch_add(1, Ordering::Relaxed) + 1;
                    if enough.is_some_and(|enough| total >= enough) {
                        is_over.store(true, Ordering::Relaxed);
                    }
                    master.ask();
                }
                (answered, longest)
            })
        })
        .collect();
    masters.into_iter().map(|master| master.join().unwrap()).collect()
}

#[test]
fn no_master_gets_the_reply_of_another_and_the_device_gets_one_request_at_a_time() {
    let each = if is_torture() { 20_000 } else { 400 };
    let (address, seen) = device(None);
    let setup = Setup::new(address);
    let answered: u64 = crowd(&setup, each, None).iter().map(|(answered, _)| answered).sum();
    assert_eq!(answered, MASTERS as u64 * each);
    assert_eq!(seen.overlapping.load(Ordering::Relaxed), 0);
    assert_eq!(setup.link.counters.timeouts.get() + setup.link.counters.failures.get(), 0);
    assert_eq!(setup.link.counters.refused_full.get(), 0);
    setup.stop();
}

#[test]
fn fifty_masters_on_a_slow_line_have_equal_shares() {
    // 19,200 baud, or a line that is quicker so that the test ends soon.
    let (baud, enough) = if is_torture() { (19_200, 5_000) } else { (192_000, 1_000) };
    let (address, seen) = device(Some(baud));
    let setup = Setup::new(address);
    let shares = crowd(&setup, u64::MAX, Some(enough));
    let mean = shares.iter().map(|(answered, _)| answered).sum::<u64>() / MASTERS as u64;
    for (number, (answered, longest)) in shares.iter().enumerate() {
        assert!(2 * answered >= mean, "master {number}: {answered} of {mean}, waited {longest:?}");
    }
    assert_eq!(seen.overlapping.load(Ordering::Relaxed), 0);
    setup.stop();
}

#[test]
fn a_master_that_has_gone_is_not_asked_for() {
    let (address, seen) = device(Some(19_200));
    let setup = Setup::new(address);
    let waits: Mutex<Vec<Master>> = Mutex::default();
    for number in 0..10 {
        let stream = setup.connect();
        let mut master = Master { stream, number, sent: 0, open: VecDeque::new() };
        (0..16).for_each(|_| master.ask());
        waits.lock().unwrap().push(master);
    }
    let mut masters = waits.into_inner().unwrap();
    let mut stays = masters.pop().unwrap();
    while setup.link.waiting() < 100 {
        thread::yield_now();
    }
    drop(masters);
    (0..16).for_each(|_| stays.receive());
    while setup.link.waiting() > 0 {
        thread::yield_now();
    }
    let asked = seen.requests.load(Ordering::Relaxed);
    assert_eq!(asked + setup.link.counters.withdrawn.get(), 160);
    assert!(asked < 120, "{asked} requests were sent");
    setup.stop();
}

#[test]
fn a_request_that_waits_for_a_device_that_was_taken_away_is_not_sent() {
    let (address, held, asked) = held_device();
    let setup = Setup::new(address);
    let mut clients: Vec<_> = (0..3).map(|_| setup.connect()).collect();
    let ask = |client: &mut TcpStream, request: &[u8]| {
        let waiting = setup.link.waiting();
        client.write_all(request).unwrap();
        while setup.link.waiting() == waiting {
            thread::yield_now();
        }
    };
    let write = [&mbap::header(1, 1, 5)[..], &[6, 0, 200, 0, 1]].concat();
    ask(&mut clients[0], &read(1, 100));
    while asked.lock().unwrap().is_empty() {
        thread::yield_now();
    }
    ask(&mut clients[1], &write);
    ask(&mut clients[2], &read(1, 300));
    setup.withdrawal.withdraw();
    drop(held);

    let expect = |client: &mut TcpStream, pdu: &[u8]| {
        let mut reply = vec![0; mbap::HEADER_LEN + pdu.len()];
        client.read_exact(&mut reply).unwrap();
        assert_eq!(reply, [&mbap::header(1, 1, pdu.len())[..], pdu].concat());
    };
    expect(&mut clients[0], &registers(100));
    expect(&mut clients[1], &[0x86, 0x0A]);
    expect(&mut clients[2], &[0x83, 0x0A]);
    assert_eq!(*asked.lock().unwrap(), [100], "only what was under way");
    assert_eq!(setup.link.counters.withdrawn.get(), 2);
    setup.stop();
}

#[test]
fn udp_clients_take_turns_and_leave_places_to_each_other() {
    let (address, held, asked) = held_device();
    let setup = Setup::with(address, 20, true);
    let many = setup.datagrams("127.0.0.1").unwrap();
    // macOS has no second address by default.
    let Some(few) = setup.datagrams("127.0.0.2") else { return setup.stop() };
    let expect = |client: &UdpSocket, pdu: &[u8]| {
        let mut reply = [0; mbap::MAX_LEN];
        let len = client.recv(&mut reply).unwrap();
        assert_eq!(reply[..len], [&mbap::header(1, 1, pdu.len())[..], pdu].concat());
    };
    for address in 0..11 {
        many.send(&read(1, address)).unwrap();
    }
    expect(&many, &[0x83, 6]);
    for address in [100, 101] {
        few.send(&read(1, address)).unwrap();
    }
    // The link takes requests in order: once it has this one, it has them all.
    few.send(&read(1, 101)).unwrap();
    while setup.link.counters.coalesced.get() == 0 {
        assert_eq!(setup.link.counters.refused_full.get(), 1);
        thread::yield_now();
    }
    drop(held);
    for address in 0..10 {
        expect(&many, &registers(address));
    }
    for address in [100, 101, 101] {
        expect(&few, &registers(address));
    }
    assert_eq!(*asked.lock().unwrap(), [0, 1, 100, 2, 101, 3, 4, 5, 6, 7, 8, 9]);
    setup.stop();
}

//! Tests what a reload changes for open connections, for those that are about to begin, and for sockets.

use std::io::{Read as _, Write as _};
use std::net::{TcpStream, UdpSocket as StdUdpSocket};

use holdfast_memory::{Access, Area, Layout, Memory, Read, Span, Write};
use holdfast_protocol::raw_ingest::{Area as PacketArea, DONE, Format, Header, REFUSED};
use rcgen::{CertificateRevocationListParams, KeyIdMethod, RevokedCertParams, date_time_ymd};
use rustls::version::TLS13;

use super::*;
use crate::server::connections::admission::Full;
use crate::server::connections::listener::accept;
use crate::server::connections::listener::bind_tcp;
use crate::server::requests::unit_server::UnitSettings;
use crate::server::rights::functions::{AccessMode, Functions};
use crate::server::rights::rule::Rule;
use crate::server::transports::raw_ingest::{AfterRefusal, Flags, PacketsPerConnection, RawRule};
use crate::server::transports::tcp::StreamFraming;
use crate::tls::server::{ServerFiles, ServerTls};
use crate::tls::test_party::{Party, connection};

const TIMEOUT: Duration = Duration::from_secs(60);
const V1: Format = Format::V1;
const CRC: Format = Format::Crc { required: false };
const MANY: PacketsPerConnection =
    PacketsPerConnection::Many { idle: TIMEOUT, after_refusal: AfterRefusal::Continue };
const NO_REPLY: &[u8] = &[];

fn any_port() -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], 0))
}

fn memory() -> Arc<Memory> {
    let layout = Layout::default().with(Area::HoldingRegisters, Span::new(0, 8).unwrap());
    Arc::new(Memory::new(layout, None).unwrap())
}

fn register(memory: &Memory) -> u16 {
    let mut out = [0; 2];
    let read = Read { area: Area::HoldingRegisters, address: 0, count: 1, out: &mut out };
    memory.read(Access::Ingest, read).unwrap();
    u16::from_be_bytes(out)
}

/// Target 1 is this memory.
fn raw(memory: &Arc<Memory>, format: Format, packets: PacketsPerConnection) -> RawSettings {
    RawSettings {
        bind: any_port(),
        format,
        flags: Flags::Strict,
        rules: vec![RawRule {
            sources: vec!["127.0.0.1/32".parse().unwrap()],
            roles: None,
            targets: vec![(1, Arc::clone(memory))],
            areas: vec![Area::HoldingRegisters],
        }],
        limits: limits(),
        request_timeout: TIMEOUT,
        packets,
        tls: None,
    }
}

fn read_only(mut settings: RawSettings) -> RawSettings {
    settings.rules[0].areas = vec![Area::Coils];
    settings
}

fn limits() -> ConnectionLimits {
    ConnectionLimits { max_connections: 10, ..ConnectionLimits::NONE }
}

/// Unit 1 is this memory.
fn stream(memory: &Arc<Memory>, raw_ingest: Option<RawSettings>) -> StreamSettings {
    StreamSettings {
        bind: any_port(),
        framing: StreamFraming::Mbap,
        rules: vec![Rule {
            sources: vec!["127.0.0.1/32".parse().unwrap()],
            roles: None,
            units: vec![(1, Arc::clone(memory))],
            destinations: Vec::new(),
            access: AccessMode::ReadWrite,
            functions: Functions::All,
            narrowed: Vec::new(),
        }],
        limits: limits(),
        idle_timeout: None,
        request_timeout: TIMEOUT,
        frame_timeout: None,
        keepalive: Duration::from_secs(60),
        units: UnitSettings::default(),
        tls: None,
        raw_ingest,
    }
}

fn packet(format: Format) -> Vec<u8> {
    let (area, count) = (PacketArea::HoldingRegisters, 1.try_into().unwrap());
    let header = Header { area, target: 1, address: 0, count };
    let mut bytes = vec![0; format.packet_len(&header)];
    format.encode_to_slice(&header, &[0, 7], &mut bytes).unwrap();
    bytes
}

fn listening(listeners: Vec<(&str, ListenerKind)>) -> Listening {
    let listener = |(name, kind)| ListenerSettings { name: String::from(name), kind };
    Listening {
        listeners: listeners.into_iter().map(listener).collect(),
        identity: [0, 1, 2].map(|id| (id, b"a".to_vec())).to_vec(),
        unit_names: Vec::new(),
    }
}

fn engine(listeners: Vec<(&str, ListenerKind)>) -> Engine {
    let settings = Settings {
        listening: listening(listeners),
        workers: 1,
        events: Verbosity::Nothing,
        audit: None,
    };
    Engine::start(settings).unwrap()
}

fn revoked(engine: &Engine) -> u64 {
    engine.counters()[0].connections().rights_revoked.get()
}

fn connect(address: SocketAddr) -> TcpStream {
    let client = TcpStream::connect(address).unwrap();
    client.set_read_timeout(Some(TIMEOUT)).unwrap();
    client
}

/// Connects to the only listener, and waits until the connection is served.
fn served(engine: &Engine) -> TcpStream {
    let client = connect(engine.addresses()[0].unwrap());
    while engine.open_connections()[0].1.is_empty() {
        thread::yield_now();
    }
    client
}

/// The task of a listener drops its socket when it ends.
fn wait_until_closed(address: SocketAddr) {
    while TcpStream::connect(address).is_ok() {
        thread::yield_now();
    }
}

/// Sends bytes, and receives the reply, which is empty at the end of the connection.
fn ask(client: &mut TcpStream, bytes: &[u8]) -> Vec<u8> {
    let mut reply = [0; 1];
    // A connection that the listener has ended may fail in either direction.
    let len = client.write_all(bytes).and_then(|()| client.read(&mut reply)).unwrap_or(0);
    reply[..len].to_vec()
}

#[test]
fn a_connection_does_not_go_on_where_packets_have_another_dialect() {
    type Kinds = fn(RawSettings) -> ListenerKind;
    let shared: Kinds = |raw| ListenerKind::ModbusStream(stream(&memory(), Some(raw)));
    let (strict, close) = (Flags::Strict, AfterRefusal::Close);
    let many = PacketsPerConnection::Many { idle: TIMEOUT, after_refusal: close };
    for kind in [ListenerKind::RawIngest, shared] {
        for (before, after) in [
            ((V1, strict, MANY), (CRC, strict, MANY)),
            ((CRC, strict, MANY), (V1, strict, MANY)),
            ((CRC, Flags::Ignore, MANY), (CRC, strict, MANY)),
            ((CRC, strict, MANY), (CRC, strict, many)),
            ((CRC, strict, many), (CRC, strict, PacketsPerConnection::One)),
        ] {
            let (first, second) = (memory(), memory());
            let raw = |memory, (format, flags, packets)| {
                vec![("raw", kind(RawSettings { flags, ..raw(memory, format, packets) }))]
            };
            let engine = engine(raw(&first, before));
            let mut client = served(&engine);
            assert_eq!(ask(&mut client, &packet(before.0)), [DONE]);
            engine.reload(listening(raw(&second, after))).unwrap();
            assert_eq!(ask(&mut client, &packet(before.0)), NO_REPLY);
            assert_eq!((register(&first), register(&second), revoked(&engine)), (7, 0, 1));
            let mut next = connect(engine.addresses()[0].unwrap());
            assert_eq!((ask(&mut next, &packet(after.0)), register(&second)), (vec![DONE], 7));
        }
    }
}

#[test]
fn the_only_packet_of_a_connection_is_judged_by_the_rights_after_a_reload() {
    let packets = PacketsPerConnection::One;
    let packet = packet(V1);
    for sent_before in [0, 3, packet.len() - 1] {
        for is_shared in [false, true] {
            let memory = memory();
            let kind = |raw| match is_shared {
                true => ListenerKind::ModbusStream(stream(&memory, Some(raw))),
                false => ListenerKind::RawIngest(raw),
            };
            let engine = engine(vec![("raw", kind(raw(&memory, V1, packets)))]);
            let mut client = served(&engine);
            client.write_all(&packet[..sent_before]).unwrap();
            let less = kind(read_only(raw(&memory, V1, packets)));
            engine.reload(listening(vec![("raw", less)])).unwrap();
            let reply = ask(&mut client, &packet[sent_before..]);
            assert_eq!((reply, register(&memory)), (vec![REFUSED], 0), "{sent_before}");
        }
    }
}

#[test]
fn a_refusal_is_reported_again_after_a_reload_and_not_after_a_review() {
    let memory = memory();
    let kind = || ListenerKind::ModbusStream(stream(&memory, None));
    let events = Verbosity::Refusals;
    let listening = || listening(vec![("plant", kind())]);
    let settings = Settings { listening: listening(), workers: 1, events, audit: None };
    let engine = Engine::start(settings).unwrap();
    let mut client = served(&engine);
    // Unit 2 has no memory. The exception follows the event.
    let mut refused = || {
        client.write_all(&[0, 1, 0, 0, 0, 6, 2, 3, 0, 0, 0, 1]).unwrap();
        client.read_exact(&mut [0; 9]).unwrap();
        let events = std::iter::from_fn(|| engine.next_event(Duration::ZERO));
        events.filter(|event| matches!(event.kind, Kind::RefusedRequest(_))).count()
    };
    assert_eq!((refused(), refused()), (1, 0));
    engine.review();
    assert_eq!(refused(), 0);
    engine.reload(listening()).unwrap();
    assert_eq!((refused(), refused()), (1, 0));
}

#[test]
fn a_port_that_carries_packets_no_more_ends_a_connection_that_sends_one() {
    let memory = memory();
    let kind = |raw| ListenerKind::ModbusStream(stream(&memory, raw));
    let packets = PacketsPerConnection::One;
    let engine = engine(vec![("plant", kind(Some(raw(&memory, V1, packets))))]);
    let mut client = served(&engine);
    engine.reload(listening(vec![("plant", kind(None))])).unwrap();
    assert_eq!(ask(&mut client, &packet(V1)), NO_REPLY);
    assert_eq!((register(&memory), revoked(&engine)), (0, 1));
}

/// The files of a server that has revoked the client.
fn revoking(party: &Party) -> ServerFiles {
    let list = CertificateRevocationListParams {
        this_update: date_time_ymd(2026, 1, 1),
        next_update: date_time_ymd(2090, 1, 1),
        crl_number: 1.into(),
        issuing_distribution_point: None,
        revoked_certs: vec![RevokedCertParams {
            serial_number: party.client.params.serial_number.clone().unwrap(),
            revocation_time: date_time_ymd(2026, 1, 1),
            reason_code: None,
            invalidity_date: None,
        }],
        key_identifier_method: KeyIdMethod::Sha256,
    };
    let list = list.signed_by(&party.authority.issuer()).unwrap().pem().unwrap();
    ServerFiles { crl_file: Some(party.folder.write("crl.pem", &list)), ..party.files() }
}

#[test]
fn a_handshake_that_a_reload_overtakes_is_judged_by_the_new_revocation_list() {
    let (party, memory) = (Party::new(), memory());
    let tls = |files: &ServerFiles| Some(Arc::new(ServerTls::load(files, None).unwrap()));
    let (before, after) = (tls(&party.files()), tls(&revoking(&party)));
    let limits = ConnectionLimits { max_handshakes: Some(10), ..limits() };
    let modbus =
        |tls| ListenerKind::ModbusStream(StreamSettings { tls, limits, ..stream(&memory, None) });
    let packets =
        |tls| ListenerKind::RawIngest(RawSettings { tls, limits, ..raw(&memory, V1, MANY) });
    let kinds: [&dyn Fn(_) -> ListenerKind; 2] = [&modbus, &packets];
    for kind in kinds {
        let engine = engine(vec![("secure", kind(before.clone()))]);
        let mut socket = connect(engine.addresses()[0].unwrap());
        let mut client = connection(&party.client(&TLS13));
        client.write_tls(&mut socket).unwrap();
        while client.is_handshaking() {
            client.read_tls(&mut socket).unwrap();
            client.process_new_packets().unwrap();
        }
        engine.reload(listening(vec![("secure", kind(after.clone()))])).unwrap();
        // The certificate of the client and the end of its handshake.
        while client.wants_write() {
            client.write_tls(&mut socket).unwrap();
        }
        while matches!(socket.read(&mut [0; 256]), Ok(1..)) {}
        assert_eq!(engine.counters()[0].connections().tls_failed.total(), 1);
        assert_eq!(engine.open_connections()[0].1.len(), 0);
    }
}

#[test]
fn a_listener_that_was_removed_admits_no_connection() {
    let memory = memory();
    let kind = ListenerKind::RawIngest(raw(&memory, V1, MANY));
    let engine = engine(vec![("raw", kind)]);
    let listener = Arc::clone(&lock(&engine.listeners)[0]);
    let mut client = served(&engine);
    engine.reload(listening(Vec::new())).unwrap();
    assert_eq!(ask(&mut client, &packet(V1)), NO_REPLY);
    assert_eq!(listener.context.admission.admit(any_port()).unwrap_err(), Full);

    // What its task does if it was about to admit a connection.
    let Served::Packets(live) = &listener.served else { unreachable!() };
    let (live, context) = (Arc::clone(live), Arc::clone(&listener.context));
    let socket = bind_tcp(any_port()).unwrap();
    let mut late = connect(socket.local_addr().unwrap());
    let handles = engine.handles.clone();
    let stop = engine.stop.subscribe();
    let task = engine.handles[0].spawn(async move {
        let socket = Arc::new(tokio::net::TcpListener::from_std(socket).unwrap());
        accept(context, live, socket, handles, stop).await;
    });
    assert_eq!((ask(&mut late, &packet(V1)), register(&memory)), (NO_REPLY.to_vec(), 0));
    let counted = &listener.context.connections;
    assert_eq!((counted.accepted.get(), counted.refused_full.get()), (1, 0));
    task.abort();
}

/// Reads register 0 of unit 1.
fn value_at(address: SocketAddr) -> u16 {
    let mut client = connect(address);
    client.write_all(&READ).unwrap();
    let mut reply = [0; 11];
    client.read_exact(&mut reply).unwrap();
    u16::from_be_bytes([reply[9], reply[10]])
}

const READ: [u8; 12] = [0, 1, 0, 0, 0, 6, 1, 3, 0, 0, 0, 1];

/// A memory whose first register has this value.
fn memory_with(value: u16) -> Arc<Memory> {
    let memory = memory();
    let bytes = &value.to_be_bytes();
    let write = Write { area: Area::HoldingRegisters, address: 0, count: 1, bytes };
    memory.write(Access::Ingest, write).unwrap();
    memory
}

#[test]
fn listeners_are_renamed_and_exchange_their_ports() {
    let memories = [1, 2].map(memory_with);
    let kind = |number: usize, bind| {
        ListenerKind::ModbusStream(StreamSettings { bind, ..stream(&memories[number], None) })
    };
    let engine = engine(vec![("a", kind(0, any_port())), ("b", kind(1, any_port()))]);
    let ports: Vec<_> = engine.addresses().into_iter().flatten().collect();
    let [one, two] = ports[..] else { unreachable!() };
    let mut client = connect(one);
    let values = || [value_at(one), value_at(two)];
    assert_eq!(values(), [1, 2]);
    engine.reload(listening(vec![("a", kind(0, two)), ("b", kind(1, one))])).unwrap();
    assert_eq!(ask(&mut client, &READ), NO_REPLY, "its listener has ended");
    assert_eq!(values(), [2, 1]);
    engine.reload(listening(vec![("b", kind(0, one)), ("c", kind(1, two))])).unwrap();
    assert_eq!(values(), [1, 2]);
    // Another protocol at the same address.
    let packets = RawSettings { bind: two, ..raw(&memories[1], V1, MANY) };
    engine.reload(listening(vec![("c", ListenerKind::RawIngest(packets))])).unwrap();
    assert_eq!(ask(&mut connect(two), &packet(V1)), [DONE]);
    wait_until_closed(one);
    engine.stop();
    assert!(TcpStream::connect(two).is_err(), "no copy of the socket is left");
}

#[test]
fn a_reload_that_fails_leaves_a_socket_with_its_listener() {
    let memories = [1, 2].map(memory_with);
    let kind = |number: usize, bind| {
        ListenerKind::ModbusStream(StreamSettings { bind, ..stream(&memories[number], None) })
    };
    let engine = engine(vec![("a", kind(0, any_port()))]);
    let address = engine.addresses()[0].unwrap();
    for twice in [("c", address), ("a", address)] {
        let failing = vec![("b", kind(1, address)), (twice.0, kind(1, twice.1))];
        let failed = engine.reload(listening(failing));
        assert!(matches!(failed, Err(StartError::Bind { .. })));
        assert_eq!((value_at(address), value_at(address)), (1, 1));
    }
    engine.reload(listening(Vec::new())).unwrap();
    wait_until_closed(address);
}

#[test]
fn a_listener_of_datagrams_is_renamed() {
    let memories = [1, 2].map(memory_with);
    let kind = |number: usize, bind| {
        let StreamSettings { rules, units, .. } = stream(&memories[number], None);
        ListenerKind::ModbusUdp(UdpSettings { bind, framing: DatagramFraming::Mbap, rules, units })
    };
    let engine = engine(vec![("a", kind(0, any_port()))]);
    let address = engine.addresses()[0].unwrap();
    let client = StdUdpSocket::bind(any_port()).unwrap();
    client.set_read_timeout(Some(TIMEOUT)).unwrap();
    client.connect(address).unwrap();
    let value = || {
        client.send(&READ).unwrap();
        let mut reply = [0; 11];
        client.recv(&mut reply).unwrap();
        u16::from_be_bytes([reply[9], reply[10]])
    };
    assert_eq!(value(), 1);
    engine.reload(listening(vec![("b", kind(1, address))])).unwrap();
    // The listener before may still answer a datagram.
    while value() != 2 {}
}

//! Modbus over UDP and RTU over UDP: one request per datagram. The reply comes from the address that
//! received the request.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::io::{self, ErrorKind, IoSliceMut};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Instant;

use holdfast_protocol::frame::{mbap, rtu};
use holdfast_protocol::pdu::{self, ExceptionCode};
use quinn_udp::{RecvMeta, Transmit, UdpSocketState};
use socket2::SockRef;
use tokio::io::Interest;
use tokio::net::UdpSocket;
use tokio::sync::watch;
use tokio::task::{JoinSet, yield_now};

use crate::link::{Asker, Reply, new_source};
use crate::server::connections::given_up::has_given_up;
use crate::server::connections::listener::ListenerContext;
use crate::server::connections::reloadable::Reloadable;
use crate::server::connections::reply_order::{Asked, Expected, MAX_WAITING};
use crate::server::reports::event::Kind;
use crate::server::reports::refused_request::Reported;
use crate::server::requests::unit_server::{UnitServer, UnitSettings};
use crate::server::rights::functions::only_reads;
use crate::server::rights::policy::Policy;
use crate::server::rights::rule::Rule;
use crate::server::transports::framing::{Datagram, Mbap, Next, Rtu};

/// Bytes per read of a socket. The system may deliver several datagrams of one peer at once.
const INPUT_BYTES: usize = 64 * 1024;

/// The most reads before other tasks run.
const READS_PER_TURN: u32 = 16;

/// The most reads of the remaining input when the listener stops.
const MAX_LAST_READS: usize = 1024;

/// The most requests of a listener that wait for devices.
const MAX_PENDING_REPLIES: usize = 1024;

/// The longest frame of the framings that datagrams have.
const MAX_FRAME_LEN: usize = mbap::MAX_LEN;

const _: () = assert!(rtu::MAX_LEN <= MAX_FRAME_LEN);

/// The framing of Modbus in a datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DatagramFraming {
    /// Modbus UDP: an MBAP header before the PDU.
    Mbap,
    /// RTU over UDP: an RTU frame.
    Rtu,
}

/// A listener for Modbus datagrams.
#[derive(Debug, Clone)]
pub struct UdpSettings {
    /// With port 0, the system picks a port. `[::]` also accepts IPv4 datagrams.
    pub bind: SocketAddr,
    pub framing: DatagramFraming,
    pub rules: Vec<Rule>,
    pub units: UnitSettings,
}

pub(crate) struct ModbusUdp {
    unit_server: Arc<UnitServer>,
    policy: Arc<Reloadable<Policy>>,
    framing: DatagramFraming,
}

impl ModbusUdp {
    pub(crate) fn new(
        framing: DatagramFraming,
        policy: Arc<Reloadable<Policy>>,
        unit_server: Arc<UnitServer>,
    ) -> ModbusUdp {
        ModbusUdp { unit_server, policy, framing }
    }

    /// Answers datagrams until `stop`, then those that the system has already received.
    pub(crate) async fn serve(
        self,
        context: Arc<ListenerContext>,
        socket: Datagrams,
        stop: watch::Receiver<bool>,
    ) {
        match self.framing {
            DatagramFraming::Mbap => self.serve_framed::<Mbap>(&context, socket, stop).await,
            DatagramFraming::Rtu => self.serve_framed::<Rtu>(&context, socket, stop).await,
        }
    }

    async fn serve_framed<D: Datagram>(
        &self,
        context: &Arc<ListenerContext>,
        socket: Datagrams,
        mut stop: watch::Receiver<bool>,
    ) {
        let mut input = vec![0; INPUT_BYTES].into_boxed_slice();
        let mut pending_replies = PendingReplies::new(stop.clone());
        let mut turns = 0;
        loop {
            turns += 1;
            if turns == READS_PER_TURN {
                turns = 0;
                // Datagrams that never pause leave time for connections, and for `stop`.
                yield_now().await;
            }
            let ready = tokio::select! {
                biased;
                _ = stop.wait_for(|stop| *stop) => break,
                Some(Ok(completed)) = pending_replies.replies.join_next(), if !pending_replies.replies.is_empty() => {
                    complete::<D>(&socket, completed, &mut pending_replies);
                    continue;
                }
                ready = socket.socket.readable() => ready,
            };
            // An error reports that an earlier reply was not delivered.
            let received = ready.and_then(|()| {
                socket.socket.try_io(Interest::READABLE, || socket.receive(&mut input))
            });
            if let Ok(meta) = received {
                self.take::<D>(context, &socket, &meta, &input, &mut pending_replies);
            }
        }
        for _ in 0..MAX_LAST_READS {
            match socket.receive(&mut input) {
                Ok(meta) => self.take::<D>(context, &socket, &meta, &input, &mut pending_replies),
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(_) => {}
            }
        }
        // The engine drops listeners whose devices take too long.
        while let Some(Ok(completed)) = pending_replies.replies.join_next().await {
            complete::<D>(&socket, completed, &mut pending_replies);
        }
    }

    /// Answers all datagrams of one read. All have the same length, except the last.
    fn take<D: Datagram>(
        &self,
        context: &Arc<ListenerContext>,
        socket: &Datagrams,
        meta: &RecvMeta,
        input: &[u8],
        pending_replies: &mut PendingReplies,
    ) {
        let mut output = [0; MAX_FRAME_LEN];
        let mut rest = &input[..meta.len];
        loop {
            let (datagram, more) = rest.split_at(meta.stride.min(rest.len()));
            let len = self.answer::<D>(context, meta, datagram, &mut output, pending_replies);
            if len > 0 {
                socket.send(&output[..len], meta);
            }
            if more.is_empty() || datagram.is_empty() {
                return;
            }
            rest = more;
        }
    }

    /// Returns the length of the reply, 0 when there is none, or none yet.
    fn answer<D: Datagram>(
        &self,
        context: &Arc<ListenerContext>,
        meta: &RecvMeta,
        datagram: &[u8],
        output: &mut [u8; MAX_FRAME_LEN],
        pending_replies: &mut PendingReplies,
    ) -> usize {
        let peer = meta.addr;
        let Some(rights) = self.policy.get().rights(peer.ip(), None) else {
            context.report(Kind::RefusedSource, Some(peer.into()));
            return 0;
        };
        let (tag, unit_id, request) = match D::single_request(datagram) {
            // The exception of another server. After one request with a forged address, two servers would
            // answer each other's exceptions without end.
            Next::Request { pdu: [0x80..=0xFF, ..], .. } => {
                self.unit_server.counters.frames.other_unit.add();
                return 0;
            }
            Next::Request { tag, unit_id, pdu, .. } => (tag, unit_id, pdu),
            Next::Foreign { .. } => {
                self.unit_server.discard(|frames| &frames.foreign);
                return 0;
            }
            Next::Damaged { .. } => {
                self.unit_server.discard(|frames| &frames.damaged);
                return 0;
            }
            Next::Broken | Next::Incomplete | Next::Stray { .. } => {
                self.unit_server.discard(|frames| &frames.broken);
                return 0;
            }
        };
        let Some(buffer) = output[D::HEADER_LEN..].first_chunk_mut::<{ pdu::MAX_LEN }>() else {
            return 0;
        };
        if let Some((newest, _)) = pending_replies.newest.get(&peer) {
            newest.send_replace(Instant::now());
        }
        if D::HAS_IDS && pending_replies.repeats(peer, (tag, unit_id, request)) {
            return 0;
        }
        if let Some(destination) = self.unit_server.destination(&rights, unit_id, request) {
            let asker = pending_replies.asker(peer.ip());
            let asked = Asked::send(context, destination, (tag, unit_id, request), |can_record| {
                if pending_replies.is_full(peer.ip()) {
                    return Err(ExceptionCode::ServerDeviceBusy);
                }
                self.unit_server.forward(&rights, destination, &asker, unit_id, request, can_record)
            });
            let (asked, reply, refused) = asked;
            context.note_refused(refused, &Reported::default(), Some(&peer.into()));
            return match reply {
                Expected::Pending(pending) => {
                    let ours = (Arc::clone(&self.unit_server), Arc::clone(context));
                    let reply = asked.answered(
                        pending,
                        ours,
                        Some(peer.into()),
                        pending_replies.running.clone(),
                    );
                    let now = Instant::now();
                    let sent = Sent { asked: now, unit_id, request: request.to_vec(), times: 1 };
                    pending_replies.sent.insert((peer, tag), sent);
                    let pending =
                        Completed { meta: *meta, asked: now, tag, unit_id, pdu: Vec::new() };
                    pending_replies.begin(&asker, pending, D::HAS_IDS, reply);
                    0
                }
                Expected::Known(reply) => {
                    asked.record(context, Some(&peer.into()), &reply);
                    buffer[..reply.pdu.len()].copy_from_slice(&reply.pdu);
                    D::complete(output, tag, unit_id, reply.pdu.len())
                }
            };
        }
        let ours = (&*self.unit_server, &*rights);
        let peer = (Some(&peer.into()), &Reported::default());
        let len = context.answer(ours, peer, unit_id, request, buffer);
        len.map_or(0, |len| D::complete(output, tag, unit_id, len))
    }
}

/// Requests that wait for their replies.
struct PendingReplies {
    /// The clients that wait for replies.
    clients: HashMap<IpAddr, Client>,
    /// For each peer that waits, when its newest request came, and for how many replies it waits.
    newest: HashMap<SocketAddr, (watch::Sender<Instant>, usize)>,
    /// By peer and transaction id, the newest request that waits for its reply.
    sent: HashMap<(SocketAddr, u16), Sent>,
    replies: JoinSet<Completed>,
    /// The engine waits until it is dropped.
    running: watch::Receiver<bool>,
}

struct Sent {
    asked: Instant,
    unit_id: u8,
    request: Vec<u8>,
    /// How often it was sent. Each time is answered, as by a device.
    times: usize,
}

/// All requests from one address: a client may send each from another port.
struct Client {
    source: u64,
    waiting: usize,
}

impl PendingReplies {
    fn new(running: watch::Receiver<bool>) -> PendingReplies {
        let (clients, newest, sent) = (HashMap::new(), HashMap::new(), HashMap::new());
        PendingReplies { clients, newest, sent, replies: JoinSet::new(), running }
    }

    fn asker(&self, address: IpAddr) -> Asker {
        let source = self.clients.get(&address).map_or_else(new_source, |client| client.source);
        Asker { source, peer: Some(address) }
    }

    /// The requests of a client that wait for replies.
    fn waiting(&self, address: IpAddr) -> usize {
        self.clients.get(&address).map_or(0, |client| client.waiting)
    }

    /// Whether a client must wait: it may have no more requests than it leaves to others.
    fn is_full(&self, address: IpAddr) -> bool {
        MAX_PENDING_REPLIES.saturating_sub(self.replies.len()) <= self.waiting(address)
    }

    /// Waits for a reply, unless its peer gives it up.
    fn begin(
        &mut self,
        asker: &Asker,
        pending: Completed,
        has_ids: bool,
        reply: impl Future<Output = Reply> + Send + 'static,
    ) {
        let (peer, asked) = (pending.meta.addr, pending.asked);
        let client = Client { source: asker.source, waiting: 0 };
        self.clients.entry(peer.ip()).or_insert(client).waiting += 1;
        let newest = self.newest.entry(peer).or_insert_with(|| (watch::Sender::new(asked), 0));
        newest.1 += 1;
        let mut newest = newest.0.subscribe();
        self.replies.spawn(async move {
            let is_late = |newest: &Instant| has_given_up(newest.duration_since(asked), None);
            let given_up = async { newest.wait_for(is_late).await.map(drop) };
            let mut reply = std::pin::pin!(reply);
            tokio::select! {
                biased;
                reply = &mut reply => Completed { pdu: reply.pdu, ..pending },
                Ok(()) = given_up, if !has_ids => {
                    // A broadcast has no reply to give up: it is sent.
                    if pending.unit_id == 0 {
                        reply.await;
                    }
                    pending
                }
            }
        });
    }

    /// Whether a peer sends a request again before its reply, as on a
    /// [connection](crate::server::connections::reply_order::Deferred::repeats).
    fn repeats(&mut self, peer: SocketAddr, (tag, unit_id, request): (u16, u8, &[u8])) -> bool {
        let Some(sent) = self.sent.get_mut(&(peer, tag)).filter(|sent| {
            sent.unit_id == unit_id && sent.request == request && !only_reads(request)
        }) else {
            return false;
        };
        sent.times = (sent.times + 1).min(MAX_WAITING);
        true
    }

    /// How often the reply to what a peer asked at that time is sent.
    fn times(&mut self, peer: SocketAddr, tag: u16, asked: Instant) -> usize {
        match self.sent.entry((peer, tag)) {
            Entry::Occupied(sent) if sent.get().asked == asked => sent.remove().times,
            _ => 1,
        }
    }

    /// Whether a peer has asked again, and given up what it asked at that time.
    fn has_asked_again(&self, peer: SocketAddr, asked: Instant) -> bool {
        let newest = self.newest.get(&peer).map(|(newest, _)| *newest.borrow());
        newest.is_some_and(|newest| has_given_up(newest.duration_since(asked), None))
    }

    /// A peer waits for one reply less.
    fn end(&mut self, peer: SocketAddr) {
        if let Entry::Occupied(mut client) = self.clients.entry(peer.ip()) {
            client.get_mut().waiting -= 1;
            if client.get().waiting == 0 {
                client.remove();
            }
        }
        if let Entry::Occupied(mut peer) = self.newest.entry(peer) {
            peer.get_mut().1 -= 1;
            if peer.get().1 == 0 {
                peer.remove();
            }
        }
    }
}

/// The reply of a device.
struct Completed {
    meta: RecvMeta,
    asked: Instant,
    tag: u16,
    unit_id: u8,
    /// Empty if nothing is to be sent.
    pdu: Vec<u8>,
}

/// Sends the reply of a device.
fn complete<D: Datagram>(
    socket: &Datagrams,
    completed: Completed,
    pending_replies: &mut PendingReplies,
) {
    let Completed { meta, asked, tag, unit_id, pdu } = completed;
    // It may have asked again just when the reply came.
    let is_late = !D::HAS_IDS && pending_replies.has_asked_again(meta.addr, asked);
    pending_replies.end(meta.addr);
    let times = pending_replies.times(meta.addr, tag, asked);
    if !pdu.is_empty() && !is_late {
        let mut frame = [0; MAX_FRAME_LEN];
        frame[D::HEADER_LEN..][..pdu.len()].copy_from_slice(&pdu);
        let len = D::complete(&mut frame, tag, unit_id, pdu.len());
        (0..times).for_each(|_| socket.send(&frame[..len], &meta));
    }
}

/// A socket that reports the local address of each datagram.
pub(crate) struct Datagrams {
    pub(crate) socket: Arc<UdpSocket>,
    state: UdpSocketState,
}

impl Datagrams {
    /// Fails if the system does not report local addresses.
    pub(crate) fn new(socket: UdpSocket) -> io::Result<Datagrams> {
        let state = UdpSocketState::new((&socket).into())?;
        Ok(Datagrams { socket: Arc::new(socket), state })
    }

    fn receive(&self, input: &mut [u8]) -> io::Result<RecvMeta> {
        let mut meta = [RecvMeta::default()];
        self.state.recv((&*self.socket).into(), &mut [IoSliceMut::new(input)], &mut meta)?;
        Ok(meta[0])
    }

    /// A reply that the system does not accept is lost, as any datagram can be.
    fn send(&self, reply: &[u8], to: &RecvMeta) {
        let transmit = Transmit {
            destination: to.addr,
            ecn: None,
            contents: reply,
            segment_size: None,
            src_ip: to.dst_ip,
        };
        // Sends directly by the system: the runtime may not know yet that the socket is writable.
        if self.state.try_send((&*self.socket).into(), &transmit).is_err() {
            // The request may have been sent to a broadcast address, which cannot be the source of
            // a reply.
            let _ = SockRef::from(&self.socket).send_to(reply, &to.addr.into());
        }
    }
}

#[cfg(test)]
mod tests {
    use holdfast_memory::{Area, Layout, Memory, Span};

    use super::*;
    use crate::server::connections::given_up::BURST_TIME;
    use crate::server::connections::listener::bind_udp;
    use crate::server::requests::identity::Identity;
    use crate::server::rights::functions::{AccessMode, Functions};

    fn unanswered(peer: SocketAddr) -> Completed {
        let mut meta = RecvMeta::default();
        meta.addr = peer;
        Completed { meta, asked: Instant::now(), tag: 0, unit_id: 1, pdu: Vec::new() }
    }

    #[test]
    fn a_client_leaves_pending_replies_to_others_and_is_forgotten_after_its_last_one() {
        let [one, other] = [1, 2].map(|last| IpAddr::from([127, 0, 0, last]));
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let _context = runtime.enter();
        let mut pending_replies = PendingReplies::new(watch::channel(false).1);
        let first = pending_replies.asker(one);
        let peer = SocketAddr::from((one, 1));
        pending_replies.begin(&first, unanswered(peer), false, std::future::pending());
        while !pending_replies.is_full(one) {
            let asker = pending_replies.asker(one);
            assert_eq!(asker.source, first.source);
            pending_replies.begin(&asker, unanswered(peer), false, std::future::pending());
        }
        assert_eq!(pending_replies.replies.len(), MAX_PENDING_REPLIES / 2);
        let asker = pending_replies.asker(other);
        assert_eq!((pending_replies.waiting(other), pending_replies.is_full(other)), (0, false));
        assert_ne!(asker.source, first.source);
        (0..pending_replies.waiting(one)).for_each(|_| pending_replies.end(peer));
        assert!(pending_replies.clients.is_empty() && pending_replies.newest.is_empty());
    }

    #[test]
    fn a_peer_that_asks_again_after_a_pause_has_given_up_the_replies_before() {
        let [one, other] = [1, 2].map(|port| SocketAddr::from(([127, 0, 0, 1], port)));
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let mut pending_replies = PendingReplies::new(watch::channel(false).1);
        let asker = pending_replies.asker(one.ip());
        let given_up: Vec<_> = runtime.block_on(async {
            for (peer, has_ids) in [(other, false), (one, true), (one, false)] {
                pending_replies.begin(&asker, unanswered(peer), has_ids, std::future::pending());
            }
            let first = Instant::now();
            for asked_again in [first, first + BURST_TIME * 2] {
                pending_replies.newest[&one].0.send_replace(asked_again);
                yield_now().await;
            }
            yield_now().await;
            std::iter::from_fn(|| pending_replies.replies.try_join_next()).collect()
        });
        assert_eq!(given_up.len(), 1);
        assert_eq!(given_up[0].as_ref().unwrap().meta.addr, one);
    }

    #[cfg(unix)]
    #[test]
    fn a_socket_that_reports_no_local_addresses_is_an_error() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let _context = runtime.enter();
        let local = socket2::Socket::new(socket2::Domain::UNIX, socket2::Type::DGRAM, None);
        let local = local.unwrap();
        local.set_nonblocking(true).unwrap();
        assert!(Datagrams::new(UdpSocket::from_std(local.into()).unwrap()).is_err());
    }

    #[test]
    fn other_tasks_run_between_many_datagrams_that_have_arrived() {
        const DATAGRAMS: usize = 100;
        let span = Span::new(0, 10).unwrap();
        let layout = Layout::default().with(Area::HoldingRegisters, span);
        let rule = Rule {
            sources: vec!["127.0.0.1/32".parse().unwrap()],
            roles: None,
            units: vec![(1, Arc::new(Memory::new(layout, None).unwrap()))],
            destinations: Vec::new(),
            access: AccessMode::ReadOnly,
            functions: Functions::All,
            narrowed: Vec::new(),
        };
        let objects = [(0, b"a".to_vec()), (1, b"b".to_vec()), (2, b"c".to_vec())];
        let identity = Identity::new(&objects, &[]).unwrap();
        let unit_server = Arc::new(UnitServer::new(identity, UnitSettings::default()));
        let policy = Arc::new(Reloadable::new(Policy::of(&[rule])));
        let service = ModbusUdp::new(DatagramFraming::Mbap, policy, Arc::clone(&unit_server));
        let socket = bind_udp("127.0.0.1:0".parse().unwrap()).unwrap();
        let client = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        client.connect(socket.local_addr().unwrap()).unwrap();
        for _ in 0..DATAGRAMS {
            client.send(&[0, 0, 0, 0, 0, 6, 1, 3, 0, 0, 0, 1]).unwrap();
        }
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let (_engine, stop) = watch::channel(false);
        let read = || unit_server.counters.requests().map(|(_, count)| count).sum::<u64>();
        let most = runtime.block_on(async {
            let context = Arc::new(ListenerContext::for_tests());
            let socket = Datagrams::new(UdpSocket::from_std(socket).unwrap()).unwrap();
            let _serving = tokio::spawn(service.serve(context, socket, stop));
            let (mut most, mut before) = (0, 0);
            while before < DATAGRAMS as u64 {
                yield_now().await;
                most = most.max(read() - before);
                before = read();
            }
            most
        });
        assert!(most <= u64::from(READS_PER_TURN), "{most} without a pause");
    }
}

//! A Raw Ingest listener: each connection carries one packet, one write, and one byte of reply. If the
//! settings allow it, it carries several packets one after another, each with its reply.
//!
//! The header is checked before the payload is read, and the whole packet before memory is written. A
//! packet is answered at its last byte, or at the first that is wrong: what follows never changes its
//! outcome, so the outcome does not depend on how the bytes were cut.
//!
//! After the last reply, the listener reads until the peer closes, for a limited time
//! (`connections/closing.rs`). What it reads behind an accepted packet is counted, because its sender does
//! not speak this protocol: its packet may mean something else.

use std::collections::HashMap;
use std::future::poll_fn;
use std::io::{Read, Write as _};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::task::ready;
use std::time::Duration;

use holdfast_memory::{Access, Area, Memory, Operation, Outcome, Refusal as MemoryRefusal, Write};
use holdfast_protocol::raw_ingest::{DONE, Format, Header, REFUSED, Refusal};
use ipnet::IpNet;
use socket2::SockRef;
use tokio::net::TcpStream;
use tokio::sync::{oneshot, watch};
use tokio::task::yield_now;
use tokio::time::{Instant, timeout_at};

use crate::raw_ingest_areas::of_packet;

use crate::server::connections::admission::{ConnectionLimits, Ticket};
use crate::server::connections::closing::drain;
use crate::server::connections::listener::{
    Admitted, KEEPALIVE, ListenerContext, Service, Serving, set_tcp_options,
};
use crate::server::connections::peer::Peer;
use crate::server::connections::reloadable::Reloadable;
use crate::server::connections::worker_share::{self, Share, WORK_OF_READ};
use crate::server::reports::audit::{Permit, Record, Written};
use crate::server::reports::counters::PacketCounters;
use crate::server::reports::event::Kind;
use crate::server::rights::policy::{Grants, PolicyEntry};
use crate::server::transports::raw_ingest_buffer::Incoming;
use crate::server::transports::secure::secured;
use crate::server::transports::stream::{self, End, Stream, send_all};
use crate::tls::server::ServerTls;

/// Bytes per read of a new connection.
const CHUNK_BYTES: usize = 16 * 1024;

/// The most packets of one connection that are answered before other tasks run.
const PACKETS_PER_TURN: usize = 64;

/// What peers from some networks can write.
#[derive(Debug, Clone)]
pub struct RawRule {
    pub sources: Vec<IpNet>,
    /// The roles that a rule applies to, as in the rules of Modbus listeners.
    pub roles: Option<Vec<String>>,
    /// The memory of each unit id (v1) or memory id (crc).
    pub targets: Vec<(u16, Arc<Memory>)>,
    pub areas: Vec<Area>,
}

/// A listener for Raw Ingest packets.
#[derive(Debug, Clone)]
pub struct RawSettings {
    /// With port 0, the system picks a port. `[::]` also accepts IPv4 connections.
    pub bind: SocketAddr,
    pub format: Format,
    pub flags: Flags,
    pub rules: Vec<RawRule>,
    pub limits: ConnectionLimits,
    /// The longest time from the start of a connection to the last byte of its packet. With TLS also
    /// for the handshake, before that.
    pub request_timeout: Duration,
    pub packets: PacketsPerConnection,
    /// `None` is plain TCP.
    pub tls: Option<Arc<ServerTls>>,
}

/// What flags and the reserved byte of a packet of format crc may be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Flags {
    /// Only 0.
    Strict,
    /// Anything.
    Ignore,
}

/// How many packets a connection carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PacketsPerConnection {
    One,
    /// Any number, until the peer closes. A connection ends after this time without a packet.
    Many {
        idle: Duration,
        after_refusal: AfterRefusal,
    },
}

/// What follows a packet whose header is valid, but that may not be written as it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AfterRefusal {
    /// The connection ends.
    Close,
    /// The next packet.
    Continue,
}

/// What a listener takes for a packet, and what may follow it. A connection keeps it to its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Dialect {
    /// Decides also what the numbers of the targets mean.
    format: Format,
    flags: Flags,
    /// `None` if a connection carries one packet.
    after_refusal: Option<AfterRefusal>,
}

#[derive(Debug)]
pub(crate) struct RawGrant {
    dialect: Dialect,
    targets: HashMap<u16, Arc<Memory>>,
    areas: Vec<Area>,
}

#[derive(Debug)]
pub(crate) struct RawIngest {
    pub(crate) packets: Arc<PacketCounters>,
    policy: Grants<RawGrant>,
    tls: Option<Arc<ServerTls>>,
    dialect: Dialect,
    request_timeout: Duration,
    /// The longest time without a packet, of a connection that carries many.
    idle: Duration,
}

/// The state of a packet that is being received.
enum Packet<'p> {
    /// At least this many bytes are missing.
    Incomplete {
        missing: usize,
    },
    Whole {
        header: Header,
        memory: &'p Memory,
        payload: &'p [u8],
    },
}

/// A connection of a sender.
pub(crate) struct Sending<S> {
    stream: S,
    peer: Peer,
    rights: Arc<RawGrant>,
    /// Bytes that were received and not answered.
    bytes: Incoming,
    /// Bytes that the system has not accepted yet.
    unsent: Vec<u8>,
    ticket: Ticket,
    share: Share,
}

/// Bytes behind an accepted packet. They are counted as they arrive, and reported when their connection
/// ends, also if another one needs its place.
struct Surplus<'a> {
    packets: &'a PacketCounters,
    context: &'a ListenerContext,
    peer: &'a Peer,
    bytes: u64,
}

impl Surplus<'_> {
    fn add(&mut self, count: usize) {
        self.packets.surplus_bytes.add_many(count as u64);
        self.bytes += count as u64;
    }
}

impl Drop for Surplus<'_> {
    fn drop(&mut self) {
        if self.bytes > 0 {
            self.context.report(Kind::SurplusBytes(self.bytes), Some(self.peer.clone()));
        }
    }
}

impl<S: Stream> Sending<S> {
    /// Reads once, at most about `most` bytes, when the source may work. Returns their number, which can
    /// be 0.
    async fn read(&mut self, most: usize) -> Result<usize, End> {
        let Sending { stream, bytes, unsent, share, .. } = self;
        poll_fn(|context| {
            ready!(share.poll(context));
            let read = bytes.poll_read(context, (stream, unsent), most);
            if read.is_ready() {
                share.charge(WORK_OF_READ);
            }
            share.pass_on();
            read
        })
        .await
    }

    /// Whether part of a packet has arrived.
    fn is_amid_packet(&self) -> bool {
        !self.bytes.is_empty() || self.stream.is_amid_record()
    }

    /// Announces the end, if nothing was cut off before.
    fn end(&mut self) {
        if self.unsent.is_empty() {
            self.stream.end(&mut self.unsent);
        }
        let _ = stream::flush_now(self.stream.socket(), &mut self.unsent);
    }
}

/// Looks up the rights of a connection again; `None` if it has none any more.
pub(crate) type Renewal = Box<dyn Fn() -> Option<Arc<RawGrant>> + Send + Sync>;

impl RawIngest {
    pub(crate) fn new(settings: &RawSettings, packets: Arc<PacketCounters>) -> RawIngest {
        let (idle, after_refusal) = match settings.packets {
            PacketsPerConnection::One => (Duration::ZERO, None),
            PacketsPerConnection::Many { idle, after_refusal } => (idle, Some(after_refusal)),
        };
        let dialect = Dialect { format: settings.format, flags: settings.flags, after_refusal };
        let rules = settings.rules.iter().map(|rule| {
            let targets = rule.targets.iter().cloned().collect();
            let rights = Arc::new(RawGrant { dialect, targets, areas: rule.areas.clone() });
            PolicyEntry { sources: rule.sources.clone(), roles: rule.roles.clone(), rights }
        });
        let nobody = RawGrant { dialect, targets: HashMap::new(), areas: Vec::new() };
        RawIngest {
            packets,
            policy: Grants { entries: rules.collect(), nobody: Arc::new(nobody) },
            tls: settings.tls.clone(),
            dialect,
            request_timeout: settings.request_timeout,
            idle,
        }
    }

    fn header(&self, bytes: &[u8]) -> Result<Option<Header>, Refusal> {
        let Dialect { format, flags, .. } = self.dialect;
        match flags {
            Flags::Strict => format.header(bytes),
            Flags::Ignore => format.header_with_any_flags(bytes),
        }
    }

    /// Refuses the packet that a connection begins with: no rule names its peer.
    pub(crate) async fn refuse_peer(
        &self,
        context: &ListenerContext,
        (mut stream, peer): (TcpStream, SocketAddr),
        packet: &[u8],
        stop: watch::Receiver<bool>,
    ) {
        self.refuse(context, &peer.into(), packet, Refusal::NotGranted);
        let _ = (&*SockRef::from(&stream)).write(&[REFUSED]);
        drain(&mut stream, stop, |_| ()).await;
        context.ended(Kind::Closed, peer);
    }

    /// The connection of a sender over plain TCP.
    pub(crate) fn sending(&self, admitted: Admitted<RawGrant>) -> Sending<TcpStream> {
        let Admitted { stream, peer, rights, received, ticket } = admitted;
        self.begin((stream, peer.into()), rights, &received, ticket)
    }

    fn begin<S: Stream>(
        &self,
        (stream, peer): (S, Peer),
        rights: Arc<RawGrant>,
        received: &[u8],
        ticket: Ticket,
    ) -> Sending<S> {
        let mut bytes = Incoming::new(Arc::clone(&self.packets));
        bytes.extend(received);
        let share = Share::of(&peer);
        Sending { stream, peer, rights, bytes, unsent: Vec::new(), ticket, share }
    }

    /// Serves a connection to its end.
    async fn receive_all(
        self: Arc<Self>,
        live: Arc<Reloadable<RawIngest>>,
        context: Arc<ListenerContext>,
        connection: Admitted<RawGrant>,
        stop: watch::Receiver<bool>,
    ) {
        if let Some(tls) = &self.tls {
            set_tcp_options(&connection.stream, KEEPALIVE);
            // In a box of its own, so that plain connections do not reserve memory for it.
            return Box::pin(self.secure(tls, live, context, connection, stop)).await;
        }
        if connection.ticket.is_answered() {
            let Admitted { mut stream, peer, received, ticket, .. } = connection;
            let from = (&mut stream, &peer.into());
            self.drain_surplus(&context, from, received.len(), stop).await;
            context.ended(Kind::Closed, peer);
            return drop(ticket);
        }
        let peer = connection.peer.ip();
        let renewal = Box::new(move || live.get().rights(peer));
        self.serve_packets(context, self.sending(connection), renewal, stop).await;
    }

    /// Performs the handshake, selects the rights by the role in the certificate, and serves the
    /// connection.
    async fn secure(
        &self,
        tls: &ServerTls,
        live: Arc<Reloadable<RawIngest>>,
        context: Arc<ListenerContext>,
        admitted: Admitted<RawGrant>,
        stop: watch::Receiver<bool>,
    ) {
        let Admitted { stream, peer, ticket, .. } = admitted;
        let (time_limit, stopping) = (self.request_timeout, stop.clone());
        let secured = secured(tls, &context, (stream, peer), &ticket, time_limit, stopping).await;
        let Some((stream, peer)) = secured else { return };
        if context.end_after_reload((self, &*live.get()), (&ticket, &peer), Service::ends) {
            return;
        }
        // A reload reviews connections by their roles. This one looks up its rights only now.
        let rights = live.get().policy.by_certificate(&peer).unwrap_or_else(|nobody| {
            context.report(Kind::RefusedRole, Some(peer.clone()));
            nobody
        });
        let by_role = peer.clone();
        let renewal = Box::new(move || {
            Some(live.get().policy.by_certificate(&by_role).unwrap_or_else(|nobody| nobody))
        });
        let sending = self.begin((stream, peer), rights, &[], ticket);
        self.serve_packets(context, sending, renewal, stop).await;
    }

    /// Checks the bytes received so far, up to the end of the first packet.
    fn judge<'p>(&self, rights: &'p RawGrant, bytes: &'p [u8]) -> Result<Packet<'p>, Refusal> {
        let Dialect { format, after_refusal, .. } = self.dialect;
        let Some(header) = self.header(bytes)? else {
            let missing = format.header_len().saturating_sub(bytes.len()).max(1);
            return Ok(Packet::Incomplete { missing });
        };
        let target = self.target(rights, &header);
        if after_refusal != Some(AfterRefusal::Continue) {
            target?;
        }
        let missing = format.packet_len(&header).saturating_sub(bytes.len());
        if missing > 0 {
            return Ok(Packet::Incomplete { missing });
        }
        // Where the next packet follows, this comes first: a wrong CRC leaves unknown where that begins.
        let payload = format.payload(&header, bytes)?;
        Ok(Packet::Whole { header, memory: target?, payload })
    }

    /// The memory that a packet with this header writes.
    fn target<'p>(&self, rights: &'p RawGrant, header: &Header) -> Result<&'p Memory, Refusal> {
        if rights.areas.is_empty() {
            return Err(Refusal::NotGranted);
        }
        let unmapped = match self.dialect.format {
            Format::V1 => Refusal::Unit,
            Format::Crc { .. } => Refusal::Memory,
        };
        let memory = rights.targets.get(&header.target).ok_or(unmapped)?;
        let area = of_packet(header.area);
        if !rights.areas.contains(&area) {
            return Err(Refusal::NotGranted);
        }
        if !memory.span(area).holds(header.address, header.count.get().into()) {
            return Err(Refusal::Range);
        }
        Ok(memory)
    }

    /// Writes a complete packet, atomically. Waits for the journal of the memory, if it has one.
    async fn write(
        &self,
        context: &ListenerContext,
        peer: &Peer,
        packet: (Header, &Memory, &[u8]),
    ) -> Result<(), Refusal> {
        let (header, memory, payload) = packet;
        if !memory.has_journal() {
            return self.write_at_once(context, peer, packet);
        }
        let permit = context.permit_packet(payload).ok_or(Refusal::Unrecorded)?;
        let (done, outcome) = oneshot::channel();
        let packets = Arc::clone(&self.packets);
        let recording = context
            .auditor
            .clone()
            .map(|auditor| (auditor, self.record(context, peer, (Some(header), payload), None)));
        // Counted and recorded by the journal's thread: the connection may have ended meanwhile.
        let kept = Box::new(move |outcome: Outcome| {
            if let Ok(carried_out) = &outcome {
                packets.accept(&header);
                if let Some((auditor, record)) = recording {
                    let log_sequence = carried_out.sequence;
                    auditor.send(Record { log_sequence, ..record }, permit);
                }
            }
            let _ = done.send(outcome);
        });
        memory
            .submit(Access::Ingest, Operation::Write(&[writing(&header, payload)]), kept)
            .map_err(refusal)?;
        let outcome = outcome.await.map_err(|_| Refusal::NotConfirmed)?;
        outcome.map(|_| ()).map_err(|refused| refusal(refused.refusal))
    }

    /// Writes a complete packet to a memory without a journal.
    fn write_at_once(
        &self,
        context: &ListenerContext,
        peer: &Peer,
        (header, memory, payload): (Header, &Memory, &[u8]),
    ) -> Result<(), Refusal> {
        debug_assert!(!memory.has_journal(), "a journal would block the thread");
        let permit = context.permit_packet(payload).ok_or(Refusal::Unrecorded)?;
        memory.write(Access::Ingest, writing(&header, payload)).map_err(refusal)?;
        self.packets.accept(&header);
        self.audit(context, peer, (Some(header), payload), Ok(permit));
        Ok(())
    }

    /// Looks up the rights of a connection again after a reload. Goes no further if the connection has been ended.
    async fn renew<S>(&self, sending: &mut Sending<S>, renewal: &Renewal) -> Result<(), Kind> {
        if poll_fn(|_| sending.ticket.poll_outdated()).await {
            let renewed = renewal().filter(|rights| rights.dialect == self.dialect);
            sending.rights = renewed.ok_or(Kind::RightsRevoked)?;
        }
        Ok(())
    }

    /// Receives a packet. The inner error is a refusal; the outer one says why no reply is due.
    async fn receive<S: Stream>(
        &self,
        sending: &mut Sending<S>,
        renewal: &Renewal,
        mut stop: watch::Receiver<bool>,
    ) -> Result<Result<(), Refusal>, Kind> {
        let deadline = Instant::now() + self.request_timeout;
        loop {
            sending.ticket.set_amid_exchange(sending.is_amid_packet());
            self.renew(sending, renewal).await?;
            let missing = match self.judge(&sending.rights, &sending.bytes) {
                Ok(Packet::Incomplete { missing }) => missing,
                Ok(Packet::Whole { .. }) => return Ok(Ok(())),
                Err(refusal) => return Ok(Err(refusal)),
            };
            let read = tokio::select! {
                read = timeout_at(deadline, sending.read(missing)) => read,
                _ = stop.wait_for(|stop| *stop) => return Err(Kind::Closed),
            };
            match read {
                Err(_) if sending.bytes.is_empty() => return Err(Kind::RequestTimeout),
                Err(_) => return Ok(Err(Refusal::Late)),
                Ok(Err(End::ByPeer)) if !sending.bytes.is_empty() => {
                    return Ok(Err(Refusal::Short));
                }
                Ok(Err(end)) => return Err(end.into()),
                Ok(Ok(_)) => self.flush(sending).await?,
            }
        }
    }

    /// Serves the packets of a connection to its end.
    pub(crate) async fn serve_packets<S: Stream>(
        &self,
        context: Arc<ListenerContext>,
        mut sending: Sending<S>,
        renewal: Renewal,
        stop: watch::Receiver<bool>,
    ) {
        if self.dialect.after_refusal.is_some() {
            return self.serve_many(context, sending, renewal, stop).await;
        }
        let judged = match self.receive(&mut sending, &renewal, stop.clone()).await {
            Err(end) => {
                context.ended(end, sending.peer.clone());
                return sending.end();
            }
            Ok(judged) => judged,
        };
        let mut behind = 0;
        let written = match judged.and_then(|()| self.judge(&sending.rights, &sending.bytes)) {
            Ok(Packet::Whole { header, memory, payload }) => {
                behind = sending.bytes.len() - self.dialect.format.packet_len(&header);
                self.write(&context, &sending.peer, (header, memory, payload)).await
            }
            Ok(Packet::Incomplete { .. }) => Err(Refusal::Short),
            Err(refusal) => Err(refusal),
        };
        sending.share.charge(worker_share::packet(sending.bytes.len() - behind));
        sending.ticket.set_amid_exchange(false);
        if let Err(refusal) = written {
            self.refuse(&context, &sending.peer, &sending.bytes, refusal);
            sending.bytes.clear();
            if refusal == Refusal::NotConfirmed {
                context.ended(Kind::Closed, sending.peer.clone());
                return sending.end();
            }
            answer(&mut sending.stream, &mut sending.unsent, &sending.ticket, REFUSED);
            drain(&mut sending.stream, stop, |_| ()).await;
        } else {
            sending.bytes.clear();
            answer(&mut sending.stream, &mut sending.unsent, &sending.ticket, DONE);
            self.drain_surplus(&context, (&mut sending.stream, &sending.peer), behind, stop).await;
        }
        context.ended(Kind::Closed, sending.peer);
        drop(sending.ticket);
    }

    /// Reads and counts what follows the only packet of a connection, which was written. `received`
    /// bytes of it were already read.
    async fn drain_surplus<S: Stream>(
        &self,
        context: &ListenerContext,
        (stream, peer): (&mut S, &Peer),
        received: usize,
        stop: watch::Receiver<bool>,
    ) {
        let mut surplus = Surplus { packets: &self.packets, context, peer, bytes: 0 };
        surplus.add(received);
        drain(stream, stop, |len| surplus.add(len)).await;
    }

    /// Serves packets one after another.
    async fn serve_many<S: Stream>(
        &self,
        context: Arc<ListenerContext>,
        mut sending: Sending<S>,
        renewal: Renewal,
        mut stop: watch::Receiver<bool>,
    ) {
        let (mut end, mut begun, mut accepted) = (Kind::Closed, Instant::now(), false);
        // The packets that were answered end here.
        let mut answered = 0;
        let mut packets: usize = 0;
        loop {
            if let Err(revoked) = self.renew(&mut sending, &renewal).await {
                end = revoked;
                break;
            }
            let waiting = &sending.bytes[answered..];
            let first = self.first_of(&context, &sending.peer, &sending.rights, waiting).await;
            let refusal = match first {
                Ok(Some((len, reply))) => {
                    answered += len;
                    accepted |= reply == DONE;
                    begun = Instant::now();
                    sending.ticket.touch(begun.into_std());
                    if let Err(slow) = self.reply(&mut sending, reply).await {
                        end = slow;
                        break;
                    }
                    sending.share.charge(worker_share::packet(len));
                    sending.share.come().await;
                    begun = Instant::now();
                    packets += 1;
                    if packets.is_multiple_of(PACKETS_PER_TURN) {
                        yield_now().await;
                    }
                    continue;
                }
                Ok(None) => {
                    sending.bytes.consume(answered);
                    answered = 0;
                    let was_empty = !sending.is_amid_packet();
                    sending.ticket.set_amid_exchange(!was_empty);
                    let time_limit = if was_empty { self.idle } else { self.request_timeout };
                    let read = tokio::select! {
                        read = timeout_at(begun + time_limit, sending.read(usize::MAX)) => read,
                        _ = stop.wait_for(|stop| *stop) => break,
                    };
                    match read {
                        Ok(Ok(_)) => {
                            if was_empty {
                                begun = Instant::now();
                            }
                            sending.ticket.set_amid_exchange(sending.is_amid_packet());
                            if let Err(slow) = self.flush(&mut sending).await {
                                end = slow;
                                break;
                            }
                            // A sender that never pauses leaves time for other connections.
                            yield_now().await;
                            continue;
                        }
                        Ok(Err(End::ByPeer)) if !sending.bytes.is_empty() => Refusal::Short,
                        Ok(Err(ended)) => {
                            end = ended.into();
                            break;
                        }
                        Err(_) if was_empty => {
                            end = Kind::Idle;
                            break;
                        }
                        Err(_) if sending.bytes.is_empty() => {
                            end = Kind::RequestTimeout;
                            break;
                        }
                        Err(_) => Refusal::Late,
                    }
                }
                Err(refusal) => refusal,
            };
            sending.ticket.set_amid_exchange(false);
            self.refuse(&context, &sending.peer, &sending.bytes[answered..], refusal);
            sending.bytes.clear();
            answered = 0;
            if refusal == Refusal::NotConfirmed {
                break;
            }
            sending.ticket.set_answered();
            let _ = self.reply(&mut sending, REFUSED).await;
            sending.end();
            drain(&mut sending.stream, stop, |_| ()).await;
            break;
        }
        if accepted {
            self.drop_bytes(&context, &sending.peer, sending.bytes.len() - answered);
        }
        context.ended(end, sending.peer.clone());
        sending.end();
    }

    /// Replies to one of several packets. Packets of a peer that has left are still written: it may
    /// not wait for replies.
    async fn reply<S: Stream>(&self, sending: &mut Sending<S>, reply: u8) -> Result<(), Kind> {
        match sending.stream.send(&[reply], &mut sending.unsent) {
            Ok(()) => self.flush(sending).await,
            Err(_) => Ok(()),
        }
    }

    /// Waits until the system has accepted what was sent, unless the peer has left.
    async fn flush<S: Stream>(&self, sending: &mut Sending<S>) -> Result<(), Kind> {
        if sending.unsent.is_empty() {
            return Ok(());
        }
        let Sending { stream, unsent, .. } = sending;
        let sent = send_all(stream.socket(), unsent, self.request_timeout).await;
        *unsent = Vec::new();
        match sent {
            Err(Kind::SlowReader) => Err(Kind::SlowReader),
            _ => Ok(()),
        }
    }

    /// Writes the packet that `bytes` begin with. Returns its length and the reply, `None` while more
    /// bytes are needed, and the refusal that ends the connection.
    async fn first_of(
        &self,
        context: &ListenerContext,
        peer: &Peer,
        rights: &RawGrant,
        bytes: &[u8],
    ) -> Result<Option<(usize, u8)>, Refusal> {
        let Some(header) = self.header(bytes)? else {
            return Ok(None);
        };
        let len = self.dialect.format.packet_len(&header);
        let packet = bytes.get(..len).unwrap_or(bytes);
        let written = match self.judge(rights, packet) {
            Ok(Packet::Incomplete { .. }) => return Ok(None),
            Ok(Packet::Whole { header, memory, payload }) => {
                self.write(context, peer, (header, memory, payload)).await
            }
            Err(refusal) => Err(refusal),
        };
        match written {
            Ok(()) => Ok(Some((len, DONE))),
            // The packet ends where its header says, so the next one can be found.
            Err(
                refusal @ (Refusal::Unit
                | Refusal::Memory
                | Refusal::NotGranted
                | Refusal::Range
                | Refusal::Unrecorded
                | Refusal::NotStored
                | Refusal::Busy
                | Refusal::TooLarge),
            ) if self.dialect.after_refusal == Some(AfterRefusal::Continue) => {
                self.refuse(context, peer, packet, refusal);
                Ok(Some((len, REFUSED)))
            }
            Err(refusal) => Err(refusal),
        }
    }

    /// Counts and reports bytes behind accepted packets that began another one, which did not arrive.
    fn drop_bytes(&self, context: &ListenerContext, peer: &Peer, count: usize) {
        if count > 0 {
            self.packets.dropped_bytes.add_many(count as u64);
            context.report(Kind::BytesDropped(count as u64), Some(peer.clone()));
        }
    }

    fn refuse(&self, context: &ListenerContext, peer: &Peer, packet: &[u8], refusal: Refusal) {
        self.packets.refuse(refusal);
        context.report(Kind::PacketRefused(refusal), Some(peer.clone()));
        let header = self.header(packet).ok().flatten();
        self.audit(context, peer, (header, &[]), Err(refusal));
    }

    /// Records a packet that was carried out or refused.
    fn audit(
        &self,
        context: &ListenerContext,
        peer: &Peer,
        packet: (Option<Header>, &[u8]),
        outcome: Result<Permit, Refusal>,
    ) {
        if let Some(auditor) = &context.auditor {
            let record = self.record(context, peer, packet, outcome.as_ref().err().copied());
            match outcome {
                Ok(permit) => auditor.send(record, permit),
                // It may still be carried out.
                Err(Refusal::NotConfirmed) => auditor.send(record, Permit::default()),
                Err(_) => auditor.refuse(record),
            }
        }
    }

    fn record(
        &self,
        context: &ListenerContext,
        peer: &Peer,
        (header, payload): (Option<Header>, &[u8]),
        refused: Option<Refusal>,
    ) -> Record {
        let (format, payload) = (self.dialect.format, payload.to_vec());
        let write = Written::Packet { format, header, payload, refused };
        let (listener, peer) = (Arc::clone(&context.name), Some(peer.clone()));
        Record { listener, peer, write, log_sequence: None, refusals: 0 }
    }
}

impl Service for RawIngest {
    type PeerRights = RawGrant;

    fn rights(&self, peer: IpAddr) -> Option<Arc<RawGrant>> {
        self.policy.rights(peer, None)
    }

    /// Most packets have arrived when their connection is accepted: they are answered before a task
    /// begins.
    fn serve_at_once(
        &self,
        context: &ListenerContext,
        mut connection: Admitted<RawGrant>,
    ) -> Admitted<RawGrant> {
        if self.dialect.after_refusal.is_some() || self.tls.is_some() {
            return connection;
        }
        let mut chunk = [0; CHUNK_BYTES];
        let Ok(len) = (&*SockRef::from(&connection.stream)).read(&mut chunk) else {
            return connection;
        };
        let mut bytes = &chunk[..len];
        // A reload may have taken place since it was accepted: then its task looks up its rights, or ends.
        if connection.ticket.is_current()
            && let Ok(Packet::Whole { header, memory, payload }) =
                self.judge(&connection.rights, bytes)
            && !memory.has_journal()
            && self
                .write_at_once(context, &connection.peer.into(), (header, memory, payload))
                .is_ok()
        {
            bytes = &bytes[self.dialect.format.packet_len(&header)..];
            answer(&mut connection.stream, &mut Vec::new(), &connection.ticket, DONE);
        } else {
            connection.ticket.set_amid_exchange(len > 0);
        }
        connection.received = bytes.to_vec();
        connection
    }

    fn ends(&self, before: &RawIngest, peer: &Peer) -> Option<Kind> {
        let is_other = self.dialect != before.dialect || self.tls.is_some() != before.tls.is_some();
        if is_other || self.rights(peer.ip()).is_none() {
            return Some(Kind::RightsRevoked);
        }
        let (tls, certificate) = (self.tls.as_ref()?, peer.certificate.as_ref()?);
        if let Err(failure) = tls.judge(certificate) {
            return Some(Kind::TlsFailed(failure.reason()));
        }
        // A sender that never had rights keeps its refusals.
        let had_rights = before.policy.by_certificate(peer).is_ok();
        (had_rights && self.policy.by_certificate(peer).is_err()).then_some(Kind::RightsRevoked)
    }

    fn serve(
        self: Arc<Self>,
        live: Arc<Reloadable<Self>>,
        context: Arc<ListenerContext>,
        connection: Admitted<RawGrant>,
        stop: watch::Receiver<bool>,
    ) -> Serving {
        Box::pin(self.receive_all(live, context, connection, stop))
    }
}

fn writing<'p>(header: &Header, payload: &'p [u8]) -> Write<'p> {
    let (area, count) = (of_packet(header.area), usize::from(header.count.get()));
    Write { area, address: header.address, count, bytes: payload }
}

fn refusal(refused: MemoryRefusal) -> Refusal {
    match refused {
        MemoryRefusal::Unavailable
        | MemoryRefusal::NotStored
        | MemoryRefusal::Stale
        | MemoryRefusal::Overtaken
        | MemoryRefusal::Behind
        | MemoryRefusal::Differs => Refusal::NotStored,
        MemoryRefusal::NotConfirmed => Refusal::NotConfirmed,
        MemoryRefusal::Busy => Refusal::Busy,
        MemoryRefusal::TooLarge { .. } => Refusal::TooLarge,
        _ => Refusal::Range,
    }
}

/// Sends the last reply of a connection and announces the end, without waiting. From now on, the
/// connection is only open so that the reply is not lost.
fn answer<S: Stream>(stream: &mut S, unsent: &mut Vec<u8>, ticket: &Ticket, reply: u8) {
    // First, because a sender that has its reply may expect a place for its next packet.
    ticket.set_answered();
    if stream.send(&[reply], unsent).is_ok() {
        stream.end(unsent);
        let _ = stream::flush_now(stream.socket(), unsent);
    }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;
    use std::io::Write as _;
    use std::net::TcpListener;
    use std::num::NonZeroU16;
    use std::sync::Mutex;
    use std::task::{Context, Poll};

    use holdfast_memory::{Layout, Span};
    use holdfast_protocol::raw_ingest::Area as PacketArea;
    use holdfast_runtime::Counter;
    use tokio::runtime::Runtime;

    use super::*;
    use crate::server::connections::admission::Admission;
    use crate::server::reports::event::{self, Verbosity};
    use crate::server::transports::cut_tests::assert_same_outcome;

    fn listener(format: Format, flags: Flags) -> RawIngest {
        listener_with(((format, flags), PacketsPerConnection::One))
    }

    fn listener_with(((format, flags), packets): Terms) -> RawIngest {
        let settings = RawSettings {
            bind: SocketAddr::from(([127, 0, 0, 1], 0)),
            format,
            flags,
            rules: Vec::new(),
            limits: ConnectionLimits::NONE,
            request_timeout: Duration::from_secs(10),
            packets,
            tls: None,
        };
        RawIngest::new(&settings, Arc::default())
    }

    /// An admitted connection, with bytes that were already read.
    fn admitted(
        accepted: std::net::TcpStream,
        peer: SocketAddr,
        received: Vec<u8>,
    ) -> Admitted<RawGrant> {
        accepted.set_nonblocking(true).unwrap();
        let limits = ConnectionLimits { max_connections: 1, ..ConnectionLimits::NONE };
        let (ticket, _) = Arc::new(Admission::new(limits)).admit(peer).unwrap();
        let stream = TcpStream::from_std(accepted).unwrap();
        Admitted { stream, peer, rights: Arc::new(rights()), received, ticket }
    }

    /// The rights to write 8 registers of unit 1.
    fn rights() -> RawGrant {
        let layout = Layout::default().with(Area::HoldingRegisters, Span::new(0, 8).unwrap());
        let memory = Arc::new(Memory::new(layout, None).unwrap());
        let targets = HashMap::from([(1, memory)]);
        let dialect = listener(Format::V1, Flags::Strict).dialect;
        RawGrant { dialect, targets, areas: vec![Area::HoldingRegisters] }
    }

    /// Both ends of a connection.
    fn connected() -> (std::net::TcpStream, std::net::TcpStream, SocketAddr) {
        let bound = TcpListener::bind("127.0.0.1:0").unwrap();
        let client = std::net::TcpStream::connect(bound.local_addr().unwrap()).unwrap();
        let (accepted, peer) = bound.accept().unwrap();
        (client, accepted, peer)
    }

    #[test]
    fn a_sender_that_does_not_read_its_replies_is_given_up_on() {
        let mut runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = runtime.enable_all().build().unwrap();
        let _guard = runtime.enter();
        let (client, accepted, peer) = connected();
        let mut raw = listener(Format::V1, Flags::Strict);
        raw.request_timeout = Duration::from_millis(50);
        let mut sending = raw.sending(admitted(accepted, peer, Vec::new()));
        while (&*SockRef::from(&sending.stream)).write(&[DONE; CHUNK_BYTES]).is_ok() {}
        assert_eq!(runtime.block_on(raw.reply(&mut sending, DONE)), Err(Kind::SlowReader));
        // A connection that is gone can't receive replies, but that is no reason to stop.
        drop(client);
        while (&*SockRef::from(&sending.stream)).write(&[DONE]).is_ok() {}
        assert_eq!(runtime.block_on(raw.reply(&mut sending, DONE)), Ok(()));
    }

    #[test]
    fn other_tasks_run_between_many_packets_that_arrive_together() {
        const PACKETS: usize = 20 * PACKETS_PER_TURN;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let _guard = runtime.enter();
        let (client, accepted, peer) = connected();
        let packet = b"RI\x01\x03\x00\x01\x00\x00\x00\x01\x00\x07";
        let context = Arc::new(ListenerContext::for_tests());
        client.shutdown(std::net::Shutdown::Write).unwrap();
        let raw = listener_with(((Format::V1, Flags::Strict), MANY));
        let sending = raw.sending(admitted(accepted, peer, packet.repeat(PACKETS)));
        let (_engine, stop) = watch::channel(false);
        let mut turns = 0;
        runtime.block_on(async {
            let serving = raw.serve_many(context, sending, Box::new(|| None), stop);
            tokio::select! {
                biased;
                () = serving => {}
                () = async { loop { turns += 1; yield_now().await } } => unreachable!(),
            }
        });
        assert_eq!(raw.packets.accepted.get(), PACKETS as u64);
        assert!(turns >= PACKETS / PACKETS_PER_TURN, "{turns} turns");
    }

    #[test]
    fn a_packet_waits_for_one_share_of_another_source() {
        const CONNECTIONS: u16 = 16;
        const PACKETS: usize = PACKETS_PER_TURN - 1;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let packet = b"RI\x01\x03\x00\x01\x00\x00\x00\x01\x00\x07";
        let context = Arc::new(ListenerContext::for_tests());
        let raw = Arc::new(listener_with(((Format::V1, Flags::Strict), MANY)));
        let (_engine, stop) = watch::channel(false);
        runtime.block_on(async {
            let mut clients = Vec::new();
            let mut serve = |peer: SocketAddr, packets: usize| {
                let (client, accepted, _) = connected();
                client.shutdown(std::net::Shutdown::Write).unwrap();
                clients.push(client);
                let sending = raw.sending(admitted(accepted, peer, packet.repeat(packets)));
                let (raw, context, stop) = (Arc::clone(&raw), Arc::clone(&context), stop.clone());
                tokio::spawn(async move {
                    raw.serve_many(context, sending, Box::new(|| None), stop).await;
                    raw.packets.accepted.get()
                })
            };
            let flood: Vec<_> = (0..CONNECTIONS)
                .map(|port| serve(([192, 0, 2, 1], port).into(), PACKETS))
                .collect();
            let accepted = serve(([192, 0, 2, 2], 1).into(), 1).await.unwrap();
            // One share before the packet, and one before its sender is found to have left.
            assert!(accepted <= 1 + 3 * u64::from(worker_share::PACKETS_PER_ROUND), "{accepted}");
            for each in flood {
                each.await.unwrap();
            }
        });
        assert_eq!(raw.packets.accepted.get(), 1 + u64::from(CONNECTIONS) * PACKETS as u64);
    }

    /// A stream whose bytes arrive in these pieces. Then the peer closes its side.
    struct Pieces<'a> {
        pieces: VecDeque<&'a [u8]>,
        replies: Arc<Mutex<Vec<u8>>>,
        socket: &'a TcpStream,
    }

    impl Stream for Pieces<'_> {
        fn poll_read(
            &mut self,
            _context: &mut Context<'_>,
            input: &mut [u8],
            _unsent: &mut Vec<u8>,
        ) -> Poll<Result<usize, End>> {
            let Some(piece) = self.pieces.front_mut() else {
                return Poll::Ready(Err(End::ByPeer));
            };
            let (read, rest) = piece.split_at(piece.len().min(input.len()));
            input[..read.len()].copy_from_slice(read);
            *piece = rest;
            if rest.is_empty() {
                self.pieces.pop_front();
            }
            Poll::Ready(Ok(read.len()))
        }

        fn read_now(&mut self, _input: &mut [u8], _unsent: &mut Vec<u8>) -> Option<usize> {
            None
        }

        fn send(&mut self, output: &[u8], _unsent: &mut Vec<u8>) -> Result<(), Kind> {
            self.replies.lock().unwrap().extend_from_slice(output);
            Ok(())
        }

        fn socket(&self) -> &TcpStream {
            self.socket
        }
    }

    async fn unused_socket() -> TcpStream {
        let (_client, accepted, _) = connected();
        accepted.set_nonblocking(true).unwrap();
        TcpStream::from_std(accepted).unwrap()
    }

    /// A format, whether flags are ignored, how many packets a connection carries, and what follows a refusal.
    type Terms = ((Format, Flags), PacketsPerConnection);

    const MANY: PacketsPerConnection = many(AfterRefusal::Close);

    const fn many(after_refusal: AfterRefusal) -> PacketsPerConnection {
        PacketsPerConnection::Many { idle: Duration::from_secs(10), after_refusal }
    }

    fn terms() -> impl Iterator<Item = Terms> {
        let (crc, none) = (Format::Crc { required: true }, Format::Crc { required: false });
        let formats = [
            (Format::V1, Flags::Strict),
            (crc, Flags::Strict),
            (none, Flags::Strict),
            (none, Flags::Ignore),
        ];
        let packets = [PacketsPerConnection::One, MANY, many(AfterRefusal::Continue)];
        formats.into_iter().flat_map(move |format| packets.map(|packets| (format, packets)))
    }

    /// Packets that are written, refused for each reason, or cut short.
    fn cases(format: Format) -> Vec<Vec<u8>> {
        let packet = |area, target, address, values: &[u8]| {
            let count = NonZeroU16::new(values.len() as u16 / 2).unwrap();
            let (header, mut packet) = (Header { area, target, address, count }, vec![0; 64]);
            let len = format.encode_to_slice(&header, values, &mut packet).unwrap();
            packet.truncate(len);
            packet
        };
        let area = PacketArea::HoldingRegisters;
        let good = packet(area, 1, 3, &[0, 7, 0, 8]);
        let changed = |at: usize, byte| {
            let mut packet = good.clone();
            packet[at] = byte;
            packet
        };
        let header_len = format.header_len();
        // As an old sender has it: the length of the payload comes first.
        let mut shifted = good.clone();
        shifted.splice(header_len..header_len, [0, 4]);
        vec![
            good.clone(),
            packet(area, 1, 0, &[1, 2]),
            shifted,
            packet(area, 9, 0, &[1, 2]),
            packet(area, 1, 7, &[1, 2, 3, 4]),
            packet(PacketArea::InputRegisters, 1, 0, &[1, 2]),
            changed(0, 0x72),
            changed(1, 0),
            changed(2, 2),
            changed(3, 9),
            changed(4, 9),
            // Area and reserved byte are both wrong.
            [&good[..4], &[9, 1], &good[6..]].concat(),
            changed(header_len - 1, 0),
            changed(good.len() - 1, 0xEE),
            good[..good.len() - 1].to_vec(),
            good[..header_len - 2].to_vec(),
            b"RI\x01\x03\x00\x01\x00\x00\x00\x01\x00\x07".to_vec(),
            vec![0; 40],
        ]
    }

    /// What has come of a connection.
    fn outcome_of(raw: &RawIngest, replies: &[u8], memory: &Arc<Memory>) -> String {
        let PacketCounters { accepted, values, surplus_bytes, dropped_bytes, .. } = &*raw.packets;
        let counted = [accepted, values, surplus_bytes, dropped_bytes].map(Counter::get);
        let refused: Vec<_> = raw.packets.refused().collect();
        let contents = Memory::contents(std::slice::from_ref(memory));
        format!("{replies:?} {counted:?} {refused:?} {contents:?}")
    }

    /// What comes of the pieces of a connection. The first may have been read before it is served.
    fn outcome(
        terms: Terms,
        (runtime, socket): (&Runtime, &TcpStream),
        pieces: &[&[u8]],
        is_read: bool,
    ) -> String {
        let raw = listener_with(terms);
        let (read, pieces) = pieces.split_at(usize::from(is_read));
        let (replies, pieces) = (Arc::default(), pieces.iter().copied().collect());
        let stream = Pieces { pieces, replies: Arc::clone(&replies), socket };
        let peer = SocketAddr::from(([127, 0, 0, 1], 1));
        let limits = ConnectionLimits { max_connections: 1, ..ConnectionLimits::NONE };
        let (ticket, _) = Arc::new(Admission::new(limits)).admit(peer).unwrap();
        let rights = Arc::new(rights());
        let memory = Arc::clone(&rights.targets[&1]);
        let sending = raw.begin((stream, peer.into()), rights, &read.concat(), ticket);
        let (_engine, stop) = watch::channel(false);
        let context = Arc::new(ListenerContext::for_tests());
        runtime.block_on(raw.serve_packets(context, sending, Box::new(|| None), stop));
        outcome_of(&raw, &replies.lock().unwrap(), &memory)
    }

    #[test]
    fn packets_have_the_same_outcome_however_they_are_cut() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let socket = runtime.block_on(unused_socket());
        for terms in terms() {
            assert_same_outcome(&cases(terms.0.0), |pieces| {
                let [outcome, other] = [false, true]
                    .map(|is_read| outcome(terms, (&runtime, &socket), pieces, is_read));
                assert_eq!(outcome, other, "{pieces:02x?}, the first one read before");
                outcome
            });
        }
    }

    #[test]
    fn packets_that_have_arrived_when_they_are_accepted_have_the_same_outcome() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let socket = runtime.block_on(unused_socket());
        for terms in terms() {
            let cases = cases(terms.0.0);
            let joined =
                cases.iter().zip(&cases[1..]).map(|(case, next)| [&case[..], next].concat());
            for sent in cases.iter().cloned().chain(joined) {
                let expected = outcome(terms, (&runtime, &socket), &[&sent], false);
                let found = runtime.block_on(arrived(listener_with(terms), &sent));
                assert_eq!(found, expected, "{sent:02x?}");
            }
        }
    }

    /// What a damaged packet says of its length may be wrong: what follows it would be judged, and
    /// answered, as other packets than it was sent as.
    #[test]
    fn a_wrong_crc_ends_a_connection_whatever_else_is_wrong() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let socket = runtime.block_on(unused_socket());
        let format = Format::Crc { required: true };
        let (count, area) = (NonZeroU16::MIN, PacketArea::HoldingRegisters);
        let mut good = [0; 18];
        let header = Header { area, target: 1, address: 0, count };
        format.encode_to_slice(&header, &[0, 7], &mut good).unwrap();
        let sent = good.repeat(4);
        let wrong_area = PacketArea::InputRegisters.code();
        // The area is not granted, there is no such memory, and two packets more than it are out of range.
        for (at, byte) in [(4, wrong_area), (7, 2), (11, 1 + 18)] {
            let mut sent = sent.clone();
            sent[at] = byte;
            let terms = ((format, Flags::Strict), many(AfterRefusal::Continue));
            let found = outcome(terms, (&runtime, &socket), &[&sent], false);
            assert!(found.starts_with("[1] [0, 0, 0, 0] [(Crc, 1)]"), "{at}: {found}");
        }
    }

    /// What comes of bytes that have arrived when their connection is accepted.
    async fn arrived(raw: RawIngest, sent: &[u8]) -> String {
        let (mut client, accepted, peer) = connected();
        client.write_all(sent).unwrap();
        client.shutdown(std::net::Shutdown::Write).unwrap();
        while accepted.peek(&mut vec![0; sent.len()]).unwrap() < sent.len() {}
        let connection = admitted(accepted, peer, Vec::new());
        let memory = Arc::clone(&connection.rights.targets[&1]);
        let live = Arc::new(Reloadable::new(raw));
        let (raw, context) = (live.get(), Arc::new(ListenerContext::for_tests()));
        let (_engine, stop) = watch::channel(false);
        let connection = raw.serve_at_once(&context, connection);
        Arc::clone(&raw).serve(live, context, connection, stop).await;
        let mut replies = Vec::new();
        client.read_to_end(&mut replies).unwrap();
        outcome_of(&raw, &replies, &memory)
    }

    #[test]
    fn a_packet_is_not_answered_by_the_rights_before_a_reload_or_an_end() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let _guard = runtime.enter();
        let header = Header {
            area: PacketArea::HoldingRegisters,
            target: 1,
            address: 0,
            count: NonZeroU16::MIN,
        };
        let mut packet = vec![0; Format::V1.packet_len(&header)];
        Format::V1.encode_to_slice(&header, &[0, 7], &mut packet).unwrap();
        let context = Arc::new(ListenerContext::for_tests());
        let (_engine, stop) = watch::channel(false);
        let nothing: fn(&Admission) = |_| ();
        let reload: fn(&Admission) = |admission| drop(admission.apply_reload(|_| None::<Kind>));
        let ending: fn(&Admission) = |admission| drop(admission.apply_reload(|_| Some(())));
        let closing: fn(&Admission) = |admission| drop(admission.close());
        for (packets, change) in [PacketsPerConnection::One, MANY]
            .into_iter()
            .flat_map(|packets| [nothing, reload, ending, closing].map(|change| (packets, change)))
        {
            let (mut client, accepted, peer) = connected();
            client.write_all(&packet).unwrap();
            while accepted.peek(&mut vec![0; packet.len()]).unwrap() < packet.len() {}
            let limits = ConnectionLimits { max_connections: 1, ..ConnectionLimits::NONE };
            let admission = Arc::new(Admission::new(limits));
            let (ticket, _) = admission.admit(peer).unwrap();
            let connection = Admitted { ticket, ..admitted(accepted, peer, Vec::new()) };
            change(&admission);
            let (is_current, is_ended) = (connection.ticket.is_current(), admission.open() == 0);
            let is_only = matches!(packets, PacketsPerConnection::One);
            let live =
                Arc::new(Reloadable::new(listener_with(((Format::V1, Flags::Strict), packets))));
            let raw = live.get();
            let mut connection = raw.serve_at_once(&context, connection);
            assert_eq!(connection.received == packet, is_only && !is_current);
            assert_eq!(raw.packets.accepted.get(), u64::from(is_only && is_current));
            if is_ended {
                // As if its task had just read the packet.
                connection.received.clone_from(&packet);
                let (context, stop) = (Arc::clone(&context), stop.clone());
                let mut serving = Arc::clone(&raw).serve(live, context, connection, stop);
                let mut task = Context::from_waker(std::task::Waker::noop());
                assert!(serving.as_mut().poll(&mut task).is_pending(), "its task is aborted here");
                assert_eq!(raw.packets.accepted.get(), 0);
            }
        }
    }

    #[test]
    fn what_follows_an_accepted_packet_is_read_counted_and_reported() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let _guard = runtime.enter();
        let (mut client, accepted, peer) = connected();
        accepted.set_nonblocking(true).unwrap();
        let mut stream = TcpStream::from_std(accepted).unwrap();
        let raw = listener(Format::V1, Flags::Strict);
        let (reporter, events) = event::channel(Verbosity::Refusals);
        let context = ListenerContext::new("raw", None, reporter, None);
        let (_engine, stop) = watch::channel(false);
        let sender = std::thread::spawn(move || {
            let sent = client.write_all(&[7; 1 << 20]);
            sent.and_then(|()| client.shutdown(std::net::Shutdown::Write)).unwrap();
            let mut end = Vec::new();
            client.read_to_end(&mut end).unwrap();
        });
        let from = (&mut stream, &peer.into());
        runtime.block_on(raw.drain_surplus(&context, from, 3, stop));
        assert_eq!(raw.packets.surplus_bytes.get(), 3 + (1 << 20));
        let event = events.next(Duration::ZERO).unwrap();
        assert_eq!(event.kind, Kind::SurplusBytes(3 + (1 << 20)));
        drop(stream);
        sender.join().unwrap();
    }
}

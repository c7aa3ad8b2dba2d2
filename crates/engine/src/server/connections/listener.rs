//! What all listeners share: a name, a socket, and the admission, counting and reporting of
//! connections.

use std::io;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use holdfast_protocol::pdu::Buffer;
use socket2::{Domain, Protocol, SockRef, Socket, TcpKeepalive, Type};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Handle;
use tokio::sync::watch;

use crate::server::connections::admission::{
    Admission, ConnectionLimits, Evicted, Full, Ticket, attach,
};
use crate::server::connections::peer::Peer;
use crate::server::connections::reloadable::Reloadable;
use crate::server::reports::audit::{Auditor, Permit};
use crate::server::reports::counters::ConnectionCounters;
use crate::server::reports::event::{Kind, Reporter};
use crate::server::reports::refused_request::{RefusedRequest, Reported};
use crate::server::requests::unit_server::UnitServer;
use crate::server::rights::functions::{is_write, only_reads};
use crate::server::rights::peer_rights::PeerRights;

/// The most connections that wait in the system to be accepted.
const MAX_BACKLOG: i32 = 1024;

/// The most unread bytes of a connection that the system buffers, in each direction.
/// Linux doubles it for its own bookkeeping. Without it, systems allow several megabytes.
const SOCKET_BUFFER_BYTES: usize = 256 * 1024;

/// TCP keepalive: the idle time before the first probe, where it is no setting.
pub(crate) const KEEPALIVE: Duration = Duration::from_secs(60);

/// How many probes without an answer end a connection. Together they take as long as the idle time.
const KEEPALIVE_PROBES: u32 = 4;

/// About how long Linux itself repeats what a peer does not acknowledge.
#[cfg(target_os = "linux")]
const MAX_RESEND_LIMIT: Duration = Duration::from_secs(15 * 60);

/// The pause after a failed accept, usually for lack of file descriptors.
pub(crate) const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// The part of a listener that does not depend on its protocol.
#[derive(Debug)]
pub(crate) struct ListenerContext {
    pub(crate) name: Arc<str>,
    pub(crate) admission: Arc<Admission>,
    pub(crate) connections: ConnectionCounters,
    pub(crate) auditor: Option<Auditor>,
    reporter: Reporter,
}

impl ListenerContext {
    pub(crate) fn new(
        name: &str,
        limits: Option<ConnectionLimits>,
        reporter: Reporter,
        auditor: Option<Auditor>,
    ) -> ListenerContext {
        ListenerContext {
            name: name.into(),
            admission: Arc::new(Admission::new(limits.unwrap_or(ConnectionLimits::NONE))),
            connections: ConnectionCounters::default(),
            auditor,
            reporter,
        }
    }

    #[cfg(test)]
    pub(crate) fn for_tests() -> ListenerContext {
        let (reporter, _) = crate::server::reports::event::channel(
            crate::server::reports::event::Verbosity::Nothing,
        );
        ListenerContext::new("test", None, reporter, None)
    }

    /// Permits a request to a memory that the peer may send: refused requests must take no room. `None` if
    /// it can't be recorded, although it must.
    #[inline]
    pub(crate) fn permit(&self, request: &[u8]) -> Option<Permit> {
        self.permitted(|auditor| auditor.permit(is_write(request), request))
    }

    /// As `permit`, for a request to a device.
    pub(crate) fn permit_forwarded(&self, request: &[u8]) -> Option<Permit> {
        self.permitted(|auditor| auditor.permit(!only_reads(request), request))
    }

    /// As `permit`, for the write of a packet.
    pub(crate) fn permit_packet(&self, payload: &[u8]) -> Option<Permit> {
        self.permitted(|auditor| auditor.permit(true, payload))
    }

    #[inline]
    fn permitted(&self, ask: impl FnOnce(&Auditor) -> Option<Permit>) -> Option<Permit> {
        self.auditor.as_ref().map_or_else(|| Some(Permit::default()), ask)
    }

    /// Counts and reports a connection that has ended, or was refused.
    pub(crate) fn ended(&self, kind: Kind, peer: impl Into<Peer>) {
        self.report(kind, Some(peer.into()));
    }

    /// Counts what has happened, if there is a counter for it, and reports it.
    pub(crate) fn report(&self, kind: Kind, peer: Option<Peer>) {
        self.report_with(kind, peer, None);
    }

    /// The same, for a peer that has presented a certificate.
    pub(crate) fn report_with(&self, kind: Kind, peer: Option<Peer>, subject: Option<&str>) {
        let counters = &self.connections;
        match kind {
            Kind::Opened => counters.accepted.add(),
            Kind::RefusedSource => counters.refused_source.add(),
            Kind::RefusedRole => counters.refused_role.add(),
            Kind::RefusedFull => counters.refused_full.add(),
            Kind::RefusedListenOnly => counters.refused_listen_only.add(),
            Kind::Evicted => counters.evicted.add(),
            Kind::EvictedHandshake => counters.evicted_handshakes.add(),
            Kind::RightsRevoked => counters.rights_revoked.add(),
            Kind::Ended => counters.ended.add(),
            Kind::Idle => counters.idle.add(),
            Kind::RequestTimeout => counters.request_timeout.add(),
            Kind::SlowReader => counters.slow_reader.add(),
            Kind::AcceptError(_) => counters.accept_errors.add(),
            Kind::TlsFailed(reason) => counters.tls_failed.add(reason),
            Kind::BrokenRequest => counters.broken_request.add(),
            _ => {}
        }
        self.reporter.report(&self.name, kind, peer, subject);
    }

    /// Ends the connections whose certificates a service does not trust any more.
    pub(crate) fn review<S: Service>(&self, service: &S) {
        for (peer, kind) in self.admission.review(|peer| service.ends(service, peer)) {
            self.ended(kind, peer);
        }
    }

    /// Ends the connections that a service does not serve any more in the place of `before`. The others look up
    /// their rights again.
    pub(crate) fn apply_reload<S: Service>(&self, before: &S, service: &S) {
        for (peer, kind) in self.admission.apply_reload(|peer| service.ends(before, peer)) {
            self.ended(kind, peer);
        }
    }

    /// Ends a connection that a reload during its handshake would have ended, if that reload had known
    /// its certificate. `before` performed the handshake; `live` may have taken its place since. `ends` says why
    /// it ends. Returns whether the connection has ended.
    pub(crate) fn end_after_reload<T>(
        &self,
        (before, live): (&T, &T),
        (ticket, peer): (&Ticket, &Peer),
        ends: impl FnOnce(&T, &T, &Peer) -> Option<Kind>,
    ) -> bool {
        if std::ptr::eq(before, live) {
            return false;
        }
        let Some(kind) = ends(live, before, peer) else { return false };
        // `None` if the reload did know it, and has counted its end.
        if self.admission.end(ticket.id()).is_some() {
            self.ended(kind, peer.clone());
        }
        true
    }

    /// Counts and reports a connection that was closed for another.
    pub(crate) fn evicted(&self, evicted: Option<Evicted>) {
        match evicted {
            None => {}
            Some(Evicted::Connection(peer)) => self.ended(Kind::Evicted, peer),
            Some(Evicted::Handshake(peer)) => self.ended(Kind::EvictedHandshake, peer),
            Some(Evicted::Answered(peer)) => self.ended(Kind::Closed, peer),
        }
    }

    /// Answers a request from a memory: permits it, records it if it writes, and reports it if it is refused.
    /// Returns the length of the reply, if there is one.
    pub(crate) fn answer(
        &self,
        (unit_server, rights): (&UnitServer, &PeerRights),
        (peer, reported): (Option<&Peer>, &Reported),
        unit_id: u8,
        request: &[u8],
        reply: &mut Buffer,
    ) -> Option<usize> {
        let is_for_listen_only = unit_server.listen_only.refuses(request);
        if is_for_listen_only {
            self.report(Kind::RefusedListenOnly, peer.cloned());
        }
        let mut permit = None;
        let ask = || {
            permit = self.permit(request);
            permit.is_some()
        };
        let len = unit_server.answer(rights, unit_id, request, ask, reply);
        if len.is_none() {
            self.report_silence((unit_server, permit.is_some()), peer, unit_id, request);
        }
        let answered = &reply[..len.unwrap_or_default()];
        let refused = RefusedRequest::from_reply(rights, unit_id, request, answered);
        if let Some(auditor) = &self.auditor {
            let unit = (unit_id, rights.memory(unit_id));
            auditor.note(&self.name, peer, unit, (request, answered), permit);
        }
        // A request for listen only mode has been reported as such.
        if !is_for_listen_only {
            self.note_refused(refused, reported, peer);
        }
        len
    }

    /// Reports a request without a reply that has silenced its unit, or ended that.
    #[cold]
    fn report_silence(
        &self,
        (unit_server, is_permitted): (&UnitServer, bool),
        peer: Option<&Peer>,
        unit_id: u8,
        request: &[u8],
    ) {
        // A silent unit ignores a request before its permit. Of all others, only the one that silences the
        // unit has no reply.
        if is_permitted {
            self.report(Kind::UnitSilenced(unit_id), peer.cloned());
        } else if unit_server.listen_only.was_ended_by(unit_id, request) {
            self.report(Kind::UnitBack(unit_id), peer.cloned());
        }
    }

    /// Reports the first refusal for each reason. The exceptions are counted elsewhere.
    #[inline]
    pub(crate) fn note_refused(
        &self,
        refused: Option<RefusedRequest>,
        reported: &Reported,
        peer: Option<&Peer>,
    ) {
        if let Some(refused) = refused
            && reported.mark(&refused)
        {
            self.report(Kind::RefusedRequest(refused), peer.cloned());
        }
    }
}

/// An admitted connection.
pub(crate) struct Admitted<G> {
    pub(crate) stream: TcpStream,
    pub(crate) peer: SocketAddr,
    pub(crate) rights: Arc<G>,
    /// Bytes that have already been read, and not answered.
    pub(crate) received: Vec<u8>,
    pub(crate) ticket: Ticket,
}

/// What serves a connection. In a box, so that each connection takes what its own kind requires, not what
/// the largest does.
pub(crate) type Serving = Pin<Box<dyn Future<Output = ()> + Send>>;

/// The protocol of a listener.
pub(crate) trait Service: Send + Sync + Sized + 'static {
    type PeerRights: Send + Sync + 'static;

    fn rights(&self, peer: IpAddr) -> Option<Arc<Self::PeerRights>>;

    /// Why a connection ends that `before` served, now that this service has taken its place; `None`
    /// if it stays.
    fn ends(&self, before: &Self, peer: &Peer) -> Option<Kind>;

    /// Answers what has arrived if that is possible without waiting.
    fn serve_at_once(
        &self,
        _front: &ListenerContext,
        connection: Admitted<Self::PeerRights>,
    ) -> Admitted<Self::PeerRights> {
        connection
    }

    /// Serves a connection to its end. `live` is this service, or what has taken its place. Called on the
    /// thread of the worker.
    fn serve(
        self: Arc<Self>,
        live: Arc<Reloadable<Self>>,
        context: Arc<ListenerContext>,
        connection: Admitted<Self::PeerRights>,
        stop: watch::Receiver<bool>,
    ) -> Serving;
}

/// Accepts connections until `stop`, and distributes them to the workers in turn. A reload can hand the
/// socket to another listener.
pub(crate) async fn accept<S: Service>(
    context: Arc<ListenerContext>,
    service: Arc<Reloadable<S>>,
    socket: Arc<TcpListener>,
    workers: Vec<Handle>,
    mut stop: watch::Receiver<bool>,
) {
    loop {
        let accepted = tokio::select! {
            biased;
            _ = stop.wait_for(|stop| *stop) => return,
            accepted = socket.accept() => accepted,
        };
        match accepted {
            Ok((stream, peer)) => admit(&context, &service, stream, peer, &workers, &stop),
            Err(error) if is_of_one_peer(&error) => {}
            Err(error) => {
                context.report(Kind::AcceptError(error.raw_os_error()), None);
                tokio::time::sleep(ACCEPT_PAUSE).await;
            }
        }
    }
}

/// Checks the rights and limits of a new connection, and starts to serve it.
fn admit<S: Service>(
    context: &Arc<ListenerContext>,
    live: &Arc<Reloadable<S>>,
    stream: TcpStream,
    peer: SocketAddr,
    workers: &[Handle],
    stop: &watch::Receiver<bool>,
) {
    if live.get().rights(peer.ip()).is_none() {
        return context.ended(Kind::RefusedSource, peer);
    }
    let (ticket, evicted) = match context.admission.admit(peer) {
        Ok(admitted) => admitted,
        // A reload has just removed the listener.
        Err(Full) if context.admission.is_closed() => return,
        Err(Full) => return context.ended(Kind::RefusedFull, peer),
    };
    context.evicted(evicted);
    context.report(Kind::Opened, Some(peer.into()));
    // A reload reviews the admitted connections. This one looks up its rights only now.
    let service = live.get();
    let Some(rights) = service.rights(peer.ip()) else {
        return context.ended(Kind::RefusedSource, peer);
    };
    let id = ticket.id();
    let connection = Admitted { stream, peer, rights, received: Vec::new(), ticket };
    let connection = service.serve_at_once(context, connection);
    let (context, live, stop) = (Arc::clone(context), Arc::clone(live), stop.clone());
    let admission = Arc::clone(&context.admission);
    let task = if let [worker] = workers {
        worker.spawn(service.serve(live, context, connection, stop))
    } else {
        let Admitted { stream, peer, rights, received, ticket } = connection;
        let Ok(stream) = stream.into_std() else { return };
        let worker = &workers[id as usize % workers.len()];
        worker.spawn(async move {
            // The socket must be registered with the worker that serves it.
            let Ok(stream) = TcpStream::from_std(stream) else { return };
            let connection = Admitted { stream, peer, rights, received, ticket };
            service.serve(live, context, connection, stop).await;
        })
    };
    attach(&admission, id, task.abort_handle());
}

/// Binds a listening socket that is not registered with a runtime.
///
/// # Errors
/// The address can't be had.
pub fn bind_tcp(address: SocketAddr) -> io::Result<std::net::TcpListener> {
    let socket = Socket::new(Domain::for_address(address), Type::STREAM, Some(Protocol::TCP))?;
    // On other systems, the option lets two programs bind the same port.
    #[cfg(unix)]
    socket.set_reuse_address(true)?;
    // Connections inherit both. The system may have lower limits.
    let _ = socket.set_recv_buffer_size(SOCKET_BUFFER_BYTES);
    let _ = socket.set_send_buffer_size(SOCKET_BUFFER_BYTES);
    bind(&socket, address)?;
    socket.listen(MAX_BACKLOG)?;
    Ok(socket.into())
}

/// Binds a datagram socket that is not registered with a runtime.
pub(crate) fn bind_udp(address: SocketAddr) -> io::Result<std::net::UdpSocket> {
    let socket = Socket::new(Domain::for_address(address), Type::DGRAM, Some(Protocol::UDP))?;
    bind(&socket, address)?;
    Ok(socket.into())
}

fn bind(socket: &Socket, address: SocketAddr) -> io::Result<()> {
    if address.is_ipv6() {
        socket.set_only_v6(false)?;
    }
    socket.bind(&address.into())?;
    socket.set_nonblocking(true)
}

/// Disables delays of replies, and detects lost peers by probes after a silence of this time. On Linux, a reply that
/// is not acknowledged, or for which the peer has no room, ends the connection after the same time. The options are
/// not essential: errors are ignored.
pub(crate) fn set_tcp_options(stream: &TcpStream, keepalive_after: Duration) {
    let socket = SockRef::from(stream);
    // Systems count whole seconds.
    let interval = Duration::from_secs((keepalive_after / KEEPALIVE_PROBES).as_secs().max(1));
    let keepalive = TcpKeepalive::new().with_time(keepalive_after).with_interval(interval);
    // Windows always sends ten probes.
    #[cfg(not(target_os = "windows"))]
    let keepalive = keepalive.with_retries(KEEPALIVE_PROBES);
    let _ = stream.set_nodelay(true);
    let _ = socket.set_tcp_keepalive(&keepalive);
    #[cfg(target_os = "linux")]
    {
        // The limit also ends the probes. A longer one than the system's own would delay the end.
        let limit = keepalive_after + interval * KEEPALIVE_PROBES;
        if limit < MAX_RESEND_LIMIT {
            let _ = socket.set_tcp_user_timeout(Some(limit));
        }
    }
}

/// Whether an error of `accept` concerns one peer, not the listener.
pub(crate) fn is_of_one_peer(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionAborted, ConnectionReset, Interrupted, WouldBlock};
    matches!(error.kind(), ConnectionAborted | ConnectionReset | Interrupted | WouldBlock)
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn unacknowledged_replies_end_a_connection_as_unanswered_probes_do() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let io = tokio::runtime::Builder::new_current_thread().enable_io().build().unwrap();
        for (keepalive, limit) in [(1, Some(5)), (10, Some(18)), (60, Some(120)), (460, None)] {
            let connecting = TcpStream::connect(listener.local_addr().unwrap());
            let stream = io.block_on(connecting).unwrap();
            set_tcp_options(&stream, Duration::from_secs(keepalive));
            let set = SockRef::from(&stream).tcp_user_timeout().unwrap();
            // An option that is not set is 0.
            let set = set.filter(|set| !set.is_zero());
            assert_eq!(set, limit.map(Duration::from_secs), "{keepalive} s");
        }
    }
}

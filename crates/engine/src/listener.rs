//! A Modbus TCP listener: its socket, and the loop that accepts connections.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use socket2::{Domain, Protocol, SockRef, Socket, TcpKeepalive, Type};
use tokio::net::TcpStream;
use tokio::runtime::Handle;
use tokio::sync::watch;

use crate::admission::{Admission, Full, attach};
use crate::connection::{Connection, Timeouts};
use crate::event::{Kind, Reporter};
use crate::policy::{Policy, Rule};
use crate::station::Station;

/// Connections that the system holds until they are accepted.
const BACKLOG: i32 = 1024;

/// When a silent peer is asked whether it is still there, how often, and how long apart.
const KEEPALIVE: (Duration, u32, Duration) = (Duration::from_secs(60), 4, Duration::from_secs(15));

/// A pause after the system could not accept, most often for want of file descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// What becomes of a new connection when there is no room.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhenFull {
    /// It is closed.
    Refuse,
    /// The connection that is idle longest is closed instead.
    Evict,
}

/// A Modbus TCP listener.
#[derive(Debug, Clone)]
pub struct ListenerSettings {
    pub name: String,
    /// Port 0 lets the system pick one. `[::]` takes IPv4 connections too.
    pub bind: SocketAddr,
    pub rules: Vec<Rule>,
    pub max_connections: usize,
    pub max_connections_per_source: Option<usize>,
    pub when_full: WhenFull,
    /// How long a connection may be without a request; `None` keeps it.
    pub idle_timeout: Option<Duration>,
    /// From the first byte of a request to its last, and for a peer to take its replies.
    pub request_timeout: Duration,
}

/// A listener that is bound, and all that its connections share.
pub(crate) struct Listener {
    pub(crate) name: Arc<str>,
    pub(crate) station: Arc<Station>,
    pub(crate) admission: Arc<Admission>,
    policy: Policy,
    timeouts: Timeouts,
    reporter: Reporter,
}

impl Listener {
    pub(crate) fn new(
        settings: ListenerSettings,
        station: Station,
        reporter: Reporter,
    ) -> Listener {
        let admission = Admission::new(
            settings.max_connections,
            settings.max_connections_per_source,
            settings.when_full,
        );
        Listener {
            name: settings.name.into(),
            station: Arc::new(station),
            admission: Arc::new(admission),
            policy: Policy::new(settings.rules),
            timeouts: Timeouts { idle: settings.idle_timeout, request: settings.request_timeout },
            reporter,
        }
    }

    /// Accepts until `stop`, and gives the connections to the workers in turn.
    pub(crate) async fn accept(
        self: Arc<Self>,
        socket: std::net::TcpListener,
        workers: Vec<Handle>,
        mut stop: watch::Receiver<bool>,
    ) {
        let Ok(socket) = tokio::net::TcpListener::from_std(socket) else {
            return;
        };
        loop {
            let accepted = tokio::select! {
                biased;
                _ = stop.wait_for(|stop| *stop) => return,
                accepted = socket.accept() => accepted,
            };
            match accepted {
                Ok((stream, peer)) => self.admit(stream, peer, &workers, &stop),
                Err(error) if is_of_one_peer(&error) => {}
                Err(_) => {
                    self.station.counters.connections.accept_errors.add();
                    self.report(Kind::AcceptError, None);
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
    }

    /// Settles what a new connection may do, and starts to serve it.
    fn admit(
        self: &Arc<Self>,
        stream: TcpStream,
        peer: SocketAddr,
        workers: &[Handle],
        stop: &watch::Receiver<bool>,
    ) {
        let counters = &self.station.counters.connections;
        let Some(grant) = self.policy.grant(peer.ip()) else {
            counters.refused_source.add();
            return self.report(Kind::RefusedSource, Some(peer));
        };
        let (ticket, evicted) = match self.admission.admit(peer) {
            Ok(admitted) => admitted,
            Err(Full) => {
                counters.refused_full.add();
                return self.report(Kind::RefusedFull, Some(peer));
            }
        };
        if evicted.is_some() {
            counters.evicted.add();
            self.report(Kind::Evicted, evicted);
        }
        counters.accepted.add();
        let id = ticket.id();
        let (listener, grant, stop) = (Arc::clone(self), Arc::clone(grant), stop.clone());
        let station = Arc::clone(&self.station);
        let timeouts = self.timeouts;
        let task = if let [worker] = workers {
            set_options(&stream);
            let connection = Connection::new(stream, station, grant, timeouts, ticket);
            worker.spawn(async move { listener.serve(connection, peer, stop).await })
        } else {
            let Ok(stream) = stream.into_std() else { return };
            let worker = &workers[id as usize % workers.len()];
            worker.spawn(async move {
                // The socket belongs to the worker that serves it: it is registered there.
                let Ok(stream) = TcpStream::from_std(stream) else { return };
                set_options(&stream);
                let connection = Connection::new(stream, station, grant, timeouts, ticket);
                listener.serve(connection, peer, stop).await;
            })
        };
        attach(&self.admission, id, task.abort_handle());
    }

    async fn serve(&self, connection: Connection, peer: SocketAddr, stop: watch::Receiver<bool>) {
        self.report(Kind::Opened, Some(peer));
        let end = connection.run(stop).await;
        self.report(end, Some(peer));
    }

    fn report(&self, kind: Kind, peer: Option<SocketAddr>) {
        self.reporter.report(&self.name, kind, peer);
    }
}

/// A socket that listens, not yet known to any runtime.
pub(crate) fn bind(address: SocketAddr) -> io::Result<std::net::TcpListener> {
    let socket = Socket::new(Domain::for_address(address), Type::STREAM, Some(Protocol::TCP))?;
    if address.is_ipv6() {
        socket.set_only_v6(false)?;
    }
    // Elsewhere the option lets two programs take the same port.
    #[cfg(unix)]
    socket.set_reuse_address(true)?;
    socket.bind(&address.into())?;
    socket.listen(BACKLOG)?;
    socket.set_nonblocking(true)?;
    Ok(socket.into())
}

/// Replies leave at once, and a peer that is gone is noticed. Where the system refuses an option,
/// the connection works without it.
fn set_options(stream: &TcpStream) {
    let (time, retries, interval) = KEEPALIVE;
    let keepalive = TcpKeepalive::new().with_time(time).with_interval(interval);
    #[cfg(not(target_os = "windows"))]
    let keepalive = keepalive.with_retries(retries);
    #[cfg(target_os = "windows")]
    let _ = retries;
    let _ = stream.set_nodelay(true);
    let _ = SockRef::from(stream).set_tcp_keepalive(&keepalive);
}

/// Errors of `accept` that say something of one peer, not of the listener.
fn is_of_one_peer(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionAborted, ConnectionReset, Interrupted, WouldBlock};
    matches!(error.kind(), ConnectionAborted | ConnectionReset | Interrupted | WouldBlock)
}

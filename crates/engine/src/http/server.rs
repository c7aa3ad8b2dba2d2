//! An HTTP server: its listening socket, its thread, and its end.

use std::io;
use std::net::{IpAddr, TcpListener};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use holdfast_runtime::{OwnThreads, lock};
use tokio::runtime::Builder;
use tokio::sync::watch;
use tokio::time::sleep;

use super::connection::serve;
use super::exchange::Event;
use super::front::{Front, HttpSettings, fails};
use super::inbox::Inbox;
use crate::heartbeat::Heartbeat;
use crate::server::Peer;
use crate::server::connections::listener::{Admitted, ListenerContext, Service, Serving, accept};
use crate::server::connections::reloadable::Reloadable;
use crate::server::reports::counters::ConnectionCounters;
use crate::server::reports::event::{self, Events, Kind, Verbosity};
use crate::server::rights::sources::contain;
use crate::tls::server::ServerTls;
use crate::wake::Wakes;

pub use crate::server::connections::listener::bind_tcp as bind;

/// How often a server that ends checks whether its last connection has ended.
const ENDING_PERIOD: Duration = Duration::from_millis(5);

impl Service for Front {
    type PeerRights = ();

    fn rights(&self, peer: IpAddr) -> Option<Arc<()>> {
        contain(&self.settings.sources, peer).then(|| Arc::new(()))
    }

    fn ends(&self, _before: &Front, _peer: &Peer) -> Option<Kind> {
        None
    }

    fn serve(
        self: Arc<Self>,
        _live: Arc<Reloadable<Front>>,
        _context: Arc<ListenerContext>,
        connection: Admitted<()>,
        stop: watch::Receiver<bool>,
    ) -> Serving {
        Box::pin(serve(self, connection, stop))
    }
}

/// A server that runs until it is closed or dropped.
pub struct HttpServer {
    front: Arc<Front>,
    stop: watch::Sender<bool>,
    abort: watch::Sender<bool>,
    threads: OwnThreads,
    heartbeat: Arc<Heartbeat>,
    events: Events,
    wakes: Mutex<Option<Wakes>>,
    /// `None` once the server has started.
    socket: Mutex<Option<TcpListener>>,
}

impl HttpServer {
    /// A server on a socket that listens. It accepts nothing yet.
    ///
    /// # Errors
    /// The system has no sockets left.
    pub fn new(
        settings: HttpSettings,
        socket: TcpListener,
        tls: Option<Arc<ServerTls>>,
    ) -> io::Result<HttpServer> {
        let (inbox, wakes) = Inbox::new()?;
        let (reporter, events) = event::channel(Verbosity::Refusals);
        socket.set_nonblocking(true)?;
        let thread = format!("http-{}", settings.name);
        let front = Front::new(settings, tls, Arc::new(inbox), reporter);
        Ok(HttpServer {
            front: Arc::new(front),
            stop: watch::Sender::new(false),
            abort: watch::Sender::new(false),
            threads: OwnThreads::default(),
            heartbeat: Arc::new(Heartbeat::new(thread)),
            events,
            wakes: Mutex::new(Some(wakes)),
            socket: Mutex::new(Some(socket)),
        })
    }

    /// Serves in a thread of its own. Once it has started, another call does nothing.
    ///
    /// # Errors
    /// The system has no threads or file descriptors left.
    pub fn start(&self) -> io::Result<()> {
        let mut unstarted = lock(&self.socket);
        let Some(socket) = &*unstarted else { return Ok(()) };
        let runtime = Builder::new_current_thread().enable_io().enable_time().build()?;
        let socket = {
            let _context = runtime.enter();
            tokio::net::TcpListener::from_std(socket.try_clone()?)?
        };
        let name = self.heartbeat.thread().to_owned();
        let (front, heartbeat) = (Arc::clone(&self.front), Arc::clone(&self.heartbeat));
        let (stop, mut abort) = (self.stop.subscribe(), self.abort.subscribe());
        let worker = runtime.handle().clone();
        let inbox = Arc::clone(&front.inbox);
        runtime.spawn(async move { inbox.deliver().await });
        let work = async move {
            let context = Arc::clone(&front.context);
            let live = Arc::new(Reloadable::from(front));
            accept(Arc::clone(&context), live, Arc::new(socket), vec![worker], stop).await;
            while context.admission.open() > 0 {
                tokio::select! {
                    _ = abort.wait_for(|abort| *abort) => return,
                    () = sleep(ENDING_PERIOD) => {}
                }
            }
        };
        let work = move || runtime.block_on(heartbeat.during(work));
        self.threads.push(thread::Builder::new().name(name).spawn(work)?);
        *unstarted = None;
        Ok(())
    }

    /// Takes what has happened to requests.
    pub fn take(&self) -> Vec<Event> {
        self.front.inbox.take()
    }

    /// Sends the responses of the exchanges that were answered since the last call.
    pub fn flush(&self) {
        self.front.inbox.flush();
    }

    /// Takes the next event of a connection.
    pub fn event(&self) -> Option<event::Event> {
        self.events.next(Duration::ZERO)
    }

    /// The socket that becomes readable when there is something to take. Only the first call returns it.
    pub fn wakes(&self) -> Option<Wakes> {
        lock(&self.wakes).take()
    }

    pub fn connections(&self) -> &ConnectionCounters {
        &self.front.context.connections
    }

    pub fn open(&self) -> usize {
        self.front.context.admission.open()
    }

    pub fn heartbeat(&self) -> &Arc<Heartbeat> {
        &self.heartbeat
    }

    /// Uses these certificates for new connections, and judges open ones by them. If clients need a
    /// certificate from now on, connections without one end, also those within the handshake.
    pub fn set_tls(&self, tls: Arc<ServerTls>) {
        let before = self.front.set_tls(tls);
        self.judge(before.as_deref());
    }

    /// Judges the certificates of open connections again. Those that fail are ended.
    pub fn review(&self) {
        self.judge(None);
    }

    fn judge(&self, before: Option<&ServerTls>) {
        let Some(tls) = self.front.tls() else { return };
        let before = before.unwrap_or(&tls);
        for (peer, kind) in self.front.context.admission.review(|peer| fails(&tls, before, peer)) {
            self.front.ended(kind, peer);
        }
    }

    /// Accepts no more connections, and ends those that have no request, or only a part of one. The
    /// others end after their responses.
    pub fn end(&self) {
        self.stop.send_replace(true);
    }

    /// Ends all connections, and waits for the thread.
    pub fn close(&self) {
        if self.threads.are_of_another_process() {
            return;
        }
        self.stop.send_replace(true);
        self.abort.send_replace(true);
        self.threads.join();
    }
}

impl Drop for HttpServer {
    fn drop(&mut self) {
        self.close();
    }
}

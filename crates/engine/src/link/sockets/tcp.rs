//! A TCP connection to a device: several requests in flight, if the settings allow it.

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::future::poll_fn;
use std::io::{self, ErrorKind};
use std::net::IpAddr;
use std::rc::Rc;
use std::sync::Arc;
use std::task::{Poll, ready};
use std::time::Duration;

use holdfast_protocol::client::{
    Attempt, Closed, Connection, Done, Failure, Past, Ticket, Tolerance, Transport,
};
use holdfast_protocol::pdu::EncodedRequest;
use holdfast_runtime::{Epoch, Retry};
use socket2::SockRef;
use tokio::net::TcpStream;
use tokio::net::tcp::OwnedReadHalf;
use tokio::sync::{Mutex, oneshot};
use tokio::task::AbortHandle;
use tokio::time::{Instant, sleep, sleep_until, timeout_at};

use crate::client::{ClientError, SendMoment, StrayCounters, connection};
use crate::link::fault::Exchanged;
use crate::link::limits::connect_pause::{ConnectPause, DuringPause};
use crate::link::limits::flood::Flood;
use crate::link::limits::lease_fence::Pass;
use crate::link::limits::permit::Permit;
use crate::link::scheduling::in_flight::Pace;
use crate::link::sockets::connect::dial;
use crate::link::sockets::handshake;
use crate::name_lookup;
use crate::socket_calls::{self, ResendLimit, poll_receive};
use crate::tls::client::ClientTls;
use crate::tls::{Channel, TlsFailure};

/// The connection has ended before a request could be sent, or before its reply.
const LOST: Failure = Failure::Closed(Closed::ByPeer);

/// Bytes that a socket may leave unsent before its connection is given up.
const MAX_UNSENT_BYTES: usize = 16 * 1024;

/// Bytes per read of a socket.
const CHUNK_BYTES: usize = 16 * 1024;

thread_local! {
    /// What is read from a socket at once. All connections of a thread share it: most are idle.
    static CHUNK: RefCell<Box<[u8]>> = RefCell::new(vec![0; CHUNK_BYTES].into_boxed_slice());
}

pub(in crate::link) struct TcpLink {
    host: String,
    port: u16,
    tls: Option<Arc<ClientTls>>,
    tolerance: Tolerance,
    /// For errors.
    url: String,
    connecting: Mutex<()>,
    strays: Arc<StrayCounters>,
    flood: Flood,
    pause: ConnectPause,
    /// When the last connection ended.
    ended: Rc<Cell<Option<Instant>>>,
    /// What it left to the next one.
    past: Rc<RefCell<Past>>,
    /// The zero of the clock of all connections.
    epoch: Epoch,
    open: Rc<RefCell<Option<Open>>>,
}

/// The result of a request, and its next attempt, if there is one; `None` if it was not sent in time.
type Outcome = Option<(Result<Vec<u8>, Failure>, Option<Attempt>)>;

/// The callers that wait for the requests in flight. They are few.
type Waiting = BTreeMap<Ticket, oneshot::Sender<Outcome>>;

/// An open connection.
struct Open {
    /// `None` if the system does not tell it.
    peer: Option<IpAddr>,
    connection: Connection,
    epoch: Epoch,
    waiting: Waiting,
    /// Requests that wait for a pause.
    held: Vec<(Ticket, Permit)>,
    ended: Rc<Cell<Option<Instant>>>,
    past: Rc<RefCell<Past>>,
    strays: Arc<StrayCounters>,
    /// Late replies that were counted.
    late: u64,
    writer: tokio::net::tcp::OwnedWriteHalf,
    resend_limit: ResendLimit,
    tls: Option<Channel>,
    /// Bytes that the socket has not accepted yet.
    unsent: Vec<u8>,
    reader: Option<AbortHandle>,
    /// Nothing is sent against it. Set by the first request that has one.
    pass: Option<Pass>,
}

impl TcpLink {
    pub(in crate::link) fn new(
        (host, port): (String, u16),
        tls: Option<Arc<ClientTls>>,
        (tolerance, retry): (Tolerance, Retry),
        url: String,
    ) -> TcpLink {
        let strays = Arc::<StrayCounters>::default();
        TcpLink {
            flood: Flood::new(Arc::clone(&strays), retry),
            strays,
            host,
            port,
            tls,
            tolerance,
            url,
            connecting: Mutex::default(),
            pause: ConnectPause::new(retry),
            ended: Rc::default(),
            past: Rc::default(),
            epoch: Epoch::now(),
            open: Rc::default(),
        }
    }

    pub(in crate::link) async fn exchange(
        &self,
        pace: &Pace,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        during_pause: DuringPause,
        permit: &Permit,
    ) -> Exchanged {
        let mut deadline = Instant::now() + timeout;
        let failed = |failure| Arc::new(ClientError::new(failure, timeout));
        let mut attempt = Attempt::default();
        loop {
            if self.open.borrow().is_none() {
                self.connect(deadline, timeout, during_pause, permit).await?;
            }
            if let Some(open) = self.open.borrow_mut().as_mut() {
                if !permit.peers.hold(open.peer) {
                    return Err(ClientError::Elsewhere.into());
                }
                if let Some(fence) = &permit.fence {
                    open.pass.get_or_insert_with(|| fence.pass());
                }
            }
            permit.check(SendMoment::Sending)?;
            let began = pace.began();
            let outcome = self.carry_out(unit_id, request, deadline, attempt, permit).await;
            let Some((answer, again)) = outcome.unwrap_or_else(|lost| Some((Err(lost), None)))
            else {
                return Err(Arc::new(ClientError::Expired));
            };
            if let Some(began) = began {
                pace.ended(began, &answer);
            }
            let Some(next) = again else { return answer.map_err(failed) };
            sleep(next.pause()).await;
            if next.has_own_timeout() {
                deadline = Instant::now() + timeout;
            }
            attempt = next;
        }
    }

    /// Sends a request on the connection, and waits for its result.
    async fn carry_out(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        deadline: Instant,
        attempt: Attempt,
        permit: &Permit,
    ) -> Result<Outcome, Failure> {
        let mut sent = self.send(unit_id, request, deadline, attempt)?;
        if let Some(open) = self.open.borrow_mut().as_mut()
            && open.connection.is_held()
        {
            open.held.push((sent.ticket, permit.clone()));
        }
        loop {
            match timeout_at(self.due(), &mut sent.outcome).await {
                Ok(outcome) => return outcome.or(Err(LOST)),
                Err(_) => self.advance(),
            }
        }
    }

    /// Opens the connection, once for all requests that wait for it.
    async fn connect(
        &self,
        deadline: Instant,
        timeout: Duration,
        during_pause: DuringPause,
        permit: &Permit,
    ) -> Result<(), Arc<ClientError>> {
        let too_late = || ClientError::ConnectTimeout { to: self.url.clone(), after: timeout };
        let alone = timeout_at(deadline, self.connecting.lock()).await;
        let _alone = alone.map_err(|_| Arc::new(too_late()))?;
        if self.open.borrow().is_some() {
            return Ok(());
        }
        if let Some(until) = self.flood.until(Instant::now()) {
            self.pause.flooded(until);
        }
        if during_pause == DuringPause::Fail {
            self.pause.check()?;
        }
        if let Some(ended) = self.ended.get() {
            sleep_until((ended + self.tolerance.reconnect).min(deadline)).await;
        }
        permit.check(SendMoment::Waiting)?;
        let found =
            match timeout_at(deadline, name_lookup::addresses_of(&self.host, self.port)).await {
                Ok(Ok(all)) if !permit.peers.hold_all(&all) => {
                    return Err(ClientError::Elsewhere.into());
                }
                Ok(found) => found,
                Err(_) => {
                    let error = ClientError::LookupTimeout { to: self.url.clone(), after: timeout };
                    return Err(self.pause.failed(error));
                }
            };
        let connected = timeout_at(deadline, async {
            let mut stream = dial(found?, deadline).await?;
            let tls = match &self.tls {
                None => None,
                Some(tls) => Some(handshake::agree(&mut stream, tls).await?),
            };
            Ok::<_, io::Error>((stream, tls))
        });
        let error = match connected.await {
            Ok(Ok((stream, tls))) => {
                self.pause.connected();
                self.take(stream, tls);
                return Ok(());
            }
            Ok(Err(error)) => self.refused(error),
            Err(_) => too_late(),
        };
        Err(self.pause.failed(error))
    }

    /// Why the connection could not be made.
    fn refused(&self, error: io::Error) -> ClientError {
        let to = self.url.clone();
        match error.get_ref().and_then(|inner| inner.downcast_ref::<TlsFailure>()) {
            Some(failure) => ClientError::Tls { to, failure: failure.clone(), maybe_sent: false },
            None => ClientError::Connect { to, error },
        }
    }

    fn take(&self, stream: TcpStream, tls: Option<Channel>) {
        let _ = stream.set_nodelay(true);
        let peer = stream.peer_addr().ok().map(|peer| peer.ip());
        let (reader, writer) = stream.into_split();
        let (transport, now) = (Transport::Tcp, self.epoch.elapsed());
        let mut connection = connection(transport, self.tolerance, now);
        connection.follow(self.past.take());
        let open = Open {
            peer,
            connection,
            epoch: self.epoch,
            waiting: Waiting::default(),
            held: Vec::new(),
            ended: Rc::clone(&self.ended),
            past: Rc::clone(&self.past),
            strays: Arc::clone(&self.strays),
            late: 0,
            writer,
            resend_limit: ResendLimit::default(),
            tls,
            unsent: Vec::new(),
            reader: None,
            pass: None,
        };
        *self.open.borrow_mut() = Some(open);
        let task = tokio::task::spawn_local(receive(Rc::clone(&self.open), reader));
        if let Some(open) = self.open.borrow_mut().as_mut() {
            open.reader = Some(task.abort_handle());
        }
    }

    fn send(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        deadline: Instant,
        attempt: Attempt,
    ) -> Result<Sent<'_>, Failure> {
        let mut open = self.open.borrow_mut();
        let found = open.as_mut().ok_or(LOST)?;
        let timeout = deadline.saturating_duration_since(Instant::now());
        found.resend_limit.cover(SockRef::from(found.writer.as_ref()), timeout);
        let sent = found.epoch.elapsed();
        let ticket = found.connection.send_again(unit_id, request, timeout, attempt, sent);
        match ticket {
            Ok(ticket) if found.write() => {
                let (sender, outcome) = oneshot::channel();
                found.waiting.insert(ticket, sender);
                Ok(Sent { link: self, ticket, outcome })
            }
            _ => {
                *open = None;
                Err(LOST)
            }
        }
    }

    pub(in crate::link) fn strays(&self) -> &Arc<StrayCounters> {
        &self.strays
    }

    /// The end of the pause after the last failed attempt to connect.
    pub(in crate::link) fn retry_at(&self) -> Option<Instant> {
        self.pause.until()
    }

    /// Closes the connection if no request is in flight.
    pub(in crate::link) fn release(&self) {
        let mut open = self.open.borrow_mut();
        if open.as_ref().is_some_and(|open| open.waiting.is_empty()) {
            *open = None;
        }
    }

    /// When something is due on the connection.
    fn due(&self) -> Instant {
        let open = self.open.borrow();
        let due = open.as_ref().and_then(|open| Some(open.epoch.at(open.connection.deadline()?)));
        let due = due.map_or_else(Instant::now, Instant::from);
        let held = open.iter().flat_map(|open| &open.held);
        held.filter_map(|(_, permit)| Some(permit.until?.into())).fold(due, Instant::min)
    }

    /// Ends the requests whose time is over, and the connection if that was too much; sends what has
    /// waited for a pause.
    fn advance(&self) {
        let mut open = self.open.borrow_mut();
        let Some(found) = open.as_mut() else { return };
        found.give_up_held();
        let Open { connection, waiting, .. } = found;
        connection.advance(found.epoch.elapsed(), |done| hand_on(waiting, &done));
        if connection.closed().is_some() || !found.write() {
            *open = None;
        }
    }
}

/// A request in flight. It is cancelled when its device is stopped.
struct Sent<'l> {
    link: &'l TcpLink,
    ticket: Ticket,
    outcome: oneshot::Receiver<Outcome>,
}

impl Drop for Sent<'_> {
    fn drop(&mut self) {
        self.outcome.close();
        let mut open = self.link.open.borrow_mut();
        if let Some(found) = open.as_mut()
            // A new connection counts its tickets anew: this one may be of another request.
            && found.waiting.get(&self.ticket).is_some_and(oneshot::Sender::is_closed)
        {
            found.waiting.remove(&self.ticket);
            found.connection.cancel(self.ticket, found.epoch.elapsed());
            if found.connection.closed().is_some() {
                *open = None;
            }
        }
    }
}

/// Hands a result to the caller that waits for it.
fn hand_on(waiting: &mut Waiting, done: &Done<'_>) {
    if let Some(sender) = waiting.remove(&done.ticket) {
        // A device that was stopped does not wait.
        let answer = done.outcome.map(|_| done.pdu.to_vec());
        let _ = sender.send(Some((answer, done.again)));
    }
}

impl Drop for TcpLink {
    /// The task that reads also holds the connection.
    fn drop(&mut self) {
        self.open.borrow_mut().take();
    }
}

impl Open {
    fn is_fenced(&self) -> bool {
        self.pass.as_ref().is_some_and(|pass| !pass.fence().allows())
    }

    /// Drops the requests that have waited for a pause for too long, and what nobody waits for.
    fn give_up_held(&mut self) {
        let Open { connection, waiting, held, epoch, .. } = self;
        if !connection.is_held() {
            held.clear();
        }
        held.retain(|(ticket, permit)| {
            if permit.is_expected(SendMoment::Waiting) {
                return true;
            }
            connection.cancel(*ticket, epoch.elapsed());
            if let Some(sender) = waiting.remove(ticket) {
                // A device that was stopped does not wait.
                let _ = sender.send(None);
            }
            false
        });
    }

    /// Sends without waiting. Bytes that the socket does not accept are sent later. Returns whether
    /// the connection still works.
    fn write(&mut self) -> bool {
        if self.is_fenced() {
            return false;
        }
        let frames = self.connection.outgoing();
        match &mut self.tls {
            None => self.unsent.extend_from_slice(frames),
            Some(tls) => tls.send(frames, &mut self.unsent),
        }
        let len = frames.len();
        self.connection.sent(len);
        match socket_calls::send(self.writer.as_ref(), &self.unsent) {
            Ok(len) => {
                self.unsent.drain(..len);
                true
            }
            // If a device does not read, its requests time out. Their number is limited.
            Err(error) => {
                error.kind() == ErrorKind::WouldBlock && self.unsent.len() < MAX_UNSENT_BYTES
            }
        }
    }
}

impl Open {
    /// Takes what was received. Returns whether the connection still works.
    fn receive(&mut self, received: &[u8], plain: &mut Vec<u8>) -> bool {
        let Open { connection, waiting, tls, unsent, strays, late, .. } = self;
        let (received, lasts) = match tls {
            None => (received, true),
            Some(tls) => {
                plain.clear();
                let intact = tls.receive(received, plain, unsent).is_ok();
                (&plain[..], intact && !tls.has_ended())
            }
        };
        let now = self.epoch.elapsed();
        connection.receive(received, now, |done| hand_on(waiting, &done));
        strays.take(connection, late);
        lasts && connection.closed().is_none()
    }
}

impl Drop for Open {
    fn drop(&mut self) {
        self.ended.set(Some(Instant::now()));
        self.past.replace(self.connection.take_past(self.epoch.elapsed()));
        if self.is_fenced() {
            self.unsent.clear();
        }
        if let Some(tls) = &mut self.tls {
            tls.end(&mut self.unsent);
            let _ = socket_calls::send(self.writer.as_ref(), &self.unsent);
        }
        if let Some(reader) = &self.reader {
            reader.abort();
        }
    }
}

/// Reads replies until the connection ends.
async fn receive(link: Rc<RefCell<Option<Open>>>, reader: OwnedReadHalf) {
    let mut plain = Vec::new();
    loop {
        let received = poll_fn(|context| {
            CHUNK.with_borrow_mut(|chunk| {
                let received = ready!(poll_receive(reader.as_ref(), context, chunk));
                let len = received.unwrap_or(0);
                let mut open = link.borrow_mut();
                Poll::Ready(
                    open.as_mut().map(|open| len > 0 && open.receive(&chunk[..len], &mut plain)),
                )
            })
        });
        let Some(intact) = received.await else { return };
        let mut open = link.borrow_mut();
        let Some(found) = open.as_mut() else { return };
        // The socket may now accept bytes that it did not accept before.
        if intact && (found.unsent.is_empty() || found.write()) {
            continue;
        }
        let lost = open.take();
        drop(open);
        if let Some(mut lost) = lost {
            // This task is the reader, so it must not abort itself.
            lost.reader = None;
            let Open { connection, waiting, .. } = &mut lost;
            connection.close(Closed::ByPeer, |done| hand_on(waiting, &done));
        }
        return;
    }
}

#[cfg(test)]
mod tests {
    use holdfast_protocol::pdu::{Range, Request};
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpListener;
    use tokio::runtime::Builder;
    use tokio::task::{LocalSet, spawn_local};

    use super::*;
    use crate::client::{Endpoint, Place};
    use crate::link::{InFlight, Link, Priority};

    const TIMEOUT: Duration = Duration::from_secs(60);

    /// A device, and a link to it with one request in flight.
    async fn linked(tolerance: Tolerance) -> (TcpListener, Rc<Link>) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let (host, port) = ("127.0.0.1".to_owned(), listener.local_addr().unwrap().port());
        let place = Place::Tcp { host, port, tls: None };
        let endpoint = Endpoint { place, tolerance };
        (listener, Link::new(endpoint, InFlight::Fixed(1), Retry::default()))
    }

    async fn write_within(link: &Link, time: Duration) -> Exchanged {
        let request = Request::WriteSingleRegister { address: 0, value: 1 };
        let write = EncodedRequest::new(&request);
        let until = Some((Instant::now() + time).into_std());
        let permit = Permit { until, ..Permit::default() };
        link.call(1, &write, TIMEOUT, Priority::Urgent, &permit).await
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_system_repeats_no_request_for_much_longer_than_its_timeout() {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
            let place = ("127.0.0.1".to_owned(), listener.local_addr().unwrap().port());
            let link = TcpLink::new(place, None, Default::default(), String::new());
            let device = spawn_local(async move {
                let (mut device, _) = listener.accept().await.unwrap();
                let mut request = [0; 12];
                while device.read_exact(&mut request).await.is_ok() {
                    device.write_all(&request).await.unwrap();
                }
            });
            let request = Request::WriteSingleRegister { address: 0, value: 1 };
            let write = EncodedRequest::new(&request);
            let (pace, permit) = (Pace::new(InFlight::Fixed(1)), Permit::default());
            link.exchange(&pace, 1, &write, TIMEOUT, DuringPause::Connect, &permit).await.unwrap();
            let open = link.open.borrow();
            let socket = SockRef::from(open.as_ref().unwrap().writer.as_ref());
            let limit = socket.tcp_user_timeout().unwrap();
            assert!(limit.is_some_and(|limit| !limit.is_zero() && limit <= TIMEOUT), "{limit:?}");
            device.abort();
        });
    }

    #[test]
    fn a_request_whose_device_was_stopped_leaves_its_place() {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let tolerance = Tolerance { close_after: 100, ..Tolerance::default() };
            let (listener, link) = linked(tolerance).await;
            let range = Range::new(0, 1).unwrap();
            let read = EncodedRequest::new(&Request::ReadHoldingRegisters(range));

            let (for_stopped, request) = (Rc::clone(&link), read.clone());
            let stopped = spawn_local(async move {
                for_stopped.call(1, &request, TIMEOUT, Priority::Usual, &Permit::default()).await
            });
            let (mut device, _) = listener.accept().await.unwrap();
            let mut request = [0; 12];
            device.read_exact(&mut request).await.unwrap();
            stopped.abort();
            assert!(stopped.await.unwrap_err().is_cancelled());

            let next = spawn_local(async move {
                link.call(1, &read, TIMEOUT, Priority::Usual, &Permit::default()).await
            });
            let mut request = [0; 12];
            device.read_exact(&mut request).await.unwrap();
            let reply = [request[0], request[1], 0, 0, 0, 5, 1, 3, 2, 0, 7];
            device.write_all(&reply).await.unwrap();
            assert_eq!(next.await.unwrap().unwrap(), [3, 2, 0, 7]);
        });
    }

    #[test]
    fn what_waits_for_a_pause_for_too_long_is_not_sent() {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let tolerance = Tolerance { pause_after_connect: TIMEOUT, ..Tolerance::default() };
            let (listener, link) = linked(tolerance).await;
            let answer = write_within(&link, Duration::from_millis(100)).await;
            assert!(matches!(*answer.unwrap_err(), ClientError::Expired));
            let (mut device, _) = listener.accept().await.unwrap();
            drop(link);
            let mut received = Vec::new();
            device.read_to_end(&mut received).await.unwrap();
            assert_eq!(received, []);
        });
    }

    #[test]
    fn what_is_sent_too_late_makes_no_connection() {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let (listener, link) = linked(Tolerance::default()).await;
            let answer = write_within(&link, Duration::ZERO).await;
            assert!(matches!(*answer.unwrap_err(), ClientError::Expired));
            let none = tokio::time::timeout(Duration::ZERO, listener.accept()).await;
            assert!(none.is_err(), "nobody connects");
        });
    }
}

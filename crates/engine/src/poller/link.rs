//! A link: one connection or one serial line, shared by all devices behind it.
//!
//! Over Modbus TCP, several requests can be in flight, if the settings of the devices allow it. Other
//! transports carry one request at a time, in a thread of their own. After a failed connect, requests
//! fail immediately until the backoff is over. [`Connection`] decides when a connection ends. The next
//! request opens a new one.

use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::io::{self, ErrorKind};
use std::rc::Rc;
use std::sync::{Arc, mpsc};
use std::time::Duration;

use holdfast_protocol::client::{
    Attempt, Closed, Connection, Done, Failure, Ticket, Tolerance, Transport,
};
use holdfast_protocol::pdu::{EncodedRequest, Response};
use tokio::net::TcpStream;
use tokio::net::tcp::OwnedReadHalf;
use tokio::sync::{Mutex, oneshot};
use tokio::task::AbortHandle;
use tokio::time::{Instant, sleep, sleep_until, timeout_at};

use super::backoff;
use super::handshake;
use super::pace::{InFlight, Pace, Priority};
use super::status::Fault;
use crate::client::{BlockingClient, ClientError, Endpoint, Place};
use crate::tls::Channel;
use crate::tls::client::ClientTls;

/// Bytes per read of a socket.
const CHUNK: usize = 16 * 1024;

/// The bytes of a read, empty for a write; or the fault.
pub(super) type Answer = Result<Vec<u8>, Fault>;

pub(super) enum Link {
    Tcp(Box<TcpLink>),
    Blocking(BlockingLink),
}

impl Link {
    /// Must be called in the context of a `LocalSet`.
    pub(super) fn new(endpoint: Endpoint, in_flight: InFlight) -> Rc<Link> {
        let Endpoint { place, tolerance } = endpoint;
        Rc::new(match place {
            Place::Tcp { host, port, tls } => {
                let one = tolerance.is_one_at_a_time();
                let in_flight = if one { InFlight::Fixed(1) } else { in_flight };
                let (failures, failed) = Default::default();
                let (pace, connecting) = (Pace::new(in_flight), Mutex::default());
                let (ended, open) = Default::default();
                Link::Tcp(Box::new(TcpLink {
                    host,
                    port,
                    tls,
                    tolerance,
                    pace,
                    connecting,
                    failures,
                    failed,
                    ended,
                    open,
                }))
            }
            place => Link::Blocking(BlockingLink::new(Endpoint { place, tolerance })),
        })
    }

    /// Sends a read or a write and waits for the answer.
    pub(super) async fn call(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        priority: Priority,
    ) -> Answer {
        match self {
            Link::Tcp(link) => link.call(unit_id, request, timeout, priority).await,
            Link::Blocking(link) => link.call(unit_id, request, timeout, priority).await,
        }
    }
}

impl Link {
    /// When an unreachable address is tried again. Until then polls fail immediately.
    pub(super) fn retry_at(&self) -> Option<Instant> {
        let failed = match self {
            Link::Tcp(link) => link.failed.get().map(|(until, _)| until),
            Link::Blocking(link) => link.retry_at.get(),
        };
        failed.filter(|until| Instant::now() < *until)
    }

    /// Closes the connection if no request is in flight. The next request opens a new one.
    pub(super) fn release(&self) {
        match self {
            Link::Tcp(link) => {
                let mut open = link.open.borrow_mut();
                if open.as_ref().is_some_and(|open| open.waiting.is_empty()) {
                    *open = None;
                }
            }
            Link::Blocking(link) => {
                let _ = link.jobs.send(Job::Release);
            }
        }
    }
}

pub(super) struct TcpLink {
    host: String,
    port: u16,
    tls: Option<Arc<ClientTls>>,
    tolerance: Tolerance,
    pace: Pace,
    connecting: Mutex<()>,
    failures: Cell<u32>,
    /// The earliest time of the next attempt after a failed one, and the fault.
    failed: Cell<Option<(Instant, Fault)>>,
    /// When the last connection ended.
    ended: Rc<Cell<Option<Instant>>>,
    open: Rc<RefCell<Option<Open>>>,
}

/// The result of a request, and its next attempt, if there is one.
type Outcome = (Answer, Option<Attempt>);

/// An open connection.
struct Open {
    connection: Connection,
    /// The zero of the clock of the connection.
    epoch: Instant,
    waiting: HashMap<Ticket, oneshot::Sender<Outcome>>,
    ended: Rc<Cell<Option<Instant>>>,
    writer: tokio::net::tcp::OwnedWriteHalf,
    tls: Option<Channel>,
    /// Bytes that the socket has not accepted yet.
    unsent: Vec<u8>,
    reader: Option<AbortHandle>,
}

impl TcpLink {
    async fn call(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        priority: Priority,
    ) -> Answer {
        let _place = self.pace.place(priority).await;
        let mut deadline = Instant::now() + timeout;
        let mut attempt = Attempt::default();
        loop {
            if self.open.borrow().is_none() {
                self.connect(deadline, priority).await?;
            }
            let began = self.pace.began();
            let (answer, again) = self.carry_out(unit_id, request, deadline, attempt).await?;
            if let Some(began) = began {
                self.pace.ended(began, answer == Err(Fault::Timeout));
            }
            let Some(next) = again else { return answer };
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
    ) -> Result<Outcome, Fault> {
        let mut sent = self.send(unit_id, request, deadline, attempt)?;
        loop {
            match timeout_at(self.due(), &mut sent.outcome).await {
                Ok(outcome) => {
                    sent.is_over = true;
                    return outcome.or(Err(Fault::Reset));
                }
                Err(_) => self.advance(),
            }
        }
    }

    /// Opens the connection, once for all requests that wait for it.
    async fn connect(&self, deadline: Instant, priority: Priority) -> Result<(), Fault> {
        let _alone = timeout_at(deadline, self.connecting.lock()).await.or(Err(Fault::Timeout))?;
        if self.open.borrow().is_some() {
            return Ok(());
        }
        if let Some((until, fault)) = self.failed.get()
            && Instant::now() < until
            && priority != Priority::Urgent
        {
            return Err(fault);
        }
        if let Some(ended) = self.ended.get() {
            sleep_until((ended + self.tolerance.reconnect).min(deadline)).await;
        }
        let address = (self.host.as_str(), self.port);
        let connected = timeout_at(deadline, async {
            let mut stream = TcpStream::connect(address).await?;
            let tls = match &self.tls {
                None => None,
                Some(tls) => Some(handshake::agree(&mut stream, tls).await?),
            };
            Ok::<_, io::Error>((stream, tls))
        });
        let fault = match connected.await {
            Ok(Ok((stream, tls))) => {
                self.failures.set(0);
                self.failed.set(None);
                self.take(stream, tls);
                return Ok(());
            }
            Ok(Err(_)) => Fault::Refused,
            Err(_) => Fault::Timeout,
        };
        self.failures.set(self.failures.get().saturating_add(1));
        let pause = backoff::pause(self.failures.get(), backoff::MAX_PAUSE);
        self.failed.set(Some((Instant::now() + pause, fault)));
        Err(fault)
    }

    fn take(&self, stream: TcpStream, tls: Option<Channel>) {
        let _ = stream.set_nodelay(true);
        let (reader, writer) = stream.into_split();
        let open = Open {
            connection: Connection::tolerant(Transport::Tcp, self.tolerance, Duration::ZERO),
            epoch: Instant::now(),
            waiting: HashMap::new(),
            ended: Rc::clone(&self.ended),
            writer,
            tls,
            unsent: Vec::new(),
            reader: None,
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
    ) -> Result<Sent<'_>, Fault> {
        let mut open = self.open.borrow_mut();
        let found = open.as_mut().ok_or(Fault::Reset)?;
        let now = Instant::now();
        let timeout = deadline.saturating_duration_since(now);
        let sent = now - found.epoch;
        let ticket = found.connection.send_again(unit_id, request, timeout, attempt, sent);
        match ticket {
            Ok(ticket) if found.write() => {
                let (sender, outcome) = oneshot::channel();
                found.waiting.insert(ticket, sender);
                Ok(Sent { link: self, ticket, outcome, is_over: false })
            }
            _ => {
                *open = None;
                Err(Fault::Reset)
            }
        }
    }

    /// When something is due on the connection.
    fn due(&self) -> Instant {
        let open = self.open.borrow();
        let due = open.as_ref().and_then(|open| Some(open.epoch + open.connection.deadline()?));
        due.unwrap_or_else(Instant::now)
    }

    /// Ends the requests whose time is over, and the connection if that was too much; sends what has
    /// waited for a pause.
    fn advance(&self) {
        let mut open = self.open.borrow_mut();
        let Some(found) = open.as_mut() else { return };
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
    is_over: bool,
}

impl Drop for Sent<'_> {
    fn drop(&mut self) {
        if self.is_over {
            return;
        }
        self.outcome.close();
        if let Some(open) = self.link.open.borrow_mut().as_mut()
            // A new connection counts its tickets anew: this one may be of another request.
            && open.waiting.get(&self.ticket).is_some_and(oneshot::Sender::is_closed)
        {
            open.waiting.remove(&self.ticket);
            open.connection.cancel(self.ticket);
        }
    }
}

/// Hands a result to the caller that waits for it.
fn hand_on(waiting: &mut HashMap<Ticket, oneshot::Sender<Outcome>>, done: &Done<'_>) {
    if let Some(sender) = waiting.remove(&done.ticket) {
        // A device that was stopped does not wait.
        let _ = sender.send((answer(done.outcome), done.again));
    }
}

impl Drop for TcpLink {
    /// The task that reads also holds the connection.
    fn drop(&mut self) {
        self.open.borrow_mut().take();
    }
}

impl Open {
    /// Sends without waiting. Bytes that the socket does not accept are sent later. Returns whether
    /// the connection still works.
    fn write(&mut self) -> bool {
        let frames = self.connection.outgoing();
        match &mut self.tls {
            None => self.unsent.extend_from_slice(frames),
            Some(tls) => tls.send(frames, &mut self.unsent),
        }
        let len = frames.len();
        self.connection.sent(len);
        match self.writer.try_write(&self.unsent) {
            Ok(len) => {
                self.unsent.drain(..len);
                true
            }
            // If a device does not read, its requests time out. Their number is limited.
            Err(error) => error.kind() == ErrorKind::WouldBlock && self.unsent.len() < CHUNK,
        }
    }
}

impl Drop for Open {
    fn drop(&mut self) {
        self.ended.set(Some(Instant::now()));
        if let Some(tls) = &mut self.tls {
            tls.end(&mut self.unsent);
            let _ = self.writer.try_write(&self.unsent);
        }
        if let Some(reader) = &self.reader {
            reader.abort();
        }
    }
}

/// Reads replies until the connection ends.
async fn receive(link: Rc<RefCell<Option<Open>>>, reader: OwnedReadHalf) {
    let mut chunk = vec![0; CHUNK].into_boxed_slice();
    let mut plain = Vec::new();
    loop {
        let read = match reader.readable().await {
            Ok(()) => reader.try_read(&mut chunk),
            Err(error) => Err(error),
        };
        let mut open = link.borrow_mut();
        let Some(found) = open.as_mut() else { return };
        let Open { connection, waiting, tls, unsent, .. } = found;
        let intact = match read {
            Err(error) if error.kind() == ErrorKind::WouldBlock => continue,
            Ok(0) | Err(_) => false,
            Ok(len) => {
                let (received, lasts) = match tls {
                    None => (&chunk[..len], true),
                    Some(tls) => {
                        plain.clear();
                        let intact = tls.receive(&chunk[..len], &mut plain, unsent).is_ok();
                        (&plain[..], intact && !tls.has_ended())
                    }
                };
                let now = found.epoch.elapsed();
                connection.receive(received, now, |done| hand_on(waiting, &done));
                lasts && connection.closed().is_none()
            }
        };
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

/// The bytes of a response; empty for a write, whose echo has been checked.
fn bytes(response: Response<'_>) -> Vec<u8> {
    match response {
        Response::Bits(bits) => bits.as_bytes().to_vec(),
        Response::Registers(registers) => registers.as_bytes().to_vec(),
        _ => Vec::new(),
    }
}

fn answer(outcome: Result<Response<'_>, Failure>) -> Answer {
    outcome.map(bytes).map_err(|failure| match failure {
        Failure::Exception(code) => Fault::Exception(code),
        Failure::Timeout => Fault::Timeout,
        Failure::Invalid(_) => Fault::Invalid,
        _ => Fault::Reset,
    })
}

/// A link that sends one request at a time, by blocking calls in a thread that ends with the link.
pub(super) struct BlockingLink {
    jobs: mpsc::Sender<Job>,
    /// Calls that precede all jobs.
    urgent: mpsc::Sender<Call>,
    retry_at: Cell<Option<Instant>>,
}

enum Job {
    Call(Call),
    /// An urgent call is waiting.
    Look,
    Release,
}

struct Call {
    unit_id: u8,
    request: Box<EncodedRequest>,
    timeout: Duration,
    urgent: bool,
    /// The result, and when an endpoint that could not be opened is tried again.
    answer: oneshot::Sender<(Answer, Option<Instant>)>,
}

impl BlockingLink {
    fn new(endpoint: Endpoint) -> BlockingLink {
        let (jobs, queue) = mpsc::channel::<Job>();
        let (urgent, first) = mpsc::channel::<Call>();
        let client = BlockingClient::new(endpoint);
        let work = move || {
            let (mut failures, mut retry_at) = (0, None);
            let mut carry_out = |call: Call| {
                // A stopped device no longer waits for its read.
                if !call.answer.is_closed() {
                    let answer = carried_out(&client, &call, &mut failures, &mut retry_at);
                    let _ = call.answer.send((answer, retry_at));
                }
            };
            for job in queue {
                first.try_iter().for_each(&mut carry_out);
                match job {
                    Job::Call(call) => carry_out(call),
                    Job::Look => {}
                    Job::Release => client.close(),
                }
            }
        };
        // If the thread does not start, every job fails, and the device reports the fault.
        let _ = std::thread::Builder::new().name("holdfast-line".into()).spawn(work);
        BlockingLink { jobs, urgent, retry_at: Cell::new(None) }
    }

    async fn call(
        &self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        priority: Priority,
    ) -> Answer {
        let (answer, answered) = oneshot::channel();
        let urgent = priority == Priority::Urgent;
        let request = Box::new(request.clone());
        let call = Call { unit_id, request, timeout, urgent, answer };
        let job = if urgent {
            self.urgent.send(call).or(Err(Fault::Reset))?;
            Job::Look
        } else {
            Job::Call(call)
        };
        self.jobs.send(job).or(Err(Fault::Reset))?;
        let (answer, retry_at) = answered.await.unwrap_or((Err(Fault::Reset), None));
        self.retry_at.set(retry_at);
        answer
    }
}

fn carried_out(
    client: &BlockingClient,
    call: &Call,
    failures: &mut u32,
    retry_at: &mut Option<Instant>,
) -> Answer {
    if !call.urgent && retry_at.is_some_and(|time| Instant::now() < time) {
        return Err(Fault::Refused);
    }
    let answer = client.call(call.unit_id, &call.request, call.timeout, bytes);
    let fault = match &answer {
        Err(ClientError::Connect { .. } | ClientError::Tls { maybe_sent: false, .. }) => {
            *failures = failures.saturating_add(1);
            *retry_at = Some(Instant::now() + backoff::pause(*failures, backoff::MAX_PAUSE));
            return Err(Fault::Refused);
        }
        Err(ClientError::Exception(code)) => Fault::Exception(*code),
        Err(ClientError::Timeout(_) | ClientError::ConnectTimeout { .. }) => Fault::Timeout,
        Err(ClientError::Invalid(_)) => Fault::Invalid,
        Ok(_) | Err(ClientError::Lost(_) | ClientError::Tls { .. }) => Fault::Reset,
    };
    (*failures, *retry_at) = (0, None);
    answer.or(Err(fault))
}

#[cfg(test)]
mod tests {
    use holdfast_protocol::pdu::{Range, Request};
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpListener;
    use tokio::runtime::Builder;
    use tokio::task::{LocalSet, spawn_local};

    use super::*;

    const TIMEOUT: Duration = Duration::from_secs(60);

    #[test]
    fn a_request_whose_device_was_stopped_leaves_its_place() {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
            let (host, port) = ("127.0.0.1".to_owned(), listener.local_addr().unwrap().port());
            let tolerance = Tolerance { close_after: 100, ..Tolerance::default() };
            let place = Place::Tcp { host, port, tls: None };
            let link = Link::new(Endpoint { place, tolerance }, InFlight::Fixed(1));
            let range = Range::new(0, 1).unwrap();
            let read = EncodedRequest::new(&Request::ReadHoldingRegisters(range));

            let (for_stopped, request) = (Rc::clone(&link), read.clone());
            let stopped = spawn_local(async move {
                for_stopped.call(1, &request, TIMEOUT, Priority::Usual).await
            });
            let (mut device, _) = listener.accept().await.unwrap();
            let mut request = [0; 12];
            device.read_exact(&mut request).await.unwrap();
            stopped.abort();
            assert!(stopped.await.unwrap_err().is_cancelled());

            let next =
                spawn_local(async move { link.call(1, &read, TIMEOUT, Priority::Usual).await });
            let mut request = [0; 12];
            device.read_exact(&mut request).await.unwrap();
            let reply = [request[0], request[1], 0, 0, 0, 5, 1, 3, 2, 0, 7];
            device.write_all(&reply).await.unwrap();
            assert_eq!(next.await.unwrap(), Ok(vec![0, 7]));
        });
    }
}

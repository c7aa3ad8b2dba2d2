//! A blocking client: it drives a [`Connection`] in the calling thread.
//!
//! The connection is opened on first use and kept open. [`Done::again`] decides whether a request is
//! sent again.

use std::io::ErrorKind;
use std::net::IpAddr;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use holdfast_protocol::client::{Attempt, Closed, Connection, Done, Past, Transport};
use holdfast_protocol::pdu::{EncodedRequest, Response};
use holdfast_runtime::{Epoch, lock};

use super::byte_stream::{ByteStream, StreamError};
use super::connect::connect;
use super::fair_lock::Turns;
use super::interrupt::{Interrupt, SIGNAL_CHECK_INTERVAL};
use super::trace::{Trace, Traced};
use super::{ClientError, Endpoint, Lost, Peers, Place, StrayCounters, connection};

/// Bytes per read of a socket. No Modbus datagram is longer.
const CHUNK_BYTES: usize = 512;

/// The most reads of one `drain`: a peer that never stops sending must not hold the caller past its deadline.
const MAX_READS_PER_DRAIN: usize = 64;

/// A TCP connection that was unused for this time is checked before it is used again.
const CHECK_AFTER_IDLE: Duration = Duration::from_millis(50);

/// A client of one endpoint. Any number of threads can call it; their calls take turns.
pub struct BlockingClient {
    endpoint: Endpoint,
    turns: Turns,
    state: Mutex<State>,
    /// Whether the call that has the turn closes the connection when it ends.
    closes: AtomicBool,
    late: AtomicU64,
    /// The longest time of a late reply, in nanoseconds.
    longest_late: AtomicU64,
    strays: Arc<StrayCounters>,
    /// The zero of the clock of all its connections.
    epoch: Epoch,
    trace: Option<Trace>,
}

/// The state of the connection.
#[derive(Default)]
struct State {
    open: Option<Open>,
    /// What the last connection left to the next one.
    past: Past,
    /// When the last connection ended.
    ended: Option<Instant>,
}

/// An open connection.
struct Open {
    stream: Box<dyn ByteStream>,
    peer: Option<IpAddr>,
    connection: Connection,
    transport: Transport,
    /// The zero of the clock of the connection.
    epoch: Epoch,
    used: Instant,
    /// Late replies that were counted.
    late: u64,
}

/// A request and its attempt.
struct Call<'r> {
    unit_id: u8,
    request: &'r EncodedRequest,
    attempt: Attempt,
    conditions: &'r Conditions<'r>,
    /// Set before its first bytes are sent.
    was_sent: &'r AtomicBool,
    /// Why it was not sent.
    refused: Option<ClientError>,
}

/// When the question is asked whether a request may be sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SendMoment {
    /// It waits, for a connection or for its turn.
    Waiting,
    /// It is sent now if the answer is yes: who answers notes that.
    Sending,
}

/// What a call depends on.
pub struct Conditions<'c> {
    /// Asked before a connection is made for the request, at least every 0.1 s while it waits until it can be
    /// sent, and at the last moment before its first bytes are sent.
    pub may_send: &'c dyn Fn(SendMoment) -> Result<(), ClientError>,
    /// Asked before bytes are sent, and then at most every 0.1 s. If it is false, the connection is
    /// closed.
    pub may_continue: Option<&'c dyn Fn() -> bool>,
    pub peers: Peers,
}

impl Conditions<'_> {
    fn may_continue(&self) -> bool {
        self.may_continue.is_none_or(|may_continue| may_continue())
    }
}

impl BlockingClient {
    pub fn new(endpoint: Endpoint) -> BlockingClient {
        BlockingClient {
            endpoint,
            turns: Turns::default(),
            state: Mutex::default(),
            closes: AtomicBool::new(false),
            late: AtomicU64::new(0),
            longest_late: AtomicU64::new(0),
            strays: Arc::default(),
            epoch: Epoch::now(),
            trace: None,
        }
    }

    /// Shows all bytes that are sent and received to `trace`, in the thread of the call.
    pub fn traced(self, trace: Trace) -> BlockingClient {
        BlockingClient { trace: Some(trace), ..self }
    }

    /// As [`BlockingClient::call`], unless `interrupted` returns true. It is asked at most every 0.1 s.
    /// Returns `None` then, and the connection is closed: a reply would still come. `may_send` is as in
    /// [`Conditions`]. `was_sent` becomes true before the first bytes are sent.
    pub fn interruptible_call<T>(
        &self,
        interrupted: &mut dyn FnMut() -> bool,
        may_send: &dyn Fn(SendMoment) -> Result<(), ClientError>,
        was_sent: &AtomicBool,
        (unit_id, request): (u8, &EncodedRequest),
        timeout: Duration,
        take: impl FnOnce(Response<'_>, &[u8]) -> T,
    ) -> Option<Result<T, ClientError>> {
        let interrupt = Interrupt::new(Some(interrupted));
        let conditions = &Conditions { may_send, may_continue: None, peers: Peers::default() };
        let attempt = Attempt::default();
        let call = Call { unit_id, request, attempt, conditions, was_sent, refused: None };
        self.call_unless(interrupt, call, timeout, take)
    }

    /// Sends a request when it is the caller's turn, and passes its response and the PDU of that to
    /// `take`. `timeout` does not include the wait for the turn. On a serial line, unit id 0 is a broadcast: no unit
    /// replies, and a write counts as done when it is sent.
    ///
    /// # Errors
    /// [`ClientError`]: the request failed, or there is no connection; or that of
    /// [`Conditions::may_send`], if nothing was sent.
    pub fn call<T>(
        &self,
        conditions: &Conditions<'_>,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        take: impl FnOnce(Response<'_>, &[u8]) -> T,
    ) -> Result<T, ClientError> {
        let mut interrupted = || !conditions.may_continue();
        let interrupt = Interrupt::new(match conditions.may_continue {
            None => None,
            Some(_) => Some(&mut interrupted),
        });
        let was_sent = &AtomicBool::new(false);
        let attempt = Attempt::default();
        let call = Call { unit_id, request, attempt, conditions, was_sent, refused: None };
        let called = self.call_unless(interrupt, call, timeout, take);
        called.unwrap_or_else(|| {
            assert!(conditions.may_continue.is_some(), "nobody interrupts this call");
            Err(ClientError::Lost(Lost::Closed(Closed::BySelf)))
        })
    }

    fn call_unless<T>(
        &self,
        mut interrupt: Interrupt<'_>,
        call: Call<'_>,
        timeout: Duration,
        take: impl FnOnce(Response<'_>, &[u8]) -> T,
    ) -> Option<Result<T, ClientError>> {
        let _turn = self.turns.take(&mut interrupt)?;
        let mut state = lock(&self.state);
        let called = self.call_in_turn(&mut state, &mut interrupt, call, timeout, take);
        if self.closes.swap(false, Ordering::Relaxed) {
            state.end();
        }
        called
    }

    fn call_in_turn<T>(
        &self,
        state: &mut State,
        interrupt: &mut Interrupt<'_>,
        mut call: Call<'_>,
        timeout: Duration,
        take: impl FnOnce(Response<'_>, &[u8]) -> T,
    ) -> Option<Result<T, ClientError>> {
        let conditions = call.conditions;
        let mut take = Some(take);
        let mut deadline = Instant::now() + timeout;
        loop {
            if let Err(error) = (conditions.may_send)(SendMoment::Waiting) {
                if !conditions.may_continue() {
                    state.end();
                }
                return Some(Err(error));
            }
            let peers = &conditions.peers;
            let open = match self.connected(state, peers, deadline, timeout, interrupt)? {
                Ok(open) if peers.hold(open.peer) => open,
                Ok(_) => return Some(Err(ClientError::Elsewhere)),
                Err(error) => return Some(Err(error)),
            };
            let late = open.connection.late();
            let (mut result, mut again) = (None, None);
            let lost = open.call(&mut call, deadline, interrupt, &mut |done: Done<'_>| {
                let Some(take) = take.take_if(|_| done.outcome.is_ok() || done.again.is_none())
                else {
                    assert!(done.again.is_some(), "a call has one result");
                    again = done.again;
                    return;
                };
                result = Some(match done.outcome {
                    Ok(response) => Ok(take(response, done.pdu)),
                    Err(failure) => Err(ClientError::new(failure, timeout)),
                });
            });
            self.late.fetch_add(open.connection.late() - late, Ordering::Relaxed);
            let longest = open.connection.longest_late().as_nanos();
            self.longest_late.fetch_max(longest.try_into().unwrap_or(u64::MAX), Ordering::Relaxed);
            open.count_strays(&self.strays);
            // An adapter that has another name now may be open and silent for ever.
            let is_silent = matches!(result, Some(Err(ClientError::Timeout(_))));
            if open.connection.closed().is_some() || is_silent && open.stream.has_moved() {
                state.end();
            }
            if let Some(error) = call.refused.take() {
                return Some(Err(error));
            }
            // A reply that has come is returned in spite of an interrupt.
            if interrupt.is_hit() && !matches!(result, Some(Ok(_))) {
                state.end();
                return None;
            }
            match (result, lost, again) {
                (_, _, Some(attempt)) => {
                    interrupt.sleep_until(Instant::now() + attempt.pause());
                    if interrupt.is_hit() {
                        state.end();
                        return None;
                    }
                    if attempt.has_own_timeout() {
                        deadline = Instant::now() + timeout;
                    }
                    call.attempt = attempt;
                }
                (Some(Err(ClientError::Lost(_))) | None, Some(error), None) => {
                    return Some(Err(self.lost(error)));
                }
                (Some(result), _, None) => return Some(result),
                (None, None, None) => unreachable!("a call ends with a result"),
            }
        }
    }

    /// Returns a usable connection; opens one if necessary. `None` when interrupted.
    fn connected<'s>(
        &self,
        state: &'s mut State,
        peers: &Peers,
        deadline: Instant,
        timeout: Duration,
        interrupt: &mut Interrupt<'_>,
    ) -> Option<Result<&'s mut Open, ClientError>> {
        if let Some(open) = &mut state.open
            && !open.is_usable()
        {
            open.count_strays(&self.strays);
            state.end();
        }
        if state.open.is_none() {
            let from = state.ended.map(|ended| ended + self.endpoint.tolerance.reconnect);
            if let Some(from) = from.filter(|from| *from > Instant::now()) {
                interrupt.sleep_until(from.min(deadline));
            }
            match self.open(peers, deadline, timeout, interrupt) {
                Some(Ok(mut open)) => {
                    if let Some(trace) = &self.trace {
                        let trace = Arc::clone(trace);
                        let stream = Box::new(Traced { stream: open.stream, trace });
                        open = Open { stream, ..open };
                    }
                    open.connection.follow(std::mem::take(&mut state.past));
                    state.open = Some(open);
                }
                failed => {
                    state.end();
                    return failed.map(|failed| failed.map(|_| unreachable!("it was not opened")));
                }
            }
        }
        let Some(open) = &mut state.open else { unreachable!("it was just opened") };
        Some(Ok(open))
    }

    /// Opens a connection. If the caller can be interrupted, in a thread: neither the lookup of a name
    /// nor a connect can be ended early, only left behind.
    fn open(
        &self,
        peers: &Peers,
        deadline: Instant,
        timeout: Duration,
        interrupt: &mut Interrupt<'_>,
    ) -> Option<Result<Open, ClientError>> {
        if interrupt.is_hit() {
            return None;
        }
        let (endpoint, epoch, own) = (self.endpoint.clone(), self.epoch, peers.clone());
        let (sender, opened) = mpsc::sync_channel(1);
        let work = move || {
            // Fails if the caller was interrupted.
            let _ = sender.send(Open::new(&endpoint, epoch, &own, deadline, timeout));
        };
        let connecting = thread::Builder::new().name("holdfast-connect".into());
        if !interrupt.is_possible() || connecting.spawn(work).is_err() {
            return Some(Open::new(&self.endpoint, self.epoch, peers, deadline, timeout));
        }
        loop {
            match opened.recv_timeout(SIGNAL_CHECK_INTERVAL) {
                Ok(opened) => return Some(opened),
                Err(RecvTimeoutError::Timeout) if interrupt.is_hit() => return None,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => unreachable!("the thread sends a result"),
            }
        }
    }

    fn lost(&self, error: StreamError) -> ClientError {
        ClientError::Lost(match error {
            StreamError::Tls(failure) => {
                let maybe_sent = !failure.refuses_connection();
                return ClientError::Tls { to: self.endpoint.to_string(), failure, maybe_sent };
            }
            StreamError::Io(error) => Lost::Io(error),
            StreamError::TimedOut | StreamError::Ended => Lost::Closed(Closed::ByPeer),
            StreamError::Unresolved | StreamError::Elsewhere => {
                unreachable!("an open connection needs no lookup")
            }
        })
    }

    /// Closes the connection after the calls before this one, unless `interrupted` returns true while
    /// they take their time. The next call opens a new one.
    pub fn close(&self, interrupted: Option<&mut dyn FnMut() -> bool>) {
        let Some(_turn) = self.turns.take(&mut Interrupt::new(interrupted)) else { return };
        lock(&self.state).end();
    }

    /// Lets the call that has the turn close the connection when it ends, without a wait for that.
    pub fn close_after_call(&self) {
        self.closes.store(true, Ordering::Relaxed);
    }

    /// Closes an idle connection whose device is gone.
    pub(crate) fn close_if_lost(&self) {
        let mut state = lock(&self.state);
        let Some(open) = &mut state.open else { return };
        let received = open.drain(&mut [0; CHUNK_BYTES], &mut |_| {});
        open.count_strays(&self.strays);
        if received.is_err() || open.connection.closed().is_some() {
            state.end();
        }
    }

    /// What came without a request, or late.
    pub fn strays(&self) -> &Arc<StrayCounters> {
        &self.strays
    }

    /// The number of replies that came after their request had ended.
    pub fn late(&self) -> u64 {
        self.late.load(Ordering::Relaxed)
    }

    /// The longest time that one of them took; 0 if there was none.
    pub fn longest_late(&self) -> Duration {
        Duration::from_nanos(self.longest_late.load(Ordering::Relaxed))
    }
}

impl State {
    fn end(&mut self) {
        if let Some(mut open) = self.open.take() {
            self.past = open.connection.take_past(open.epoch.elapsed());
            self.ended = Some(Instant::now());
        }
    }
}

impl Open {
    fn new(
        endpoint: &Endpoint,
        epoch: Epoch,
        peers: &Peers,
        deadline: Instant,
        timeout: Duration,
    ) -> Result<Open, ClientError> {
        let transport = endpoint.place.transport();
        let to = || endpoint.to_string();
        let stream = connect(&endpoint.place, peers, deadline).map_err(|error| match error {
            StreamError::TimedOut => ClientError::ConnectTimeout { to: to(), after: timeout },
            StreamError::Unresolved => ClientError::LookupTimeout { to: to(), after: timeout },
            StreamError::Elsewhere => ClientError::Elsewhere,
            StreamError::Ended => {
                ClientError::Connect { to: to(), error: ErrorKind::UnexpectedEof.into() }
            }
            StreamError::Io(error) => ClientError::Connect { to: to(), error },
            StreamError::Tls(failure) => ClientError::Tls { to: to(), failure, maybe_sent: false },
        })?;
        let now = Instant::now();
        let connection = connection(transport, endpoint.tolerance, epoch.elapsed());
        let connection = match &endpoint.place {
            Place::Serial(line) => connection.on_line(line.character()),
            _ => connection,
        };
        let peer = stream.peer();
        Ok(Open { stream, peer, connection, transport, epoch, used: now, late: 0 })
    }

    /// Whether the connection can carry another request: the peer has not closed it, and has not
    /// sent bytes without a request.
    #[deny(clippy::wildcard_enum_match_arm)]
    fn is_usable(&mut self) -> bool {
        match self.transport {
            Transport::Tcp => self.used.elapsed() <= CHECK_AFTER_IDLE || !self.stream.has_ended(),
            Transport::RtuOverTcp | Transport::AsciiOverTcp | Transport::RtuOverUdp => {
                let is_quiet = self.stream.is_quiet();
                let mut chunk = [0; CHUNK_BYTES];
                if !is_quiet && let Ok(Some(len)) = self.stream.receive_now(&mut chunk) {
                    self.connection.receive(&chunk[..len], self.epoch.elapsed(), |_| {});
                }
                is_quiet
            }
            // Datagrams have transaction ids. What a line has brought, `exchange` reads first.
            Transport::Udp | Transport::SerialRtu { .. } | Transport::SerialAscii { .. } => true,
        }
    }

    fn count_strays(&mut self, counters: &StrayCounters) {
        counters.take(&mut self.connection, &mut self.late);
    }

    /// Reads what has arrived, without waiting: it must not be taken for the reply to a later request.
    fn drain(
        &mut self,
        chunk: &mut [u8],
        sink: &mut impl FnMut(Done<'_>),
    ) -> Result<(), StreamError> {
        for _ in 0..MAX_READS_PER_DRAIN {
            let Some(len) = self.stream.receive_now(chunk)? else { break };
            self.connection.receive(&chunk[..len], self.epoch.elapsed(), &mut *sink);
        }
        Ok(())
    }

    /// Carries out a request. Returns the I/O error, if there was one.
    fn call(
        &mut self,
        call: &mut Call<'_>,
        deadline: Instant,
        interrupt: &mut Interrupt<'_>,
        sink: &mut impl FnMut(Done<'_>),
    ) -> Option<StreamError> {
        let exchanged = self.exchange(call, deadline, interrupt, sink);
        self.used = Instant::now();
        let error = exchanged.err()?;
        self.connection.close(Closed::ByPeer, sink);
        Some(error)
    }

    fn exchange(
        &mut self,
        call: &mut Call<'_>,
        deadline: Instant,
        interrupt: &mut Interrupt<'_>,
        sink: &mut impl FnMut(Done<'_>),
    ) -> Result<(), StreamError> {
        let mut chunk = [0; CHUNK_BYTES];
        if matches!(self.transport, Transport::SerialRtu { .. } | Transport::SerialAscii { .. }) {
            // On a line that is never silent, the request is not sent.
            while Instant::now() < deadline
                && !interrupt.is_hit()
                && let Some(len) = self.stream.receive_now(&mut chunk)?
            {
                self.connection.receive(&chunk[..len], self.epoch.elapsed(), &mut *sink);
            }
        }
        let now = self.epoch.elapsed();
        let timeout = deadline.saturating_duration_since(Instant::now());
        let Call { unit_id, request, attempt, .. } = *call;
        let sent = self.connection.send_again(unit_id, request, timeout, attempt, now);
        let ticket = match sent {
            Ok(ticket) => ticket,
            Err(why) => {
                call.refused = Some(ClientError::new(why.failure(), timeout));
                self.connection.close(why, sink);
                return Ok(());
            }
        };
        let mut has_begun = false;
        loop {
            let outgoing = self.connection.outgoing();
            let is_sent = !outgoing.is_empty();
            // Also while it waits for late replies: the next request may have nothing to wait for.
            let moment = if is_sent { SendMoment::Sending } else { SendMoment::Waiting };
            if !has_begun && let Err(error) = (call.conditions.may_send)(moment) {
                call.refused = Some(error);
                if !is_sent {
                    self.connection.cancel(ticket, self.epoch.elapsed());
                }
                if self.connection.in_flight() > 0 || !call.conditions.may_continue() {
                    self.connection.close(Closed::BySelf, sink);
                }
                return Ok(());
            }
            if is_sent {
                if !call.conditions.may_continue() {
                    self.connection.close(Closed::BySelf, sink);
                    return Ok(());
                }
                has_begun = true;
                call.was_sent.store(true, Ordering::Relaxed);
                let until = self.connection.deadline().unwrap_or(now);
                match self.stream.send(outgoing, self.epoch.at(until)) {
                    // Part of the request may have been sent.
                    Err(StreamError::TimedOut) => {
                        self.connection.advance(until, &mut *sink);
                        self.connection.close(Closed::TimedOut, sink);
                        return Ok(());
                    }
                    other => other?,
                }
                let len = outgoing.len();
                self.connection.sent(len);
            }
            let Some(until) = self.connection.deadline() else { return Ok(()) };
            if interrupt.is_hit() {
                self.connection.close(Closed::BySelf, sink);
                return Ok(());
            }
            let until = self.epoch.at(until);
            let slice = match has_begun {
                true => interrupt.slice(until),
                false => until.min(Instant::now() + SIGNAL_CHECK_INTERVAL),
            };
            match self.stream.receive(&mut chunk, slice) {
                Ok(len) => {
                    self.connection.receive(&chunk[..len], self.epoch.elapsed(), &mut *sink);
                }
                // The end of a slice.
                Err(StreamError::TimedOut) if Instant::now() < until => {}
                Err(StreamError::TimedOut) => {
                    self.drain(&mut chunk, sink)?;
                    self.connection.advance(self.epoch.elapsed(), &mut *sink);
                }
                Err(error) => return Err(error),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::collections::VecDeque;
    use std::io::Read;
    use std::net::TcpListener;

    use holdfast_protocol::client::{TURNAROUND, Tolerance};
    use holdfast_protocol::frame::rtu;
    use holdfast_protocol::pdu::{Range, Request};

    use super::*;

    fn any_time() -> Conditions<'static> {
        Conditions { may_send: &|_| Ok(()), may_continue: None, peers: Peers::default() }
    }

    /// A stream whose second copy of a reply waits unread when the guard time is over, because the process had no
    /// processor.
    struct Stalled {
        waiting: VecDeque<Vec<u8>>,
        copy: Option<Vec<u8>>,
    }

    impl ByteStream for Stalled {
        fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> Result<usize, StreamError> {
            if self.waiting.is_empty()
                && let Some(copy) = self.copy.take()
            {
                thread::sleep(deadline.saturating_duration_since(Instant::now()));
                self.waiting.push_back(copy);
                return Err(StreamError::TimedOut);
            }
            self.receive_now(buffer)?.ok_or(StreamError::TimedOut)
        }

        fn receive_now(&mut self, buffer: &mut [u8]) -> Result<Option<usize>, StreamError> {
            let Some(bytes) = self.waiting.pop_front() else { return Ok(None) };
            buffer[..bytes.len()].copy_from_slice(&bytes);
            Ok(Some(bytes.len()))
        }

        fn send(&mut self, bytes: &[u8], _deadline: Instant) -> Result<(), StreamError> {
            let mut reply = [0; rtu::MAX_LEN];
            let len = rtu::encode(bytes[0], &[3, 2, bytes[2], bytes[3]], &mut reply);
            let len = len.expect("a short reply fits");
            self.waiting.push_back(reply[..len].to_vec());
            self.copy = Some(reply[..len].to_vec());
            Ok(())
        }
    }

    #[test]
    fn what_came_while_the_process_was_held_up_answers_no_later_request() {
        let place = Place::RtuOverTcp { host: String::new(), port: 0 };
        let client = BlockingClient::new(Endpoint { place, tolerance: Tolerance::default() });
        client.state.lock().unwrap().open = Some(Open {
            stream: Box::new(Stalled { waiting: VecDeque::new(), copy: None }),
            peer: None,
            connection: Connection::new(Transport::RtuOverTcp),
            transport: Transport::RtuOverTcp,
            epoch: client.epoch,
            used: Instant::now(),
            late: 0,
        });
        for address in 1..4 {
            let range = Range::new(address, 1).unwrap();
            let request = EncodedRequest::new(&Request::ReadHoldingRegisters(range));
            let timeout = Duration::from_secs(60);
            let pdu = client.call(&any_time(), 1, &request, timeout, |_, pdu| pdu.to_vec());
            assert_eq!(pdu.unwrap(), [3, 2, 0, address as u8]);
        }
    }

    #[test]
    fn what_may_no_longer_begin_while_it_waits_for_a_late_reply_leaves_the_line_to_the_next_request()
     {
        let place = Place::RtuOverTcp { host: String::new(), port: 0 };
        let client = BlockingClient::new(Endpoint { place, tolerance: Tolerance::default() });
        let range = Range::new(0, 1).unwrap();
        let request = EncodedRequest::new(&Request::ReadHoldingRegisters(range));
        let transport = Transport::SerialRtu { silence: Duration::ZERO };
        let mut connection = Connection::new(transport);
        // Units may confirm it for a minute.
        let timeout = Duration::from_secs(60);
        let write = EncodedRequest::new(&Request::WriteSingleRegister { address: 0, value: 1 });
        let now = client.epoch.elapsed();
        connection.send(0, &write, timeout, now).unwrap();
        connection.sent(connection.outgoing().len());
        connection.advance(now + TURNAROUND, |_| {});
        client.state.lock().unwrap().open = Some(Open {
            stream: Box::new(Stalled { waiting: VecDeque::new(), copy: None }),
            peer: None,
            connection,
            transport,
            epoch: client.epoch,
            used: Instant::now(),
            late: 0,
        });
        let asked = Cell::new(0);
        let may_send = |moment: SendMoment| {
            asked.set(asked.get() + 1);
            if moment == SendMoment::Sending || asked.get() > 3 {
                Err(ClientError::Expired)
            } else {
                Ok(())
            }
        };
        let conditions = Conditions { may_send: &may_send, ..any_time() };
        let answer = client.call(&conditions, 1, &write, timeout, |_, _| ());
        assert!(matches!(answer, Err(ClientError::Expired)), "{answer:?}");
        assert_eq!(asked.get(), 4);
        assert!(client.state.lock().unwrap().open.is_some());
        let answer = client.call(&any_time(), 2, &request, timeout, |_, pdu| pdu.to_vec());
        assert_eq!(answer.unwrap(), [3, 2, 0, 0]);
    }

    #[test]
    fn what_may_no_longer_begin_after_the_connect_is_not_sent() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let (host, port) = ("127.0.0.1".to_owned(), listener.local_addr().unwrap().port());
        let place = Place::Tcp { host, port, tls: None };
        let client = BlockingClient::new(Endpoint { place, tolerance: Tolerance::default() });
        let may_send = |moment| match moment {
            SendMoment::Sending => Err(ClientError::Expired),
            SendMoment::Waiting => Ok(()),
        };
        let conditions = Conditions { may_send: &may_send, ..any_time() };
        let write = EncodedRequest::new(&Request::WriteSingleRegister { address: 0, value: 1 });
        let answer = client.call(&conditions, 1, &write, Duration::from_secs(60), |_, _| ());
        assert!(matches!(answer, Err(ClientError::Expired)), "{answer:?}");
        drop(client);
        let mut received = Vec::new();
        listener.accept().unwrap().0.read_to_end(&mut received).unwrap();
        assert_eq!(received, []);
    }
}

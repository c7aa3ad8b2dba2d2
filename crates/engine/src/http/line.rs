//! The bytes of one connection, between its socket and hyper, and how long it may wait for what.

use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};

use holdfast_runtime::lock;
use hyper::rt::{Read, ReadBufCursor, Write};
use socket2::SockRef;
use tokio::time::Sleep;

use super::exchange::{Exchange, LooksForEnd, Order, WeakConnection};
use super::front::Front;
use super::refusal::{self, Refusal};
use super::request_bytes::{ChunksEnd, HeadEnd, Portion};
use crate::server::Peer;
use crate::server::connections::admission::{Ticket, WaitingFor};
use crate::server::reports::event::Kind;
use crate::server::transports::stream::{self, End, Stream};

/// Bytes per read of the socket, and the most that a connection holds of requests that were sent ahead.
const CHUNK_BYTES: usize = 16 * 1024;

/// The time that a handler has to answer a request that did not arrive in time.
const LATE_ANSWER: Duration = Duration::from_secs(1);

/// The longest pause of the alarm for the deadlines.
pub(super) const NEVER: Duration = Duration::from_secs(3600);

thread_local! {
    static INPUT: std::cell::RefCell<Box<[u8]>> =
        std::cell::RefCell::new(vec![0; CHUNK_BYTES].into_boxed_slice());
}

/// How far the current request has been answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Answer {
    /// There is no request yet.
    None,
    /// The handler has the request.
    Awaited,
    /// hyper has the response, or begins to get it.
    Begun,
    /// hyper has all of the response.
    Complete,
}

pub(super) struct Line {
    pub(super) front: Arc<Front>,
    pub(super) ticket: Ticket,
    pub(super) peer: Peer,
    stream: Box<dyn Stream>,
    /// Bytes that the system has not taken yet.
    unsent: Vec<u8>,
    /// Received bytes, of which `taken` were read by hyper.
    held: Vec<u8>,
    taken: usize,
    portion: Portion,
    /// Whether the peer sends no more.
    pub(super) is_ended: bool,
    /// Whether somebody waits for the body of the request. hyper reads ahead without it.
    is_asked: bool,
    /// Whether the peer has sent anything.
    pub(super) is_used: bool,
    answer: Answer,
    pub(super) exchange: Option<Arc<Exchange>>,
    /// Since when it waits for what it waits for.
    since: Instant,
    request_due: Option<Instant>,
    reply_due: Option<Instant>,
    idle_due: Option<Instant>,
    is_late: bool,
    /// Why hyper refused what it could not parse.
    pub(super) refused: Option<Refusal>,
    /// Whether the end of the connection was announced.
    is_shut: bool,
}

/// The line, shared by hyper, the handler's response and the task of the connection. They all run in one
/// task, so nobody waits for the lock, unless a handler looks for the end at the same moment.
#[derive(Clone)]
pub(super) struct SharedLine(Arc<Mutex<Line>>);

/// How a connection ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ConnectionEnd {
    /// After a response. What the peer still sends is read for a while, so that it gets the response.
    Answered,
    /// Between requests. With TLS, the end is announced.
    Idle,
    /// At once: the peer is gone or late, its request is broken, or the handler has abandoned it.
    Dropped,
}

/// What a deadline that has passed asks for.
#[derive(Debug, PartialEq, Eq)]
enum Verdict {
    Stay,
    Drop(Kind),
    /// As `Drop`, after it was reported already.
    DropAgain,
}

impl SharedLine {
    pub(super) fn new(
        front: Arc<Front>,
        (ticket, peer): (Ticket, Peer),
        stream: Box<dyn Stream>,
        request_due: Instant,
    ) -> SharedLine {
        let now = Instant::now();
        let line = Line {
            request_due: Some(request_due),
            front,
            ticket,
            peer,
            stream,
            unsent: Vec::new(),
            held: Vec::new(),
            taken: 0,
            portion: Portion::Head(HeadEnd::default()),
            is_ended: false,
            is_asked: false,
            is_used: false,
            answer: Answer::None,
            exchange: None,
            since: now,
            reply_due: None,
            idle_due: None,
            is_late: false,
            refused: None,
            is_shut: false,
        };
        SharedLine(Arc::new(Mutex::new(line)))
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, Line> {
        lock(&self.0)
    }

    pub(super) fn downgrade(&self) -> WeakConnection {
        let line: Arc<Mutex<dyn LooksForEnd>> = self.0.clone();
        Arc::downgrade(&line)
    }

    /// The line, when hyper and the response are done with it.
    pub(super) fn into_line(self) -> Option<Line> {
        Some(Arc::into_inner(self.0)?.into_inner().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Line {
    /// A request has begun: hyper has read its header. `None`: its body has no length.
    /// Returns whether its header is ambiguous.
    pub(super) fn begin(&mut self, exchange: Arc<Exchange>, body: Option<u64>) -> bool {
        let is_ambiguous = matches!(&self.portion, Portion::Head(head) if head.is_ambiguous());
        self.portion = body.map_or_else(|| Portion::Chunks(ChunksEnd::default()), Portion::Body);
        self.answer = Answer::Awaited;
        self.exchange = Some(exchange);
        if body == Some(0) {
            self.note_arrived();
        }
        self.note_waiting();
        is_ambiguous
    }

    /// Whether this many bytes of a body have arrived.
    pub(super) fn has(&self, len: u64) -> bool {
        (self.held.len() - self.taken) as u64 >= len
    }

    /// All of the request has arrived.
    pub(super) fn note_arrived(&mut self) {
        self.portion = Portion::Body(0);
        self.request_due = None;
        self.note_waiting();
    }

    pub(super) fn note_asked(&mut self) {
        self.is_asked = true;
    }

    pub(super) fn note_answering(&mut self) {
        self.answer = Answer::Begun;
        self.note_waiting();
    }

    /// hyper has all of the response, or needs no more of it.
    pub(super) fn note_answered(&mut self) {
        self.answer = Answer::Complete;
        self.note_waiting();
    }

    /// Whether a request waits for its response.
    pub(super) fn is_busy(&self) -> bool {
        matches!(self.answer, Answer::Awaited | Answer::Begun)
    }

    /// Whether the client is gone, although its connection is only half closed.
    pub(super) fn is_left(&self) -> bool {
        let leaves = |exchange: &Arc<Exchange>| self.front.settings.leaving || exchange.leaves();
        self.is_ended && self.is_busy() && self.exchange.as_ref().is_some_and(leaves)
    }

    /// Whether the handler waits for the rest of the request.
    pub(super) fn lacks_rest(&self) -> bool {
        self.answer == Answer::Awaited && self.is_asked && !self.portion.is_over()
    }

    /// Whether it waits for the next request, and nothing else is left to do.
    pub(super) fn is_idle(&self) -> bool {
        self.idle_due.is_some() && self.unsent.is_empty()
    }

    /// Whether the peer may still send what nobody reads. Closing the socket then could destroy the
    /// response on its way.
    pub(super) fn has_unread(&self) -> bool {
        !self.is_ended
            && (self.refused.is_some()
                || self.taken < self.held.len()
                || !matches!(self.portion, Portion::Head(_)) && !self.portion.is_over())
    }

    /// Announces the end of the connection, without waiting.
    pub(super) fn announce_end(&mut self) {
        self.stream.end(&mut self.unsent);
        let _ = stream::flush_now(self.stream.socket(), &mut self.unsent);
    }

    pub(super) fn into_stream(self) -> Box<dyn Stream> {
        self.stream
    }

    /// The response is complete: the next request may begin.
    fn next_request(&mut self) {
        self.portion = Portion::Head(HeadEnd::default());
        self.answer = Answer::None;
        self.exchange = None;
        self.is_late = false;
        self.is_asked = false;
        let now = Instant::now();
        self.since = now;
        if self.taken < self.held.len() {
            self.request_due = Some(now + self.front.settings.request_timeout);
        } else {
            self.request_due = None;
            self.idle_due = Some(now + self.front.settings.idle_timeout);
        }
        self.note_waiting();
    }

    /// Tells the admission what the connection waits for.
    fn note_waiting(&mut self) {
        let is_taken = self.reply_due.is_none();
        let has_arrived = self.portion.is_over();
        let waiting = if self.is_busy() && is_taken && (self.answer == Answer::Begun || has_arrived)
        {
            WaitingFor::Handler
        } else if is_taken && self.idle_due.is_some() {
            WaitingFor::NextRequest
        } else if is_taken && !self.is_used {
            WaitingFor::FirstRequest
        } else {
            WaitingFor::Rest
        };
        self.ticket.wait(waiting, self.since);
    }

    /// How many of the bytes that were received hyper may read.
    fn allowed(&mut self) -> usize {
        let received = &self.held[self.taken..];
        let len = self.portion.len(received);
        // After the end, a part of a header is all that there is.
        let is_head = matches!(self.portion, Portion::Head(_));
        let is_part = is_head && len == 0 && !self.portion.hyper_missed_end();
        if self.is_ended && is_part { received.len() } else { len }
    }

    /// hyper has read bytes.
    fn note_taken(&mut self, len: usize) {
        self.taken += len;
        if self.taken == self.held.len() {
            // Idle connections hold no memory.
            (self.held, self.taken) = (Vec::new(), 0);
        }
        self.portion.skip(len);
        if self.portion.is_over() {
            self.note_arrived();
        }
    }

    /// Reads once. Returns the number of bytes, 0 at the end.
    pub(super) fn poll_fill(&mut self, context: &mut Context<'_>) -> Poll<Result<usize, End>> {
        let read = ready!(INPUT.with_borrow_mut(|input| self.poll_read_into(context, input)));
        match read {
            Ok(0) => self.is_ended = true,
            Ok(_) => self.note_received(),
            Err(End::TlsFailed(_)) => {
                self.front.ended(Kind::from(read.unwrap_err()), self.peer.clone());
            }
            Err(_) => {}
        }
        Poll::Ready(read)
    }

    fn poll_read_into(
        &mut self,
        context: &mut Context<'_>,
        input: &mut [u8],
    ) -> Poll<Result<usize, End>> {
        loop {
            match ready!(self.stream.poll_read(context, input, &mut self.unsent)) {
                // A record of TLS without data.
                Ok(0) => {}
                Ok(len) => {
                    self.hold(&input[..len]);
                    return Poll::Ready(Ok(len));
                }
                Err(End::ByPeer) => return Poll::Ready(Ok(0)),
                Err(end) => return Poll::Ready(Err(end)),
            }
        }
    }

    fn hold(&mut self, received: &[u8]) {
        self.held.drain(..self.taken);
        self.taken = 0;
        self.held.extend_from_slice(received);
    }

    fn note_received(&mut self) {
        self.is_used = true;
        if matches!(self.portion, Portion::Head(_)) {
            self.idle_due = None;
            if self.request_due.is_none() {
                self.since = Instant::now();
                self.request_due = Some(self.since + self.front.settings.request_timeout);
            }
        }
        self.note_waiting();
    }

    /// While a request is answered: reads what the peer sends ahead, so that its end is noticed.
    /// Returns whether the connection is broken.
    pub(super) fn poll_ahead(&mut self, context: &mut Context<'_>) -> bool {
        while self.reads_ahead() {
            match self.poll_fill(context) {
                Poll::Ready(Ok(_)) => {}
                Poll::Ready(Err(_)) => return true,
                Poll::Pending => return false,
            }
        }
        false
    }

    fn reads_ahead(&self) -> bool {
        self.is_busy()
            && self.portion.is_over()
            && !self.is_ended
            && self.held.len() - self.taken < CHUNK_BYTES
    }

    /// Ready when a deadline has passed: the connection ends.
    pub(super) fn poll_deadlines(
        &mut self,
        context: &mut Context<'_>,
        mut alarm: Pin<&mut Sleep>,
    ) -> Poll<ConnectionEnd> {
        loop {
            let due = self.due().unwrap_or_else(|| Instant::now() + NEVER);
            if alarm.deadline().into_std() > due {
                alarm.as_mut().reset(due.into());
            }
            if alarm.as_mut().poll(context).is_pending() {
                return Poll::Pending;
            }
            match self.check_deadlines(Instant::now()) {
                Verdict::Stay => {
                    let next = self.due().unwrap_or_else(|| Instant::now() + NEVER);
                    alarm.as_mut().reset(next.into());
                }
                Verdict::Drop(kind) => {
                    self.front.ended(kind, self.peer.clone());
                    let is_idle = kind == Kind::Idle;
                    return Poll::Ready(if is_idle {
                        ConnectionEnd::Idle
                    } else {
                        ConnectionEnd::Dropped
                    });
                }
                Verdict::DropAgain => return Poll::Ready(ConnectionEnd::Dropped),
            }
        }
    }

    /// The next time at which a deadline may have passed.
    fn due(&self) -> Option<Instant> {
        [self.request_due, self.reply_due, self.idle_due].into_iter().flatten().min()
    }

    /// Judges the deadlines.
    fn check_deadlines(&mut self, now: Instant) -> Verdict {
        let has_passed = |due: Option<Instant>| due.is_some_and(|due| due <= now);
        if has_passed(self.reply_due) {
            return Verdict::Drop(Kind::SlowReader);
        }
        if has_passed(self.request_due) {
            return self.handle_late_request(now);
        }
        if has_passed(self.idle_due) {
            return Verdict::Drop(Kind::Idle);
        }
        Verdict::Stay
    }

    /// A request did not arrive in time. Its handler may answer if it waits for the body.
    fn handle_late_request(&mut self, now: Instant) -> Verdict {
        match &self.exchange {
            _ if self.is_late => Verdict::DropAgain,
            Some(_) if self.is_busy() && !self.is_asked => {
                // The peer waits for the handler, not the handler for the peer.
                self.request_due = Some(now + self.front.settings.request_timeout);
                Verdict::Stay
            }
            Some(exchange) if self.is_busy() => {
                exchange.order(Order::Late);
                self.is_late = true;
                self.request_due = Some(now + LATE_ANSWER);
                self.front.ended(Kind::RequestTimeout, self.peer.clone());
                Verdict::Stay
            }
            _ => Verdict::Drop(Kind::RequestTimeout),
        }
    }

    /// Sends what the system has not taken yet.
    fn poll_unsent(&mut self, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        while !self.unsent.is_empty() {
            if self.stream.socket().poll_write_ready(context)?.is_pending() {
                if self.reply_due.is_none() {
                    self.since = Instant::now();
                    self.reply_due = Some(self.since + self.front.settings.request_timeout);
                    self.note_waiting();
                }
                return Poll::Pending;
            }
            match self.stream.socket().try_write(&self.unsent) {
                Ok(sent) => _ = self.unsent.drain(..sent),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => return Poll::Ready(Err(error)),
            }
        }
        if self.reply_due.take().is_some() {
            self.unsent = Vec::new();
            self.since = Instant::now();
            self.note_waiting();
        }
        Poll::Ready(Ok(()))
    }
}

impl LooksForEnd for Line {
    /// As `poll_ahead`, and also what the runtime has not reported yet.
    fn look_for_end(&mut self) -> bool {
        INPUT.with_borrow_mut(|input| {
            while self.reads_ahead()
                && let Some(len @ 1..) = self.stream.read_now(input, &mut self.unsent)
            {
                self.hold(&input[..len]);
                self.note_received();
            }
        });
        self.is_ended |= self.stream.has_ended();
        self.is_ended
    }
}

/// The line as hyper uses it.
pub(super) struct Wire(pub(super) SharedLine);

impl Read for Wire {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        mut buffer: ReadBufCursor<'_>,
    ) -> Poll<io::Result<()>> {
        let line = &mut *self.0.lock();
        if line.answer == Answer::Complete && line.portion.is_over() {
            line.next_request();
        }
        loop {
            let len = line.allowed().min(buffer.remaining());
            if len > 0 {
                buffer.put_slice(&line.held[line.taken..line.taken + len]);
                line.note_taken(len);
                return Poll::Ready(Ok(()));
            }
            if line.portion.is_over() {
                // The next request has to wait. The task is polled when the response is complete.
                return Poll::Pending;
            }
            if line.portion.hyper_missed_end() {
                // hyper would take all that follows for the rest of the header.
                line.front.ended(Kind::BrokenRequest, line.peer.clone());
                return Poll::Ready(Err(io::ErrorKind::InvalidData.into()));
            }
            if line.is_ended {
                return Poll::Ready(Ok(()));
            }
            if ready!(line.poll_fill(context)).is_err() {
                return Poll::Ready(Err(io::ErrorKind::ConnectionReset.into()));
            }
        }
    }
}

impl Write for Wire {
    fn poll_write(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let line = &mut *self.0.lock();
        ready!(line.poll_unsent(context))?;
        let broken = |_| io::Error::from(io::ErrorKind::BrokenPipe);
        if line.answer == Answer::None && line.refused.is_none() {
            // Nobody has a request, so this is hyper's response to what it can't parse.
            let refusal = refusal::of_response(bytes);
            line.refused = Some(refusal);
            line.front.ended(Kind::BrokenRequest, line.peer.clone());
            let response = refusal::completed(bytes, line.front.refusal(refusal));
            line.stream.send(&response, &mut line.unsent).map_err(broken)?;
        } else {
            line.stream.send(bytes, &mut line.unsent).map_err(broken)?;
        }
        Poll::Ready(Ok(bytes.len()))
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let line = &mut *self.0.lock();
        ready!(line.poll_unsent(context))?;
        if let Some(exchange) = &line.exchange {
            exchange.flushed();
        }
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let line = &mut *self.0.lock();
        if !std::mem::replace(&mut line.is_shut, true) {
            line.stream.end(&mut line.unsent);
        }
        ready!(line.poll_unsent(context))?;
        let _ = SockRef::from(line.stream.socket()).shutdown(std::net::Shutdown::Write);
        Poll::Ready(Ok(()))
    }
}

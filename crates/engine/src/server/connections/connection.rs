//! A Modbus connection over a stream: receives bytes, answers all complete requests in order, sends
//! bytes.
//!
//! All connections of a worker thread share one pair of buffers ([`Scratch`]): nothing is awaited
//! between a read and the write that answers it. A connection keeps only what is left over: the
//! beginning of a request, or replies that a slow peer has not read. While such replies wait, no more
//! requests are read. Requests to devices are answered later ([`super::reply_order`]).

use std::cell::RefCell;
use std::future::poll_fn;
use std::io;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use holdfast_protocol::frame::mbap;
use holdfast_protocol::pdu;
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::task::{coop, yield_now};
use tokio::time::{Instant, Sleep, sleep_until};

use crate::server::connections::admission::Ticket;
use crate::server::connections::deadlines::{Deadlines, Exchange, Expired, NO_DEADLINE, Timeouts};
use crate::server::connections::listener::{ListenerContext, Serving};
use crate::server::connections::peer::Peer;
use crate::server::connections::reply_order::{Deferral, Deferred, MAX_WAITING};
use crate::server::connections::worker_share::{Share, WORK_OF_READ};
use crate::server::reports::event::Kind;
use crate::server::reports::refused_request::Reported;
use crate::server::requests::unit_server::{ASCII_DELIMITER, UnitServer, changed_delimiter};
use crate::server::rights::functions::only_reads;
use crate::server::rights::peer_rights::PeerRights;
use crate::server::transports::framing::{Ascii, Framing, Mbap, Next, Rtu};
use crate::server::transports::stream::{self, Stream};

/// Bytes per read of a socket, together with those of a connection that wait.
const INPUT_BYTES: usize = 4096;

/// Room for the replies to all requests of one read, or to those that waited, and for those that come later.
const OUTPUT_BYTES: usize =
    output::<Mbap>(output::<Rtu>(output::<Ascii>(0))) + MAX_WAITING * Ascii::MAX_LEN;

const fn output<F: Framing>(least: usize) -> usize {
    // A read has room for at least one byte.
    assert!(F::MAX_LEN < INPUT_BYTES);
    assert!(F::HEADER_LEN + pdu::MAX_LEN <= F::MAX_LEN);
    // Those that waited have an MBAP header: in ASCII, as many would be longer.
    let shortest =
        if F::MIN_FRAME_LEN < Mbap::MIN_FRAME_LEN { F::MIN_FRAME_LEN } else { Mbap::MIN_FRAME_LEN };
    let len = (INPUT_BYTES / shortest + 1) * F::MAX_LEN;
    if len > least { len } else { least }
}

/// The most reads of a connection before other tasks run.
const READS_PER_TURN: u32 = 4;

/// The most reads of the remaining input before a connection ends: a peer may go on sending.
const MAX_LAST_READS: usize = 64;

struct Scratch {
    input: Box<[u8]>,
    output: Box<[u8]>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::new(Scratch {
        input: vec![0; INPUT_BYTES].into_boxed_slice(),
        output: vec![0; OUTPUT_BYTES].into_boxed_slice(),
    });
}

/// What a connection may do, and how long it may take.
pub(crate) struct Terms {
    pub(crate) rights: Arc<PeerRights>,
    pub(crate) timeouts: Timeouts,
}

/// Looks up the terms of a connection again.
pub(crate) trait Renewal: Send + Sync {
    /// `None` if it has no rights any more.
    fn terms(&self, peer: &Peer) -> Option<Terms>;
}

pub(crate) struct Connection<F: Framing, S> {
    /// Before the stream: once the peer can see the end, none of its requests that wait is sent any more.
    answering: Answering<F>,
    stream: S,
    deadlines: Deadlines,
    renewal: Arc<dyn Renewal>,
    ticket: Ticket,
    /// Bytes queued for the peer.
    unsent: Vec<u8>,
    /// Reads since other tasks last ran.
    reads_in_turn: u32,
    /// Whether the runtime may not know that there are bytes to read.
    readiness_unknown: bool,
    /// Whether the last read took all that had arrived.
    has_read_all: bool,
    share: Share,
}

/// Whether the peer is still there, by what the system has received behind the bytes that were read.
type IsThere<'a> = &'a dyn Fn() -> bool;

/// The state that replies depend on.
struct Answering<F: Framing> {
    context: Arc<ListenerContext>,
    peer: Peer,
    unit_server: Arc<UnitServer>,
    rights: Arc<PeerRights>,
    /// The beginning of an incomplete request. Most connections never have one.
    partial: Vec<u8>,
    /// What is known of the bytes before it.
    parser: F::ParserState,
    /// The last character of an ASCII frame, which the peer can change.
    delimiter: u8,
    reported: Reported,
    /// `None` until a request is answered later.
    deferred: Option<Box<Deferred>>,
    /// Whether the next request shows that its peer no longer waits for replies to earlier ones.
    gives_up: bool,
    /// The engine waits until it is dropped; `None` before the connection is served.
    running: Option<watch::Receiver<bool>>,
}

/// The result of answering some input.
struct Answered {
    /// Bytes of output.
    len: usize,
    requests: usize,
    /// Frames that were discarded.
    discarded: usize,
    /// Bytes of complete frames.
    consumed: usize,
    /// A frame was broken. Bytes after it were ignored.
    broken: bool,
}

impl<F: Framing, S: Stream + 'static> Connection<F, S> {
    pub(crate) fn new(
        context: Arc<ListenerContext>,
        unit_server: Arc<UnitServer>,
        (stream, peer): (S, Peer),
        Terms { rights, timeouts }: Terms,
        renewal: Arc<dyn Renewal>,
        ticket: Ticket,
    ) -> Connection<F, S> {
        let share = Share::of(&peer);
        let answering = Answering::new(context, peer, unit_server, rights);
        Connection {
            stream,
            answering,
            deadlines: Deadlines::new(timeouts),
            renewal,
            ticket,
            unsent: Vec::new(),
            reads_in_turn: 0,
            readiness_unknown: false,
            has_read_all: false,
            share,
        }
    }

    /// Takes over bytes that were already read: the beginning of a request.
    pub(crate) fn begin_with(&mut self, received: &[u8]) {
        if !received.is_empty() {
            self.answering.keep(received);
            self.deadlines.begin();
        }
    }

    /// Serves until the connection ends. The end is counted before the peer can see it. As a block: an
    /// `async fn` would have room for the connection twice.
    pub(crate) fn run(mut self, mut stop: watch::Receiver<bool>) -> Serving {
        self.answering.running = Some(stop.clone());
        Box::pin(async move {
            match self.serve(&mut stop).await {
                Some(end) => {
                    self.answering.give_up();
                    self.answering.ended(end);
                    // After replies that were cut off, a closing message would be misread.
                    if self.unsent.is_empty() {
                        self.stream.end(&mut self.unsent);
                        let _ = stream::flush_now(self.stream.socket(), &mut self.unsent);
                    }
                }
                None => {
                    self.finish().await;
                    self.answering.ended(Kind::Closed);
                }
            }
        })
    }

    /// Serves until the connection ends. Returns `None` when the engine stops.
    async fn serve(&mut self, stop: &mut watch::Receiver<bool>) -> Option<Kind> {
        let stopping = stop.clone();
        let mut stopped = pin!(stop.wait_for(|stop| *stop));
        let mut alarm = pin!(sleep_until(Instant::now() + NO_DEADLINE));
        // Whether both of them wake this task.
        let mut is_armed = false;
        loop {
            // In a box: most peers read their replies.
            if !self.unsent.is_empty()
                && let Err(end) = Box::pin(self.send_unsent()).await
            {
                return Some(end);
            }
            is_armed &= !self.set_alarm(alarm.as_mut());
            let step = poll_fn(|context| {
                if stopping.has_changed().unwrap_or(true) {
                    return Poll::Ready(None);
                }
                if let Poll::Ready(step) = self.poll(context) {
                    return Poll::Ready(Some(step));
                }
                // A task keeps its waker, so both need it only once.
                if !is_armed {
                    if stopped.as_mut().poll(context).is_ready() {
                        return Poll::Ready(None);
                    }
                    let _ = alarm.as_mut().poll(context);
                    // Without a budget, both return Pending, and keep no waker: they are polled again.
                    is_armed = coop::has_budget_remaining();
                }
                if alarm.is_elapsed() { self.on_alarm().map(Some) } else { Poll::Pending }
            });
            match step.await {
                None => return None,
                Some(Err(end)) => return Some(end),
                Some(Ok(())) => {}
            }
            if self.reads_in_turn == READS_PER_TURN {
                self.reads_in_turn = 0;
                yield_now().await;
            }
        }
    }

    /// Reads and answers once, unless the source has used its share. Or writes replies that have come.
    fn poll(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Kind>> {
        if self.answering.is_waiting() {
            if let Poll::Ready(step) = self.poll_deferred(context) {
                return Poll::Ready(step);
            }
            if self.answering.room() == 0 {
                self.reads_in_turn = 0;
                (self.readiness_unknown, self.has_read_all) = (true, false);
                return stream::poll_end(self.stream.socket(), context).map(Err);
            }
        }
        // Most peers send one request at a time: behind it, there is nothing yet that takes a share.
        let is_idle =
            std::mem::take(&mut self.has_read_all) && self.stream.poll_ready(context).is_pending();
        if is_idle || self.share.poll(context).is_pending() {
            self.reads_in_turn = 0;
            return Poll::Pending;
        }
        let read = self.poll_read(context);
        self.share.pass_on();
        read
    }

    /// Reads once, answers all complete requests, and writes once.
    fn poll_read(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Kind>> {
        SCRATCH.with_borrow_mut(|Scratch { input, output }| {
            let partial = self.answering.restore(input);
            let room = self.answering.room();
            let free = &mut input[partial..][..room];
            let unsent = &mut self.unsent;
            let known =
                if self.readiness_unknown { self.stream.read_now(free, unsent) } else { None };
            self.readiness_unknown = known.is_some();
            let read = match known {
                Some(len) => Poll::Ready(Ok(len)),
                None => self.stream.poll_read(context, free, unsent),
            };
            let Poll::Ready(read) = read else {
                self.reads_in_turn = 0;
                return Poll::Pending;
            };
            self.reads_in_turn += 1;
            let read = read?;
            self.has_read_all = !self.readiness_unknown && read < room;
            ready!(self.renew())?;
            self.answering.gives_up =
                !F::HAS_IDS && self.answering.is_waiting() && self.deadlines.has_given_up();
            let is_there = || !self.stream.has_ended();
            let answered = self.answering.answer(&is_there, &input[..partial + read], output);
            self.note_answered(&answered);
            let output = &output[..answered.len];
            if !output.is_empty() {
                self.stream.send(output, &mut self.unsent)?;
            }
            Poll::Ready(if answered.broken { Err(Kind::BrokenFrame) } else { Ok(()) })
        })
    }

    /// Writes replies that have come, and answers what waited for them.
    fn poll_deferred(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Kind>> {
        SCRATCH.with_borrow_mut(|Scratch { output, .. }| {
            let Some(mut len) = self.answering.collect(context, output) else {
                self.reads_in_turn = 0;
                return Poll::Pending;
            };
            self.reads_in_turn += 1;
            if self.answering.behind() > 0 {
                ready!(self.renew())?;
                let is_there = || !self.stream.has_ended();
                let (written, taken) = self.answering.resume(&is_there, &mut output[len..]);
                len += written;
                self.share.charge(taken);
            }
            self.note_exchange(Instant::now());
            if len > 0 {
                self.stream.send(&output[..len], &mut self.unsent)?;
            }
            Poll::Ready(Ok(()))
        })
    }

    /// Looks up rights and timeouts again after a reload. Pending if the connection has been ended.
    #[inline]
    fn renew(&mut self) -> Poll<Result<(), Kind>> {
        if ready!(self.ticket.poll_outdated()) {
            let Terms { rights, timeouts } =
                self.renewal.terms(&self.answering.peer).ok_or(Kind::RightsRevoked)?;
            (self.answering.rights, self.deadlines.timeouts) = (rights, timeouts);
            // Other rights refuse other requests: each first one is reported again.
            self.answering.reported = Reported::default();
        }
        Poll::Ready(Ok(()))
    }

    /// Notes the work of the source, and the times that the deadlines depend on.
    fn note_answered(&mut self, answered: &Answered) {
        let now = Instant::now();
        if answered.requests > 0 {
            self.note_exchange(now);
        }
        self.share.charge(WORK_OF_READ + (answered.requests + answered.discarded) as u32);
        let is_at_start = F::is_at_start(&self.answering.parser);
        if self.answering.partial.is_empty() && is_at_start && !self.stream.is_amid_record() {
            return self.deadlines.note_complete();
        }
        // Bytes that are discarded until a silence do not put off the end of the connection.
        let is_new = answered.requests > 0 || answered.consumed > 0 && is_at_start;
        self.deadlines.note_partial(now, is_new);
    }

    /// Notes a request that was complete, or a reply that has come.
    #[inline]
    fn note_exchange(&mut self, now: Instant) {
        self.deadlines.note_request(now);
        self.ticket.touch_modbus(now.into_std(), self.answering.is_waiting());
    }

    /// Waits for the peer to read its replies.
    async fn send_unsent(&mut self) -> Result<(), Kind> {
        let time_limit = self.deadlines.timeouts.request;
        stream::send_all(self.stream.socket(), &self.unsent, time_limit).await?;
        // Frees the buffer of a slow peer.
        self.unsent = Vec::new();
        Ok(())
    }

    fn exchange(&self) -> Exchange {
        if !self.answering.partial.is_empty() || self.stream.is_amid_record() {
            Exchange::Request
        } else if self.answering.is_waiting() {
            Exchange::Replies
        } else {
            Exchange::Idle
        }
    }

    /// Moves the alarm to an earlier time. A later deadline is set when the alarm fires: requests
    /// are much more frequent than alarms.
    /// Returns whether it has moved.
    fn set_alarm(&self, alarm: Pin<&mut Sleep>) -> bool {
        let deadline = self.deadlines.next(self.exchange());
        let moves = deadline < alarm.deadline() || alarm.is_elapsed();
        if moves {
            alarm.reset(deadline);
        }
        moves
    }

    /// Discards the beginning of a request that nothing followed, or ends the connection.
    fn on_alarm(&mut self) -> Poll<Result<(), Kind>> {
        // The alarm may be that of a timeout which a reload has changed.
        ready!(self.renew())?;
        let now = Instant::now();
        match self.deadlines.expired(now, self.exchange()) {
            Expired::Nothing => {}
            Expired::Frame | Expired::Connection(_)
                if self.share.is_waiting() || self.answering.room() == 0 =>
            {
                self.deadlines.restart(now);
            }
            Expired::Frame => {
                self.answering.discard_partial();
                self.deadlines.note_complete();
            }
            Expired::Connection(kind) => return Poll::Ready(Err(kind)),
        }
        Poll::Ready(Ok(()))
    }

    /// Answers what the system has already received, then ends. The engine drops connections whose
    /// devices take too long.
    async fn finish(&mut self) {
        // An error: a peer that does not read loses these replies.
        if self.answering.drain(&mut self.stream, &mut self.unsent).is_err() {
            return;
        }
        while self.answering.is_waiting() {
            let step = poll_fn(|context| self.poll_deferred(context)).await;
            let sent = stream::flush_now(self.stream.socket(), &mut self.unsent);
            if step.is_err() || sent.is_err() {
                return;
            }
        }
        self.stream.end(&mut self.unsent);
        let _ = stream::flush_now(self.stream.socket(), &mut self.unsent);
    }
}

impl<F: Framing> Drop for Answering<F> {
    /// Also when the task of the connection is aborted: a client can't keep a write out of the audit log by its end.
    fn drop(&mut self) {
        // Without a runtime, the engine is gone.
        if Handle::try_current().is_ok() {
            self.give_up();
        }
    }
}

impl<F: Framing> Answering<F> {
    fn new(
        context: Arc<ListenerContext>,
        peer: Peer,
        unit_server: Arc<UnitServer>,
        rights: Arc<PeerRights>,
    ) -> Answering<F> {
        Answering {
            context,
            peer,
            unit_server,
            rights,
            partial: Vec::new(),
            parser: F::ParserState::default(),
            delimiter: ASCII_DELIMITER,
            reported: Reported::default(),
            deferred: None,
            gives_up: false,
            running: None,
        }
    }

    /// Copies the beginning of a request to the start of `input`. Returns its length.
    fn restore(&self, input: &mut [u8]) -> usize {
        // Most connections have none, and then nothing is called.
        if !self.partial.is_empty() {
            input[..self.partial.len()].copy_from_slice(&self.partial);
        }
        self.partial.len()
    }

    /// Answers the complete requests of `input`, and keeps the incomplete one after them. Writes to devices are
    /// only sent on their way while the peer `is_there`.
    fn answer(&mut self, is_there: IsThere<'_>, input: &[u8], output: &mut [u8]) -> Answered {
        let mut answered =
            Answered { len: 0, requests: 0, discarded: 0, consumed: 0, broken: false };
        let mut rest = input;
        let mut decoded = F::EMPTY_DECODED;
        loop {
            match F::next(&mut self.parser, rest, || self.delimiter, &mut decoded) {
                Next::Request { tag, unit_id, pdu, len } => {
                    if std::mem::take(&mut self.gives_up) {
                        self.give_up();
                    }
                    rest = &rest[len..];
                    answered.requests += 1;
                    let room = &mut output[answered.len..];
                    let request = (tag, unit_id, pdu);
                    let Some(reply) = self.handle_request(is_there, request, room) else {
                        rest = &[];
                        break;
                    };
                    answered.len += reply;
                }
                Next::Foreign { len } => {
                    rest = &rest[len..];
                    self.unit_server.discard(|frames| &frames.foreign);
                    answered.discarded += 1;
                }
                Next::Damaged { len } => {
                    rest = &rest[len..];
                    self.unit_server.discard(|frames| &frames.damaged);
                    answered.discarded += 1;
                }
                Next::Stray { len } => rest = &rest[len..],
                Next::Broken => {
                    self.unit_server.discard(|frames| &frames.broken);
                    answered.broken = true;
                    break;
                }
                Next::Incomplete => break,
            }
        }
        answered.consumed = input.len() - rest.len();
        self.keep(rest);
        answered
    }

    /// Answers a request now, or sends it on its way, or keeps it until others are answered. Returns the length
    /// of the framed reply, 0 when there is none, or none yet; `None` if its peer has ended: it and all behind it
    /// are dropped.
    // Otherwise, each request would be passed on through memory.
    #[inline(always)]
    fn handle_request(
        &mut self,
        is_there: IsThere<'_>,
        (tag, unit_id, pdu): (u16, u8, &[u8]),
        output: &mut [u8],
    ) -> Option<usize> {
        let destination = self.unit_server.destination(&self.rights, unit_id, pdu);
        if destination.is_some() || self.deferred.is_some() {
            // After a standstill, a request and the end of its peer are received together. A device may be faster
            // than the next read, which finds the end.
            if let Some(device) = destination.filter(|destination| destination.is_device())
                && !only_reads(pdu)
                && !(F::HAS_BROADCASTS && unit_id == 0)
                && !is_there()
                && self.unit_server.withdraw(&self.rights, device, unit_id, pdu)
            {
                return None;
            }
            let deferred = self.deferred.get_or_insert_default();
            let ours = (&*self.unit_server, &*self.rights, &*self.context);
            let request = (tag, unit_id, pdu);
            let peer = self.peer.ip();
            if let Deferral::Later(refused) =
                deferred.defer(ours, destination, peer, F::HAS_IDS, request)
            {
                self.context.note_refused(refused, &self.reported, Some(&self.peer));
                return Some(0);
            }
        }
        Some(self.reply(tag, unit_id, pdu, output))
    }

    /// Answers the requests that waited for others, as far as they need not wait any more. Returns the length of
    /// the output, and the number of those requests.
    fn resume(&mut self, is_there: IsThere<'_>, output: &mut [u8]) -> (usize, u32) {
        let behind = self.deferred.as_mut().map(|deferred| deferred.resume()).unwrap_or_default();
        let (mut rest, mut written, mut taken) = (&behind[..], 0, 0);
        while let mbap::Next::Frame { transaction_id, unit_id, pdu, len } = mbap::next(rest) {
            let request = (transaction_id, unit_id, pdu);
            let room = &mut output[written..];
            let Some(reply) = self.handle_request(is_there, request, room) else { break };
            written += reply;
            rest = &rest[len..];
            taken += 1;
        }
        (written, taken)
    }

    /// Keeps an incomplete frame, which is shorter than the longest one.
    fn keep(&mut self, rest: &[u8]) {
        self.partial.clear();
        self.partial.extend_from_slice(&rest[..rest.len().min(F::MAX_LEN)]);
    }

    /// Discards the beginning of a request: the next byte starts a frame.
    fn discard_partial(&mut self) {
        if !self.partial.is_empty() {
            self.partial.clear();
            self.unit_server.discard(|frames| &frames.damaged);
        }
        self.parser = F::ParserState::default();
    }

    /// Whether replies come later.
    #[inline]
    fn is_waiting(&self) -> bool {
        self.deferred.as_ref().is_some_and(|deferred| !deferred.is_empty())
    }

    /// The bytes of requests that wait until others are answered.
    #[inline]
    fn behind(&self) -> usize {
        self.deferred.as_ref().map_or(0, |deferred| deferred.behind())
    }

    /// How many bytes may be read: a peer that sends requests faster than they are answered is held back.
    #[inline]
    fn room(&self) -> usize {
        INPUT_BYTES.saturating_sub(self.partial.len() + self.behind())
    }

    /// Writes the replies that have come at the start of `output`, framed. Returns their length; `None`
    /// while there is none.
    fn collect(&mut self, context: &mut Context<'_>, output: &mut [u8]) -> Option<usize> {
        let deferred = self.deferred.as_mut()?;
        let mut len = None;
        while let Poll::Ready((asked, reply, times)) =
            deferred.poll_next(&self.unit_server, context)
        {
            let (tag, unit_id) = (asked.tag, asked.unit_id);
            asked.record(&self.context, Some(&self.peer), &reply);
            let at = len.get_or_insert(0);
            let pdu = &reply.pdu[..];
            let times = if pdu.is_empty() { 0 } else { times };
            for _ in 0..times {
                let frame = &mut output[*at..];
                frame[F::HEADER_LEN..][..pdu.len()].copy_from_slice(pdu);
                *at += F::complete(frame, tag, unit_id, pdu.len());
            }
        }
        len
    }

    fn ended(&self, end: Kind) {
        self.context.ended(end, self.peer.clone());
    }

    /// The peer has disconnected, or waits no longer. Replies of devices that still come are recorded.
    fn give_up(&mut self) {
        let Some(deferred) = self.deferred.as_mut().filter(|deferred| !deferred.is_empty()) else {
            return;
        };
        let given_up = deferred.give_up(F::HAS_BROADCASTS);
        let running = self.running.clone();
        let (context, unit_server) = (Arc::clone(&self.context), Arc::clone(&self.unit_server));
        let peer = self.peer.clone();
        tokio::spawn(async move {
            for waiting in given_up {
                if let Some((asked, reply)) = waiting.complete(&unit_server).await {
                    asked.record(&context, Some(&peer), &reply);
                }
            }
            drop(running);
        });
    }

    /// Writes one framed reply at the start of `output`. Returns its length, 0 when there is none.
    #[inline]
    fn reply(&mut self, tag: u16, unit_id: u8, request: &[u8], output: &mut [u8]) -> usize {
        let room = output.get_mut(F::HEADER_LEN..);
        let Some(buffer) = room.and_then(<[u8]>::first_chunk_mut::<{ pdu::MAX_LEN }>) else {
            return 0;
        };
        let ours = (&*self.unit_server, &*self.rights);
        let peer = (Some(&self.peer), &self.reported);
        let len = self.context.answer(ours, peer, unit_id, request, buffer);
        let answered = &buffer[..len.unwrap_or_default()];
        self.delimiter = changed_delimiter(request, answered).unwrap_or(self.delimiter);
        len.map_or(0, |len| F::complete(output, tag, unit_id, len))
    }

    /// Sends `unsent`, then reads, answers and sends until no input is left, without waiting.
    fn drain(&mut self, stream: &mut impl Stream, unsent: &mut Vec<u8>) -> io::Result<()> {
        stream::flush_now(stream.socket(), unsent)?;
        SCRATCH.with_borrow_mut(|Scratch { input, output }| {
            for _ in 0..MAX_LAST_READS {
                // The replies of devices come first.
                if self.is_waiting() {
                    break;
                }
                let partial = self.restore(input);
                let Some(len) = stream.read_now(&mut input[partial..], unsent) else { break };
                let is_there = || !stream.has_ended();
                let answered = self.answer(&is_there, &input[..partial + len], output);
                let output = &output[..answered.len];
                if !output.is_empty() && stream.send(output, unsent).is_err() {
                    break;
                }
                stream::flush_now(stream.socket(), unsent)?;
                if answered.broken {
                    break;
                }
            }
            Ok(())
        })
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read as _, Write};
    use std::net::SocketAddr;
    use std::time::Duration;

    use holdfast_memory::{Access, Area, Contents, Layout, Memory, Read, Span};
    use holdfast_protocol::frame::{ascii, mbap, rtu};

    use holdfast_runtime::Retry;
    use tokio::sync::mpsc;

    use super::*;
    use crate::client::Place;
    use crate::link::{InFlight, LinkSettings, Route, SharedLink};
    use crate::server::connections::admission::{Admission, ConnectionLimits};
    use crate::server::requests::identity::Identity;
    use crate::server::requests::unit_server::UnitSettings;
    use crate::server::rights::functions::{AccessMode, Functions};
    use crate::server::rights::rule::{RequestDestination, Rule};
    use crate::server::transports::cut_tests::assert_same_outcome;
    use crate::server::transports::framing::MbapBesidePackets;

    fn memory() -> Arc<Memory> {
        let span = Span::new(0, 2000).unwrap();
        let layout =
            Area::ALL.into_iter().fold(Layout::default(), |layout, area| layout.with(area, span));
        Arc::new(Memory::new(layout, None).unwrap())
    }

    fn answering<F: Framing>() -> Answering<F> {
        answering_with(memory())
    }

    fn answering_with<F: Framing>(memory: Arc<Memory>) -> Answering<F> {
        answering_by(&rule(memory))
    }

    fn rule(memory: Arc<Memory>) -> Rule {
        Rule {
            sources: Vec::new(),
            roles: None,
            units: vec![(1, memory)],
            destinations: Vec::new(),
            access: AccessMode::ReadWrite,
            functions: Functions::All,
            narrowed: Vec::new(),
        }
    }

    fn answering_by<F: Framing>(rule: &Rule) -> Answering<F> {
        let objects = [(0, b"a".to_vec()), (1, b"b".to_vec()), (2, b"c".to_vec())];
        let identity = Identity::new(&objects, &[]).unwrap();
        Answering::new(
            Arc::new(ListenerContext::for_tests()),
            Peer::from(SocketAddr::from(([127, 0, 0, 1], 1))),
            Arc::new(UnitServer::new(identity, UnitSettings::default())),
            Arc::new(PeerRights::new(rule)),
        )
    }

    fn frame(unit_id: u8, pdu: &[u8]) -> Vec<u8> {
        [&mbap::header(7, unit_id, pdu.len())[..], pdu].concat()
    }

    fn ascii_frame(unit_id: u8, pdu: &[u8]) -> Vec<u8> {
        let mut frame = [0; ascii::MAX_LEN];
        let len = ascii::encode(unit_id, pdu, &mut frame).unwrap();
        frame[..len].to_vec()
    }

    fn rtu_frame(unit_id: u8, pdu: &[u8]) -> Vec<u8> {
        let mut frame = [0; rtu::MAX_LEN];
        let len = rtu::encode(unit_id, pdu, &mut frame).unwrap();
        frame[..len].to_vec()
    }

    /// Requests of each function, and some that are refused.
    const PDUS: [&[u8]; 16] = [
        &[1, 0, 3, 7, 0xD0 - 3],
        &[2, 0, 0, 0, 9],
        &[3, 0, 0, 0, 125],
        &[4, 0, 1, 0, 2],
        &[5, 0, 9, 0xFF, 0],
        &[6, 0, 9, 1, 2],
        &[8, 0, 0, 1, 2],
        &[8, 0, 0x0B, 0, 0],
        &[11],
        &[15, 0, 3, 0, 9, 2, 0xFF, 1],
        &[17],
        &[22, 0, 4, 0, 0xF2, 0, 0x25],
        &[23, 0, 0, 0, 2, 0, 1, 0, 1, 2, 0xBE, 0xEF],
        &[43, 14, 3, 0],
        &[3, 0xFF, 0xFF, 0, 2],
        &[99],
    ];

    const LONG_WRITE: [u8; 252] = {
        let mut pdu = [0; 252];
        (pdu[0], pdu[4], pdu[5]) = (16, 123, 246);
        pdu
    };

    fn requests(frame: fn(u8, &[u8]) -> Vec<u8>) -> Vec<u8> {
        PDUS.iter().copied().chain([&LONG_WRITE[..]]).flat_map(|pdu| frame(1, pdu)).collect()
    }

    #[test]
    fn answering_requests_allocates_nothing() {
        allocates_nothing::<Mbap>(&requests(frame));
        allocates_nothing::<Ascii>(&requests(ascii_frame));
    }

    fn allocates_nothing<F: Framing>(input: &[u8]) {
        let (mut answering, mut output) = (answering::<F>(), vec![0; OUTPUT_BYTES]);
        answering.answer(&|| true, input, &mut output);
        let mut requests = 0;
        let allocations = allocation_counter::measure(|| {
            requests = answering.answer(&|| true, input, &mut output).requests;
        });
        assert_eq!(requests, 17);
        assert_eq!(allocations.count_total, 0);
    }

    /// What comes of the pieces of a stream, and of the silence after it: replies, the end of the
    /// connection, counters and memory.
    fn outcome<F: Framing>(
        pieces: &[&[u8]],
        output: &mut [u8],
    ) -> (Vec<u8>, bool, String, Vec<Contents>) {
        let memory = memory();
        let (mut answering, mut input) =
            (answering_with::<F>(Arc::clone(&memory)), vec![0; INPUT_BYTES]);
        let (mut replies, mut broken) = (Vec::new(), false);
        for piece in pieces {
            let partial = answering.restore(&mut input);
            input[partial..partial + piece.len()].copy_from_slice(piece);
            let answered = answering.answer(&|| true, &input[..partial + piece.len()], output);
            replies.extend_from_slice(&output[..answered.len]);
            broken = answered.broken;
            if broken {
                break;
            }
        }
        if !broken {
            answering.discard_partial();
        }
        let counters = &answering.unit_server.counters;
        let counted = format!("{:?} {:?}", counters.frames, counters.bus());
        (replies, broken, counted, Memory::contents(&[memory]))
    }

    fn have_the_same_outcome<F: Framing>(cases: &[Vec<u8>]) {
        let output = RefCell::new(vec![0; OUTPUT_BYTES]);
        assert_same_outcome(cases, |pieces| outcome::<F>(pieces, &mut output.borrow_mut()));
    }

    /// The requests of [`requests`], one a case.
    fn each_request(frame: fn(u8, &[u8]) -> Vec<u8>) -> Vec<Vec<u8>> {
        PDUS.iter()
            .map(|pdu| frame(1, pdu))
            .chain([frame(1, &LONG_WRITE), frame(9, &[17])])
            .collect()
    }

    #[test]
    fn modbus_tcp_has_the_same_outcome_however_it_is_cut() {
        let foreign = [0, 1, 0, 9, 0, 2, 1, 17].to_vec();
        let broken = [0, 1, 0, 0, 0, 255, 1, 17].to_vec();
        let begun = frame(1, &LONG_WRITE)[..40].to_vec();
        let packet = b"RI\x01\x03\x00\x01\x00\x00\x00\x01\x00\x07".to_vec();
        let cases = [each_request(frame), vec![foreign, broken, begun, packet]].concat();
        have_the_same_outcome::<Mbap>(&cases);
        have_the_same_outcome::<MbapBesidePackets>(&cases);
    }

    #[test]
    fn rtu_in_a_stream_has_the_same_outcome_however_it_is_cut() {
        let mut damaged = rtu_frame(1, PDUS[2]);
        damaged[7] ^= 1;
        // The last byte of the data is the first byte of the CRC of those before it.
        let [low, _] = rtu::crc(&[1, 99, 1]).to_le_bytes();
        let misleading = rtu_frame(1, &[99, 1, low]);
        let begun = [1, 16, 0, 0, 0, 0x7B, 0xF6].to_vec();
        let cases = [
            each_request(rtu_frame),
            vec![damaged.clone(), rtu_frame(1, &[17]), damaged.clone(), damaged],
            vec![misleading.clone(), rtu_frame(0, &[17]), misleading, rtu_frame(1, &[17])],
            vec![begun, rtu_frame(1, PDUS[2]), vec![0], vec![0x64; 300], vec![1, 20, 255]],
        ];
        have_the_same_outcome::<Rtu>(&cases.concat());
    }

    #[test]
    fn ascii_in_a_stream_has_the_same_outcome_however_it_is_cut() {
        // Characters between frames, a frame cut short, a wrong checksum, and a line without end.
        let disturbed = [b"\r\nx\0".to_vec(), ascii_frame(1, &[17]), b":0111:0111EF\r\n".to_vec()];
        let endless = [b":".to_vec(), vec![b'0'; 2 * ascii::MAX_LEN], ascii_frame(1, &[17])];
        let delimiter = ascii_frame(1, &[8, 0, 3, b'!', 0]);
        let cases =
            [each_request(ascii_frame), vec![disturbed.concat(), endless.concat(), delimiter]];
        have_the_same_outcome::<Ascii>(&cases.concat());
    }

    #[test]
    fn a_write_to_a_device_is_not_sent_on_its_way_once_its_peer_has_ended() {
        let place = Place::Tcp { host: "127.0.0.1".into(), port: 502, tls: None };
        let settings = LinkSettings {
            endpoint: place.into(),
            in_flight: InFlight::Fixed(1),
            retry: Retry::default(),
            queue: LinkSettings::QUEUE,
            coalesce: true,
            cache: Duration::ZERO,
            preferred: Vec::new(),
        };
        let (calls, mut called) = mpsc::unbounded_channel();
        let route = Route {
            name: "plc".into(),
            link: Arc::new(SharedLink::new(&settings, calls)),
            unit_id: None,
            timeout: Duration::from_secs(1),
            withdrawal: Arc::default(),
        };
        let (memory, mut register) = (memory(), [0; 2]);
        let mut rule = rule(Arc::clone(&memory));
        rule.destinations = vec![(2, RequestDestination::Device(route))];
        let mut output = vec![0; OUTPUT_BYTES];
        for (pdu, is_there, is_sent) in [
            (&[6, 0, 0, 0, 7][..], false, false),
            (&[6, 0, 0, 0, 7], true, true),
            (&[3, 0, 0, 0, 1], false, true),
            (&[6, 0, 0], false, false),
        ] {
            let mut answering = answering_by::<Mbap>(&rule);
            let input = [frame(2, pdu), frame(1, &[6, 0, 0, 0, 9])].concat();
            answering.answer(&|| is_there, &input, &mut output);
            assert_eq!(called.try_recv().is_ok(), is_sent, "{pdu:?}");
            let is_refused = pdu.len() < 5;
            assert_eq!(
                answering.is_waiting(),
                is_sent || is_refused,
                "refusals are reported: {pdu:?}"
            );
            let read =
                Read { area: Area::HoldingRegisters, address: 0, count: 1, out: &mut register };
            memory.read(Access::Client, read).unwrap();
            assert_eq!(register, [0; 2], "{pdu:?}: what follows waits, or is dropped too");
        }
    }

    #[test]
    fn rtu_after_a_silence_is_never_part_of_what_came_before() {
        let mut output = vec![0; OUTPUT_BYTES];
        let read = rtu_frame(1, &[3, 0, 0, 0, 1]);
        let answer = rtu_frame(1, &[3, 2, 0, 0]);
        let begun = [1, 16, 0, 0, 0, 0x7B, 0xF6].to_vec();
        let swallowed = [&begun[..], &read].concat();
        let mut damaged = read.clone();
        damaged[7] ^= 1;
        let lost = [&damaged[..], &[0; 12]].concat();
        for before in [begun, swallowed, damaged, lost, rtu_frame(1, &[99]), vec![0x64; 300]] {
            let mut answering = answering::<Rtu>();
            let first = answering.answer(&|| true, &before, &mut output);
            let replies = rtu_frame(1, &[99]) == before;
            assert_eq!(first.len > 0, replies, "{before:02x?}");
            answering.discard_partial();
            assert!(answering.partial.is_empty());
            let len = answering.answer(&|| true, &read, &mut output).len;
            assert_eq!(output[..len], answer, "{before:02x?}");
        }
    }

    struct NoRights;

    impl Renewal for NoRights {
        fn terms(&self, _peer: &Peer) -> Option<Terms> {
            None
        }
    }

    /// A connection, and the listener that its peer is connected with.
    fn connection<F: Framing>() -> (Connection<F, tokio::net::TcpStream>, std::net::TcpListener) {
        let bound = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let client = std::net::TcpStream::connect(bound.local_addr().unwrap()).unwrap();
        client.set_nonblocking(true).unwrap();
        let (stream, peer) = (
            tokio::net::TcpStream::from_std(client).unwrap(),
            SocketAddr::from(([192, 0, 2, 1], 1)),
        );
        let limits = ConnectionLimits { max_connections: 1, ..ConnectionLimits::NONE };
        let (ticket, _) = Arc::new(Admission::new(limits)).admit(peer).unwrap();
        let answering = answering::<F>();
        let (context, unit_server) =
            (Arc::clone(&answering.context), Arc::clone(&answering.unit_server));
        let rights = Arc::clone(&answering.rights);
        let timeouts = Timeouts { idle: None, request: Duration::ZERO, frame: None };
        let (terms, renewal) = (Terms { rights, timeouts }, Arc::new(NoRights));
        let stream = (stream, peer.into());
        (Connection::new(context, unit_server, stream, terms, renewal, ticket), bound)
    }

    #[test]
    fn a_peer_is_not_to_blame_for_silence_while_its_source_waits() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let _guard = runtime.enter();
        let (mut connection, _bound) = connection::<Mbap>();
        connection.begin_with(&[0]);
        let other = Share::of(&Peer::from(SocketAddr::from(([192, 0, 2, 2], 1))));
        connection.share.charge(1_000_000);
        let mut context = Context::from_waker(std::task::Waker::noop());
        assert!(connection.poll(&mut context).is_pending());
        assert_eq!(connection.on_alarm(), Poll::Ready(Ok(())));
        drop(other);
        assert!(connection.poll(&mut context).is_pending(), "nothing has arrived");
        assert_eq!(connection.on_alarm(), Poll::Ready(Err(Kind::RequestTimeout)));
    }

    #[test]
    fn a_connection_that_was_ended_answers_nothing() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let _guard = runtime.enter();
        let (mut connection, bound) = connection::<Mbap>();
        let limits = ConnectionLimits { max_connections: 1, ..ConnectionLimits::NONE };
        let admission = Arc::new(Admission::new(limits));
        connection.ticket = admission.admit(SocketAddr::from(([192, 0, 2, 1], 1))).unwrap().0;
        let mut peer = bound.accept().unwrap().0;
        peer.write_all(&frame(1, &[17]).repeat(2)).unwrap();
        runtime.block_on(connection.stream.readable()).unwrap();
        assert!(admission.end(connection.ticket.id()).is_some());
        let mut context = Context::from_waker(std::task::Waker::noop());
        for _ in 0..2 {
            assert_eq!(connection.poll(&mut context), Poll::Pending);
            assert_eq!(connection.on_alarm(), Poll::Pending);
        }
        drop(connection);
        assert!(!matches!(peer.read(&mut [0; 16]), Ok(1..)));
    }

    struct WithoutLimit(Arc<PeerRights>);

    impl Renewal for WithoutLimit {
        fn terms(&self, _peer: &Peer) -> Option<Terms> {
            let timeouts = Timeouts { idle: None, request: Duration::ZERO, frame: None };
            Some(Terms { rights: Arc::clone(&self.0), timeouts })
        }
    }

    #[test]
    fn an_idle_timeout_that_a_reload_has_removed_ends_no_connection() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let _guard = runtime.enter();
        let (mut connection, _bound) = connection::<Mbap>();
        let limits = ConnectionLimits { max_connections: 1, ..ConnectionLimits::NONE };
        let admission = Arc::new(Admission::new(limits));
        connection.ticket = admission.admit(SocketAddr::from(([192, 0, 2, 1], 1))).unwrap().0;
        connection.renewal = Arc::new(WithoutLimit(Arc::clone(&connection.answering.rights)));
        connection.deadlines.timeouts.idle = Some(Duration::ZERO);
        assert_eq!(connection.on_alarm(), Poll::Ready(Err(Kind::Idle)));
        admission.apply_reload(|_| None::<Kind>);
        assert_eq!(connection.on_alarm(), Poll::Ready(Ok(())));
    }

    #[test]
    fn a_connection_takes_less_than_a_kilobyte() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let _guard = runtime.enter();
        let stop = || watch::channel(false).1;
        for connection in [
            connection::<Mbap>().0.run(stop()),
            connection::<Rtu>().0.run(stop()),
            connection::<Ascii>().0.run(stop()),
        ] {
            assert!(size_of_val(&*connection) < 1024, "{}", size_of_val(&*connection));
        }
    }

    #[test]
    fn the_output_has_room_for_the_replies_to_any_input() {
        let shortest = frame(1, &[17]);
        let input = shortest.repeat(INPUT_BYTES / shortest.len());
        let answered = answering::<Mbap>().answer(&|| true, &input, &mut vec![0; OUTPUT_BYTES]);
        assert_eq!(answered.requests, INPUT_BYTES / Mbap::MIN_FRAME_LEN);
        assert!(answered.requests * mbap::MAX_LEN <= OUTPUT_BYTES);

        let shortest = ascii_frame(1, &[17]);
        let input = shortest.repeat(INPUT_BYTES / shortest.len());
        let answered = answering::<Ascii>().answer(&|| true, &input, &mut vec![0; OUTPUT_BYTES]);
        assert_eq!(answered.requests, INPUT_BYTES / Ascii::MIN_FRAME_LEN);
        assert!(answered.requests * ascii::MAX_LEN <= OUTPUT_BYTES);
    }

    #[test]
    fn the_longest_ascii_reply_is_encoded_in_place() {
        let longest = [&[8, 0, 0][..], &[0xA5; 250]].concat();
        let mut output = vec![0; OUTPUT_BYTES];
        let answered =
            answering::<Ascii>().answer(&|| true, &ascii_frame(1, &longest), &mut output);
        assert_eq!(output[..answered.len], ascii_frame(1, &longest));
        assert_eq!(answered.len, ascii::MAX_LEN);
    }

    #[test]
    fn an_ascii_line_without_end_leaves_nothing_behind() {
        let mut answering = answering::<Ascii>();
        let damaged =
            |answering: &Answering<Ascii>| answering.unit_server.counters.frames.damaged.get();
        let line = [b":".to_vec(), vec![b'0'; INPUT_BYTES - 1]].concat();
        let answered = answering.answer(&|| true, &line, &mut vec![0; OUTPUT_BYTES]);
        assert_eq!((answered.consumed, answering.partial.len()), (INPUT_BYTES, 0));
        assert_eq!(damaged(&answering), 1);

        answering.answer(&|| true, &line[..ascii::MAX_LEN - 1], &mut vec![0; OUTPUT_BYTES]);
        assert_eq!((answering.partial.len(), damaged(&answering)), (ascii::MAX_LEN - 1, 1));
    }

    #[test]
    fn requests_before_a_broken_frame_are_answered_and_none_after_it() {
        let input = [frame(1, &[17]), vec![0, 0, 0, 0, 1, 0, 1, 17], frame(1, &[17])].concat();
        let answered = answering::<Mbap>().answer(&|| true, &input, &mut vec![0; OUTPUT_BYTES]);
        assert_eq!((answered.requests, answered.broken), (1, true));
    }

    #[test]
    fn a_packet_among_frames_breaks_a_connection_that_also_accepts_packets() {
        // Unit id 2 is the length of a frame that ends in the middle of the packet.
        let write = frame(1, &[6, 0, 0, 0, 7]);
        let packet = [b"RI\x01\x03\x00\x02\x00\x00\x00\x06", &write[..]].concat();
        let input = [frame(1, &[17]), packet].concat();
        for cut in 0..=input.len() {
            let mut shared = answering::<MbapBesidePackets>();
            let (mut buffer, mut output) = (vec![0; INPUT_BYTES], vec![0; OUTPUT_BYTES]);
            let (mut requests, mut broken) = (0, false);
            for part in [&input[..cut], &input[cut..]] {
                let partial = shared.restore(&mut buffer);
                buffer[partial..partial + part.len()].copy_from_slice(part);
                let answered =
                    shared.answer(&|| true, &buffer[..partial + part.len()], &mut output);
                requests += answered.requests;
                broken |= answered.broken;
                if answered.broken {
                    break;
                }
            }
            assert_eq!((requests, broken), (1, true), "cut at {cut}");
            let frames = &shared.unit_server.counters.frames;
            assert_eq!((frames.broken.get(), frames.foreign.get()), (1, 0));
        }
        // A version that is wrong makes no difference: its sender takes it for a packet too.
        let input = [&frame(1, &[17])[..], b"RI\x02\x03\x00\x02\x00\x00\x00\x06", &write].concat();
        let answered =
            answering::<MbapBesidePackets>().answer(&|| true, &input, &mut vec![0; OUTPUT_BYTES]);
        assert_eq!((answered.requests, answered.broken), (1, true));
        // Frames of other protocols, and transaction ids like the start of a packet, are as before.
        let foreign = [0x52, 0x48, 2, 1, 0, 2, 1, 17];
        let mut harmless = frame(1, &[17]);
        harmless[..2].copy_from_slice(b"RI");
        let input = [&foreign[..], &harmless].concat();
        let answered =
            answering::<MbapBesidePackets>().answer(&|| true, &input, &mut vec![0; OUTPUT_BYTES]);
        assert_eq!((answered.requests, answered.broken), (1, false));
        let input = [b"RI\x01\x09\x00\x02\x01\x11", &frame(1, &[17])[..]].concat();
        let answered = answering::<Mbap>().answer(&|| true, &input, &mut vec![0; OUTPUT_BYTES]);
        assert_eq!((answered.requests, answered.broken), (1, false), "no packets at this port");
    }
}

//! The connection: the part that is the same for every transport.

use alloc::boxed::Box;
use alloc::vec::Vec;
use core::mem::take;
use core::time::Duration;

use super::flights::{Call, Done, Flights, Strays, Ticket};
use super::late_replies_without_ids::LateReplies;
use super::mbap_datagrams::Datagrams;
use super::mbap_stream::{MAX_IN_FLIGHT, Stream};
use super::raised_timeouts::Lateness;
use super::rtu_and_ascii::{Framing, OneAtATime};
use super::{Attempt, Closed, MAX_READ_DELAY, Time, Tolerance, Transport};
use crate::pdu::EncodedRequest;

/// One connection, from start to end.
///
/// ```
/// use core::time::Duration;
/// use holdfast_protocol::client::{Connection, Transport};
/// use holdfast_protocol::pdu::{EncodedRequest, Range, Request, Response};
///
/// let range = Range::new(3, 1).unwrap();
/// let request = EncodedRequest::new(&Request::ReadHoldingRegisters(range));
/// let mut connection = Connection::new(Transport::Tcp);
///
/// let (timeout, now) = (Duration::from_secs(1), Duration::ZERO);
/// let ticket = connection.send(7, &request, timeout, now).unwrap();
/// assert_eq!(connection.outgoing(), [0, 0, 0, 0, 0, 6, 7, 3, 0, 3, 0, 1]);
/// connection.sent(12);
///
/// let mut registers = Vec::new();
/// connection.receive(&[0, 0, 0, 0, 0, 5, 7, 3, 2, 0, 42], now, |done| {
///     assert_eq!(done.ticket, ticket);
///     let Ok(Response::Registers(read)) = done.outcome else { panic!() };
///     registers.extend(read.iter());
/// });
/// assert_eq!(registers, [42]);
/// ```
#[derive(Debug)]
pub struct Connection {
    wire: Wire,
    flights: Flights,
    /// The next request is not sent before.
    ready_at: Time,
    /// Requests so far.
    sent: u32,
}

/// What a connection leaves to the next one to the same address: see [`Connection::take_past`].
#[derive(Debug, Default)]
pub struct Past {
    left: Left,
    /// The end of the pause after the last request.
    ready_at: Time,
}

#[derive(Debug, Default)]
enum Left {
    #[default]
    Nothing,
    /// The next transaction id, those that may still be answered, and how late replies are.
    Ids(u16, Vec<u16>, Lateness),
    /// How late replies are.
    Lateness(Lateness),
    LateReplies(LateReplies),
}

#[derive(Debug)]
enum Wire {
    Stream(Stream),
    Datagrams(Datagrams),
    OneAtATime(Box<OneAtATime>),
}

impl Connection {
    /// A connection that was just made, to a device that follows the standard.
    pub fn new(transport: Transport) -> Connection {
        Connection::tolerant(transport, Tolerance::default(), Time::ZERO)
    }

    /// A connection that was made `now`, to a device that needs this tolerance.
    pub fn tolerant(transport: Transport, tolerance: Tolerance, now: Time) -> Connection {
        let one = |framing, silence| {
            Wire::OneAtATime(Box::new(OneAtATime::new(framing, silence, tolerance.echo)))
        };
        let wire = match transport {
            Transport::Tcp => Wire::Stream(Stream::default()),
            Transport::Udp => Wire::Datagrams(Datagrams::default()),
            Transport::RtuOverTcp | Transport::RtuOverUdp => one(Framing::Rtu, None),
            Transport::AsciiOverTcp => one(Framing::Ascii, None),
            Transport::SerialRtu { silence } => one(Framing::Rtu, Some(silence)),
            Transport::SerialAscii { silence } => one(Framing::Ascii, Some(silence)),
        };
        let mut flights = Flights::default();
        flights.tolerance = tolerance;
        let pause = tolerance.pause_after_connect;
        let ready_at = if pause.is_zero() { Time::ZERO } else { now + pause };
        Connection { wire, flights, ready_at, sent: 0 }
    }

    /// Lets transaction ids begin with a random number: a device or a gateway may still answer the
    /// requests of an earlier connection. Those of datagrams follow from it, so that nobody who sees none
    /// of them can forge a reply. In a stream they count up: forging a part of it takes more than an id.
    #[must_use]
    pub fn unpredictable(mut self, seed: u64) -> Connection {
        match &mut self.wire {
            Wire::Stream(stream) => stream.randomize(seed),
            Wire::Datagrams(datagrams) => datagrams.randomize(seed),
            Wire::OneAtATime(_) => {}
        }
        self
    }

    /// Tells how long a character takes on a serial line: a reply that comes before the line can have
    /// carried its request and itself is not believed, unless the first replies show that the line is
    /// faster, as a pseudo-terminal is.
    #[must_use]
    pub fn on_line(mut self, character: Duration) -> Connection {
        if let Wire::OneAtATime(line) = &mut self.wire {
            line.character = character;
        }
        self
    }

    /// Takes what the next connection to this address has to know: replies that may still come, how late
    /// they are, and the pause. This connection is not used again.
    pub fn take_past(&mut self, now: Time) -> Past {
        let pause = self.flights.tolerance.pause;
        let was_asked = self.flights.len() > 0 && !pause.is_zero();
        let ready_at = if was_asked { self.ready_at.max(now + pause) } else { self.ready_at };
        self.flights.close(Closed::BySelf, &mut |_| {});
        let left = match &mut self.wire {
            Wire::Stream(stream) => {
                let (next_id, given_up) = stream.take_ids(&self.flights);
                Left::Ids(next_id, given_up, take(&mut stream.lateness))
            }
            Wire::Datagrams(datagrams) => Left::Lateness(take(&mut datagrams.lateness)),
            Wire::OneAtATime(line) => Left::LateReplies(line.take_late_replies(&self.flights, now)),
        };
        Past { left, ready_at }
    }

    /// Goes on where another connection to the same address ended, whose clock was the same.
    pub fn follow(&mut self, past: Past) {
        if !self.flights.tolerance.pause.is_zero() {
            self.ready_at = self.ready_at.max(past.ready_at);
        }
        match (&mut self.wire, past.left) {
            (Wire::Stream(stream), Left::Ids(next_id, given_up, lateness)) => {
                stream.go_on(next_id, &given_up);
                stream.lateness = lateness;
            }
            (Wire::Datagrams(datagrams), Left::Lateness(lateness)) => datagrams.lateness = lateness,
            (Wire::OneAtATime(line), Left::LateReplies(late_replies)) => {
                line.late_replies = late_replies;
            }
            _ => {}
        }
    }

    /// Sends a request, or queues it until the line is silent. `timeout` runs from when it has been sent, and
    /// again from each reply to a request that was sent before it. If late replies of the unit repeat, it is
    /// longer, up to four times; end the request with [`Connection::cancel`] if it must not be.
    ///
    /// # Errors
    /// [`Closed`]: the reason why the connection has ended.
    ///
    /// # Panics
    /// If another request is in flight on a transport that carries one at a time, or too many are: see
    /// [`Connection::has_room`].
    pub fn send(
        &mut self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        now: Time,
    ) -> Result<Ticket, Closed> {
        self.send_again(unit_id, request, timeout, Attempt::default(), now)
    }

    /// Does the same for a request that was sent before, with [`Done::again`] of that time.
    ///
    /// # Errors
    /// As [`Connection::send`].
    ///
    /// # Panics
    /// As [`Connection::send`].
    pub fn send_again(
        &mut self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        attempt: Attempt,
        now: Time,
    ) -> Result<Ticket, Closed> {
        if let Some(why) = self.flights.closed {
            return Err(why);
        }
        assert!(self.has_room(), "too many requests are in flight");
        self.end_pause(now);
        self.sent += 1;
        let start = now.max(self.ready_at);
        let adapted = self.flights.tolerance.adapted(request);
        let request = adapted.as_ref().unwrap_or(request);
        let (flights, call) = (&mut self.flights, Call { unit_id, request, timeout, attempt });
        let ticket = match &mut self.wire {
            Wire::Stream(stream) => stream.send(flights, call, start),
            Wire::Datagrams(datagrams) => datagrams.send(flights, call, start),
            Wire::OneAtATime(line) => return Ok(line.send(flights, call, start, now)),
        };
        flights.held = (start > now).then_some(start);
        Ok(ticket)
    }

    /// Whether another request can be sent now.
    pub fn has_room(&self) -> bool {
        let many = matches!(self.wire, Wire::Stream(_));
        let most =
            if many && !self.flights.tolerance.is_one_at_a_time() { MAX_IN_FLIGHT } else { 1 };
        self.flights.len() < most
    }

    /// The number of requests in flight.
    pub fn in_flight(&self) -> usize {
        self.flights.len()
    }

    /// When the timeout of a request ends; `None` once it has its result. Replies to requests sent
    /// before it move this moment.
    pub fn deadline_of(&self, ticket: Ticket) -> Option<Time> {
        self.flights.deadline_of(ticket)
    }

    /// Whether the requests in flight wait for a pause, so that none of them was sent. Not on transports
    /// that carry one request at a time.
    pub fn is_held(&self) -> bool {
        self.flights.held.is_some()
    }

    /// The bytes to send; over UDP, exactly one datagram.
    pub fn outgoing(&self) -> &[u8] {
        if self.flights.held.is_some() { &[] } else { &self.flights.out }
    }

    /// Reports that the first `len` bytes of [`Connection::outgoing`] have been sent.
    pub fn sent(&mut self, len: usize) {
        self.flights.out.drain(..len);
    }

    /// Processes received bytes, which may end anywhere; over UDP, exactly one datagram.
    pub fn receive(&mut self, bytes: &[u8], now: Time, mut sink: impl FnMut(Done<'_>)) {
        let datagram = matches!(self.wire, Wire::Datagrams(_));
        if self.flights.closed.is_some() || (bytes.is_empty() && !datagram) {
            return;
        }
        if self.awaits_reply_until().is_some_and(|until| until + MAX_READ_DELAY <= now) {
            // Others that have timed out since may still be answered in time.
            self.advance_by(now - MAX_READ_DELAY, now, &mut sink);
            if self.flights.closed.is_some() {
                return;
            }
        }
        let flights = &mut self.flights;
        let waiting = flights.len();
        flights.reply_begun = true;
        match &mut self.wire {
            Wire::Stream(stream) => stream.receive(flights, bytes, now, &mut sink),
            Wire::Datagrams(datagrams) => datagrams.receive(flights, bytes, now, &mut sink),
            Wire::OneAtATime(line) => line.receive(flights, bytes, now, &mut sink),
        }
        self.after(waiting, now, sink);
    }

    /// When the first timeout ends of the requests that were sent.
    fn awaits_reply_until(&self) -> Option<Time> {
        if self.flights.held.is_some() {
            return None;
        }
        match &self.wire {
            Wire::OneAtATime(line) => line.awaits_reply_until(&self.flights),
            _ => self.flights.deadline(),
        }
    }

    /// When to call [`Connection::advance`], unless another call comes first.
    pub fn deadline(&self) -> Option<Time> {
        if self.flights.closed.is_some() {
            return None;
        }
        if self.flights.held.is_some() {
            return self.flights.held;
        }
        match &self.wire {
            Wire::Stream(stream) => stream.deadline(&self.flights),
            Wire::Datagrams(datagrams) => datagrams.deadline(&self.flights),
            Wire::OneAtATime(line) => line.deadline(&self.flights),
        }
    }

    /// Performs what is due: ends requests whose timeout has expired, repeats a datagram, or sends
    /// a queued request.
    pub fn advance(&mut self, now: Time, sink: impl FnMut(Done<'_>)) {
        self.advance_by(now, now, sink);
    }

    /// Does the same, but gives up requests of many in flight only if they were `due` by then.
    fn advance_by(&mut self, due: Time, now: Time, mut sink: impl FnMut(Done<'_>)) {
        if self.flights.closed.is_some() {
            return;
        }
        self.end_pause(now);
        let flights = &mut self.flights;
        let waiting = flights.len();
        match &mut self.wire {
            Wire::Stream(stream) => stream.advance(flights, due, now, &mut sink),
            Wire::Datagrams(datagrams) => datagrams.advance(flights, now, &mut sink),
            Wire::OneAtATime(line) => line.advance(flights, now, &mut sink),
        }
        self.after(waiting, now, sink);
    }

    /// Lets what waits for a pause be sent if that has ended. Where a thread wakes up late, requests are sent
    /// late, and not given up before.
    fn end_pause(&mut self, now: Time) {
        if self.flights.held.take_if(|until| *until <= now).is_some() {
            self.flights.transmitted_all(now);
            if let Wire::Datagrams(datagrams) = &mut self.wire {
                datagrams.transmitted(now);
            }
        }
    }

    /// Does what follows the end of a request: a pause, or the end of the connection.
    fn after(&mut self, waiting: usize, now: Time, mut sink: impl FnMut(Done<'_>)) {
        let tolerance = &self.flights.tolerance;
        if self.flights.len() == waiting || !tolerance.is_one_at_a_time() {
            return;
        }
        if !tolerance.pause.is_zero() {
            self.ready_at = self.ready_at.max(now + tolerance.pause);
        }
        if tolerance.close_after > 0 && self.sent >= tolerance.close_after {
            self.flights.close(Closed::BySelf, &mut sink);
        }
    }

    /// Drops a request: it gets no [`Done`]. Without transaction ids, it stays in flight until its
    /// reply or timeout, so that its reply is not taken for another one. A request that was not sent
    /// yet is not sent.
    pub fn cancel(&mut self, ticket: Ticket, now: Time) {
        match &mut self.wire {
            Wire::Stream(stream) => {
                let (waiting, was_sent) = (self.flights.len(), self.flights.held.is_none());
                stream.cancel(&mut self.flights, ticket);
                if was_sent {
                    self.after(waiting, now, |_| unreachable!("no other is in flight"));
                }
            }
            Wire::OneAtATime(line) => line.cancel(&mut self.flights, ticket, now),
            Wire::Datagrams(_) => self.flights.abandon(ticket),
        }
    }

    /// Ends the connection. Every request in flight fails.
    pub fn close(&mut self, why: Closed, mut sink: impl FnMut(Done<'_>)) {
        if let (Wire::OneAtATime(line), Closed::ByPeer) = (&mut self.wire, why) {
            line.stream_ended(&mut self.flights, &mut sink);
        }
        self.flights.close(why, &mut sink);
    }

    /// The reason why the connection has ended; `None` while it is open.
    pub fn closed(&self) -> Option<Closed> {
        self.flights.closed
    }

    /// Takes the counts of what was received without a request, since the last call.
    pub fn take_strays(&mut self) -> Strays {
        core::mem::take(&mut self.flights.strays)
    }

    /// Takes the number of requests since the last call that had more than their timeout, because late
    /// replies repeat.
    pub fn take_raised(&mut self) -> u64 {
        core::mem::take(&mut self.flights.raised)
    }

    /// The number of late replies, which were dropped.
    pub fn late(&self) -> u64 {
        self.flights.late
    }

    /// The longest time that one of them took; 0 if there was none.
    pub fn longest_late(&self) -> Duration {
        self.flights.longest_late
    }
}

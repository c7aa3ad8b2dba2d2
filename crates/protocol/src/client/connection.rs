//! The connection itself: what is the same for every transport, and which part does the rest.

use core::time::Duration;

use super::datagram::Datagrams;
use super::flights::{Done, Flights, Ticket};
use super::line::{Framing, OneAtATime};
use super::stream::Stream;
use super::{Closed, Time, Transport};
use crate::pdu::EncodedRequest;

/// One connection, from its beginning to its end.
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
}

#[derive(Debug)]
enum Wire {
    Stream(Stream),
    Datagrams(Datagrams),
    OneAtATime(OneAtATime),
}

impl Connection {
    /// A connection that was just made.
    pub fn new(transport: Transport) -> Connection {
        let one = |framing, line| Wire::OneAtATime(OneAtATime::new(framing, line));
        let wire = match transport {
            Transport::Tcp => Wire::Stream(Stream::default()),
            Transport::Udp => Wire::Datagrams(Datagrams::default()),
            Transport::RtuOverTcp => one(Framing::Rtu, None),
            Transport::SerialRtu(line) => one(Framing::Rtu, Some(line)),
            Transport::SerialAscii(line) => one(Framing::Ascii, Some(line)),
        };
        Connection { wire, flights: Flights::default() }
    }

    /// Sends a request, or queues it until the line is silent. `timeout` runs from now.
    ///
    /// # Errors
    /// Why the connection has ended, or [`Closed::NoTransactionId`].
    ///
    /// # Panics
    /// While another request is in flight on a transport that carries one at a time: see
    /// [`Connection::has_room`].
    pub fn send(
        &mut self,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        now: Time,
    ) -> Result<Ticket, Closed> {
        if let Some(why) = self.flights.closed {
            return Err(why);
        }
        assert!(self.has_room(), "one request at a time");
        let flights = &mut self.flights;
        match &mut self.wire {
            Wire::Stream(stream) => {
                stream.send(flights, unit_id, request, timeout, now).ok_or(Closed::NoTransactionId)
            }
            Wire::Datagrams(datagrams) => {
                Ok(datagrams.send(flights, unit_id, request, timeout, now))
            }
            Wire::OneAtATime(line) => Ok(line.send(flights, unit_id, request, timeout, now)),
        }
    }

    /// Whether another request can be sent now.
    pub fn has_room(&self) -> bool {
        matches!(self.wire, Wire::Stream(_)) || self.flights.len() == 0
    }

    /// Requests that wait for their replies.
    pub fn in_flight(&self) -> usize {
        self.flights.len()
    }

    /// Whether a request waits for its reply.
    pub fn is_waiting_for(&self, ticket: Ticket) -> bool {
        self.flights.contains(ticket)
    }

    /// The bytes to be sent; over UDP, exactly one datagram.
    pub fn outgoing(&self) -> &[u8] {
        &self.flights.out
    }

    /// The first `len` bytes of [`Connection::outgoing`] were sent.
    pub fn sent(&mut self, len: usize) {
        self.flights.out.drain(..len);
    }

    /// Takes received bytes, which may end anywhere; over UDP, exactly one datagram.
    pub fn receive(&mut self, bytes: &[u8], now: Time, mut sink: impl FnMut(Done<'_>)) {
        let datagram = matches!(self.wire, Wire::Datagrams(_));
        if self.flights.closed.is_some() || (bytes.is_empty() && !datagram) {
            return;
        }
        let flights = &mut self.flights;
        match &mut self.wire {
            Wire::Stream(stream) => stream.receive(flights, bytes, &mut sink),
            Wire::Datagrams(datagrams) => datagrams.receive(flights, bytes, &mut sink),
            Wire::OneAtATime(line) => line.receive(flights, bytes, now, &mut sink),
        }
    }

    /// When [`Connection::advance`] is to be called, if nothing happens before.
    pub fn deadline(&self) -> Option<Time> {
        if self.flights.closed.is_some() {
            return None;
        }
        match &self.wire {
            Wire::Stream(_) => self.flights.deadline(),
            Wire::Datagrams(datagrams) => datagrams.deadline(&self.flights),
            Wire::OneAtATime(line) => line.deadline(&self.flights),
        }
    }

    /// Does what is due: ends requests whose time is over, sends again, or sends at last.
    pub fn advance(&mut self, now: Time, mut sink: impl FnMut(Done<'_>)) {
        if self.flights.closed.is_some() {
            return;
        }
        let flights = &mut self.flights;
        match &mut self.wire {
            Wire::Stream(stream) => stream.advance(flights, now, &mut sink),
            Wire::Datagrams(datagrams) => datagrams.advance(flights, now, &mut sink),
            Wire::OneAtATime(line) => line.advance(flights, now, &mut sink),
        }
    }

    /// Drops a request: it gets no [`Done`]. Where replies have no transaction ids, it stays under
    /// way until its reply or its timeout, so that nobody else gets its reply.
    pub fn cancel(&mut self, ticket: Ticket) {
        match &mut self.wire {
            Wire::Stream(stream) => stream.cancel(&mut self.flights, ticket),
            Wire::Datagrams(_) | Wire::OneAtATime(_) => self.flights.abandon(ticket),
        }
    }

    /// Ends the connection: every request in flight fails.
    pub fn close(&mut self, why: Closed, mut sink: impl FnMut(Done<'_>)) {
        self.flights.close(why, &mut sink);
    }

    /// Why the connection has ended, if it has.
    pub fn closed(&self) -> Option<Closed> {
        self.flights.closed
    }

    /// Replies that were dropped because their requests had been given up.
    pub fn late(&self) -> u64 {
        self.flights.late
    }
}

//! The connection: the part that is the same for every transport.

use core::time::Duration;

use super::datagram::Datagrams;
use super::flights::{Done, Flights, Ticket};
use super::line::{Framing, OneAtATime};
use super::stream::Stream;
use super::{Closed, Time, Transport};
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
}

#[derive(Debug)]
enum Wire {
    Stream(Stream),
    Datagrams(Datagrams),
    OneAtATime(OneAtATime),
}

impl Connection {
    /// A new connection.
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

    /// Sends a request, or queues it until the line is silent. `timeout` starts now.
    ///
    /// # Errors
    /// [`Closed`]: the reason why the connection has ended, or [`Closed::NoTransactionId`].
    ///
    /// # Panics
    /// If another request is in flight on a transport that carries one at a time: see
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

    /// The number of requests in flight.
    pub fn in_flight(&self) -> usize {
        self.flights.len()
    }

    /// Whether a request is in flight.
    pub fn is_waiting_for(&self, ticket: Ticket) -> bool {
        self.flights.contains(ticket)
    }

    /// The bytes to send; over UDP, exactly one datagram.
    pub fn outgoing(&self) -> &[u8] {
        &self.flights.out
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
        let flights = &mut self.flights;
        match &mut self.wire {
            Wire::Stream(stream) => stream.receive(flights, bytes, &mut sink),
            Wire::Datagrams(datagrams) => datagrams.receive(flights, bytes, &mut sink),
            Wire::OneAtATime(line) => line.receive(flights, bytes, now, &mut sink),
        }
    }

    /// When to call [`Connection::advance`], unless another call comes first.
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

    /// Performs what is due: ends requests whose timeout has expired, repeats a datagram, or sends
    /// a queued request.
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

    /// Drops a request: it gets no [`Done`]. Without transaction ids, it stays in flight until its
    /// reply or timeout, so that its reply is not taken for another one.
    pub fn cancel(&mut self, ticket: Ticket) {
        match &mut self.wire {
            Wire::Stream(stream) => stream.cancel(&mut self.flights, ticket),
            Wire::Datagrams(_) | Wire::OneAtATime(_) => self.flights.abandon(ticket),
        }
    }

    /// Ends the connection. Every request in flight fails.
    pub fn close(&mut self, why: Closed, mut sink: impl FnMut(Done<'_>)) {
        self.flights.close(why, &mut sink);
    }

    /// The reason why the connection has ended; `None` while it is open.
    pub fn closed(&self) -> Option<Closed> {
        self.flights.closed
    }

    /// The number of late replies, which were dropped.
    pub fn late(&self) -> u64 {
        self.flights.late
    }
}

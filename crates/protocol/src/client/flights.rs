//! The requests in flight on a connection, and what all transports do with them.

use alloc::collections::VecDeque;
use alloc::vec::Vec;
use core::time::Duration;

use super::{Closed, Failure, InvalidResponse, Time};
use crate::pdu::{EncodedRequest, Response, ResponseError};

/// The number of a request on its connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Ticket(pub u64);

/// A completed request.
#[derive(Debug)]
pub struct Done<'d> {
    /// The ticket that [`super::Connection::send`] returned.
    pub ticket: Ticket,
    /// The timeout that [`super::Connection::send`] was given.
    pub timeout: Duration,
    /// The response, or why the request failed.
    pub outcome: Result<Response<'d>, Failure>,
}

/// A request in flight.
#[derive(Debug)]
pub(super) struct Flight {
    pub(super) ticket: Ticket,
    pub(super) transaction_id: u16,
    pub(super) unit_id: u8,
    pub(super) request: EncodedRequest,
    pub(super) sent: Time,
    timeout: Duration,
    pub(super) deadline: Time,
    /// Whether the result is to be dropped.
    abandoned: bool,
}

/// All requests in flight, in the order in which they were sent.
#[derive(Debug, Default)]
pub(super) struct Flights {
    waiting: VecDeque<Flight>,
    /// Bytes to send.
    pub(super) out: Vec<u8>,
    pub(super) closed: Option<Closed>,
    /// The number of late replies, which were dropped.
    pub(super) late: u64,
    next_ticket: u64,
}

impl Flights {
    pub(super) fn len(&self) -> usize {
        self.waiting.len()
    }

    pub(super) fn first(&self) -> Option<&Flight> {
        self.waiting.front()
    }

    pub(super) fn deadline(&self) -> Option<Time> {
        self.waiting.iter().map(|flight| flight.deadline).min()
    }

    pub(super) fn push(
        &mut self,
        unit_id: u8,
        request: &EncodedRequest,
        transaction_id: u16,
        sent: Time,
        timeout: Duration,
    ) -> Ticket {
        let ticket = Ticket(self.next_ticket);
        self.next_ticket += 1;
        let request = request.clone();
        let deadline = sent + timeout;
        self.waiting.push_back(Flight {
            ticket,
            transaction_id,
            unit_id,
            request,
            sent,
            timeout,
            deadline,
            abandoned: false,
        });
        ticket
    }

    /// The position of the request with this transaction id.
    pub(super) fn position(&self, transaction_id: u16) -> Option<usize> {
        self.waiting.iter().position(|flight| flight.transaction_id == transaction_id)
    }

    pub(super) fn get(&self, position: usize) -> Option<&Flight> {
        self.waiting.get(position)
    }

    pub(super) fn contains(&self, ticket: Ticket) -> bool {
        self.waiting.iter().any(|flight| flight.ticket == ticket)
    }

    /// Removes the request with this ticket.
    pub(super) fn take(&mut self, ticket: Ticket) -> Option<Flight> {
        let position = self.waiting.iter().position(|flight| flight.ticket == ticket)?;
        self.waiting.remove(position)
    }

    /// Leaves the request in flight, and drops its result.
    pub(super) fn abandon(&mut self, ticket: Ticket) {
        if let Some(flight) = self.waiting.iter_mut().find(|flight| flight.ticket == ticket) {
            flight.abandoned = true;
        }
    }

    /// Removes the first request whose timeout has expired.
    pub(super) fn expired(&mut self, now: Time) -> Option<Flight> {
        let position = self.waiting.iter().position(|flight| flight.deadline <= now)?;
        self.waiting.remove(position)
    }

    /// Checks a PDU that answers the request at this position, and reports the result. Returns the
    /// error if the PDU cannot be its response.
    pub(super) fn answer(
        &mut self,
        position: usize,
        pdu: &[u8],
        sink: &mut impl FnMut(Done<'_>),
    ) -> Option<InvalidResponse> {
        let flight = self.waiting.remove(position)?;
        let request = flight.request.request();
        let (outcome, invalid) = match request.response(pdu) {
            Ok(response) => (Ok(response), None),
            Err(ResponseError::Exception(code)) => (Err(Failure::Exception(code.code())), None),
            Err(ResponseError::UnknownException(code)) => (Err(Failure::Exception(code)), None),
            Err(error) => {
                let invalid = InvalidResponse::Pdu(error);
                (Err(Failure::Invalid(invalid)), Some(invalid))
            }
        };
        if !flight.abandoned {
            let Flight { ticket, timeout, .. } = flight;
            sink(Done { ticket, timeout, outcome });
        }
        invalid
    }

    /// Ends the first request with a result other than a reply.
    pub(super) fn finish(
        &mut self,
        outcome: Result<Response<'_>, Failure>,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        if let Some(flight) = self.waiting.pop_front() {
            flight.end(outcome, sink);
        }
    }

    /// Ends the connection and all its requests.
    pub(super) fn close(&mut self, why: Closed, sink: &mut impl FnMut(Done<'_>)) {
        if self.closed.is_some() {
            return;
        }
        self.closed = Some(why);
        self.out.clear();
        let failure = why.failure();
        while let Some(flight) = self.waiting.pop_front() {
            flight.end(Err(failure), sink);
        }
    }
}

impl Flight {
    pub(super) fn end(
        self,
        outcome: Result<Response<'_>, Failure>,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        if !self.abandoned {
            let Flight { ticket, timeout, .. } = self;
            sink(Done { ticket, timeout, outcome });
        }
    }
}

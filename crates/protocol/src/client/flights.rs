//! The requests in flight on a connection, and what all transports do alike with them.

use alloc::collections::VecDeque;
use alloc::vec::Vec;
use core::time::Duration;

use super::{Closed, Failure, InvalidResponse, Time};
use crate::pdu::{EncodedRequest, Response, ResponseError};

/// The number of a request on its connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Ticket(pub u64);

/// A request that has its result.
#[derive(Debug)]
pub struct Done<'d> {
    /// The number that [`super::Connection::send`] gave it.
    pub ticket: Ticket,
    /// What [`super::Connection::send`] was given.
    pub timeout: Duration,
    /// The response, or why there is none.
    pub outcome: Result<Response<'d>, Failure>,
}

/// A request that waits for its reply.
#[derive(Debug)]
pub(super) struct Flight {
    pub(super) ticket: Ticket,
    pub(super) transaction_id: u16,
    pub(super) unit_id: u8,
    pub(super) request: EncodedRequest,
    pub(super) sent: Time,
    timeout: Duration,
    pub(super) deadline: Time,
    /// Nobody wants the result any more.
    abandoned: bool,
}

/// All of them, in the order in which they were sent.
#[derive(Debug, Default)]
pub(super) struct Flights {
    waiting: VecDeque<Flight>,
    /// Bytes to be sent.
    pub(super) out: Vec<u8>,
    pub(super) closed: Option<Closed>,
    /// Replies that were dropped because their requests had been given up.
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

    /// The place of the request with that transaction id.
    pub(super) fn position(&self, transaction_id: u16) -> Option<usize> {
        self.waiting.iter().position(|flight| flight.transaction_id == transaction_id)
    }

    pub(super) fn get(&self, position: usize) -> Option<&Flight> {
        self.waiting.get(position)
    }

    pub(super) fn contains(&self, ticket: Ticket) -> bool {
        self.waiting.iter().any(|flight| flight.ticket == ticket)
    }

    /// Takes out the request with that number.
    pub(super) fn take(&mut self, ticket: Ticket) -> Option<Flight> {
        let position = self.waiting.iter().position(|flight| flight.ticket == ticket)?;
        self.waiting.remove(position)
    }

    /// Leaves the request under way, and drops its result.
    pub(super) fn abandon(&mut self, ticket: Ticket) {
        if let Some(flight) = self.waiting.iter_mut().find(|flight| flight.ticket == ticket) {
            flight.abandoned = true;
        }
    }

    /// Takes out the first request whose time is over.
    pub(super) fn expired(&mut self, now: Time) -> Option<Flight> {
        let position = self.waiting.iter().position(|flight| flight.deadline <= now)?;
        self.waiting.remove(position)
    }

    /// Judges a PDU that answers the request at this place, and hands the result on. A PDU that
    /// can't be its response is returned.
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

    /// Ends the first request with a result that is no reply.
    pub(super) fn finish(
        &mut self,
        outcome: Result<Response<'_>, Failure>,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        if let Some(flight) = self.waiting.pop_front() {
            flight.end(outcome, sink);
        }
    }

    /// Ends the connection, and with it all requests.
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

//! The requests in flight on a connection, and what all transports do with them.

use alloc::collections::VecDeque;
use alloc::vec::Vec;
use core::time::Duration;

use super::{Attempt, Closed, Failure, InvalidResponse, MAX_READ_DELAY, Time, Tolerance};
use crate::frame::rtu;
use crate::pdu::{EncodedRequest, Response, ResponseError};

/// The number of a request on its connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Ticket(pub u64);

/// What was received without a request that asked for it. Late replies are not among it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Strays {
    /// Complete frames that match no request.
    pub replies: u64,
    /// The bytes of these, and all others that are no part of a reply.
    pub bytes: u64,
}

/// A completed request.
#[derive(Debug)]
pub struct Done<'d> {
    /// The ticket that [`super::Connection::send`] returned.
    pub ticket: Ticket,
    /// The timeout that [`super::Connection::send`] was given, or the raised one.
    pub timeout: Duration,
    /// The response, or why the request failed.
    pub outcome: Result<Response<'d>, Failure>,
    /// The PDU of the reply; empty without one, as after a broadcast.
    pub pdu: &'d [u8],
    /// False if no byte of it was given out for sending, nor for an attempt before.
    pub maybe_sent: bool,
    /// The request may be sent again: give this to [`super::Connection::send_again`].
    pub again: Option<Attempt>,
}

/// What a request is sent with.
#[derive(Debug, Clone, Copy)]
pub(super) struct Call<'r> {
    pub(super) unit_id: u8,
    pub(super) request: &'r EncodedRequest,
    pub(super) timeout: Duration,
    pub(super) attempt: Attempt,
}

/// A request in flight.
#[derive(Debug)]
pub(super) struct Flight {
    pub(super) ticket: Ticket,
    pub(super) transaction_id: u16,
    pub(super) unit_id: u8,
    pub(super) request: EncodedRequest,
    pub(super) sent: Time,
    /// The timeout that it was given, or the raised one.
    timeout: Duration,
    /// The timeout that it was given.
    pub(super) within: Duration,
    attempt: Attempt,
    pub(super) deadline: Time,
    /// Whether the result is to be dropped.
    abandoned: bool,
}

impl Flight {
    /// From when on the device can have handled it: since it was sent, and since the reply before.
    pub(super) fn began(&self) -> Time {
        self.deadline.saturating_sub(self.timeout)
    }

    /// Whether its reply may have come in time, and waits to be read: the process may have been stopped.
    pub(super) fn may_be_unread(&self, now: Time) -> bool {
        self.deadline + MAX_READ_DELAY <= now
    }
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
    /// The longest time that one of them took, as far as it is known.
    pub(super) longest_late: Duration,
    pub(super) strays: Strays,
    /// The number of requests that had more than their timeout, because late replies repeat.
    pub(super) raised: u64,
    /// Transaction ids of requests that ended with the connection.
    pub(super) unanswered: Vec<u16>,
    /// The unit and the request of the last of them, when it was sent, and its timeout.
    pub(super) cut_off: Option<(u8, EncodedRequest, Time, Duration)>,
    next_ticket: u64,
    pub(super) tolerance: Tolerance,
    /// `out` waits until then: the pause after the request before.
    pub(super) held: Option<Time>,
    /// Replies so far.
    answered: u64,
    /// Whether bytes were received since the last reply.
    pub(super) reply_begun: bool,
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
        Call { unit_id, request, timeout, attempt }: Call<'_>,
        transaction_id: u16,
        sent: Time,
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
            within: timeout,
            attempt,
            deadline,
            abandoned: false,
        });
        ticket
    }

    /// Gives the request that was pushed last more time than its timeout.
    pub(super) fn raise_last(&mut self, timeout: Duration) {
        if let Some(flight) = self.waiting.back_mut().filter(|flight| timeout > flight.timeout) {
            self.raised += 1;
            flight.timeout = timeout;
            flight.deadline = flight.sent + timeout;
        }
    }

    /// Counts a late reply, which took this time; 0 if that is not known.
    pub(super) fn came_late(&mut self, took: Duration) {
        self.late += 1;
        self.longest_late = self.longest_late.max(took);
    }

    /// The longest timeout of a request in flight; 0 if there is none.
    pub(super) fn longest_timeout(&self) -> Duration {
        self.waiting.iter().map(|flight| flight.timeout).max().unwrap_or_default()
    }

    /// When the timeout of a request ends.
    pub(super) fn deadline_of(&self, ticket: Ticket) -> Option<Time> {
        self.waiting.iter().find(|flight| flight.ticket == ticket).map(|flight| flight.deadline)
    }

    /// The place of the request with that transaction id. One that is held was not sent.
    pub(super) fn position(&self, transaction_id: u16) -> Option<usize> {
        if self.held.is_some() {
            return None;
        }
        self.waiting.iter().position(|flight| flight.transaction_id == transaction_id)
    }

    pub(super) fn get(&self, position: usize) -> Option<&Flight> {
        self.waiting.get(position)
    }

    /// The requests behind the one with that number.
    pub(super) fn after(&self, ticket: Ticket) -> impl Iterator<Item = &Flight> {
        self.waiting.iter().filter(move |flight| flight.ticket > ticket)
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

    /// Judges a PDU that answers the request at this place, and hands the result on. A PDU that
    /// can't be its response is returned. The timeouts of requests sent later start again: a device
    /// that handles one request at a time can't have begun them before.
    pub(super) fn answer(
        &mut self,
        position: usize,
        pdu: &[u8],
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) -> Option<InvalidResponse> {
        let flight = self.waiting.remove(position)?;
        self.restart_after(flight.ticket, now);
        self.answered += 1;
        self.reply_begun = false;
        let pdu = self.without_padding(&flight, pdu);
        let outcome = flight.request.response(pdu);
        let (outcome, invalid) = match outcome {
            Ok(response) => (Ok(response), None),
            Err(ResponseError::Exception(code)) => (Err(Failure::Exception(code.code())), None),
            Err(ResponseError::UnknownException(code)) => (Err(Failure::Exception(code)), None),
            Err(error) => {
                let invalid = InvalidResponse::Pdu(error);
                (Err(Failure::Invalid(invalid)), Some(invalid))
            }
        };
        self.end_with(flight, outcome, pdu, sink);
        invalid
    }

    /// Notes when the first request has been sent. Its timeout begins then, and may be raised.
    pub(super) fn transmitted(&mut self, timeout: Duration, sent: Time) {
        let Some(flight) = self.waiting.front_mut() else { return };
        if timeout > flight.timeout {
            self.raised += 1;
            flight.timeout = timeout;
        }
        flight.sent = sent;
        flight.deadline = sent + flight.timeout;
    }

    /// Notes that all requests are sent now. Their timeouts begin.
    pub(super) fn transmitted_all(&mut self, now: Time) {
        for flight in &mut self.waiting {
            flight.sent = now;
            flight.deadline = now + flight.timeout;
        }
    }

    /// Gives the first request more time.
    pub(super) fn prolong(&mut self, by: Duration) {
        if let Some(flight) = self.waiting.front_mut() {
            flight.deadline += by;
        }
    }

    /// Starts the timeout of the first request again.
    pub(super) fn restart(&mut self, now: Time) {
        if let Some(flight) = self.waiting.front_mut() {
            flight.deadline = now.max(flight.sent) + flight.timeout;
        }
    }

    /// Starts the timeouts of requests again that were sent after this one.
    pub(super) fn restart_after(&mut self, ticket: Ticket, now: Time) {
        for later in self.waiting.iter_mut().filter(|flight| flight.ticket > ticket) {
            later.deadline = now + later.timeout;
        }
    }

    /// The PDU, without surplus bytes behind it if the device may send some.
    fn without_padding<'p>(&self, flight: &Flight, pdu: &'p [u8]) -> &'p [u8] {
        if !self.tolerance.pad {
            return pdu;
        }
        let len = rtu::response_pdu_len(pdu, flight.request.pdu().len());
        len.ok().flatten().and_then(|len| pdu.get(..len)).unwrap_or(pdu)
    }

    /// Hands a result on that is no reply.
    pub(super) fn end(
        &self,
        flight: Flight,
        outcome: Result<Response<'_>, Failure>,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        self.end_with(flight, outcome, &[], sink);
    }

    /// Hands a result on, unless nobody wants it any more.
    fn end_with(
        &self,
        flight: Flight,
        outcome: Result<Response<'_>, Failure>,
        pdu: &[u8],
        sink: &mut impl FnMut(Done<'_>),
    ) {
        let Flight { ticket, timeout, attempt, request, abandoned, .. } = flight;
        if !abandoned {
            let stale = self.answered > 0 && !self.reply_begun;
            let failed = outcome.as_ref().err();
            let again =
                failed.and_then(|error| attempt.next(&request, *error, stale, &self.tolerance));
            let was_sent = self.held.is_none() && failed != Some(&Failure::NoSilence);
            let maybe_sent = was_sent || attempt != Attempt::default();
            sink(Done { ticket, timeout, outcome, pdu, maybe_sent, again });
        }
    }

    /// Ends the first request with a result that is no reply.
    pub(super) fn finish(
        &mut self,
        outcome: Result<Response<'_>, Failure>,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        if let Some(flight) = self.waiting.pop_front() {
            self.end(flight, outcome, sink);
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
        let were_sent = self.held.is_none();
        self.cut_off = self
            .waiting
            .back()
            .map(|flight| (flight.unit_id, flight.request.clone(), flight.sent, flight.timeout));
        while let Some(flight) = self.waiting.pop_front() {
            if were_sent {
                self.unanswered.push(flight.transaction_id);
            }
            self.end(flight, Err(failure), sink);
        }
    }
}

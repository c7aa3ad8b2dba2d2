//! MBAP frames in a stream: many requests in flight, matched by transaction id (Messaging on TCP/IP
//! Implementation Guide V1.0b, 4.4.2).

use alloc::collections::BTreeSet;
use alloc::vec::Vec;
use core::time::Duration;

use super::flights::{Done, Flights, Ticket};
use super::{Closed, Failure, InvalidResponse, MAX_CONSECUTIVE_TIMEOUTS, Time};
use crate::frame::mbap::{self, Next};
use crate::pdu::EncodedRequest;

/// The number of transaction ids.
const IDS: usize = 65_536;

#[derive(Debug, Default)]
pub(super) struct Stream {
    next_id: u16,
    /// Transaction ids of abandoned requests, whose replies may still arrive.
    given_up: BTreeSet<u16>,
    /// The beginning of an incomplete frame.
    partial: Vec<u8>,
    /// The number of timeouts since the last received byte, and the time of the last one.
    timeouts: u32,
    timed_out: Time,
}

impl Stream {
    pub(super) fn send(
        &mut self,
        flights: &mut Flights,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        now: Time,
    ) -> Option<Ticket> {
        if flights.len() + self.given_up.len() >= IDS {
            return None;
        }
        let mut id = self.next_id;
        while self.given_up.contains(&id) || flights.position(id).is_some() {
            id = id.wrapping_add(1);
        }
        self.next_id = id.wrapping_add(1);
        flights.out.extend_from_slice(&mbap::header(id, unit_id, request.pdu().len()));
        flights.out.extend_from_slice(request.pdu());
        Some(flights.push(unit_id, request, id, now, timeout))
    }

    /// Abandons a request. A late reply to it is dropped.
    pub(super) fn cancel(&mut self, flights: &mut Flights, ticket: Ticket) {
        if let Some(flight) = flights.take(ticket) {
            self.given_up.insert(flight.transaction_id);
        }
    }

    pub(super) fn receive(
        &mut self,
        flights: &mut Flights,
        bytes: &[u8],
        sink: &mut impl FnMut(Done<'_>),
    ) {
        self.timeouts = 0;
        let mut partial = core::mem::take(&mut self.partial);
        let mut rest = if partial.is_empty() {
            bytes
        } else {
            partial.extend_from_slice(bytes);
            &partial
        };
        loop {
            let invalid = match mbap::next(rest) {
                Next::Incomplete => break,
                Next::Foreign { protocol_id, .. } => Some(InvalidResponse::ProtocolId(protocol_id)),
                Next::Broken { length } => Some(InvalidResponse::Length(length)),
                Next::Frame { transaction_id, unit_id, pdu, len } => {
                    rest = &rest[len..];
                    self.frame(flights, transaction_id, unit_id, pdu, sink)
                }
            };
            if let Some(invalid) = invalid {
                return flights.close(Closed::Invalid(invalid), sink);
            }
        }
        if partial.is_empty() {
            self.partial.extend_from_slice(rest);
        } else {
            let taken = partial.len() - rest.len();
            partial.drain(..taken);
            self.partial = partial;
        }
    }

    fn frame(
        &mut self,
        flights: &mut Flights,
        id: u16,
        unit_id: u8,
        pdu: &[u8],
        sink: &mut impl FnMut(Done<'_>),
    ) -> Option<InvalidResponse> {
        let Some(position) = flights.position(id) else {
            if self.given_up.remove(&id) {
                flights.late += 1;
                return None;
            }
            return Some(InvalidResponse::TransactionId(id));
        };
        let expected = flights.get(position)?.unit_id;
        if unit_id != expected {
            return Some(InvalidResponse::UnitId { expected, found: unit_id });
        }
        flights.answer(position, pdu, sink)
    }

    pub(super) fn advance(
        &mut self,
        flights: &mut Flights,
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        let mut timed_out = false;
        while let Some(flight) = flights.expired(now) {
            timed_out = true;
            self.given_up.insert(flight.transaction_id);
            if self.timeouts == 0 || flight.sent >= self.timed_out {
                self.timeouts += 1;
                self.timed_out = now;
            }
            flight.end(Err(Failure::Timeout), sink);
        }
        if timed_out && self.has_broken_off(flights) {
            flights.close(Closed::BrokenOff, sink);
        } else if self.timeouts >= MAX_CONSECUTIVE_TIMEOUTS && flights.len() == 0 {
            flights.close(Closed::Silent, sink);
        }
    }

    /// Whether the incomplete reply belongs to an abandoned request: if the rest never arrives, the
    /// next reply would be taken for it.
    fn has_broken_off(&self, flights: &Flights) -> bool {
        match self.partial.first_chunk::<2>() {
            Some(id) => self.given_up.contains(&u16::from_be_bytes(*id)),
            None => !self.partial.is_empty() && flights.len() == 0,
        }
    }
}

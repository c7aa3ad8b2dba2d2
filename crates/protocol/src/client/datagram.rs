//! One MBAP frame per datagram, one request at a time. An unanswered read is sent again.

use core::time::Duration;

use super::flights::{Done, Flights, Ticket};
use super::{Closed, Failure, InvalidResponse, Time, UDP_ATTEMPTS};
use crate::frame::mbap::{self, Next};
use crate::pdu::EncodedRequest;

#[derive(Debug, Default)]
pub(super) struct Datagrams {
    next_id: u16,
    /// When to send the request again, and how many times.
    repeat: Option<Repeat>,
}

#[derive(Debug, Clone, Copy)]
struct Repeat {
    at: Time,
    every: Duration,
    left: u32,
}

impl Datagrams {
    pub(super) fn send(
        &mut self,
        flights: &mut Flights,
        unit_id: u8,
        request: &EncodedRequest,
        timeout: Duration,
        now: Time,
    ) -> Ticket {
        let id = self.next_id;
        self.next_id = id.wrapping_add(1);
        let every = timeout / UDP_ATTEMPTS;
        let left = if request.request().is_read() { UDP_ATTEMPTS - 1 } else { 0 };
        self.repeat = (left > 0).then_some(Repeat { at: now + every, every, left });
        let ticket = flights.push(unit_id, request, id, now, timeout);
        write(flights);
        ticket
    }

    pub(super) fn deadline(&self, flights: &Flights) -> Option<Time> {
        self.repeat.map(|repeat| repeat.at).or_else(|| flights.deadline())
    }

    pub(super) fn receive(
        &mut self,
        flights: &mut Flights,
        datagram: &[u8],
        sink: &mut impl FnMut(Done<'_>),
    ) {
        let invalid = match mbap::next(datagram) {
            Next::Frame { transaction_id, unit_id, pdu, len } if len == datagram.len() => {
                let expected =
                    flights.first().map(|flight| (flight.transaction_id, flight.unit_id));
                if expected == Some((transaction_id, unit_id)) {
                    self.repeat = None;
                    flights.answer(0, pdu, sink)
                } else {
                    flights.late += 1;
                    None
                }
            }
            _ => Some(InvalidResponse::Datagram),
        };
        if let Some(invalid) = invalid {
            flights.close(Closed::Invalid(invalid), sink);
        }
    }

    pub(super) fn advance(
        &mut self,
        flights: &mut Flights,
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        if let Some(flight) = flights.expired(now) {
            self.repeat = None;
            return flight.end(Err(Failure::Timeout), sink);
        }
        if let Some(Repeat { at, every, left }) = self.repeat
            && at <= now
        {
            write(flights);
            self.repeat = (left > 1).then_some(Repeat { at: at + every, every, left: left - 1 });
        }
    }
}

/// Writes the datagram of the request in flight.
fn write(flights: &mut Flights) {
    if let Some(flight) = flights.first() {
        let pdu = flight.request.pdu();
        let header = mbap::header(flight.transaction_id, flight.unit_id, pdu.len());
        flights.out = [&header[..], pdu].concat();
    }
}

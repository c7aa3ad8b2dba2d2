//! One MBAP frame per datagram, one request at a time. An unanswered read is sent again.

use core::time::Duration;

use super::flights::{Call, Done, Flights, Ticket};
use super::mbap_stream;
use super::{Closed, Failure, InvalidResponse, Time, Tolerance, UDP_ATTEMPTS};
use crate::frame::mbap::{self, Next};

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
    pub(super) fn send(&mut self, flights: &mut Flights, call: Call<'_>, now: Time) -> Ticket {
        let id = self.next_id;
        self.next_id = id.wrapping_add(1);
        let every = call.timeout / UDP_ATTEMPTS;
        let left = if call.request.is_read() { UDP_ATTEMPTS - 1 } else { 0 };
        self.repeat = (left > 0).then_some(Repeat { at: now + every, every, left });
        let ticket = flights.push(call, id, now);
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
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        let Tolerance { pad, accept_unit, .. } = flights.tolerance;
        let invalid = match mbap_stream::next(datagram, pad).0 {
            Next::Frame { transaction_id, unit_id, pdu, len } if pad || len == datagram.len() => {
                let is_expected = flights.position(transaction_id).is_some()
                    && flights.first().is_some_and(|one| accept_unit.accepts(one.unit_id, unit_id));
                if is_expected {
                    self.repeat = None;
                    flights.answer(0, pdu, now, sink)
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
            return flights.end(flight, Err(Failure::Timeout), sink);
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

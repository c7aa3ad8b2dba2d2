//! One MBAP frame per datagram, one request at a time. An unanswered read is sent again.

use alloc::collections::VecDeque;
use core::time::Duration;

use super::flights::{Call, Done, Flights, Ticket};
use super::mbap_stream;
use super::{Closed, Failure, InvalidResponse, MAX_STRAY_DATAGRAMS, Time, Tolerance, UDP_ATTEMPTS};
use crate::frame::mbap::{self, Next};

/// The number of requests whose late replies are recognized.
const RECENT: usize = 16;

#[derive(Debug, Default)]
pub(super) struct Datagrams {
    next_id: u16,
    /// The state from which transaction ids follow; `None` while they count up.
    random: Option<u64>,
    /// The last transaction ids, and how many replies to each may still come.
    recent: VecDeque<(u16, u32)>,
    /// Datagrams that matched no request, since the last reply.
    strays: u32,
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
    pub(super) fn randomize(&mut self, seed: u64) {
        self.random = Some(seed);
        self.next_id = self.following(0);
    }

    /// The transaction id after this one, which no recent request had.
    fn following(&mut self, id: u16) -> u16 {
        let mut next = id;
        loop {
            next = match &mut self.random {
                None => next.wrapping_add(1),
                Some(state) => split_mix(state),
            };
            if self.recent.iter().all(|(recent, _)| *recent != next) {
                return next;
            }
        }
    }

    /// Whether a reply with that id may come.
    fn expects(&mut self, id: u16) -> bool {
        let recent = self.recent.iter_mut().find(|(recent, _)| *recent == id);
        recent.is_some_and(|(_, left)| {
            let is_expected = *left > 0;
            *left = left.saturating_sub(1);
            is_expected
        })
    }

    pub(super) fn send(&mut self, flights: &mut Flights, call: Call<'_>, now: Time) -> Ticket {
        let id = self.next_id;
        let every = call.timeout / UDP_ATTEMPTS;
        let left = if call.request.is_read() { UDP_ATTEMPTS - 1 } else { 0 };
        self.repeat = (left > 0).then_some(Repeat { at: now + every, every, left });
        self.recent.truncate(RECENT - 1);
        self.recent.push_front((id, left + 1));
        self.next_id = self.following(id);
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
                let in_flight = flights.position(transaction_id).is_some();
                let is_expected = in_flight
                    && flights.first().is_some_and(|one| accept_unit.accepts(one.unit_id, unit_id));
                if is_expected {
                    self.expects(transaction_id);
                    (self.repeat, self.strays) = (None, 0);
                    flights.answer(0, pdu, now, sink)
                } else if !in_flight && self.expects(transaction_id) {
                    flights.late += 1;
                    None
                } else {
                    flights.strays.replies += 1;
                    flights.strays.bytes += len as u64;
                    self.strays += 1;
                    (self.strays > MAX_STRAY_DATAGRAMS).then_some(InvalidResponse::Flood)
                }
            }
            _ => {
                flights.strays.bytes += datagram.len() as u64;
                Some(InvalidResponse::Datagram)
            }
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

/// The next number of the generator SplitMix64. Whoever sees none of its numbers can't guess the next.
fn split_mix(state: &mut u64) -> u16 {
    *state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let mixed = (*state ^ (*state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((mixed ^ (mixed >> 31)) >> 48) as u16
}

/// Writes the datagram of the request in flight.
fn write(flights: &mut Flights) {
    if let Some(flight) = flights.first() {
        let pdu = flight.request.pdu();
        let header = mbap::header(flight.transaction_id, flight.unit_id, pdu.len());
        flights.out = [&header[..], pdu].concat();
    }
}

//! One MBAP frame per datagram, one request at a time. An unanswered read is sent again.

use alloc::collections::VecDeque;
use core::time::Duration;

use super::consecutive_timeouts::ConsecutiveTimeouts;
use super::flights::{Call, Done, Flights, Ticket};
use super::mbap_stream;
use super::raised_timeouts::{Lateness, MAX_RAISED_FACTOR};
use super::{Closed, Failure, InvalidResponse, Time, Tolerance};
use crate::frame::mbap::{self, Next};

/// How many times a read is sent over UDP within its timeout.
pub const UDP_ATTEMPTS: u32 = 3;

/// The number of datagrams that match no request, since the last reply, after which a connection ends.
pub const MAX_STRAY_DATAGRAMS: u32 = 1000;

/// The number of requests whose late replies are recognized.
const MAX_RECENT_REQUESTS: usize = 16;

#[derive(Debug, Default)]
pub(super) struct Datagrams {
    next_id: u16,
    /// The state from which transaction ids follow; `None` while they count up.
    random: Option<u64>,
    /// The last requests.
    recent: VecDeque<Recent>,
    pub(super) lateness: Lateness,
    /// Datagrams that matched no request, since the last reply.
    strays: u32,
    timeouts: ConsecutiveTimeouts,
    /// When to send the request again, and how many times.
    repeat: Option<Repeat>,
}

/// A request whose replies are recognized.
#[derive(Debug, Clone, Copy)]
struct Recent {
    transaction_id: u16,
    unit_id: u8,
    /// `None` once the time until a reply is read says nothing of the unit: one has come, or may have waited.
    sent: Option<Time>,
    within: Duration,
    /// How many replies to it may still come.
    left: u32,
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
            if self.recent.iter().all(|recent| recent.transaction_id != next) {
                return next;
            }
        }
    }

    /// Takes a reply with that id, if one may come: the first one of its request says how long it took.
    fn take(&mut self, id: u16) -> Option<Recent> {
        let recent = self.recent.iter_mut().find(|recent| recent.transaction_id == id)?;
        recent.left = recent.left.checked_sub(1)?;
        let found = *recent;
        recent.sent = None;
        Some(found)
    }

    /// Notes a late reply.
    fn late(&mut self, flights: &mut Flights, request: Recent, now: Time) {
        let Recent { unit_id, sent, within, .. } = request;
        let took = sent.map_or(Duration::ZERO, |sent| now.saturating_sub(sent));
        let took = took.min(within * MAX_RAISED_FACTOR);
        flights.came_late(took);
        if took > within {
            self.lateness.late(unit_id, took);
        }
    }

    pub(super) fn send(&mut self, flights: &mut Flights, call: Call<'_>, now: Time) -> Ticket {
        let id = self.next_id;
        let Call { unit_id, timeout: within, .. } = call;
        let every = within / UDP_ATTEMPTS;
        let left = if call.request.is_read() { UDP_ATTEMPTS - 1 } else { 0 };
        self.repeat = (left > 0).then_some(Repeat { at: now + every, every, left });
        self.recent.truncate(MAX_RECENT_REQUESTS - 1);
        let (sent, left) = (Some(now), left + 1);
        let recent = Recent { transaction_id: id, unit_id, sent, within, left };
        self.recent.push_front(recent);
        self.next_id = self.following(id);
        let ticket = flights.push(call, id, now);
        flights.raise_last(self.lateness.timeout(unit_id, within));
        write(flights);
        ticket
    }

    /// Notes that the last request is sent now.
    pub(super) fn transmitted(&mut self, now: Time) {
        if let Some(last) = self.recent.front_mut() {
            last.sent = Some(now);
        }
        if let Some(repeat) = &mut self.repeat {
            repeat.at = now + repeat.every;
        }
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
        self.timeouts.clear();
        let Tolerance { pad, accept_unit, .. } = flights.tolerance;
        let invalid = match mbap_stream::next(datagram, pad).0 {
            Next::Frame { transaction_id, unit_id, pdu, len } if pad || len == datagram.len() => {
                let in_flight = flights.position(transaction_id).is_some();
                let is_expected = in_flight
                    && flights.first().is_some_and(|one| accept_unit.accepts(one.unit_id, unit_id));
                if is_expected {
                    if let Some(Recent { unit_id, sent: Some(sent), within, .. }) =
                        self.take(transaction_id)
                    {
                        self.lateness.answered(unit_id, now.saturating_sub(sent), within);
                    }
                    (self.repeat, self.strays) = (None, 0);
                    flights.answer(0, pdu, now, sink)
                } else if !in_flight && let Some(request) = self.take(transaction_id) {
                    self.late(flights, request, now);
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
            if let Some(last) = self.recent.front_mut().filter(|_| flight.may_be_unread(now)) {
                last.sent = None;
            }
            self.timeouts.add(flight.sent, now);
            flights.end(flight, Err(Failure::Timeout), sink);
            if self.timeouts.are_too_many(flights.longest_timeout(), now) {
                flights.close(Closed::Silent, sink);
            }
            return;
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
    // The last step of the generator changes only lower bits.
    (mixed >> 48) as u16
}

/// Writes the datagram of the request in flight.
fn write(flights: &mut Flights) {
    if let Some(flight) = flights.first() {
        let pdu = flight.request.pdu();
        let header = mbap::header(flight.transaction_id, flight.unit_id, pdu.len());
        flights.out = [&header[..], pdu].concat();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transaction_ids_are_the_high_bits_of_splitmix64() {
        // The first numbers of the generator after 0 are E220A8397B1DCDAF, 6E789E6AA1B965F4 and
        // 06C45D188009454F.
        let mut state = 0;
        assert_eq!([(); 3].map(|()| split_mix(&mut state)), [0xE220, 0x6E78, 0x06C4]);
    }
}

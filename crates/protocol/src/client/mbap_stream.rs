//! MBAP frames in a stream: many requests in flight, matched by transaction id (Messaging on TCP/IP
//! Implementation Guide V1.0b, 4.4.2).

use alloc::collections::{BTreeMap, VecDeque};
use alloc::vec::Vec;
use core::time::Duration;

use super::consecutive_timeouts::ConsecutiveTimeouts;
use super::flights::{Call, Done, Flight, Flights, Ticket};
use super::raised_timeouts::{Lateness, MAX_RAISED_FACTOR};
use super::{Closed, Failure, InvalidResponse, Time};
use crate::frame::mbap::{self, Next};

/// Bytes of an exception reply.
const EXCEPTION_LEN: usize = mbap::HEADER_LEN + 2;

/// The most requests in flight: half of the transaction ids, so that there is always a free one.
pub(super) const MAX_IN_FLIGHT: usize = 32_768;

#[derive(Debug, Default)]
pub(super) struct Stream {
    next_id: u16,
    given_up: AllGivenUp,
    pub(super) lateness: Lateness,
    /// The beginning of a frame.
    partial: Vec<u8>,
    timeouts: ConsecutiveTimeouts,
    /// Bytes that the header of an exception reply counted beyond its end. They may come, or not.
    surplus: usize,
}

/// A request that was given up.
#[derive(Debug, Clone, Copy)]
struct GivenUp {
    ticket: Ticket,
    unit_id: u8,
    /// `None` if its reply may have waited to be read: the time until then says nothing of the unit.
    began: Option<Time>,
    within: Duration,
}

impl GivenUp {
    fn new(flight: &Flight, may_be_unread: bool) -> Option<GivenUp> {
        let Flight { ticket, unit_id, within, .. } = *flight;
        let began = (!may_be_unread).then(|| flight.began());
        Some(GivenUp { ticket, unit_id, began, within })
    }
}

/// The requests that were given up last: their replies may still come, and their transaction ids are not used
/// again.
#[derive(Debug, Default)]
struct AllGivenUp {
    /// Those of an earlier connection are only known by their ids.
    by_id: BTreeMap<u16, Option<GivenUp>>,
    /// In the order in which they were given up. A request may be given up long after those sent behind it: by
    /// the order of ids, it would be forgotten at once, and its id be the next one.
    ids: VecDeque<u16>,
}

impl AllGivenUp {
    fn contains(&self, id: u16) -> bool {
        self.by_id.contains_key(&id)
    }

    fn insert(&mut self, id: u16, request: Option<GivenUp>) {
        if self.ids.len() >= usize::from(MAX_REMEMBERED_IDS)
            && let Some(oldest) = self.ids.pop_front()
        {
            self.by_id.remove(&oldest);
        }
        self.ids.push_back(id);
        self.by_id.insert(id, request);
    }

    fn remove(&mut self, id: u16) -> Option<Option<GivenUp>> {
        let request = self.by_id.remove(&id)?;
        self.ids.retain(|other| *other != id);
        Some(request)
    }
}

/// The latest transaction ids whose replies may still come, on a connection and from it to the next one.
const MAX_REMEMBERED_IDS: u16 = 4096;

impl Stream {
    pub(super) fn randomize(&mut self, seed: u64) {
        self.next_id = (seed ^ (seed >> 16) ^ (seed >> 32) ^ (seed >> 48)) as u16;
    }

    /// What the next connection needs: its first transaction id, and those that may still be answered.
    pub(super) fn take_ids(&mut self, flights: &Flights) -> (u16, Vec<u16>) {
        let given_up = core::mem::take(&mut self.given_up).ids.into_iter();
        let mut ids: Vec<u16> = given_up.chain(flights.unanswered.iter().copied()).collect();
        ids.retain(|id| self.is_recent(*id));
        (self.next_id, ids)
    }

    /// Whether a request, also one of an earlier connection, had this transaction id not long ago.
    fn is_recent(&self, id: u16) -> bool {
        self.next_id.wrapping_sub(id) <= MAX_REMEMBERED_IDS
    }

    /// Goes on where another connection ended.
    pub(super) fn go_on(&mut self, next_id: u16, given_up: &[u16]) {
        self.next_id = next_id;
        given_up.iter().for_each(|id| self.given_up.insert(*id, None));
    }

    pub(super) fn send(&mut self, flights: &mut Flights, call: Call<'_>, now: Time) -> Ticket {
        let mut id = self.next_id;
        while self.given_up.contains(id) || flights.position(id).is_some() {
            id = id.wrapping_add(1);
        }
        self.next_id = id.wrapping_add(1);
        let pdu = call.request.pdu();
        flights.out.extend_from_slice(&mbap::header(id, call.unit_id, pdu.len()));
        flights.out.extend_from_slice(pdu);
        let ticket = flights.push(call, id, now);
        flights.raise_last(self.lateness.timeout(call.unit_id, call.timeout));
        ticket
    }

    /// Gives a request up: its reply, should it come, is dropped. It still counts as a timeout at its
    /// deadline. One that waits for a pause is not sent.
    pub(super) fn cancel(&mut self, flights: &mut Flights, ticket: Ticket) {
        // While there is a pause, all requests are in `out`, in their order.
        let behind: usize = flights.after(ticket).map(frame_len).sum();
        let Some(flight) = flights.take(ticket) else { return };
        if flights.held.is_none() {
            self.given_up.insert(flight.transaction_id, GivenUp::new(&flight, false));
            return self.timeouts.cut_short(flight.deadline, flight.sent);
        }
        let end = flights.out.len().saturating_sub(behind);
        flights.out.drain(end.saturating_sub(frame_len(&flight))..end);
        if flights.len() == 0 {
            flights.held = None;
        }
    }

    pub(super) fn receive(
        &mut self,
        flights: &mut Flights,
        bytes: &[u8],
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        self.timeouts.clear();
        let mut partial = core::mem::take(&mut self.partial);
        let mut rest = if partial.is_empty() {
            bytes
        } else {
            partial.extend_from_slice(bytes);
            &partial
        };
        loop {
            rest = self.without_surplus(flights, rest);
            let (next, surplus) = next(rest, flights.tolerance.pad);
            self.surplus = surplus.unwrap_or(self.surplus);
            let invalid = match next {
                Next::Incomplete => break,
                Next::Foreign { protocol_id, .. } => {
                    flights.strays.bytes += rest.len() as u64;
                    Some(InvalidResponse::ProtocolId(protocol_id))
                }
                Next::Broken { length } => {
                    flights.strays.bytes += rest.len() as u64;
                    Some(InvalidResponse::Length(length))
                }
                // Behind an exception reply that is padded, there may be anything.
                Next::Frame { len, .. } if surplus.is_none() && self.is_cut_off(rest, len) => {
                    flights.strays.bytes += rest.len() as u64;
                    Some(InvalidResponse::Unrequested)
                }
                Next::Frame { transaction_id, unit_id, pdu, len } => {
                    let received = rest.len();
                    rest = &rest[len..];
                    let invalid = self.frame(flights, (transaction_id, unit_id, pdu), now, sink);
                    if let Some(InvalidResponse::TransactionId(_)) = invalid {
                        flights.strays.replies += 1;
                        flights.strays.bytes += received as u64;
                    }
                    invalid
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
        flights.reply_begun = !self.partial.is_empty();
    }

    /// Drops what the last exception reply had beyond its end.
    fn without_surplus<'b>(&mut self, flights: &Flights, mut bytes: &'b [u8]) -> &'b [u8] {
        while self.surplus > 0
            && let Some((id, _)) = bytes.split_first_chunk::<2>()
        {
            let id = u16::from_be_bytes(*id);
            if flights.position(id).is_some() || self.given_up.contains(id) {
                break;
            }
            self.surplus -= 1;
            bytes = &bytes[1..];
        }
        bytes
    }

    fn frame(
        &mut self,
        flights: &mut Flights,
        (id, unit_id, pdu): (u16, u8, &[u8]),
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) -> Option<InvalidResponse> {
        let Some(position) = flights.position(id) else {
            let Some(request) = self.given_up.remove(id) else {
                return Some(InvalidResponse::TransactionId(id));
            };
            self.late(flights, request, now);
            return None;
        };
        let flight = flights.get(position)?;
        let expected = flight.unit_id;
        if !flights.tolerance.accept_unit.accepts(expected, unit_id) {
            return Some(InvalidResponse::UnitId { expected, found: unit_id });
        }
        self.lateness.answered(expected, now.saturating_sub(flight.began()), flight.within);
        flights.answer(position, pdu, now, sink)
    }

    /// Notes a late reply to a request, of which an earlier connection has left only its transaction id.
    fn late(&mut self, flights: &mut Flights, request: Option<GivenUp>, now: Time) {
        flights.reply_begun = false;
        let Some(GivenUp { ticket, unit_id, began, within }) = request else {
            return flights.came_late(Duration::ZERO);
        };
        // The owner of the socket may not have read for a while.
        let took = began.map_or(Duration::ZERO, |began| now.saturating_sub(began));
        let took = took.min(within * MAX_RAISED_FACTOR);
        flights.came_late(took);
        flights.restart_after(ticket, now);
        // A device that handles one request at a time can't have begun those after it before.
        let all = self.given_up.by_id.values_mut().flatten();
        let after = all.filter(|other| other.ticket > ticket);
        after.for_each(|other| other.began = other.began.map(|_| now));
        // A call that its caller has ended before its timeout says nothing of the unit.
        if took > within {
            self.lateness.late(unit_id, took);
        }
    }

    /// Ends requests whose timeouts had expired when it was `due`.
    pub(super) fn advance(
        &mut self,
        flights: &mut Flights,
        due: Time,
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        let mut timed_out = false;
        while let Some(flight) = flights.expired(due) {
            timed_out = true;
            let given_up = GivenUp::new(&flight, flight.may_be_unread(now));
            self.given_up.insert(flight.transaction_id, given_up);
            self.timeouts.add(flight.sent, now);
            flights.end(flight, Err(Failure::Timeout), sink);
        }
        timed_out |= self.timeouts.add_cut_short(now);
        if timed_out && self.has_broken_off(flights) {
            flights.close(Closed::BrokenOff, sink);
        } else if self.timeouts.are_too_many(flights.longest_timeout(), now) {
            flights.close(Closed::Silent, sink);
        }
    }

    pub(super) fn deadline(&self, flights: &Flights) -> Option<Time> {
        flights.deadline().into_iter().chain(self.timeouts.deadline()).min()
    }

    /// Whether another reply begins in the frame at the start of `bytes`, which was cut off: there is no check
    /// sum that would show it. What follows the frame is then no frame. The other reply may also be a late
    /// one, or come again.
    fn is_cut_off(&self, bytes: &[u8], len: usize) -> bool {
        let behind = bytes.get(len..).unwrap_or_default();
        let has_protocol_id = behind.iter().skip(2).take(2).any(|byte| *byte != 0);
        (has_protocol_id || matches!(mbap::next(behind), Next::Broken { .. }))
            && (mbap::HEADER_LEN + 1..len).any(|at| match bytes.get(at..) {
                Some(other @ [high, low, 0, 0, ..]) => {
                    let id = u16::from_be_bytes([*high, *low]);
                    // Of a length that no reply has, they are values.
                    self.is_recent(id) && !matches!(mbap::next(other), Next::Broken { .. })
                }
                _ => false,
            })
    }

    /// Whether the incomplete reply belongs to an abandoned request: if the rest never arrives, the
    /// next reply would be taken for it.
    fn has_broken_off(&self, flights: &Flights) -> bool {
        match self.partial.first_chunk::<2>() {
            Some(id) => self.given_up.contains(u16::from_be_bytes(*id)),
            None => !self.partial.is_empty() && flights.len() == 0,
        }
    }
}

fn frame_len(flight: &Flight) -> usize {
    mbap::HEADER_LEN + flight.request.pdu().len()
}

/// The frame at the start of `bytes`. With `pad`, an exception reply ends after its exception code:
/// then also how many more bytes its header counts.
pub(super) fn next(bytes: &[u8], pad: bool) -> (Next<'_>, Option<usize>) {
    match short_exception(bytes) {
        Some((frame, surplus)) if pad => (frame, Some(surplus)),
        _ => (mbap::next(bytes), None),
    }
}

/// An exception reply whose header counts more bytes than it has, and how many more.
fn short_exception(bytes: &[u8]) -> Option<(Next<'_>, usize)> {
    let frame = bytes.first_chunk::<EXCEPTION_LEN>()?;
    let length = usize::from(u16::from_be_bytes([frame[4], frame[5]]));
    let is_short = frame[2..4] == [0, 0] && length > 3 && frame[7] & 0x80 != 0;
    let transaction_id = u16::from_be_bytes([frame[0], frame[1]]);
    is_short.then(|| {
        let (unit_id, pdu) = (frame[6], &frame[7..]);
        (Next::Frame { transaction_id, unit_id, pdu, len: EXCEPTION_LEN }, length - 3)
    })
}

//! RTU and ASCII frames, on a serial line or in a stream: one request at a time, without
//! transaction ids. On a serial line, silence separates replies: unrequested bytes are discarded,
//! and a request waits until the line is silent. A stream has no silence: there, unrequested bytes
//! or a timeout end the connection.

use alloc::vec::Vec;
use core::time::Duration;

use super::flights::{Call, Done, Flight, Flights, Ticket};
use super::{Closed, Failure, InvalidResponse, TURNAROUND, Time};
use crate::frame::{FrameError, ascii, rtu};
use crate::pdu::{self, EncodedRequest, Response};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Framing {
    Rtu,
    Ascii,
}

#[derive(Debug)]
pub(super) struct OneAtATime {
    framing: Framing,
    /// The silence between frames on a serial line; `None` for a stream.
    silence: Option<Duration>,
    /// Whether the adapter echoes sent bytes.
    echo: bool,
    state: State,
    /// When the line was last used.
    used: Time,
    /// The frame of the request.
    frame: Vec<u8>,
    received: Vec<u8>,
    /// What is wrong with the received bytes, none of which fits the request.
    stray: Option<FrameError>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Idle,
    /// A request waits for silence.
    Quieting {
        until: Time,
    },
    /// The request was sent. `echoed` says whether its echo has been received.
    Sent {
        echoed: bool,
    },
    /// A broadcast was sent.
    Turnaround {
        until: Time,
    },
}

impl OneAtATime {
    pub(super) fn new(framing: Framing, silence: Option<Duration>, echo: bool) -> OneAtATime {
        OneAtATime {
            framing,
            silence,
            echo,
            state: State::Idle,
            used: Time::ZERO,
            frame: Vec::new(),
            received: Vec::new(),
            stray: None,
        }
    }

    /// The length of the longest reply with an echo before it, in bytes.
    fn max_received(&self) -> usize {
        2 * match self.framing {
            Framing::Rtu => rtu::MAX_LEN,
            Framing::Ascii => ascii::MAX_LEN,
        }
    }

    pub(super) fn send(
        &mut self,
        flights: &mut Flights,
        call: Call<'_>,
        start: Time,
        now: Time,
    ) -> Ticket {
        let Call { unit_id, request, .. } = call;
        self.frame.clear();
        match self.framing {
            Framing::Rtu => encode(&mut self.frame, [0; rtu::MAX_LEN], |frame| {
                rtu::encode(unit_id, request.pdu(), frame)
            }),
            Framing::Ascii => encode(&mut self.frame, [0; ascii::MAX_LEN], |frame| {
                ascii::encode(unit_id, request.pdu(), frame)
            }),
        }
        self.received.clear();
        self.stray = None;
        let ticket = flights.push(call, 0, start);
        let until = self.silence.map_or(start, |silence| start.max(self.used + silence));
        self.state = State::Quieting { until };
        self.transmit(flights, now);
        ticket
    }

    /// When to call `advance`.
    pub(super) fn deadline(&self, flights: &Flights) -> Option<Time> {
        match self.state {
            State::Turnaround { until } => Some(until),
            State::Quieting { until } => flights.deadline().map(|deadline| deadline.min(until)),
            State::Idle | State::Sent { .. } => flights.deadline(),
        }
    }

    /// Sends the request if the line has been silent long enough.
    fn transmit(&mut self, flights: &mut Flights, now: Time) {
        if let State::Quieting { until } = self.state
            && until <= now
        {
            flights.out.extend_from_slice(&self.frame);
            let broadcast = flights.first().is_some_and(|flight| flight.unit_id == 0);
            self.state = if broadcast && self.silence.is_some() {
                State::Turnaround { until: now + TURNAROUND }
            } else {
                State::Sent { echoed: false }
            };
        }
    }

    pub(super) fn receive(
        &mut self,
        flights: &mut Flights,
        bytes: &[u8],
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        let State::Sent { mut echoed } = self.state else {
            flights.strays.bytes += self.count_unrequested(flights, bytes);
            return self.unrequested(flights, now, sink);
        };
        let room = self.max_received().saturating_sub(self.received.len());
        let (bytes, surplus) = bytes.split_at(bytes.len().min(room));
        self.received.extend_from_slice(bytes);
        let found = match self.framing {
            Framing::Rtu => self.rtu(flights, &mut echoed),
            Framing::Ascii => self.ascii(flights, &mut echoed),
        };
        self.state = State::Sent { echoed };
        match found {
            Ok(Some(Reply { unit_id, pdu, stray })) => {
                let behind = if flights.tolerance.pad { 0 } else { surplus.len() };
                flights.strays.bytes += (stray + behind) as u64;
                self.replied(flights, unit_id, &pdu, now, sink);
            }
            Ok(None) if surplus.is_empty() && room > bytes.len() => {}
            Ok(None) => {
                flights.strays.bytes += (self.received.len() + surplus.len()) as u64;
                self.invalid(flights, InvalidResponse::TooLong, now, sink);
            }
            Err(error) => self.invalid(flights, InvalidResponse::Frame(error), now, sink),
        }
    }

    /// Bytes without a request in flight, unless the device may send surplus bytes.
    fn count_unrequested(&self, flights: &Flights, bytes: &[u8]) -> u64 {
        let may_be_surplus = flights.tolerance.pad && self.state == State::Idle;
        if may_be_surplus { 0 } else { bytes.len() as u64 }
    }

    /// Handles bytes without a request in flight: a late reply, or data from another sender.
    fn unrequested(&mut self, flights: &mut Flights, now: Time, sink: &mut impl FnMut(Done<'_>)) {
        match self.silence {
            None if flights.tolerance.pad && self.state == State::Idle => {}
            None => flights.close(Closed::Invalid(InvalidResponse::Unrequested), sink),
            Some(silence) => {
                self.used = now;
                if let State::Quieting { .. } = self.state {
                    self.state = State::Quieting { until: now + silence };
                }
            }
        }
    }

    fn replied(
        &mut self,
        flights: &mut Flights,
        found: u8,
        pdu: &[u8],
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        let expected = flights.first().map_or(found, |flight| flight.unit_id);
        if !flights.tolerance.accept_unit.accepts(expected, found) {
            let invalid = InvalidResponse::UnitId { expected, found };
            return self.invalid(flights, invalid, now, sink);
        }
        self.rest(now);
        if let Some(invalid) = flights.answer(0, pdu, now, sink)
            && self.silence.is_none()
        {
            flights.close(Closed::Invalid(invalid), sink);
        }
    }

    fn invalid(
        &mut self,
        flights: &mut Flights,
        invalid: InvalidResponse,
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        self.rest(now);
        flights.finish(Err(Failure::Invalid(invalid)), sink);
        if self.silence.is_none() {
            flights.close(Closed::Invalid(invalid), sink);
        }
    }

    fn rest(&mut self, now: Time) {
        self.state = State::Idle;
        self.used = now;
    }

    pub(super) fn advance(
        &mut self,
        flights: &mut Flights,
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        if let State::Turnaround { until } = self.state {
            if until <= now {
                self.rest(now);
                flights.finish(Ok(Response::Written), sink);
            }
            return;
        }
        if let Some(flight) = flights.expired(now) {
            let sent = !matches!(self.state, State::Quieting { .. });
            self.rest(now);
            let invalid = self.stray.map(InvalidResponse::Frame);
            flights.end(flight, Err(invalid.map_or(Failure::Timeout, Failure::Invalid)), sink);
            if sent && self.silence.is_none() {
                flights.close(Closed::TimedOut, sink);
            }
            return;
        }
        self.transmit(flights, now);
    }

    /// The reply in what was received; `None` while more bytes are needed. Stray bytes before it are
    /// skipped: the reply begins at the first byte that fits the request and the CRC.
    fn rtu(&mut self, flights: &Flights, echoed: &mut bool) -> Result<Option<Reply>, FrameError> {
        let Some(flight) = flights.first() else { return Ok(None) };
        let may_be_echo = !*echoed && (self.echo || is_no_reply(flight));
        let echo = self.received.windows(self.frame.len()).position(|bytes| bytes == self.frame);
        if may_be_echo && let Some(start) = echo {
            self.received.drain(..start + self.frame.len());
            (*echoed, self.echo) = (true, true);
        }
        if self.echo && !*echoed {
            return Ok(None);
        }
        let request = flight.request.pdu();
        let mut failure = None;
        self.stray = None;
        for start in 0..self.received.len() {
            let bytes = &self.received[start..];
            let fits = flights.tolerance.accept_unit.accepts(flight.unit_id, bytes[0])
                && bytes.get(1).is_none_or(|code| code & 0x7F == request[0]);
            if start > 0 && !fits {
                continue;
            }
            match response_len(bytes, &flight.request) {
                Ok(Some(len)) if len <= bytes.len() => match rtu::decode(&bytes[..len]) {
                    Ok(reply) => {
                        let behind = bytes.len() - len;
                        let stray = if flights.tolerance.pad { start } else { start + behind };
                        return Ok(Some(Reply::new(reply, stray)));
                    }
                    Err(error) if fits => failure = failure.or(Some(error)),
                    Err(error) => self.stray = Some(error),
                },
                Ok(_) if fits => return Ok(None),
                Ok(_) => self.stray = Some(FrameError::CheckSum),
                Err(error) => self.stray = Some(error),
            }
        }
        // The beginning of an echo is not a damaged reply.
        let echo_begun = may_be_echo && !*echoed && self.frame.starts_with(&self.received);
        match failure {
            Some(error) if !echo_begun => Err(error),
            _ => Ok(None),
        }
    }

    /// Parses the reply in the received characters; `None` while more are needed.
    fn ascii(&mut self, flights: &Flights, echoed: &mut bool) -> Result<Option<Reply>, FrameError> {
        let Some(flight) = flights.first() else { return Ok(None) };
        while let Some(end) = self.received.windows(2).position(|pair| pair == b"\r\n") {
            let line: Vec<u8> = self.received.drain(..end + 2).collect();
            let start = line.iter().rposition(|byte| *byte == b':').unwrap_or(0);
            let behind = if flights.tolerance.pad { 0 } else { self.received.len() };
            let line = &line[start..];
            let may_be_echo = !*echoed && (self.echo || is_no_reply(flight));
            if may_be_echo && line == self.frame {
                (*echoed, self.echo) = (true, true);
                continue;
            }
            let mut body = [0; pdu::MAX_LEN + 2];
            return ascii::decode(line, &mut body)
                .map(|parts| Some(Reply::new(parts, start + behind)));
        }
        Ok(None)
    }
}

/// The length of the reply that `bytes` begin with; `None` while more are needed. The reply to a
/// request that is passed on as it came ends with what has arrived, as soon as the CRC fits.
fn response_len(bytes: &[u8], request: &EncodedRequest) -> Result<Option<usize>, FrameError> {
    let pdu = request.pdu();
    if request.request().is_none() && bytes.get(1) == pdu.first() && bytes.len() <= rtu::MAX_LEN {
        return Ok(rtu::decode(bytes).is_ok().then_some(bytes.len()));
    }
    rtu::response_len(bytes, pdu.len())
}

/// Whether the request itself, sent back, can't be taken for its reply.
fn is_no_reply(flight: &Flight) -> bool {
    let request = &flight.request;
    request.is_read() && request.response(request.pdu()).is_err()
}

/// A reply that was taken out of its frame.
struct Reply {
    unit_id: u8,
    pdu: Vec<u8>,
    /// Bytes before and behind it that are no part of it.
    stray: usize,
}

impl Reply {
    fn new((unit_id, pdu): (u8, &[u8]), stray: usize) -> Reply {
        Reply { unit_id, pdu: pdu.to_vec(), stray }
    }
}

/// Appends the frame that `write` encodes.
fn encode<const N: usize>(
    frame: &mut Vec<u8>,
    mut buffer: [u8; N],
    write: impl FnOnce(&mut [u8; N]) -> Option<usize>,
) {
    match write(&mut buffer) {
        Some(len) => frame.extend_from_slice(&buffer[..len]),
        None => {
            unreachable!("an encoded request has 1 to 253 bytes, which fit into every frame")
        }
    }
}

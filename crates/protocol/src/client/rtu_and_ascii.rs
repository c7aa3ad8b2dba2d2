//! RTU and ASCII frames, on a serial line or in a stream: one request at a time, without
//! transaction ids. On a serial line, silence separates replies: unrequested bytes are discarded,
//! and a request waits until the line is silent. A stream has no silence: there, unrequested bytes
//! or a timeout end the connection. A request also waits until no reply to an earlier one can come that
//! could be taken for its own ([`LateReplies`]), on the next connection too.

use alloc::vec::Vec;
use core::time::Duration;

use super::attempts::Attempt;
use super::echo::Echo;
use super::flights::{Call, Done, Flight, Flights, Ticket};
use super::late_replies_without_ids::{
    Ended, GUARD, LateReplies, Unanswered, confirmation, read_bytes,
};
use super::{Closed, Failure, InvalidResponse, MAX_READ_DELAY, Time, Tolerance};
use crate::frame::{FrameError, ascii, rtu};
use crate::pdu::{self, EncodedRequest, ExceptionCode, Response, ResponseError};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Framing {
    Rtu,
    Ascii,
}

/// The time that the units of a serial line have to carry out a broadcast (Modbus over Serial Line
/// V1.02, 2.4.1).
pub const TURNAROUND: Duration = Duration::from_millis(100);

/// The exception of a gateway that has no reply yet: that of the device may follow.
const GATEWAY_NO_REPLY: u8 = ExceptionCode::GatewayTargetFailedToRespond as u8;

/// Bytes behind a reply that are no sign of another one, whatever they are: lines have some when a driver is
/// switched off.
const MAX_NOISE_BYTES: usize = 2;

#[derive(Debug)]
pub(super) struct OneAtATime {
    framing: Framing,
    /// The silence between frames on a serial line; `None` for a stream.
    silence: Option<Duration>,
    echo: Echo,
    pub(super) late_replies: LateReplies,
    /// The time of a character on a serial line; 0 elsewhere.
    pub(super) character: Duration,
    /// What the line needs for the request and a reply to it that came sooner, and was dropped.
    too_fast: Option<Duration>,
    /// The timeout that the request was given: its own may be longer.
    timeout: Duration,
    /// The request is not sent before: what it waits for is a pause.
    start: Time,
    /// Its timeout was prolonged: its reply had begun.
    is_prolonged: bool,
    /// The request repeats an earlier one of the same call.
    repeats: bool,
    /// A frame came right behind the reply.
    behind: Behind,
    /// The reply that is believed if no other follows, and when it came.
    doubted: Option<(u8, Vec<u8>, Time)>,
    /// It may be an echo, before the same bytes as the reply.
    is_maybe_echo: bool,
    state: State,
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
    /// A reply has come. Until then, no other may.
    Doubting {
        until: Time,
    },
    /// A broadcast was sent.
    Turnaround {
        until: Time,
    },
}

/// What came right behind a reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Behind {
    NoFrame,
    /// The same frame.
    Same,
    /// Another frame.
    Another,
}

impl OneAtATime {
    pub(super) fn new(framing: Framing, silence: Option<Duration>, echo: Echo) -> OneAtATime {
        OneAtATime {
            framing,
            silence,
            echo,
            late_replies: LateReplies::default(),
            character: Duration::ZERO,
            too_fast: None,
            timeout: Duration::ZERO,
            start: Time::ZERO,
            is_prolonged: false,
            repeats: false,
            behind: Behind::NoFrame,
            doubted: None,
            is_maybe_echo: false,
            state: State::Idle,
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
        let Call { unit_id, request, timeout, attempt } = call;
        self.frame.clear();
        let mut room = [0; ascii::MAX_LEN];
        let len = match self.framing {
            Framing::Rtu => {
                let frame = room.first_chunk_mut();
                frame.and_then(|frame| rtu::encode(unit_id, request.pdu(), frame))
            }
            Framing::Ascii => ascii::encode(unit_id, request.pdu(), &mut room),
        };
        let len = len.expect("an encoded request has 1 to 253 bytes, which fit into every frame");
        self.frame.extend_from_slice(&room[..len]);
        self.keep_begun(flights);
        (self.stray, self.too_fast, self.is_prolonged) = (None, None, false);
        (self.timeout, self.start) = (timeout, start);
        // The reply to the same request, sent before by the same call, is as good.
        self.repeats = attempt != Attempt::default();
        let may_begin = start.max(self.clear_at(flights, (unit_id, request), now));
        let ticket = flights.push(call, 0, may_begin);
        let until = self
            .silence
            .map_or(may_begin, |silence| may_begin.max(self.late_replies.last_activity + silence));
        self.state = State::Quieting { until };
        self.transmit(flights, now);
        ticket
    }

    /// Drops a request, or leaves it in flight with nobody who waits for its result.
    pub(super) fn cancel(&mut self, flights: &mut Flights, ticket: Ticket, now: Time) {
        flights.abandon(ticket);
        if let State::Quieting { .. } = self.state
            && flights.take(ticket).is_some()
        {
            self.rest(now);
        }
    }

    /// From when on no reply can come that could be taken for the one to this request.
    fn clear_at(
        &mut self,
        flights: &Flights,
        (unit_id, request): (u8, &EncodedRequest),
        now: Time,
    ) -> Time {
        let is_broadcast = unit_id == 0 && self.silence.is_some();
        if self.repeats || is_broadcast {
            return Time::ZERO;
        }
        let clear = self.late_replies.until(unit_id, request, &flights.tolerance, now);
        let last = self.late_replies.last_activity;
        let guarded = if last.is_zero() { last } else { last + self.late_replies.guard() };
        clear.unwrap_or_default().max(guarded)
    }

    /// When to call `advance`.
    pub(super) fn deadline(&self, flights: &Flights) -> Option<Time> {
        match self.state {
            State::Turnaround { until } | State::Doubting { until } => Some(until),
            State::Quieting { until } => flights.deadline().map(|deadline| deadline.min(until)),
            State::Idle | State::Sent { .. } => flights.deadline(),
        }
    }

    /// When the timeout of the request ends, if it was sent.
    pub(super) fn awaits_reply_until(&self, flights: &Flights) -> Option<Time> {
        match self.state {
            State::Sent { .. } => flights.deadline(),
            State::Doubting { until } => flights.deadline().max(Some(until)),
            State::Idle | State::Quieting { .. } | State::Turnaround { .. } => None,
        }
    }

    /// Sends the request if the line has been silent long enough.
    fn transmit(&mut self, flights: &mut Flights, now: Time) {
        if let State::Quieting { until } = self.state
            && until <= now
        {
            flights.out.extend_from_slice(&self.frame);
            let unit_id = flights.first().map_or(0, |flight| flight.unit_id);
            // The driver takes the whole frame at once, and the line carries it then.
            let sent = now + self.character * self.frame.len() as u32;
            flights.transmitted(self.late_replies.timeout(unit_id, self.timeout), sent);
            // Also for the next connection.
            self.late_replies.last_activity = sent;
            self.late_replies.expire(now);
            self.received.clear();
            let broadcast = flights.first().filter(|flight| flight.unit_id == 0);
            self.state = match broadcast.filter(|_| self.silence.is_some()) {
                Some(flight) => {
                    // Units may confirm it from now on. No request is sent before the turnaround ends.
                    let times = (sent, self.timeout.max(TURNAROUND));
                    let request = (0, &flight.request);
                    self.late_replies.ended(request, times, Ended::Broadcast, now);
                    State::Turnaround { until: sent + TURNAROUND }
                }
                None => State::Sent { echoed: false },
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
        if let State::Doubting { .. } = self.state {
            return self.after_doubted(flights, bytes, now, sink);
        }
        let State::Sent { mut echoed } = self.state else {
            return self.unrequested(flights, bytes, now, sink);
        };
        let room = self.max_received().saturating_sub(self.received.len());
        let (bytes, surplus) = bytes.split_at(bytes.len().min(room));
        self.received.extend_from_slice(bytes);
        if !self.repeats && self.take_late(flights, now) > 0 {
            flights.restart(now);
        }
        let found = match self.framing {
            Framing::Rtu => self.rtu(flights, &mut echoed),
            Framing::Ascii => self.ascii(flights, &mut echoed),
        };
        self.state = State::Sent { echoed };
        match found {
            Ok(Some(Reply { unit_id, pdu, stray })) => {
                let behind = if flights.tolerance.pad { 0 } else { surplus.len() };
                flights.strays.bytes += (stray + behind) as u64;
                self.found(flights, (unit_id, pdu), now, sink);
            }
            Ok(None) if surplus.is_empty() && room > bytes.len() => {}
            Ok(None) => {
                flights.strays.bytes += (self.received.len() + surplus.len()) as u64;
                self.invalid(flights, InvalidResponse::TooLong, now, sink);
            }
            Err(error) => self.invalid(flights, InvalidResponse::Frame(error), now, sink),
        }
    }

    /// Handles bytes while no request waits for its reply: a late reply, or data from another sender.
    fn unrequested(
        &mut self,
        flights: &mut Flights,
        bytes: &[u8],
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        let is_idle = self.state == State::Idle;
        let may_be_surplus = flights.tolerance.pad && is_idle;
        let had_begun = self.begun_late(flights);
        if self.received.len() + bytes.len() > self.max_received() {
            self.received.clear();
        }
        self.received.extend_from_slice(&bytes[..bytes.len().min(self.max_received())]);
        let may_be_echo = matches!(self.state, State::Turnaround { .. })
            && flights.first().is_some_and(|flight| self.may_be_echo(flight));
        let echo = if may_be_echo && self.take_echo() { self.frame.len() } else { 0 };
        let late = self.take_late(flights, now);
        if !may_be_surplus {
            let known = echo + late + self.begun_late(flights);
            flights.strays.bytes += (had_begun + bytes.len()).saturating_sub(known) as u64;
        }
        if late == 0 && is_frame(self.framing, &self.received) {
            self.received.clear();
            self.late_replies.stray(now.saturating_sub(self.late_replies.last_activity));
        }
        self.late_replies.last_activity = now;
        if self.silence.is_none() && is_idle && late == 0 && !may_be_surplus {
            flights.close(Closed::Invalid(InvalidResponse::Unrequested), sink);
        }
        self.wait_again(flights, self.silence.unwrap_or_default(), now);
    }

    /// Lets a request that waits for silence wait from now on.
    fn wait_again(&mut self, flights: &Flights, silence: Duration, now: Time) {
        let State::Quieting { .. } = self.state else { return };
        let Some(flight) = flights.first() else { return };
        let (unit_id, request) = (flight.unit_id, flight.request.clone());
        let clear = self.clear_at(flights, (unit_id, &request), now);
        self.state = State::Quieting { until: self.start.max(clear).max(now + silence) };
    }

    /// Takes late replies out of the received bytes. Returns the number of their bytes.
    fn take_late(&mut self, flights: &mut Flights, now: Time) -> usize {
        let mut taken = 0;
        while let Some((place, at, len)) = self.late_reply(flights.tolerance.pad) {
            let took = self.late_replies.late(place, now);
            self.received.drain(at..at + len);
            flights.came_late(took);
            taken += len;
        }
        taken
    }

    /// The place of an earlier request whose reply was received, and where it is.
    fn late_reply(&self, pads: bool) -> Option<(usize, usize, usize)> {
        let mut unanswered = self.late_replies.unanswered().enumerate();
        unanswered.find_map(|(place, earlier)| {
            (0..self.received.len()).find_map(|at| {
                let len = self.reply_to(earlier, pads, &self.received[at..])?;
                Some((place, at, len))
            })
        })
    }

    /// The length of the reply that `bytes` begin with, if it answers this request. One with an exception
    /// answers any request of its function, but no broadcast while another request waits: it may be the reply
    /// to that.
    fn reply_to(&self, earlier: &Unanswered, pads: bool, bytes: &[u8]) -> Option<usize> {
        let Unanswered { unit_id, ref request, is_broadcast, .. } = *earlier;
        let function = *request.pdu().first()?;
        let is_its = |(unit, pdu): (u8, &[u8])| {
            if is_broadcast {
                let no_other_waits = !matches!(self.state, State::Sent { .. });
                let is_exception = pdu.first() == Some(&(function | 0x80));
                return pdu == confirmation(request) || (no_other_waits && is_exception);
            }
            let is_of_function = pdu.first().is_some_and(|code| code & 0x7F == function);
            // A request that reads another number of bytes may wait for its own reply.
            let fits = pads || !matches!(request.response(pdu), Err(ResponseError::Length));
            unit == unit_id && is_of_function && fits
        };
        match self.framing {
            Framing::Rtu => {
                let is_unit = is_broadcast || bytes[0] == unit_id;
                if bytes.len() < 2 || !is_unit || bytes[1] & 0x7F != function {
                    return None;
                }
                let len = response_len(bytes, request).ok()??;
                rtu::decode(bytes.get(..len)?).is_ok_and(is_its).then_some(len)
            }
            Framing::Ascii => {
                let line = ascii_line(bytes)?;
                let mut body = [0; pdu::MAX_LEN + 2];
                ascii::decode(line, &mut body).is_ok_and(is_its).then_some(line.len())
            }
        }
    }

    /// How much has been received of a reply to this request of a unit that is not complete, and how much is missing.
    fn begun(
        &self,
        pads: bool,
        request: &EncodedRequest,
        is_unit: impl Fn(u8) -> bool,
    ) -> Option<(usize, usize)> {
        let pdu_len = |bytes: &[u8]| {
            let (unit_id, function) = (*bytes.first()?, *request.pdu().first()?);
            if !is_unit(unit_id) || bytes.get(1).is_some_and(|code| code & 0x7F != function) {
                return None;
            }
            let start = [unit_id, function];
            let len = response_len(if bytes.len() > 1 { bytes } else { &start }, request).ok()?;
            let most = read_reply_len(request).unwrap_or(rtu::MAX_LEN);
            // Without unit id and CRC.
            self.may_come(pads, request, bytes, len).then(|| len.unwrap_or(most) - 3)
        };
        let missing = |at, pdu_len| {
            let received = self.received.len() - at;
            let missing = self.reply_len(pdu_len).saturating_sub(received);
            (missing > 0).then_some((received, missing))
        };
        match self.framing {
            Framing::Rtu => {
                (0..self.received.len()).find_map(|at| missing(at, pdu_len(&self.received[at..])?))
            }
            Framing::Ascii => {
                let at = self.received.iter().rposition(|byte| *byte == b':')?;
                let pairs = self.received[at + 1..].chunks_exact(2);
                let digits = pairs.map_while(|pair| core::str::from_utf8(pair).ok());
                let bytes = digits.map_while(|pair| u8::from_str_radix(pair, 16).ok());
                missing(at, pdu_len(&bytes.collect::<Vec<u8>>())?)
            }
        }
    }

    /// How much has been received of a late reply that is not complete.
    fn begun_late(&self, flights: &Flights) -> usize {
        let known = self.late_replies.unanswered().filter(|earlier| !earlier.is_broadcast);
        let begun = known.filter_map(|earlier| {
            let is_unit = |unit_id| unit_id == earlier.unit_id;
            self.begun(flights.tolerance.pad, &earlier.request, is_unit)
        });
        begun.map(|(received, _)| received).max().unwrap_or_default()
    }

    /// Drops what was received, except a late reply that is not complete.
    fn keep_begun(&mut self, flights: &Flights) {
        let dropped = self.received.len() - self.begun_late(flights);
        self.received.drain(..dropped);
    }

    /// Handles a reply that can answer the request: believes it, or waits whether another follows.
    fn found(
        &mut self,
        flights: &mut Flights,
        (unit_id, pdu): (u8, Vec<u8>),
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        if self.is_too_fast(flights, pdu.len(), now) && !self.late_replies.shows_fast_line(&pdu) {
            flights.strays.replies += 1;
            flights.strays.bytes += self.reply_len(pdu.len()) as u64;
            self.received.clear();
            self.too_fast = Some(self.needed(pdu.len()));
            return self.late_replies.stray(Duration::ZERO);
        }
        let behind = core::mem::replace(&mut self.behind, Behind::NoFrame);
        let is_like_echo = self.is_like_echo(flights, &pdu);
        if is_like_echo && behind == Behind::Same {
            self.late_replies.echoes = self.late_replies.echoes.saturating_add(1);
            return self.replied(flights, (unit_id, &pdu, now), now, sink);
        }
        if behind != Behind::NoFrame && !flights.tolerance.pad {
            self.late_replies.stray(Duration::ZERO);
        }
        if behind == Behind::Another && !flights.tolerance.pad {
            return self.contradicted(flights, now, sink);
        }
        let accepted = flights.tolerance.accept_unit;
        let is_doubtful = flights.first().is_some_and(|flight| {
            let request = (flight.unit_id, flight.request.pdu());
            let is_its = accepted.accepts(flight.unit_id, unit_id);
            is_its && !self.repeats && self.late_replies.is_doubtful(request, &pdu, now)
        });
        if is_doubtful || is_like_echo {
            if let (State::Sent { .. }, Some(flight)) = (self.state, flights.first()) {
                self.learn_echo(is_no_reply(flight));
            }
            let until = flights.first().map_or(now, |flight| match is_like_echo {
                // An echo is no reply, however long that takes.
                true => flight.deadline,
                // The unit may take as long as usual.
                false => flight.sent + self.late_replies.longest(flight.unit_id) * 2,
            });
            // What came behind it is kept: another reply may have begun.
            (self.doubted, self.is_maybe_echo) = (Some((unit_id, pdu, now)), is_like_echo);
            self.state = State::Doubting { until: until.max(now + GUARD) };
            if is_like_echo {
                self.after_doubted(flights, &[], now, sink);
            }
            return;
        }
        self.replied(flights, (unit_id, &pdu, now), now, sink);
    }

    /// Whether the line can't have carried the request and its reply by now.
    fn is_too_fast(&mut self, flights: &Flights, pdu_len: usize, now: Time) -> bool {
        let Some(flight) = flights.first() else { return false };
        let took = now.saturating_sub(flight.sent);
        took < self.character * self.reply_len(pdu_len) as u32 && !self.late_replies.is_fast_line()
    }

    /// The time that the line needs for the request and its reply.
    fn needed(&self, pdu_len: usize) -> Duration {
        self.character * (self.frame.len() + self.reply_len(pdu_len)) as u32
    }

    /// The length of the frame of a reply.
    fn reply_len(&self, pdu_len: usize) -> usize {
        match self.framing {
            Framing::Rtu => pdu_len + 3,
            Framing::Ascii => 2 * pdu_len + 7,
        }
    }

    /// Whether this reply may be an echo: it equals the request, and the last reads had one, but too few to
    /// rely on it.
    fn is_like_echo(&self, flights: &Flights, pdu: &[u8]) -> bool {
        let State::Sent { echoed: false } = self.state else { return false };
        let equals = flights.first().is_some_and(|flight| flight.request.pdu() == pdu);
        equals && self.echo.is_likely(self.late_replies.echoes)
    }

    /// Handles bytes after a reply that is doubted.
    fn after_doubted(
        &mut self,
        flights: &mut Flights,
        bytes: &[u8],
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        let room = self.max_received() - self.received.len();
        self.received.extend_from_slice(&bytes[..bytes.len().min(room)]);
        // There may be noise between an echo and the reply.
        let noise = (0..=MAX_NOISE_BYTES).find(|noise| {
            let behind = self.received.get(*noise..).filter(|behind| !behind.is_empty());
            self.is_maybe_echo && behind.is_some_and(|behind| self.frame.starts_with(behind))
        });
        if noise.is_some_and(|noise| self.received.len() - noise == self.frame.len()) {
            self.late_replies.echoes = self.late_replies.echoes.saturating_add(1);
            return self.believe_doubted(flights, now, sink);
        }
        if noise.is_some() {
            return;
        }
        if !flights.tolerance.pad {
            flights.strays.bytes += bytes.len() as u64;
        }
        if self.received.len() > MAX_NOISE_BYTES && self.may_be_other_reply(flights) {
            self.contradicted(flights, now, sink);
        }
    }

    /// Whether the bytes after a reply that is doubted may be another one, whole, damaged or in part. A serial line has
    /// noise, which a stream has not, and some devices pad replies: both are shorter, or begin like none.
    fn may_be_other_reply(&self, flights: &Flights) -> bool {
        let (bytes, pads) = (&self.received, flights.tolerance.pad);
        let len = self.doubted.as_ref().map_or(0, |(_, pdu, _)| self.reply_len(pdu.len()));
        let is_as_long = !pads && (self.silence.is_none() || bytes.len() >= len);
        let begins = |flight: &Flight| match self.framing {
            Framing::Rtu => bytes.windows(2).any(|pair| fits(flights, flight, pair)),
            Framing::Ascii => bytes.contains(&b':'),
        };
        is_as_long || is_frame(self.framing, bytes) || flights.first().is_some_and(begins)
    }

    /// Nothing followed what may have been an echo, so it is no reply. If it was one, the next is believed.
    fn was_echo(&mut self) {
        self.late_replies.echoes = self.late_replies.echoes.saturating_sub(1);
        self.doubted = None;
        self.state = State::Sent { echoed: true };
    }

    fn believe_doubted(
        &mut self,
        flights: &mut Flights,
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        let (unit_id, pdu, came) = self.doubted.take().expect("a reply is doubted");
        self.replied(flights, (unit_id, &pdu, came), now, sink);
    }

    /// Believes a reply that is doubted: the stream has ended, so no other follows.
    pub(super) fn stream_ended(&mut self, flights: &mut Flights, sink: &mut impl FnMut(Done<'_>)) {
        match self.state {
            State::Doubting { .. } if self.is_maybe_echo => self.was_echo(),
            State::Doubting { until } => self.believe_doubted(flights, until, sink),
            _ => {}
        }
    }

    /// Two replies came to one request: nothing shows which one is its own.
    fn contradicted(&mut self, flights: &mut Flights, now: Time, sink: &mut impl FnMut(Done<'_>)) {
        self.late_replies.stray(Duration::ZERO);
        self.doubted = None;
        self.state = State::Sent { echoed: true };
        self.invalid(flights, InvalidResponse::Unrequested, now, sink);
    }

    fn replied(
        &mut self,
        flights: &mut Flights,
        (found, pdu, came): (u8, &[u8], Time),
        now: Time,
        sink: &mut impl FnMut(Done<'_>),
    ) {
        let expected = flights.first().map_or(found, |flight| flight.unit_id);
        if !flights.tolerance.accept_unit.accepts(expected, found) {
            let invalid = InvalidResponse::UnitId { expected, found };
            return self.invalid(flights, invalid, now, sink);
        }
        let doubted = matches!(self.state, State::Doubting { .. });
        self.late_replies.not_too_fast(self.needed(pdu.len()));
        if let Some(flight) = flights.first() {
            let request = (flight.unit_id, flight.request.pdu());
            self.late_replies.believed(request, pdu, doubted, now);
            let took = came.saturating_sub(flight.sent);
            self.late_replies.answered(flight.unit_id, took, self.timeout);
            let (request, times) = ((flight.unit_id, &flight.request), (flight.sent, self.timeout));
            if self.repeats {
                self.late_replies.repeated(request, flight.sent, now);
            }
            if pdu.first().is_some_and(|code| code & 0x80 != 0)
                && pdu.get(1) == Some(&GATEWAY_NO_REPLY)
            {
                self.late_replies.ended(request, times, Ended::Other, now);
            }
            self.learn_echo(is_no_reply(flight));
        }
        let unanswered =
            flights.first().map(|flight| (flight.unit_id, flight.request.clone(), flight.sent));
        self.rest(now);
        let Some(invalid) = flights.answer(0, pdu, now, sink) else { return };
        if let Some((unit_id, request, sent)) = unanswered {
            let times = (sent, self.timeout);
            self.late_replies.ended((unit_id, &request), times, Ended::Other, now);
        }
        if self.silence.is_none() {
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
        let how = match invalid {
            InvalidResponse::UnitId { .. } => Ended::Other,
            _ => Ended::Damaged,
        };
        self.note_ended(flights, how, now);
        // The line may still carry the request.
        self.rest(flights.first().map_or(now, |flight| now.max(flight.sent)));
        flights.finish(Err(Failure::Invalid(invalid)), sink);
        if self.silence.is_none() {
            flights.close(Closed::Invalid(invalid), sink);
        }
    }

    /// Takes what the next connection has to know of earlier requests.
    pub(super) fn take_late_replies(&mut self, flights: &Flights, now: Time) -> LateReplies {
        if let (State::Sent { .. }, Some(cut_off)) = (self.state, &flights.cut_off) {
            let (unit_id, request, sent, timeout) = cut_off;
            self.late_replies.ended(
                (*unit_id, request),
                (*sent, *timeout),
                Ended::WithConnection,
                now,
            );
        }
        core::mem::take(&mut self.late_replies)
    }

    /// Notes that the request ends without its reply, if it was sent.
    fn note_ended(&mut self, flights: &Flights, how: Ended, now: Time) {
        if let (State::Sent { echoed }, Some(flight)) = (self.state, flights.first()) {
            let times = (flight.sent, self.timeout);
            self.late_replies.ended((flight.unit_id, &flight.request), times, how, now);
            if let (Ended::TimedOut, Some(needed)) = (how, self.too_fast) {
                self.late_replies.only_too_fast(needed);
            }
            // A reply came without the echo that was expected.
            let is_mute = self.received.is_empty();
            if how == Ended::TimedOut && !echoed && !is_mute && !is_no_reply(flight) {
                self.late_replies.echoes = 0;
            }
        }
    }

    /// An echo before the reply to a read shows that the adapter echoes, and no echo that it does not.
    fn learn_echo(&mut self, is_unmistakable: bool) {
        if let (State::Sent { echoed }, true) = (self.state, is_unmistakable) {
            self.late_replies.echoes =
                if echoed { self.late_replies.echoes.saturating_add(1) } else { 0 };
        }
    }

    /// Whether no reply comes before the echo of this request.
    fn awaits_echo(&self, flight: &Flight) -> bool {
        self.echo.is_awaited(self.late_replies.echoes, is_no_reply(flight))
    }

    /// Whether the request itself, sent back, is its echo.
    fn may_be_echo(&self, flight: &Flight) -> bool {
        let is_detected = self.echo == Echo::Auto && is_no_reply(flight);
        is_detected || self.awaits_echo(flight)
    }

    /// Takes the echo of the request out of the received bytes, with those before it. Returns whether it came.
    fn take_echo(&mut self) -> bool {
        let start = self.received.windows(self.frame.len()).position(|bytes| bytes == self.frame);
        self.received.drain(..start.map_or(0, |start| start + self.frame.len()));
        start.is_some()
    }

    fn rest(&mut self, now: Time) {
        self.state = State::Idle;
        self.received.clear();
        self.late_replies.last_activity = now;
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
        if let State::Doubting { until } = self.state {
            if until > now {
                return;
            }
            let waits_until = self.awaits_reply_until(flights);
            let is_old = waits_until.is_some_and(|until| until + MAX_READ_DELAY <= now);
            if self.is_maybe_echo {
                self.was_echo();
            } else if is_old {
                self.doubted = None;
                self.state = State::Sent { echoed: true };
            } else {
                return self.believe_doubted(flights, now, sink);
            }
        }
        // First of all: where a thread wakes up late, its request is sent late, and not given up unsent.
        self.transmit(flights, now);
        let was_sent = matches!(self.state, State::Sent { .. });
        let due = flights.first().filter(|flight| was_sent && flight.deadline <= now);
        let begun = due.and_then(|flight| {
            let Tolerance { pad, accept_unit, .. } = flights.tolerance;
            let is_unit = |found| accept_unit.accepts(flight.unit_id, found);
            self.begun(pad, &flight.request, is_unit)
        });
        if let Some((_, missing)) = begun
            && !self.is_prolonged
            && !self.character.is_zero()
        {
            // The line carries nothing else before. An adapter may deliver the last bytes later.
            self.is_prolonged = true;
            flights.prolong(self.character * missing as u32 + GUARD);
        }
        if let Some(flight) = flights.first().filter(|flight| flight.deadline <= now) {
            let how = if flight.may_be_unread(now) { Ended::Unread } else { Ended::TimedOut };
            // Where this is called late, its reply may have come before, and is read only now.
            self.note_ended(flights, how, flight.deadline);
        }
        if let Some(flight) = flights.expired(now) {
            let sent = !matches!(self.state, State::Quieting { .. });
            (self.state, self.late_replies.last_activity) = (State::Idle, now);
            self.keep_begun(flights);
            let too_fast = self.too_fast.map(|_| InvalidResponse::TooFast);
            let invalid = too_fast.or(self.stray.map(InvalidResponse::Frame));
            let failure = match invalid {
                Some(invalid) => Failure::Invalid(invalid),
                // One byte can be noise.
                None if begun.is_some_and(|(received, _)| received > 1) => Failure::Incomplete,
                // An earlier attempt was sent, and got no reply.
                None if sent || self.repeats => Failure::Timeout,
                None => Failure::NoSilence,
            };
            flights.end(flight, Err(failure), sink);
            if sent && self.silence.is_none() {
                flights.close(Closed::TimedOut, sink);
            }
        }
    }

    /// The reply in what was received; `None` while more bytes are needed. Stray bytes before it are
    /// skipped: the reply begins at the first byte that fits the request and the CRC.
    fn rtu(&mut self, flights: &Flights, echoed: &mut bool) -> Result<Option<Reply>, FrameError> {
        let Some(flight) = flights.first() else { return Ok(None) };
        let may_be_echo = !*echoed && self.may_be_echo(flight);
        if may_be_echo && self.take_echo() {
            *echoed = true;
        }
        if self.awaits_echo(flight) && !*echoed {
            return Ok(None);
        }
        let pad = flights.tolerance.pad;
        let mut failure = None;
        self.stray = None;
        for start in 0..self.received.len() {
            let bytes = &self.received[start..];
            let fits = fits(flights, flight, bytes);
            if start > 0 && !fits {
                continue;
            }
            match response_len(bytes, &flight.request) {
                Ok(Some(len)) if len <= bytes.len() => match rtu::decode(&bytes[..len]) {
                    Ok(reply) => {
                        let behind = bytes.len() - len;
                        self.behind = behind_reply(Framing::Rtu, &bytes[..len], &bytes[len..]);
                        let stray = if pad { start } else { start + behind };
                        let reply = Reply::new(reply, stray);
                        self.received.drain(..start + len);
                        return Ok(Some(reply));
                    }
                    Err(error) if fits => failure = failure.or(Some(error)),
                    Err(error) => self.stray = Some(error),
                },
                Ok(len) if fits && self.may_come(pad, &flight.request, bytes, len) => {
                    // If the rest does not come, what was found before it is why there is no reply.
                    self.stray = failure.or(self.stray.filter(|_| bytes.len() == 1));
                    return Ok(None);
                }
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

    /// Whether a reply of this length that has begun like `bytes` may come: to this request, or a late one. One of any
    /// other length is no beginning of a reply, but noise, or values of a damaged one.
    fn may_come(
        &self,
        pads: bool,
        request: &EncodedRequest,
        bytes: &[u8],
        len: Option<usize>,
    ) -> bool {
        let (Some(len), Some(code)) = (len, bytes.get(1)) else { return true };
        let late = self.late_replies.unanswered().map(|earlier| &earlier.request);
        let mut asked = core::iter::once(request).chain(late);
        pads || code & 0x80 != 0
            || asked.any(|request| {
                let is_of_function = request.pdu().first() == Some(code);
                is_of_function && read_reply_len(request).is_none_or(|expected| len == expected)
            })
    }

    /// Parses the reply in the received characters; `None` while more are needed.
    fn ascii(
        &mut self,
        flights: &mut Flights,
        echoed: &mut bool,
    ) -> Result<Option<Reply>, FrameError> {
        while let Some(end) = self.received.windows(2).position(|pair| pair == b"\r\n") {
            let line: Vec<u8> = self.received.drain(..end + 2).collect();
            let Some(start) = line.iter().rposition(|byte| *byte == b':') else {
                flights.strays.bytes += line.len() as u64;
                continue;
            };
            let behind = if flights.tolerance.pad { 0 } else { self.received.len() };
            let line = &line[start..];
            let Some(flight) = flights.first() else { return Ok(None) };
            if !*echoed && self.may_be_echo(flight) && line == self.frame {
                *echoed = true;
                continue;
            }
            if self.awaits_echo(flight) && !*echoed {
                flights.strays.bytes += (start + line.len()) as u64;
                continue;
            }
            self.behind = behind_reply(Framing::Ascii, line, &self.received);
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

/// The length of the RTU frame that answers a read: unit id, function, byte count, the values and CRC; `None` for
/// any other request.
fn read_reply_len(request: &EncodedRequest) -> Option<usize> {
    read_bytes(request).map(|count| count + 5)
}

/// Whether an RTU reply to this request may begin with these bytes.
fn fits(flights: &Flights, flight: &Flight, bytes: &[u8]) -> bool {
    flights.tolerance.accept_unit.accepts(flight.unit_id, bytes[0])
        && bytes.get(1).is_none_or(|code| code & 0x7F == flight.request.pdu()[0])
}

/// Whether the request itself, sent back, can't be taken for its reply.
fn is_no_reply(flight: &Flight) -> bool {
    let request = &flight.request;
    request.response(request.pdu()).is_err()
}

/// The first line in these characters, from its colon to its end.
fn ascii_line(bytes: &[u8]) -> Option<&[u8]> {
    let end = bytes.windows(2).position(|pair| pair == b"\r\n")?;
    bytes.starts_with(b":").then(|| &bytes[..end + 2])
}

/// What came right behind a reply.
fn behind_reply(framing: Framing, reply: &[u8], behind: &[u8]) -> Behind {
    match is_frame(framing, behind) {
        false => Behind::NoFrame,
        true if reply == behind => Behind::Same,
        true => Behind::Another,
    }
}

/// Whether these bytes are one frame.
fn is_frame(framing: Framing, bytes: &[u8]) -> bool {
    match framing {
        Framing::Rtu => rtu::decode(bytes).is_ok(),
        Framing::Ascii => {
            let mut body = [0; pdu::MAX_LEN + 2];
            ascii_line(bytes).is_some_and(|line| ascii::decode(line, &mut body).is_ok())
        }
    }
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

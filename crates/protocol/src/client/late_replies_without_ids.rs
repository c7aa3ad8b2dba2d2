//! Late replies: what earlier requests may still bring on lines and streams without transaction ids, and how
//! long a request waits for it.
//!
//! A request that ended without its reply stays here until that reply has come, or until late replies are
//! known to have ended. Meanwhile, nothing is sent whose reply could be taken for it.

use alloc::collections::{BTreeSet, VecDeque};
use core::time::Duration;

use super::Time;
use super::raised_timeouts::Lateness;
use super::tolerance::{AcceptUnit, Tolerance};
use crate::pdu::{EncodedRequest, Request};

/// Requests without a reply that are remembered. With the bounds on their time, there are never as many, except
/// for broadcasts.
const MAX_UNANSWERED_REQUESTS: usize = 64;

/// A late reply may take this many times the timeout, as long as nothing else is known.
const LATENESS_FACTOR: u32 = 3;

/// How long after its timeout a late reply may come at most, where there are no transaction ids.
pub const MAX_LATENESS: Duration = Duration::from_secs(10);

/// By the timeouts of other requests, a late reply may take no longer than this.
const MAX_LATENESS_BY_OTHERS: Duration = Duration::from_secs(1);

/// A late reply may take so long however short the timeouts are: a request may have had only what was left of
/// its time.
const MIN_LATENESS: Duration = Duration::from_millis(250);

/// The time after a reply in which the same one may come again, on lines and streams without transaction
/// ids. It passes before the next request until enough replies have come once.
pub const GUARD: Duration = Duration::from_millis(25);

/// Replies that a new line or stream has to give, none of them twice, before it needs no guard time.
const PROBATION_REPLIES: u32 = 8;

/// The same after a reply that nobody asked for.
const PROBATION_REPLIES_AFTER_STRAY: u32 = 1000;

/// The longest guard time.
const MAX_GUARD: Duration = GUARD.saturating_mul(10);

/// Replies that were doubted because they equal one to another request, and turned out right: no more are
/// doubted until one comes that nobody asked for.
const MAX_WRONG_DOUBTS: u32 = 8;

/// Replies that are compared with the next one.
const MAX_RECENT_REPLIES: usize = 16;

/// A reply that came longer ago is not repeated now.
const RECENT_REPLY_TIME: Duration = MAX_GUARD;

/// After a reply to another request: how long a request still waits for its own, if the unit is usually faster.
const WAIT_AFTER_OTHER_REPLY: Duration = Duration::from_millis(500);

/// After a damaged reply: how long a request still waits for its own, while nothing is known of the unit.
const WAIT_AFTER_DAMAGED_REPLY: Duration = Duration::from_millis(250);

/// What earlier requests may still bring.
#[derive(Debug, Default)]
pub(super) struct LateReplies {
    /// The oldest first.
    unanswered: VecDeque<Unanswered>,
    /// Units and functions of which a reply never came: a device may send it with the next one.
    never_came: BTreeSet<(u8, u8)>,
    lateness: Lateness,
    guard: Guard,
    /// When something was last received, or a request sent or ended.
    pub(super) last_activity: Time,
    /// The line is faster than its settings say: replies showed it that were the first ones, or the only ones.
    is_fast: bool,
    late_reply_came: bool,
    /// The time on the line of a request whose only reply came faster than the line allows, and of that reply. No
    /// exchange that takes as long has had a slower reply since.
    only_too_fast: Option<Duration>,
    /// Reads in a row whose echo came before their reply. Here because a new connection keeps it.
    pub(super) echoes: u8,
    /// The newest first.
    recent: VecDeque<Recent>,
}

/// A reply, as checksums.
#[derive(Debug, Clone, Copy)]
struct Recent {
    request: u32,
    reply: u32,
    at: Time,
}

/// A request that ended without its reply.
#[derive(Debug)]
pub(super) struct Unanswered {
    pub(super) unit_id: u8,
    pub(super) request: EncodedRequest,
    /// Units confirm broadcasts only by mistake, each with its own id.
    pub(super) is_broadcast: bool,
    sent: Time,
    /// The reply may come until then.
    until: Time,
    /// What comes before is a copy of the reply to another attempt of the same call.
    from: Time,
    /// Its reply may have waited to be read: the time until then says nothing of the unit.
    is_unread: bool,
}

/// Why a request ended without its reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Ended {
    TimedOut,
    /// Long after its timeout: its reply may have come in time, and waits to be read.
    Unread,
    WithConnection,
    /// By a reply that is not its own, or by an exception that a gateway sent in its place.
    Other,
    /// By bytes that may have been its reply.
    Damaged,
    /// It has no reply.
    Broadcast,
}

/// Whether replies may come twice.
#[derive(Debug, Default)]
struct Guard {
    /// A reply has come.
    has_begun: bool,
    /// Replies since the last one that nobody asked for.
    clean: u32,
    /// What was learned from those that nobody asked for; `None` before the first.
    learned: Option<Duration>,
    doubts: u32,
}

impl LateReplies {
    /// The timeout of a request to this unit: more than `timeout` if late replies repeat.
    pub(super) fn timeout(&self, unit_id: u8, timeout: Duration) -> Duration {
        self.lateness.timeout(unit_id, timeout)
    }

    /// Until when a reply may come that could be taken for the one to this request.
    pub(super) fn until(
        &mut self,
        unit_id: u8,
        request: &EncodedRequest,
        tolerance: &Tolerance,
        now: Time,
    ) -> Option<Time> {
        self.expire(now);
        let accepted = tolerance.accept_unit;
        let alike = self.unanswered.iter().filter(|earlier| {
            if earlier.is_broadcast {
                return confirmation(&earlier.request) == confirmation(request);
            }
            let same_unit = accepted != AcceptUnit::Requested || earlier.unit_id == unit_id;
            same_unit && may_confuse(&earlier.request, request, tolerance.pad)
        });
        alike.map(|earlier| earlier.until).max()
    }

    /// Forgets requests whose replies can't come any more, as far as is known.
    pub(super) fn expire(&mut self, now: Time) {
        let never_came = &mut self.never_came;
        self.unanswered.retain(|earlier| {
            let may_come = earlier.until > now;
            if !may_come && let Some(function) = earlier.request.pdu().first() {
                never_came.insert((earlier.unit_id, *function));
            }
            may_come
        });
    }

    /// The time after a reply in which the same one may come again.
    pub(super) fn guard(&self) -> Duration {
        let Guard { has_begun, clean, learned, .. } = self.guard;
        let (guard, enough) = match learned {
            // Nothing can be repeated.
            None if !has_begun => (Duration::ZERO, PROBATION_REPLIES),
            None => (GUARD, PROBATION_REPLIES),
            Some(learned) => (learned, PROBATION_REPLIES_AFTER_STRAY),
        };
        if clean < enough { guard } else { Duration::ZERO }
    }

    /// Whether the line may be faster than its settings say. Asked for a reply that came too fast: one of
    /// the first, while the guard time excludes another reason, shows it.
    pub(super) fn is_fast_line(&mut self) -> bool {
        let Guard { clean, learned, .. } = self.guard;
        self.is_fast |= learned.is_none() && clean < PROBATION_REPLIES;
        self.is_fast
    }

    /// Whether a reply that came too fast shows that the line is faster than its settings say: it is no copy
    /// of a recent one, and the line has never brought a late reply, of which it may be a copy, or one that
    /// nobody asked for, such as one to another master.
    pub(super) fn shows_fast_line(&mut self, reply: &[u8]) -> bool {
        let reply = crc32fast::hash(reply);
        let is_copy = self.recent.iter().any(|recent| recent.reply == reply);
        self.is_fast |= self.guard.learned.is_none() && !self.late_reply_came && !is_copy;
        self.is_fast
    }

    /// Notes that a request timed out whose only reply came too fast: the line needs this time for both. A copy
    /// of an earlier reply would have been followed by its own: if none is, twice, the line is faster than its
    /// settings say, as one over USB or a network is.
    pub(super) fn only_too_fast(&mut self, needs: Duration) {
        self.is_fast |= self.only_too_fast.is_some();
        self.only_too_fast = Some(needs);
    }

    /// Notes a reply that did not come too fast, which needs this time with its request. It shows nothing for those
    /// that need more: the unit itself may take so long.
    pub(super) fn not_too_fast(&mut self, needs: Duration) {
        self.only_too_fast = self.only_too_fast.filter(|more| needs < *more);
    }

    /// Notes a reply that nobody asked for, this time after the last one.
    pub(super) fn stray(&mut self, after: Duration) {
        let learned = self.guard.learned.unwrap_or(GUARD);
        // Much later, it says nothing of the time between a reply and its repetition.
        let after = if after > MAX_GUARD { Duration::ZERO } else { after * 2 };
        self.guard = Guard {
            has_begun: true,
            clean: 0,
            learned: Some(after.clamp(learned, MAX_GUARD)),
            doubts: 0,
        };
    }

    /// Until when the reply may come to a request that ended without it, maybe before it counts as sent: a line can
    /// be faster than its settings say.
    fn until_after(
        &mut self,
        unit_id: u8,
        (sent, timeout): (Time, Duration),
        how: Ended,
        now: Time,
    ) -> Time {
        let longest = self.lateness.longest(unit_id);
        let usual = longest.map(|longest| (longest * 4).max(GUARD));
        let longest_timeout = self.lateness.note_timeout(unit_id, timeout);
        match how {
            Ended::TimedOut | Ended::Unread => {
                let latest = self.lateness.latest(unit_id) * 2;
                let by_others = (longest_timeout * LATENESS_FACTOR).min(MAX_LATENESS_BY_OTHERS);
                let known = usual.unwrap_or(GUARD).max(latest).max(by_others).max(MIN_LATENESS);
                sent + (timeout * LATENESS_FACTOR).max(known).min(timeout + MAX_LATENESS)
            }
            Ended::Other | Ended::WithConnection => {
                let left = (sent + longest_timeout).saturating_sub(now).min(WAIT_AFTER_OTHER_REPLY);
                // It may have been given up as late as by a timeout.
                let is_silent = how == Ended::WithConnection;
                let took = if is_silent { now.saturating_sub(sent) } else { Duration::ZERO };
                now.max(sent)
                    + usual
                        .unwrap_or(GUARD)
                        .max(left)
                        .max(took * (LATENESS_FACTOR - 1))
                        .min(MAX_LATENESS)
            }
            Ended::Broadcast => sent + timeout,
            Ended::Damaged => {
                let most = usual.unwrap_or(WAIT_AFTER_DAMAGED_REPLY);
                (sent + timeout).min(now.max(sent) + most)
            }
        }
    }

    /// Notes that a request was answered that repeats an earlier one of the same call, sent at this time:
    /// the reply may be that to the earlier one, and its own may still come.
    pub(super) fn repeated(
        &mut self,
        (unit_id, request): (u8, &EncodedRequest),
        sent: Time,
        now: Time,
    ) {
        let same = |earlier: &&mut Unanswered| {
            earlier.unit_id == unit_id && earlier.request.pdu() == request.pdu()
        };
        for earlier in self.unanswered.iter_mut().filter(same) {
            // As long after this request as it would have been waited for after the earlier one.
            earlier.until += sent.saturating_sub(earlier.sent);
            earlier.from = now + GUARD;
        }
    }

    /// Notes a request that was sent at this time and ended without its reply.
    pub(super) fn ended(
        &mut self,
        (unit_id, request): (u8, &EncodedRequest),
        (sent, timeout): (Time, Duration),
        how: Ended,
        now: Time,
    ) {
        let until = self.until_after(unit_id, (sent, timeout), how, now);
        if until <= now {
            self.never_came.extend(request.pdu().first().map(|function| (unit_id, *function)));
            return;
        }
        let is_broadcast = how == Ended::Broadcast;
        if is_broadcast {
            let same = confirmation(request);
            self.unanswered.retain(|old| {
                !old.is_broadcast || old.until > until || confirmation(&old.request) != same
            });
        }
        if self.unanswered.len() == MAX_UNANSWERED_REQUESTS {
            let oldest = self.unanswered.iter().position(|old| old.is_broadcast);
            self.unanswered.remove(oldest.unwrap_or_default());
        }
        let request = request.clone();
        self.unanswered.push_back(Unanswered {
            unit_id,
            request,
            is_broadcast,
            sent,
            until,
            from: Time::ZERO,
            is_unread: how == Ended::Unread,
        });
    }

    /// The longest time of a reply of this unit that was not late.
    pub(super) fn longest(&self, unit_id: u8) -> Duration {
        self.lateness.longest(unit_id).unwrap_or_default()
    }

    /// Requests whose replies may still come.
    pub(super) fn unanswered(&self) -> impl Iterator<Item = &Unanswered> {
        self.unanswered.iter()
    }

    /// Notes the late reply to the request at this place. Returns how long it took; 0 if it may have waited to
    /// be read, or if others may follow: copies of it, or the confirmations of a broadcast by other units.
    pub(super) fn late(&mut self, place: usize, now: Time) -> Duration {
        self.late_reply_came = true;
        let may_repeat = |earlier: &Unanswered| {
            now < if earlier.is_broadcast { earlier.until } else { earlier.from }
        };
        if self.unanswered.get(place).is_some_and(may_repeat) {
            return Duration::ZERO;
        }
        let Some(earlier) = self.unanswered.remove(place) else { return Duration::ZERO };
        self.guard.has_begun = true;
        if earlier.is_unread {
            return Duration::ZERO;
        }
        // On a line that is faster than its settings say, it may have ended before it counted as sent.
        let most = earlier.until.saturating_sub(earlier.sent);
        let took = now.saturating_sub(earlier.sent).min(most);
        self.lateness.late(earlier.unit_id, took);
        took
    }

    /// Whether this reply is believed only if no other follows: one to an earlier request never came, or it
    /// equals a recent one to another request.
    pub(super) fn is_doubtful(&self, request: (u8, &[u8]), reply: &[u8], now: Time) -> bool {
        let (unit_id, pdu) = request;
        if pdu.first().is_some_and(|function| self.never_came.contains(&(unit_id, *function))) {
            return true;
        }
        if self.guard.doubts >= MAX_WRONG_DOUBTS {
            return false;
        }
        let (request, reply) = (checksum(request), crc32fast::hash(reply));
        let last = self.recent.iter().find(|recent| recent.request == request);
        let is_usual = last.is_some_and(|last| last.reply == reply);
        let since = now.saturating_sub(RECENT_REPLY_TIME);
        !is_usual && self.recent.iter().any(|other| other.reply == reply && other.at >= since)
    }

    /// Notes a reply that is believed, and whether it was doubted.
    pub(super) fn believed(
        &mut self,
        request: (u8, &[u8]),
        reply: &[u8],
        doubted: bool,
        now: Time,
    ) {
        self.guard.doubts += u32::from(doubted);
        if let (unit_id, [function, ..]) = request {
            self.never_came.remove(&(unit_id, *function));
        }
        let (request, reply) = (checksum(request), crc32fast::hash(reply));
        self.recent.retain(|recent| recent.request != request);
        self.recent.truncate(MAX_RECENT_REPLIES - 1);
        self.recent.push_front(Recent { request, reply, at: now });
    }

    /// Notes a reply that was asked for, and took this time.
    pub(super) fn answered(&mut self, unit_id: u8, took: Duration, timeout: Duration) {
        self.guard.has_begun = true;
        self.guard.clean = self.guard.clean.saturating_add(1);
        self.lateness.answered(unit_id, took, timeout);
    }
}

/// Whether a reply to the earlier request could be taken for one to the other: not if both read a different
/// number of bytes, which their replies contain. Bytes may be added to a reply that is padded.
fn may_confuse(earlier: &EncodedRequest, other: &EncodedRequest, pads: bool) -> bool {
    let same_function = earlier.pdu().first() == other.pdu().first();
    same_function && (pads || read_bytes(earlier) == read_bytes(other))
}

/// The PDU that confirms a write: it repeats the request, but not its values if it may have several
/// (V1.1b3, 6.11 and 6.12).
pub(super) fn confirmation(request: &EncodedRequest) -> &[u8] {
    match request.pdu() {
        [15 | 16, range @ ..] if range.len() > 4 => &request.pdu()[..5],
        pdu => pdu,
    }
}

/// The number of bytes that a read asks for; `None` for any other request.
pub(super) fn read_bytes(request: &EncodedRequest) -> Option<usize> {
    match request.request()? {
        Request::ReadCoils(range) | Request::ReadDiscreteInputs(range) => Some(range.byte_len()),
        Request::ReadHoldingRegisters(range) | Request::ReadInputRegisters(range) => {
            Some(range.byte_len())
        }
        _ => None,
    }
}

fn checksum((unit_id, pdu): (u8, &[u8])) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&[unit_id]);
    hasher.update(pdu);
    hasher.finalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pdu::Range;

    const MS: Duration = Duration::from_millis(1);
    const START: Time = Duration::from_secs(100);

    fn registers(quantity: u16) -> EncodedRequest {
        EncodedRequest::new(&Request::ReadHoldingRegisters(Range::new(0, quantity).unwrap()))
    }

    fn coils(quantity: u16) -> EncodedRequest {
        EncodedRequest::new(&Request::ReadCoils(Range::new(0, quantity).unwrap()))
    }

    fn ms(times: u32) -> Duration {
        MS * times
    }

    /// Until when the reply may come to a request of unit 1 that ended like this, since it was sent.
    fn until(replies: &mut LateReplies, timeout: u32, how: Ended, took: u32) -> Duration {
        replies.ended((1, &registers(1)), (START, ms(timeout)), how, START + ms(took));
        replies.unanswered().last().unwrap().until - START
    }

    fn answered(took: u32, timeout: u32) -> LateReplies {
        let mut replies = LateReplies::default();
        replies.answered(1, ms(took), ms(timeout));
        replies
    }

    #[test]
    fn after_a_timeout_a_reply_may_come_as_late_as_this_and_other_timeouts_and_replies_say() {
        let timed_out = |mut replies: LateReplies, timeout| {
            until(&mut replies, timeout, Ended::TimedOut, timeout)
        };
        assert_eq!(timed_out(LateReplies::default(), 50), ms(250), "however short");
        assert_eq!(timed_out(LateReplies::default(), 200), ms(600));
        assert_eq!(timed_out(LateReplies::default(), 6_000), ms(16_000), "10 s later at most");
        assert_eq!(timed_out(answered(1, 300), 10), ms(900), "by an earlier timeout");
        assert_eq!(timed_out(answered(1, 500), 10), ms(1_000), "by it, at most");
        assert_eq!(timed_out(answered(400, 500), 10), ms(1_600), "by the usual time");
        let mut late = LateReplies::default();
        late.lateness.late(1, ms(2_000));
        assert_eq!(timed_out(late, 10), ms(4_000), "by the latest reply");
    }

    #[test]
    fn after_another_reply_or_the_end_of_the_connection_it_may_come_within_its_time() {
        let other = |mut replies: LateReplies, timeout, took| {
            until(&mut replies, timeout, Ended::Other, took) - ms(took)
        };
        assert_eq!(other(LateReplies::default(), 300, 100), ms(200), "the rest of its timeout");
        assert_eq!(other(LateReplies::default(), 2_000, 100), ms(500), "or of half a second");
        assert_eq!(other(LateReplies::default(), 300, 290), GUARD);
        assert_eq!(other(answered(100, 300), 10, 10), ms(400), "by the usual time");
        let cut_off = |timeout, took| {
            let mut replies = LateReplies::default();
            until(&mut replies, timeout, Ended::WithConnection, took) - ms(took)
        };
        assert_eq!(cut_off(300, 1_000), ms(2_000), "twice as long again");
        assert_eq!(cut_off(300, 6_000), ms(10_000), "10 s at most");
    }

    #[test]
    fn after_a_damaged_reply_it_may_come_for_a_while_but_not_after_its_timeout() {
        let damaged =
            |mut replies: LateReplies, timeout| until(&mut replies, timeout, Ended::Damaged, 100);
        assert_eq!(damaged(LateReplies::default(), 1_000), ms(350));
        assert_eq!(damaged(LateReplies::default(), 300), ms(300));
        assert_eq!(damaged(answered(20, 300), 1_000), ms(180), "by the usual time");
    }

    #[test]
    fn the_guard_time_is_twice_that_after_which_a_reply_was_repeated() {
        for (after, guard) in [(0, 25), (10, 25), (100, 200), (125, 250), (250, 250), (251, 25)] {
            let mut replies = answered(1, 300);
            replies.stray(ms(after));
            assert_eq!(replies.guard(), ms(guard), "{after}");
            replies.stray(ms(10));
            assert_eq!(replies.guard(), ms(guard), "it is never shorter than before");
            (1..1000).for_each(|_| replies.answered(1, MS, ms(300)));
            assert_eq!(replies.guard(), ms(guard));
            replies.answered(1, MS, ms(300));
            assert_eq!(replies.guard(), Duration::ZERO, "after 1,000 replies");
        }
    }

    #[test]
    fn only_the_first_replies_have_a_guard_time_or_show_a_fast_line() {
        let mut replies = LateReplies::default();
        assert_eq!(replies.guard(), Duration::ZERO, "nothing can come twice");
        for _ in 1..8 {
            replies.answered(1, MS, ms(300));
            assert_eq!(replies.guard(), GUARD);
        }
        let mut fast = LateReplies::default();
        (1..8).for_each(|_| fast.answered(1, MS, ms(300)));
        assert!(fast.is_fast_line());
        replies.answered(1, MS, ms(300));
        assert_eq!(replies.guard(), Duration::ZERO);
        assert!(!replies.is_fast_line());
    }

    #[test]
    fn the_reply_to_an_earlier_attempt_is_expected_as_much_later_as_the_next_one_was_sent() {
        let mut replies = LateReplies::default();
        let (read, other) = (registers(1), registers(2));
        for (unit_id, request) in [(1, &read), (2, &read), (1, &other)] {
            let now = START + ms(200);
            replies.ended((unit_id, request), (START, ms(200)), Ended::TimedOut, now);
        }
        replies.repeated((1, &read), START + ms(210), START + ms(220));
        let times = replies.unanswered().map(|earlier| (earlier.until - START, earlier.from));
        let unchanged = (ms(600), Time::ZERO);
        let changed = (ms(810), START + ms(245));
        assert!(times.eq([changed, unchanged, unchanged]));
        assert_eq!(replies.late(0, START + ms(244)), Duration::ZERO, "a copy of the other reply");
        assert_eq!(replies.late(0, START + ms(245)), ms(245));
        assert_eq!(replies.late(0, START + ms(9_000)), ms(600), "at most as late as expected");
        assert_eq!(replies.unanswered().count(), 1);
    }

    #[test]
    fn a_reply_is_doubtful_that_equals_the_last_one_to_another_recent_request() {
        let mut replies = LateReplies::default();
        let request = |number: &'static [u8]| (1, number);
        let is_doubtful = |replies: &LateReplies, asked: &'static [u8], reply: &[u8], now| {
            replies.is_doubtful(request(asked), reply, START + now)
        };
        replies.believed(request(&[3, 1]), &[1], false, START);
        replies.believed(request(&[3, 2]), &[2], false, START);
        assert!(!is_doubtful(&replies, &[3, 1], &[1], MS), "it is usual");
        assert!(is_doubtful(&replies, &[3, 1], &[2], MS));
        assert!(is_doubtful(&replies, &[3, 3], &[1], ms(250)));
        assert!(!is_doubtful(&replies, &[3, 3], &[1], ms(251)), "that is long ago");
        assert!(!is_doubtful(&replies, &[3, 3], &[3], MS));
        replies.believed(request(&[3, 1]), &[9], false, START);
        assert!(!is_doubtful(&replies, &[3, 3], &[1], MS), "it is no longer the last one");
        assert!(is_doubtful(&replies, &[3, 3], &[2], MS));
    }

    #[test]
    fn a_reply_is_doubtful_after_one_of_its_function_that_never_came() {
        let mut replies = LateReplies::default();
        until(&mut replies, 200, Ended::TimedOut, 200);
        for (at, is_doubtful) in [(599, false), (600, true)] {
            replies.expire(START + ms(at));
            assert_eq!(replies.is_doubtful((1, &[3, 1]), &[1], START), is_doubtful, "{at}");
        }
        assert!(!replies.is_doubtful((1, &[4, 1]), &[1], START));
        replies.believed((1, &[3, 1]), &[1], true, START);
        assert!(!replies.is_doubtful((1, &[3, 1]), &[1], START));
    }

    #[test]
    fn sixteen_replies_are_compared_and_after_eight_wrong_doubts_none() {
        let mut replies = LateReplies::default();
        (0..16).for_each(|number| replies.believed((1, &[3, number]), &[number], false, START));
        assert!(replies.is_doubtful((1, &[3, 99]), &[0], START));
        replies.believed((1, &[3, 16]), &[16], false, START);
        assert!(!replies.is_doubtful((1, &[3, 99]), &[0], START));
        for _ in 0..8 {
            assert!(replies.is_doubtful((1, &[3, 99]), &[1], START));
            replies.believed((1, &[3, 16]), &[16], true, START);
        }
        assert!(!replies.is_doubtful((1, &[3, 99]), &[1], START));
    }

    #[test]
    fn reads_of_another_number_of_bytes_or_another_function_can_not_be_confused() {
        let mut replies = LateReplies::default();
        let now = START + ms(200);
        replies.ended((1, &coils(8)), (START, ms(200)), Ended::TimedOut, now);
        let waits = |replies: &mut LateReplies, unit_id, request, pad| {
            let tolerance = Tolerance { pad, ..Tolerance::default() };
            replies.until(unit_id, &request, &tolerance, now).is_some()
        };
        assert!(waits(&mut replies, 1, coils(8), false));
        assert!(waits(&mut replies, 1, coils(7), false));
        assert!(!waits(&mut replies, 1, coils(9), false));
        assert!(waits(&mut replies, 1, coils(9), true));
        assert!(!waits(&mut replies, 1, registers(8), true));
        assert!(!waits(&mut replies, 2, coils(8), false));
    }
}

//! Whether a seal that opens once may stay open when a node starts: only if another node was running
//! meanwhile. Otherwise nobody knows how old the contents are, and all nodes close it, at one place of the log.
//!
//! A node that starts asks in the log, and serves only when it knows. Nodes that know answer. If none does,
//! it sends a message that closes the seals, unless another message has come before it: it may be an answer,
//! or another node that has started may have closed them. Each session asks anew; the time for answers goes on.

use std::sync::Arc;
use std::time::{Duration, Instant};

use holdfast_memory::{GateMode, Memory};

use crate::log::settings::Settings;
use crate::log::state::State;
use crate::log::stream::message::Notice;

/// Until nodes that run have answered. They may have to connect again before: after an outage of the servers,
/// all nodes do. It does not count as time that a start may take (`JOIN_TIMEOUT_S` of `shared_logs.py`).
pub(in crate::log) const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);

/// Until a message that closes seals has come back, and for so long nodes let one with a lower name try again:
/// otherwise, nodes that start together come in front of each other.
const CLOSING_TIMEOUT: Duration = Duration::from_secs(2);

/// Whether this process knows, and what it has to tell others.
pub(in crate::log) struct Continuity {
    settings: Arc<Settings>,
    stage: Stage,
    /// The last question of another node that was not answered.
    asked: Option<u64>,
}

enum Stage {
    /// The process has started. Its question was not applied in this session.
    Started {
        /// How long it waits for answers, without the time that earlier sessions have waited.
        left: Duration,
    },
    Asking {
        /// Where the question was applied: answers to it name this sequence, or a later one.
        sequence: u64,
        /// When this node closes the seals.
        until: Instant,
        /// The number of the message that was sent to close them.
        closing: Option<u64>,
    },
    /// A node was running, or the seals were closed. It stays so until the process ends.
    Known,
}

impl Continuity {
    pub(in crate::log) fn new(settings: &Arc<Settings>, members: &[Arc<Memory>]) -> Continuity {
        let opens_once =
            |memory: &Arc<Memory>| memory.gate().is_some_and(|gate| gate.mode == GateMode::Once);
        let is_needed = members.iter().any(opens_once);
        let left = settings.answer_timeout;
        let stage = if is_needed { Stage::Started { left } } else { Stage::Known };
        Continuity { settings: Arc::clone(settings), stage, asked: None }
    }

    pub(in crate::log) fn begin_session(&mut self, now: Instant) {
        if let Stage::Asking { until, .. } = self.stage {
            self.stage = Stage::Started { left: until.saturating_duration_since(now) };
        }
    }

    pub(in crate::log) fn is_known(&self) -> bool {
        matches!(self.stage, Stage::Known)
    }

    /// What messages without steps carry until it is known: the stream may not have stored the first question.
    pub(in crate::log) fn question(&self) -> Option<Notice> {
        (!self.is_known()).then_some(Notice::Asks)
    }

    /// The question of this node was applied, behind all that the log had.
    pub(in crate::log) fn joined(&mut self, state: &State, now: Instant) {
        let Stage::Started { left } = self.stage else { return };
        let sequence = state.position.sequence;
        // The contents of a new log are as they are configured.
        self.stage = if sequence == 1 || !state.has_open_seal() {
            Stage::Known
        } else {
            let has_others = state.knows_others(&self.settings.node);
            let until = if has_others { now + left } else { now };
            Stage::Asking { sequence, until, closing: None }
        };
    }

    /// A message of any node was applied. `own` is its number if this process has sent it.
    pub(in crate::log) fn applied(
        &mut self,
        state: &State,
        node: &str,
        notice: Option<Notice>,
        own: Option<u64>,
        now: Instant,
    ) {
        match notice {
            // This node may know only later, and nodes ask seldom.
            Some(Notice::Asks) if own.is_none() => self.asked = Some(state.position.sequence),
            Some(Notice::Answers { sequence }) if self.asked <= Some(sequence) => self.asked = None,
            _ => {}
        }
        if self.asked.is_some() && !state.has_open_seal() {
            self.asked = None;
        }
        match (&mut self.stage, notice) {
            (Stage::Asking { sequence: asked, .. }, Some(Notice::Answers { sequence }))
                if *asked <= sequence =>
            {
                self.stage = Stage::Known;
            }
            (Stage::Asking { .. }, _) if !state.has_open_seal() => self.stage = Stage::Known,
            (Stage::Asking { until, closing, .. }, Some(Notice::Closes { .. }))
                if own.is_none() && node < self.settings.node.as_str() =>
            {
                (*until, *closing) = ((*until).max(now + CLOSING_TIMEOUT), None);
            }
            // Another message came first: it is sent again.
            (Stage::Asking { until, closing, .. }, _) if closing.is_some() && *closing <= own => {
                (*until, *closing) = (now, None);
            }
            _ => {}
        }
    }

    /// The answer to the nodes that have started.
    pub(in crate::log) fn take_answer(&mut self) -> Option<Notice> {
        if !self.is_known() {
            return None;
        }
        self.asked.take().map(|sequence| Notice::Answers { sequence })
    }

    /// The notice that closes the seals, if no node has answered. `applied` is the last sequence.
    pub(in crate::log) fn due(&self, applied: u64, now: Instant) -> Option<Notice> {
        match self.stage {
            Stage::Asking { until, .. } if until <= now => Some(Notice::Closes { behind: applied }),
            _ => None,
        }
    }

    /// The seals are being closed by the message with this number.
    pub(in crate::log) fn closing(&mut self, counter: u64, now: Instant) {
        if let Stage::Asking { until, closing, .. } = &mut self.stage {
            // If the stream does not store it, it is sent again.
            (*until, *closing) = (now + CLOSING_TIMEOUT, Some(counter));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use holdfast_memory::{Access, Area, Gate, Layout, Span, Write};

    use super::*;
    use crate::log::state::StreamPosition;

    /// The state of a node `a` at this sequence, with an open seal, and what it knows.
    fn asking(sequence: u64) -> (State, Continuity, Instant) {
        let layout = Layout::default().with(Area::Coils, Span::new(0, 8).unwrap());
        let gate = Gate { area: Area::Coils, address: 3, mode: GateMode::Once };
        let members = vec![Arc::new(Memory::new(layout, Some(gate)).unwrap())];
        let open = Write { area: Area::Coils, address: 3, count: 1, bytes: &[1] };
        members[0].write(Access::Ingest, open).unwrap();
        let settings = Arc::new(Settings::new("site", "a", Vec::new()));
        let mut continuity = Continuity::new(&settings, &members);
        let origins = BTreeMap::from(["a", "b"].map(|node| (node.to_owned(), (1, 1))));
        let position = StreamPosition { sequence, stored: 0 };
        let state = State { position, origins, ..State::new(members) };
        let now = Instant::now();
        continuity.joined(&state, now);
        continuity.applied(&state, "a", Some(Notice::Asks), Some(1), now);
        (state, continuity, now)
    }

    #[test]
    fn an_answer_to_an_earlier_question_proves_nothing() {
        let (mut state, mut continuity, now) = asking(7);
        let mut answered = |sequence| {
            state.position.sequence += 1;
            continuity.applied(&state, "b", Some(Notice::Answers { sequence }), None, now);
            continuity.is_known()
        };
        assert!(!answered(6), "it was sent before this process had asked");
        assert!(answered(7));
        assert_eq!(continuity.question(), None);
        assert_eq!(continuity.due(8, now + ANSWER_TIMEOUT), None);
    }

    #[test]
    fn without_an_answer_seals_are_closed_behind_what_was_applied_last() {
        let (mut state, mut continuity, now) = asking(7);
        assert_eq!(continuity.due(7, now), None);
        let late = now + ANSWER_TIMEOUT;
        assert_eq!(continuity.due(7, late), Some(Notice::Closes { behind: 7 }));
        continuity.closing(2, late);
        assert_eq!(continuity.due(7, late), None, "it is under way");
        // Another node asks first.
        state.position.sequence = 8;
        continuity.applied(&state, "b", Some(Notice::Asks), None, late);
        assert_eq!(continuity.take_answer(), None, "it does not know either");
        assert_eq!(continuity.due(8, late), None);
        state.position.sequence = 9;
        continuity.applied(&state, "a", Some(Notice::Closes { behind: 7 }), Some(2), late);
        assert_eq!(continuity.due(9, late), Some(Notice::Closes { behind: 9 }));
        continuity.closing(3, late);
        let later = late + CLOSING_TIMEOUT;
        assert_eq!(
            continuity.due(9, later),
            Some(Notice::Closes { behind: 9 }),
            "it was not stored"
        );
        state.members[0].close_seal();
        continuity.applied(&state, "b", Some(Notice::Closes { behind: 9 }), None, late);
        assert!(continuity.is_known(), "whoever has closed them");
        assert_eq!(continuity.take_answer(), None, "all nodes know");
    }

    #[test]
    fn of_nodes_that_close_seals_together_the_one_with_the_lowest_name_goes_first() {
        let (state, mut continuity, now) = asking(7);
        let late = now + ANSWER_TIMEOUT;
        continuity.closing(2, now);
        let mut closes = |node, own| {
            let closes = Some(Notice::Closes { behind: 5 });
            continuity.applied(&state, node, closes, own, late);
            continuity.due(7, late).is_some()
        };
        assert!(closes("b", None));
        assert!(!closes("A", None));
        assert!(!closes("a", Some(2)), "it was sent before");
        let later = late + CLOSING_TIMEOUT;
        assert_eq!(continuity.due(7, later), Some(Notice::Closes { behind: 7 }));
    }

    #[test]
    fn a_node_that_knows_answers_the_last_question_of_others() {
        let (mut state, mut continuity, now) = asking(7);
        let mut applied = |continuity: &mut Continuity, sequence, notice, own: Option<u64>| {
            state.position.sequence = sequence;
            let node = if own.is_some() { "a" } else { "b" };
            continuity.applied(&state, node, Some(notice), own, now);
        };
        // While it asks itself.
        applied(&mut continuity, 8, Notice::Asks, None);
        assert_eq!(continuity.take_answer(), None);
        applied(&mut continuity, 9, Notice::Answers { sequence: 7 }, None);
        assert_eq!(continuity.take_answer(), Some(Notice::Answers { sequence: 8 }));
        for (sequence, own) in [(10, None), (11, None), (12, Some(3))] {
            applied(&mut continuity, sequence, Notice::Asks, own);
        }
        continuity.begin_session(now);
        assert_eq!(continuity.take_answer(), Some(Notice::Answers { sequence: 11 }));
        assert_eq!(continuity.take_answer(), None);
        // Another node is faster.
        applied(&mut continuity, 13, Notice::Asks, None);
        applied(&mut continuity, 14, Notice::Answers { sequence: 13 }, None);
        assert_eq!(continuity.take_answer(), None);
    }

    #[test]
    fn a_new_session_asks_again_and_waits_for_the_rest_of_the_time() {
        let (state, mut continuity, now) = asking(7);
        let waited = ANSWER_TIMEOUT.mul_f64(0.8);
        let again = now + Duration::from_secs(60);
        continuity.begin_session(now + waited);
        continuity.begin_session(again);
        assert_eq!(continuity.question(), Some(Notice::Asks));
        assert_eq!(continuity.due(7, again + ANSWER_TIMEOUT), None, "it has not joined");
        continuity.joined(&state, again);
        assert_eq!(continuity.due(7, again), None, "time without a session does not count");
        let end = again + ANSWER_TIMEOUT - waited;
        assert_eq!(continuity.due(7, end), Some(Notice::Closes { behind: 7 }));
    }
}

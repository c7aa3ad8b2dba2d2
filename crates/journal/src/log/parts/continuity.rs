//! Whether a seal that opens once may stay open when a node starts: only if another node was running
//! meanwhile. Otherwise nobody knows how old the contents are, and all nodes close it, at one place of the log.
//!
//! A node that starts asks in the log, and serves only when it knows. Nodes that know answer. If none does,
//! it sends a message that closes the seals, unless another message has come before it: it may be an answer,
//! or another node that has started may have closed them.

use std::sync::Arc;
use std::time::{Duration, Instant};

use holdfast_memory::{GateMode, Memory};

use crate::log::settings::Settings;
use crate::log::state::State;
use crate::log::stream::message::Notice;

/// Until nodes that run have answered. They may have to connect again before: after an outage of the servers,
/// all nodes do. Much shorter than a start may take (`JOIN_TIMEOUT_S` of `shared_logs.py`).
pub(in crate::log) const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);

/// Whether this process knows, and what it has to tell others.
pub(in crate::log) struct Continuity {
    settings: Arc<Settings>,
    stage: Stage,
    /// The last question of another node that was not answered.
    asked: Option<u64>,
}

enum Stage {
    /// The process has started. Its question was not applied in this session.
    Started,
    Asking {
        /// Where the question was applied: answers to it name this sequence, or a later one.
        sequence: u64,
        until: Instant,
        /// The number of the message that was sent to close the seals.
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
        let stage = if is_needed { Stage::Started } else { Stage::Known };
        Continuity { settings: Arc::clone(settings), stage, asked: None }
    }

    pub(in crate::log) fn begin_session(&mut self) {
        if !self.is_known() {
            self.stage = Stage::Started;
        }
    }

    pub(in crate::log) fn is_known(&self) -> bool {
        matches!(self.stage, Stage::Known)
    }

    /// What messages without steps carry until it is known.
    pub(in crate::log) fn question(&self) -> Option<Notice> {
        (!self.is_known()).then_some(Notice::Asks)
    }

    /// The question of this node was applied, behind all that the log had.
    pub(in crate::log) fn joined(&mut self, state: &State, now: Instant) {
        let sequence = state.place.sequence;
        if self.is_known() {
            return;
        }
        // The contents of a new log are as they are configured.
        self.stage = if sequence == 1 || !state.has_open_seal() {
            Stage::Known
        } else {
            let has_others = state.knows_others(&self.settings.node);
            let timeout = if has_others { self.settings.answer_timeout } else { Duration::ZERO };
            Stage::Asking { sequence, until: now + timeout, closing: None }
        };
    }

    /// A message was applied. `own` is its number if it was sent by this process.
    pub(in crate::log) fn applied(
        &mut self,
        state: &State,
        notice: Option<Notice>,
        own: Option<u64>,
    ) {
        match (&mut self.stage, notice) {
            (Stage::Known, Some(Notice::Asks)) if own.is_none() => {
                self.asked = Some(state.place.sequence);
            }
            (Stage::Asking { sequence: asked, .. }, Some(Notice::Answers { sequence }))
                if *asked <= sequence =>
            {
                self.stage = Stage::Known;
            }
            (Stage::Asking { .. }, _) if !state.has_open_seal() => self.stage = Stage::Known,
            // Another message came first, or it was not stored: it is sent again.
            (Stage::Asking { closing, .. }, _) if own.is_some() && *closing <= own => {
                *closing = None;
            }
            _ => {}
        }
    }

    /// The answer to the nodes that have started.
    pub(in crate::log) fn take_answer(&mut self) -> Option<Notice> {
        self.asked.take().map(|sequence| Notice::Answers { sequence })
    }

    /// The notice that closes the seals, if no node has answered. `applied` is the last sequence.
    pub(in crate::log) fn due(&self, applied: u64, now: Instant) -> Option<Notice> {
        match self.stage {
            Stage::Asking { until, closing: None, .. } if until <= now => {
                Some(Notice::Closes { behind: applied })
            }
            _ => None,
        }
    }

    /// The seals are being closed by the message with this number.
    pub(in crate::log) fn closing(&mut self, counter: u64) {
        if let Stage::Asking { closing, .. } = &mut self.stage {
            *closing = Some(counter);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use holdfast_memory::{Access, Area, Gate, Layout, Span, Write};

    use super::*;
    use crate::log::state::Place;

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
        let place = Place { sequence, stored: 0 };
        let state = State { place, origins, ..State::new(members) };
        let now = Instant::now();
        continuity.joined(&state, now);
        continuity.applied(&state, Some(Notice::Asks), Some(1));
        (state, continuity, now)
    }

    #[test]
    fn an_answer_to_an_earlier_question_proves_nothing() {
        let (mut state, mut continuity, now) = asking(7);
        let mut answered = |sequence| {
            state.place.sequence += 1;
            continuity.applied(&state, Some(Notice::Answers { sequence }), None);
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
        continuity.closing(2);
        assert_eq!(continuity.due(7, late), None, "it is under way");
        // Another node asks first.
        state.place.sequence = 8;
        continuity.applied(&state, Some(Notice::Asks), None);
        assert_eq!(continuity.take_answer(), None, "it does not know either");
        assert_eq!(continuity.due(8, late), None);
        state.place.sequence = 9;
        continuity.applied(&state, Some(Notice::Closes { behind: 7 }), Some(2));
        assert_eq!(continuity.due(9, late), Some(Notice::Closes { behind: 9 }));
        state.members[0].close_seal();
        continuity.applied(&state, Some(Notice::Closes { behind: 9 }), None);
        assert!(continuity.is_known(), "whoever has closed them");
    }

    #[test]
    fn a_node_that_knows_answers_the_last_question_of_others() {
        let (mut state, mut continuity, _) = asking(7);
        continuity.applied(&state, Some(Notice::Answers { sequence: 7 }), None);
        for (sequence, own) in [(8, None), (9, None), (10, Some(3))] {
            state.place.sequence = sequence;
            continuity.applied(&state, Some(Notice::Asks), own);
        }
        continuity.begin_session();
        assert_eq!(continuity.take_answer(), Some(Notice::Answers { sequence: 9 }));
        assert_eq!(continuity.take_answer(), None);
    }

    #[test]
    fn a_new_session_asks_again_until_the_answer_is_known() {
        let (_, mut continuity, now) = asking(7);
        continuity.begin_session();
        assert_eq!(continuity.question(), Some(Notice::Asks));
        assert_eq!(continuity.due(7, now + ANSWER_TIMEOUT), None);
    }
}

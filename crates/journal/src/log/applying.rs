//! What a message of the stream does on this node, and when the node has caught up.

use std::time::Instant;

use holdfast_memory::Outcome;

use super::error::End;
use super::message::OVERHEAD;
use super::node::{LogSession, Node};
use super::raw_message::Received;
use super::state::{Applied, Place};
use super::status::{Event, NodeView, Phase};

impl Node {
    pub(super) fn received(
        &mut self,
        session: &mut LogSession,
        received: Received,
    ) -> Result<(), End> {
        let Received { place, payload, last, is_readable: _ } = received;
        self.shared.counters.last_sequence.set(last);
        let applied = self.state.place;
        if place.sequence == applied.sequence && place != applied {
            let text = format!(
                "the message at {place} is not the one that this node has applied, {applied}: the \
                 servers have lost messages"
            );
            return Err(self.replaced(text).into());
        }
        if place.sequence <= applied.sequence {
            return Ok(());
        }
        if place.sequence != applied.sequence + 1 {
            let next = applied.sequence + 1;
            return Err(End::Lost(format!("sequence {} came in place of {next}", place.sequence)));
        }
        self.apply(session, place, &payload)
    }

    fn apply(&mut self, session: &mut LogSession, place: Place, payload: &[u8]) -> Result<(), End> {
        let counters = &self.shared.counters;
        let (mut compared, mut for_snapshot) = (false, false);
        session.last_applied = Instant::now();
        let (shared, sent, own) = (&self.shared, &self.sent, &self.origin);
        let applied = self.state.apply(place, payload, |origin| {
            let is_own = origin.node == own.node && origin.start == own.start;
            let first_sent = is_own.then(|| sent.first_sent(origin.counter)).flatten();
            shared.age_since(first_sent)
        })?;
        counters.sequence.set(place.sequence);
        match applied {
            Applied::Fresh { origin, compares, outcomes } => {
                compared = compares;
                if origin.node == self.origin.node {
                    if origin.start > self.origin.start {
                        self.outrun()?;
                    } else if origin.start == self.origin.start {
                        self.is_known = true;
                        for_snapshot = session.asked == Some(origin.counter);
                        self.applied_own(session, origin.counter, outcomes);
                    }
                }
                self.seen(origin.node, place);
            }
            Applied::Stale(origin) => {
                counters.stale.add(1);
                if origin.node == self.origin.node && origin.start > self.origin.start {
                    self.outrun()?;
                }
            }
            Applied::Ignored(error) => {
                counters.ignored.add(1);
                let sequence = place.sequence.to_string();
                let fields = [("sequence", sequence.as_str()), ("reason", &error.to_string())];
                self.shared.event(Event::new("log_message_ignored", &fields));
            }
        }
        if compared || place.sequence.is_multiple_of(self.settings.digest_every) {
            self.tell_digest(session, for_snapshot)?;
        }
        Ok(())
    }

    fn applied_own(&mut self, session: &mut LogSession, counter: u64, outcomes: Vec<Outcome>) {
        let sent = self.sent.applied(counter, outcomes, &self.shared.counters);
        if let Some(at) = sent {
            self.shared.contact(at);
        }
        if session.asked.is_some_and(|asked| asked <= counter) {
            let was_lost = session.asked != Some(counter);
            session.asked = None;
            session.takes_snapshot &= !was_lost;
        }
        if session.caught_up_at.is_some_and(|at| at <= counter) {
            session.caught_up_at = None;
            self.worked = true;
            self.shared.open(session.longest - OVERHEAD);
            let sequence = self.state.place.sequence.to_string();
            self.shared.event(Event::new("log_caught_up", &[("sequence", &sequence)]));
            match &mut self.doubt {
                Some(doubt) => {
                    doubt.compared = Some((self.state.place.sequence, Instant::now()));
                }
                None => self.shared.update(|view| {
                    view.phase = Phase::Running;
                    view.last_error = None;
                }),
            }
        }
    }

    /// Remembers when a node was last seen, for whoever looks at the log.
    fn seen(&mut self, node: String, place: Place) {
        self.shared.update_node(node, |node: &mut NodeView| {
            node.sequence = place.sequence;
            node.stored = place.stored;
        });
    }
}

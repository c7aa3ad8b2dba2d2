//! Where a node begins to read the stream, and with which contents. Whether the servers have lost
//! messages.

use std::time::Instant;

use super::error::{End, LogError};
use super::node::{Doubt, LogSession, NOT_ANNOUNCED, Node};
use super::state::{Place, State, digest_of};
use super::status::Event;
use super::store::{Store, unique};

/// The distance between two starts, at most. Starts were microseconds of Unix time once: as long as they
/// stay behind the clock, such a version still follows this one.
const STARTS: u64 = 1 << 20;

impl Node {
    /// Loads a snapshot if that is needed. Returns the sequence to read from.
    pub(super) async fn join(&mut self, store: &Store) -> Result<u64, End> {
        let id = store.id().map(str::to_owned);
        if self.id.is_some() && self.id != id {
            let text = "the stream of the log was deleted and made anew".to_owned();
            return Err(self.replaced(text).into());
        }
        let (first, end) = {
            let info = &store.stream.cached_info().state;
            let stored = info.last_timestamp.unix_timestamp_nanos() as i64;
            (info.first_sequence, Place { sequence: info.last_sequence, stored })
        };
        let (last, applied) = (end.sequence, self.state.place.sequence);
        if last < applied {
            let place = self.state.place;
            return Err(self.short(format!(
                "the stream ends at {end}, but this node has applied {place}: the servers have lost \
                 messages"
            )));
        }
        let is_wrong = self.doubt.as_ref().is_some_and(|doubt| !doubt.is_loaded);
        if self.id.is_none() || first > applied + 1 || is_wrong {
            self.load(store, last).await?;
            if let Some(doubt) = &mut self.doubt {
                *doubt = Doubt { is_loaded: true, compared: None };
            }
        }
        self.id = id;
        // What was applied last is read again, to see that it is still the same.
        let applied = self.state.place.sequence;
        Ok(if applied >= first.max(1) { applied } else { applied + 1 })
    }

    /// Sends what was not confirmed before, and the message at which this node has caught up. A node
    /// that has sent nothing yet first reads all that the log had when the session began.
    pub(super) async fn announce(&mut self, session: &mut LogSession) -> Result<(), End> {
        if session.caught_up_at != Some(NOT_ANNOUNCED) {
            return Ok(());
        }
        if self.origin.start == 0 {
            if self.state.place.sequence < session.last {
                return Ok(());
            }
            self.origin.start = self.next_start()?;
        } else if self.state.last_start(&self.origin.node) > self.origin.start {
            self.outrun()?;
        }
        for (counter, payload) in self.sent.again() {
            self.publish(session, counter, payload).await?;
        }
        session.caught_up_at = Some(self.origin.counter + 1);
        self.send(session, self.doubt.is_some(), Vec::new(), Vec::new(), session.began).await
    }

    /// A start behind all starts of this node in the log, whatever the clock shows. If another process
    /// with its name starts at the same time, it draws another one.
    fn next_start(&self) -> Result<u64, LogError> {
        let node = &self.origin.node;
        let step = 1 + (unique() as u64) % STARTS;
        let next = self.state.last_start(node).checked_add(step);
        next.ok_or_else(|| LogError::NameUsedUp(node.clone()))
    }

    /// The log has a start of this node that is later than this one.
    pub(super) fn outrun(&mut self) -> Result<(), End> {
        if self.is_known {
            return Err(LogError::NameTaken(self.origin.node.clone()).into());
        }
        if std::mem::take(&mut self.origin.start) == 0 {
            return Ok(());
        }
        Err(End::Lost("the log has a later start of this node".to_owned()))
    }

    /// A server knows less than this node. Whether that stays so is seen later.
    fn short(&mut self, text: String) -> End {
        let since = self.was_short_since.unwrap_or_else(Instant::now);
        self.short_since = Some(since);
        let error = self.replaced(text);
        if since.elapsed() < self.settings.cut_off {
            End::Lost(error.to_string())
        } else {
            error.into()
        }
    }

    /// Loads the newest snapshot that is good, or makes the first one.
    async fn load(&mut self, store: &Store, last: u64) -> Result<(), End> {
        let pointer = self.tend(store.pointer()).await??;
        let Some((revision, pointer)) = pointer else {
            if last > 0 {
                let text = "the log has messages, but the key of its snapshot is missing";
                let missing = self.short(text.to_owned());
                return Err(match missing {
                    End::Fatal(_) => LogError::Snapshot(text.to_owned()).into(),
                    other => other,
                });
            }
            // The first node that gets here decides what the log begins with.
            let encoded = self.state.encode();
            let snapshot = self.snapshot_of(digest_of(&encoded));
            let first = self.tend(store.put(None, &encoded, snapshot)).await?;
            self.pointer = Some(first.map_err(|error| End::lost("the first snapshot", error))?);
            self.pointer_since = Instant::now();
            return Ok(());
        };
        if pointer.newest.sequence > last {
            let sequence = pointer.newest.sequence;
            return Err(self.short(format!(
                "the stream ends at sequence {last}, but there is a snapshot at {sequence}: the \
                 servers have lost messages"
            )));
        }
        self.shared.loading(true);
        let mut state = State::new(std::mem::take(&mut self.state.members));
        let (mut first, mut second) = (&pointer.newest, pointer.previous.as_ref());
        // A node whose contents were wrong does not trust what it has stored itself.
        if let (true, Some(previous)) = (self.doubt.is_some(), second)
            && first.node == self.settings.node
        {
            (first, second) = (previous, Some(first));
        }
        let mut loaded = self.tend(store.load(first, &mut state)).await;
        if let (Ok(Err(End::Fatal(error))), Some(previous)) = (&loaded, second) {
            self.shared
                .event(Event::new("log_snapshot_damaged", &[("reason", &error.to_string())]));
            loaded = self.tend(store.load(previous, &mut state)).await;
        }
        let mut end = loaded.and_then(|loaded| loaded);
        if matches!(end, Err(End::Fatal(_))) {
            // Other nodes may have stored snapshots meanwhile, and removed these.
            if let Ok(Ok(Some((now, _)))) = self.tend(store.pointer()).await
                && now != revision
            {
                end = Err(End::Lost("the snapshot was replaced".to_owned()));
            }
        }
        if end.is_ok() {
            self.state = state;
            // What the snapshot has of this node was applied, but not here: the outcomes are lost.
            let counter = self.state.last_counter(&self.origin);
            self.sent.unclear(counter, &self.shared.counters);
        } else {
            self.state.members = state.members;
        }
        self.shared.loading(false);
        end?;
        self.shared.counters.sequence.set(self.state.place.sequence);
        self.note_pointer(revision, pointer);
        Ok(())
    }
}

//! When a node takes a snapshot, and when the snapshot is stored.

use std::time::{Duration, Instant};

use super::error::End;
use super::node::{LogSession, Node, Prepared, Report};
use super::status::Event;
use super::store::{Pointer, Snapshot, unique};

/// How long a snapshot, or a node that returns, waits for the digests of other nodes.
pub(super) const ALONE: Duration = Duration::from_secs(5);

/// When a snapshot is tried again.
const RETRY: Duration = Duration::from_secs(5);

impl Node {
    pub(super) fn note_pointer(&mut self, revision: u64, pointer: Pointer) {
        if self.pointer.as_ref().is_none_or(|(known, _)| *known < revision) {
            let sequence = pointer.newest.sequence;
            self.shared.update(|view| view.snapshot = Some(sequence));
            self.pointer = Some((revision, pointer));
            self.pointer_since = Instant::now();
        }
    }

    pub(super) fn snapshot_of(&self, digest: String) -> Snapshot {
        Snapshot {
            sequence: self.state.place.sequence,
            stored: self.state.place.stored,
            steps: self.state.steps,
            object: format!("{:016x}", unique() as u64),
            digest,
            node: self.settings.node.clone(),
        }
    }

    /// Stores the snapshot that was made at this sequence: its digest is right.
    pub(super) fn store_snapshot(&mut self, session: &mut LogSession, sequence: u64) {
        let own = session.prepared.take_if(|own| own.snapshot.sequence == sequence);
        let Some(Prepared { encoded, snapshot, .. }) = own else { return };
        let (store, reports) = (session.store.clone(), session.reports.clone());
        let pointer = self.pointer.clone();
        tokio::spawn(async move {
            let stored = match store.put(pointer, &encoded, snapshot).await {
                Ok((revision, pointer)) => store.tidy(&pointer).await.map(|()| (revision, pointer)),
                Err(error) => Err(error),
            };
            store.release().await;
            // If the session has ended, the next one sees the key.
            let _ = reports.send(Report::Stored(stored));
        });
    }

    /// Gives up a snapshot that nodes don't agree on. There will be another one.
    pub(super) fn drop_disputed(&self, session: &mut LogSession) {
        if session.prepared.take_if(|own| own.is_disputed).is_some() {
            session.takes_snapshot = false;
            session.no_snapshot_before = Instant::now() + RETRY;
        }
    }

    pub(super) fn consider_snapshot(&mut self, session: &mut LogSession, now: Instant) {
        self.store_undisputed(session, now);
        let Some((_, pointer)) = &self.pointer else { return };
        let newest = &pointer.newest;
        let since = self.state.steps.saturating_sub(newest.steps);
        let due = since >= self.settings.snapshot_steps
            || (now.saturating_duration_since(self.pointer_since) >= self.settings.snapshot_after
                && self.state.place.sequence > newest.sequence);
        let may = self.doubt.is_none()
            && session.caught_up_at.is_none()
            && now >= session.no_snapshot_before;
        if due && may && !std::mem::replace(&mut session.takes_snapshot, true) {
            let (store, reports) = (session.store.clone(), session.reports.clone());
            let node = self.settings.node.clone();
            tokio::spawn(async move {
                // If the session has ended, the lease expires.
                let _ = reports.send(Report::Leased(store.lease(&node).await));
            });
        }
    }

    pub(super) async fn leased(&mut self, session: &mut LogSession, is: bool) -> Result<(), End> {
        if !is {
            session.takes_snapshot = false;
            session.no_snapshot_before = Instant::now() + RETRY;
            return Ok(());
        }
        let until = Instant::now() + self.settings.write_timeout;
        self.send(session, true, Vec::new(), Vec::new(), until).await?;
        session.asked = Some(self.origin.counter);
        Ok(())
    }

    pub(super) fn stored(
        &mut self,
        session: &mut LogSession,
        stored: Result<(u64, Pointer), String>,
    ) {
        session.takes_snapshot = false;
        match stored {
            Ok((revision, pointer)) => {
                let sequence = pointer.newest.sequence.to_string();
                self.shared.event(Event::new("log_snapshot_stored", &[("sequence", &sequence)]));
                self.note_pointer(revision, pointer);
            }
            Err(reason) => {
                session.no_snapshot_before = Instant::now() + RETRY;
                self.shared.event(Event::new("log_snapshot_failed", &[("reason", &reason)]));
            }
        }
    }

    /// Stores a snapshot that no other node has compared itself with for some time.
    fn store_undisputed(&mut self, session: &mut LogSession, now: Instant) {
        let is_alone =
            |own: &&Prepared| !own.is_disputed && now.saturating_duration_since(own.since) >= ALONE;
        if let Some(own) = session.prepared.as_ref().filter(is_alone) {
            let sequence = own.snapshot.sequence;
            self.store_snapshot(session, sequence);
        }
    }
}

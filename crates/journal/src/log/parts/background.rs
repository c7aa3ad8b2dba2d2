//! Work that takes long, beside a session: it reports its result to the session.

use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};

use crate::log::error::End;
use crate::log::stream::store::{Pointer, Store};

/// The result of work in the background.
pub(in crate::log) enum Report {
    /// Whether this node may take a snapshot.
    Leased(Result<bool, End>),
    /// The revision of the snapshot's key.
    Stored((u64, Pointer)),
    /// Why a snapshot was not stored, the revision of the key that was known, and what the key names now.
    NotStored { reason: String, known: Option<u64>, found: Result<Option<(u64, Pointer)>, End> },
    /// How many messages were removed behind the newest snapshot, for want of room.
    Freed(Result<u64, String>),
    /// On how many servers the stream is, if they say so. Whether they have lost what the log begins with.
    Examined { replicas: Option<usize>, found: Result<(), End> },
    /// The digest that the log leads to.
    Replayed { sequence: u64, digest: Result<String, String> },
}

/// Runs work on the store of one session.
pub(in crate::log) struct Background {
    store: Store,
    reports: UnboundedSender<Report>,
}

impl Background {
    pub(in crate::log) fn new(store: Store) -> (Background, UnboundedReceiver<Report>) {
        let (reports, reported) = unbounded_channel();
        (Background { store, reports }, reported)
    }

    pub(in crate::log) fn store(&self) -> &Store {
        &self.store
    }

    pub(in crate::log) fn spawn<F>(&self, work: impl FnOnce(Store) -> F)
    where
        F: Future<Output = Report> + Send + 'static,
    {
        let (work, reports) = (work(self.store.clone()), self.reports.clone());
        tokio::spawn(async move {
            // Fails if the session has ended. The next one reads the store anew.
            let _ = reports.send(work.await);
        });
    }
}

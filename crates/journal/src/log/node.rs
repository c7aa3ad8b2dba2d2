//! What a node of a log knows: for as long as its process runs, and for one session.

use std::future::Future;
use std::sync::Arc;
use std::time::Instant;

use async_nats::Client;
use holdfast_memory::Memory;
use tokio::sync::mpsc;

use super::digests::Digests;
use super::error::End;
use super::message::Origin;
use super::sent::{LOOK, Sent};
use super::settings::Settings;
use super::shared::Shared;
use super::state::State;
use super::store::{Pointer, Snapshot, Store};

/// What the owner of a session keeps from one session to the next.
pub(super) struct Node {
    pub(super) settings: Arc<Settings>,
    pub(super) fingerprint: String,
    pub(super) shared: Arc<Shared>,
    pub(super) state: State,
    /// What this node has sent last. The start is 0 until the first message is sent.
    pub(super) origin: Origin,
    pub(super) sent: Sent,
    /// Tells the stream that was applied from another one.
    pub(super) id: Option<String>,
    pub(super) digests: Digests,
    pub(super) pointer: Option<(u64, Pointer)>,
    pub(super) pointer_since: Instant,
    /// Since when the servers have known less than this node, in this session and in the last one.
    pub(super) short_since: Option<Instant>,
    pub(super) was_short_since: Option<Instant>,
    pub(super) worked: bool,
    /// A message of this start was applied: a later start is that of another process.
    pub(super) is_known: bool,
    /// While the node returns with other contents, because its own were wrong.
    pub(super) doubt: Option<Doubt>,
    /// When it has begun to return the last time.
    pub(super) returned: Option<Instant>,
}

/// One connection, and what is under way on it.
pub(super) struct LogSession {
    pub(super) client: Client,
    pub(super) store: Store,
    pub(super) subject: String,
    pub(super) inbox: String,
    pub(super) longest: usize,
    pub(super) began: Instant,
    pub(super) last_sent: Instant,
    pub(super) last_applied: Instant,
    /// The last sequence of the stream when the session began.
    pub(super) last: u64,
    /// When a message of this node with this counter is applied, this node has caught up.
    pub(super) caught_up_at: Option<u64>,
    pub(super) reports: mpsc::UnboundedSender<Report>,
    /// From the request for the lease to the end of its use.
    pub(super) takes_snapshot: bool,
    /// At the message of this node with this counter, a snapshot is made.
    pub(super) asked: Option<u64>,
    pub(super) prepared: Option<Prepared>,
    /// After a refused lease, another node is about to store a snapshot.
    pub(super) no_snapshot_before: Instant,
    pub(super) replays: bool,
}

/// The counter of a message that was not sent yet.
pub(super) const NOT_ANNOUNCED: u64 = u64::MAX;

/// A snapshot that is stored when no other node has another digest.
pub(super) struct Prepared {
    pub(super) encoded: Vec<u8>,
    pub(super) snapshot: Snapshot,
    pub(super) since: Instant,
    /// Another node has another digest, so the log is asked.
    pub(super) is_disputed: bool,
}

/// What tasks beside a session report to it.
pub(super) enum Report {
    /// This node may take a snapshot.
    Leased(bool),
    Stored(Result<(u64, Pointer), String>),
    /// The digest that the log leads to.
    Replayed {
        sequence: u64,
        digest: Result<String, String>,
    },
}

/// Contents that were dropped because they were wrong.
#[derive(Debug, Default)]
pub(super) struct Doubt {
    /// A snapshot has taken their place.
    pub(super) is_loaded: bool,
    /// The contents are compared at this sequence, since this time.
    pub(super) compared: Option<(u64, Instant)>,
}

impl Node {
    pub(super) fn new(
        settings: Arc<Settings>,
        fingerprint: String,
        shared: Arc<Shared>,
        members: Vec<Arc<Memory>>,
    ) -> Node {
        let origin = Origin { node: settings.node.clone(), start: 0, counter: 0 };
        let digests = Digests::new(&settings.node);
        Node {
            settings,
            fingerprint,
            shared,
            state: State::new(members),
            origin,
            sent: Sent::default(),
            id: None,
            digests,
            pointer: None,
            pointer_since: Instant::now(),
            short_since: None,
            was_short_since: None,
            worked: false,
            is_known: false,
            doubt: None,
            returned: None,
        }
    }

    /// Waits for something, and meanwhile answers steps whose time is over.
    pub(super) async fn tend<T>(&mut self, work: impl Future<Output = T>) -> Result<T, End> {
        let mut work = std::pin::pin!(work);
        loop {
            tokio::select! {
                done = &mut work => return Ok(done),
                () = tokio::time::sleep(LOOK) => {
                    self.keep();
                    self.sent.expire(Instant::now(), &self.shared.counters);
                    if self.shared.is_stopping() {
                        return Err(End::Stopped);
                    }
                }
            }
        }
    }
}

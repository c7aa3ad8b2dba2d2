//! What a log shows of itself: counters, a view of its state, and events.

use std::collections::BTreeMap;
use std::time::Duration;

use holdfast_runtime::Counter;

use super::error::LogError;

/// Those of [`Status`].
#[derive(Debug, Default)]
pub(super) struct Counters {
    pub(super) sequence: Counter,
    pub(super) last_sequence: Counter,
    pub(super) steps: Counter,
    pub(super) unavailable: Counter,
    pub(super) not_confirmed: Counter,
    pub(super) too_large: Counter,
    pub(super) refused: Counter,
    pub(super) stale: Counter,
    pub(super) ignored: Counter,
}

/// Where a log is in its life.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Phase {
    #[default]
    Starting,
    /// It has caught up once.
    Running,
    /// Its contents were wrong. It serves again when they are right for sure.
    Returning(LogError),
    Failed(LogError),
    Stopped,
}

/// What the status shows, without the counters.
#[derive(Debug, Clone, Default)]
pub(super) struct View {
    pub(super) phase: Phase,
    pub(super) server: Option<String>,
    /// It has applied all that the log had, and waits for other nodes to say whether seals stay open.
    pub(super) awaits_seal_answer: bool,
    pub(super) last_error: Option<String>,
    pub(super) replicas: usize,
    pub(super) digest: Option<Digest>,
    pub(super) snapshot: Option<u64>,
    pub(super) nodes: BTreeMap<String, NodeStatus>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Digest {
    pub sequence: u64,
    pub digest: String,
    /// Whether another node has the same digest, or another one; `None` if no node has published one.
    pub agrees: Option<bool>,
}

/// What is known of a node of the log.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NodeStatus {
    /// The sequence of its last message.
    pub sequence: u64,
    /// When the stream stored that, in nanoseconds of Unix time.
    pub stored: i64,
    /// The sequence of its last digest, and the digest.
    pub digest: Option<(u64, String)>,
}

/// What a log shows of itself.
#[derive(Debug, Clone)]
pub struct Status {
    pub phase: Phase,
    /// The server of the present connection.
    pub server: Option<String>,
    pub last_error: Option<String>,
    /// How long ago the contents were current for sure.
    pub contact_age: Option<Duration>,
    /// The sequence that was applied last.
    pub sequence: u64,
    /// The last sequence of the stream, as far as it is known.
    pub last_sequence: u64,
    /// Steps of this node that were carried out.
    pub steps: u64,
    /// Steps of this node that were not sent, or that the stream has not taken: they are never carried out.
    pub unavailable: u64,
    /// Steps of this node that may be carried out, but this was not known in time.
    pub not_confirmed: u64,
    /// Steps of this node that the servers would not accept, as they are too long. Users see it as `not_stored`.
    pub too_large: u64,
    /// Steps of this node that a memory refused when it was their turn.
    pub refused: u64,
    /// Messages that were applied before, or that a later start of their node has overtaken.
    pub stale: u64,
    /// Messages that are of no node, of another log, or of a node for which the log has no room.
    pub ignored: u64,
    pub replicas: usize,
    pub digest: Option<Digest>,
    /// The sequence of the newest snapshot.
    pub snapshot: Option<u64>,
    pub nodes: BTreeMap<String, NodeStatus>,
}

/// Something that happened, for the log of the program.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Event {
    pub name: &'static str,
    pub fields: Vec<(&'static str, String)>,
}

impl Event {
    pub(super) fn new(name: &'static str, fields: &[(&'static str, &str)]) -> Event {
        let fields = fields.iter().map(|(key, value)| (*key, (*value).to_owned())).collect();
        Event { name, fields }
    }
}

//! How storing goes.

use std::time::{Duration, Instant, SystemTime};

/// How storing goes.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Status {
    /// Why the contents can't be stored at present.
    pub failing: Option<String>,
    /// When contents were last stored.
    pub stored_at: Option<SystemTime>,
    /// How many transactions were stored.
    pub commits: u64,
    /// How many writes wait to be stored.
    pub pending: u64,
    /// How many writes were refused because they could not be stored.
    pub refused: u64,
    /// How many writes were refused because too many waited.
    pub busy: u64,
    /// How long the last transaction took.
    pub last_commit: Duration,
    /// The size of the file.
    pub bytes: u64,
    /// How often the file was gone, and was written anew.
    pub recreated: u64,
    /// Since when the disk has not answered.
    pub(super) busy_since: Option<Instant>,
    /// Nothing of the contents is where a start looks for them: the file was removed, or renamed, or something
    /// else is in its place. A file that was moved with its folder, or is not mounted, still has them.
    pub(super) is_away: bool,
}

//! For how long the servers have known less than this node: they may be cut off from the others for a
//! while, or have lost messages for good.

use std::time::{Duration, Instant};

use crate::log::error::{End, LogError};

/// For so long, the servers may be cut off from the others. After that, they have lost messages. At least
/// the time that a start may take (`JOIN_TIMEOUT_S` of `shared_logs.py`).
pub(in crate::log) const MAX_CUT_OFF: Duration = Duration::from_secs(30);

/// Since when the servers have known less than this node, without a session in which they did not.
pub(in crate::log) struct LostMessages {
    /// For so long, the servers may be cut off from the others.
    max: Duration,
    in_this_session: Option<Instant>,
    in_last_session: Option<Instant>,
}

impl LostMessages {
    pub(in crate::log) fn new(max: Duration) -> LostMessages {
        LostMessages { max, in_this_session: None, in_last_session: None }
    }

    pub(in crate::log) fn begin_session(&mut self) {
        self.in_last_session = self.in_this_session.take();
    }

    /// The servers know less than this node. The next session may find other servers, until they have been
    /// cut off for too long.
    pub(in crate::log) fn judge(&mut self, error: LogError) -> End {
        let since = self.in_last_session.unwrap_or_else(Instant::now);
        self.in_this_session = Some(since);
        if since.elapsed() < self.max { End::Lost(error.to_string()) } else { error.into() }
    }
}

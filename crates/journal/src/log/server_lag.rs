//! For how long the servers have known less than this node: they may be cut off from the others for a
//! while, or have lost messages for good.

use std::time::{Duration, Instant};

use super::error::{End, LogError};

/// Since when the servers have known less than this node, without a session in which they did not.
pub(super) struct ServerLag {
    /// For so long, the servers may be cut off from the others.
    max: Duration,
    in_this_session: Option<Instant>,
    in_last_session: Option<Instant>,
}

impl ServerLag {
    pub(super) fn new(max: Duration) -> ServerLag {
        ServerLag { max, in_this_session: None, in_last_session: None }
    }

    pub(super) fn begin_session(&mut self) {
        self.in_last_session = self.in_this_session.take();
    }

    /// The servers know less than this node. The next session may find other servers, until they have been
    /// cut off for too long.
    pub(super) fn judge(&mut self, error: LogError) -> End {
        let since = self.in_last_session.unwrap_or_else(Instant::now);
        self.in_this_session = Some(since);
        if since.elapsed() < self.max { End::Lost(error.to_string()) } else { error.into() }
    }
}

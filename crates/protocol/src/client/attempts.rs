//! Whether a request is sent again after a failure: only a read is.

use core::time::Duration;

use super::tolerance::Tolerance;
use super::{Closed, Failure};
use crate::pdu::EncodedRequest;

/// The pause before a read is sent again to a device that is busy.
pub const BUSY_PAUSE: Duration = Duration::from_millis(100);

/// How often a request was sent before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Attempt {
    retries: u8,
    reconnected: bool,
    pause: Duration,
}

impl Attempt {
    /// The next attempt after a failure, if there is one. Only reads are sent again. `stale` says that
    /// the connection had carried replies before, and ended without a byte of this one.
    pub(super) fn next(
        self,
        request: &EncodedRequest,
        failure: Failure,
        stale: bool,
        tolerance: &Tolerance,
    ) -> Option<Attempt> {
        if !request.is_read() {
            return None;
        }
        if failure == Failure::Closed(Closed::ByPeer) && stale && !self.reconnected {
            return Some(Attempt { reconnected: true, ..self });
        }
        let pause = match failure {
            Failure::Exception(5 | 6) if tolerance.retry_busy => tolerance.pause.max(BUSY_PAUSE),
            Failure::Exception(_) | Failure::Closed(Closed::BySelf) => return None,
            Failure::Timeout
            | Failure::Incomplete
            | Failure::NoSilence
            | Failure::Invalid(_)
            | Failure::Closed(_) => tolerance.pause,
        };
        (self.retries < tolerance.retries).then(|| Attempt {
            retries: self.retries + 1,
            reconnected: false,
            pause,
        })
    }

    /// The time to wait before sending.
    pub const fn pause(&self) -> Duration {
        self.pause
    }

    /// Whether the attempt has a timeout of its own. A read that is repeated because a device had
    /// closed its connection has not.
    pub const fn has_own_timeout(&self) -> bool {
        !self.reconnected
    }
}

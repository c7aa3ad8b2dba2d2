//! What is checked at the last moment before a request is sent.

use std::sync::Arc;
use std::time::Instant;

use tokio::time::timeout_at;

use crate::client::{ClientError, Peers, SendMoment};
use crate::link::limits::lease_fence::Fence;

/// Whether somebody still waits for the answer to a request.
pub(crate) type Wanted = Arc<dyn Fn(SendMoment) -> bool + Send + Sync>;

/// Until when a request may be sent. The default is without a limit.
#[derive(Clone, Default)]
pub(crate) struct Permit {
    /// The fence of the device.
    pub fence: Option<Arc<Fence>>,
    /// After this, the caller no longer expects its write to be sent.
    pub until: Option<Instant>,
    /// `None` if it is sent even when nobody waits for its answer.
    pub wanted: Option<Wanted>,
    pub peers: Peers,
}

impl Permit {
    /// # Errors
    /// [`ClientError::Fenced`] or [`ClientError::Expired`].
    pub fn check(&self, moment: SendMoment) -> Result<(), ClientError> {
        if self.fence.as_ref().is_some_and(|fence| !fence.allows()) {
            return Err(ClientError::Fenced);
        }
        if self.is_expected(moment) { Ok(()) } else { Err(ClientError::Expired) }
    }

    /// Whether its caller still expects it to be sent.
    pub fn is_expected(&self, moment: SendMoment) -> bool {
        self.until.is_none_or(|until| Instant::now() < until)
            && self.wanted.as_ref().is_none_or(|wanted| wanted(moment))
    }

    /// This permit while `also` expects the request too.
    pub fn and(&self, also: Wanted) -> Permit {
        let wanted: Wanted = match self.wanted.clone() {
            Some(wanted) => Arc::new(move |moment| wanted(moment) && also(moment)),
            None => also,
        };
        Permit { wanted: Some(wanted), ..self.clone() }
    }

    /// Waits for a turn; `None` if it does not come in time.
    pub async fn in_time<T>(&self, turn: impl Future<Output = T>) -> Option<T> {
        match self.until {
            None => Some(turn.await),
            Some(until) => timeout_at(until.into(), turn).await.ok(),
        }
    }
}

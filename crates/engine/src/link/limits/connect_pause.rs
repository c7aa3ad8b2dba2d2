//! The pause after a failed connect: until it is over, polls fail at once, with the same error. Requests of clients
//! are tried all the same, as far as a [circuit breaker](super::circuit_breaker) lets them through. How long the
//! pause is, and how it grows, is in `holdfast_runtime::Retry`.

use std::cell::{Cell, RefCell};
use std::sync::Arc;

use holdfast_runtime::Retry;
use tokio::time::Instant;

use crate::client::ClientError;
use crate::link::fault::FLOODED;

/// What a request does whose address could not be reached, before the pause is over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::link) enum DuringPause {
    Fail,
    Connect,
}

pub(in crate::link) struct ConnectPause {
    retry: Retry,
    /// Consecutive failed attempts to connect.
    failures: Cell<u32>,
    /// The earliest time of the next attempt, and why it waits. Stays until the device is connected.
    waiting: RefCell<Option<(Instant, Arc<ClientError>)>>,
}

impl ConnectPause {
    pub(in crate::link) fn new(retry: Retry) -> ConnectPause {
        ConnectPause { retry, failures: Cell::default(), waiting: RefCell::default() }
    }

    /// Whether the device may be connected now.
    ///
    /// # Errors
    /// That of the last attempt.
    pub(in crate::link) fn check(&self) -> Result<(), Arc<ClientError>> {
        match &*self.waiting.borrow() {
            Some((until, error)) if Instant::now() < *until => Err(Arc::clone(error)),
            _ => Ok(()),
        }
    }

    /// An attempt has failed, for whatever reason: refused, too late, without an address. Returns its error.
    pub(in crate::link) fn failed(&self, error: impl Into<Arc<ClientError>>) -> Arc<ClientError> {
        let error = error.into();
        self.failures.set(self.failures.get().saturating_add(1));
        let until = Instant::now() + self.retry.pause(self.failures.get());
        self.waiting.replace(Some((until, Arc::clone(&error))));
        error
    }

    /// The device has flooded the link. [`Flood`](super::flood::Flood) counts that, and decides how long the
    /// pause is.
    pub(in crate::link) fn flooded(&self, until: Instant) {
        self.waiting.replace(Some((until, Arc::new(FLOODED))));
    }

    /// The device was connected, whatever comes of the request.
    pub(in crate::link) fn connected(&self) {
        self.failures.set(0);
        self.waiting.replace(None);
    }

    /// The end of the pause, which may be over.
    pub(in crate::link) fn until(&self) -> Option<Instant> {
        self.waiting.borrow().as_ref().map(|(until, _)| *until)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn seconds(pause: &ConnectPause) -> u64 {
        // The time between the two looks at the clock is missing.
        let left = pause.until().map(|until| until - Instant::now());
        left.map_or(0, |left| left.as_secs_f64().ceil() as u64)
    }

    #[test]
    fn pauses_double_until_the_device_is_connected_and_a_flood_is_no_failed_connect() {
        let (first, most) = (Duration::from_secs(60), Duration::from_secs(240));
        let too_late = || ClientError::ConnectTimeout { to: "tcp://plc7:502".into(), after: first };
        let pause = ConnectPause::new(Retry { first, most, jitter: false });
        assert!(pause.check().is_ok());
        for expected in [60, 120] {
            let error = pause.failed(too_late());
            assert!(Arc::ptr_eq(&pause.check().unwrap_err(), &error));
            assert_eq!(seconds(&pause), expected);
        }
        pause.flooded(Instant::now() + first);
        assert_eq!(pause.check().unwrap_err().to_string(), FLOODED.to_string());
        assert_eq!(seconds(&pause), 60);
        pause.failed(too_late());
        assert_eq!(seconds(&pause), 240);
        pause.connected();
        assert!(pause.check().is_ok());
        pause.failed(too_late());
        assert_eq!(seconds(&pause), 60);
    }
}

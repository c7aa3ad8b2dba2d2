//! Units and addresses that do not answer: for a while, requests to them are refused without a try, so
//! that they do not hold up the others.

use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::time::Duration;

use holdfast_protocol::pdu::ExceptionCode;
use holdfast_runtime::Retry;
use tokio::time::Instant;

use super::fault::Fault;

/// Timeouts in a row after which requests to a unit are refused for a while.
const SILENT_AFTER: u32 = 3;

/// The longest time for which requests are refused without a try: somebody waits for them.
const MAX_PAUSE: Duration = Duration::from_secs(5);

pub(super) struct Silence {
    retry: Retry,
    units: RefCell<HashMap<u8, Pause>>,
    address: Cell<Option<Pause>>,
}

/// Failures in a row, and how long requests are refused for that.
#[derive(Clone, Copy)]
struct Pause {
    failures: u32,
    until: Instant,
}

impl Pause {
    /// After one more failure. The first `free` failures cause no pause.
    fn longer(before: Option<Pause>, free: u32, retry: Retry) -> Pause {
        let failures = before.map_or(1, |pause| pause.failures.saturating_add(1));
        let pause = match failures.checked_sub(free) {
            None | Some(0) => Duration::ZERO,
            Some(counted) => retry.pause(counted),
        };
        Pause { failures, until: Instant::now() + pause }
    }

    fn lasts(&self) -> bool {
        Instant::now() < self.until
    }
}

impl Silence {
    pub(super) fn new(retry: Retry) -> Silence {
        let (units, address) = Default::default();
        Silence { retry: retry.up_to(MAX_PAUSE), units, address }
    }

    /// Whether a request is refused without a try.
    pub(super) fn refuse(&self, unit_id: u8) -> Result<(), ExceptionCode> {
        if self.address.get().is_some_and(|pause| pause.lasts()) {
            return Err(ExceptionCode::GatewayPathUnavailable);
        }
        if self.units.borrow().get(&unit_id).is_some_and(Pause::lasts) {
            return Err(ExceptionCode::GatewayTargetFailedToRespond);
        }
        Ok(())
    }

    /// Draws conclusions for the next requests. `is_unreachable` says that the address could not be
    /// reached.
    pub(super) fn learn(&self, unit_id: u8, answered: Result<(), Fault>, is_unreachable: bool) {
        if answered.is_err() && is_unreachable {
            return self.address.set(Some(Pause::longer(self.address.get(), 0, self.retry)));
        }
        self.address.set(None);
        let mut units = self.units.borrow_mut();
        if answered == Err(Fault::Timeout) {
            let pause = Pause::longer(units.get(&unit_id).copied(), SILENT_AFTER - 1, self.retry);
            units.insert(unit_id, pause);
        } else {
            units.remove(&unit_id);
        }
    }

    /// Whether the address could not be reached the last time.
    pub(super) fn is_unreachable(&self) -> bool {
        self.address.get().is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SILENT: Result<(), Fault> = Err(Fault::Timeout);

    #[test]
    fn a_unit_is_left_alone_after_some_timeouts_and_others_are_not() {
        let silence = Silence::new(Retry::default());
        for _ in 1..SILENT_AFTER {
            silence.learn(7, SILENT, false);
            assert_eq!(silence.refuse(7), Ok(()));
        }
        silence.learn(7, SILENT, false);
        assert_eq!(silence.refuse(7), Err(ExceptionCode::GatewayTargetFailedToRespond));
        assert_eq!(silence.refuse(8), Ok(()));
        for answer in [Ok(()), Err(Fault::Exception(2))] {
            silence.learn(7, answer, false);
            assert_eq!(silence.refuse(7), Ok(()));
        }
    }

    #[test]
    fn an_address_that_can_not_be_reached_is_left_alone_at_once() {
        let silence = Silence::new(Retry::default());
        silence.learn(7, Err(Fault::Refused), true);
        assert_eq!(silence.refuse(8), Err(ExceptionCode::GatewayPathUnavailable));
        silence.learn(8, Ok(()), false);
        assert_eq!(silence.refuse(7), Ok(()));
    }
}

//! A circuit breaker for each unit, and one for the address of the link. While it is open, requests fail
//! fast, so that a unit that does not answer does not delay requests to the others.
//!
//! A breaker opens after failures in a row, for longer each time. The first request after that is the
//! test: a reply closes the breaker, a failure opens it again.

use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::time::Duration;

use holdfast_protocol::pdu::ExceptionCode;
use holdfast_runtime::Retry;
use tokio::time::Instant;

use crate::link::fault::Fault;

/// Timeouts in a row that open the breaker of a unit. One timeout says little: replies get lost.
const OPEN_AFTER_TIMEOUTS: u32 = 3;

/// The longest time for which a breaker stays open. Clients wait for requests, unlike for polls.
const MAX_OPEN: Duration = Duration::from_secs(5);

pub(in crate::link) struct CircuitBreakers {
    retry: Retry,
    /// Without an entry, the breaker of a unit is closed.
    units: RefCell<HashMap<u8, Breaker>>,
    address: Cell<Option<Breaker>>,
}

/// Failures in a row, and until when the breaker is open because of them.
#[derive(Clone, Copy)]
struct Breaker {
    failures: u32,
    open_until: Instant,
}

impl Breaker {
    /// After one more failure. The first `tolerated` failures do not open it.
    fn after_failure(before: Option<Breaker>, tolerated: u32, retry: Retry) -> Breaker {
        let failures = before.map_or(1, |breaker| breaker.failures.saturating_add(1));
        let pause = match failures.checked_sub(tolerated) {
            None | Some(0) => Duration::ZERO,
            Some(counted) => retry.pause(counted),
        };
        Breaker { failures, open_until: Instant::now() + pause }
    }

    fn is_open(&self) -> bool {
        Instant::now() < self.open_until
    }
}

impl CircuitBreakers {
    pub(in crate::link) fn new(retry: Retry) -> CircuitBreakers {
        let (units, address) = Default::default();
        CircuitBreakers { retry: retry.up_to(MAX_OPEN), units, address }
    }

    /// Fails fast if a breaker is open.
    ///
    /// # Errors
    /// The exception of a gateway (V1.1b3, 7).
    pub(in crate::link) fn check(&self, unit_id: u8) -> Result<(), ExceptionCode> {
        if self.address.get().is_some_and(|breaker| breaker.is_open()) {
            return Err(ExceptionCode::GatewayPathUnavailable);
        }
        if self.units.borrow().get(&unit_id).is_some_and(Breaker::is_open) {
            return Err(ExceptionCode::GatewayTargetFailedToRespond);
        }
        Ok(())
    }

    /// Notes the outcome of a request. `is_unreachable` says that the address could not be reached.
    pub(in crate::link) fn record(
        &self,
        unit_id: u8,
        answered: Result<(), Fault>,
        is_unreachable: bool,
    ) {
        if answered.is_err() && is_unreachable {
            // At once: the connection itself was refused or is gone, and that is true for all units.
            let breaker = Breaker::after_failure(self.address.get(), 0, self.retry);
            return self.address.set(Some(breaker));
        }
        self.address.set(None);
        let mut units = self.units.borrow_mut();
        if answered == Err(Fault::Timeout) {
            let before = units.get(&unit_id).copied();
            let breaker = Breaker::after_failure(before, OPEN_AFTER_TIMEOUTS - 1, self.retry);
            units.insert(unit_id, breaker);
        } else {
            // An exception shows that the unit answers. Other failures say nothing about it.
            units.remove(&unit_id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SILENT: Result<(), Fault> = Err(Fault::Timeout);

    #[test]
    fn the_breaker_of_a_unit_opens_after_some_timeouts_and_those_of_others_do_not() {
        let breakers = CircuitBreakers::new(Retry::default());
        for _ in 1..OPEN_AFTER_TIMEOUTS {
            breakers.record(7, SILENT, false);
            assert_eq!(breakers.check(7), Ok(()));
        }
        breakers.record(7, SILENT, false);
        assert_eq!(breakers.check(7), Err(ExceptionCode::GatewayTargetFailedToRespond));
        assert_eq!(breakers.check(8), Ok(()));
        for answer in [Ok(()), Err(Fault::Exception(2))] {
            breakers.record(7, answer, false);
            assert_eq!(breakers.check(7), Ok(()));
        }
    }

    #[test]
    fn the_breaker_of_an_address_that_can_not_be_reached_opens_at_once() {
        let breakers = CircuitBreakers::new(Retry::default());
        breakers.record(7, Err(Fault::Refused), true);
        assert_eq!(breakers.check(8), Err(ExceptionCode::GatewayPathUnavailable));
        breakers.record(8, Ok(()), false);
        assert_eq!(breakers.check(7), Ok(()));
    }
}

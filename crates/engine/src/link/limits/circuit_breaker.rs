//! A circuit breaker for each unit, and one for the address of the link. While it is open, requests fail
//! fast, so that a unit that does not answer does not delay requests to the others.
//!
//! A breaker opens after failures in a row, for longer each time. The first request after that is the
//! test: a reply closes the breaker, a failure opens it again.
//!
//! Some devices are silent only about functions that they do not have. So the open breaker of a unit
//! concerns only functions that have timed out since the last answer of the unit.

use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::time::Duration;

use holdfast_runtime::Retry;
use tokio::time::Instant;

use crate::link::fault::Fault;

/// Timeouts in a row that open the breaker of a unit. One timeout says little: replies get lost.
pub(in crate::link) const OPEN_AFTER_TIMEOUTS: u32 = 3;

/// The longest time for which a breaker stays open. Clients wait for requests, unlike for polls.
const MAX_OPEN: Duration = Duration::from_secs(5);

pub(in crate::link) struct CircuitBreakers {
    retry: Retry,
    /// The breaker of each unit that is silent, and the functions that have timed out: bit N is
    /// function N.
    units: RefCell<HashMap<u8, (Breaker, u128)>>,
    address: Cell<Option<Breaker>>,
}

/// What can't be reached while a breaker is open.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Down {
    Address,
    Unit,
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

    /// Whether a request must fail fast.
    pub(in crate::link) fn check(&self, unit_id: u8, function: u8) -> Result<(), Down> {
        if self.address.get().is_some_and(|breaker| breaker.is_open()) {
            return Err(Down::Address);
        }
        match self.units.borrow().get(&unit_id) {
            Some((breaker, silent)) if silent & bit(function) != 0 && breaker.is_open() => {
                Err(Down::Unit)
            }
            _ => Ok(()),
        }
    }

    /// Notes the outcome of a request. `is_unreachable` says that the address could not be reached.
    pub(in crate::link) fn record(
        &self,
        (unit_id, function): (u8, u8),
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
            let (before, silent) = before.map_or((None, 0), |(before, of)| (Some(before), of));
            let breaker = Breaker::after_failure(before, OPEN_AFTER_TIMEOUTS - 1, self.retry);
            units.insert(unit_id, (breaker, silent | bit(function)));
        } else {
            // An exception shows that the unit answers. Other failures say nothing about it.
            units.remove(&unit_id);
        }
    }
}

/// Requests have functions up to 127.
fn bit(function: u8) -> u128 {
    1 << (function & 0x7F)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SILENT: Result<(), Fault> = Err(Fault::Timeout);

    /// The breakers after timeouts of function 3 that open the breaker of unit 7.
    fn silent() -> CircuitBreakers {
        let breakers = CircuitBreakers::new(Retry::default());
        for _ in 0..OPEN_AFTER_TIMEOUTS {
            assert_eq!(breakers.check(7, 3), Ok(()));
            breakers.record((7, 3), SILENT, false);
        }
        breakers
    }

    #[test]
    fn the_breaker_of_a_unit_opens_after_some_timeouts_and_those_of_others_do_not() {
        for answer in [Ok(()), Err(Fault::Exception(2))] {
            let breakers = silent();
            assert_eq!(breakers.check(7, 3), Err(Down::Unit));
            assert_eq!(breakers.check(8, 3), Ok(()));
            breakers.record((7, 3), answer, false);
            assert_eq!(breakers.check(7, 3), Ok(()));
        }
    }

    #[test]
    fn a_function_is_tried_until_it_has_timed_out_too() {
        let breakers = silent();
        assert_eq!(breakers.check(7, 6), Ok(()));
        breakers.record((7, 6), SILENT, false);
        assert_eq!(breakers.check(7, 6), Err(Down::Unit));
        assert_eq!(breakers.check(7, 16), Ok(()));
        breakers.record((7, 16), Ok(()), false);
        for function in [3, 6, 16] {
            assert_eq!(breakers.check(7, function), Ok(()), "the unit answers");
        }
    }

    #[test]
    fn the_breaker_of_an_address_that_can_not_be_reached_opens_at_once() {
        let breakers = CircuitBreakers::new(Retry::default());
        breakers.record((7, 3), Err(Fault::Refused), true);
        assert_eq!(breakers.check(8, 6), Err(Down::Address));
        breakers.record((8, 3), Ok(()), false);
        assert_eq!(breakers.check(7, 3), Ok(()));
    }
}

//! The health of a polled device: when it is in error, and when it is stale.

use std::time::Duration;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Health {
    /// The device has not been polled yet.
    #[default]
    Unknown,
    Ok,
    Error,
    /// The device answers, but its polls are late.
    Stale,
    /// The device is switched off in the configuration.
    Disabled,
    /// Another node polls the device.
    Standby,
}

impl Health {
    /// A device whose last poll succeeded is stale when its last answer is older than this: three
    /// intervals plus the timeout.
    pub(super) fn stale_after(interval: Duration, timeout: Duration) -> Duration {
        interval.saturating_mul(3).saturating_add(timeout)
    }

    /// The health of a device whose last poll ended like this, now that its last answer has this
    /// age.
    pub(super) fn at(self, age: Option<Duration>, stale_after: Duration) -> Health {
        match self {
            Health::Ok if age.is_some_and(|age| age > stale_after) => Health::Stale,
            other => other,
        }
    }

    /// # Panics
    /// For a code that no health has.
    pub(super) fn from_code(code: u16) -> Health {
        NAMES[usize::from(code)].0
    }

    pub const fn code(self) -> u16 {
        self as u16
    }

    pub const fn name(self) -> &'static str {
        NAMES[self as usize].1
    }
}

/// In the order of the codes.
const NAMES: [(Health, &str); 6] = [
    (Health::Unknown, "unknown"),
    (Health::Ok, "ok"),
    (Health::Error, "error"),
    (Health::Stale, "stale"),
    (Health::Disabled, "disabled"),
    (Health::Standby, "standby"),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_in_the_order_of_the_codes() {
        assert!((0..).zip(NAMES).all(|(code, (health, _))| health.code() == code));
        assert_eq!(NAMES.len(), usize::from(Health::Standby.code()) + 1);
    }
}

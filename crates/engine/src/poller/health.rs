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
        match code {
            0 => Health::Unknown,
            1 => Health::Ok,
            2 => Health::Error,
            3 => Health::Stale,
            4 => Health::Disabled,
            5 => Health::Standby,
            _ => unreachable!("no health has the code {code}"),
        }
    }

    pub const fn code(self) -> u16 {
        match self {
            Health::Unknown => 0,
            Health::Ok => 1,
            Health::Error => 2,
            Health::Stale => 3,
            Health::Disabled => 4,
            Health::Standby => 5,
        }
    }

    pub const fn name(self) -> &'static str {
        match self {
            Health::Unknown => "unknown",
            Health::Ok => "ok",
            Health::Error => "error",
            Health::Stale => "stale",
            Health::Disabled => "disabled",
            Health::Standby => "standby",
        }
    }
}

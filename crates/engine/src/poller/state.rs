//! Counters and health of a device: written by its task, read from any thread.

use std::sync::atomic::{AtomicBool, AtomicU16, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use holdfast_runtime::{Counter, Epoch, lock};

use super::health::Health;
use super::status::Status;
use crate::client::{ClientError, StrayCounters};
use crate::counter::counters;
use crate::link::{Fault, fault};

/// Counters and health of a device.
#[derive(Debug, Default)]
pub struct DeviceState {
    pub counters: DeviceCounters,
    /// The age, in milliseconds, at which the last answer is stale.
    stale_after: AtomicU64,
    health: AtomicU16,
    last_error: AtomicU16,
    failures: AtomicU32,
    most_failures: AtomicU32,
    /// The round trip of the last answer, in microseconds.
    round_trip: AtomicU64,
    requests_per_poll: AtomicU32,
    since: Mutex<Times>,
    plan_error: Mutex<Option<String>>,
    /// Why the last request that failed did.
    error: Mutex<Option<Arc<ClientError>>>,
    /// Whether a task of the device has panicked since the device was created or replaced.
    broken: AtomicBool,
    standby: AtomicBool,
    /// What the connection to its address has received without a request, or late.
    strays: Mutex<Arc<StrayCounters>>,
}

#[derive(Debug, Default)]
struct Times {
    last_good: Option<Epoch>,
    /// Since when the last poll has failed, or nothing is known.
    error_since: Option<Epoch>,
}

counters! {
    pub struct DeviceCounters {
        polls,
        /// Polls that could not begin in time.
        missed,
        /// Polls not carried out because the device has no plan.
        unplanned,
        requests,
        valid,
        exceptions,
        timeouts,
        transport_errors,
        /// Complete reads that were stored, or have no destination; and the values in them.
        reads,
        values,
        /// Reads and status blocks that memory refused.
        unstored,
        ;
        /// Polls that read everything.
        pub good_polls: Counter,
    }
}

impl DeviceState {
    pub(super) fn set_stale_after(&self, interval: Duration, timeout: Duration) {
        let after = Health::stale_after(interval, timeout).as_millis();
        self.stale_after.store(u64::try_from(after).unwrap_or(u64::MAX), Ordering::Relaxed);
    }

    pub fn health(&self) -> Health {
        if self.broken.load(Ordering::Relaxed) {
            return Health::Error;
        }
        if self.stands_by() {
            return Health::Standby;
        }
        let health = Health::from_code(self.health.load(Ordering::Relaxed));
        health.at(self.age(), self.stale_after())
    }

    /// The last error as in the status block: an exception code, or 0x8000 plus the number of a
    /// fault.
    pub fn last_error(&self) -> u16 {
        if self.broken.load(Ordering::Relaxed) {
            return Fault::Internal.code();
        }
        self.last_error.load(Ordering::Relaxed)
    }

    /// The error behind [`last_error`](DeviceState::last_error), if it is of a request.
    pub fn error(&self) -> Option<String> {
        let error = lock(&self.error).clone()?;
        (fault(&error).code() == self.last_error()).then(|| error.to_string())
    }

    pub(super) fn set_error(&self, error: Arc<ClientError>) {
        *lock(&self.error) = Some(error);
    }

    /// Why the device has no plan.
    pub fn plan_error(&self) -> Option<String> {
        lock(&self.plan_error).clone()
    }

    /// Records the number of requests of the plan, or why there is none.
    pub(super) fn planned(&self, requests: Result<usize, String>) {
        let count = *requests.as_ref().unwrap_or(&0);
        self.requests_per_poll.store(count as u32, Ordering::Relaxed);
        *lock(&self.plan_error) = requests.err();
    }

    /// Records whether a task of the device has panicked. If so, the device is in error until it is
    /// replaced.
    pub(super) fn set_broken(&self, broken: bool) {
        self.broken.store(broken, Ordering::Relaxed);
        if broken {
            self.bad(Fault::Internal);
        }
    }

    /// Counts a complete read of so many items that was stored, or has no destination.
    pub(super) fn count_read(&self, items: u32) {
        self.counters.reads.add();
        self.counters.values.add_many(items.into());
    }

    /// What the connection to its address has received without a request, or late. Devices at one address
    /// share it.
    pub fn strays(&self) -> Arc<StrayCounters> {
        Arc::clone(&lock(&self.strays))
    }

    /// Whether another node polls the device.
    pub(super) fn stands_by(&self) -> bool {
        self.standby.load(Ordering::Relaxed)
    }

    /// Records whether another node polls the device. What was known before is old when it comes back.
    pub(super) fn set_standby(&self, standby: bool) {
        if !standby {
            self.health.store(Health::Unknown.code(), Ordering::Relaxed);
            self.times().error_since = Some(Epoch::now());
        }
        self.standby.store(standby, Ordering::Relaxed);
    }

    pub(super) fn set_strays(&self, strays: &Arc<StrayCounters>) {
        *lock(&self.strays) = Arc::clone(strays);
    }

    pub fn failures(&self) -> u32 {
        self.failures.load(Ordering::Relaxed)
    }

    pub fn round_trip(&self) -> Duration {
        Duration::from_micros(self.round_trip.load(Ordering::Relaxed))
    }

    pub fn requests_per_poll(&self) -> u32 {
        self.requests_per_poll.load(Ordering::Relaxed)
    }

    /// The time since the last valid answer.
    pub fn age(&self) -> Option<Duration> {
        self.times().last_good.map(|time| time.elapsed())
    }

    /// The time since the device is in error; before its first complete poll, since it is polled.
    pub fn in_error(&self) -> Duration {
        match self.times().error_since {
            Some(time) if !self.stands_by() => time.elapsed(),
            _ => Duration::ZERO,
        }
    }

    fn stale_after(&self) -> Duration {
        Duration::from_millis(self.stale_after.load(Ordering::Relaxed))
    }

    fn times(&self) -> std::sync::MutexGuard<'_, Times> {
        lock(&self.since)
    }

    /// Records that polling begins. A device that was in error before still is.
    pub(super) fn begun(&self) {
        if Health::from_code(self.health.load(Ordering::Relaxed)) == Health::Unknown {
            self.times().error_since.get_or_insert_with(Epoch::now);
        }
    }

    /// Records a valid answer.
    pub(super) fn answered(&self, round_trip: Duration) {
        self.counters.valid.add();
        self.round_trip.store(round_trip.as_micros() as u64, Ordering::Relaxed);
        self.times().last_good = Some(Epoch::now());
    }

    /// Records a complete poll.
    pub(super) fn good(&self) {
        self.counters.good_polls.add();
        self.times().error_since = None;
        self.failures.store(0, Ordering::Relaxed);
        self.health.store(Health::Ok.code(), Ordering::Relaxed);
    }

    pub(super) fn bad(&self, fault: Fault) {
        self.times().error_since.get_or_insert_with(Epoch::now);
        self.health.store(Health::Error.code(), Ordering::Relaxed);
        self.last_error.store(fault.code(), Ordering::Relaxed);
        let failures = self.failures.fetch_add(1, Ordering::Relaxed) + 1;
        self.most_failures.fetch_max(failures, Ordering::Relaxed);
    }

    pub(super) fn status(&self) -> Status {
        let counters = &self.counters;
        Status {
            health: self.health(),
            last_error: self.last_error(),
            seconds_in_error: saturated(self.in_error().as_secs()),
            polls: counters.polls.get() as u32,
            good_polls: counters.good_polls.get() as u32,
            timeouts: counters.timeouts.get() as u32,
            transport_errors: counters.transport_errors.get() as u32,
            failures: saturated(self.failures().into()),
            most_failures: saturated(self.most_failures.load(Ordering::Relaxed).into()),
        }
    }
}

fn saturated(number: u64) -> u16 {
    u16::try_from(number).unwrap_or(u16::MAX)
}

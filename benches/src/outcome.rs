//! The result of a load.

use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use rustix::time::{ClockId, clock_gettime};

use crate::{Failure, seconds};

/// The duration of a load: a warm-up, then the measured time.
#[derive(Clone, Copy)]
pub(crate) struct Period {
    warmup: Duration,
    measured: Duration,
}

impl Period {
    pub(crate) const DEFAULT: Period =
        Period { warmup: Duration::from_millis(300), measured: Duration::from_secs(2) };

    /// Parses `--warmup` and `--seconds`.
    pub(crate) fn set(&mut self, name: &str, value: &str) -> Result<bool, Failure> {
        match name {
            "warmup" => self.warmup = seconds(value)?,
            "seconds" => self.measured = seconds(value)?,
            _ => return Ok(false),
        }
        Ok(true)
    }
}

pub(crate) struct Outcome {
    began: Instant,
    cpu_before: f64,
    period: Period,
    busy: f64,
    latencies: Histogram<u64>,
    /// Requests with a reply, inside the measured time or not.
    answered: usize,
}

impl Outcome {
    /// Starts the period.
    pub(crate) fn new(period: Period) -> Result<Outcome, Failure> {
        let latencies = Histogram::new_with_bounds(1, 60_000_000_000, 3)?;
        let (began, cpu_before) = (Instant::now(), cpu_seconds());
        Ok(Outcome { began, cpu_before, period, busy: 0.0, latencies, answered: 0 })
    }

    /// The end of the period.
    pub(crate) fn end(&self) -> Instant {
        self.began + self.period.warmup + self.period.measured
    }

    /// Records `count` replies that arrived at `now`.
    pub(crate) fn record(
        &mut self,
        sent: Instant,
        now: Instant,
        count: usize,
    ) -> Result<(), Failure> {
        self.answered += count;
        if now >= self.began + self.period.warmup && now < self.end() {
            self.latencies.record_n((now - sent).as_nanos() as u64, count as u64)?;
        }
        Ok(())
    }

    /// Records replies after the end of the period.
    pub(crate) fn late(&mut self, count: usize) {
        self.answered += count;
    }

    /// Ends the period, and records the share of it that the load was busy.
    pub(crate) fn ended(&mut self) {
        self.busy = (cpu_seconds() - self.cpu_before) / self.began.elapsed().as_secs_f64();
    }

    /// Prints the rate, latencies in microseconds and processor time as JSON.
    pub(crate) fn report(&self) {
        let micros = |nanos: u64| nanos as f64 / 1e3;
        let at = |quantile| micros(self.latencies.value_at_quantile(quantile));
        let (requests, seconds) = (self.latencies.len(), self.period.measured.as_secs_f64());
        println!(
            r#"{{"requests": {requests}, "answered": {}, "seconds": {seconds}, "rate": {:.1}, "p50": {:.2}, "p99": {:.2}, "p999": {:.2}, "max": {:.2}, "cpu": {:.3}, "busy": {:.3}}}"#,
            self.answered,
            requests as f64 / seconds,
            at(0.5),
            at(0.99),
            at(0.999),
            micros(self.latencies.max()),
            cpu_seconds(),
            self.busy,
        );
    }
}

/// The processor time of this process.
fn cpu_seconds() -> f64 {
    let cpu = clock_gettime(ClockId::ProcessCPUTime);
    cpu.tv_sec as f64 + cpu.tv_nsec as f64 / 1e9
}

//! Heartbeats: whether a thread that runs tasks still gets to them.

use std::fs;
use std::pin::pin;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use tokio::time::{MissedTickBehavior, interval};

/// The time between two beats.
const PERIOD: Duration = Duration::from_secs(1);

/// The heartbeat of a thread. Reading it never waits for that thread.
#[derive(Debug)]
pub struct Heartbeat {
    thread: String,
    began: Instant,
    /// Milliseconds from `began` to the last beat.
    last: AtomicU64,
    /// The number that the system has for the thread, if it tells it.
    id: OnceLock<Option<u32>>,
}

impl Heartbeat {
    /// The heartbeat of the thread with this name. Creating it is the first beat.
    pub(crate) fn new(thread: impl Into<String>) -> Heartbeat {
        let (thread, began) = (thread.into(), Instant::now());
        Heartbeat { thread, began, last: AtomicU64::new(0), id: OnceLock::new() }
    }

    /// Beats while `work` runs. Call it in the thread that the heartbeat is of, with a runtime that
    /// has timers: a task that keeps the thread keeps it from beating.
    pub(crate) async fn during<T>(&self, work: impl Future<Output = T>) -> T {
        self.id.get_or_init(own_id);
        let mut work = pin!(work);
        let mut ticks = interval(PERIOD);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                biased;
                _ = ticks.tick() => self.beat(),
                done = &mut work => return done,
            }
        }
    }

    fn beat(&self) {
        self.last.store(self.began.elapsed().as_millis() as u64, Ordering::Relaxed);
    }

    pub fn thread(&self) -> &str {
        &self.thread
    }

    /// The time since the last beat.
    pub fn age(&self) -> Duration {
        let last = Duration::from_millis(self.last.load(Ordering::Relaxed));
        self.began.elapsed().saturating_sub(last)
    }

    /// The number that Linux has for the thread; `None` elsewhere, and before the thread has begun.
    pub fn thread_id(&self) -> Option<u32> {
        self.id.get().copied().flatten()
    }
}

/// The number of this thread. Linux tells it as a link to `PID/task/TID`.
fn own_id() -> Option<u32> {
    fs::read_link("/proc/thread-self").ok()?.file_name()?.to_str()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::mpsc::channel;
    use std::thread;

    use tokio::runtime::Builder;

    use super::*;

    fn until(condition: impl Fn() -> bool) {
        let deadline = Instant::now() + Duration::from_secs(60);
        while !condition() {
            assert!(Instant::now() < deadline, "the condition does not come true");
            thread::sleep(Duration::from_millis(10));
        }
    }

    #[test]
    fn a_task_that_keeps_the_thread_keeps_it_from_beating() {
        let heartbeat = Arc::new(Heartbeat::new("worker"));
        let (keep, kept) = channel::<()>();
        let (begin, begun) = tokio::sync::oneshot::channel::<()>();
        let (end, ended) = tokio::sync::oneshot::channel::<()>();
        let own = Arc::clone(&heartbeat);
        let worker = thread::spawn(move || {
            let runtime = Builder::new_current_thread().enable_time().build().unwrap();
            runtime.block_on(own.during(async move {
                let _ = begun.await;
                let _ = kept.recv();
                let _ = ended.await;
            }));
        });
        let beats = |heartbeat: &Heartbeat| heartbeat.last.load(Ordering::Relaxed);
        until(|| beats(&heartbeat) >= 1000);
        begin.send(()).unwrap();
        until(|| heartbeat.age() > 3 * PERIOD);
        let before = beats(&heartbeat);
        drop(keep);
        until(|| beats(&heartbeat) > before);
        drop(end);
        worker.join().unwrap();
        assert_eq!(heartbeat.thread(), "worker");
        assert_eq!(heartbeat.thread_id().is_some(), cfg!(target_os = "linux"));
    }
}

//! Fences: until when devices may be used. The holder of the lease of a device moves the end of its fence;
//! when that passes without a renewal, nothing is sent to the device any more, not even by a process that
//! was stopped in between.
//!
//! The end is compared with the clock at the last moment before bytes are sent. It is not enough that a
//! task closes the connection when the time is over: after a stop of the process, others may run first.

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::time::{Duration, Instant};

use holdfast_memory::{
    Access, Done, Memory, Operation, Outcome, Refusal, Refused, Tenure, Term, Write,
};
use holdfast_runtime::lock;
use tokio::sync::watch;
use tokio::time::sleep_until;

/// Added to an epoch that a log takes for an earlier one. Epochs are seconds of Unix time, and much smaller.
const FORCED_EPOCH: u64 = 1 << 40;

/// What a fence allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// Nothing is sent, and connections are closed.
    Closed,
    /// Running polls may finish; no new ones begin.
    Ending,
    Open,
}

/// Until when devices may be used. It begins closed.
#[derive(Debug)]
pub struct Fence {
    /// The number of the lease, the same on all nodes.
    lease: u64,
    /// Since when this node has the lease, or had it last.
    term: Mutex<Term>,
    /// The zero of all times.
    zero: Instant,
    /// In nanoseconds after `zero`; 0 if it was never opened, or is closed.
    until: AtomicU64,
    /// When requests of a former holder arrive no more, not counting the timeout of the device.
    settles: AtomicU64,
    is_ending: AtomicBool,
    /// Polls, writes and connections.
    in_use: AtomicUsize,
    stage: watch::Sender<Stage>,
}

/// A use of the devices behind a fence, while it lasts.
#[derive(Debug)]
pub struct Pass(Arc<Fence>);

impl Fence {
    /// The fence of the lease with this number.
    pub fn new(lease: u64) -> Fence {
        Fence {
            lease,
            term: Mutex::default(),
            zero: Instant::now(),
            until: AtomicU64::new(0),
            settles: AtomicU64::new(0),
            is_ending: AtomicBool::new(false),
            in_use: AtomicUsize::new(0),
            stage: watch::Sender::new(Stage::Closed),
        }
    }

    /// Opens it for a term. What a former holder has sent may still arrive for `settle`, and the timeout of a
    /// device.
    pub fn open(&self, until: Instant, term: Term, settle: Duration) {
        let settles = if settle.is_zero() { 0 } else { self.time(Instant::now() + settle) };
        self.settles.store(settles, Ordering::Release);
        *lock(&self.term) = term;
        self.is_ending.store(false, Ordering::Release);
        self.until.store(self.time(until), Ordering::Release);
        self.announce();
    }

    /// Moves the end, never to an earlier time. Without effect if it was closed.
    pub fn renew(&self, until: Instant) {
        let until = self.time(until);
        let moved = self.until.fetch_update(Ordering::AcqRel, Ordering::Acquire, |before| {
            (before > 0).then_some(before.max(until))
        });
        if moved.is_ok() {
            self.announce();
        }
    }

    /// Lets running polls finish, and no new ones begin. Go on to renew it meanwhile.
    pub fn end(&self) {
        self.is_ending.store(true, Ordering::Release);
        self.announce();
    }

    pub fn close(&self) {
        self.until.store(0, Ordering::Release);
        self.announce();
    }

    pub fn stage(&self) -> Stage {
        if self.time(Instant::now()) >= self.until.load(Ordering::Acquire) {
            Stage::Closed
        } else if self.is_ending.load(Ordering::Acquire) {
            Stage::Ending
        } else {
            Stage::Open
        }
    }

    /// Whether bytes may be sent now.
    pub fn allows(&self) -> bool {
        self.stage() != Stage::Closed
    }

    /// Under which term to write what a device holds into a log, and who receives the outcome in place of `done`.
    fn tenure(self: &Arc<Fence>, done: Done) -> (Tenure, Done) {
        let tenure = Tenure { lease: self.lease, term: *lock(&self.term) };
        let fence = Arc::clone(self);
        let noted = move |outcome: Outcome| {
            if matches!(outcome, Err(Refused { refusal: Refusal::Overtaken, .. })) {
                fence.overtaken(tenure.term);
            }
            done(outcome);
        };
        (tenure, Box::new(noted))
    }

    /// A log has a later term. If this node has the lease all the same, what counts terms has begun anew, or was
    /// set back: with a greater epoch, the next step is carried out, or one of the next.
    fn overtaken(&self, sent: Term) {
        let mut term = lock(&self.term);
        if *term == sent && self.allows() {
            term.epoch = term.epoch.saturating_mul(2).max(term.epoch.saturating_add(FORCED_EPOCH));
        }
    }

    /// The number of polls, writes and connections.
    pub fn in_use(&self) -> usize {
        self.in_use.load(Ordering::Acquire)
    }

    /// From when on nothing of a former holder can arrive at a device with this timeout any more. `None` if that is
    /// so now.
    pub(crate) fn settles_at(&self, timeout: Duration) -> Option<Instant> {
        let settles = self.settles.load(Ordering::Acquire);
        let at = (settles > 0).then(|| self.zero + Duration::from_nanos(settles) + timeout);
        at.filter(|at| Instant::now() < *at)
    }

    /// Waits until nothing of a former holder can arrive any more; `None` if the device may not be used.
    pub(crate) async fn admit_write(self: &Arc<Fence>, timeout: Duration) -> Option<Pass> {
        while self.stage() == Stage::Open {
            let Some(at) = self.settles_at(timeout) else { return Some(self.pass()) };
            tokio::select! {
                () = self.ended() => {}
                () = sleep_until(at.into()) => {}
            }
        }
        None
    }

    pub(crate) fn pass(self: &Arc<Fence>) -> Pass {
        self.in_use.fetch_add(1, Ordering::AcqRel);
        Pass(Arc::clone(self))
    }

    /// Waits until it is open.
    pub(crate) async fn opened(&self) {
        self.wait(|stage| stage == Stage::Open).await;
    }

    /// Waits until no poll may begin.
    pub(crate) async fn ended(&self) {
        self.wait(|stage| stage != Stage::Open).await;
    }

    /// Waits until nothing may be sent.
    pub(crate) async fn closed(&self) {
        self.wait(|stage| stage == Stage::Closed).await;
    }

    async fn wait(&self, is_reached: impl Fn(Stage) -> bool) {
        let mut stage = self.stage.subscribe();
        // The announced stage may be out of date: the clock decides.
        while !is_reached(self.stage()) {
            if is_reached(*stage.borrow_and_update()) {
                self.announce();
            }
            // The sender is a part of the fence.
            let _ = stage.changed().await;
        }
    }

    fn announce(&self) {
        self.stage.send_if_modified(|announced| {
            let now = self.stage();
            std::mem::replace(announced, now) != now
        });
    }

    /// Announces that the end has passed. Runs while there is a fence.
    pub(crate) async fn watch(fence: Weak<Fence>) {
        let Some(mut stage) = fence.upgrade().map(|fence| fence.stage.subscribe()) else { return };
        loop {
            let Some(found) = fence.upgrade() else { return };
            stage.mark_unchanged();
            found.announce();
            let until = found.zero + Duration::from_nanos(found.until.load(Ordering::Acquire));
            // Not the clock: if the end passes now, it still has to be announced.
            let is_closed = *stage.borrow() == Stage::Closed;
            drop(found);
            if is_closed {
                if stage.changed().await.is_err() {
                    return;
                }
            } else {
                sleep_until(until.into()).await;
            }
        }
    }

    fn time(&self, instant: Instant) -> u64 {
        let nanos = instant.saturating_duration_since(self.zero).as_nanos();
        u64::try_from(nanos).unwrap_or(u64::MAX)
    }
}

/// Gives what a device holds to the journal of a memory. The log of a replicated one refuses it if another node has
/// taken over the lease since.
pub(crate) fn submit_under(
    fence: Option<&Arc<Fence>>,
    memory: &Memory,
    access: Access,
    write: Write<'_>,
    done: Done,
) -> Result<(), Refusal> {
    let (tenure, done) = match fence.filter(|_| memory.is_replicated()) {
        None => (None, done),
        Some(fence) => {
            let (tenure, done) = fence.tenure(done);
            (Some(tenure), done)
        }
    };
    memory.submit_under(tenure, access, Operation::Write(&[write]), done)
}

impl Pass {
    pub(crate) fn fence(&self) -> &Arc<Fence> {
        &self.0
    }
}

impl Drop for Pass {
    fn drop(&mut self) {
        self.0.in_use.fetch_sub(1, Ordering::AcqRel);
    }
}

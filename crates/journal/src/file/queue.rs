//! The steps that wait to be stored.

use std::mem;
use std::process;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use holdfast_memory::{Action, Done, Journal, Memory, Refusal, Refused, Step};
use holdfast_runtime::lock;

use super::status::Status;

/// A step, and the receiver of its outcome.
pub(super) struct QueuedStep {
    pub step: Step,
    pub done: Done,
}

/// The journal of the memories of a file.
#[derive(Debug)]
pub(super) struct Queue {
    state: Mutex<State>,
    changed: Condvar,
    limits: QueueLimits,
    status: Arc<Mutex<Status>>,
    /// A forked child has no thread that takes steps.
    process: u32,
}

/// How many steps, and how many bytes of steps, may wait. One step always may.
#[derive(Debug, Clone, Copy)]
pub struct QueueLimits {
    pub steps: usize,
    pub bytes: usize,
}

impl QueueLimits {
    pub(super) const DEFAULT: QueueLimits = QueueLimits { steps: 4096, bytes: 16 << 20 };
}

struct State {
    phase: Phase,
    waiting: Vec<QueuedStep>,
    bytes: usize,
    /// How many steps were taken and are not answered: the disk may keep them waiting.
    taken: usize,
}

#[derive(Debug)]
enum Phase {
    /// Nothing is stored yet: steps are carried out at once.
    Loading(Vec<Arc<Memory>>),
    Running,
    /// Steps that wait are stored, others refused.
    Stopping,
    Ended,
}

/// What is to be done next.
pub(super) enum Next {
    Steps(Vec<QueuedStep>),
    /// Nothing happened in the given time.
    Idle,
    /// Nothing waits any more, and nothing will.
    Stop,
}

impl Queue {
    pub fn new(
        memories: Vec<Arc<Memory>>,
        limits: QueueLimits,
        status: Arc<Mutex<Status>>,
    ) -> Queue {
        let phase = Phase::Loading(memories);
        let state = Mutex::new(State { phase, waiting: Vec::new(), bytes: 0, taken: 0 });
        let process = process::id();
        Queue { state, changed: Condvar::new(), limits, status, process }
    }

    /// Lets steps wait from now on, if `store` stores what the memories contain now.
    pub fn begin<E>(&self, store: impl FnOnce() -> Result<(), E>) -> Result<(), E> {
        let mut state = lock(&self.state);
        if matches!(state.phase, Phase::Loading(_)) {
            store()?;
            state.phase = Phase::Running;
        }
        Ok(())
    }

    /// Refuses steps from now on. Those that wait are still stored.
    pub fn stop(&self) {
        let mut state = lock(&self.state);
        state.phase = match state.phase {
            Phase::Running | Phase::Stopping => Phase::Stopping,
            Phase::Loading(_) | Phase::Ended => Phase::Ended,
        };
        drop(state);
        self.changed.notify_all();
    }

    /// Refuses all steps, also those that wait.
    pub fn end(&self) {
        let mut state = lock(&self.state);
        state.phase = Phase::Ended;
        (state.bytes, state.taken) = (0, 0);
        let waiting = mem::take(&mut state.waiting);
        drop(state);
        self.refuse(waiting.into_iter().map(|each| each.done), Refusal::Unavailable);
    }

    /// Waits until there is something to do, or for this time.
    pub fn next(&self, timeout: Duration) -> Next {
        let is_idle =
            |state: &mut State| state.waiting.is_empty() && matches!(state.phase, Phase::Running);
        let state = self.changed.wait_timeout_while(lock(&self.state), timeout, is_idle);
        let (mut state, _) = state.unwrap_or_else(PoisonError::into_inner);
        if !state.waiting.is_empty() {
            (state.bytes, state.taken) = (0, state.waiting.len());
            return Next::Steps(mem::take(&mut state.waiting));
        }
        if is_idle(&mut state) { Next::Idle } else { Next::Stop }
    }

    /// Notes, before they are answered, that the steps that were taken do not wait any more.
    pub fn stored(&self) {
        lock(&self.state).taken = 0;
    }

    /// How many steps wait, also those that are being stored.
    pub fn waiting(&self) -> usize {
        let state = lock(&self.state);
        state.waiting.len() + state.taken
    }

    /// Answers and counts steps that were not carried out.
    pub fn refuse(&self, steps: impl ExactSizeIterator<Item = Done>, refusal: Refusal) {
        let mut status = lock(&self.status);
        let counter = if refusal == Refusal::Busy { &mut status.busy } else { &mut status.refused };
        *counter += steps.len() as u64;
        drop(status);
        for done in steps {
            done(Err(Refused { index: 0, refusal }));
        }
    }
}

impl Journal for Queue {
    fn submit(&self, step: Step, done: Done) {
        if self.process != process::id() {
            return done(Err(Refused { index: 0, refusal: Refusal::Unavailable }));
        }
        let mut state = lock(&self.state);
        let refusal = match &state.phase {
            Phase::Loading(memories) => {
                let outcome = step.carry_out(memories);
                drop(state);
                return done(outcome);
            }
            Phase::Stopping | Phase::Ended => Refusal::Unavailable,
            Phase::Running => {
                let bytes = state.bytes + size(&step);
                let fits = state.waiting.len() < self.limits.steps && bytes <= self.limits.bytes;
                // A step that is larger than the queue waits alone.
                if fits || state.waiting.is_empty() {
                    state.bytes = bytes;
                    state.waiting.push(QueuedStep { step, done });
                    drop(state);
                    return self.changed.notify_one();
                }
                Refusal::Busy
            }
        };
        drop(state);
        self.refuse(std::iter::once(done), refusal);
    }
}

/// About how many bytes a step needs.
fn size(step: &Step) -> usize {
    let writes = match &step.action {
        Action::Write(writes) => &writes[..],
        Action::Mask { .. } => &[],
        Action::WriteThenRead { write, .. } => std::slice::from_ref(write),
    };
    let of_writes = writes.iter().map(|write| mem::size_of_val(write) + write.bytes.len());
    mem::size_of::<QueuedStep>() + of_writes.sum::<usize>()
}

impl std::fmt::Debug for State {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let State { phase, waiting, bytes, taken } = self;
        write!(f, "{phase:?}, {} steps of {bytes} bytes, {taken} taken", waiting.len())
    }
}

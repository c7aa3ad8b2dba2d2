//! What the thread of a log shares with writers, readers and the status.

use std::collections::VecDeque;
use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use holdfast_memory::{Contents, Done, Journal, Refusal, Refused, Step};
use holdfast_runtime::{Counter, lock};
use tokio::sync::Notify;

use super::clock::{Clock, Moment};
use super::error::LogError;
use super::settings::Settings;
use super::status::{Counters, Event, NodeStatus, Phase, View};
use super::stream::message::STEP_LEN_BYTES;
use super::stream::message_limit::MessageLimit;
use crate::encoding;

/// The most steps that wait to be sent, and their bytes.
const MAX_QUEUE_STEPS: usize = 4096;
const MAX_QUEUE_BYTES: usize = 64 << 20;

/// The most events that wait to be taken. Then the oldest are dropped.
const MAX_EVENTS: usize = 1000;

/// What the contents can be used for, in [`Shared::usability`].
const USABLE: u8 = 0;
/// They are wrong.
const DIFFERS: u8 = 1;
/// A snapshot is being loaded.
const LOADING: u8 = 2;

pub(super) struct Shared {
    pub(super) clock: Clock,
    refuses_when_behind: bool,
    max_lag: Duration,
    write_timeout: Duration,
    /// [`USABLE`], [`DIFFERS`] or [`LOADING`].
    usability: AtomicU8,
    /// The contents have been current at this [`Moment`], in nanoseconds. 0 means never.
    contact: AtomicU64,
    /// The longest encoded step that the servers accept, in bytes.
    max_step_bytes: AtomicUsize,
    pub(super) message_limit: MessageLimit,
    stopping: AtomicBool,
    queue: Mutex<Queue>,
    pub(super) step_arrived: Notify,
    pub(super) counters: Counters,
    progress: Mutex<Progress>,
    progress_changed: Condvar,
    /// Held by the caller that requests a checkpoint: an answer is for one only.
    requesting: Mutex<()>,
    exchange: Mutex<Exchange>,
    checkpoint_answered: Condvar,
}

/// The contents of the memories after one message, in the order of their names, and a note about them.
pub type Checkpoint = (Vec<Contents>, Vec<u8>);

/// How the thread of the log hands a checkpoint to the file.
#[derive(Default)]
enum Exchange {
    #[default]
    Idle,
    /// The file waits for it.
    Requested,
    /// `None` if the contents are not right.
    Given(Option<Checkpoint>),
    /// The log has ended: this stays the answer.
    Ended(Option<Checkpoint>),
}

#[derive(Default)]
struct Queue {
    is_open: bool,
    steps: VecDeque<UnsentStep>,
    bytes: usize,
}

/// A step that was not sent yet.
pub(super) struct UnsentStep {
    pub(super) bytes: Vec<u8>,
    pub(super) done: Done,
    pub(super) until: Instant,
}

#[derive(Default)]
struct Progress {
    view: View,
    events: VecDeque<Event>,
}

impl fmt::Debug for Shared {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Shared").finish_non_exhaustive()
    }
}

impl Journal for Shared {
    fn submit(&self, step: Step, done: Done) {
        let mut bytes = Vec::new();
        encoding::encode(&step, &mut bytes);
        // The servers would end the connection: no later attempt could succeed either.
        let most = self.max_step_bytes.load(Ordering::Relaxed);
        if bytes.len() > most {
            self.counters.too_large.add();
            return refuse(done, Refusal::TooLarge { bytes: bytes.len(), most });
        }
        let mut queue = lock(&self.queue);
        let fits =
            queue.steps.len() < MAX_QUEUE_STEPS && queue.bytes + bytes.len() <= MAX_QUEUE_BYTES;
        if !queue.is_open || !fits {
            let refusal = if queue.is_open { Refusal::Busy } else { Refusal::Unavailable };
            drop(queue);
            self.counters.unavailable.add();
            return refuse(done, refusal);
        }
        queue.bytes += bytes.len();
        let until = Instant::now() + self.write_timeout;
        queue.steps.push_back(UnsentStep { bytes, done, until });
        drop(queue);
        self.step_arrived.notify_one();
    }

    fn guards(&self) -> bool {
        true
    }

    fn admit(&self) -> Result<(), Refusal> {
        match self.usability.load(Ordering::Acquire) {
            USABLE if self.refuses_when_behind && self.is_behind() => Err(Refusal::Behind),
            USABLE => Ok(()),
            LOADING => Err(Refusal::Behind),
            _ => Err(Refusal::Differs),
        }
    }
}

impl Shared {
    pub(super) fn new(settings: &Settings) -> Shared {
        Shared {
            clock: Clock::default(),
            refuses_when_behind: settings.refuses_when_behind,
            max_lag: settings.max_lag,
            write_timeout: settings.write_timeout,
            usability: AtomicU8::new(USABLE),
            contact: AtomicU64::new(0),
            max_step_bytes: AtomicUsize::new(usize::MAX),
            message_limit: MessageLimit::default(),
            stopping: AtomicBool::new(false),
            queue: Mutex::default(),
            step_arrived: Notify::new(),
            counters: Counters::default(),
            progress: Mutex::default(),
            progress_changed: Condvar::new(),
            requesting: Mutex::default(),
            exchange: Mutex::default(),
            checkpoint_answered: Condvar::new(),
        }
    }

    /// The clock is asked at each read: a process that was stopped notices it then.
    fn is_behind(&self) -> bool {
        self.contact_age().is_none_or(|age| age > self.max_lag)
    }

    /// How long ago the contents were current for sure.
    pub(super) fn contact_age(&self) -> Option<Duration> {
        let contact = Moment::from_nanos(self.contact.load(Ordering::Acquire));
        contact.map(|contact| self.now().since(contact))
    }

    /// How long ago, at most, the log has taken the message that is applied next: it has taken it after the
    /// last one of this node that was applied, and its own not before it was sent. `None` before there
    /// was one, while the node only replays what others have sent.
    pub(super) fn age_since(&self, first_sent: Option<Moment>) -> Option<Duration> {
        let contact = Moment::from_nanos(self.contact.load(Ordering::Acquire));
        contact.max(first_sent).map(|moment| self.now().since(moment))
    }

    /// The contents have all that the log had at this time.
    pub(super) fn contact(&self, at: Moment) {
        self.contact.fetch_max(at.as_nanos(), Ordering::Release);
    }

    pub(super) fn now(&self) -> Moment {
        self.clock.now()
    }

    /// Takes steps from now on.
    pub(super) fn open(&self, max_step_bytes: usize) {
        self.max_step_bytes.store(max_step_bytes, Ordering::Relaxed);
        lock(&self.queue).is_open = !self.is_stopping();
    }

    /// Refuses steps from now on, and those that were not sent.
    pub(super) fn close(&self) {
        let mut queue = lock(&self.queue);
        queue.is_open = false;
        queue.bytes = 0;
        let steps = std::mem::take(&mut queue.steps);
        drop(queue);
        let steps = steps.into_iter().map(|waiting| waiting.done).collect();
        refuse_all(steps, Refusal::Unavailable, &self.counters.unavailable);
    }

    /// Refuses steps that have waited too long and were not sent.
    pub(super) fn expire(&self, now: Instant) {
        let mut late = Vec::new();
        let mut queue = lock(&self.queue);
        while queue.steps.front().is_some_and(|first| first.until <= now) {
            if let Some(waiting) = queue.steps.pop_front() {
                queue.bytes -= waiting.bytes.len();
                late.push(waiting.done);
            }
        }
        drop(queue);
        refuse_all(late, Refusal::Unavailable, &self.counters.unavailable);
    }

    /// Takes steps for one message: as many as `room` has bytes for, and at least one.
    pub(super) fn take(&self, room: usize) -> Vec<UnsentStep> {
        let mut queue = lock(&self.queue);
        let (mut count, mut len) = (0, 0);
        for waiting in &queue.steps {
            len += waiting.bytes.len() + STEP_LEN_BYTES;
            // The first always: a step longer than `room` is sent alone.
            if count > 0 && len > room {
                break;
            }
            count += 1;
        }
        let taken: Vec<UnsentStep> = queue.steps.drain(..count).collect();
        queue.bytes -= taken.iter().map(|waiting| waiting.bytes.len()).sum::<usize>();
        taken
    }

    /// While contents are replaced, reads are refused.
    pub(super) fn set_loading(&self, is_loading: bool) {
        let (from, to) = if is_loading { (USABLE, LOADING) } else { (LOADING, USABLE) };
        // If the contents differ, they stay unusable until a comparison shows that they are right.
        let _ = self.usability.compare_exchange(from, to, Ordering::AcqRel, Ordering::Acquire);
    }

    pub(super) fn stop(&self) {
        self.stopping.store(true, Ordering::Release);
        self.close();
        self.step_arrived.notify_one();
    }

    pub(super) fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Acquire)
    }

    /// The log can't go on. If it has served, its contents are not to be used any more.
    pub(super) fn fail(&self, error: LogError) {
        self.usability.store(DIFFERS, Ordering::Release);
        self.event(Event::new(
            "log_failed",
            &[("kind", error.kind()), ("reason", &error.to_string())],
        ));
        self.update(|view| {
            view.server = None;
            view.phase = Phase::Failed(error);
        });
    }

    /// The contents are wrong. They are replaced, and reads are refused until they are right.
    pub(super) fn drop_contents(&self, error: LogError) {
        self.usability.store(DIFFERS, Ordering::Release);
        self.event(Event::new("log_contents_dropped", &[("reason", &error.to_string())]));
        self.update(|view| {
            (view.server, view.digest) = (None, None);
            view.phase = Phase::Returning(error);
        });
    }

    /// The contents in place of the wrong ones are right.
    pub(super) fn restored(&self) {
        self.usability.store(USABLE, Ordering::Release);
        self.update(|view| {
            view.phase = Phase::Running;
            view.last_error = None;
        });
    }

    /// Requests a checkpoint from the thread of the log, and waits for it, at most for this time.
    pub(super) fn checkpoint(&self, timeout: Duration) -> Option<Checkpoint> {
        let _alone = lock(&self.requesting);
        let mut exchange = lock(&self.exchange);
        if !matches!(*exchange, Exchange::Ended(_)) {
            *exchange = Exchange::Requested;
        }
        let is_open = |exchange: &mut Exchange| matches!(exchange, Exchange::Requested);
        let waited = self.checkpoint_answered.wait_timeout_while(exchange, timeout, is_open);
        let mut exchange = waited.unwrap_or_else(PoisonError::into_inner).0;
        if let Exchange::Ended(last) = &*exchange {
            return last.clone();
        }
        match std::mem::take(&mut *exchange) {
            Exchange::Given(checkpoint) => checkpoint,
            // The thread took too long. Its answer would be ignored.
            _ => None,
        }
    }

    pub(super) fn is_checkpoint_requested(&self) -> bool {
        matches!(*lock(&self.exchange), Exchange::Requested)
    }

    pub(super) fn give_checkpoint(&self, checkpoint: Option<Checkpoint>) {
        self.answer(Exchange::Given(checkpoint));
    }

    /// The thread of the log ends.
    pub(super) fn give_last_checkpoint(&self, checkpoint: Option<Checkpoint>) {
        self.answer(Exchange::Ended(checkpoint));
    }

    fn answer(&self, answer: Exchange) {
        *lock(&self.exchange) = answer;
        self.checkpoint_answered.notify_all();
    }

    pub(super) fn event(&self, event: Event) {
        let mut progress = lock(&self.progress);
        if progress.events.len() == MAX_EVENTS {
            progress.events.pop_front();
        }
        progress.events.push_back(event);
        drop(progress);
        self.progress_changed.notify_all();
    }

    pub(super) fn update(&self, change: impl FnOnce(&mut View)) {
        change(&mut lock(&self.progress).view);
        self.progress_changed.notify_all();
    }

    /// Changes what is known of a node. No call waits for that, so none is woken.
    pub(super) fn update_node(&self, node: &str, change: impl FnOnce(&mut NodeStatus)) {
        let nodes = &mut lock(&self.progress).view.nodes;
        match nodes.get_mut(node) {
            Some(known) => change(known),
            None => change(nodes.entry(node.to_owned()).or_default()),
        }
    }

    pub(super) fn view(&self) -> View {
        lock(&self.progress).view.clone()
    }

    /// Waits until the view is as wanted, at most for this time. Returns it.
    pub(super) fn wait(&self, timeout: Duration, wanted: impl Fn(&View) -> bool) -> View {
        let progress = lock(&self.progress);
        let waited = self
            .progress_changed
            .wait_timeout_while(progress, timeout, |progress| !wanted(&progress.view));
        waited.unwrap_or_else(PoisonError::into_inner).0.view.clone()
    }

    /// Takes all events. If there are none, waits for one, at most for this time.
    pub(super) fn take_events(&self, timeout: Duration) -> Vec<Event> {
        let progress = lock(&self.progress);
        let waited = self
            .progress_changed
            .wait_timeout_while(progress, timeout, |progress| progress.events.is_empty());
        let mut progress = waited.unwrap_or_else(PoisonError::into_inner).0;
        progress.events.drain(..).collect()
    }
}

fn refuse(done: Done, refusal: Refusal) {
    done(Err(Refused { index: 0, refusal }));
}

/// Refuses and counts steps.
pub(super) fn refuse_all(steps: Vec<Done>, refusal: Refusal, counted: &Counter) {
    counted.add_many(steps.len() as u64);
    steps.into_iter().for_each(|done| refuse(done, refusal));
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use holdfast_memory::{Access, Action, Outcome};

    use super::*;

    #[test]
    fn after_a_suspend_contents_are_old() {
        let time = Arc::new(Mutex::new(Duration::from_secs(100)));
        let mut settings = Settings::new("site", "a", Vec::new());
        settings.refuses_when_behind = true;
        let shared = Shared { clock: Clock::Test(Arc::clone(&time)), ..Shared::new(&settings) };
        assert_eq!(shared.admit(), Err(Refusal::Behind), "never current");
        shared.contact(shared.now());
        let sent = shared.now();
        for (passed, expected) in [(4, Ok(())), (1, Ok(())), (1, Err(Refusal::Behind))] {
            *lock(&time) += Duration::from_secs(passed);
            assert_eq!(shared.admit(), expected);
        }
        // A message that was sent before the suspend is applied after it.
        *lock(&time) += Duration::from_secs(3600);
        shared.contact(sent);
        assert_eq!(shared.contact_age(), Some(Duration::from_secs(3606)));
        assert_eq!(shared.admit(), Err(Refusal::Behind));
        shared.contact(shared.now());
        assert_eq!(shared.admit(), Ok(()));
    }

    #[test]
    fn a_full_queue_is_busy_and_a_closed_one_unavailable() {
        let shared = Shared::new(&Settings::new("site", "a", Vec::new()));
        let refusal = || {
            let (sender, receiver) = std::sync::mpsc::channel();
            let (access, action) = (Access::Ingest, Action::Write(Vec::new()));
            let done = Box::new(move |outcome: Outcome| drop(sender.send(outcome)));
            shared.submit(Step { access, tenure: None, action }, done);
            receiver.try_recv().ok().map(|outcome| outcome.unwrap_err().refusal)
        };
        assert_eq!(refusal(), Some(Refusal::Unavailable));
        shared.open(usize::MAX);
        for _ in 0..MAX_QUEUE_STEPS {
            assert_eq!(refusal(), None);
        }
        assert_eq!(refusal(), Some(Refusal::Busy));
        assert_eq!(shared.counters.unavailable.get(), 2);
    }

    #[test]
    fn a_log_that_has_failed_is_not_connected() {
        let shared = Shared::new(&Settings::new("site", "a", Vec::new()));
        shared.update(|view| view.server = Some("10.0.0.1:4222".to_owned()));
        shared.fail(LogError::NameTaken("a".to_owned()));
        assert_eq!(shared.view().server, None);
    }

    #[test]
    fn a_message_is_as_old_as_the_last_contact_before_it_or_as_its_own_sending() {
        let time = Arc::new(Mutex::new(Duration::from_secs(100)));
        let shared = Shared::new(&Settings::new("site", "a", Vec::new()));
        let shared = Shared { clock: Clock::Test(Arc::clone(&time)), ..shared };
        let pass = |seconds| *lock(&time) += Duration::from_secs(seconds);
        assert_eq!(shared.age_since(None), None, "what others have sent is replayed");
        shared.contact(shared.now());
        pass(60);
        let sent = shared.now();
        pass(3);
        assert_eq!(shared.age_since(None), Some(Duration::from_secs(63)), "after an outage");
        assert_eq!(shared.age_since(Some(sent)), Some(Duration::from_secs(3)));
    }
}

//! Sends the messages of this node, and reports the outcome of its steps to their writers.
//!
//! A [`Sender`] lasts as long as the process: it numbers messages, and knows those whose outcome is
//! open. A [`Publisher`] is its way to the stream in one session.

use std::sync::Arc;
use std::time::{Duration, Instant};

use async_nats::jetstream::ErrorCode;
use async_nats::{Client, HeaderMap, StatusCode, Subscriber, header};
use bytes::Bytes;
use holdfast_memory::{CarriedOut, Done, Outcome};
use serde::Deserialize;

use crate::log::clock::Moment;
use crate::log::error::{End, LogError};
use crate::log::late_messages::StreamLead;
use crate::log::parts::in_flight::InFlight;
use crate::log::settings::Settings;
use crate::log::shared::Shared;
use crate::log::state::State;
use crate::log::status::Event;
use crate::log::stream::message::{self, Notice, OVERHEAD_BYTES, Origin};
use crate::log::stream::message_limit::MessageLimit;
use crate::log::stream::raw_message::LOG_ID;
use crate::log::stream::store::{subject, unique};

/// The most bytes of steps that are sent in one message with others.
const MAX_BATCH_BYTES: usize = 64 << 10;

/// The errors of a server, an account or a stream that has no room, and of a disk that is full.
const NO_ROOM: [ErrorCode; 4] = [
    ErrorCode::INSUFFICIENT_RESOURCES,
    ErrorCode::ACCOUNT_RESOURCES_EXCEEDED,
    ErrorCode::STORAGE_RESOURCES_EXCEEDED,
    ErrorCode::STREAM_STORE_FAILED,
];

/// A message has room for this many bytes of protocol, beside its payload.
const HEADER_BYTES: usize = 1024;

/// The distance between two starts, at most. Older releases take the microseconds of Unix time as a start: with
/// distances as short as this, which is about a second, it is still greater if one of them follows.
const MAX_START_DISTANCE: u64 = 1 << 20;

/// Numbers messages and keeps them until their outcome is known.
pub(in crate::log) struct Sender {
    settings: Arc<Settings>,
    shared: Arc<Shared>,
    start: Start,
    /// Of the last message that was sent.
    counter: u64,
    in_flight: InFlight,
    stream_lead: StreamLead,
    /// Why the stream has refused messages, since the last one of this node was applied.
    refusal: Option<String>,
}

/// What the stream replied to a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::log) enum Acknowledged {
    /// The servers have no room for it.
    NoRoom,
    Other,
}

/// The start of this node, which orders its messages behind those of earlier processes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Start {
    /// Nothing was sent yet.
    None,
    /// Drawn, but no message with it was applied: another process may have drawn a later one.
    Drawn(u64),
    /// A message with it was applied: a later start is that of another process.
    Applied(u64),
}

/// Publishes to the stream over one connection.
pub(in crate::log) struct Publisher {
    client: Client,
    subject: String,
    log_id: Option<String>,
    /// The prefix of the subjects of acknowledgements.
    inbox: String,
    limit: MessageLimit,
    /// The most bytes of encoded steps that the servers accept in one message.
    max_steps_bytes: usize,
    timeout: Duration,
    last_sent: Instant,
}

/// Steps that are sent in one message.
struct Batch {
    steps: Vec<Vec<u8>>,
    dones: Vec<Done>,
    /// When they are answered as not confirmed.
    until: Instant,
}

impl Start {
    /// 0 before the first message: below all starts that are drawn.
    const fn number(self) -> u64 {
        match self {
            Start::None => 0,
            Start::Drawn(start) | Start::Applied(start) => start,
        }
    }
}

impl Sender {
    pub(in crate::log) fn new(settings: &Arc<Settings>, shared: &Arc<Shared>) -> Sender {
        let (settings, shared) = (Arc::clone(settings), Arc::clone(shared));
        Sender {
            settings,
            shared,
            start: Start::None,
            counter: 0,
            in_flight: InFlight::default(),
            stream_lead: StreamLead::default(),
            refusal: None,
        }
    }

    pub(in crate::log) fn has_started(&self) -> bool {
        self.start != Start::None
    }

    /// Draws the start of this process, or checks that it is still the last one in the log.
    pub(in crate::log) fn ensure_start(&mut self, last_applied: u64) -> Result<(), End> {
        if self.start == Start::None {
            self.start = Start::Drawn(self.draw_start(last_applied)?);
        } else if last_applied > self.start.number() {
            self.outrun()?;
        }
        Ok(())
    }

    /// A start behind all starts of this node in the log, whatever the clock shows. If another process
    /// with its name starts at the same time, it draws another one.
    fn draw_start(&self, last_applied: u64) -> Result<u64, LogError> {
        let distance = 1 + (unique() as u64) % MAX_START_DISTANCE;
        let next = last_applied.checked_add(distance);
        next.ok_or_else(|| LogError::NameUsedUp(self.settings.node.clone()))
    }

    /// The log has a start of this node that is later than this one.
    fn outrun(&mut self) -> Result<(), End> {
        match self.start {
            // An earlier process had this name: its messages are replayed.
            Start::None => Ok(()),
            // It may be this process that came too late, or an earlier one whose message was still
            // on its way. With the next start, the other one sees that it is not alone.
            Start::Drawn(_) => {
                self.start = Start::None;
                Err(End::Lost("the log has a later start of this node".to_owned()))
            }
            Start::Applied(_) => Err(LogError::NameTaken(self.settings.node.clone()).into()),
        }
    }

    /// The number of this origin's message, if this process has sent it.
    fn own_counter(&self, origin: &Origin) -> Option<u64> {
        let is_own = self.has_started()
            && origin.start == self.start.number()
            && origin.node == self.settings.node;
        is_own.then_some(origin.counter)
    }

    /// When the message of this origin was sent first, if this process has sent it and remembers it.
    pub(in crate::log) fn first_sent(&self, origin: &Origin) -> Option<Moment> {
        self.in_flight.first_sent(self.own_counter(origin)?)
    }

    /// A message was applied that the stream stored at this time. Returns its number if this process has
    /// sent it.
    pub(in crate::log) fn applied(
        &mut self,
        origin: &Origin,
        stored: i64,
        outcomes: Vec<Outcome>,
    ) -> Result<Option<u64>, End> {
        self.stream_lead.applied(stored, self.shared.now());
        self.check_start(origin)?;
        let Some(counter) = self.own_counter(origin) else { return Ok(None) };
        self.start = Start::Applied(origin.start);
        self.refusal = None;
        let sent = self.in_flight.applied(counter, outcomes, &self.shared.counters);
        // All that the log had when it was sent comes before it, and was applied.
        if let Some(at) = sent {
            self.shared.contact(at);
            self.stream_lead.sent(stored, at);
        }
        Ok(Some(counter))
    }

    /// Notices messages of another process with the name of this node.
    pub(in crate::log) fn check_start(&mut self, origin: &Origin) -> Result<(), End> {
        if origin.start > self.start.number() && origin.node == self.settings.node {
            self.outrun()?;
        }
        Ok(())
    }

    /// A snapshot was loaded. What it has of this process was applied, but not here: the outcomes are lost.
    pub(in crate::log) fn loaded(&mut self, state: &State) {
        let counter = state.last_counter(&self.settings.node, self.start.number());
        self.in_flight.give_up_until(counter, &self.shared.counters);
    }

    /// Sends the messages again whose outcome was not reported in earlier sessions.
    pub(in crate::log) async fn resend(&mut self, publisher: &mut Publisher) -> Result<(), End> {
        for (counter, payload) in self.in_flight.take_unanswered() {
            // It may be the one that was too large: when the next message is applied, it never will be.
            if !publisher.fits(&payload) {
                continue;
            }
            publisher.publish(&self.origin(counter), payload).await?;
        }
        Ok(())
    }

    /// Sends waiting steps, as long as there is room for them in flight.
    pub(in crate::log) async fn send_waiting(
        &mut self,
        publisher: &mut Publisher,
    ) -> Result<(), End> {
        if self.shared.is_stopping() && !self.in_flight.has_open_steps() {
            return Err(End::Stopped);
        }
        // While many messages are in flight, steps gather in the queue: batches grow with the load.
        while self.in_flight.has_room() {
            let waiting = self.shared.take(MAX_BATCH_BYTES.min(publisher.max_steps_bytes()));
            let Some(until) = waiting.first().map(|first| first.until) else { break };
            let (steps, dones) =
                waiting.into_iter().map(|waiting| (waiting.bytes, waiting.done)).unzip();
            self.send(publisher, Batch { steps, dones, until }).await?;
        }
        Ok(())
    }

    /// Sends a message without steps, with a notice if there is one: when it is applied, the contents have all
    /// that the log had when it was sent. Returns its number.
    pub(in crate::log) async fn send_probe(
        &mut self,
        publisher: &mut Publisher,
        compares: bool,
        notice: Option<Notice>,
    ) -> Result<u64, End> {
        self.counter += 1;
        let origin = self.origin(self.counter);
        let payload = match notice {
            Some(notice) => message::encode_notice(&origin, compares, notice),
            None => message::encode(&origin, compares, None, std::iter::empty()),
        };
        self.publish(publisher, payload, Vec::new(), None).await
    }

    async fn send(&mut self, publisher: &mut Publisher, batch: Batch) -> Result<u64, End> {
        let Batch { steps, mut dones, until } = batch;
        self.counter += 1;
        let origin = self.origin(self.counter);
        let deadline = Some(self.deadline(until));
        let payload = message::encode(&origin, false, deadline, steps.iter().map(Vec::as_slice));
        if self.settings.answers_early {
            dones.drain(..).for_each(|done| done(Ok(CarriedOut::default())));
        }
        self.publish(publisher, payload, dones, Some(until)).await
    }

    /// Publishes the next message.
    async fn publish(
        &mut self,
        publisher: &mut Publisher,
        payload: Bytes,
        dones: Vec<Done>,
        until: Option<Instant>,
    ) -> Result<u64, End> {
        let counter = self.counter;
        // Before it is published: if that fails, the next session sends it again.
        self.in_flight.push((counter, payload.clone()), dones, self.shared.now(), until);
        publisher.publish(&self.origin(counter), payload).await?;
        Ok(counter)
    }

    /// When the stream may store steps at the latest that are answered at `until`.
    fn deadline(&self, until: Instant) -> i64 {
        let left = until.saturating_duration_since(Instant::now()) + self.settings.write_timeout;
        self.stream_lead.deadline(self.shared.now(), left)
    }

    fn origin(&self, counter: u64) -> Origin {
        Origin { node: self.settings.node.clone(), start: self.start.number(), counter }
    }

    /// What the stream replied to a message.
    pub(in crate::log) fn acknowledged(
        &mut self,
        ack: Option<async_nats::Message>,
    ) -> Result<Acknowledged, End> {
        let Some(ack) = ack else { return Err(End::Lost("a subscription has ended".to_owned())) };
        let counter = ack.subject.rsplit('.').next().and_then(|counter| counter.parse().ok());
        // Anyone may send to the inbox.
        let Some(counter) = counter else { return Ok(Acknowledged::Other) };
        if ack.status == Some(StatusCode::NO_RESPONDERS) {
            self.in_flight.not_taken(counter, &self.shared.counters);
            self.report("the stream has no leader");
        } else if let Some(error) = refusal(&ack.payload) {
            self.in_flight.refused_by_stream(counter, &self.shared.counters);
            let description = error.description.as_deref().unwrap_or("no reason");
            self.report(&format!("the stream refuses messages: {description}"));
            if NO_ROOM.contains(&error.err_code) {
                return Ok(Acknowledged::NoRoom);
            }
        }
        // A message that was stored is not confirmed before it is applied.
        Ok(Acknowledged::Other)
    }

    /// Why the stream has refused messages, since the last one of this node was applied.
    pub(in crate::log) fn refusal(&self) -> Option<&str> {
        self.refusal.as_deref()
    }

    /// Shows an error in the status, and as an event if it is new.
    pub(in crate::log) fn report(&mut self, reason: &str) {
        let reported = Some(reason.to_owned());
        // The session before may have ended for it.
        let before = self.refusal.replace(reason.to_owned());
        if before != reported && self.shared.view().last_error != reported {
            self.shared.event(Event::new("log_error", &[("reason", reason)]));
            self.shared.update(|view| view.last_error = reported);
        }
    }

    /// Answers steps that were not confirmed in time.
    pub(in crate::log) fn expire(&mut self, now: Instant) {
        self.in_flight.expire(now, &self.shared.counters);
    }

    /// Answers all steps: nothing will confirm them.
    pub(in crate::log) fn expire_all(&mut self) {
        // No step waits longer than this.
        self.expire(Instant::now() + self.settings.write_timeout);
    }

    /// Whether all steps that were sent are answered.
    pub(in crate::log) fn is_idle(&self) -> bool {
        !self.in_flight.has_open_steps()
    }
}

impl Publisher {
    pub(in crate::log) fn new(
        client: Client,
        settings: &Settings,
        log_id: Option<&str>,
        limit: MessageLimit,
    ) -> Publisher {
        Publisher {
            subject: subject(&settings.name),
            log_id: log_id.map(str::to_owned),
            inbox: client.new_inbox(),
            max_steps_bytes: limit.bytes().saturating_sub(HEADER_BYTES + OVERHEAD_BYTES),
            limit,
            timeout: settings.write_timeout,
            last_sent: Instant::now(),
            client,
        }
    }

    pub(in crate::log) fn max_steps_bytes(&self) -> usize {
        self.max_steps_bytes
    }

    /// Whether the servers accept a message with this payload, as far as is known.
    fn fits(&self, payload: &Bytes) -> bool {
        payload.len() <= self.max_steps_bytes + OVERHEAD_BYTES
    }

    pub(in crate::log) fn last_sent(&self) -> Instant {
        self.last_sent
    }

    /// Subscribes to what the stream replies to messages.
    pub(in crate::log) async fn acknowledgements(&self) -> Result<Subscriber, End> {
        let subscribed = self.client.subscribe(format!("{}.*", self.inbox)).await;
        subscribed.map_err(|error| End::lost("subscribe", error))
    }

    async fn publish(&mut self, origin: &Origin, payload: Bytes) -> Result<(), End> {
        let mut headers = HeaderMap::new();
        // The servers themselves drop a message that they have stored lately.
        headers.insert(header::NATS_MESSAGE_ID, origin.message_id().as_str());
        if let Some(id) = &self.log_id {
            headers.insert(LOG_ID, id.as_str());
        }
        let reply = format!("{}.{}", self.inbox, origin.counter);
        self.limit.sent(payload.len() + HEADER_BYTES);
        let published = self.client.publish_with_reply_and_headers(
            self.subject.clone(),
            reply,
            headers,
            payload,
        );
        self.last_sent = Instant::now();
        match tokio::time::timeout(self.timeout, published).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(error)) => Err(End::lost("publish", error)),
            Err(_) => Err(End::Lost("the server takes no messages".to_owned())),
        }
    }
}

#[derive(Deserialize)]
struct Refused {
    #[serde(default)]
    err_code: ErrorCode,
    description: Option<String>,
}

/// The error in the answer of a stream, if it has not stored a message.
fn refusal(answer: &[u8]) -> Option<Refused> {
    #[derive(Deserialize)]
    struct Answer {
        error: Option<Refused>,
    }
    // Most answers are short and have no error: they are not parsed.
    if !answer.windows(7).any(|part| part == b"\"error\"") {
        return None;
    }
    serde_json::from_slice::<Answer>(answer).ok()?.error
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use holdfast_runtime::lock;

    use super::*;
    use crate::log::clock::Clock;

    const SECOND: i64 = 1_000_000_000;

    fn sender() -> Sender {
        timed().0
    }

    /// A sender of a machine whose clock goes on by the seconds that pass.
    fn timed() -> (Sender, impl Fn(u64)) {
        let time = Arc::new(Mutex::new(Duration::from_secs(1000)));
        let settings = Arc::new(Settings::new("site", "a", Vec::new()));
        let mut shared = Shared::new(&settings);
        shared.clock = Clock::Test(Arc::clone(&time));
        let pass = move |seconds| *lock(&time) += Duration::from_secs(seconds);
        (Sender::new(&settings, &Arc::new(shared)), pass)
    }

    fn origin(node: &str, start: u64) -> Origin {
        Origin { node: node.to_owned(), start, counter: 1 }
    }

    #[test]
    fn a_start_is_behind_all_starts_of_the_node_in_the_log() {
        let mut sender = sender();
        assert!(sender.applied(&origin("a", 5), 0, Vec::new()).is_ok(), "an earlier process");
        sender.ensure_start(5).unwrap();
        assert!(sender.start.number() > 5);
    }

    #[test]
    fn a_later_start_of_the_node_before_the_own_was_applied_lets_it_draw_another_one() {
        let mut sender = sender();
        sender.ensure_start(5).unwrap();
        let later = sender.start.number() + 1;
        assert!(matches!(sender.check_start(&origin("a", later)), Err(End::Lost(_))));
        sender.ensure_start(later).unwrap();
        assert!(sender.start.number() > later);
    }

    #[test]
    fn a_later_start_of_the_node_after_the_own_was_applied_is_that_of_another_process() {
        let mut sender = sender();
        sender.ensure_start(5).unwrap();
        let own = sender.start.number();
        assert_eq!(sender.applied(&origin("b", own), 0, Vec::new()).unwrap(), None);
        assert_eq!(sender.applied(&origin("a", own), 0, Vec::new()).unwrap(), Some(1));
        assert!(sender.check_start(&origin("b", own + 1)).is_ok());
        let taken = sender.check_start(&origin("a", own + 1));
        assert!(matches!(taken, Err(End::Fatal(LogError::NameTaken(_)))), "{taken:?}");
    }

    #[test]
    fn steps_have_as_long_again_as_their_writers_wait_by_the_clock_of_the_stream() {
        let (mut sender, _) = timed();
        sender.applied(&origin("b", 1), 100 * SECOND, Vec::new()).unwrap();
        let before = Instant::now();
        let deadline = sender.deadline(before + Duration::from_secs(3));
        let since = i64::try_from(before.elapsed().as_nanos()).unwrap();
        let usual = 104 * SECOND;
        assert!((usual - since..=usual).contains(&deadline), "{deadline}");
        assert_eq!(sender.deadline(before), 101 * SECOND, "their time is over");
    }

    #[test]
    fn a_message_that_arrives_late_does_not_set_the_clock_of_the_stream_back() {
        let (mut sender, pass) = timed();
        let over = Instant::now();
        sender.applied(&origin("b", 1), 100 * SECOND, Vec::new()).unwrap();
        pass(7);
        sender.applied(&origin("b", 1), 102 * SECOND, Vec::new()).unwrap();
        assert_eq!(sender.deadline(over), 108 * SECOND);
        sender.applied(&origin("b", 1), 109 * SECOND, Vec::new()).unwrap();
        assert_eq!(sender.deadline(over), 110 * SECOND, "what was stored later says more");
        pass(3600);
        assert_eq!(sender.deadline(over), 3710 * SECOND, "after a suspend");
    }

    #[test]
    fn a_clock_of_the_stream_that_was_set_back_counts_from_the_next_own_message_on() {
        let (mut sender, pass) = timed();
        let over = Instant::now();
        sender.applied(&origin("b", 1), 100 * SECOND, Vec::new()).unwrap();
        sender.ensure_start(0).unwrap();
        sender.in_flight.push((1, Bytes::new()), Vec::new(), sender.shared.now(), None);
        pass(2);
        let own = origin("a", sender.start.number());
        sender.applied(&own, 50 * SECOND, Vec::new()).unwrap();
        assert_eq!(sender.deadline(over), 53 * SECOND);
    }

    #[test]
    fn a_message_with_start_0_is_not_of_a_process_that_has_sent_nothing() {
        let mut sender = sender();
        assert_eq!(sender.applied(&origin("a", 0), 0, Vec::new()).unwrap(), None);
        assert!(sender.check_start(&origin("a", 5)).is_ok());
    }
}

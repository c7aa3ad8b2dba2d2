//! The thread of a log: sessions with the servers, one after the other.
//!
//! A session is one connection. It reads the stream from what was applied last, sends steps, and
//! ends at the first doubt. Then the next one begins.

use std::convert::Infallible;
use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use async_nats::jetstream::consumer::pull;
use async_nats::jetstream::{self, Context};
use async_nats::{Client, HeaderMap, StatusCode, header};
use bytes::Bytes;
use futures_util::{FutureExt, StreamExt};
use holdfast_memory::{CarriedOut, Memory};
use serde::{Deserialize, Serialize};
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;

use super::connection::connect;
use super::digests::{Digests, Verdict};
use super::error::{End, LogError};
use super::follower::digest_at;
use super::layout::copies;
use super::message::{self, OVERHEAD, Origin};
use super::sent::{LOOK, Sent};
use super::settings::{Settings, is_word};
use super::shared::Shared;
use super::state::{Applied, Place, State, digest_of};
use super::status::{Digest, Event, NodeView, Phase};
use super::store::{DIGEST, POINTER, Pointer, Snapshot, Store, parsed, subject, unique};

/// The length of a digest as text.
const DIGEST_LEN: usize = 64;

/// The most bytes of steps that travel in one message with others.
const TOGETHER: usize = 64 << 10;

/// The most further messages that are applied before steps are sent.
const TOGETHER_RECEIVED: usize = 255;

/// Pauses between sessions. Each failure doubles the pause.
const FIRST_PAUSE: Duration = Duration::from_millis(50);
const MAX_PAUSE: Duration = Duration::from_secs(1);

/// For so long, a server may know less than this node: it may be cut off from the others.
const CUT_OFF: Duration = Duration::from_secs(30);

/// How long a snapshot waits for the digests of other nodes.
const ALONE: Duration = Duration::from_secs(5);

/// When a snapshot is tried again.
const RETRY: Duration = Duration::from_secs(5);

/// How long requests to JetStream may take.
const REQUEST: Duration = Duration::from_secs(3);

/// What the owner of a session keeps from one session to the next.
pub(super) struct Node {
    settings: Arc<Settings>,
    fingerprint: String,
    shared: Arc<Shared>,
    state: State,
    /// What this node has sent last. The start is 0 until the state is loaded.
    origin: Origin,
    sent: Sent,
    /// Tells the stream that was applied from another one.
    id: Option<String>,
    digests: Digests,
    pointer: Option<(u64, Pointer)>,
    pointer_since: Instant,
    /// Since when the servers have known less than this node, in this session and in the last one.
    short_since: Option<Instant>,
    was_short_since: Option<Instant>,
    worked: bool,
}

/// What a node stores as its digest.
#[derive(Serialize, Deserialize)]
struct Told {
    sequence: u64,
    digest: String,
}

/// What tasks beside a session report to it.
enum Report {
    /// This node may take a snapshot.
    Leased(bool),
    Stored(Result<(u64, Pointer), String>),
    /// The digest that the log leads to.
    Replayed {
        sequence: u64,
        digest: Result<String, String>,
    },
}

/// A snapshot that is stored when no other node has another digest.
struct Prepared {
    encoded: Vec<u8>,
    snapshot: Snapshot,
    since: Instant,
    /// Another node has another digest, so the log is asked.
    is_disputed: bool,
}

struct Session {
    client: Client,
    store: Store,
    subject: String,
    inbox: String,
    longest: usize,
    began: Instant,
    last_sent: Instant,
    last_applied: Instant,
    /// When a message of this node with this counter is applied, this node has caught up.
    caught_up_at: Option<u64>,
    reports: mpsc::UnboundedSender<Report>,
    /// From the request for the lease to the end of its use.
    takes_snapshot: bool,
    /// At the message of this node with this counter, a snapshot is made.
    asked: Option<u64>,
    prepared: Option<Prepared>,
    /// After a refused lease, another node is about to store a snapshot.
    no_snapshot_before: Instant,
    replays: bool,
}

impl Node {
    pub(super) fn new(
        settings: Arc<Settings>,
        fingerprint: String,
        shared: Arc<Shared>,
        members: Vec<Arc<Memory>>,
    ) -> Node {
        let origin = Origin { node: settings.node.clone(), start: 0, counter: 0 };
        let digests = Digests::new(&settings.node);
        Node {
            settings,
            fingerprint,
            shared,
            state: State::new(members),
            origin,
            sent: Sent::default(),
            id: None,
            digests,
            pointer: None,
            pointer_since: Instant::now(),
            short_since: None,
            was_short_since: None,
            worked: false,
        }
    }

    /// Runs sessions until the log is stopped, or can't go on.
    pub(super) fn run(mut self) {
        let mut pause = FIRST_PAUSE;
        while !self.shared.is_stopping() {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
            let end = match runtime {
                Ok(runtime) => {
                    let Err(end) = runtime.block_on(self.session());
                    // All tasks of the client end here, with all that it has not sent.
                    runtime.shutdown_background();
                    end
                }
                Err(error) => End::lost("starting a runtime", error),
            };
            self.shared.close();
            match end {
                End::Stopped => break,
                // A file that can't be read now can be read later.
                End::Fatal(LogError::Settings(reason)) if self.id.is_some() => self.lost(reason),
                End::Fatal(error) => {
                    self.sent.expire(
                        Instant::now() + self.settings.write_timeout,
                        &self.shared.counters,
                    );
                    return self.shared.fail(error);
                }
                End::Lost(reason) => self.lost(reason),
            }
            if std::mem::take(&mut self.worked) {
                pause = FIRST_PAUSE;
            }
            let until = Instant::now() + pause;
            while Instant::now() < until && !self.shared.is_stopping() {
                std::thread::sleep(LOOK.min(pause));
                self.sent.expire(Instant::now(), &self.shared.counters);
            }
            pause = (pause * 2).min(MAX_PAUSE);
        }
        self.sent.expire(Instant::now() + self.settings.write_timeout, &self.shared.counters);
        self.shared.update(|view| {
            view.phase = Phase::Stopped;
            view.server = None;
        });
    }

    fn lost(&self, reason: String) {
        let was = self.shared.view();
        let told = was.last_error.as_ref() == Some(&reason);
        if was.server.is_some() {
            self.shared.event(Event::new("log_disconnected", &[("reason", &reason)]));
        } else if !told {
            self.shared.event(Event::new("log_connect_failed", &[("reason", &reason)]));
        }
        self.shared.update(|view| {
            view.server = None;
            view.last_error = Some(reason);
        });
    }

    /// Waits for something, and meanwhile answers steps whose time is over.
    async fn tend<T>(&mut self, work: impl Future<Output = T>) -> Result<T, End> {
        let mut work = std::pin::pin!(work);
        loop {
            tokio::select! {
                done = &mut work => return Ok(done),
                () = tokio::time::sleep(LOOK) => {
                    self.sent.expire(Instant::now(), &self.shared.counters);
                    if self.shared.is_stopping() {
                        return Err(End::Stopped);
                    }
                }
            }
        }
    }

    async fn session(&mut self) -> Result<Infallible, End> {
        self.was_short_since = self.short_since.take();
        let settings = Arc::clone(&self.settings);
        let name = format!("holdfast log {} {}", settings.name, settings.node);
        let mut connected = self.tend(connect(&settings.servers, name)).await??;
        let client = connected.client.clone();
        let mut context: Context = jetstream::new(client.clone());
        context.set_timeout(REQUEST);
        let fingerprint = self.fingerprint.clone();
        let store = self.tend(Store::open(&context, &settings, &fingerprint, true)).await??;
        let from = self.join(&store).await?;
        let heartbeat = (settings.silence() / 4).max(Duration::from_millis(200));
        let mut messages = self.tend(store.messages(from, heartbeat)).await??;
        let inbox = client.new_inbox();
        let subscribed = client.subscribe(format!("{inbox}.*"));
        let lost = |error: &dyn std::fmt::Display| End::lost("subscribe", error);
        let mut acks = self.tend(subscribed).await?.map_err(|error| lost(&error))?;
        let keys = store.keys.clone();
        let watched = [POINTER.to_owned(), format!("{DIGEST}>")];
        let watch = self.tend(keys.watch_many_with_history(watched)).await?;
        let mut watch = watch.map_err(|error| lost(&error))?;
        let (reports, mut reported) = mpsc::unbounded_channel();
        let now = Instant::now();
        let mut session = Session {
            subject: subject(&settings.name),
            inbox,
            longest: client.server_info().max_payload.saturating_sub(1024),
            client,
            store,
            began: now,
            last_sent: now,
            last_applied: now,
            caught_up_at: None,
            reports,
            takes_snapshot: false,
            asked: None,
            prepared: None,
            no_snapshot_before: now,
            replays: false,
        };
        let replicas = session.store.stream.cached_info().config.num_replicas;
        let server = connected.server.clone();
        self.shared.event(Event::new("log_connected", &[("server", &server)]));
        self.shared.update(|view| {
            view.server = Some(server);
            view.replicas = replicas;
        });
        self.sent.expire(Instant::now(), &self.shared.counters);
        for (counter, payload) in self.sent.again() {
            self.publish(&mut session, counter, payload).await?;
        }
        session.caught_up_at = Some(self.origin.counter + 1);
        self.send(&mut session, false, Vec::new(), Vec::new(), now).await?;

        let mut look = tokio::time::interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                message = messages.next() => {
                    self.received(&mut session, message)?;
                    // What has arrived together is answered before steps are sent: those who were
                    // answered write again, and their steps travel together.
                    for _ in 0..TOGETHER_RECEIVED {
                        let Some(message) = messages.next().now_or_never() else { break };
                        self.received(&mut session, message)?;
                    }
                    self.send_waiting(&mut session).await?;
                }
                ack = acks.next() => self.acknowledged(ack)?,
                () = self.shared.arrived.notified() => self.send_waiting(&mut session).await?,
                entry = watch.next() => match entry {
                    Some(Ok(entry)) => self.watched(&mut session, &entry.key, entry.revision, &entry.value)?,
                    Some(Err(error)) => return Err(End::lost("watching the keys of the log", error)),
                    None => return Err(End::Lost("the watch of the keys has ended".to_owned())),
                },
                Some(report) = reported.recv() => self.reported(&mut session, report).await?,
                end = connected.end() => return Err(end),
                _ = look.tick() => self.look(&mut session).await?,
            }
        }
    }

    /// Loads a snapshot if that is needed. Returns the sequence to read from.
    async fn join(&mut self, store: &Store) -> Result<u64, End> {
        let id = store.id().map(str::to_owned);
        if self.id.is_some() && self.id != id {
            let text = "the stream of the log was deleted and made anew".to_owned();
            return Err(LogError::Replaced(text).into());
        }
        let (first, last) = {
            let info = &store.stream.cached_info().state;
            (info.first_sequence, info.last_sequence)
        };
        let applied = self.state.place.sequence;
        if last < applied {
            return Err(self.short(format!(
                "the stream ends at sequence {last}, but this node has applied {applied}: the \
                 servers have lost messages"
            )));
        }
        if self.id.is_none() || first > applied + 1 {
            self.load(store, last).await?;
        }
        self.id = id;
        if self.origin.start == 0 {
            let clock = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
            let now = u64::try_from(clock.as_micros()).unwrap_or(u64::MAX);
            self.origin.start = now.max(self.state.last_start(&self.origin.node) + 1);
        }
        // What was applied last is read again, to see that it is still the same.
        let applied = self.state.place.sequence;
        Ok(if applied >= first.max(1) { applied } else { applied + 1 })
    }

    /// A server knows less than this node. Whether that stays so is seen later.
    fn short(&mut self, text: String) -> End {
        let since = self.was_short_since.unwrap_or_else(Instant::now);
        self.short_since = Some(since);
        if since.elapsed() < CUT_OFF { End::Lost(text) } else { LogError::Replaced(text).into() }
    }

    /// Loads the newest snapshot that is good, or makes the first one.
    async fn load(&mut self, store: &Store, last: u64) -> Result<(), End> {
        let pointer = self.tend(store.pointer()).await??;
        let Some((revision, pointer)) = pointer else {
            if last > 0 {
                let text = "the log has messages, but the key of its snapshot is missing";
                let missing = self.short(text.to_owned());
                return Err(match missing {
                    End::Fatal(_) => LogError::Snapshot(text.to_owned()).into(),
                    other => other,
                });
            }
            // The first node that gets here decides what the log begins with.
            let encoded = self.state.encode();
            let snapshot = self.snapshot_of(digest_of(&encoded));
            let first = self.tend(store.put(None, &encoded, snapshot)).await?;
            self.pointer = Some(first.map_err(|error| End::lost("the first snapshot", error))?);
            self.pointer_since = Instant::now();
            return Ok(());
        };
        if pointer.newest.sequence > last {
            let sequence = pointer.newest.sequence;
            return Err(self.short(format!(
                "the stream ends at sequence {last}, but there is a snapshot at {sequence}: the \
                 servers have lost messages"
            )));
        }
        self.shared.loading(true);
        let mut state = State::new(std::mem::take(&mut self.state.members));
        let mut loaded = self.tend(store.load(&pointer.newest, &mut state)).await;
        if let (Ok(Err(End::Fatal(error))), Some(previous)) = (&loaded, &pointer.previous) {
            self.shared
                .event(Event::new("log_snapshot_damaged", &[("reason", &error.to_string())]));
            loaded = self.tend(store.load(previous, &mut state)).await;
        }
        let mut end = loaded.and_then(|loaded| loaded);
        if matches!(end, Err(End::Fatal(_))) {
            // Other nodes may have stored snapshots meanwhile, and removed these.
            if let Ok(Ok(Some((now, _)))) = self.tend(store.pointer()).await
                && now != revision
            {
                end = Err(End::Lost("the snapshot was replaced".to_owned()));
            }
        }
        if end.is_ok() {
            self.state = state;
            // What the snapshot has of this node was applied, but not here: the outcomes are lost.
            let counter = self.state.last_counter(&self.origin);
            self.sent.unclear(counter, &self.shared.counters);
        } else {
            self.state.members = state.members;
        }
        self.shared.loading(false);
        end?;
        self.shared.counters.sequence.set(self.state.place.sequence);
        self.note_pointer(revision, pointer);
        Ok(())
    }

    fn note_pointer(&mut self, revision: u64, pointer: Pointer) {
        if self.pointer.as_ref().is_none_or(|(known, _)| *known < revision) {
            let sequence = pointer.newest.sequence;
            self.shared.update(|view| view.snapshot = Some(sequence));
            self.pointer = Some((revision, pointer));
            self.pointer_since = Instant::now();
        }
    }

    fn snapshot_of(&self, digest: String) -> Snapshot {
        Snapshot {
            sequence: self.state.place.sequence,
            stored: self.state.place.stored,
            steps: self.state.steps,
            object: format!("{:016x}", unique() as u64),
            digest,
            node: self.settings.node.clone(),
        }
    }

    /// Sends waiting steps, as long as there is room for them on the way.
    async fn send_waiting(&mut self, session: &mut Session) -> Result<(), End> {
        if self.shared.is_stopping() && self.sent.is_empty() {
            return Err(End::Stopped);
        }
        while self.sent.has_room() {
            let waiting = self.shared.take(TOGETHER.min(session.longest - OVERHEAD));
            let Some(until) = waiting.first().map(|first| first.until) else { break };
            let (steps, dones) =
                waiting.into_iter().map(|waiting| (waiting.bytes, waiting.done)).unzip();
            self.send(session, false, steps, dones, until).await?;
        }
        Ok(())
    }

    async fn send(
        &mut self,
        session: &mut Session,
        compares: bool,
        steps: Vec<Vec<u8>>,
        mut dones: Vec<holdfast_memory::Done>,
        until: Instant,
    ) -> Result<(), End> {
        self.origin.counter += 1;
        let payload = message::encode(&self.origin, compares, steps.iter().map(Vec::as_slice));
        if self.settings.answers_early {
            dones.drain(..).for_each(|done| done(Ok(CarriedOut::default())));
        }
        let counter = self.origin.counter;
        self.sent.push((counter, payload.clone()), dones, self.shared.now(), until);
        self.publish(session, counter, payload).await
    }

    async fn publish(
        &mut self,
        session: &mut Session,
        counter: u64,
        payload: Bytes,
    ) -> Result<(), End> {
        let mut headers = HeaderMap::new();
        let id = Origin { counter, ..self.origin.clone() }.message_id();
        headers.insert(header::NATS_MESSAGE_ID, id.as_str());
        let reply = format!("{}.{counter}", session.inbox);
        let published = session.client.publish_with_reply_and_headers(
            session.subject.clone(),
            reply,
            headers,
            payload,
        );
        session.last_sent = Instant::now();
        match tokio::time::timeout(self.settings.write_timeout, published).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(error)) => Err(End::lost("publish", error)),
            Err(_) => Err(End::Lost("the server takes no messages".to_owned())),
        }
    }

    fn acknowledged(&mut self, ack: Option<async_nats::Message>) -> Result<(), End> {
        let Some(ack) = ack else { return Err(End::Lost("a subscription has ended".to_owned())) };
        let counter = ack.subject.rsplit('.').next().and_then(|counter| counter.parse().ok());
        let Some(counter) = counter else { return Ok(()) };
        if ack.status == Some(StatusCode::NO_RESPONDERS) {
            self.sent.not_taken(counter, &self.shared.counters);
            self.note("the stream has no leader");
        } else if let Some(error) = refusal(&ack.payload) {
            self.sent.not_stored(counter, &self.shared.counters);
            self.note(&format!("the stream refuses messages: {error}"));
        }
        Ok(())
    }

    /// Keeps an error for whoever looks at the log, and makes it an event if it is new.
    fn note(&self, reason: &str) {
        if self.shared.view().last_error.as_deref() != Some(reason) {
            self.shared.event(Event::new("log_error", &[("reason", reason)]));
            self.shared.update(|view| view.last_error = Some(reason.to_owned()));
        }
    }

    fn received(
        &mut self,
        session: &mut Session,
        message: Option<Result<jetstream::Message, pull::MessagesError>>,
    ) -> Result<(), End> {
        let message = match message {
            Some(Ok(message)) => message,
            Some(Err(error)) => return Err(End::lost("reading the stream", error)),
            None => return Err(End::Lost("the consumer has ended".to_owned())),
        };
        let info = message.info().map_err(|error| End::lost("a message of the stream", error))?;
        let stored = info.published.unix_timestamp_nanos() as i64;
        let place = Place { sequence: info.stream_sequence, stored };
        self.shared.counters.last_sequence.set(place.sequence + info.pending);
        let applied = self.state.place;
        if place.sequence == applied.sequence && place != applied {
            let sequence = place.sequence;
            let text = format!(
                "the message at sequence {sequence} is not the one that this node has applied: \
                 the servers have lost messages"
            );
            return Err(LogError::Replaced(text).into());
        }
        if place.sequence <= applied.sequence {
            return Ok(());
        }
        if place.sequence != applied.sequence + 1 {
            let next = applied.sequence + 1;
            return Err(End::Lost(format!("sequence {} came in place of {next}", place.sequence)));
        }
        self.apply(session, place, &message.payload)
    }

    fn apply(&mut self, session: &mut Session, place: Place, payload: &[u8]) -> Result<(), End> {
        let counters = &self.shared.counters;
        let (mut compared, mut for_snapshot) = (false, false);
        session.last_applied = Instant::now();
        match self.state.apply(place, payload)? {
            Applied::Fresh { origin, compares, outcomes } => {
                self.shared.counters.sequence.set(place.sequence);
                compared = compares;
                if origin.node == self.origin.node {
                    if origin.start > self.origin.start {
                        return Err(LogError::NameTaken(origin.node).into());
                    }
                    if origin.start == self.origin.start {
                        for_snapshot = session.asked == Some(origin.counter);
                        self.applied_own(session, origin.counter, outcomes);
                    }
                }
                self.seen(origin.node, place);
            }
            Applied::Stale(origin) => {
                counters.stale.add(1);
                if origin.node == self.origin.node && origin.start > self.origin.start {
                    return Err(LogError::NameTaken(origin.node).into());
                }
            }
            Applied::Ignored(error) => {
                counters.ignored.add(1);
                let sequence = place.sequence.to_string();
                let fields = [("sequence", sequence.as_str()), ("reason", &error.to_string())];
                self.shared.event(Event::new("log_message_ignored", &fields));
            }
        }
        self.shared.counters.sequence.set(place.sequence);
        if compared || place.sequence.is_multiple_of(self.settings.digest_every) {
            self.tell_digest(session, for_snapshot)?;
        }
        Ok(())
    }

    fn applied_own(
        &mut self,
        session: &mut Session,
        counter: u64,
        outcomes: Vec<holdfast_memory::Outcome>,
    ) {
        let sent = self.sent.applied(counter, outcomes, &self.shared.counters);
        if let Some(at) = sent {
            self.shared.contact(at);
        }
        if session.asked.is_some_and(|asked| asked <= counter) {
            let was_lost = session.asked != Some(counter);
            session.asked = None;
            session.takes_snapshot &= !was_lost;
        }
        if session.caught_up_at.is_some_and(|at| at <= counter) {
            session.caught_up_at = None;
            self.worked = true;
            self.shared.open(session.longest - OVERHEAD);
            let sequence = self.state.place.sequence.to_string();
            self.shared.event(Event::new("log_caught_up", &[("sequence", &sequence)]));
            self.shared.update(|view| {
                view.phase = Phase::Running;
                view.last_error = None;
            });
        }
    }

    /// Remembers when a node was last seen, for whoever looks at the log.
    fn seen(&mut self, node: String, place: Place) {
        self.shared.update_node(node, |node: &mut NodeView| {
            node.sequence = place.sequence;
            node.stored = place.stored;
        });
    }

    fn tell_digest(&mut self, session: &mut Session, for_snapshot: bool) -> Result<(), End> {
        let sequence = self.state.place.sequence;
        let encoded = self.state.encode();
        let digest = digest_of(&encoded);
        if for_snapshot {
            let (snapshot, since) = (self.snapshot_of(digest.clone()), Instant::now());
            session.prepared = Some(Prepared { encoded, snapshot, since, is_disputed: false });
        }
        let told = Told { sequence, digest: digest.clone() };
        if let Ok(value) = serde_json::to_vec(&told) {
            let (keys, key) =
                (session.store.keys.clone(), format!("{DIGEST}{}", self.settings.node));
            // If this fails, the next digest tells as much.
            tokio::spawn(async move { keys.put(key, value.into()).await.map(drop) });
        }
        let own = Digest { sequence, digest: digest.clone(), agrees: None };
        self.shared.update(|view| view.digest = Some(own));
        let verdict = self.digests.add(&self.settings.node, sequence, &digest);
        self.judged(session, sequence, verdict)
    }

    fn watched(
        &mut self,
        session: &mut Session,
        key: &str,
        revision: u64,
        value: &[u8],
    ) -> Result<(), End> {
        if key == POINTER {
            self.note_pointer(revision, parsed(value)?);
            return Ok(());
        }
        let node = key.strip_prefix(DIGEST).unwrap_or_default();
        let Ok(told) = serde_json::from_slice::<Told>(value) else { return Ok(()) };
        let is_digest = is_word(node) && told.digest.len() == DIGEST_LEN;
        if !is_digest || node == self.settings.node || !self.state.knows(node) {
            return Ok(());
        }
        let verdict = self.digests.add(node, told.sequence, &told.digest);
        let sequence = told.sequence;
        self.shared.update_node(node.to_owned(), |node| {
            node.digest = Some((told.sequence, told.digest));
        });
        self.judged(session, sequence, verdict)
    }

    fn judged(
        &mut self,
        session: &mut Session,
        sequence: u64,
        verdict: Verdict,
    ) -> Result<(), End> {
        let agrees = match verdict {
            Verdict::Alone => return Ok(()),
            Verdict::Agrees => {
                self.store_snapshot(session, sequence);
                true
            }
            Verdict::Differs(other) => {
                return Err(self.differs(sequence, format!("most nodes have {other}")));
            }
            Verdict::Unclear(_) => {
                let mut prepared = session.prepared.iter_mut();
                if let Some(own) = prepared.find(|own| own.snapshot.sequence == sequence) {
                    own.is_disputed = true;
                }
                self.replay(session, sequence);
                false
            }
        };
        self.shared.update(|view| {
            if let Some(digest) = view.digest.as_mut().filter(|digest| digest.sequence == sequence)
            {
                digest.agrees = Some(agrees);
            }
        });
        Ok(())
    }

    fn differs(&self, sequence: u64, other: String) -> End {
        let found = self.digests.own(sequence).unwrap_or_default().to_owned();
        LogError::Differs { sequence, found, other }.into()
    }

    /// Finds out what the log leads to, beside the session: nodes differ, and none has a majority.
    fn replay(&mut self, session: &mut Session, sequence: u64) {
        let Some((_, pointer)) = self.pointer.clone() else { return };
        if std::mem::replace(&mut session.replays, true) {
            return;
        }
        let at = sequence.to_string();
        self.shared.event(Event::new("log_digests_differ", &[("sequence", &at)]));
        let (store, reports) = (session.store.clone(), session.reports.clone());
        let members = copies(&self.state.members);
        tokio::spawn(async move {
            let digest = match members {
                Ok(members) => digest_at(&store, &pointer, members, sequence).await,
                Err(error) => Err(error.to_string()),
            };
            // If the session has ended, the next difference is looked at.
            let _ = reports.send(Report::Replayed { sequence, digest });
        });
    }

    async fn reported(&mut self, session: &mut Session, report: Report) -> Result<(), End> {
        match report {
            Report::Leased(false) => {
                session.takes_snapshot = false;
                session.no_snapshot_before = Instant::now() + RETRY;
            }
            Report::Leased(true) => {
                let until = Instant::now() + self.settings.write_timeout;
                self.send(session, true, Vec::new(), Vec::new(), until).await?;
                session.asked = Some(self.origin.counter);
            }
            Report::Stored(Ok((revision, pointer))) => {
                session.takes_snapshot = false;
                let sequence = pointer.newest.sequence.to_string();
                self.shared.event(Event::new("log_snapshot_stored", &[("sequence", &sequence)]));
                self.note_pointer(revision, pointer);
            }
            Report::Stored(Err(reason)) => {
                session.takes_snapshot = false;
                session.no_snapshot_before = Instant::now() + RETRY;
                self.shared.event(Event::new("log_snapshot_failed", &[("reason", &reason)]));
            }
            Report::Replayed { sequence, digest: Ok(digest) } => {
                session.replays = false;
                if self.digests.own(sequence).is_some_and(|own| own != digest) {
                    return Err(self.differs(sequence, format!("the log leads to {digest}")));
                }
                self.store_snapshot(session, sequence);
                self.drop_disputed(session);
            }
            Report::Replayed { sequence, digest: Err(reason) } => {
                session.replays = false;
                self.drop_disputed(session);
                let fields = [("sequence", &*sequence.to_string()), ("reason", &reason)];
                self.shared.event(Event::new("log_replay_failed", &fields));
            }
        }
        Ok(())
    }

    /// Stores the snapshot that was made at this sequence: its digest is right.
    fn store_snapshot(&mut self, session: &mut Session, sequence: u64) {
        let own = session.prepared.take_if(|own| own.snapshot.sequence == sequence);
        let Some(Prepared { encoded, snapshot, .. }) = own else { return };
        let (store, reports) = (session.store.clone(), session.reports.clone());
        let pointer = self.pointer.clone();
        tokio::spawn(async move {
            let stored = match store.put(pointer, &encoded, snapshot).await {
                Ok((revision, pointer)) => store.tidy(&pointer).await.map(|()| (revision, pointer)),
                Err(error) => Err(error),
            };
            store.release().await;
            // If the session has ended, the next one sees the key.
            let _ = reports.send(Report::Stored(stored));
        });
    }

    /// Gives up a snapshot that nodes don't agree on. There will be another one.
    fn drop_disputed(&self, session: &mut Session) {
        if session.prepared.take_if(|own| own.is_disputed).is_some() {
            session.takes_snapshot = false;
            session.no_snapshot_before = Instant::now() + RETRY;
        }
    }

    async fn look(&mut self, session: &mut Session) -> Result<(), End> {
        let now = Instant::now();
        self.sent.expire(now, &self.shared.counters);
        self.shared.expire(now);
        if self.shared.is_stopping() && self.sent.is_empty() {
            return Err(End::Stopped);
        }
        let silent = now.saturating_duration_since(session.last_applied.max(session.began));
        if silent > self.settings.silence() {
            let seconds = silent.as_secs_f64();
            return Err(End::Lost(format!("the log has confirmed nothing for {seconds:.1} s")));
        }
        if now.saturating_duration_since(session.last_sent) >= self.settings.tick() {
            let until = now + self.settings.write_timeout;
            self.send(session, false, Vec::new(), Vec::new(), until).await?;
        }
        self.send_waiting(session).await?;
        let is_alone =
            |own: &&Prepared| !own.is_disputed && now.saturating_duration_since(own.since) >= ALONE;
        if let Some(own) = session.prepared.as_ref().filter(is_alone) {
            let sequence = own.snapshot.sequence;
            self.store_snapshot(session, sequence);
        }
        self.consider_snapshot(session, now);
        Ok(())
    }

    fn consider_snapshot(&mut self, session: &mut Session, now: Instant) {
        let Some((_, pointer)) = &self.pointer else { return };
        let newest = &pointer.newest;
        let since = self.state.steps.saturating_sub(newest.steps);
        let due = since >= self.settings.snapshot_steps
            || (now.saturating_duration_since(self.pointer_since) >= self.settings.snapshot_after
                && self.state.place.sequence > newest.sequence);
        let may = session.caught_up_at.is_none() && now >= session.no_snapshot_before;
        if due && may && !std::mem::replace(&mut session.takes_snapshot, true) {
            let (store, reports) = (session.store.clone(), session.reports.clone());
            let node = self.settings.node.clone();
            tokio::spawn(async move {
                // If the session has ended, the lease expires.
                let _ = reports.send(Report::Leased(store.lease(&node).await));
            });
        }
    }
}

/// The error in the answer of a stream, if it has not stored a message.
fn refusal(answer: &[u8]) -> Option<String> {
    #[derive(Deserialize)]
    struct Answer {
        error: Option<Refused>,
    }
    #[derive(Deserialize)]
    struct Refused {
        description: String,
    }
    // Most answers are short and have no error: they are not parsed.
    if !answer.windows(7).any(|part| part == b"\"error\"") {
        return None;
    }
    let answer: Answer = serde_json::from_slice(answer).ok()?;
    answer.error.map(|error| error.description)
}

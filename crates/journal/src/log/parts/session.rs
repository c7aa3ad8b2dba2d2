//! A session: one connection to the servers.
//!
//! It reads the stream from what was applied last, sends steps, and passes on what one part of the
//! [`Node`] finds out to the others. It ends at the first doubt, with all that the client has not sent.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Duration, Instant};

use async_nats::jetstream::{self, Context, kv};
use async_nats::{Client, Subscriber};
use futures_util::StreamExt;
use tokio::sync::mpsc::UnboundedReceiver;
use tokio::time::MissedTickBehavior;

use crate::log::digests::Verdict;
use crate::log::error::{End, LogError};
use crate::log::parts::background::{Background, Report};
use crate::log::parts::comparer::Replayed;
use crate::log::parts::node::{CHECK_INTERVAL, Node};
use crate::log::parts::sender::{Acknowledged, Publisher};
use crate::log::parts::session_start::{join, servers_behind};
use crate::log::settings::Settings;
use crate::log::state::{Applied, digest_of};
use crate::log::status::{Event, Phase};
use crate::log::stream::connection::{Connected, REQUEST_TIMEOUT, connect};
use crate::log::stream::message::{MAX_NODES, MessageError, Notice};
use crate::log::stream::messages::Messages;
use crate::log::stream::raw_message::Received;
use crate::log::stream::store::{DIGEST_KEY_PREFIX, OpenAs, SNAPSHOT_KEY, Store, parsed};

/// The most further messages that are applied before steps are sent.
const MAX_FURTHER_MESSAGES: usize = 255;

/// How often to look on how many servers the stream is, which an operator can change while nodes run, and
/// whether the key of the snapshot is still there: no watch says that its stream was purged, or has expired it.
pub(in crate::log) const EXAMINE_EVERY: Duration = Duration::from_secs(60);

/// The shortest heartbeat that a consumer is asked for.
const MIN_HEARTBEAT: Duration = Duration::from_millis(200);

struct Session<'n> {
    node: &'n mut Node,
    publisher: Publisher,
    background: Background,
    catch_up: CatchUp,
    began: Instant,
    last_applied: Instant,
    /// The last sequence of the stream when the session began.
    stream_end: u64,
}

/// Whether this node has applied all that the log had when the session began.
#[derive(Clone, Copy, PartialEq, Eq)]
enum CatchUp {
    /// It reads the stream. Nothing was sent in this session.
    Reading,
    /// When its message with this counter is applied, it has caught up.
    Announced {
        counter: u64,
    },
    /// It has applied all, up to this sequence, and waits until it knows whether seals stay open.
    Applied {
        sequence: u64,
    },
    CaughtUp,
}

/// What a session waits for.
struct Sources {
    connected: Connected,
    messages: Messages,
    acks: Subscriber,
    watch: kv::Watch,
    reports: UnboundedReceiver<Report>,
}

/// Runs a session. Returns why it has ended, and whether the node had caught up.
pub(in crate::log) async fn run(node: &mut Node) -> (End, bool) {
    node.begin_session();
    match Session::open(node).await {
        Ok((mut session, sources)) => {
            let Err(end) = session.serve(sources).await;
            (end, session.catch_up == CatchUp::CaughtUp)
        }
        Err(end) => (end, false),
    }
}

impl<'n> Session<'n> {
    async fn open(node: &'n mut Node) -> Result<(Session<'n>, Sources), End> {
        let settings = Arc::clone(&node.settings);
        let name = format!("holdfast log {} {}", settings.name, settings.node);
        let limit = node.shared.message_limit.clone();
        let connected = node.run_with_expiry(connect(&settings.servers, name, &limit)).await??;
        node.connection_end = Some(connected.end.clone());
        let error = connected.error.clone();
        let begun = Session::begin(node, &settings, connected).await;
        begun.map_err(|end| end.because(error.borrow().as_deref()))
    }

    /// Loads a snapshot if that is needed, and follows the log.
    async fn begin(
        node: &'n mut Node,
        settings: &Settings,
        connected: Connected,
    ) -> Result<(Session<'n>, Sources), End> {
        let store = open_store(node, &connected.client).await?;
        let from = join(node, &store).await?;
        mend_keys(node, &store).await?;
        let messages = Messages::new(&store, from);
        let limit = node.shared.message_limit.clone();
        let publisher = Publisher::new(connected.client.clone(), settings, store.id(), limit);
        let acks = node.run_with_expiry(publisher.acknowledgements()).await??;
        let watched = [SNAPSHOT_KEY.to_owned(), format!("{DIGEST_KEY_PREFIX}>")];
        let watch = node.run_with_expiry(store.keys.watch_many_with_history(watched)).await?;
        let watch = watch.map_err(|error| End::lost("subscribe", error))?;
        let info = store.stream.cached_info();
        let (stream_end, replicas) = (info.state.last_sequence, info.config.num_replicas);
        let server = connected.server.clone();
        node.shared.event(Event::new("log_connected", &[("server", &server)]));
        node.shared.update(|view| (view.server, view.awaits_seal_answer) = (Some(server), false));
        node.learn_replicas(replicas);
        let (background, reports) = Background::new(store);
        let (now, catch_up) = (Instant::now(), CatchUp::Reading);
        let (began, last_applied) = (now, now);
        let session =
            Session { node, publisher, background, catch_up, began, last_applied, stream_end };
        Ok((session, Sources { connected, messages, acks, watch, reports }))
    }

    async fn serve(&mut self, sources: Sources) -> Result<Infallible, End> {
        let Sources { mut connected, mut messages, mut acks, mut watch, mut reports } = sources;
        // Steps whose time is over are not sent again.
        self.node.sender.expire(Instant::now());
        self.announce().await?;
        let mut server_error = connected.error.clone();
        let mut checks = tokio::time::interval(CHECK_INTERVAL);
        checks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let every = self.node.settings.examine_every;
        let first = tokio::time::Instant::now() + every;
        let mut examinations = tokio::time::interval_at(first, every);
        examinations.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            if messages.are_calm() {
                self.consume(&mut messages).await?;
            }
            tokio::select! {
                received = messages.next() => {
                    self.receive(&received?)?;
                    // What has arrived together is answered before steps are sent: writers that
                    // were answered write again, and their steps become one batch.
                    for _ in 0..MAX_FURTHER_MESSAGES {
                        let Some(received) = messages.next_now() else { break };
                        self.receive(&received?)?;
                    }
                    self.announce().await?;
                    self.answer().await?;
                    self.send_waiting().await?;
                }
                ack = acks.next() => {
                    if self.node.sender.acknowledged(ack)? == Acknowledged::NoRoom {
                        self.node.snapshotter.make_room(&self.background);
                    }
                }
                () = self.node.shared.step_arrived.notified() => self.send_waiting().await?,
                entry = watch.next() => match entry {
                    Some(Ok(entry)) => self.watched(&entry)?,
                    Some(Err(error)) => return Err(End::lost("watching the keys of the log", error)),
                    None => return Err(End::Lost("the watch of the keys has ended".to_owned())),
                },
                Some(report) = reports.recv() => self.reported(report).await?,
                Ok(()) = server_error.changed() => {
                    if let Some(error) = server_error.borrow_and_update().as_deref() {
                        self.node.sender.report(error);
                    }
                }
                end = connected.end.wait() => {
                    // The message that has ended the connection comes next in the next session.
                    while let Some(Ok(received)) = messages.next_now() {
                        self.receive(&received)?;
                    }
                    return Err(end);
                }
                _ = checks.tick() => self.check().await?,
                _ = examinations.tick() => self.background.spawn(|store| async move {
                    let replicas = store.replicas().await;
                    Report::Examined { replicas, found: store.examine().await.map(|_| ()) }
                }),
            }
        }
    }

    /// Lets a consumer deliver the next messages: all that were fetched lately are harmless.
    async fn consume(&mut self, messages: &mut Messages) -> Result<(), End> {
        let from = self.node.applier.sequence() + 1;
        let heartbeat = (self.node.settings.max_silence() / 4).max(MIN_HEARTBEAT);
        let consumer = self.background.store().consume(from, heartbeat);
        messages.consume(self.node.run_with_expiry(consumer).await??);
        Ok(())
    }

    /// Sends what was not confirmed before, and the message at which this node has caught up. A node
    /// that has sent nothing yet first reads all that the log had when the session began.
    async fn announce(&mut self) -> Result<(), End> {
        let Session { node, publisher, .. } = self;
        if self.catch_up != CatchUp::Reading {
            return Ok(());
        }
        // Its start has to be behind all its starts in the log.
        if !node.sender.has_started() && node.applier.sequence() < self.stream_end {
            return Ok(());
        }
        check_room(node)?;
        let last_start = node.applier.state().last_start(&node.settings.node);
        node.sender.ensure_start(last_start)?;
        node.sender.resend(publisher).await?;
        let compares = !node.rejoin.contents_are_right();
        let notice = node.continuity.question();
        let counter = node.sender.send_probe(publisher, compares, notice).await?;
        self.catch_up = CatchUp::Announced { counter };
        Ok(())
    }

    /// Answers a node that has started. Before a session has sent again what was not confirmed, all nodes would
    /// take that as overtaken by the answer.
    async fn answer(&mut self) -> Result<(), End> {
        if self.catch_up == CatchUp::CaughtUp
            && let Some(answer) = self.node.continuity.take_answer()
        {
            self.notify(Some(answer)).await?;
        }
        Ok(())
    }

    /// Sends a message without steps, with or without a notice. Returns its number.
    async fn notify(&mut self, notice: Option<Notice>) -> Result<u64, End> {
        self.node.sender.send_probe(&mut self.publisher, false, notice).await
    }

    async fn send_waiting(&mut self) -> Result<(), End> {
        self.node.sender.send_waiting(&mut self.publisher).await
    }

    /// Applies a message of the stream.
    fn receive(&mut self, received: &Received) -> Result<(), End> {
        let Node { applier, sender, .. } = &mut *self.node;
        let applied = applier.receive(received, |origin| sender.first_sent(origin))?;
        let Some(applied) = applied else { return Ok(()) };
        self.last_applied = Instant::now();
        self.node.snapshotter.applied(received.payload.len());
        let (mut compares, mut is_for_snapshot) = (false, false);
        match applied {
            Applied::Fresh { origin, compares: is_asked, notice, outcomes, .. } => {
                compares = is_asked;
                let stored = received.position.stored;
                let own = self.node.sender.applied(&origin, stored, outcomes)?;
                if let Some(counter) = own {
                    is_for_snapshot = self.node.snapshotter.is_requested_at(counter);
                    self.applied_own(counter);
                }
                let Node { applier, continuity, .. } = &mut *self.node;
                continuity.applied(applier.state(), &origin.node, notice, own, self.last_applied);
                self.finish_catch_up();
            }
            Applied::Stale(origin) => self.node.sender.check_start(&origin)?,
            // It may be that of this node, if another new one was first.
            Applied::Ignored(MessageError::TooManyNodes) => check_room(self.node)?,
            Applied::Ignored(_) => {}
        }
        let sequence = received.position.sequence;
        if compares || self.node.comparer.is_due(sequence) {
            self.compare(sequence, is_for_snapshot)?;
        }
        Ok(())
    }

    /// A message of this node was applied. Has it applied all that the log had?
    fn applied_own(&mut self, counter: u64) {
        if matches!(self.catch_up, CatchUp::Announced { counter: at } if at <= counter) {
            let Node { shared, applier, continuity, .. } = &mut *self.node;
            self.catch_up = CatchUp::Applied { sequence: applier.sequence() };
            continuity.joined(applier.state(), self.last_applied);
            shared.update(|view| view.awaits_seal_answer = !continuity.is_known());
        }
    }

    fn finish_catch_up(&mut self) {
        let CatchUp::Applied { sequence } = self.catch_up else { return };
        if !self.node.continuity.is_known() {
            return;
        }
        self.catch_up = CatchUp::CaughtUp;
        let Node { shared, rejoin, .. } = &mut *self.node;
        shared.open(self.publisher.max_steps_bytes());
        shared.update(|view| view.awaits_seal_answer = false);
        shared.event(Event::new("log_caught_up", &[("sequence", &sequence.to_string())]));
        if rejoin.caught_up(sequence) {
            shared.update(|view| {
                view.phase = Phase::Running;
                view.last_error = None;
            });
        }
    }

    /// Compares the contents of this node with those of the others.
    fn compare(&mut self, sequence: u64, is_for_snapshot: bool) -> Result<(), End> {
        let Node { applier, snapshotter, comparer, .. } = &mut *self.node;
        let encoded = applier.state().encode();
        let digest = digest_of(&encoded);
        let verdict = comparer.publish(&self.background, sequence, &digest);
        if is_for_snapshot {
            snapshotter.prepare(applier.state(), encoded, digest);
        }
        self.judge(sequence, verdict)
    }

    /// Draws the consequences of a comparison.
    fn judge(&mut self, sequence: u64, verdict: Verdict) -> Result<(), End> {
        let Node { snapshotter, comparer, rejoin, .. } = &mut *self.node;
        match verdict {
            Verdict::Alone => {}
            Verdict::Agrees => {
                snapshotter.store(&self.background, sequence);
                rejoin.confirm(sequence);
                comparer.show(sequence, true);
            }
            Verdict::Differs(other) => {
                return Err(comparer.differs(sequence, format!("most nodes have {other}")));
            }
            Verdict::Unclear(_) => {
                snapshotter.dispute(sequence);
                comparer.show(sequence, false);
                if self.replay(sequence) {
                    let at = sequence.to_string();
                    self.node.shared.event(Event::new("log_digests_differ", &[("sequence", &at)]));
                }
            }
        }
        Ok(())
    }

    fn replay(&mut self, sequence: u64) -> bool {
        let Node { applier, snapshotter, comparer, .. } = &mut *self.node;
        let members = &applier.state().members;
        comparer.replay(&self.background, snapshotter.pointer(), members, sequence)
    }

    /// A key of the log was written.
    fn watched(&mut self, entry: &kv::Entry) -> Result<(), End> {
        let Node { applier, snapshotter, comparer, .. } = &mut *self.node;
        if entry.key == SNAPSHOT_KEY {
            match parsed(&entry.value) {
                Ok(pointer) => snapshotter.learn(entry.revision, pointer),
                // Deleted, or written by another program.
                Err(error) => self.key_lost(End::Lost(error.to_string()))?,
            }
            return Ok(());
        }
        match comparer.receive(applier.state(), &entry.key, &entry.value) {
            Some((sequence, verdict)) => self.judge(sequence, verdict),
            None => Ok(()),
        }
    }

    async fn reported(&mut self, report: Report) -> Result<(), End> {
        match report {
            Report::Leased(Ok(true)) => {
                let Node { sender, snapshotter, .. } = &mut *self.node;
                let counter = sender.send_probe(&mut self.publisher, true, None).await?;
                snapshotter.requested(counter);
            }
            Report::Leased(Ok(false)) => self.node.snapshotter.postpone(),
            Report::Leased(Err(end)) => return Err(end),
            Report::Stored((revision, pointer)) => {
                self.node.snapshotter.stored(revision, pointer);
            }
            Report::NotStored { reason, known, found } => {
                self.node.snapshotter.failed(&reason, known, found)?;
            }
            Report::Examined { replicas, found } => {
                // If the servers don't say, the next look does better.
                if let Some(replicas) = replicas {
                    self.node.learn_replicas(replicas);
                }
                found.or_else(|end| self.key_lost(end))?;
            }
            Report::Freed(freed) => self.node.snapshotter.freed(freed),
            Report::Replayed { sequence, digest } => self.replayed(sequence, digest)?,
        }
        Ok(())
    }

    /// The log has lost the key of the snapshot. A node that knows what it named makes it anew in the next session.
    fn key_lost(&mut self, end: End) -> Result<(), End> {
        if self.node.snapshotter.pointer().is_some() {
            return Err(end);
        }
        self.node.sender.report(&end.reason());
        Ok(())
    }

    fn replayed(&mut self, sequence: u64, digest: Result<String, String>) -> Result<(), End> {
        let Node { snapshotter, comparer, rejoin, .. } = &mut *self.node;
        match comparer.replayed(sequence, digest)? {
            Replayed::Agrees => {
                snapshotter.store(&self.background, sequence);
                rejoin.confirm(sequence);
            }
            Replayed::Failed => rejoin.postpone(),
        }
        // If that was it, it is being stored.
        snapshotter.drop_disputed();
        Ok(())
    }

    /// Does what is due.
    async fn check(&mut self) -> Result<(), End> {
        let now = Instant::now();
        self.node.keep_deadlines(now);
        self.node.shared.expire(now);
        // Steps that were sent are still answered before the end.
        if self.node.shared.is_stopping() && self.node.sender.is_idle() {
            return Err(End::Stopped);
        }
        let silent = now.saturating_duration_since(self.last_applied.max(self.began));
        // A server that is cut off from the stream may keep the connection open for long.
        if silent > self.node.settings.max_silence() {
            self.check_end().await?;
            let seconds = silent.as_secs_f64();
            let mut reason = format!("the log has confirmed nothing for {seconds:.1} s");
            if let Some(refusal) = self.node.sender.refusal() {
                reason = format!("{reason}: {refusal}");
            }
            return Err(End::Lost(reason));
        }
        self.prove_contact(now).await?;
        self.close_seals(now).await?;
        self.send_waiting().await?;
        let Node { applier, snapshotter, comparer, rejoin, .. } = &mut *self.node;
        snapshotter.store_undisputed(&self.background, now);
        // Only a node that is up to date and sure of its contents takes a snapshot.
        if rejoin.contents_are_right() && self.catch_up == CatchUp::CaughtUp {
            snapshotter.consider(&self.background, applier.state(), now);
        }
        // The digest of an old sequence may be forgotten, and the log may not reach back to it any more.
        if let Some(sequence) = rejoin.overdue(now).and_then(|from| comparer.last_compared(from)) {
            self.replay(sequence);
        }
        Ok(())
    }

    /// Whether the stream still has what it ended with when the session began: a node that reads up to there
    /// would wait for ever.
    async fn check_end(&mut self) -> Result<(), End> {
        let (next, end) = (self.node.applier.sequence() + 1, self.stream_end);
        if self.catch_up != CatchUp::Reading || next > end {
            return Ok(());
        }
        let store = self.background.store().clone();
        for sequence in [next, end] {
            if self.node.run_with_expiry(store.message(sequence)).await??.is_some() {
                return Ok(());
            }
        }
        Err(End::missing(next, end))
    }

    /// Sends a message if nothing was sent for a while: when it is applied, the contents are current.
    async fn prove_contact(&mut self, now: Instant) -> Result<(), End> {
        let Node { settings, continuity, .. } = &*self.node;
        let last_sent = self.publisher.last_sent();
        let (last, pause) = match self.catch_up {
            CatchUp::Reading => return Ok(()),
            // Seldom: a message that closes seals does not count behind it, whoever sends the one or the other.
            CatchUp::Applied { .. } => {
                (last_sent.max(self.last_applied), settings.max_silence() / 2)
            }
            CatchUp::Announced { .. } | CatchUp::CaughtUp => {
                (last_sent, settings.contact_interval())
            }
        };
        if now.saturating_duration_since(last) >= pause {
            let question = continuity.question();
            self.notify(question).await?;
        }
        Ok(())
    }

    /// Closes seals on all nodes, if this one has started and no other one was running.
    async fn close_seals(&mut self, now: Instant) -> Result<(), End> {
        let Node { applier, continuity, .. } = &mut *self.node;
        if let Some(notice) = continuity.due(applier.sequence(), now) {
            let counter = self.notify(Some(notice)).await?;
            self.node.continuity.closing(counter, now);
        }
        Ok(())
    }
}

/// Without room in the log, all nodes would ignore what this one sends.
fn check_room(node: &Node) -> Result<(), LogError> {
    let name = &node.settings.node;
    if node.applier.state().has_room_for(name) {
        return Ok(());
    }
    Err(LogError::TooManyNodes { node: name.clone(), most: MAX_NODES })
}

async fn open_store(node: &mut Node, client: &Client) -> Result<Store, End> {
    let mut context: Context = jetstream::new(client.clone());
    context.set_timeout(REQUEST_TIMEOUT);
    let (settings, fingerprint) = (Arc::clone(&node.settings), node.fingerprint.clone());
    // A node that has applied something makes no new stream in place of the one that is missing.
    let is_known = node.applier.stream_id().is_some();
    if is_known && node.run_with_expiry(Store::is_missing(&context, &settings)).await?? {
        let text = "the servers do not have the stream of the log any more: they have lost it";
        return Err(servers_behind(node, text.to_owned()));
    }
    node.run_with_expiry(Store::open(&context, &settings, &fingerprint, OpenAs::Node)).await?
}

/// Anyone may write keys whose headers end the connection. They would end each session. And whoever may
/// delete the bucket of the keys deletes what nodes begin with.
async fn mend_keys(node: &mut Node, store: &Store) -> Result<(), End> {
    let Some(pointer) = node.snapshotter.pointer().cloned() else { return Ok(()) };
    if node.run_with_expiry(store.mend_keys(&pointer)).await?? {
        let reason = "keys of the log that were missing, or can't be read, were replaced";
        node.shared.event(Event::new("log_error", &[("reason", reason)]));
    }
    Ok(())
}

//! The thread of a log: sessions with the servers, one after the other.
//!
//! A session is one connection. It reads the stream from what was applied last, sends steps, and
//! ends at the first doubt. Then the next one begins.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Duration, Instant};

use async_nats::jetstream::{self, Context};
use futures_util::StreamExt;
use holdfast_runtime::Retry;
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;

use super::connection::connect;
use super::error::{End, LogError};
use super::messages::Messages;
use super::node::{LogSession, NOT_ANNOUNCED, Node, Report};
use super::sent::LOOK;
use super::status::{Event, Phase};
use super::store::{DIGEST, POINTER, Store, subject};

/// The most further messages that are applied before steps are sent.
const TOGETHER_RECEIVED: usize = 255;

/// Pauses between sessions. Many nodes share the servers.
const RETRY: Retry =
    Retry { first: Duration::from_millis(50), most: Duration::from_secs(1), jitter: true };

/// How long requests to JetStream may take.
const REQUEST: Duration = Duration::from_secs(3);

impl Node {
    /// Runs sessions until the log is stopped, or can't go on.
    pub(super) fn run(mut self) {
        let mut failures = 0_u32;
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
                    if !self.may_return(&error) {
                        let is_right = !matches!(error, LogError::Differs { .. });
                        self.shared.give_kept(is_right.then(|| self.kept()).flatten(), true);
                        return self.shared.fail(error);
                    }
                    self.drop_contents(error);
                }
                End::Lost(reason) => self.lost(reason),
            }
            if std::mem::take(&mut self.worked) {
                failures = 0;
            }
            failures = failures.saturating_add(1);
            let pause = RETRY.pause(failures);
            let until = Instant::now() + pause;
            while Instant::now() < until && !self.shared.is_stopping() {
                std::thread::sleep(LOOK.min(pause));
                self.sent.expire(Instant::now(), &self.shared.counters);
                self.keep();
            }
        }
        self.sent.expire(Instant::now() + self.settings.write_timeout, &self.shared.counters);
        self.shared.give_kept(self.kept(), true);
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
        if let Some((_, pointer)) = self.pointer.clone()
            && self.tend(store.mend_keys(&pointer)).await??
        {
            let reason = "keys of the log that can't be read were replaced";
            self.shared.event(Event::new("log_error", &[("reason", reason)]));
        }
        let mut messages = Messages::new(&store, from);
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
        let mut session = LogSession {
            subject: subject(&settings.name),
            inbox,
            longest: client.server_info().max_payload.saturating_sub(1024),
            client,
            last: store.stream.cached_info().state.last_sequence,
            store,
            began: now,
            last_sent: now,
            last_applied: now,
            caught_up_at: Some(NOT_ANNOUNCED),
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
        self.announce(&mut session).await?;

        let mut look = tokio::time::interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            if messages.are_calm() {
                let from = self.state.place.sequence + 1;
                let heartbeat = (settings.silence() / 4).max(Duration::from_millis(200));
                let store = session.store.clone();
                messages.consume(self.tend(store.consume(from, heartbeat)).await??);
            }
            tokio::select! {
                received = messages.next() => {
                    self.received(&mut session, received?)?;
                    // What has arrived together is answered before steps are sent: those who were
                    // answered write again, and their steps travel together.
                    for _ in 0..TOGETHER_RECEIVED {
                        let Some(received) = messages.next_now() else { break };
                        self.received(&mut session, received?)?;
                    }
                    self.announce(&mut session).await?;
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
                end = connected.end() => {
                    // The message that has ended the connection comes next in the next session.
                    while let Some(Ok(received)) = messages.next_now() {
                        self.received(&mut session, received)?;
                    }
                    return Err(end);
                }
                _ = look.tick() => self.look(&mut session).await?,
            }
        }
    }

    async fn reported(&mut self, session: &mut LogSession, report: Report) -> Result<(), End> {
        match report {
            Report::Leased(is) => self.leased(session, is).await?,
            Report::Stored(stored) => self.stored(session, stored),
            Report::Replayed { sequence, digest } => self.replayed(session, sequence, digest)?,
        }
        Ok(())
    }

    async fn look(&mut self, session: &mut LogSession) -> Result<(), End> {
        let now = Instant::now();
        self.keep();
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
        let is_announced = session.caught_up_at != Some(NOT_ANNOUNCED);
        if is_announced && now.saturating_duration_since(session.last_sent) >= self.settings.tick()
        {
            let until = now + self.settings.write_timeout;
            self.send(session, false, Vec::new(), Vec::new(), until).await?;
        }
        self.send_waiting(session).await?;
        self.consider_snapshot(session, now);
        self.consider_return(session, now);
        Ok(())
    }
}

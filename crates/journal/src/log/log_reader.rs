//! Rebuilds what a log leads to, in memories of its own, without writing.

use std::sync::Arc;
use std::time::Duration;

use async_nats::jetstream;
use futures_util::StreamExt;
use holdfast_memory::{Access, Action, Gate, Memory, Outcome, Refusal, Step, StepWrite};

use super::error::{End, LogError, missing};
use super::layout::fingerprint;
use super::settings::Settings;
use super::state::{Applied, State, StreamPosition, digest_of};
use crate::log::stream::connection::connect;
use crate::log::stream::message::{self, MessageError, Origin};
use crate::log::stream::message_limit::MessageLimit;
use crate::log::stream::messages::{Fetched, fetched};
use crate::log::stream::store::{OpenAs, Pointer, Snapshot, Store};

/// Where to end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Until {
    Sequence(u64),
    /// Nanoseconds of Unix time: the last message that was stored until then.
    Time(i64),
    /// The last message there is now.
    Now,
    /// Never: what comes is followed.
    Forever,
}

/// A message that was applied.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Record {
    pub sequence: u64,
    /// When the stream stored it, in nanoseconds of Unix time.
    pub stored: i64,
    /// `None` if it is not of a node. Then it has no steps.
    pub origin: Option<Origin>,
    /// Seals that it has closed are writes of their gate bits.
    pub steps: Vec<Step>,
    /// Why steps were refused, by their index.
    pub refusals: Vec<Option<Refusal>>,
    /// Whether it changed anything: a message that was sent twice does so once.
    pub fresh: bool,
}

/// Reads a log from a snapshot on.
pub struct LogReader {
    runtime: tokio::runtime::Runtime,
    reading: Reading,
    until: Until,
    last: u64,
    ended: bool,
}

struct Reading {
    state: State,
    messages: Fetched,
    log_id: Option<String>,
}

impl LogReader {
    /// Connects, and loads the newest snapshot that is not behind the end. The contents of the
    /// memories are replaced.
    ///
    /// # Errors
    /// [`LogError`]; also if the stream does not reach back that far.
    pub fn open(
        settings: &Settings,
        mut members: Vec<(String, Arc<Memory>)>,
        until: Until,
        timeout: Duration,
    ) -> Result<LogReader, LogError> {
        settings.check()?;
        members.sort_by(|(one, _), (other, _)| one.cmp(other));
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|error| LogError::Thread(error.to_string()))?;
        let opening = async {
            let name = format!("holdfast log replay {}", settings.name);
            let connected = connect(&settings.servers, name, &MessageLimit::default()).await?;
            let context = jetstream::new(connected.client);
            let store =
                Store::open(&context, settings, &fingerprint(&members), OpenAs::Reader).await?;
            let last = store.stream.cached_info().state.last_sequence;
            let Some((_, pointer)) = store.pointer().await? else {
                return Err(LogError::Snapshot("the log has no snapshot".to_owned()).into());
            };
            let members = members.iter().map(|(_, memory)| Arc::clone(memory)).collect();
            let known = [Some(&pointer.newest), pointer.previous.as_ref()];
            Ok((read_from(&store, known, members, until).await?, last))
        };
        let timed = async { tokio::time::timeout(timeout, opening).await };
        let last = "the servers do not answer".to_owned();
        match runtime.block_on(timed) {
            Ok(Ok((reading, last))) => {
                Ok(LogReader { runtime, reading, until, last, ended: false })
            }
            Ok(Err(End::Fatal(error))) => Err(error),
            Ok(Err(End::Lost(last))) => Err(LogError::NoConnection { within: timeout, last }),
            Ok(Err(End::Stopped)) | Err(_) => Err(LogError::NoConnection { within: timeout, last }),
        }
    }

    /// Applies the next message. `None` if none comes within this time, and at the [end](LogReader::has_ended).
    ///
    /// # Errors
    /// [`LogError`]. The reader is at its end then.
    pub fn next(&mut self, timeout: Duration) -> Result<Option<Record>, LogError> {
        let end = match self.until {
            Until::Sequence(end) => Some(end.min(self.last)),
            Until::Now => Some(self.last),
            // Without messages until then, the last one known is the end.
            Until::Time(_) => Some(self.last),
            Until::Forever => None,
        };
        if self.ended || end.is_some_and(|end| self.reading.state.position.sequence >= end) {
            self.ended = true;
            return Ok(None);
        }
        let next = self.reading.next(self.until);
        let timed = async { tokio::time::timeout(timeout, next).await };
        let result = match self.runtime.block_on(timed) {
            Err(_) => return Ok(None),
            Ok(Ok(Some(record))) => return Ok(Some(record)),
            Ok(Ok(None) | Err(End::Stopped)) => Ok(None),
            Ok(Err(End::Fatal(error))) => Err(error),
            Ok(Err(End::Lost(last))) => Err(LogError::NoConnection { within: timeout, last }),
        };
        self.ended = true;
        result
    }

    /// Whether all is applied up to the end, or an error came.
    pub fn has_ended(&self) -> bool {
        self.ended
    }

    /// The sequence that was applied last.
    pub fn sequence(&self) -> u64 {
        self.reading.state.position.sequence
    }

    /// When the stream stored the message that was applied last, in nanoseconds of Unix time.
    pub fn stored(&self) -> i64 {
        self.reading.state.position.stored
    }

    /// The last sequence that the stream had when this began.
    pub fn last_sequence(&self) -> u64 {
        self.last
    }

    /// The digest of the contents, as nodes compare it.
    pub fn digest(&self) -> String {
        digest_of(&self.reading.state.encode())
    }
}

impl Reading {
    /// What closing a seal has written, as a step.
    fn closed_gate(&self, member: u16) -> Option<Step> {
        let Gate { area, address, .. } = self.state.members.get(usize::from(member))?.gate()?;
        let write = StepWrite { member, area, address, count: 1, bytes: vec![0] };
        let action = Action::Write(vec![write]);
        Some(Step { access: Access::Ingest, tenure: None, action })
    }

    /// `None` at a message that was stored after the end.
    async fn next(&mut self, until: Until) -> Result<Option<Record>, End> {
        let next = self.state.position.sequence + 1;
        loop {
            let received = self.messages.next().await;
            let ended = || Err(End::Lost("the messages have ended".to_owned()));
            let received = received.unwrap_or_else(ended)?;
            let position = received.position;
            if position.sequence < next {
                continue;
            }
            // Messages were removed behind a newer snapshot: what is missing can't be rebuilt.
            if position.sequence > next {
                return Err(LogError::Snapshot(missing(next, position.sequence - 1)).into());
            }
            if matches!(until, Until::Time(end) if position.stored > end) {
                return Ok(None);
            }
            // Also a message that was applied before is shown, with its steps.
            let decoded = message::decode(&received.payload, &self.state.members).ok();
            let applied = received.apply_to(&mut self.state, self.log_id.as_deref(), |_| None)?;
            let is_other = matches!(applied, Applied::Ignored(MessageError::OtherLog));
            let decoded = decoded.filter(|_| !is_other);
            let (fresh, outcomes, sealed) = match applied {
                Applied::Fresh { outcomes, sealed, .. } => (true, outcomes, sealed),
                Applied::Stale(_) | Applied::Ignored(_) => (false, Vec::new(), Vec::new()),
            };
            let refusal = |outcome: Outcome| outcome.err().map(|refused| refused.refusal);
            let refusals = outcomes.into_iter().map(refusal).collect();
            let (origin, mut steps) =
                decoded.map(|message| (Some(message.origin), message.steps)).unwrap_or_default();
            steps.extend(sealed.into_iter().filter_map(|member| self.closed_gate(member)));
            let StreamPosition { sequence, stored } = position;
            return Ok(Some(Record { sequence, stored, origin, steps, refusals, fresh }));
        }
    }
}

/// Reads from the first of these snapshots that is not behind the end.
async fn read_from(
    store: &Store,
    known: [Option<&Snapshot>; 2],
    members: Vec<Arc<Memory>>,
    until: Until,
) -> Result<Reading, End> {
    let reaches = |snapshot: &&Snapshot| match until {
        Until::Sequence(end) => snapshot.sequence <= end,
        Until::Time(end) => snapshot.stored <= end,
        Until::Now | Until::Forever => true,
    };
    let snapshots = known.into_iter().flatten();
    let Some(snapshot) = snapshots.clone().find(reaches) else {
        let oldest = snapshots.map(|snapshot| snapshot.sequence).min().unwrap_or_default();
        let text = format!("the log reaches back to sequence {oldest}");
        return Err(LogError::Snapshot(text).into());
    };
    let mut state = State::new(members);
    store.load(snapshot, &mut state).await?;
    // Not a consumer: a message with malformed headers must not end it.
    let messages = fetched(store, state.position.sequence + 1);
    Ok(Reading { state, messages, log_id: store.id().map(str::to_owned) })
}

/// The digest that the log leads to at a sequence, from the oldest snapshot that the stream goes on
/// behind: the fewer nodes have made what this begins with, the better.
pub(super) async fn digest_at(
    store: &Store,
    pointer: &Pointer,
    members: Vec<Arc<Memory>>,
    sequence: u64,
) -> Result<String, String> {
    let until = Until::Sequence(sequence);
    let info = store.stream.get_info().await.map_err(|error| error.to_string())?;
    let is_continued = |snapshot: &&Snapshot| snapshot.sequence + 1 >= info.state.first_sequence;
    let known = [pointer.previous.as_ref().filter(is_continued), Some(&pointer.newest)];
    let mut reading = read_from(store, known, members, until).await.map_err(End::reason)?;
    while reading.state.position.sequence < sequence {
        reading.next(until).await.map_err(End::reason)?;
    }
    Ok(digest_of(&reading.state.encode()))
}

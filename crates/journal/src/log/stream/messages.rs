//! The messages of the stream, in their order: from a consumer, or fetched one by one.
//!
//! The client library ends its connection at a message whose headers it can't parse, and takes
//! a message whose headers have a status for an answer of the server. Any client that may publish can
//! send such messages. A fetched message is JSON, with its headers as text, so it does no harm: a session begins
//! with fetched messages, and changes to a consumer when those have no such headers.

use std::ops::RangeInclusive;
use std::time::Duration;

use async_nats::jetstream::consumer::pull;
use futures_util::stream::{self, BoxStream};
use futures_util::{FutureExt, StreamExt};

use crate::log::error::End;
use crate::log::state::StreamPosition;
use crate::log::stream::raw_message::{Received, log_id};
use crate::log::stream::store::Store;

/// How many requests for messages are in flight.
const MAX_FETCHES: usize = 16;

/// How often to look for new messages.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// A session fetches what was applied last, and the next message, which may have ended the session
/// before.
const FIRST_FETCHED_MESSAGES: u32 = 2;

/// Fetching ends after so many messages in a row that a consumer can deliver.
const CALM_AFTER_MESSAGES: u32 = 100;

pub(in crate::log) struct Messages(Source);

enum Source {
    Consumer(Box<pull::Stream>),
    Fetched { messages: Fetched, calm_after: u32 },
}

pub(in crate::log) type Fetched = BoxStream<'static, Result<Received, End>>;

impl Messages {
    /// Messages from this sequence on. Of those that the stream has already, the first are fetched.
    pub(in crate::log) fn new(store: &Store, from: u64) -> Messages {
        let there = (store.stream.cached_info().state.last_sequence + 1).saturating_sub(from);
        let calm_after = u32::try_from(there).unwrap_or(u32::MAX).min(FIRST_FETCHED_MESSAGES);
        Messages(Source::Fetched { messages: fetched(store, from), calm_after })
    }

    /// The next message. Nothing is lost if the future is dropped.
    pub(in crate::log) async fn next(&mut self) -> Result<Received, End> {
        match &mut self.0 {
            Source::Consumer(messages) => match messages.next().await {
                Some(Ok(message)) => delivered(&message),
                Some(Err(error)) => Err(End::lost("reading the stream", error)),
                None => Err(End::Lost("the consumer has ended".to_owned())),
            },
            Source::Fetched { messages, calm_after } => {
                let next = messages.next().await;
                let received = next.unwrap_or_else(|| Err(End::Lost("no messages".to_owned())))?;
                *calm_after = if received.is_readable {
                    calm_after.saturating_sub(1)
                } else {
                    CALM_AFTER_MESSAGES
                };
                Ok(received)
            }
        }
    }

    /// The next message, if it has arrived. Works after the end of the connection too.
    pub(in crate::log) fn next_now(&mut self) -> Option<Result<Received, End>> {
        self.next().now_or_never()
    }

    /// Whether a consumer can take over.
    pub(in crate::log) fn are_calm(&self) -> bool {
        matches!(self.0, Source::Fetched { calm_after: 0, .. })
    }

    pub(in crate::log) fn consume(&mut self, messages: pull::Stream) {
        self.0 = Source::Consumer(Box::new(messages));
    }
}

fn delivered(message: &async_nats::jetstream::Message) -> Result<Received, End> {
    let info = message.info().map_err(|error| End::lost("a message of the stream", error))?;
    let stored = info.published.unix_timestamp_nanos() as i64;
    let position = StreamPosition { sequence: info.stream_sequence, stored };
    let (payload, last) = (message.payload.clone(), position.sequence + info.pending);
    let log_id = log_id(message.headers.as_ref());
    Ok(Received { position, payload, last, is_readable: true, log_id })
}

/// Fetches messages from this sequence on. After the last one, waits for further ones.
pub(in crate::log) fn fetched(store: &Store, from: u64) -> Fetched {
    let ranges = stream::unfold((store.clone(), from), |(store, from)| async move {
        loop {
            match store.last().await {
                Ok(last) if last < from => tokio::time::sleep(POLL_INTERVAL).await,
                Ok(last) => return Some((Ok(from..=last), (store, last + 1))),
                Err(end) => return Some((Err(end), (store, from))),
            }
        }
    });
    let store = store.clone();
    let messages = ranges.flat_map(move |range| match range {
        Ok(range) => of_range(store.clone(), range),
        Err(end) => stream::once(async { Err(end) }).boxed(),
    });
    messages.boxed()
}

fn of_range(store: Store, range: RangeInclusive<u64>) -> Fetched {
    let last = *range.end();
    let messages = stream::iter(range).map(move |sequence| {
        let store = store.clone();
        async move {
            let message = store.message(sequence).await?;
            Ok(message.map(|message| Received { last, ..message }))
        }
    });
    // Those that are missing leave a gap in the sequences.
    messages.buffered(MAX_FETCHES).filter_map(|message| async { message.transpose() }).boxed()
}

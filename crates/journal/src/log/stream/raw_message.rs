//! A message of a stream, whatever its headers are.

use std::time::Duration;

use async_nats::HeaderMap;
use async_nats::jetstream::message::StreamMessage;
use async_nats::jetstream::response::Response;
use async_nats::jetstream::stream::RawMessage;
use async_nats::jetstream::{Context, ErrorCode};
use bytes::Bytes;
use serde::Deserialize;
use serde_json::Value;

use crate::log::error::{End, LogError};
use crate::log::state::{Applied, State, StreamPosition};
use crate::log::stream::message::{MessageError, Origin};

/// The beginning of headers without a status, `NATS/1.0` and a carriage return, in base64.
const WITHOUT_STATUS: &str = "TkFUUy8xLjAN";

#[derive(Debug)]
pub(in crate::log) struct Received {
    pub(in crate::log) position: StreamPosition,
    pub(in crate::log) payload: Bytes,
    /// The last sequence of the stream, as far as it is known.
    pub(in crate::log) last: u64,
    /// Whether a consumer can deliver it.
    pub(in crate::log) is_readable: bool,
    /// The log that its sender belongs to. `None` if it does not say so, as those of older releases.
    pub(in crate::log) log_id: Option<String>,
}

/// The header that says which log the sender of a message belongs to. Servers with a JetStream of their own that
/// are joined, as by a leaf node, store the messages of all logs of one name in each of these.
pub(in crate::log) const LOG_ID: &str = "Holdfast-Log-Id";

pub(in crate::log) fn log_id(headers: Option<&HeaderMap>) -> Option<String> {
    headers?.get(LOG_ID).map(|id| id.as_str().to_owned())
}

/// A message in JSON: its headers can't end the connection. `None` if the stream does not have it.
pub(in crate::log) async fn fetch(
    context: &Context,
    stream: &str,
    which: Value,
) -> Result<Option<Received>, End> {
    #[derive(Deserialize)]
    struct Fetched {
        message: RawMessage,
    }
    let lost = |error: &dyn std::fmt::Display| End::lost("fetching a message", error);
    let answer = context.request(format!("STREAM.MSG.GET.{stream}"), &which).await;
    match answer.map_err(|error| lost(&error))? {
        Response::Ok(Fetched { message }) => {
            Received::of(message).map(Some).map_err(|error| lost(&error))
        }
        Response::Err { error } if error.error_code() == ErrorCode::NO_MESSAGE_FOUND => Ok(None),
        Response::Err { error } => Err(lost(&error)),
    }
}

impl Received {
    /// Applies it as the next message of the log with this id, unless it was sent to another one.
    ///
    /// # Errors
    /// Those of [`State::apply`].
    pub(in crate::log) fn apply_to(
        &self,
        state: &mut State,
        id: Option<&str>,
        age: impl FnOnce(&Origin) -> Option<Duration>,
    ) -> Result<Applied, LogError> {
        if self.log_id.is_some() && self.log_id.as_deref() != id {
            return Ok(state.ignore(self.position, MessageError::OtherLog));
        }
        state.apply(self.position, &self.payload, age)
    }

    /// A message as a server describes it.
    fn of(message: RawMessage) -> Result<Received, async_nats::Error> {
        let is_plain = |headers: &String| headers.starts_with(WITHOUT_STATUS);
        // What is not UTF-8 in a subject is replaced in JSON.
        let breaks = |c: char| c.is_whitespace() || c == char::REPLACEMENT_CHARACTER;
        // The client library refuses to convert a message whose headers it can't parse.
        let without_headers = RawMessage { headers: None, ..message.clone() };
        let is_plain = message.headers.as_ref().is_none_or(is_plain);
        let has_subject = !message.subject.contains(breaks);
        let parsed = StreamMessage::try_from(message);
        let is_readable = is_plain && has_subject && parsed.is_ok();
        let log_id = parsed.ok().and_then(|parsed| log_id(Some(&parsed.headers)));
        let StreamMessage { sequence, payload, time, .. } = without_headers.try_into()?;
        let position = StreamPosition { sequence, stored: time.unix_timestamp_nanos() as i64 };
        Ok(Received { position, payload, last: sequence, is_readable, log_id })
    }
}

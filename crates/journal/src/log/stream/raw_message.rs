//! A message of a stream, whatever its headers are.

use async_nats::jetstream::message::StreamMessage;
use async_nats::jetstream::response::Response;
use async_nats::jetstream::stream::RawMessage;
use async_nats::jetstream::{Context, ErrorCode};
use bytes::Bytes;
use serde::Deserialize;
use serde_json::Value;

use crate::log::error::End;
use crate::log::state::StreamPosition;

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
    /// A message as a server describes it.
    fn of(message: RawMessage) -> Result<Received, async_nats::Error> {
        let is_plain = |headers: &String| headers.starts_with(WITHOUT_STATUS);
        // What is not UTF-8 in a subject is replaced in JSON.
        let breaks = |c: char| c.is_whitespace() || c == char::REPLACEMENT_CHARACTER;
        // The client library refuses to convert a message whose headers it can't parse.
        let without_headers = RawMessage { headers: None, ..message.clone() };
        let is_readable = message.headers.as_ref().is_none_or(is_plain)
            && !message.subject.contains(breaks)
            && StreamMessage::try_from(message).is_ok();
        let StreamMessage { sequence, payload, time, .. } = without_headers.try_into()?;
        let position = StreamPosition { sequence, stored: time.unix_timestamp_nanos() as i64 };
        Ok(Received { position, payload, last: sequence, is_readable })
    }
}

//! Which steps travel in one message, and what the stream answers to a message.

use std::time::Instant;

use async_nats::{HeaderMap, StatusCode, header};
use bytes::Bytes;
use holdfast_memory::{CarriedOut, Done};
use serde::Deserialize;

use super::error::End;
use super::message::{self, OVERHEAD, Origin};
use super::node::{LogSession, Node};
use super::status::Event;

/// The most bytes of steps that travel in one message with others.
const TOGETHER: usize = 64 << 10;

impl Node {
    /// Sends waiting steps, as long as there is room for them on the way.
    pub(super) async fn send_waiting(&mut self, session: &mut LogSession) -> Result<(), End> {
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

    pub(super) async fn send(
        &mut self,
        session: &mut LogSession,
        compares: bool,
        steps: Vec<Vec<u8>>,
        mut dones: Vec<Done>,
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

    pub(super) async fn publish(
        &mut self,
        session: &mut LogSession,
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

    pub(super) fn acknowledged(&mut self, ack: Option<async_nats::Message>) -> Result<(), End> {
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
